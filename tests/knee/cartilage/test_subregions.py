import numpy as np
import pytest
import trimesh

from marey.errors import MareyError
from marey.knee.cartilage.outer_surface import CartilageSheet
from marey.knee.cartilage.subregions import flat_map, subregion_names, subregions
from marey.knee.space.sides import is_left
from marey.knee.space.surface import TriangleSurface


def sheet_on(surface: TriangleSurface, thickness: np.ndarray) -> CartilageSheet:
    return CartilageSheet(
        bone=surface,
        normals=surface.vertex_normals,
        thickness_mm=thickness,
        thickness_sd_mm=np.where(thickness > 0, 0.1, np.nan),
        confidence=np.ones(len(thickness)),
    )


@pytest.fixture
def roller() -> TriangleSurface:
    """A femur's end as a roller of 20 mm radius about an axis from side to side."""
    mesh = trimesh.creation.cylinder(radius=20.0, height=60.0, sections=96).subdivide().subdivide()
    turned = np.asarray(mesh.vertices)[:, [2, 0, 1]]
    return TriangleSurface(vertices_mm=turned, faces=np.asarray(mesh.faces))


def test_a_roller_is_unrolled_to_the_length_of_its_arc(roller: TriangleSurface):
    on_side = np.linalg.norm(roller.vertices_mm[:, 1:], axis=1) > 19.9
    below = on_side & (roller.vertices_mm[:, 2] < 5) & (np.abs(roller.vertices_mm[:, 0]) < 29)
    flat = flat_map("femur", sheet_on(roller, np.where(below, 2.0, 0.0)), left=True)
    y, z = roller.vertices_mm[below, 1:].T
    np.testing.assert_allclose(flat.along[below], 20.0 * np.arctan2(y, -z), atol=0.1)
    np.testing.assert_allclose(flat.across[below], roller.vertices_mm[below, 0], atol=1.0)


def test_parts_have_their_sides_and_add_up_to_the_whole(roller: TriangleSurface):
    on_side = np.linalg.norm(roller.vertices_mm[:, 1:], axis=1) > 19.9
    thick = np.where(on_side & (roller.vertices_mm[:, 2] < 5), 2.0, 0.0)
    for left in (True, False):
        sheet = sheet_on(roller, thick)
        names = np.array(subregion_names("femur", sheet, left=left))
        lateral = np.char.startswith(names.astype(str), "lateral")
        far = np.abs(roller.vertices_mm[:, 0]) > 2
        np.testing.assert_array_equal(lateral[far], (roller.vertices_mm[far, 0] > 0) == left)
        front = np.char.endswith(names.astype(str), "anterior") & (thick > 0)
        assert roller.vertices_mm[front, 1].max() < 0
        *parts, whole = subregions("femur", sheet, left=left)
        assert len(parts) == 6
        np.testing.assert_allclose(sum(part.area_mm2 for part in parts), whole.area_mm2)
        np.testing.assert_allclose(sum(part.volume_mm3 for part in parts), 2.0 * whole.area_mm2)
        assert whole.mean_mm == pytest.approx(2.0)


def test_a_tibia_has_thirds_from_front_to_back():
    mesh = trimesh.creation.box((60, 40, 10)).subdivide().subdivide().subdivide().subdivide()
    surface = TriangleSurface(vertices_mm=mesh.vertices, faces=mesh.faces)
    sheet = sheet_on(surface, np.where(surface.vertices_mm[:, 2] > 4.9, 2.0, 0.0))
    names = np.array(subregion_names("tibia", sheet, left=True))
    y = surface.vertices_mm[:, 1]
    assert y[np.char.endswith(names, "anterior")].max() < -5
    assert np.abs(y[np.char.endswith(names, "central")]).max() < 8
    assert y[np.char.endswith(names, "posterior")].min() > 5


def test_a_bare_bone_has_no_map(roller: TriangleSurface):
    with pytest.raises(MareyError, match="no cartilage"):
        flat_map("femur", sheet_on(roller, np.zeros(len(roller.vertices_mm))), left=True)


def test_the_patella_shows_the_side(roller: TriangleSurface):
    def patella(x: float) -> TriangleSurface:
        return TriangleSurface(vertices_mm=0.3 * roller.vertices_mm + (x, -40, 0), faces=roller.faces)

    assert is_left({"femur": roller, "patella": patella(8.0)}) is True
    assert is_left({"femur": roller, "patella": patella(-8.0)}) is False
    assert is_left({"femur": roller, "patella": patella(0.5)}) is None
    assert is_left({"femur": roller}) is None

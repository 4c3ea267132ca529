from functools import cache

import numpy as np
import pytest
import trimesh

from marey.errors import MareyError
from marey.knee.cartilage.evidence import LEVELS_MM
from marey.knee.cartilage.knee_cartilage import KNEE_CARTILAGE_DEFAULTS, _why_invisible
from marey.knee.cartilage.labels import with_cartilage
from marey.knee.cartilage.outer_surface import (
    OUTER_SURFACE_DEFAULTS,
    _answers,
    _sd_of_direction,
    _without_specks,
    find_cartilage,
)
from marey.knee.cartilage.prediction import predict_cartilage
from marey.knee.registration.deformation import Deformation
from marey.knee.space.mesh_graph import MeshGraph
from marey.knee.space.structures import LABELS
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.volume import Labels, Volume, VoxelGrid

RADIUS, THICK, RIM = 15.0, 2.4, 0.3
"""A round bone under a cap of cartilage, down to z = RIM * radius."""
MARROW, CARTILAGE, FLESH = 15.0, 110.0, 32.0


def ball(radius: float = RADIUS, fine: int = 3) -> TriangleSurface:
    mesh = trimesh.creation.icosphere(subdivisions=fine, radius=radius)
    return TriangleSurface(vertices_mm=mesh.vertices, faces=mesh.faces)


@cache
def made_kinds() -> tuple[np.ndarray, VoxelGrid]:
    """Shares of bone, cartilage and flesh in voxels of half a millimetre by half by one."""
    spacing = np.array([0.5, 0.5, 1.0])
    shape = (46, 92, 92)
    matrix = np.diag([*spacing, 1.0])
    matrix[:3, 3] = -0.5 * spacing * (np.array(shape[::-1]) - 1)
    grid = VoxelGrid(shape=shape, lps_from_voxel=matrix)
    kinds = np.zeros((3, *shape))
    for shift in np.ndindex(2, 2, 2):
        index = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1)[..., ::-1]
        places = grid.lps(index + (np.array(shift) - 0.5) / 2)
        radius = np.linalg.norm(places, axis=-1)
        bone = radius < RADIUS
        cartilage = ~bone & (radius < RADIUS + THICK) & (places[..., 2] > RIM * radius)
        for kind, mask in zip(kinds, (bone, cartilage, ~bone & ~cartilage), strict=True):
            kind += mask / 8
    return kinds, grid


def places_of(grid: VoxelGrid) -> np.ndarray:
    index = np.stack(np.meshgrid(*(np.arange(n) for n in grid.shape), indexing="ij"), -1)[..., ::-1]
    return grid.lps(index.astype(float))


def made_volume(
    rng: np.random.Generator, values=(MARROW, CARTILAGE, FLESH), noise: float = 4.0
) -> tuple[Volume, Labels]:
    """Average over the box of each voxel."""
    kinds, grid = made_kinds()
    shape = grid.shape
    image = np.tensordot(values, kinds, 1)
    # The brightness varies over the image like the sensitivity of a coil.
    image *= 1 + 0.2 * np.linspace(-1, 1, shape[2])
    labels = np.where(kinds[0] > 0.5, LABELS["femur"], np.where(kinds[1] > 0.5, LABELS["femoral_cartilage"], 0))
    return Volume(intensity=image + rng.normal(0, noise, shape), grid=grid), Labels(labels=labels, grid=grid)


def predicted(bone: TriangleSurface, *, thick: float, rim: float):
    """Prediction by a template whose cartilage has another thickness and ends elsewhere."""
    height = bone.vertices_mm[:, 2] / np.linalg.norm(bone.vertices_mm, axis=1)
    return predict_cartilage(bone, bone, np.where(height > rim, thick, 0.0))


@pytest.mark.slow
@pytest.mark.parametrize("values", [(MARROW, CARTILAGE, FLESH), (120.0, 80.0, 130.0), (120.0, 80.0, 25.0)])
def test_cartilage_is_found_though_the_template_is_thicker_and_ends_elsewhere(rng, values):
    volume, truth = made_volume(rng, values)
    bone = ball()
    sheet = find_cartilage([volume], bone, predicted(bone, thick=3.0, rim=0.15))
    height = bone.vertices_mm[:, 2] / RADIUS
    inner = height > RIM + 0.1
    assert (sheet.thickness_mm[inner] > 0).all()
    assert (sheet.thickness_mm[height < RIM - 0.15] == 0).mean() > 0.9
    # Half a voxel of a millimetre.
    assert abs(np.median(sheet.thickness_mm[inner]) - THICK) < 0.25
    assert np.abs(sheet.thickness_mm[inner] - THICK).mean() < 0.3
    found = with_cartilage(Labels(labels=np.where(truth.mask("femur"), 1, 0), grid=truth.grid), {"femur": sheet})
    ours, true = found.mask("femoral_cartilage"), truth.mask("femoral_cartilage")
    assert 2 * (ours & true).sum() / (ours.sum() + true.sum()) > 0.85
    # The bone ends where the cartilage begins; elsewhere it does not change.
    changed = found.mask("femur") != truth.mask("femur")
    assert changed.sum() < 0.01 * truth.mask("femur").sum()
    assert not changed[: changed.shape[0] // 2].any()


@pytest.mark.slow
@pytest.mark.parametrize(("values", "off"), [((MARROW, CARTILAGE, FLESH), 0.8), ((120.0, 80.0, 130.0), -0.6)])
def test_a_displaced_bone_surface_is_corrected_under_cartilage(rng, values, off):
    volume, truth = made_volume(rng, values)
    bone = ball(RADIUS + off)
    sheet = find_cartilage([volume], bone, predicted(bone, thick=3.0, rim=0.15))
    height = bone.vertices_mm[:, 2] / (RADIUS + off)
    inner = height > RIM + 0.15
    lies = np.linalg.norm(sheet.bone.vertices_mm, axis=1)
    assert abs(np.median(lies[inner]) - RADIUS) < 0.1
    assert np.abs(lies[inner] - RADIUS).mean() < 0.15
    assert abs(np.median(sheet.thickness_mm[inner]) - THICK) < 0.15
    np.testing.assert_allclose(lies[height < -0.3], RADIUS + off, atol=0.1)
    # Voxels of the bone as it was found: none is left between bone and cartilage, and none outside.
    first = np.linalg.norm(places_of(truth.grid), axis=-1) < RADIUS + off
    found = with_cartilage(Labels(labels=np.where(first, LABELS["femur"], 0), grid=truth.grid), {"femur": sheet})
    cap = places_of(truth.grid)[..., 2] > (RIM + 0.15) * np.linalg.norm(places_of(truth.grid), axis=-1)
    radius = np.linalg.norm(places_of(truth.grid), axis=-1)
    for name in ("femur", "femoral_cartilage"):
        ours, true = found.mask(name) & cap, truth.mask(name) & cap
        assert 2 * (ours & true).sum() / (ours.sum() + true.sum()) > 0.9
    assert (found.labels[cap & (radius < RADIUS + THICK - 1)] > 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("thick", [1.5, 3.8])
def test_a_template_of_other_thickness_does_not_bias_the_result_where_the_edge_is_visible(rng, thick):
    volume, _ = made_volume(rng)
    bone = ball()
    sheet = find_cartilage([volume], bone, predicted(bone, thick=thick, rim=RIM))
    inner = bone.vertices_mm[:, 2] / RADIUS > RIM + 0.15
    off = sheet.thickness_mm[inner] - THICK
    assert abs(off.mean()) < 0.1
    assert np.abs(off).mean() < 0.15
    # The prediction by the template was scaled to the subject's thickness.
    assert abs(np.median(sheet.predicted_mm[inner]) - THICK) < 0.15
    sure = sheet.confidence[inner] > 0.5
    assert (np.abs(off) < 1.96 * sheet.thickness_sd_mm[inner])[sure].mean() > 0.85


@pytest.mark.slow
def test_where_the_image_shows_no_edge_only_the_template_determines_the_thickness(rng):
    bone = ball()
    inner = bone.vertices_mm[:, 2] / RADIUS > RIM + 0.15
    for flesh, seen in ((FLESH, True), (CARTILAGE, False)):
        volume, _ = made_volume(rng, (MARROW, CARTILAGE, flesh))
        sheet = find_cartilage([volume], bone, predicted(bone, thick=2.4, rim=RIM))
        known = inner & (sheet.thickness_mm > 0)
        assert bool((sheet.by_image[known] > 0.5).mean() > 0.9) is seen
        assert (_why_invisible(sheet, settings=KNEE_CARTILAGE_DEFAULTS) is None) is seen
    assert "its outer edge is not visible" in _why_invisible(sheet, settings=KNEE_CARTILAGE_DEFAULTS)


@pytest.mark.slow
def test_the_outer_surface_is_closed_and_has_the_cartilages_volume(rng):
    volume, _ = made_volume(rng)
    bone = ball()
    sheet = find_cartilage([volume], bone, predicted(bone, thick=2.4, rim=RIM))
    outer = sheet.outer
    assert trimesh.Trimesh(outer.vertices_mm, outer.faces, process=False).is_watertight
    cap = 2 / 3 * np.pi * ((RADIUS + THICK) ** 3 - RADIUS**3) * (1 - RIM)
    np.testing.assert_allclose(outer.volume_mm3, cap, rtol=0.15)
    assert sheet.confidence.min() >= 0
    assert sheet.confidence.max() <= 1
    np.testing.assert_array_equal(np.isnan(sheet.thickness_sd_mm), sheet.thickness_mm == 0)


@pytest.mark.slow
def test_where_two_cartilages_touch_the_space_is_shared(rng):
    # The other bone is a shell around, and all between the two is as bright as cartilage.
    volume, _ = made_volume(rng, (MARROW, CARTILAGE, CARTILAGE))
    bone, around = ball(), ball(RADIUS + 4.0)
    shell = TriangleSurface(vertices_mm=around.vertices_mm, faces=around.faces[:, ::-1])
    prediction = predicted(bone, thick=2.0, rim=0.0)
    sheet = find_cartilage([volume], bone, prediction, [(shell, np.full(len(around.vertices_mm), 2.0))])
    top = bone.vertices_mm[:, 2] > 0.5 * RADIUS
    assert abs(np.median(sheet.thickness_mm[top]) - 2.0) < 0.4
    # The sum of both is the distance of the bones; the part of each is as uncertain as the prediction.
    np.testing.assert_allclose(np.asarray(sheet.shared_mm)[top], 4.0, atol=0.3)
    assert np.median(sheet.thickness_sd_mm[top]) > 0.4


def test_the_spread_of_the_normals_widens_the_interval_of_a_sloping_cartilage():
    bone = ball()
    thickness = 2.0 + bone.vertices_mm[:, 2] / 15
    found = _sd_of_direction(bone, thickness, settings=OUTER_SURFACE_DEFAULTS)
    # On a ball, smoothing by a width w is diffusion, which shortens the mean normal to exp(-(w / radius)^2).
    spread = np.sqrt(2) * OUTER_SURFACE_DEFAULTS.normals_mm / RADIUS
    slope = MeshGraph.of(bone).slopes(thickness, thickness > 0)
    np.testing.assert_allclose(found, thickness * spread * slope, rtol=0.25)
    assert not _sd_of_direction(bone, np.full(len(thickness), 2.0), settings=OUTER_SURFACE_DEFAULTS).any()


def test_a_template_without_cartilage_is_an_error(rng):
    volume, _ = made_volume(rng)
    bone = ball()
    with pytest.raises(MareyError, match="predicts no cartilage"):
        find_cartilage([volume], bone, predict_cartilage(bone, bone, np.zeros(len(bone.vertices_mm))))


def test_thickness_is_carried_by_the_deformation():
    template = ball(fine=3)
    height = template.vertices_mm[:, 2]
    nodes = 4.0 * np.stack(np.meshgrid(*(np.arange(n) for n in (14, 14, 14)), indexing="ij")) - 26.0
    # The subject is 20 % longer along z: u - d(u) is the template's place.
    field = np.stack([0 * nodes[0], 0 * nodes[1], nodes[2] * (1 - 1 / 1.2)])
    deformation = Deformation(origin_mm=np.full(3, -26.0), step_mm=4.0, displacement_mm=field)
    bone = TriangleSurface(vertices_mm=template.vertices_mm * (1, 1, 1.2), faces=template.faces)
    prediction = predict_cartilage(bone, template, np.where(height > 0, 2.0 + 0.05 * height, 0.0), deformation)
    inner = height > 6
    np.testing.assert_allclose(prediction.thickness_mm[inner], (2.0 + 0.05 * height)[inner], atol=1e-2)
    assert prediction.presence[height > 12].min() > 0.95
    assert prediction.presence[height < -12].max() < 0.05


def test_a_lone_speck_is_no_cartilage_and_a_hole_no_lesion_with_low_confidence():
    bone = ball()
    up = bone.vertices_mm / RADIUS
    cap, island, hole = up[:, 2] > 0.3, up[:, 2] < -0.98, np.linalg.norm(up - [0.6, 0, 0.8], axis=1) < 0.08
    lesion = np.linalg.norm(up - [0, 0, 1], axis=1) < 0.25
    covered = (cap & ~lesion | island) & ~hole
    costs = np.full((len(up), len(LEVELS_MM)), 8.0)
    costs[np.arange(len(up)), np.where(covered, 8, 0)] = 0.0
    thickness, _, confidence = _answers(
        _without_specks(costs, bone, MeshGraph.of(bone), settings=OUTER_SURFACE_DEFAULTS),
        costs,
        settings=OUTER_SURFACE_DEFAULTS,
    )
    assert not thickness[island].any()
    assert not thickness[lesion].any()
    np.testing.assert_array_equal(thickness > 0, cap & ~lesion | hole)
    assert (confidence[island | hole] < 0.51).all()
    assert (confidence[cap & ~lesion & ~hole] > 0.9).all()

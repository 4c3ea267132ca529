import numpy as np
import pytest

from marey.errors import MareyError
from marey.knee.space.structures import LABELS
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.surfacing import smoothed_surface, surface_of_field, surface_of_labels
from marey.knee.space.volume import Labels, VoxelGrid

pytest.importorskip("skimage")
pytest.importorskip("fast_simplification")
RADIUS = 12.0


def ball(spacing: tuple[float, float, float], *, flip: bool) -> tuple[np.ndarray, VoxelGrid]:
    """Distance inside a ball about the origin, on a grid whose first axis may run to the right."""
    count = [int(36 / each) for each in spacing]
    lps_from_voxel = np.diag([-spacing[0] if flip else spacing[0], spacing[1], spacing[2], 1.0])
    lps_from_voxel[:3, 3] = [18.0 if flip else -18.0, -18.0, -18.0]
    grid = VoxelGrid(shape=(count[2], count[1], count[0]), lps_from_voxel=lps_from_voxel)
    k, j, i = np.meshgrid(*[np.arange(n) for n in grid.shape], indexing="ij")
    place = grid.lps(np.stack([i, j, k], axis=-1).astype(float))
    return RADIUS - np.linalg.norm(place, axis=-1), grid


@pytest.mark.parametrize("flip", [False, True])
def test_a_ball_of_thick_slices_is_a_ball_that_faces_outward(flip):
    distance, grid = ball((0.4, 0.4, 1.5), flip=flip)
    surface = surface_of_field(distance, grid)
    radii = np.linalg.norm(surface.vertices_mm, axis=1)
    # The linear field between slices 1.5 mm apart is flatter than the ball by 1.5^2 / 8 / 12 = 0.02 mm.
    assert abs(radii.mean() - RADIUS) < 0.06
    assert radii.std() < 0.06
    assert surface.volume_mm3 == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.02)
    outward = np.einsum("vi,vi->v", surface.vertex_normals, surface.vertices_mm) / radii
    assert outward.min() > 0.95


def test_labels_give_no_staircase(rng):
    distance, grid = ball((0.4, 0.4, 1.5), flip=True)
    labels = Labels(labels=np.where(distance > 0, LABELS["patella"], 0), grid=grid)
    surface = surface_of_labels(labels, "patella")
    radii = np.linalg.norm(surface.vertices_mm, axis=1)
    # Steps of 1.5 mm would deviate by 1.5 / sqrt(12) = 0.43 mm where the slices graze the ball.
    assert radii.std() < 0.2
    assert abs(radii.mean() - RADIUS) < 0.2


def test_edges_have_about_the_requested_length():
    distance, grid = ball((0.5, 0.5, 0.5), flip=False)
    for edge in (1.0, 2.0):
        surface = surface_of_field(distance, grid, edge_mm=edge)
        first, second, _ = np.moveaxis(surface.corners_mm, 1, 0)
        assert np.linalg.norm(first - second, axis=1).mean() == pytest.approx(edge, rel=0.3)


def test_smoothing_keeps_the_volume_and_takes_noise_away(rng):
    distance, grid = ball((1.0, 1.0, 1.0), flip=False)
    surface = surface_of_field(distance, grid, edge_mm=1.5)
    rough = TriangleSurface(
        vertices_mm=surface.vertices_mm + rng.normal(0, 0.1, surface.vertices_mm.shape), faces=surface.faces
    )
    smooth = smoothed_surface(rough)
    assert smooth.volume_mm3 == pytest.approx(rough.volume_mm3, rel=1e-9)
    spread = [np.linalg.norm(each.vertices_mm, axis=1).std() for each in (rough, smooth)]
    assert spread[1] < 0.6 * spread[0]


def test_what_the_image_cuts_is_closed_flat():
    distance, grid = ball((0.5, 0.5, 0.5), flip=False)
    half = VoxelGrid(shape=(36, *grid.shape[1:]), lps_from_voxel=grid.lps_from_voxel)
    surface = surface_of_field(distance[:36], half)
    edges = np.sort(surface.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, shared = np.unique(edges, axis=0, return_counts=True)
    assert (shared == 2).all()
    assert surface.volume_mm3 == pytest.approx(2 / 3 * np.pi * RADIUS**3, rel=0.08)


@pytest.mark.parametrize("depth_mm", [8.0, 40.0])
def test_a_thick_shaft_is_closed_where_the_image_ends(depth_mm):
    """A shaft that ends at both faces of an image of thick slices is a closed prism, however deep its inside is."""
    count = int(depth_mm) * 2 + 12
    grid = VoxelGrid(shape=(8, count, count), lps_from_voxel=np.diag([1.0, 1.0, 4.0, 1.0]))
    j, i = np.meshgrid(np.arange(count) - count / 2, np.arange(count) - count / 2, indexing="ij")
    distance = np.broadcast_to(depth_mm - np.hypot(j, i), grid.shape)
    surface = surface_of_field(distance, grid, edge_mm=2.0)
    edges = np.sort(surface.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    own, shared = np.unique(edges, axis=0, return_counts=True)
    assert (shared == 2).all()
    assert len(surface.vertices_mm) - len(own) + len(surface.faces) == 2
    # Smoothing of 1.6 mm rounds the rim off, and the ends are good to half a cube of 1.2 mm.
    assert np.ptp(surface.vertices_mm[:, 2]) == pytest.approx(28.0, abs=1.5)


@pytest.mark.parametrize("edge_mm", [1.0, 2.5, 4.0])
def test_a_sheet_thinner_than_the_requested_edges_is_closed_and_not_pinched(edge_mm):
    """Half a shell that thins out towards its rim, as cartilage on a condyle: its two sides may not meet in an edge."""
    count = 56
    grid = VoxelGrid(shape=(count, count, count), lps_from_voxel=np.diag([0.8, 0.8, 0.8, 1.0]))
    k, j, i = np.meshgrid(*[0.8 * (np.arange(count) - count / 2)] * 3, indexing="ij")
    half = np.interp(i, [0.0, 15.0], [0.2, 1.3])
    surface = surface_of_field(half - np.abs(np.sqrt(i**2 + j**2 + k**2) - 17.0), grid, edge_mm=edge_mm, several=True)
    edges = np.sort(surface.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    assert len(surface.faces) > surface.area_mm2 / (0.5 * edge_mm**2)


def test_nothing_gives_no_surface():
    distance, grid = ball((1.0, 1.0, 1.0), flip=False)
    with pytest.raises(MareyError, match="there is no surface"):
        surface_of_field(np.full(distance.shape, -1.0), grid)
    with pytest.raises(MareyError, match="no femoral cartilage"):
        surface_of_labels(Labels(labels=np.zeros(distance.shape), grid=grid), "femoral_cartilage")


def test_cartilage_keeps_both_of_its_pieces_and_a_bone_the_largest():
    labels = np.zeros((30, 30, 60), dtype=np.uint8)
    labels[10:20, 10:20, 5:25] = labels[10:20, 10:20, 35:50] = 4
    grid = VoxelGrid(shape=labels.shape, lps_from_voxel=np.eye(4))
    both = surface_of_labels(Labels(labels=labels, grid=grid), "tibial_cartilage")
    assert np.ptp(both.vertices_mm[:, 0]) > 40
    one = surface_of_labels(Labels(labels=np.where(labels == 4, 3, 0), grid=grid), "tibia")
    assert np.ptp(one.vertices_mm[:, 0]) < 25

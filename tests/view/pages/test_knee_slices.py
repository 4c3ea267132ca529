import cv2
import numpy as np
import pytest
from tests.made_knees import made_grid, made_labels, made_volume

from marey.knee.space.structures import LABELS
from marey.knee.space.volume import Labels, Volume, VoxelGrid
from marey.view.pages.knee_slices import keys_of, main_axis, slices_with_outlines
from marey.view.pictures.knee_maps import STRUCTURE_COLOURS

DIRECTIONS = {"L": np.eye(3)[0], "P": np.eye(3)[1], "H": np.eye(3)[2]}


def grid_of(directions: str, spacing: tuple[float, float, float], counts: tuple[int, int, int]) -> VoxelGrid:
    """A grid whose i, j and k go to L or R, P or A, H or F; its middle is the origin."""
    toward = DIRECTIONS | {"R": -DIRECTIONS["L"], "A": -DIRECTIONS["P"], "F": -DIRECTIONS["H"]}
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([mm * toward[letter] for mm, letter in zip(spacing, directions, strict=True)], 1)
    matrix[:3, 3] = -matrix[:3, :3] @ ((np.array(counts) - 1) / 2)
    return VoxelGrid(shape=counts[::-1], lps_from_voxel=matrix)


def balls_in(grid: VoxelGrid, *centres_and_radii: tuple[tuple[float, float, float], float]) -> np.ndarray:
    """(k, j, i) true inside any of some balls, LPS mm."""
    k, j, i = np.meshgrid(*[np.arange(n) for n in grid.shape], indexing="ij")
    places = grid.lps(np.stack([i, j, k], -1).astype(float))
    return np.any([np.linalg.norm(places - centre, axis=-1) < radius for centre, radius in centres_and_radii], axis=0)


def picture_of(grid: VoxelGrid, bright: np.ndarray, found: np.ndarray) -> np.ndarray:
    labels = Labels(labels=np.where(found, LABELS["tibia"], 0).astype(np.uint8), grid=grid)
    return slices_with_outlines(Volume(intensity=100.0 * bright, grid=grid), labels, most=1)[0].image


def outline_in(picture: np.ndarray) -> np.ndarray:
    """(n, 2) x and y of what has the tibia's colour."""
    blue, green, red = (int(STRUCTURE_COLOURS["tibia"][i : i + 2], 16) for i in (5, 3, 1))
    return np.argwhere((np.abs(picture.astype(int) - (blue, green, red)) < 12).all(-1))[:, ::-1]


@pytest.mark.parametrize(
    ("directions", "wide", "corner", "at"),
    [
        # Sagittal: head up, front left, however the scanner ran. The bright ball lies in front and above.
        ("PFR", 100.0, (0.0, -25.0, 30.0), (-25.0, -30.0)),
        ("AHL", 100.0, (0.0, -25.0, 30.0), (-25.0, -30.0)),
        ("HPL", 90.0, (0.0, -25.0, 30.0), (-25.0, -30.0)),
        # Coronal: head up, the patient's right on the left.
        ("LFP", 100.0, (-25.0, 0.0, 30.0), (-25.0, -30.0)),
        ("HRA", 90.0, (-25.0, 0.0, 30.0), (-25.0, -30.0)),
        # Axial: front up, the patient's right on the left.
        ("LPH", 100.0, (-25.0, -30.0, 0.0), (-25.0, -30.0)),
        ("ARF", 90.0, (-25.0, -30.0, 0.0), (-25.0, -30.0)),
    ],
)
def test_slices_are_upright_with_their_true_proportions(directions, wide, corner, at):
    # Slices measure 100 mm along i and 90 mm along j.
    grid = grid_of(directions, (0.5, 1.0, 4.0), (200, 90, 15))
    picture = picture_of(grid, balls_in(grid, (corner, 6.0)), balls_in(grid, ((0.0, 0.0, 0.0), 12.0)))
    height, width = picture.shape[:2]
    assert width / height == pytest.approx(wide / (190.0 - wide), abs=0.01)
    scale = width / wide
    row, column = np.argwhere(cv2.blur(picture, (9, 9)).min(-1) > 200).mean(0)
    middle = (width - 1) / 2, (height - 1) / 2
    np.testing.assert_allclose([column - middle[0], row - middle[1]], np.array(at) * scale, atol=1.0 * scale)


def test_outlines_lie_on_the_edges_in_voxels_of_any_shape():
    grid = grid_of("PFR", (0.5, 1.5, 4.0), (200, 60, 11))
    ball = balls_in(grid, ((0.0, 0.0, 0.0), 20.0))
    picture = picture_of(grid, ball, ball)
    height, width = picture.shape[:2]
    places = (outline_in(picture) - [(width - 1) / 2, (height - 1) / 2]) / (width / 100.0)
    radii = np.linalg.norm(places, axis=1)
    assert len(radii) > 200
    # The labels' own steps of 1.5 mm, and the line's width.
    assert radii.min() > 20 - 1.1
    assert radii.max() < 20 + 1.1
    assert abs(np.median(radii) - 20) < 0.4


def test_twelve_slices_are_evenly_spaced_through_the_knee_and_state_their_position():
    grid = made_grid((2.0, 2.0, 4.0))
    labels = made_labels(grid)
    stills = slices_with_outlines(made_volume(grid, "dark"), labels)
    held = np.flatnonzero((labels.labels > 0).any((1, 2)))
    chosen = [int(still.caption.split()[3]) for still in stills]
    assert len(chosen) == 12
    assert held[0] < chosen[0]
    assert chosen[-1] < held[-1]
    assert np.ptp(np.diff(chosen)) <= 1
    assert stills[0].caption.startswith("slice k = ")
    assert stills[0].caption.endswith(f"F {70 - 4 * chosen[0]:.1f} mm")
    assert stills[-1].caption.endswith(f"H {4 * chosen[-1] - 70:.1f} mm")
    assert list(keys_of(labels)) == ["femur", "tibia", "patella"]


def test_few_slices_are_all_shown_once():
    grid = grid_of("PFR", (1.0, 1.0, 20.0), (60, 60, 5))
    ball = balls_in(grid, ((0.0, 0.0, 0.0), 25.0))
    labels = Labels(labels=ball.astype(np.uint8), grid=grid)
    assert len(slices_with_outlines(Volume(intensity=1.0 * ball, grid=grid), labels)) == 3


def test_slices_go_across_the_longest_step_or_from_side_to_side():
    assert main_axis(grid_of("LPH", (0.5, 0.5, 1.0), (9, 9, 9))) == "k"
    assert main_axis(grid_of("PLH", (0.6, 0.55, 0.6), (9, 9, 9))) == "j"

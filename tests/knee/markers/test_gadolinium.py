import numpy as np
import pytest
import trimesh
from tests.made_balls import limb_grid, limb_with_balls, on_skin
from tests.made_knees import made_grid, made_volume

from marey.knee.markers.gadolinium import Gadolinium, find_gadolinium, joined
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.volume import Volume

ANGLES = np.array([0.3, 1.8, 3.1, 4.5])


def places(radius: float, sunk: float = 0.4) -> np.ndarray:
    return np.array([on_skin(angle, 8 * np.sin(5 * angle), radius, sunk) for angle in ANGLES])


def errors_mm(found: Gadolinium, true: np.ndarray) -> np.ndarray:
    apart = np.linalg.norm(true[:, None] - found.centres_mm[None], axis=2)
    assert len(found) == len(true)
    assert sorted(apart.argmin(axis=1)) == list(range(len(true)))
    return apart.min(axis=1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "spacing", "radius"),
    [("dark", (0.7, 0.7, 1.5), 3.0), ("bright", (0.8, 0.8, 1.0), 3.0), ("bright", (1.0, 1.0, 1.0), 7.0)],
)
def test_balls_half_in_the_skin_are_found_within_0_1_mm(kind, spacing, radius):
    true = places(radius)
    found = find_gadolinium(limb_with_balls(limb_grid(spacing), true, [radius] * len(true), kind, bias=0.1))
    assert errors_mm(found, true).max() < 0.1
    np.testing.assert_allclose(found.diameter_mm, 2 * radius, atol=0.2)
    assert found.centres_mm[:, 2].tolist() == sorted(found.centres_mm[:, 2], reverse=True)
    assert not found.notes


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["dark", "bright"])
def test_a_limb_without_balls_has_none(kind):
    grid = limb_grid((1.0, 1.0, 1.2))
    assert len(find_gadolinium(limb_with_balls(grid, np.empty((0, 3)), [], kind))) == 0
    assert len(find_gadolinium(made_volume(made_grid((1.0, 1.0, 2.0)), kind))) == 0


def test_noise_and_a_constant_image_contain_no_balls(rng):
    grid = limb_grid((1.5, 1.5, 1.5))
    for values in (rng.uniform(5, 60, grid.shape), np.full(grid.shape, 7.0), np.zeros(grid.shape)):
        assert len(find_gadolinium(Volume(intensity=values, grid=grid))) == 0


def made(centres: list[list[float]], sd: float = 0.1) -> Gadolinium:
    count = len(centres)
    return Gadolinium(
        centres_mm=np.array(centres), centres_sd_mm=np.full((count, 3), sd), diameter_mm=np.full(count, 6.0)
    )


def test_markers_of_two_volumes_are_joined_by_their_precision_and_the_rest_kept():
    both = joined(made([[0.0, 0, 0], [50, 0, 10]], 0.1), made([[50.3, 0, 10], [0, 80, -20]], 0.2))
    np.testing.assert_allclose(both.centres_mm, [[50.06, 0, 10], [0, 0, 0], [0, 80, -20]])
    np.testing.assert_allclose(both.centres_sd_mm[:, 0], [np.sqrt(1 / 125), 0.1, 0.2])
    assert [note.split(" is visible in ")[1] for note in both.notes] == [
        "the first volume only.",
        "the second volume only.",
    ]
    assert len(joined(made([]), made([[1.0, 2, 3]]))) == 1
    assert len(joined(made([]), made([]))) == 0


def test_a_marker_that_moved_between_the_volumes_is_less_certain_and_reported():
    both = joined(made([[0.0, 0, 0]]), made([[2.0, 0, 0]]))
    assert both.centres_sd_mm[0, 0] > 0.5
    assert "differ by 2.0 mm" in both.notes[0]


@pytest.mark.slow
def test_two_balls_that_touch_are_two():
    grid = limb_grid((0.8, 0.8, 1.0), length_mm=30.0)
    true = np.array([on_skin(1.0, -3.2, 3.0, 0.3), on_skin(1.0, 3.2, 3.0, 0.3)])
    found = find_gadolinium(limb_with_balls(grid, true, [3.0, 3.0], "bright"))
    assert errors_mm(found, true).max() < 0.15


@pytest.mark.slow
def test_a_ball_cut_by_the_border_is_reported_and_a_barely_visible_one_is_omitted():
    grid = limb_grid((0.8, 0.8, 1.0), length_mm=30.0)
    end = float(grid.lps(np.array(grid.shape[::-1]) - 0.5)[2])
    true = np.array([on_skin(0.5, end - 2.0, 4.0), on_skin(2.5, end + 1.0, 4.0)])
    found = find_gadolinium(limb_with_balls(grid, true, [4.0, 4.0], "dark"))
    assert errors_mm(found, true[:1]).max() < 0.15
    assert any("cut by the border of the image" in note for note in found.notes)


@pytest.mark.slow
def test_a_ball_within_a_bone_is_none():
    grid = limb_grid((0.8, 0.8, 1.0), length_mm=30.0)
    true = np.array([on_skin(1.0, 0.0, 3.0)])
    volume = limb_with_balls(grid, true, [3.0], "dark")
    ball = trimesh.creation.icosphere(radius=10)
    bone = TriangleSurface(vertices_mm=np.asarray(ball.vertices) + true[0], faces=np.asarray(ball.faces))
    assert len(find_gadolinium(volume, {"femur": bone})) == 0
    assert (
        len(find_gadolinium(volume, {"femur": TriangleSurface(vertices_mm=bone.vertices_mm + 20, faces=bone.faces)}))
        == 1
    )

import numpy as np
import pytest
from scipy import ndimage

from marey.errors import SettingProblem
from marey.knee.bones.marrow import PreparedImage
from marey.knee.bones.region_growing import grow, joined_fibula, outgrowth, thin_share
from marey.knee.bones.seeds import MarrowLevel, marrow_level, seed_voxel
from marey.knee.space.bias_field import BiasField
from marey.knee.space.distances import signed_distance
from marey.knee.space.volume import VoxelGrid


def two_balls(neck_mm: float) -> np.ndarray:
    """Balls of 12 mm, 30 mm apart, with a neck between them."""
    z, y, x = np.meshgrid(*[np.arange(n) for n in (34, 34, 64)], indexing="ij")
    balls = [np.sqrt((z - 17) ** 2 + (y - 17) ** 2 + (x - c) ** 2) < 12 for c in (16, 46)]
    neck = (np.hypot(z - 17, y - 17) < neck_mm) & (x > 16) & (x < 46)
    return (balls[0] | balls[1] | neck).astype(np.float32)


@pytest.mark.parametrize("neck_mm", [1.5, 2.5])
def test_a_leak_through_a_neck_is_cut_off(neck_mm):
    likeness = two_balls(neck_mm)
    grown = grow(likeness, np.array([17, 17, 16]))
    ball = two_balls(0.0)[:, :, :31].sum()
    assert grown[:, :, 33:].sum() == 0
    assert grown[:, :, :29].sum() == pytest.approx(ball, rel=0.05)


def test_without_a_leak_the_bone_is_whole_and_air_gives_nothing():
    likeness = two_balls(0.0)
    grown = grow(likeness, np.array([17, 17, 46]))
    assert grown.sum() == pytest.approx(likeness[:, :, 31:].sum(), rel=0.03)
    assert not grow(likeness, np.array([2, 2, 2])).any()
    assert not grow(np.zeros_like(likeness), np.array([17, 17, 16])).any()


def made_knee(rng: np.random.Generator, level: float) -> PreparedImage:
    grid = VoxelGrid(shape=(24, 24, 24), lps_from_voxel=np.eye(4))
    body = np.zeros(grid.shape, dtype=bool)
    body[:, :, :20] = True
    intensity = rng.normal(level, 1.0, grid.shape)
    bias = BiasField(factor=np.ones(grid.shape), grid=grid)
    return PreparedImage(
        intensity=intensity, bias=bias, body=body, depth_mm=np.ones(grid.shape), within=np.full(grid.shape, True),
        grid=grid, air_level=None, bright_from=level, candidates={"dark": body, "bright": body},
    )  # fmt: skip


def test_the_band_comes_from_the_seeds_own_region(rng):
    dark, bright = (marrow_level(made_knee(rng, 20.0), kind, np.array([12, 12, 8])) for kind in ("dark", "bright"))
    # 5 standard deviations of 1; the median of some 2000 voxels is good to 0.03.
    assert dark.limit - dark.median == pytest.approx(5.0, rel=0.1)
    assert bright.median - bright.limit == pytest.approx(5.0, rel=0.1)
    np.testing.assert_allclose(
        MarrowLevel(median=20, limit=25).likeness(np.array([10, 20, 22.5, 25, 40])), [1, 1, 0.5, 0, 0]
    )


def test_the_error_on_seeds_outside_the_body_states_the_extent_of_the_image(rng):
    knee = made_knee(rng, 20.0)
    with pytest.raises(SettingProblem, match="lies in the air"):
        seed_voxel(knee, "femur", np.array([22.0, 5, 5]))
    with pytest.raises(SettingProblem, match=r"outside the image, which reaches from 0\.0 0\.0 0\.0 to 23\.0"):
        seed_voxel(knee, "femur", np.array([50.0, 5, 5]))
    np.testing.assert_array_equal(seed_voxel(knee, "femur", np.array([3.0, 5, 7])), [7, 5, 3])


def test_the_signed_distance_continues_beyond_the_border_of_the_image():
    mask = np.zeros((8, 9, 20), dtype=bool)
    mask[:, :, :10] = True
    distance = signed_distance(mask, (2.0, 1.0, 0.5))
    np.testing.assert_allclose(distance[4, 4, [0, 9, 10, 19]], [5.0, 0.25, -0.25, -5.0], atol=0.3)
    assert np.ptp(distance[:, :, 3]) == 0
    assert (signed_distance(np.zeros_like(mask), (1.0, 1.0, 1.0)) < -100).all()


def test_a_handle_on_a_thick_bone_is_an_outgrowth_and_a_corner_is_none():
    bone = np.zeros((60, 50, 60), dtype=bool)
    bone[:, 10:40, 10:40] = True
    bone[20:25, 20:25, 20:25] = False
    # An edge of a square of 90 degrees is 8 (sqrt(2) - 1) = 3.3 mm beyond a ball of 8 mm.
    assert not outgrowth(bone).any()
    leaked = bone.copy()
    leaked[20:28, 20:28, 40:58] = True
    part = outgrowth(leaked)
    assert part.any()
    assert np.argwhere(part)[:, 2].min() > 42
    assert part[24, 24, 50:58].all()
    assert not outgrowth(leaked & (np.arange(60) > 41)).any()


def test_a_leak_through_a_gap_makes_more_of_a_bone_thin():
    k, j, i = np.meshgrid(*[np.arange(n) for n in (60, 70, 70)], indexing="ij")
    bone = np.hypot(j - 30, i - 30) < 20
    assert thin_share(bone) < 0.02
    leak = bone | ((abs(k - 30) < 3) & (abs(j - 30) < 12) & (i > 30))
    # 5 x 23 x 19 voxels of a film beyond the bone.
    assert thin_share(leak) == pytest.approx(5 * 23 * 19 / leak.sum(), rel=0.15)
    assert thin_share(np.zeros_like(bone)) == 1.0


def shank() -> tuple[np.ndarray, np.ndarray]:
    """A tibia that widens upwards, and a fibula whose head touches it."""
    k, j, i = np.meshgrid(*[np.arange(n) for n in (50, 80, 100)], indexing="ij")
    tibia = np.hypot(j - 40, i - 35) < 14 + 0.4 * k
    shaft = (np.hypot(j - 50, i - 72) < 7) & (k < 30)
    head = np.sqrt((k - 28) ** 2 + (j - 50) ** 2 + (i - 68) ** 2) < 11
    fibula = (shaft | head) & ~tibia
    return tibia, fibula


def test_a_fibula_that_touches_the_tibia_is_separated_from_it():
    tibia, fibula = shank()
    whole = tibia | fibula
    assert ndimage.label(whole)[1] == 1
    found = joined_fibula(whole)
    # Only voxels at the place where both touch may be exchanged.
    assert (found ^ fibula).sum() < 0.02 * fibula.sum()


def test_a_tibia_alone_and_a_shaft_in_two_pieces_have_no_fibula():
    tibia, _ = shank()
    assert not joined_fibula(tibia).any()
    assert not joined_fibula(np.zeros_like(tibia)).any()
    dim = tibia.copy()
    dim[:15, :, 40:43] = False
    assert ndimage.label(dim[:15])[1] == 2
    assert not joined_fibula(dim).any()

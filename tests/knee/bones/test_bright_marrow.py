"""Bright marrow in thick slices, cut along the dark line about it; fat behind the line is as bright."""

import numpy as np
import pytest

from marey.knee.bones.bright_marrow import (
    BrightImage,
    continued_limit,
    cut_along_line,
    evened,
    evenness,
    extended_bone,
    template_odds,
)
from marey.knee.space.volume import VoxelGrid

SHAPE = (8, 70, 60)
SPACING = (4.0, 1.0, 1.0)
LEVEL = 3000.0


def grid() -> VoxelGrid:
    return VoxelGrid(shape=SHAPE, lps_from_voxel=np.diag([*SPACING[::-1], 1.0]))


def depth_in_shaft() -> np.ndarray:
    """(k, j, i) depth [mm] in a shaft that runs along j, 26 mm wide, in every slice."""
    return np.broadcast_to(13.0 - np.abs(np.arange(SHAPE[2]) - 29.5), SHAPE).copy()


def coil(least: float) -> np.ndarray:
    """(1, j, 1) sensitivity: 1 at the first row, the least at the last."""
    return np.exp(np.log(least) * (np.arange(SHAPE[1]) / SHAPE[1]) ** 2)[None, :, None]


def image_of(
    rng: np.random.Generator, *, least: float = 1.0, line: float = 0.3, gap: slice | None = None
) -> BrightImage:
    """A shaft in fat, both bright, with a darker line of 1.5 mm between them that may have a gap."""
    depth = depth_in_shaft()
    levels = np.full(SHAPE, LEVEL)
    levels[(depth < 0) & (depth > -2.0)] *= line
    if gap is not None:
        levels[:, gap] = LEVEL
    levels = levels * coil(least) + rng.normal(0, 0.04 * LEVEL, SHAPE)
    return BrightImage(intensity=levels.astype(np.float32), free=np.ones(SHAPE, dtype=bool), grid=grid())


def test_a_shaft_is_followed_to_where_the_marrow_is_dimmer(rng):
    bone = depth_in_shaft() > 0
    image = image_of(rng, least=0.6)
    grown = bone & (coil(0.6) > 0.75)
    assert grown.sum() < 0.8 * bone.sum()
    found = extended_bone(image, grown)
    assert found is not None
    assert (found & bone).sum() > 0.95 * bone.sum()
    assert not found[depth_in_shaft() < -2].any()


def test_a_bone_that_is_whole_is_left_as_it_grew(rng):
    assert extended_bone(image_of(rng), depth_in_shaft() > 0) is None


def test_what_leaks_is_not_taken(rng):
    assert extended_bone(image_of(rng, gap=slice(10, 60)), depth_in_shaft() > 2) is None


@pytest.mark.parametrize("off_mm", [-2.0, 2.0])
def test_a_faint_line_before_equally_bright_fat_counts_more_than_an_inaccurate_template(rng, off_mm):
    depth = depth_in_shaft()
    found = cut_along_line(image_of(rng, line=0.7), depth > 3, (depth + off_mm).astype(np.float32))
    assert found[depth > 1].mean() > 0.99
    assert not found[depth < -2].any()


def test_a_template_closes_a_gap_in_the_line_and_keeps_dark_marrow_in(rng):
    depth = depth_in_shaft()
    image = image_of(rng, gap=slice(30, 45))
    image.intensity[:, 50:54] = np.where(depth > 0, 0.55 * LEVEL, image.intensity)[:, 50:54]
    with_limit = cut_along_line(image, depth > 3, depth.astype(np.float32))
    assert with_limit[depth > 2].mean() > 0.97
    assert not with_limit[depth < -4].any()
    assert cut_along_line(image, depth > 3)[:, 30:45][depth[:, 30:45] < -4].any()


def test_the_local_level_of_marrow_is_even_and_continues_beyond_the_known_marrow(rng):
    bone = depth_in_shaft() > 0
    known = bone & (np.arange(SHAPE[1]) < 50)[None, :, None]
    shares = evened(image_of(rng, least=0.5).intensity, known, grid())
    rows = np.median(shares[:, :, 22:38], axis=(0, 2))
    assert rows[:60] == pytest.approx(1.0, abs=0.08)


def test_only_lines_and_steps_are_uneven_and_thick_slices_are_neither():
    shares = np.ones(SHAPE)
    shares[:, 30] = 0.5
    shares[5:] *= 1.2
    even = evenness(shares, grid())
    assert even[:, 30].max() < 0.3
    assert even[:, :20].min() > 0.7


def test_a_template_has_no_effect_outside_its_extent():
    np.testing.assert_array_equal(np.sign(template_odds(np.array([np.nan, -3.0, 0.0, 4.0]))), [0, -1, 0, 1])


def test_a_template_is_continued_beyond_its_end_with_less_weight():
    limit = np.full((6, 1, 3), np.nan)
    limit[2:4] = [5.0, -1.0, -6.0]
    limit[4:] = limit[3]
    found = continued_limit(limit, 2.0)
    np.testing.assert_array_equal(found[2:], limit[2:])
    np.testing.assert_allclose(found[0, 0], [0.0, 0.0, -6.0 + 0.3 * 4], rtol=1e-6)

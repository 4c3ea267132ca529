"""Femur, tibia and patella of made knees: whole, cut, and with seeds in the wrong bone."""

import numpy as np
import pytest
from tests.made_knees import made_grid, made_labels, made_volume

from marey.errors import MareyError, SettingProblem
from marey.geometry import rotations
from marey.knee.bones.bones import segment_bones
from marey.knee.bones.marrow import PreparedImage, prepare
from marey.knee.space.resampling import part_of, resampled
from marey.knee.space.volume import Volume, VoxelGrid

SPACING = (2.5, 2.5, 2.5)
SHORT = (slice(10, 50), slice(None), slice(None))
"""100 of 150 mm along the bones, with the joint: two thirds of the work."""


def cut(volume: Volume, box: tuple[slice, ...]) -> Volume:
    return Volume(intensity=volume.intensity[box], grid=part_of(volume.grid, box))


@pytest.mark.slow
def test_an_image_of_the_femur_only_has_no_tibia():
    grid = made_grid(SPACING)
    box = (slice(30, None), slice(None), slice(None))
    template = made_labels(grid)
    found = segment_bones([cut(made_volume(grid, "dark"), box)], template=template)
    assert "tibia" not in found.bones
    assert "shows the femur only" in found.missing["tibia"]
    assert not found.labels.mask("tibia").any()
    femur, truth = found.labels.mask("femur"), template.mask("femur")[box]
    assert 2 * (femur & truth).sum() / (femur.sum() + truth.sum()) > 0.95
    assert found.template_fit is not None
    assert list(found.template_fit.placements) == ["femur", "patella"]


@pytest.mark.slow
def test_a_seed_finds_the_only_long_bone_without_a_template():
    grid = made_grid(SPACING)
    box = (slice(None, 26), slice(None), slice(None))
    volume = cut(made_volume(grid, "dark"), box)
    with pytest.raises(MareyError, match="shows only one of the two, give a template"):
        segment_bones([volume])
    found = segment_bones([volume], seeds_mm={"tibia": np.array([0.0, 2.0, -20.0])})
    assert list(found.bones) == ["tibia"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("given", "place", "seems"), [("tibia", (17, 2, 22), "femur"), ("femur", (0, 2, -20), "tibia")]
)
def test_a_seed_in_the_other_bone_is_named(given, place, seems):
    with pytest.raises(SettingProblem, match=f"seed of the {given} at LPS .* seems to be the {seems}"):
        segment_bones([made_volume(made_grid(SPACING), "dark")], seeds_mm={given: np.array(place, dtype=float)})


def turned(grid: VoxelGrid, angle: float) -> VoxelGrid:
    by = np.eye(4)
    by[:3, :3] = rotations.exp(np.array([0.0, angle, 0.0]))
    return VoxelGrid(shape=grid.shape, lps_from_voxel=by @ grid.lps_from_voxel)


def body_off(knee: PreparedImage) -> float:
    """Share of the image where body and made limb differ, except within 3 mm of the skin."""
    k, j, i = np.meshgrid(*[np.arange(n) for n in knee.grid.shape], indexing="ij")
    x, y, _ = np.moveaxis(knee.grid.lps(np.stack([i, j, k], axis=-1).astype(float)), -1, 0)
    far = 52 - np.hypot(x, y)
    sure = knee.within & (np.abs(far) > 3)
    return float((knee.body != (far > 0))[sure].mean())


@pytest.mark.slow
def test_the_corners_beside_a_turned_image_are_neither_body_nor_air():
    straight, oblique = (made_volume(grid, "dark") for grid in (made_grid(SPACING), turned(made_grid(SPACING), 0.2)))
    knees = [prepare(each) for each in (straight, oblique)]
    assert knees[0].within.all()
    reached = resampled(np.ones(oblique.grid.shape), oblique.grid, knees[1].grid) > 0.999
    np.testing.assert_array_equal(knees[1].within, reached)
    assert not knees[1].body[~knees[1].within].any()
    assert max(body_off(knee) for knee in knees) < 0.01


@pytest.mark.slow
def test_a_turned_image_gives_the_same_bones():
    grid = turned(made_grid(SPACING), 0.2)
    found, truth = segment_bones([cut(made_volume(grid, "dark"), SHORT)]).labels, made_labels(grid)
    for bone in ("femur", "tibia", "patella"):
        mine, true = found.mask(bone), truth.mask(bone)[SHORT]
        assert 2 * (mine & true).sum() / (mine.sum() + true.sum()) > 0.98


@pytest.mark.slow
def test_bones_that_grow_into_each_other_are_an_error_that_names_a_remedy():
    # Voxels of 2.5 mm do not show the line of 1.5 mm between bright marrow and fat as bright.
    with pytest.raises(MareyError, match=r"grew into each other.*Give a template"):
        segment_bones([cut(made_volume(made_grid(SPACING), "bright"), SHORT)])

import numpy as np
import pytest
from tests.made_knees import made_grid, made_labels, made_volume

from marey.errors import MareyError, SettingProblem
from marey.knee.bones import located_bones
from marey.knee.bones.located_bones import (
    LocatedBones,
    PreparedImages,
    in_line,
    locate_bones,
    prepare_images,
    thick_end,
)
from marey.knee.bones.marrow import PreparedImage
from marey.knee.bones.region_growing import grow
from marey.knee.bones.seeds import marrow_likenesses
from marey.knee.bones.settings import BoneSettings
from marey.knee.bones.template_fit import template_bones
from marey.knee.space.bias_field import BiasField
from marey.knee.space.resampling import part_of
from marey.knee.space.volume import Volume, VoxelGrid


def column(gap_mm: int) -> tuple[np.ndarray, VoxelGrid]:
    """Marrow 60 mm high, with a gap in its middle."""
    likeness = np.zeros((60, 30, 30), dtype=np.float32)
    likeness[:, 5:25, 5:25] = 1
    likeness[30 : 30 + gap_mm] = 0
    return likeness, VoxelGrid(shape=likeness.shape, lps_from_voxel=np.eye(4))


@pytest.mark.parametrize(("gap_mm", "one"), [(0, True), (2, True), (6, False)])
def test_a_scar_of_growth_is_no_joint_and_a_joint_is_none_of_marrow(gap_mm, one):
    likeness, grid = column(gap_mm)
    assert in_line(likeness, grid, np.array([50, 14, 14]), np.array([10, 16, 12])) is one


def test_seeds_in_one_place_are_in_line():
    likeness, grid = column(0)
    assert in_line(likeness, grid, np.array([50, 14, 14]), np.array([50, 14, 14]))


def test_the_thick_end_distinguishes_femur_from_tibia():
    bone = np.zeros((40, 30, 30), dtype=bool)
    bone[5:35, 10:20, 10:20] = True
    assert thick_end(bone) is None
    bone[5:15, 5:25, 5:25] = True
    assert thick_end(bone) == "femur"
    assert thick_end(bone[::-1]) == "tibia"


@pytest.mark.slow
def test_a_seed_in_the_other_bone_is_named_where_the_shape_of_that_bone_does_not_show_it():
    volume, settings = made_volume(made_grid((2.0, 2.0, 2.0)), "dark"), BoneSettings()
    # The lower 40 mm of the tibia are missing.
    box = (slice(15, 65), slice(None), slice(None))
    cut = Volume(intensity=volume.intensity[box], grid=part_of(volume.grid, box))
    wrong = prepare_images((cut,), {}, {"femur": np.array([0.0, 2.0, -20.0])}, settings)
    (limit,) = locate_bones(wrong).limits
    assert "The seed of the femur at LPS 0 2 -20 mm seems to lie in the tibia" in limit
    right = locate_bones(prepare_images((cut,), {}, {"femur": np.array([17.0, 2.0, 23.0])}, settings))
    assert right.limits == ()
    assert set(right.seeds) == {"femur", "tibia"}


@pytest.mark.slow
def test_a_template_shows_a_seed_in_the_other_bone():
    grid = made_grid((2.5, 2.5, 2.5))
    bones = template_bones(made_labels(grid, size=1.08))
    images = prepare_images(
        (made_volume(grid, "dark"),), bones, {"tibia": np.array([-17.0, 2.0, 20.0])}, BoneSettings()
    )
    with pytest.raises(SettingProblem, match="lie in one bone: it seems to be the femur"):
        locate_bones(images)


def leaking_knee(plate: float) -> LocatedBones:
    """Two shafts of a level about 100, and a plate of another level between them that is wider than they are."""
    k, j, i = np.meshgrid(*[np.arange(n) for n in (80, 60, 60)], indexing="ij")
    away = np.hypot(j - 30, i - 30)
    # Waves of the amplitude a have a median deviation of a / sqrt(2), a robust standard deviation of 1.05 a.
    level = np.where((away < 15) & ((k < 35) | (k > 45)), 100.0 + 6.0 * np.sin(2 * np.pi * i / 7), 0.0)
    level[(away < 26) & (k >= 35) & (k <= 45)] = plate
    grid = VoxelGrid(shape=level.shape, lps_from_voxel=np.eye(4))
    body = np.full(level.shape, True)
    knee = PreparedImage(
        intensity=level, bias=BiasField(factor=np.ones(level.shape), grid=grid), body=body,
        depth_mm=np.full(level.shape, 30.0), within=body, grid=grid, air_level=None, bright_from=50.0,
        candidates={"dark": body, "bright": body},
    )  # fmt: skip
    seeds = {"femur": np.array([65, 30, 30]), "tibia": np.array([15, 30, 30])}
    images = PreparedImages(volumes=(), knees=(knee,))
    likenesses = marrow_likenesses(images.knees, ("bright",), seeds)
    return LocatedBones(images=images, kinds=("bright",), seeds=seeds, seen={}, likenesses=likenesses)


@pytest.mark.parametrize(("plate", "separate"), [(72.0, True), (100.0, False)])
def test_a_leak_into_another_bone_is_cut_by_a_narrower_band_of_marrow(plate, separate):
    located = leaking_knee(plate)
    single = located_bones._bone_of_both_seeds(located)
    narrower, left = located_bones._without_leak(located, single)
    assert (left is None) == separate
    if separate:
        grown = grow(narrower.likenesses["femur"], located.seeds["femur"])
        assert not grown[:33].any()
        assert grown[50:].sum() > 0.8 * 30 * np.pi * 15**2
    else:
        assert narrower is located
        with pytest.raises(MareyError, match=r"Give a template \(--template\), or a seed"):
            located_bones._single_bone(located, {}, left)

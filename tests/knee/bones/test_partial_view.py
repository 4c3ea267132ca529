"""Which long bones are in view: placed by a template, and kept or rejected by the evidence."""

from dataclasses import replace

import numpy as np
import pytest
from tests.made_knees import made_grid, made_labels, made_volume

from marey.errors import SettingProblem
from marey.knee.bones.marrow import PreparedImage, prepare
from marey.knee.bones.partial_view import SeenBone, in_view, partial_view
from marey.knee.bones.seeds import NoPairFound, SeedSettings, find_seeds, seed_voxel
from marey.knee.bones.template_fit import TemplateBone, TemplatePlacement, template_bones
from marey.knee.space.resampling import part_of
from marey.knee.space.volume import Volume

SPACING = (2.5, 2.5, 2.5)
INSIDE = np.array([0.0, 2.0, -20.0])
"""LPS [mm] of a place in the tibia."""


@pytest.fixture(scope="module")
def tibia_only() -> PreparedImage:
    """What lies 5 mm and more below the joint."""
    volume = made_volume(made_grid(SPACING), "dark")
    box = (slice(None, 26), slice(None), slice(None))
    return prepare(Volume(intensity=volume.intensity[box], grid=part_of(volume.grid, box)))


@pytest.fixture(scope="module")
def bones() -> dict[str, TemplateBone]:
    return template_bones(made_labels(made_grid(SPACING), size=1.08))


@pytest.mark.slow
def test_a_tibia_alone_is_found_by_a_larger_template(tibia_only, bones):
    with pytest.raises(NoPairFound, match="No femur above a tibia"):
        find_seeds(tibia_only, {})
    view = partial_view(tibia_only, bones, {})
    assert view is not None
    assert (view.kind, list(view.seeds), list(view.seen)) == ("dark", ["tibia"], ["tibia"])
    seen = view.seen["tibia"]
    assert 0.5 < seen.known < 1
    # The upper end of the template's tibia, 2 mm below the joint, reaches that of the image: half a voxel is 1.25 mm.
    top = seen.placement.image_from_template(bones["tibia"].points_mm)[:, 2].max()
    assert top == pytest.approx(-2.0, abs=2.5)


def test_without_a_template_only_a_seed_identifies_a_bone(tibia_only):
    assert partial_view(tibia_only, {}, {}) is None
    view = partial_view(tibia_only, {}, {"tibia": seed_voxel(tibia_only, "tibia", INSIDE)})
    assert view is not None
    assert (view.kind, list(view.seeds), view.seen) == ("dark", ["tibia"], {})
    with pytest.raises(SettingProblem, match="lies in the air"):
        seed_voxel(tibia_only, "tibia", np.array([50.0, 45.0, -50.0]))


def test_the_settings_of_seeds_reach_the_check_of_a_given_seed(tibia_only):
    inside = {"tibia": seed_voxel(tibia_only, "tibia", INSIDE)}
    with pytest.raises(SettingProblem, match="does not lie in dark marrow"):
        partial_view(tibia_only, {}, inside, seeds=SeedSettings(least_marrow_share=1.1))


def seen(name: str, place: tuple[float, float, float], **other: object) -> SeenBone:
    here = TemplatePlacement(matrix=np.eye(3), shift=np.zeros(3))
    one = SeenBone(
        name=name, kind="dark", mirrored=False, placement=here, seed=np.array(place[::-1]).astype(int),
        contrast=0.8, known=0.8, fill=1.0,
    )  # fmt: skip
    return replace(one, **other)  # type: ignore[arg-type]


def test_both_are_in_view_only_where_neither_lies_in_the_other(bones):
    grid = made_grid((1.0, 1.0, 1.0))
    femur, tibia = [grid.voxels(np.array([0.0, 2.0, z])).round().tolist() for z in (22.0, -25.0)]
    both = {"femur": seen("femur", femur), "tibia": seen("tibia", tibia)}
    assert list(in_view(both, bones, grid)) == ["femur", "tibia"]
    weaker = both | {"tibia": seen("tibia", tibia, contrast=0.4)}
    assert list(in_view(weaker, bones, grid)) == ["femur"]
    in_one = {"femur": seen("femur", femur), "tibia": seen("tibia", femur, contrast=0.7)}
    assert list(in_view(in_one, bones, grid)) == ["femur"]
    either = {"femur": seen("femur", femur), "tibia": seen("tibia", femur, contrast=0.79)}
    assert not in_view(either, bones, grid)

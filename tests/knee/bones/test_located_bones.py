import numpy as np
import pytest

from marey.knee.bones.located_bones import in_line, thick_end
from marey.knee.space.volume import VoxelGrid


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

import numpy as np
import pytest

from marey.knee.outlines.contours import AXES
from marey.knee.space.volume import VoxelGrid
from marey.view.pictures.slice_display import displayed

SAGITTAL = np.array([[0, 0, -1.5, 10], [0.3, 0, 0, -60], [0, -0.4, 0, 80], [0, 0, 0, 1.0]])
TURNED = np.array([[0, -1.5, 0, 10], [0, 0, -0.3, -60], [0.4, 0, 0, 80], [0, 0, 0, 1.0]])


@pytest.mark.parametrize("lps_from_voxel", [SAGITTAL, TURNED])
@pytest.mark.parametrize("axis", AXES)
def test_head_and_front_are_up_and_the_patients_left_and_back_are_on_the_right(lps_from_voxel: np.ndarray, axis: str):
    shown = displayed(VoxelGrid(shape=(20, 30, 40), lps_from_voxel=lps_from_voxel), axis)
    a, b, c, d = shown["screen_mm"]
    along = AXES.index(axis)
    column, row = (lps_from_voxel[:3, each] for each in range(3) if each != along)
    # One mm to the right and one mm down the screen, as directions in the patient.
    slice_from_screen = np.linalg.inv([[a, b], [c, d]])
    right, down = (slice_from_screen[0, n] * column + slice_from_screen[1, n] * row for n in range(2))
    np.testing.assert_allclose([np.linalg.norm(right), np.linalg.norm(down)], 1.0)
    main_right, main_down = int(np.argmax(np.abs(right))), int(np.argmax(np.abs(down)))
    assert main_down > main_right
    assert right[main_right] > 0
    assert down[main_down] < 0 if main_down == 2 else down[main_down] > 0
    ends = {0: ["right", "left"], 1: ["front", "back"], 2: ["head", "feet"]}
    assert shown["sides"] == ends[main_right] + ends[main_down]


def test_rows_and_columns_are_those_of_the_slices():
    shown = displayed(VoxelGrid(shape=(20, 30, 40), lps_from_voxel=SAGITTAL), "j")
    assert (shown["rows"], shown["columns"]) == (20, 40)

"""Vicon's .xcp: the direction of its lens model, its quaternions and its units."""

import numpy as np
import pytest
from tests.rig_files import POINTS, assert_same_pixels, made_rig, write_xcp

from marey.errors import FileProblem
from marey.io.calibration.readers import read_rig


def test_a_quaternion_with_the_real_part_last_turns_the_world_into_the_camera(tmp_path):
    rig = made_rig(lens=())
    write_xcp(tmp_path / "lab.xcp", rig)
    assert_same_pixels(read_rig(tmp_path), rig)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("coefficients", "centre"),
    [
        ((4e-8, 3e-15, 0.0), None),
        ((-5e-8, 1e-14, -1e-21), None),
        ((3e-7, 0.0, 0.0), None),
        ((1.5e-7, 2e-14, 0.0), (640.0, 360.0)),
    ],
)
def test_the_lens_that_corrects_pixels_becomes_one_that_bends_rays(tmp_path, coefficients, centre):
    """Undistorting the projected pixel by Vicon's own formula must give the straight pixel again, to 0.05 px."""
    rig = made_rig(lens=())
    place = "{x} {y}" if centre is None else f"{centre[0]} {centre[1]}"
    radial = f"Vicon3Parameter {place} " + " ".join(map(repr, coefficients))
    write_xcp(tmp_path / "lab.xcp", rig, radial=radial)
    for straight, bent in zip(rig, read_rig(tmp_path), strict=True):
        pixels = bent.project(POINTS)
        middle = straight.matrix[:2, 2] if centre is None else np.array(centre)
        offset = pixels - middle
        squared = np.sum(offset**2, axis=1, keepdims=True)
        scale = 1 + sum(k * squared ** (power + 1) for power, k in enumerate(coefficients))
        corrected = middle + offset * scale
        assert np.abs(pixels - straight.project(POINTS)).max() > 0.5
        assert np.abs(corrected - straight.project(POINTS)).max() < 0.05


def test_the_older_lens_has_two_coefficients_about_the_principal_point(tmp_path):
    rig = made_rig(lens=())
    write_xcp(tmp_path / "new.xcp", rig, radial="Vicon3Parameter {x} {y} 2e-08 3e-15 0")
    (tmp_path / "old").mkdir()
    write_xcp(tmp_path / "old" / "lab.xcp", rig, radial="")
    text = (tmp_path / "old" / "lab.xcp").read_text().replace("WORLD_ERROR", 'VICON_RADIAL="2e-08 3e-15" WORLD_ERROR')
    (tmp_path / "old" / "lab.xcp").write_text(text)
    assert_same_pixels(read_rig(tmp_path / "old"), read_rig(tmp_path / "new.xcp"), tolerance=1e-9)


def test_only_video_cameras_are_read_if_there_are_any(tmp_path):
    rig = made_rig(lens=())
    write_xcp(tmp_path / "lab.xcp", rig)
    text = (tmp_path / "lab.xcp").read_text().replace('TYPE="VideoInputDevice"', 'TYPE="Vantage"', 1)
    (tmp_path / "lab.xcp").write_text(text)
    assert read_rig(tmp_path).names == ("cam02", "cam03")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"<Cameras>": "<Cameras"}, "is not XML"),
        ({"<Camera ": "<Kamera ", "</Camera>": "</Kamera>"}, "has no calibrated camera"),
        ({'SENSOR_SIZE="1280 720"': 'SENSOR_SIZE="1280"'}, "has no 2 numbers in SENSOR_SIZE"),
        ({"ORIENTATION": "O"}, "has no 4 numbers in ORIENTATION"),
        ({'ORIENTATION="': 'ORIENTATION="1e3 '}, "has no 4 numbers in ORIENTATION"),
        ({'FOCAL_LENGTH="1000.0"': 'FOCAL_LENGTH="nan"'}, "has no number in FOCAL_LENGTH"),
        ({'FOCAL_LENGTH="1000.0"': 'FOCAL_LENGTH="-1000"'}, "focal length"),
        ({"Vicon3Parameter": "Vicon5Parameter"}, "not 'Vicon3Parameter' and 5 numbers"),
        ({"0 0 0": "-9e-6 0 0"}, "fold the image"),
        ({"<?xml version=\"1.0\" encoding=\"UTF-8\"?>": "<!DOCTYPE a [<!ENTITY b 'c'>]>"}, "defines entities"),
        ({'encoding="UTF-8"': 'encoding="nonsense"'}, "is not XML"),
        ({'DEVICEID="cam02"': 'DEVICEID="../cam02"'}, "a name that is a path"),
        ({'DEVICEID="cam02"': 'DEVICEID="cam01"'}, "several cameras named 'cam01'"),
    ],
)  # fmt: skip
def test_a_wrong_file_is_an_error_that_names_it(tmp_path, changes, message):
    write_xcp(tmp_path / "lab.xcp", made_rig(lens=()), changes=changes)
    with pytest.raises(FileProblem, match=message) as caught:
        read_rig(tmp_path)
    assert "lab.xcp" in str(caught.value)

"""Damaged calibrations of every format: either still usable cameras, or one line that names the file."""

import pickle
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from tests.damaged_files import damaged_bytes
from tests.rig_files import made_rig, opencap_table, write_colmap, write_xcp

from marey.cameras.rig import Rig
from marey.errors import FileProblem
from marey.io.calibration.readers import read_rig
from marey.io.calibration.writers import write_rig

COUNT = 60
QUALISYS = """<calibration><cameras><camera active="1" serial="21001" model="Miqus Video">
<fov_video left="32" top="16" right="1951" bottom="1095"/>
<fov_video_max left="0" top="0" right="1983" bottom="1111"/>
<transform x="3000" y="0" z="1500" r11="0" r12="1" r13="0" r21="0" r22="0" r23="1" r31="1" r32="0" r33="0"/>
<intrinsic sensorMinU="0" sensorMaxU="126975" focalLengthU="107520" focalLengthV="107584" centerPointU="64000"
 centerPointV="35200" skew="0" radialDistortion1="-0.046" radialDistortion2="0.14" radialDistortion3="0.01"
 tangentalDistortion1="0.0006" tangentalDistortion2="-0.0007"/></camera></cameras></calibration>
"""


def write_valid(folder: Path, kind: str) -> list[Path]:
    """Write a calibration of each kind; return its files."""
    rig = made_rig(("cam_1", "cam_2"))
    if kind in ("pose2sim", "caliscope", "opencv"):
        return list(write_rig(rig, folder, to=kind))
    if kind == "vicon":
        write_xcp(folder / "lab.xcp", rig, radial="Vicon3Parameter {x} {y} 2e-08 3e-15 0")
    elif kind == "qualisys":
        (folder / "lab.qca.txt").write_text(QUALISYS)
    elif kind == "colmap":
        write_colmap(folder, rig)
    else:
        for camera in rig:
            (folder / f"{camera.name}.pickle").write_bytes(pickle.dumps(opencap_table(camera)))
    return sorted(folder.iterdir())


def usable_or_problem(folder: Path) -> Rig | FileProblem:
    """Read the cameras of a folder; warnings are errors."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            return read_rig(folder)
        except FileProblem as problem:
            return problem


@pytest.mark.parametrize("kind", ["pose2sim", "caliscope", "opencv", "vicon", "qualisys", "colmap", "opencap"])
def test_a_damaged_calibration_is_usable_or_one_line(tmp_path, kind):
    rng = np.random.default_rng(5)
    files = write_valid(tmp_path, kind)
    whole = {path: path.read_bytes() for path in files}
    assert len(read_rig(tmp_path)) > 0
    refused = 0
    for _ in range(COUNT):
        path = files[rng.integers(len(files))]
        path.write_bytes(damaged_bytes(whole[path], rng))
        found = usable_or_problem(tmp_path)
        if isinstance(found, FileProblem):
            assert str(tmp_path) in str(found)
            assert found.remedy
            refused += 1
        else:
            assert all(np.isfinite(camera.packed[:12]).all() for camera in found)
        path.write_bytes(whole[path])
    assert refused > COUNT / 5


@pytest.mark.parametrize(
    "name", ["../x", "/other/x", "a/b", "a\\\\b", "", "  ", ".", "..", "a\\u0000b", "a\\nb", "x" * 101, "\\u202ex"]
)  # fmt: skip
def test_a_name_that_is_no_plain_name_is_refused(tmp_path, name):
    files = write_valid(tmp_path, "pose2sim")
    text = files[0].read_text().replace('name = "cam_2"', f'name = "{name}"')
    files[0].write_text(text)
    with pytest.raises(FileProblem, match=r"cameras.toml: camera '.*' has (a|no) name"):
        read_rig(tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("rotation = [", "rotation = [90.0, 0.0, 0.0] #", "needs a rotation of 3 numbers .*in radians"),
        ("matrix = [[1000.0,", "matrix = [[1e6,", "has the focal lengths 1e.06 and 1002 for an image of 1280 x 720"),
        ("size = [1280.0, 720.0]", "size = [1e9, 720.0]", "whole pixels"),
        ("size = [1280.0, 720.0]", "size = [1280.5, 720.0]", "whole pixels"),
        ("translation = [", "translation = [inf, 0, 0] #", "needs a translation"),
    ],
)
def test_values_in_other_units_are_named(tmp_path, old, new, message):
    files = write_valid(tmp_path, "pose2sim")
    text = files[0].read_text()
    assert old in text
    files[0].write_text(text.replace(old, new, 1))
    with pytest.raises(FileProblem, match=f"camera 'cam_1' {message}|{message}"):
        read_rig(tmp_path)


def test_two_cameras_at_one_place_are_named(tmp_path):
    files = write_valid(tmp_path, "pose2sim")
    text = files[0].read_text()
    zero = re.sub(r"(rotation|translation) = .*", r"\1 = [0.0, 0.0, 0.0]", text)
    files[0].write_text(zero)
    with pytest.raises(FileProblem, match="has the cameras 'cam_1' and 'cam_2' at the same place"):
        read_rig(tmp_path)


def test_a_file_of_impossible_size_is_not_read(tmp_path):
    with (tmp_path / "cameras.toml").open("wb") as file:
        file.truncate(2**31)
    with pytest.raises(FileProblem, match="has more than 64 MB, which is too large for such a file"):
        read_rig(tmp_path)

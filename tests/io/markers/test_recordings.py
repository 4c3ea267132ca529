"""Reading motions of every format: angles, points, orientations and times."""

import ezc3d
import numpy as np
import pytest

from marey.errors import FileProblem
from marey.io.markers.c3d import write_c3d
from marey.io.markers.recordings import read_recording
from marey.io.npz import write_motion
from marey.io.opensim.mot_sto import Orientations, TimeSeriesTable, write_orientations, write_table
from marey.io.opensim.trc import PointPaths, write_trc
from marey.motion.motion import BodyMotion


def test_a_folder_of_a_capture_gives_angles_joints_and_segments(motion: BodyMotion, tmp_path):
    write_motion(tmp_path / "marey" / "motion.npz", motion)
    read = read_recording(tmp_path)
    assert read.angle_names == motion.angle_names
    assert read.point_names == motion.joint_names
    np.testing.assert_allclose(np.degrees(read.angles), motion.angles_deg)
    np.testing.assert_allclose(np.degrees(read.angles_sd), motion.angles_deg_sd)
    np.testing.assert_array_equal(read.rotation, motion.segment_rotation)


def test_a_table_gives_angles_and_standard_deviations_but_no_translations(tmp_path):
    columns = ("knee", "knee_sd", "pelvis_tx", "knee_lateral_mm", "knee_lateral_sd_mm")
    values = np.array([[10.0, 1.0, 0.5, 3.0, 0.1], [20.0, 2.0, 0.6, 4.0, 0.2]])
    write_table(tmp_path / "a.mot", TimeSeriesTable(name="a", columns=columns, time=[0.0, 0.1], values=values))
    read = read_recording(tmp_path / "a.mot")
    assert read.angle_names == ("knee",)
    np.testing.assert_allclose(np.degrees(read.angles[:, 0]), [10, 20])
    np.testing.assert_allclose(np.degrees(read.angles_sd[:, 0]), [1, 2])


def test_points_and_orientations_of_all_formats_are_the_same(motion: BodyMotion, tmp_path):
    paths = PointPaths(names=motion.joint_names, time=motion.time, rate=motion.rate, points=motion.joint_centres)
    write_trc(tmp_path / "a.trc", paths)
    write_c3d(
        tmp_path / "a.c3d", paths, segment_names=motion.segment_names, segment_rotation=motion.segment_rotation,
        segment_origin=motion.segment_origin,
    )  # fmt: skip
    turns = Orientations(
        names=motion.segment_names, time=motion.time, rate=motion.rate, world_from_body=motion.segment_rotation
    )
    write_orientations(tmp_path / "a.sto", turns)
    trc, c3d, sto = (read_recording(tmp_path / f"a.{kind}") for kind in ("trc", "c3d", "sto"))
    np.testing.assert_allclose(trc.points, motion.joint_centres, atol=1e-6)
    np.testing.assert_allclose(c3d.points, motion.joint_centres, atol=1e-6)
    np.testing.assert_allclose(c3d.rotation, motion.segment_rotation, atol=1e-6)
    np.testing.assert_allclose(sto.rotation, motion.segment_rotation, atol=1e-6)
    assert c3d.segment_names == sto.segment_names == motion.segment_names


def test_angles_of_plug_in_gait_are_angles_and_not_points(tmp_path):
    c3d = ezc3d.c3d()
    point = c3d["parameters"]["POINT"]
    point["RATE"]["value"], point["UNITS"]["value"] = [100.0], ["mm"]
    point["LABELS"]["value"] = ["LKNE", "RKNE", "LKneeAngles"]
    data = np.ones((4, 3, 5))
    data[:3, 0], data[:3, 1] = 100.0, 400.0
    data[:3, 2] = np.array([30.0, 5.0, -8.0])[:, None]
    c3d["data"]["points"] = data
    c3d.add_parameter("POINT", "ANGLES", ["LKneeAngles"])
    c3d.write(str(tmp_path / "pig.c3d"))
    read = read_recording(tmp_path / "pig.c3d")
    assert read.angle_names == ("left_knee_flexion", "left_knee_adduction", "left_knee_rotation")
    np.testing.assert_allclose(np.degrees(read.angles[0]), [30, 5, -8], atol=1e-5)
    assert "LKneeAngles" not in read.point_names


def test_a_file_without_a_measured_frame_or_a_motion_is_rejected(tmp_path):
    write_table(
        tmp_path / "empty.mot", TimeSeriesTable(name="a", columns=("a",), time=[0.0, 0.1], values=[[np.nan], [np.nan]])
    )
    with pytest.raises(FileProblem, match="has no measured frame"):
        read_recording(tmp_path / "empty.mot")
    (tmp_path / "a.xlsx").write_text("x")
    with pytest.raises(FileProblem, match="is not a file of a motion"):
        read_recording(tmp_path / "a.xlsx")
    write_table(
        tmp_path / "back.mot", TimeSeriesTable(name="a", columns=("a",), time=[0.1, 0.0], values=[[1.0], [2.0]])
    )
    with pytest.raises(FileProblem, match="are not increasing"):
        read_recording(tmp_path / "back.mot")

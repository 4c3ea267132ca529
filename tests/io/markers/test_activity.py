import json

import numpy as np
import pytest
from tests.made_scans import made_scan

from marey.errors import FileProblem
from marey.io.markers.activity import first_method, laboratory_is_y_up, read_activity
from marey.io.markers.bones import BoneFile, write_bones
from marey.io.markers.c3d import write_c3d
from marey.io.markers.results import write_marker_motion
from marey.io.opensim.trc import PointPaths
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.clusters import Cluster
from marey.markers.data.marker_motion import marker_motion


@pytest.fixture
def folder(rng, tmp_path):
    """Result folder of `marey markers` for a synthetic activity, by two methods."""
    activity = made_scan(rng).activity
    markers, motion = activity.markers, activity.motion
    paths = PointPaths(names=markers.labels, time=markers.time, rate=markers.rate, points=markers.points)
    write_c3d(
        tmp_path / "motion.c3d", paths, segment_names=motion.segments, segment_rotation=motion.rotation,
        segment_origin=motion.origin,
    )  # fmt: skip
    clusters = [
        Cluster(segment=name, labels=tuple(k for k, v in activity.segment_of_label.items() if v == name))
        for name in motion.segments
    ]
    write_marker_motion(tmp_path / "marker_motion.csv", activity.time, marker_motion(markers, clusters, motion))
    for name in ("bones.npz", "bones_rigid.npz"):
        known = np.array([0])
        write_bones(tmp_path / name, BoneFile(motion=motion, time=activity.time, side="left", reference_frames=known))
    record = {"settings": {"methods": ["skin", "rigid"]}}
    (tmp_path / "run.json").write_text(json.dumps(record), encoding="utf-8")
    return tmp_path


def test_bones_markers_and_the_reference_posture_are_read_from_a_result_folder(rng, folder):
    made = made_scan(np.random.default_rng(20060101)).activity
    read = read_activity(folder)
    assert read.side == "left"
    assert read.reference_frames.tolist() == [0]
    assert dict(read.segment_of_label) == dict(made.segment_of_label)
    assert read.motion.rotation == pytest.approx(made.motion.rotation)
    assert read.cluster is not None
    # A C3D has single precision.
    places = read.places("thigh", ("thigh_0", "thigh_3"))
    assert places == pytest.approx(made.places("thigh", ("thigh_0", "thigh_3")), abs=1e-6)


def test_bones_of_another_method_are_read_and_a_method_that_was_not_run_is_an_error(folder):
    assert len(read_activity(folder, method="rigid").motion) == 6
    assert len(read_activity(folder, method="skin").motion) == 6
    with pytest.raises(FileProblem, match=r"method pct\. It has results of skin, rigid"):
        read_activity(folder, method="pct")


def test_a_folder_without_bones_and_one_with_other_frames_are_errors(folder, tmp_path_factory):
    with pytest.raises(FileProblem, match=r"has no bones\.npz"):
        read_activity(tmp_path_factory.mktemp("empty"))
    shorter = read_activity(folder).motion
    cut = BoneMotion(
        segments=shorter.segments, rotation=shorter.rotation[:4], origin=shorter.origin[:4],
        covariance=shorter.covariance[:4],
    )  # fmt: skip
    write_bones(folder / "bones.npz", BoneFile(motion=cut, time=np.arange(4) / 100))
    with pytest.raises(FileProblem, match="6 frames of markers but 4 of bones"):
        read_activity(folder)


def test_the_first_method_is_that_of_the_run_record_or_the_name_of_the_folder(folder):
    assert first_method(folder) == "skin"
    (folder / "run.json").write_text("{}", encoding="utf-8")
    assert first_method(folder) == folder.name


def test_a_laboratory_is_y_up_if_the_trial_was_a_trc(folder):
    assert not laboratory_is_y_up(folder)
    (folder / "run.json").write_text(json.dumps({"inputs": {"walk.TRC": "", "frame0.npz": ""}}), encoding="utf-8")
    assert laboratory_is_y_up(folder)


def test_a_record_that_is_no_json_is_named(tmp_path):
    (tmp_path / "run.json").write_text("[")
    with pytest.raises(FileProblem, match=r"run\.json: is not JSON"):
        laboratory_is_y_up(tmp_path)

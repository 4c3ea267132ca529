"""Results in forms of exchange: Motion-BIDS, movement, C3D."""

import csv
import json
import shutil

import ezc3d
import numpy as np
import pytest
from scipy.stats import chi2
from tests import performer
from tests.trials import marker_points, write_reference, write_trial

import marey
from marey.cli.main import run
from marey.errors import FileProblem, SettingProblem
from marey.geometry import rotations
from marey.io.markers.c3d_forces import read_events
from marey.io.npz import write_motion
from marey.io.results.gait import write_events
from marey.motion.events.cycles import OFF, STRIKE, GaitEvent

STEM = "sub-07/motion/sub-07_task-walk01_tracksys-marey"


@pytest.fixture
def results(tmp_path):
    """The results of a take, whose motion has frames without a person."""
    folder = tmp_path / "walk 01" / "marey"
    folder.mkdir(parents=True)
    write_motion(folder / "motion.npz", performer.motion(performer.body()))
    return folder


def channels(dataset, stem=STEM):
    """The columns of a recording by name, and their descriptions."""
    with (dataset / f"{stem}_channels.tsv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file, delimiter="\t"))
    text = (dataset / f"{stem}_motion.tsv").read_text().replace("n/a", "nan")
    table = np.array([line.split("\t") for line in text.splitlines()], float)
    assert table.shape[1] == len(rows)
    return {row["name"]: values for row, values in zip(rows, table.T, strict=True)}, rows


def test_every_quantity_is_a_channel_with_its_standard_deviation(results, tmp_path):
    path = marey.export(results, out=tmp_path / "data", subject="07")
    assert path == tmp_path / "data" / f"{STEM}_motion.tsv"
    found, rows = channels(tmp_path / "data")
    motion = marey.load_motion(results).data
    name = motion.joint_names[2]
    np.testing.assert_allclose(found[f"{name}_y"], motion.joint_centres[:, 2, 1], rtol=1e-8)
    np.testing.assert_allclose(found[f"{name}_y_sd"], motion.joint_centres_sd[:, 2, 1], rtol=1e-8)
    np.testing.assert_allclose(found[motion.angle_names[0]], motion.angles_deg[:, 0], rtol=1e-8)
    np.testing.assert_allclose(found["latency"], motion.time - motion.time[0], atol=1e-9)
    segment = motion.segment_names[1]
    quaternion = np.stack([found[f"{segment}_quat_{part}"] for part in "wxyz"], 1)
    known = np.isfinite(quaternion).all(1)
    assert known.any()
    np.testing.assert_allclose(
        rotations.from_quaternion(quaternion[known]), motion.segment_rotation[known, 1], atol=1e-7
    )
    assert {row["component"] for row in rows if row["type"] == "ORNT"} == {f"quat_{part}" for part in "wxyz"}
    sidecar = json.loads((tmp_path / "data" / f"{STEM}_motion.json").read_text())
    assert sidecar["SamplingFrequency"] == motion.rate
    assert sidecar["MotionChannelCount"] == len(rows)
    counted = [sidecar[f"{kind}ChannelCount"] for kind in ("POS", "ORNT", "JNTANG", "LATENCY", "MISC")]
    assert sum(counted) == len(rows)
    frames = json.loads((tmp_path / "data" / f"{STEM}_channels.json").read_text())["reference_frame"]["Levels"]
    assert {row["reference_frame"] for row in rows} <= set(frames)
    assert frames["world"]["SpatialAxes"] == "__S"  # The specification's letters: the third axis is superior.


def test_recordings_are_added_and_none_is_replaced(results, tmp_path):
    data = tmp_path / "data"
    marey.export(results, out=data, subject="07", task="walk", session="a", run=1)
    marey.export(results, out=data, subject="07", task="walk", session="a", run=2)
    marey.export(results, out=data, subject="08", task="walk", session="a", run=1)
    assert (data / "participants.tsv").read_text().splitlines() == ["participant_id", "sub-07", "sub-08"]
    assert len(list(data.rglob("*_motion.tsv"))) == 3
    before = {path: path.read_bytes() for path in data.rglob("*") if path.is_file()}
    with pytest.raises(FileProblem, match="exists"):
        marey.export(results, out=data, subject="07", task="walk", session="a", run=2)
    assert before == {path: path.read_bytes() for path in data.rglob("*") if path.is_file()}


def test_further_columns_of_participants_are_kept(results, tmp_path):
    data = tmp_path / "data"
    marey.export(results, out=data, subject="07")
    (data / "participants.tsv").write_text("participant_id\tage\nsub-07\t31\n")
    marey.export(results, out=data, subject="08")
    assert (data / "participants.tsv").read_text() == "participant_id\tage\nsub-07\t31\nsub-08\tn/a\n"


def test_bones_of_markers_are_exported(tmp_path):
    write_trial(tmp_path / "walk.c3d", marker_points())
    write_reference(tmp_path / "frame0.npz")
    trial = marey.open_markers(tmp_path / "walk.c3d", reference=tmp_path / "frame0.npz", frames=range(0, 20))
    marey.estimate_bones(trial, "rigid", out=tmp_path / "bones")
    bones = marey.load_bones(tmp_path / "bones")
    path = marey.export(tmp_path / "bones", out=tmp_path / "data", subject="07", task="walk")
    found, _ = channels(tmp_path / "data", str(path.relative_to(tmp_path / "data")).removesuffix("_motion.tsv"))
    np.testing.assert_allclose(found[f"{bones.segments[0]}_x"], bones.motion.origin[:, 0, 0], rtol=1e-7)
    for curve in bones.angles.values():
        np.testing.assert_allclose(found[curve.name], curve.values, rtol=1e-7)


@pytest.mark.parametrize(
    ("words", "wrong"),
    [
        (["--to", "xls"], "'xls' and should be one of: bids"),
        (["--to", "movement"], "does not end in .nc"),
        (["--to", "c3d", "--run", "1"], "belong to the form bids"),
        (["--subject", "0_7"], "letters and digits"),
        (["--run", "0"], "1 or greater"),
    ],
)
def test_wrong_options_are_one_line_and_write_nothing(results, tmp_path, capsys, words, wrong):
    assert run(["export", str(results), "--out", str(tmp_path / "data"), *words]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert wrong in lines[0]
    assert not (tmp_path / "data").exists()


def test_a_folder_with_something_else_is_refused(results, tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.jpg").write_bytes(b"")
    with pytest.raises(FileProblem, match="not a BIDS dataset"):
        marey.export(results, out=tmp_path / "photos")
    with pytest.raises(FileProblem, match=r"motion\.npz"):
        marey.export(tmp_path / "photos", out=tmp_path / "data")
    with pytest.raises(SettingProblem, match="letters and digits"):
        marey.export(results, out=tmp_path / "data", task="walk fast")


@pytest.mark.slow
@pytest.mark.parametrize(("to", "end"), [("movement", "s"), ("movement-0.17", "")])
def test_movement_gets_the_dimensions_attributes_and_values_of_a_poses_dataset(results, tmp_path, to, end):
    xarray = pytest.importorskip("xarray")
    path = marey.export(results, out=tmp_path / "walk.nc", to=to, subject="07")
    motion = marey.load_motion(results).data
    with xarray.open_dataset(path) as data:
        assert data.position.dims == ("time", "space", f"keypoint{end}", f"individual{end}")
        assert data.confidence.dims == ("time", f"keypoint{end}", f"individual{end}")
        assert {key: data.attrs[key] for key in ("ds_type", "time_unit", "fps")} == {
            "ds_type": "poses", "time_unit": "seconds", "fps": motion.rate,
        }  # fmt: skip
        assert list(data[f"individual{end}"].values) == ["07"]
        chosen = {"space": "y", f"keypoint{end}": "left_knee"}
        own = motion.joint_names.index("left_knee")
        np.testing.assert_array_equal(data.position.sel(chosen).values[:, 0], motion.joint_centres[:, own, 1])
        np.testing.assert_array_equal(data.position_sd.sel(chosen).values[:, 0], motion.joint_centres_sd[:, own, 1])
        angle = data.joint_angle.sel(angle=motion.angle_names[4]).values[:, 0]
        np.testing.assert_array_equal(angle, motion.angles_deg[:, 4])
        np.testing.assert_array_equal(data.time.values, motion.time)
        there = np.isfinite(motion.joint_centres[:, 0, 0])
        confidence = data.confidence.values[:, 0, 0]
    assert (confidence[~there] == 0).all()
    np.testing.assert_allclose(confidence[there], chi2.cdf(3.0**2, 3))  # The made motion has deviations of 10 mm.


def test_all_people_of_a_recording_are_in_one_dataset(results, tmp_path):
    xarray = pytest.importorskip("xarray")
    for name in ("person10", "person2"):
        shutil.copytree(results, tmp_path / "street" / name)
    with xarray.open_dataset(marey.export(tmp_path / "street", out=tmp_path / "all.nc", to="movement")) as data:
        assert list(data.individuals.values) == ["person2", "person10"]
    other = tmp_path / "street" / "person10" / "motion.npz"
    write_motion(other, performer.motion(performer.body(), frames=20))
    with pytest.raises(FileProblem, match="person2 and person10 that differ in their frames"):
        marey.export(tmp_path / "street", out=tmp_path / "again.nc", to="movement")


def test_a_c3d_has_points_rotations_angles_events_and_deviations(results, tmp_path):
    motion = marey.load_motion(results).data
    events = (
        GaitEvent(kind=STRIKE, side="left", time=0.2, source="body", sd_s=0.01),
        GaitEvent(kind=OFF, side="left", time=0.5, source="body", sd_s=0.01),
    )
    write_events(results / "events.csv", events)
    path = marey.export(results, out=tmp_path / "walk.c3d", to="c3d")
    c3d = ezc3d.c3d(str(path))
    labels = c3d["parameters"]["POINT"]["LABELS"]["value"]
    assert labels[: len(motion.joint_names)] == list(motion.joint_names)
    frame = 5
    knee = c3d["data"]["points"][:3, labels.index("left_knee_angles"), frame]
    first = motion.angle_names.index("left_knee_flexion")
    np.testing.assert_allclose(knee, motion.angles_deg[frame, first : first + 3], rtol=1e-6)
    assert c3d["data"]["meta_points"]["residuals"][0, 0, frame] == 10.0  # [mm], the deviation of the made motion
    assert c3d["data"]["meta_points"]["residuals"][0, 0, 0] == -1.0
    np.testing.assert_allclose(
        c3d["data"]["rotations"][:3, :3, 1, frame], motion.segment_rotation[frame, 1], atol=1e-6
    )  # fmt: skip
    assert [(e.kind, e.side, round(e.time, 6)) for e in read_events(path)] == [
        ("strike", "left", 0.2), ("off", "left", 0.5),
    ]  # fmt: skip
    with pytest.raises(FileProblem, match="exists"):
        marey.export(results, out=path, to="c3d")


def test_bones_of_markers_get_their_angles_into_the_c3d_and_origins_into_movement(tmp_path):
    xarray = pytest.importorskip("xarray")
    write_trial(tmp_path / "walk.c3d", marker_points())
    write_reference(tmp_path / "frame0.npz")
    trial = marey.open_markers(tmp_path / "walk.c3d", reference=tmp_path / "frame0.npz", frames=range(0, 20))
    marey.estimate_bones(trial, "rigid", out=tmp_path / "bones")
    bones = marey.load_bones(tmp_path / "bones")
    c3d = ezc3d.c3d(str(marey.export(tmp_path / "bones", out=tmp_path / "walk_angles.c3d", to="c3d")))
    labels = c3d["parameters"]["POINT"]["LABELS"]["value"]
    before = ezc3d.c3d(str(tmp_path / "bones" / "motion.c3d"))["parameters"]["POINT"]["LABELS"]["value"]
    assert labels[: len(before)] == before
    values = next(iter(bones.angles.values())).values
    at = labels.index(c3d["parameters"]["POINT"]["ANGLES"]["value"][0])
    np.testing.assert_allclose(c3d["data"]["points"][0, at, :20], values[:20], rtol=1e-5, atol=1e-5)
    assert (c3d["data"]["meta_points"]["residuals"][0, at, 20:] == -1).all()
    with xarray.open_dataset(marey.export(tmp_path / "bones", out=tmp_path / "walk.nc", to="movement")) as data:
        assert tuple(data.keypoints.values) == bones.segments
        np.testing.assert_array_equal(data.position.values[..., 0].swapaxes(1, 2), bones.motion.origin)

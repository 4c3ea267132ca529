"""What `marey shape` reads and leaves beside what a capture does."""

import csv
import re
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import Pose
from marey.body.metaballs import segment_measures
from marey.body.metaballs.metaball_people import metaball_person
from marey.body.metaballs.metaballs import PosedMetaballs
from marey.cameras.rig import Rig
from marey.errors import FileProblem
from marey.fit.points.shape import ShapeEstimate
from marey.fit.points.surface_points import FramePoints
from marey.fit.solver.picture_times import PictureTimes
from marey.geometry.rigid import RigidTransform
from marey.io.calibration.readers import write_cameras_toml
from marey.io.shapes.measured_surface import write_surface
from marey.pipelines.capture.run import with_corrected_cameras
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.shape import shape
from marey.pipelines.shape.shape import Fitted, find_lost_points, keep, points_of, posed_skin, seen_of, write_table
from marey.surface.points.measured import MeasuredPoints


@pytest.fixture(scope="module")
def body():
    return metaball_person("simple", "coarse", preset="right_arm")


@pytest.fixture(scope="module")
def pose(body):
    angles = np.zeros(len(body.skeleton) - 6)
    angles[[c.name for c in body.skeleton.coordinates].index("right_elbow_flexion")] = 0.6
    return Pose(np.array([1.0, 2.0, 3.0]), np.eye(3), angles)


def run_of(first, end):
    take = SimpleNamespace(first=first, end=end, count=end)
    return SimpleNamespace(trial=SimpleNamespace(take=take, rig=()), out=None)


def test_the_skin_is_the_metaballs_own_in_every_pose(body, pose):
    skin = posed_skin(body, {4: pose})
    used = np.unique(skin.faces)
    vertices = skin.vertices_of(4)
    assert len(skin.faces) == 4 * len(body.faces)
    on = PosedMetaballs(body.metaballs.balls(body.numbers), pose)
    away = np.abs(on.distance(vertices[used]))
    # In a crease, where two limbs meet, the blended skin stays.
    assert np.mean(away < 1e-4) > 0.9


def test_each_camera_sees_the_skin_at_the_instant_of_its_picture(body, pose):
    poses = {f: replace(pose, translation=pose.translation + [0.1 * f, 0.0, 0.0]) for f in range(3)}
    skin = posed_skin(body, poses, PictureTimes(np.array([[0.0] * 3, [0.4] * 3])))
    np.testing.assert_allclose(skin.late_vertices(1, 0), skin.vertices_of(1), atol=1e-12)
    np.testing.assert_allclose(skin.late_vertices(1, 1), skin.vertices_of(1) + [0.04, 0.0, 0.0], atol=1e-9)


def test_what_lies_near_points_was_seen(body, pose):
    skin = posed_skin(body, {1: pose})
    vertices = skin.vertices_of(1)
    some = np.unique(skin.faces)[::9]
    points = {1: FramePoints(vertices[some] + 0.002, np.zeros((len(some), 3, 3)))}
    seen = list(seen_of(skin, points, 2, [1], run_of(0, 2)))
    assert seen[1][some].all()
    assert not seen[0].any()
    far = np.linalg.norm(vertices[:, None] - points[1].points[None], axis=2).min(1) > 0.0101
    assert not seen[1][far].any()


def test_points_of_other_frames_are_left_out(tmp_path):
    count = 6
    points = MeasuredPoints(
        frame=np.array([0, 0, 1, 2, 2, 2]), points=np.arange(18.0).reshape(6, 3),
        covariance=np.broadcast_to(np.eye(3) * 1e-6, (6, 3, 3)), camera_names=("a", "b"),
        pixels=np.zeros((count, 2, 2)), correlation=np.ones((count, 2)), residual_px=np.zeros(count),
        colour=np.zeros((count, 3), np.uint8),
    )  # fmt: skip
    write_surface(tmp_path / "surface.npz", [points], ("a", "b"))
    found = points_of(run_of(1, 3), tmp_path / "surface.npz")
    assert {frame: len(own) for frame, own in found.items()} == {1: 1, 2: 3}
    assert points_of(run_of(0, 3), tmp_path / "none.npz") == {}


@dataclass(frozen=True)
class Calibrated:
    """The attributes of a trial that the correction of its cameras uses."""

    rig: Rig


def test_cameras_that_the_surface_corrected_are_used_and_it_is_reported(tmp_path):
    cameras = worlds.ring(3)
    rig = Rig(tuple(replace(camera, name=name) for camera, name in zip(cameras, "abc", strict=True)))
    shift = RigidTransform(rotation=np.eye(3), translation=np.array([0.01, 0.0, 0.0]))
    write_cameras_toml(rig.moved(shift), tmp_path / "cameras.toml")
    warnings = []
    progress = SimpleNamespace(warn=warnings.append)
    found = with_corrected_cameras(Calibrated(rig.subset(["a", "c"])), tmp_path / "cameras.toml", progress)
    assert found.rig.names == ("a", "c")
    np.testing.assert_allclose(found.rig.centres, rig.moved(shift).subset(["a", "c"]).centres, atol=1e-9)
    assert "corrected" in warnings[0]
    other = Calibrated(Rig((replace(cameras[0], name="d"), replace(cameras[1], name="a"))))
    assert with_corrected_cameras(other, tmp_path / "cameras.toml", progress) is other
    assert "lacks d" in warnings[1]


def test_the_measured_surface_stays_among_the_results(tmp_path):
    out, folder = tmp_path / "out", tmp_path / "new"
    (out / "surface").mkdir(parents=True)
    (out / "surface_masks").mkdir()
    folder.mkdir()
    for name in ("surface.npz", "surface_cam01.png", "surface/frame_00001.ply", "surface_masks/cam01.npz", "body.npz"):
        (out / name).write_text(name)
    keep(out, folder)
    kept = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    assert kept == ["surface.npz", "surface/frame_00001.ply", "surface_cam01.png"]


@pytest.mark.slow
def test_the_table_has_a_row_for_each_segment_that_is_followed(tmp_path, body, monkeypatch):
    monkeypatch.setattr(segment_measures, "COVARIANCE_DRAWS", 4)
    known = replace(body, numbers_covariance=1e-4 * np.eye(len(body.space)))
    warned: list[str] = []
    tables = write_table(tmp_path, known, warned.append)
    with (tmp_path / "segments.csv").open(newline="") as file:
        rows = {row["segment"]: row for row in csv.DictReader(file)}
    assert "right_forearm" in rows
    assert "left_forearm" not in rows
    texts = ("segment", "equal_by_model_to")
    forearm = {name: float(value) for name, value in rows["right_forearm"].items() if name not in texts and value}
    assert 0.15 < forearm["length_m"] < 0.35
    assert 0.4 < forearm["volume_l"] < 1.5
    assert forearm["mass_kg"] == pytest.approx(1.13 * forearm["volume_l"], rel=1e-4)
    assert all(forearm[name] > 0 for name in forearm if "_sd_" in name)
    assert rows["right_hand"]["girth_middle_m"] == ""
    # The page shows the same rows in centimetres and litres.
    page = {row[0]: dict(zip(tables[0].head, row, strict=True)) for row in tables[0].rows}
    assert list(page) == [*(name.replace("_", " ") for name in rows), "all segments"]
    assert page["right forearm"]["length cm"].startswith(f"{100 * forearm['length_m']:.1f} ± ")
    assert page["right forearm"]["volume l"].startswith(f"{forearm['volume_l']:.2f} ± ")
    assert page["right hand"]["girth 1/2 cm"] == ""
    # The last row of the page is the sum of all segments.
    for name, own, place in (("volume l", "volume_l", 0), ("mass kg", "mass_kg", 1)):
        whole = dict(zip(tables[place].head, tables[place].rows[-1], strict=True))
        value, half = map(float, whole[name].split(" ± "))
        assert value == pytest.approx(sum(float(row[own] or 0) for row in rows.values()), abs=0.006)
    # The densities of all segments are too high or too low together.
    assert half > 1.96 * 0.02 * value
    assert warned == []
    # The other side is not followed, so that there is no second number.
    assert rows["right_forearm"]["equal_by_model_to"] == ""


def test_a_girth_that_is_not_determined_is_left_out_and_named(tmp_path, body, monkeypatch):
    monkeypatch.setattr(segment_measures, "COVARIANCE_DRAWS", 4)
    known = replace(body, numbers_covariance=0.5 * np.eye(len(body.space)))
    warned: list[str] = []
    tables = write_table(tmp_path, known, warned.append)
    with (tmp_path / "segments.csv").open(newline="") as file:
        rows = {row["segment"]: row for row in csv.DictReader(file)}
    assert rows["right_upperarm"]["girth_proximal_m"] == ""
    assert float(rows["right_upperarm"]["girth_proximal_sd_m"]) > 0.01
    [place] = re.findall(r"at 25 % of the length of ([^;.]*)", warned[0])
    assert "right upperarm" in place.split(", ")
    page = {row[0]: dict(zip(tables[0].head, row, strict=True)) for row in tables[0].rows}
    assert page["right upperarm"]["girth 1/4 cm"] == "not determined"


def test_without_a_surface_the_page_states_what_the_silhouettes_do_not_show(tmp_path, monkeypatch):
    progress = RecordingProgress()

    def failing(*_: object) -> None:
        raise FileProblem(tmp_path / "cameras.toml", "has no two cameras near each other")

    monkeypatch.setattr(shape, "read_trial", lambda folder, **changes: None)
    monkeypatch.setattr(shape, "surface_of_trial", failing)
    trial = SimpleNamespace(folder=tmp_path, settings=SimpleNamespace(cameras=None, frames=None))
    [reason] = shape.measure(trial, tmp_path, progress)
    assert reason.level == "usable with limits"
    assert reason.what.endswith("cameras.toml has no two cameras near each other.")
    assert reason.remedy.startswith("The shape is fitted to the silhouettes alone: hollows")
    assert progress.warnings == [str(reason)]


def followed_with(monkeypatch, tmp_path, body, poses, *, names):
    """Search for lost points without images; return the predictions for them and the warnings."""
    arguments, warned = {}, []
    monkeypatch.setattr(shape, "follow_measured", lambda *given, **named: arguments.update(named, parts=given[2]))
    monkeypatch.setattr(shape, "write_tracks", lambda *given: None)
    monkeypatch.setattr(shape, "tracks_text", lambda result: "")
    none = MeasuredPoints(
        frame=np.zeros(1, int), points=np.zeros((1, 3)), covariance=np.eye(3)[None] * 1e-6, camera_names=("a", "b"),
        pixels=np.zeros((1, 2, 2)), correlation=np.ones((1, 2)), residual_px=np.zeros(1),
        colour=np.zeros((1, 3), np.uint8),
    )  # fmt: skip
    write_surface(tmp_path / "surface.npz", [none], ("a", "b"))
    run = SimpleNamespace(
        trial=SimpleNamespace(take=SimpleNamespace(first=0, end=3), rig=SimpleNamespace(names=names)), scope=None,
        progress=SimpleNamespace(warn=warned.append, report=lambda text: None), cache=None,
    )  # fmt: skip
    skin = posed_skin(body, poses)
    find_lost_points(run, tmp_path, skin, Fitted(body, poses, [], ShapeEstimate(body, poses, 0.001, 1.0)))
    return arguments, warned, skin


def test_a_lost_point_is_expected_where_the_fitted_body_carries_it(monkeypatch, tmp_path, body, pose):
    bent = np.array(pose.angles)
    bent[[c.name for c in body.skeleton.coordinates].index("right_elbow_flexion")] = 1.2
    poses = {0: pose, 2: Pose(pose.translation, pose.rotation, bent)}
    arguments, warned, skin = followed_with(monkeypatch, tmp_path, body, poses, names=("a", "b"))
    some = skin.faces[:: len(skin.faces) // 50]
    then, now = (np.array(skin.vertices_of(frame)[some]).mean(1) for frame in (0, 2))
    found = arguments["expected"](2, then, np.zeros(len(then), int))
    assert np.median(np.linalg.norm(found - now, axis=1)) < 1e-6
    assert np.isnan(arguments["expected"](1, then, np.zeros(len(then), int))).all()
    assert [len(part) for part in arguments["parts"]] == [1, 0, 0]
    assert not warned


def test_points_of_other_cameras_are_not_followed_again(monkeypatch, tmp_path, body, pose):
    arguments, warned, _ = followed_with(monkeypatch, tmp_path, body, {0: pose}, names=("a", "c"))
    assert not arguments
    assert "other cameras" in warned[0]

"""Factorising tracks, points and videos: the files of the results, and errors on input that determines nothing."""

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.errors import MareyError
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from marey.io.calibration.readers import write_cameras_toml
from marey.io.markers.c3d import read_c3d, write_c3d
from marey.io.npz import read_arrays
from marey.io.opensim.trc import PointPaths
from marey.io.shapes.shapes import read_shapes
from marey.pipelines.nonrigid.factorise import factorise
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.verdict import NotUsable

FRAMES, POINTS = 60, 12


def recovered(inputs: Path | Sequence[Path], out: Path | None = None, **options: Any) -> Path:
    """Recover the shapes and return the folder of results, which is beside the input by default."""
    first = inputs if isinstance(inputs, Path) else inputs[0]
    out = out or first.with_name(f"{first.stem}_marey")
    factorise(inputs, out=out, progress=RecordingProgress(), **options)
    return out


def turning(frames=FRAMES):
    """A camera that goes round a cluster that deforms in two ways: rotation (F, 3, 3), shapes (F, 3, P)."""
    rng = np.random.default_rng(3)
    time = np.arange(frames)
    axis = np.stack([0.1 * np.sin(time / 15), np.ones(frames), 0.1 * np.cos(time / 20)], 1)
    path = rotations.exp(axis * (0.08 * time + 0.1 * np.sin(time / 12))[:, None])
    weights = np.stack([0.25 * np.sin(time / 9), 0.15 * np.cos(time / 14)], 1)
    shapes = rng.normal(size=(3, POINTS)) + np.einsum("fm,mip->fip", weights, rng.normal(size=(2, 3, POINTS)))
    return path, 100 * (shapes - shapes.mean(2, keepdims=True))


@pytest.fixture(scope="module")
def made():
    path, shapes = turning()
    return path, shapes, (path @ shapes)[:, :2] + 300


@pytest.fixture(scope="module")
def results(made, tmp_path_factory):
    folder = tmp_path_factory.mktemp("nonrigid")
    tracks = made[2].copy()
    tracks[20:24, :, 3] = np.nan
    tracks[40] = np.nan
    tracks[:, :, 11] = np.where(np.arange(FRAMES)[:, None] < 3, tracks[:, :, 11], np.nan)
    np.savez(folder / "tracks.npz", tracks=tracks, edges=[[0, 1], [1, 2]], rate=50.0)
    return recovered(folder / "tracks.npz", distance=(0, 1, 0.5))


@pytest.mark.slow
def test_every_file_is_there_and_the_report_loads_nothing_from_elsewhere(results):
    names = {path.name for path in results.iterdir()}
    assert names == {"shapes.npz", "residuals.csv", "shapes", "shapes.glb", "shapes.c3d", "report.html", "run.json"}
    page = (results / "report.html").read_text()
    assert "http" not in page
    for text in ("Sign of depth", "Residuals by point", "basis shape 2"):
        assert text in page
    record = json.loads((results / "run.json").read_text())
    assert record["command"] == "nonrigid"
    assert list(record["inputs"]) == ["tracks.npz"]


def test_the_tracks_are_the_first_rows_of_the_turned_shape_and_the_shift(results, made):
    arrays = read_arrays(results / "shapes.npz")
    model = (arrays["rotation"] @ arrays["shape"])[:, :2] + arrays["translation"][:, :, None]
    known = np.isfinite(model)
    assert np.abs(model - made[2])[known].max() < 0.05 * 300
    np.testing.assert_allclose(model, arrays["modelled"][0])
    assert arrays["rank"] == 3 * len(arrays["basis"])
    combined = np.einsum("fk,kip->fip", arrays["coefficients"], arrays["basis"])
    np.testing.assert_allclose(combined, arrays["shape"])


def test_input_with_too_few_points_has_no_result_and_is_reported(results):
    found = read_shapes(results / "shapes.npz")
    assert np.flatnonzero(~found.answered).tolist() == [40]
    assert np.isnan(found.shape[40]).all()
    assert np.isnan(found.shape[:, :, 11]).all()
    assert np.isfinite(found.shape[20:24, :, 3]).all()
    assert np.flatnonzero(found.predicted.any(0)).tolist() == [3]
    warnings = json.loads((results / "run.json").read_text())["warnings"]
    assert any("no result: 40" in text for text in warnings)
    assert any("no result: 11" in text for text in warnings)
    assert not (results / "shapes" / "frame_00040.ply").exists()


def test_a_known_distance_gives_the_scale_of_all_that_other_programs_open(results):
    found = read_shapes(results / "shapes.npz")
    apart = np.linalg.norm(found.shape[:, :, 0] - found.shape[:, :, 1], axis=1)
    assert np.nanmedian(apart) * found.metres_per_unit == pytest.approx(0.5)
    points = read_c3d(results / "shapes.c3d").points
    metric = np.linalg.norm(points[:, 0] - points[:, 1], axis=1)
    assert np.median(metric[found.answered]) == pytest.approx(0.5, rel=1e-4)


def test_residuals_are_written_point_by_point(results):
    with (results / "residuals.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == POINTS
    assert rows[3]["frames_predicted"] == "4"
    assert rows[11]["rms"] == ""
    assert float(rows[0]["rms"]) <= float(rows[0]["largest"])


@pytest.mark.slow
def test_a_rigid_object_is_reported_as_rigid_and_has_rank_three(tmp_path, made):
    path, shapes, _ = made
    np.savez(tmp_path / "rigid.npz", tracks=(path @ shapes[0])[:, :2])
    found = factorise(tmp_path / "rigid.npz", out=tmp_path / "out", progress=RecordingProgress())
    assert "rigid" in str(found.summary()) + " ".join(found.details.warnings)
    assert read_arrays(tmp_path / "out" / "shapes.npz")["rank"] == 3


def test_only_the_requested_frames_have_a_result(tmp_path, made):
    np.savez(tmp_path / "t.npz", points=made[0] @ made[1])
    found = read_shapes(recovered(tmp_path / "t.npz", frames=(5, 30), basis_shapes=2) / "shapes.npz")
    assert np.flatnonzero(found.answered).tolist() == list(range(5, 30))


def test_points_in_space_give_the_motion_in_the_laboratory(tmp_path, made):
    path, shapes, _ = made
    points = np.moveaxis(path @ shapes, 1, 2) / 1e3 + np.linspace(0, 1, FRAMES)[:, None, None]
    names = tuple(f"thigh_{n:02d}" for n in range(POINTS))
    trial = PointPaths(names=names, time=np.arange(FRAMES) / 100, rate=100.0, points=points)
    write_c3d(tmp_path / "walk.c3d", trial)
    arrays = read_arrays(recovered(tmp_path / "walk.c3d", basis_shapes=3) / "shapes.npz")
    model = arrays["rotation"] @ arrays["shape"] + arrays["translation"][:, :, None]
    np.testing.assert_allclose(np.moveaxis(model, 1, 2), points, atol=5e-3)
    assert arrays["labels"].tolist() == list(names)
    assert arrays["unit"] == "m"
    assert arrays["basis"].shape == (3, 3, POINTS)
    np.testing.assert_allclose(read_c3d(tmp_path / "walk_marey" / "shapes.c3d").points, points, atol=5e-3)


def write(folder: Path, **arrays: Any) -> Path:
    np.savez(folder / "given.npz", **arrays)
    return folder / "given.npz"


def error_of(inputs: Path | Sequence[Path], **options: Any) -> str:
    """Return the error of a factorisation that must fail."""
    with pytest.raises(MareyError) as problem:
        recovered(inputs, **options)
    return str(problem.value)


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"shape": np.zeros((9, 3, 5))}, "neither tracks nor points, but shape"),
        ({"tracks": np.zeros((9, 5, 2))}, "last two axes seem to be exchanged"),
        ({"tracks": np.zeros((9, 10))}, "shape (9, 10)"),
        ({"tracks": np.full((9, 2, 5), "a")}, "type <U1"),
        ({"tracks": np.full((9, 2, 5), np.nan)}, "all are NaN"),
        ({"tracks": np.full((9, 2, 5), np.inf)}, "infinite"),
        ({"points": np.zeros((9, 2, 5))}, "(frames, 3, points)"),
        ({"tracks": np.ones((9, 2, 5)), "points": np.ones((9, 3, 5))}, "both tracks and points"),
        ({"tracks": np.ones((9, 2, 5)), "edges": [[0, 5]]}, "Points are numbered from 0 to 4"),
        ({"tracks": np.ones((9, 2, 5)), "rate": -1.0}, "rate"),
        ({"tracks": np.ones((9, 2, 5)), "labels": ["a", "b"]}, "labels for 5 points"),
    ],
)
def test_a_file_that_cannot_be_used_is_named_with_what_would_be_right(tmp_path, arrays, words):
    assert words in error_of(write(tmp_path, **arrays))
    assert not (tmp_path / "given_marey").exists()


@pytest.mark.parametrize(
    ("tracks", "words"),
    [
        (np.ones((9, 2, 3)), "at least 4 points must be seen together in at least 6 frames"),
        (np.ones((5, 2, 9)), "at least 4 points"),
        (np.random.default_rng(1).normal(size=(9, 2, 6)), "6 points are too few for one camera: 7"),
        (np.ones((9, 2, 9)), "coincide in every frame"),
    ],
)
def test_points_that_determine_no_shape_end_with_a_verdict_and_its_page(tmp_path, tracks, words):
    with pytest.raises(NotUsable) as problem:
        factorise(write(tmp_path, tracks=tracks), out=tmp_path / "out", progress=RecordingProgress())
    [reason] = problem.value.verdict.reasons
    assert (reason.level, reason.cause) == ("not usable", "undetermined")
    assert reason.what.startswith("given.npz: ")
    assert words in reason.what
    record = json.loads((tmp_path / "out" / "run.json").read_text(encoding="utf-8"))
    assert record["verdict"]["level"] == "not usable"
    assert problem.value.report == tmp_path / "out" / "report.html"
    assert words in problem.value.report.read_text(encoding="utf-8")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["report.html", "run.json"]
    # Without a folder nothing is written.
    with pytest.raises(NotUsable, match=words) as problem:
        factorise(tracks)
    assert problem.value.report is None


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"distance": (0, 12, 0.1)}, "there are the points 0 to 11"),
        ({"distance": (3, 3, 0.1)}, "two different points"),
        ({"distance": (0, 1, -2.0)}, "two different points"),
        ({"frames": (0, 900)}, "there are 60 frames"),
        ({"frames": (0, 3)}, "at least 4 points"),
        ({"points": "missing.npz"}, "does not exist"),
        ({"cameras": "missing.toml"}, "does not exist"),
        ({"matrix": "1,2,3"}, "3 numbers"),
        ({"matrix": "a,b,c,d"}, "neither an existing file nor numbers"),
        ({"matrix": "0,700,320,240"}, "focal lengths"),
        ({"basis_shapes": 3}, "points in space"),
        ({"scaled": True, "matrix": "700,700,320,240"}, "for an uncalibrated camera"),
    ],
)
def test_a_setting_that_does_not_apply_is_reported(tmp_path, made, options, words):
    assert words in error_of(write(tmp_path, tracks=made[2]), **options)


def test_a_camera_that_sees_one_side_only_is_reported(tmp_path, made):
    _, shapes, _ = made
    turn = rotations.exp(np.stack([0 * np.arange(FRAMES), 0 * np.arange(FRAMES), 0.05 * np.arange(FRAMES)], 1))
    assert "one side only" in error_of(write(tmp_path, tracks=(turn @ shapes[0])[:, :2]))


@pytest.mark.slow
def test_the_magnification_of_a_camera_with_changing_scale_is_reported(tmp_path, made):
    size = np.exp(0.3 * np.sin(np.arange(FRAMES) / 10))
    size /= np.exp(np.log(size).mean())
    out = recovered(write(tmp_path, tracks=size[:, None, None] * (made[2] - 300) + 300), scaled=True)
    with np.load(out / "shapes.npz") as found:
        magnification, turned = found["camera_magnification"], found["rotation"] @ found["shape"]
        again = magnification[:, None, None] * turned[:, :2] + found["translation"][..., None]
        np.testing.assert_allclose(again, found["modelled"][0], atol=1e-9)
        assert any("size is held" in str(note) for note in found["notes"])
    assert np.std(np.log(magnification / size)) < 0.5 * np.std(np.log(size))


@pytest.mark.parametrize("option", ["cameras", "matrix", "scaled"])
def test_points_in_space_take_no_cameras(tmp_path, made, option):
    (tmp_path / "cameras.toml").write_text("")
    values = {"cameras": tmp_path / "cameras.toml", "matrix": "700,700,320,240", "scaled": True}
    assert "points in space already" in error_of(write(tmp_path, points=made[1]), **{option: values[option]})


def test_a_c3d_without_points_and_files_of_other_kinds_are_rejected(tmp_path):
    empty = PointPaths(names=("a",), time=np.arange(9) / 100, rate=100.0, points=np.full((9, 1, 3), np.nan))
    write_c3d(tmp_path / "empty.c3d", empty)
    assert "no measured point" in error_of(tmp_path / "empty.c3d")
    (tmp_path / "note.txt").write_text("hello")
    assert "Give videos, an NPZ or a C3D" in error_of(tmp_path / "note.txt")
    assert "does not exist" in error_of(tmp_path / "none.npz")
    assert "is a folder" in error_of(tmp_path)


def test_an_interrupted_run_leaves_no_results_and_is_resumed_by_the_same_call(tmp_path, made, monkeypatch):
    given = write(tmp_path, points=made[0] @ made[1])

    def stopped(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("marey.pipelines.nonrigid.shapes.write_results", stopped)
    with pytest.raises(KeyboardInterrupt):
        recovered(given, basis_shapes=2)
    assert [path.name for path in (tmp_path / "given_marey").iterdir()] == [".work"]
    monkeypatch.undo()
    monkeypatch.setattr("marey.pipelines.nonrigid.factorise.factorise_points", stopped)
    recovered(given, basis_shapes=2)
    assert not (tmp_path / "given_marey" / ".work").exists()


SIZE, SHOWN = 128, 18


def seen_from(frame: int, beside: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Where the places of a speckled relief that sways and bends are seen: x and y (H, W) in the image.

    In frame 0 a camera that is not `beside` [rad] sees it from the front: its places are the pixels.
    """
    y, x = np.mgrid[:SIZE, :SIZE] - SIZE / 2
    depth = 14 * np.cos(x / 18) + 10 * np.sin(y / 15) + 6 * np.sin(frame / 5) * np.cos((x + y) / 30)
    a, b = beside + 0.5 * np.sin(frame / 4), 0.35 * np.sin(frame / 6)
    return SIZE / 2 + x * np.cos(a) + depth * np.sin(a), SIZE / 2 + y * np.cos(b) + depth * np.sin(b)


def film(path: Path, beside: float = 0.0) -> Path:
    rng = np.random.default_rng(5)
    grey = cv2.GaussianBlur(rng.standard_normal((SIZE, SIZE)), (0, 0), 1.6)
    grey = (128 + 40 * grey / grey.std()).astype(np.float32)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 25.0, (SIZE, SIZE))
    for frame in range(SHOWN):
        x, y = seen_from(frame, beside)
        goal_x, goal_y = np.meshgrid(np.arange(SIZE, dtype=float), np.arange(SIZE, dtype=float))
        back_x, back_y = goal_x.copy(), goal_y.copy()
        for _ in range(40):
            at = [cv2.remap(v.astype(np.float32), *_maps(back_x, back_y), cv2.INTER_LINEAR) for v in (x, y)]
            back_x, back_y = back_x + 0.7 * (goal_x - at[0]), back_y + 0.7 * (goal_y - at[1])
        shown = cv2.remap(grey, *_maps(back_x, back_y), cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        writer.write(cv2.cvtColor(np.clip(shown, 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


@pytest.fixture(scope="module")
def video(tmp_path_factory) -> Path:
    return film(tmp_path_factory.mktemp("video") / "relief.avi")


def _maps(x, y):
    return np.clip(x, 0, SIZE - 1).astype(np.float32), np.clip(y, 0, SIZE - 1).astype(np.float32)


@pytest.fixture(scope="module")
def from_video(video):
    places = np.stack(np.meshgrid(np.arange(30, 101, 14.0), np.arange(30, 101, 14.0)), -1).reshape(-1, 2)
    np.savez(video.with_name("points.npz"), points=places, frame=0)
    return recovered(video, video.with_name("out"), points=video.with_name("points.npz")), places


@pytest.mark.slow
def test_given_points_are_followed_in_their_order(from_video):
    out, places = from_video
    tracks = read_arrays(out / "tracks.npz")
    truth = np.stack(
        [np.stack([v[places[:, 1].astype(int), places[:, 0].astype(int)] for v in seen_from(f)]) for f in range(SHOWN)]
    )
    away = np.linalg.norm(tracks["tracks"] - truth, axis=1)
    assert np.nanmedian(away) < 1.0
    assert tracks["visible"].mean() > 0.7


def test_the_overlay_shows_image_and_side_view_of_every_frame(from_video):
    out, _ = from_video
    film = cv2.VideoCapture(str(out / "overlay_relief.mp4"))
    assert int(film.get(cv2.CAP_PROP_FRAME_COUNT)) == SHOWN
    assert film.get(cv2.CAP_PROP_FRAME_WIDTH) > SIZE
    assert (out / "report.html").read_text().count("data:image/jpeg") == 4


def test_videos_and_settings_that_exclude_each_other_are_reported(video, tmp_path):
    for count, words in ((9, "is shorter than the others"), (SHOWN, "another frame rate")):
        other = tmp_path / f"other{count}.avi"
        writer = cv2.VideoWriter(str(other), cv2.VideoWriter_fourcc(*"MJPG"), 50.0, (SIZE, SIZE))
        for _ in range(count):
            writer.write(np.zeros((SIZE, SIZE, 3), np.uint8))
        writer.release()
        assert words in error_of([video, other])
    assert "for a single camera" in error_of([video, other], matrix="700,700,64,64")
    assert "for a single camera" in error_of([video, other], scaled=True)
    (tmp_path / "a.npz").write_bytes(b"")
    assert "either videos, or files" in error_of([video, tmp_path / "a.npz"])
    assert "once per video" in error_of([video, other], points=3 * [tmp_path / "a.npz"])


@pytest.fixture(scope="module")
def two_views(made):
    """The same shapes before a second camera 45 degrees beside the first, with a little noise: (2, F, 2, P)."""
    path, shapes, first = made
    beside = rotations.exp(np.array([0, np.pi / 4, 0]))
    second = 1.3 * (beside @ path @ shapes)[:, :2] + 200
    return np.stack([first, second]) + 0.3 * np.random.default_rng(8).normal(size=(2, *first.shape))


def camera_error(arrays, made) -> float:
    path, shapes, _ = made
    truth, got = path @ shapes, arrays["rotation"] @ arrays["shape"]
    mirrored = got * np.array([1, 1, -1.0])[:, None]
    return min(np.linalg.norm(each - truth, axis=1).mean() for each in (got, mirrored)) / truth.std(2).mean()


@pytest.mark.slow
def test_tracks_of_several_cameras_in_one_file_are_of_the_same_points(tmp_path, made, two_views):
    arrays = read_arrays(recovered(write(tmp_path, tracks=two_views)) / "shapes.npz")
    assert camera_error(arrays, made) < 0.05
    shown = arrays["camera_from_first"][:, None] @ arrays["rotation"] @ arrays["shape"]
    modelled = arrays["camera_scale"][:, None, None, None] * shown[:, :, :2] + arrays["camera_translation"][..., None]
    np.testing.assert_allclose(modelled, arrays["modelled"])
    assert np.linalg.norm(modelled - two_views, axis=2).mean() < 2
    assert arrays["camera_scale"][1] == pytest.approx(1.3, rel=0.02)


@pytest.mark.slow
def test_points_of_several_files_are_matched_by_their_motion(tmp_path, made, two_views, rng):
    order = rng.permutation(POINTS)
    np.savez(tmp_path / "left.npz", tracks=two_views[0])
    np.savez(tmp_path / "right.npz", tracks=two_views[1][..., order])
    out = recovered([tmp_path / "left.npz", tmp_path / "right.npz"], tmp_path / "o")
    arrays = read_arrays(out / "shapes.npz")
    left, right = arrays["camera_points"]
    assert len(left) >= 0.9 * POINTS
    assert (order[right] == left).mean() >= 0.9
    assert arrays["labels"][0] == f"{left[0]}/{right[0]}"


def test_files_of_several_cameras_that_do_not_fit_are_reported(tmp_path, two_views, made):
    np.savez(tmp_path / "a.npz", tracks=two_views[0])
    np.savez(tmp_path / "b.npz", tracks=two_views[1][:-1])
    np.savez(tmp_path / "c.npz", points=made[1])
    a, b, c = (tmp_path / f"{name}.npz" for name in "abc")
    assert "same number of frames" in error_of([a, b])
    assert "points in space" in error_of([a, c])
    assert "the same name" in error_of([a, a])
    assert "for a single camera" in error_of([a, a], matrix="700,700,64,64")


LENS = np.array([-0.1, 0, 0, 0])
MATRIX = np.array([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]])


def before_camera(path, shapes):
    """Points (F, P, 3) at 2.5 m before a camera, the object about a quarter of a metre large."""
    return np.moveaxis(path @ shapes, 1, 2) / 800 + [0.1, 0, 2.5]


@pytest.fixture(scope="module")
def seen_by_rig(made):
    """Three calibrated cameras about the cluster, and what they see of it: (C, F, 2, P)."""
    path, shapes, _ = made
    cameras = []
    for name, turn in (("left", -0.5), ("middle", 0.0), ("right", 0.5)):
        pose = RigidTransform(rotations.exp(np.array([0, turn, 0])), np.array([0, 0, 2.5]))
        cameras.append(Camera(name=name, size=(640, 480), matrix=MATRIX, distortion=LENS, camera_from_world=pose))
    points = np.moveaxis(path @ shapes, 1, 2) / 800
    tracks = np.stack([np.moveaxis(camera.project(points), 2, 1) for camera in cameras])
    return Rig(tuple(cameras)), points, tracks + 0.2 * np.random.default_rng(4).normal(size=tracks.shape)


def test_calibrated_cameras_give_the_motion_in_metres(tmp_path, seen_by_rig):
    rig, points, tracks = seen_by_rig
    write_cameras_toml(rig, tmp_path / "cameras.toml")
    recovered(write(tmp_path, tracks=tracks), cameras=tmp_path / "cameras.toml", basis_shapes=3)
    arrays = read_arrays(tmp_path / "given_marey" / "shapes.npz")
    model = np.moveaxis(arrays["rotation"] @ arrays["shape"] + arrays["translation"][:, :, None], 1, 2)
    assert np.linalg.norm(model - points, axis=2).mean() < 3e-3
    assert (arrays["unit"], arrays["residual_unit"], arrays["metres_per_unit"]) == ("m", "px", 1)
    assert arrays["residuals"].shape == (3, FRAMES, POINTS)
    got = read_c3d(tmp_path / "given_marey" / "shapes.c3d").points
    np.testing.assert_allclose(got, model, atol=1e-5)


def test_a_calibration_that_does_not_fit_is_reported(tmp_path, seen_by_rig):
    rig, _, tracks = seen_by_rig
    cameras = tmp_path / "cameras.toml"
    write_cameras_toml(rig, cameras)
    text = error_of(write(tmp_path, tracks=tracks[:2]), cameras=cameras)
    assert "has 3 cameras, and the tracks are of 2" in text
    assert "have one" in error_of(write(tmp_path, tracks=tracks), cameras=cameras, distance=(0, 1, 1.0))
    np.savez(tmp_path / "left.npz", tracks=tracks[0])
    np.savez(tmp_path / "top.npz", tracks=tracks[1])
    text = error_of([tmp_path / "left.npz", tmp_path / "top.npz"], cameras=cameras)
    assert "left, middle, right, not left, top" in text
    text = error_of(write(tmp_path, tracks=tracks[[1, 0, 2]]), cameras=cameras)
    assert "not in the order of the tracks" in text


@pytest.mark.slow
def test_points_of_one_video_are_found_in_another_one(from_video, video):
    _, places = from_video
    second = film(video.with_name("beside.avi"), 0.25)
    out = recovered([video, second], video.with_name("both"), points=video.with_name("points.npz"), overlay=False)
    arrays = read_arrays(out / "shapes.npz")
    found = np.isfinite(arrays["camera_points_probability"][1])
    assert found.mean() > 0.6
    tracks = read_arrays(out / "tracks_beside.npz")["tracks"]
    x, y = places[:, 0].astype(int), places[:, 1].astype(int)
    truth = np.stack([[v[y, x] for v in seen_from(f, 0.25)] for f in range(SHOWN)])
    assert np.nanmedian(np.linalg.norm(tracks - truth, axis=1)) < 1.0
    assert not (out / "overlay_beside.mp4").exists()


@pytest.mark.slow
def test_known_intrinsics_give_the_shape_in_perspective(tmp_path, made):
    path, shapes, _ = made
    points = before_camera(path[:24], shapes[:24])
    pixels = points @ MATRIX.T
    tracks = np.moveaxis(pixels[..., :2] / pixels[..., 2:], 2, 1)
    np.savez(tmp_path / "camera.npz", matrix=MATRIX)
    given = write(tmp_path, tracks=tracks + 0.1 * np.random.default_rng(2).normal(size=tracks.shape))
    arrays = read_arrays(recovered(given, matrix=tmp_path / "camera.npz") / "shapes.npz")
    assert arrays["kind"] == "one camera, full perspective"
    placed = arrays["rotation"] @ arrays["shape"] + arrays["translation"][:, :, None]
    shown = MATRIX @ placed
    np.testing.assert_allclose(shown[:, :2] / shown[:, 2:], arrays["modelled"][0], atol=1e-6)
    assert np.median(arrays["residuals"]) < 5
    scale = np.linalg.norm(shapes[:24] / 800) / np.linalg.norm(arrays["shape"])
    away = np.linalg.norm(scale * (placed - placed.mean(2, keepdims=True)) - path[:24] @ shapes[:24] / 800, axis=1)
    assert away.mean() < 0.3 * shapes.std() / 800


@pytest.mark.slow
def test_one_calibrated_camera_gives_its_matrix_and_lens(tmp_path, seen_by_rig):
    rig, _, tracks = seen_by_rig
    write_cameras_toml(rig, tmp_path / "cameras.toml")
    np.savez(tmp_path / "middle.npz", tracks=tracks[1, :24])
    out = recovered(tmp_path / "middle.npz", cameras=tmp_path / "cameras.toml")
    arrays = read_arrays(out / "shapes.npz")
    assert arrays["kind"] == "one camera, full perspective"
    # The model is shown through the lens: it lies on the tracks as they were given.
    assert np.linalg.norm(arrays["modelled"][0] - tracks[1, :24], axis=1).mean() < 5

import json

import cv2
import numpy as np
import pytest
from tests import scenes
from tests.pages import linked_files
from tests.scenes import beside_ball
from tests.verdicts import agreed_verdict

from marey.errors import FileProblem, MareyError, SettingProblem
from marey.io.calibration.readers import read_rig, write_cameras_toml
from marey.io.shapes.measured_surface import read_surface
from marey.io.shapes.trajectories import read_trajectories
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.surface.tasks import measure_surface
from marey.pipelines.verdict import NotUsable

RIG = scenes.rig(-10, 0, 10)


def measured(folder, *, progress=None, **settings):
    """Measure, with the warnings recorded instead of issued: stills have no rate."""
    return measure_surface(folder, progress=progress or RecordingProgress(), **settings)


class Reports(RecordingProgress):
    """Keeps the intermediate results."""

    def __init__(self):
        super().__init__()
        self.reports: list[str] = []

    def report(self, text: str) -> None:
        self.reports.append(text)


def write_trial(folder, frames, rig=RIG):
    """Stills of instants, each a list of images."""
    folder.mkdir(parents=True, exist_ok=True)
    write_cameras_toml(rig, folder / "cameras.toml")
    for number, images in enumerate(frames, start=1):
        for camera, image in zip(rig, images, strict=True):
            cv2.imwrite(str(folder / f"{camera.name}_{number}.png"), image)
    return folder


@pytest.fixture(scope="module")
def instants():
    rng = np.random.default_rng(11)
    return [scenes.films(RIG, rng) for _ in range(2)]


@pytest.fixture(scope="module")
def results(instants, tmp_path_factory):
    folder = write_trial(tmp_path_factory.mktemp("trial"), instants)
    measured(folder, out=folder / "marey", spacing=6)
    return folder / "marey"


@pytest.mark.slow
def test_all_frames_are_measured_and_every_file_is_there(results):
    points = read_surface(results / "surface.npz")
    assert points.frames.tolist() == [0, 1]
    assert points.camera_names == RIG.names
    assert np.median(np.abs(beside_ball(points.points))) < 0.6e-3
    names = {str(path.relative_to(results)) for path in results.rglob("*") if path.is_file()}
    clouds = {"surface.ply", "surface/frame_00000.ply", "surface/frame_00001.ply"}
    # The two instants show different balls: hardly anything is followed, and perhaps nothing is drawn.
    names -= {"tracks_middle.png"}
    assert names == {"surface.npz", "surface_middle.png", "surface.html", "run.json", "trajectories.npz", *clouds}


@pytest.mark.slow
def test_points_are_followed_from_frame_to_frame(tmp_path, rng):
    ball = scenes.Ball.draw(rng)
    instants = [[ball.filmed(camera, rng) for camera in RIG] for _ in range(2)]
    folder = write_trial(tmp_path / "trial", instants)
    measured(folder, out=folder / "marey", spacing=6, refine_rig=False)
    found = read_trajectories(folder / "marey" / "trajectories.npz")
    assert found.camera_names == RIG.names
    assert (folder / "marey" / "tracks_middle.png").exists()
    position = np.asarray(found.position[:, found.kept], float)
    both = np.isfinite(position[..., 0]).all(axis=0)
    assert both.sum() > 500
    # The ball does not move.
    assert np.median(np.linalg.norm(position[1, both] - position[0, both], axis=1)) < 0.6e-3


@pytest.mark.slow
def test_there_are_no_tracks_of_a_single_instant_or_if_they_are_switched_off(instants, tmp_path):
    folder = write_trial(tmp_path / "trial", instants)
    for more in ({"tracks": False}, {"frames": range(1)}):
        found = measured(folder, spacing=12, refine_rig=False, **more)
        assert found.trajectories is None
        assert not (found.folder / "trajectories.npz").exists()
    with pytest.raises(SettingProblem, match="speed"):
        measured(folder, max_speed=-1)


def test_the_record_names_templates_and_settings(results):
    record = json.loads((results / "run.json").read_text())
    assert record["command"] == "surface"
    agreed_verdict(results / "run.json", page=results / "surface.html")
    assert record["settings"]["compared"] == [{"template": "middle", "searched": ["left", "right"]}]
    assert record["settings"]["rig_correction"] is None
    page = (results / "surface.html").read_text()
    assert "middle matched with left, right" in page
    assert "{&#39;" not in page
    linked = set(linked_files(results / "surface.html"))
    assert {"surface_middle.png", "surface/"} < linked


@pytest.mark.slow
def test_another_commands_results_stay(results):
    record = json.loads((results / "run.json").read_text())
    (results / "motion.npz").write_bytes(b"captured")
    kept = {"command": "capture", "files": ["motion.npz", "run.json"]}
    (results / "run.json").write_text(json.dumps(kept | {"earlier": {"surface": record}}))
    measured(results.parent, out=results, spacing=12, frames=range(1, 2))
    assert (results / "motion.npz").exists()
    assert not (results / "surface" / "frame_00000.ply").exists()
    assert json.loads((results / "run.json").read_text())["earlier"]["capture"] == kept


@pytest.mark.slow
def test_cameras_that_nod_are_corrected_and_it_is_reported(instants, tmp_path):
    from tests.surface.points.test_refine_rig import turned

    wrong = type(RIG)((*RIG.cameras[:2], turned(RIG.cameras[2], 0.12)))
    folder = write_trial(tmp_path / "trial", instants[:1], wrong)
    progress = Reports()
    measured(folder, out=folder / "marey", spacing=6, progress=progress)
    assert progress.reports[0].startswith("The cameras were corrected by")
    assert read_rig(folder / "marey" / "corrected_cameras.toml").names == RIG.names
    found = json.loads((folder / "marey" / "run.json").read_text())["settings"]["rig_correction"]
    residual = found["median_residual_px"]
    assert residual["corrected"] < 0.6 * residual["as_calibrated"]
    assert 0.05 < found["cameras"]["right"]["turned_deg"] < 0.2


@pytest.mark.slow
def test_an_interrupted_run_is_resumed(instants, tmp_path, monkeypatch):
    from marey.pipelines.surface import stages as surface_stages

    folder = write_trial(tmp_path / "trial", instants)
    whole, calls = surface_stages.intersect, []

    def interrupted(*arguments, **more):
        calls.append(more["frame"])
        if more["frame"] == 1 and calls.count(1) == 1:
            raise KeyboardInterrupt
        return whole(*arguments, **more)

    monkeypatch.setattr(surface_stages, "intersect", interrupted)
    with pytest.raises(KeyboardInterrupt):
        measured(folder, out=folder / "marey", spacing=12, refine_rig=False)
    measured(folder, out=folder / "marey", spacing=12, refine_rig=False)
    assert sorted(calls) == [0, 1, 1]  # both frames at the same time, and the second one again
    assert read_surface(folder / "marey" / "surface.npz").frames.tolist() == [0, 1]


@pytest.mark.slow
def test_what_was_measured_before_a_damaged_image_is_kept(instants, tmp_path):
    folder = write_trial(tmp_path / "trial", instants)
    (folder / "right_2.png").write_bytes(b"no image")
    with pytest.raises(MareyError, match=r"right_2\.png"):
        measured(folder, out=folder / "marey", spacing=12)
    assert read_surface(folder / "marey" / "surface.npz").frames.tolist() == [0]


@pytest.mark.parametrize("kind", ["other balls", "flat", "far apart"])
def test_without_a_common_surface_there_is_a_reason_and_no_file(tmp_path, rng, kind):
    rig = scenes.rig(0, 90, 180) if kind == "far apart" else scenes.rig(-5, 5)
    ball = scenes.Ball.draw(rng)
    balls = [ball if kind == "far apart" else scenes.Ball.draw(rng) for _ in rig]
    images = [(each.flat() if kind == "flat" else each).filmed(c, rng) for each, c in zip(balls, rig, strict=True)]
    if kind == "flat":
        images = [np.full_like(image, 90) for image in images]
    folder = write_trial(tmp_path / "trial", [images], rig)
    wrong = {"other balls": "no surface that", "flat": "too little texture", "far apart": "differ by less"}
    expected = FileProblem if kind == "far apart" else NotUsable
    with pytest.raises(expected, match=wrong[kind]):
        measured(folder, out=folder / "marey", spacing=6)
    assert not (folder / "marey" / "surface.npz").exists()


@pytest.mark.slow
def test_exchanged_cameras_are_named(tmp_path, rng):
    rig = type(RIG)(tuple(scenes.camera_at(name, 8 * k, height=0.3 * k) for k, name in enumerate(("one", "two"))))
    folder = write_trial(tmp_path / "trial", [scenes.films(rig, rng)[::-1]], rig)
    verdict = measured(folder, out=folder / "marey", spacing=6).verdict
    assert not verdict.usable
    assert (verdict.reasons[0].cause, verdict.reasons[0].cameras) == ("exchanged", ("one", "two"))


def test_a_seed_outside_of_its_image_names_file_and_row(instants, tmp_path):
    folder = write_trial(tmp_path / "trial", instants[:1])
    (tmp_path / "clicked.csv").write_text("100,100,100,100,100,100\n100,100,900,100,100,100\n")
    with pytest.raises(MareyError, match=r"clicked\.csv.*row 2"):
        measured(folder, seeds=tmp_path / "clicked.csv")


def test_an_impossible_setting_is_reported_before_the_trial_is_read(tmp_path):
    with pytest.raises(SettingProblem, match="patch is 12"):
        measured(tmp_path / "nowhere", patch=12)

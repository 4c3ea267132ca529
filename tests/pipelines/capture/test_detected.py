"""The person whose joints a detector found: who is followed, and what is said about it."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from tests import worlds
from tests.detected import JOINTS, detections, openpose, write_folder

from marey.body.articulation.pose import PosedBody
from marey.cameras.rig import Rig
from marey.errors import FileProblem, SettingProblem
from marey.fit.recipes.detections import PersonDetections
from marey.fit.recipes.person import PersonSettings
from marey.fit.recipes.seen_people import PersonTrack, find_people
from marey.io.trial.person_choice import parse_person
from marey.pipelines.capture import capture
from marey.pipelines.capture.begun import CLEARLY_BETTER, better_start
from marey.pipelines.capture.detected import DetectedPerson, detected_person
from marey.pipelines.capture.run import Bodies
from marey.pipelines.progress import RecordingProgress

CAMERAS = worlds.ring(3, size=(400, 240))
COUNT = 8


class Heard(RecordingProgress):
    """Keeps what is reported."""

    def __init__(self):
        super().__init__()
        self.reports: list[str] = []

    def report(self, text):
        self.reports.append(text)


def run_of(folder, *, first=0, end=COUNT, follow=None, start=None):
    take = SimpleNamespace(count=COUNT, first=first, end=end, rate=worlds.RATE, common=None, late=None)
    return SimpleNamespace(
        trial=SimpleNamespace(
            keypoints=folder, rig=Rig(CAMERAS), take=take, follow=follow, start=start, file_names={}, masks={},
            background={}, folder=folder,
        ),
        progress=Heard(), captured={}, times=None,
    )  # fmt: skip


def person(at, frames):
    body = worlds.person()
    return [PosedBody(body, worlds.pose(body, at=(*at, 0))) if f in frames else None for f in range(COUNT)]


@pytest.fixture
def folder(tmp_path):
    """One person in frames 0 to 6, of whom frame 3 shows most; another one, more clearly seen, in the last four."""
    longer, shorter = person((0.4, 0.0), range(7)), person((-0.5, 0.3), range(4, 8))
    pixels, _ = detections([longer, shorter], CAMERAS)
    pixels[[0, 1, 2, 4, 5, 6], :, 0, JOINTS.index("left_wrist")] = np.nan
    frames = [
        [[openpose(p, c) for p, c in zip(view, (0.5, 0.9), strict=True) if np.isfinite(p).any()] for view in views]
        for views in pixels
    ]
    return write_folder(tmp_path / "pose", [camera.name for camera in CAMERAS], frames), pixels


def test_without_key_points_there_is_nobody():
    assert detected_person(run_of(None)) is None


def test_the_person_who_is_seen_longest_is_followed_and_reported(folder):
    path, pixels = folder
    run = run_of(path)
    found = detected_person(run)
    assert found is not None
    assert [seen.frame for seen in found.track.seen] == list(range(7))
    own = [j for j, name in enumerate(JOINTS) if name not in ("neck", "head", "left_toe", "right_toe")]
    np.testing.assert_allclose(found.joints.pixels[:7][:, :, own], pixels[:7, :, 0][:, :, own], atol=1e-9)
    assert np.isnan(found.joints.pixels[7]).all()
    assert run.progress.reports == [
        "Key points (Halpe-26): 2 people; number 1 (frames 0 to 6) is followed. --person follows another one, "
        "--people all everybody; --list-people shows them"
    ]


@pytest.mark.parametrize("text", ["2", "-0.5,0.3,0@6"])
def test_another_person_is_followed_by_number_or_place(folder, text):
    path, _ = folder
    run = run_of(path, follow=parse_person(text))
    found = detected_person(run)
    assert found is not None
    assert [seen.frame for seen in found.track.seen] == list(range(4, 8))
    assert "number 2 (frames 4 to 7) is followed" in run.progress.reports[0]


def test_a_click_follows_the_person_whom_it_shows(folder):
    path, pixels = folder
    for p, frames in ((0, range(7)), (1, range(4, 8))):
        x, y = np.nanmean(pixels[5, 1, p], axis=0)
        found = detected_person(run_of(path, follow=parse_person(f"cam02:{x:.0f},{y:.0f}@5")))
        assert found is not None
        assert [seen.frame for seen in found.track.seen] == list(frames)


def clicks_of(pixels, path, *, frame=6, away=(0.0, 0.0)):
    """Clicks of two joints of the second person, apart from where the detector found them."""
    clicks: dict = {"frame": frame}
    for c, camera in enumerate(CAMERAS):
        found = {n: pixels[6, c, 1, JOINTS.index(n)] + away for n in ("left_hip", "right_shoulder")}
        clicks[camera.name] = {n: pixel.tolist() for n, pixel in found.items()}
    path.write_text(json.dumps(clicks))
    return path


def test_the_joints_of_the_start_choose_the_person_and_replace_those_of_the_detector(folder, tmp_path):
    path, pixels = folder
    file = clicks_of(pixels, tmp_path / "clicks.json", away=(0.5, -0.5))
    found = detected_person(run_of(path, start=file))
    assert found is not None
    assert found.track.seen[0].frame == 4
    assert found.start == 6
    hip, knee = JOINTS.index("left_hip"), JOINTS.index("left_knee")
    np.testing.assert_allclose(found.joints.pixels[6, :, hip], pixels[6, :, 1, hip] + (0.5, -0.5), atol=1e-3)
    np.testing.assert_allclose(found.joints.pixels[6, :, knee], pixels[6, :, 1, knee], atol=1e-3)
    np.testing.assert_allclose(found.joints.pixels[7, :, hip], pixels[7, :, 1, hip], atol=1e-3)
    assert found.joints.agreeing[6, :, hip].all()


def test_a_person_whom_the_detector_missed_in_the_frame_of_the_start_is_there(folder, tmp_path):
    path, pixels = folder
    file = clicks_of(pixels, tmp_path / "clicks.json")
    for camera in CAMERAS:
        (path / f"{camera.name}_json" / f"{camera.name}_000006.json").unlink()
    found = detected_person(run_of(path, start=file))
    assert found is not None
    assert found.start == 6
    [seen] = [each for each in found.track.seen if each.frame == 6]
    assert (seen.persons == -1).all()
    assert np.isfinite(seen.points[JOINTS.index("left_hip")]).all()


def test_the_start_of_another_person_than_the_named_one_is_not_used(folder, tmp_path):
    path, pixels = folder
    found = detected_person(run_of(path, follow=parse_person("1"), start=clicks_of(pixels, tmp_path / "clicks.json")))
    assert found is not None
    assert found.start is None
    assert found.track.seen[0].frame == 0


def test_a_start_where_nobody_is_is_one_clear_line(folder, tmp_path):
    path, pixels = folder
    file = clicks_of(pixels, tmp_path / "clicks.json", frame=1)
    with pytest.raises(FileProblem, match=r"at a place where nobody was found \(people in frame 1: 1 at"):
        detected_person(run_of(path, start=file))


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("3", "there are only 2 people"),
        ("cam02:1,1@5", r"nobody was found in this part of the image \(people in frame 5: 1 at .*, 2 at .*\)"),
        ("cam02:0,0,9,9@5", "nobody was found in this part of the image"),
        ("4,4,0@1", r"nobody was found in this place \(people in frame 1: 1 at"),
        ("4,4,0", "nobody was found near this place in any frame"),
    ],
)
def test_a_choice_of_nobody_is_one_clear_line(folder, text, wrong):
    with pytest.raises(SettingProblem, match=wrong) as problem:
        detected_person(run_of(folder[0], follow=parse_person(text)))
    assert "--list-people shows everybody" in str(problem.value)


def test_other_people_are_known_where_they_are(folder):
    found = detected_person(run_of(folder[0]))
    assert found is not None
    assert {frame for frame, _ in found.others.figures} == set(range(4, 7)) | {7}
    assert not found.elsewhere.any()
    with_one_captured = run_of(folder[0])
    with_one_captured.captured[2] = None
    again = detected_person(with_one_captured)
    assert again is not None
    assert again.others.figures == {}


def test_only_the_frames_of_the_run_count(folder):
    path, pixels = folder
    run = run_of(path, first=5, end=8)
    found = detected_person(run)
    assert found is not None
    # In frames 5 to 7 the other person is seen three times, this one twice.
    assert [seen.frame for seen in found.track.seen] == [5, 6, 7]
    hip = JOINTS.index("left_hip")
    np.testing.assert_allclose(found.joints.pixels[5:, :, hip], pixels[5:, :, 1, hip], atol=1e-9)


def test_the_clearest_frame_has_most_agreeing_joints(folder):
    found = detected_person(run_of(folder[0]))
    assert found is not None
    assert found.clearest(range(COUNT)) == 3
    assert found.clearest([5, 6, 7]) in (5, 6)
    assert found.clearest([7]) is None
    agreeing = found.agreeing_pixels(0)
    wrist = JOINTS.index("left_wrist")
    assert np.isnan(agreeing[:, wrist]).all()
    assert np.isfinite(np.delete(agreeing, wrist, axis=1)).all()


def test_key_points_of_another_recording_are_named(tmp_path):
    rng = np.random.default_rng(0)
    frames = [[[openpose(rng.uniform(0, 240, (len(JOINTS), 2)))] for _ in CAMERAS] for _ in range(COUNT)]
    path = write_folder(tmp_path / "pose", [camera.name for camera in CAMERAS], frames)
    with pytest.raises(FileProblem, match="pose: has no person about whose joints two cameras agree"):
        detected_person(run_of(path))


def test_few_joints_about_which_cameras_agree_are_reported(tmp_path):
    rng = np.random.default_rng(0)
    pixels, _ = detections([person((0.4, 0.0), range(COUNT))], CAMERAS)
    pixels[3:] = rng.uniform(0, 240, pixels[3:].shape)
    frames = [[[openpose(view[0])] for view in views] for views in pixels]
    run = run_of(write_folder(tmp_path / "pose", [camera.name for camera in CAMERAS], frames))
    detected_person(run)
    assert any("agree about only" in warning for warning in run.progress.warnings)


@pytest.fixture
def start():
    """A run with silhouettes and key points of one frame, the start from the key points, and that person."""
    body = worlds.person()
    posed = PosedBody(body, worlds.pose(body))
    pixels, confidence = detections([[posed]], CAMERAS)
    [track] = find_people(CAMERAS, pixels, confidence, rate=worlds.RATE)
    detected = DetectedPerson(PersonDetections.of_track(CAMERAS, JOINTS, pixels, confidence, track), track)
    run = SimpleNamespace(trial=SimpleNamespace(rig=Rig(CAMERAS)), person=PersonSettings())
    take, bodies = worlds.take([posed], CAMERAS), Bodies(body, body)
    found = better_start(run, take, bodies, None, detected)
    assert found is not None
    return run, take, bodies, detected, found


def test_without_a_start_from_silhouettes_that_from_key_points_is_used(start):
    frame, candidate = start[-1]
    assert frame == 0
    assert candidate.score > 0.85


@pytest.mark.slow
def test_a_start_from_key_points_must_be_clearly_better(start):
    run, take, bodies, detected, (_, own) = start
    for gain, better in ((0.5 * CLEARLY_BETTER, False), (2 * CLEARLY_BETTER, True)):
        other = 0, replace(own, score=own.score - gain)
        found = better_start(run, take, bodies, other, detected)
        assert found is not None
        assert (found is not other) == better
        assert found[1].score == pytest.approx(own.score if better else own.score - gain)


def test_without_key_points_in_its_frames_the_start_stays(start):
    run, take, bodies, detected, found = start
    assert better_start(run, take, bodies, found, None) is found
    elsewhere = replace(take, frames=(7,))
    assert better_start(run, elsewhere, bodies, found, detected) is found


@pytest.mark.parametrize(("people", "plates", "by_joints"), [(1, 0, True), (1, 3, False), (2, 3, True), (2, 0, True)])
def test_with_several_people_key_points_give_the_poses_also_with_images_of_the_empty_room(
    monkeypatch, people, plates, by_joints
):
    found = SimpleNamespace(people=people, joints=None)
    monkeypatch.setattr(capture, "detected_person", lambda run: found)
    monkeypatch.setattr(capture, "follow_detected", lambda *_: "by joints")
    monkeypatch.setattr(capture, "with_open_limbs", lambda run, bodies, followed, detected: followed)
    monkeypatch.setattr(capture, "MaskStore", lambda *_: "by silhouettes")
    monkeypatch.setattr(capture, "model_backgrounds", lambda *_: (_ for _ in ()).throw(InterruptedError))
    take = SimpleNamespace(first=0)
    background = {camera.name: None for camera in CAMERAS[:plates]}
    trial = SimpleNamespace(masks={}, background=background, rig=Rig(CAMERAS), take=take)
    run = SimpleNamespace(trial=trial, progress=Heard(), further=None, moved=None)
    logs = SimpleNamespace(outlines=None, first=None)
    if by_joints:
        assert capture.follow_person(run, None, logs) == "by joints"
    else:
        with pytest.raises(InterruptedError):
            capture.follow_person(run, None, logs)


@pytest.fixture
def agreeing():
    """(F, C, J): two of three cameras agree about all joints of all frames."""
    seen = np.zeros((COUNT, len(CAMERAS), len(JOINTS)), bool)
    seen[:, :2] = True
    return seen


def seen_by(agreeing) -> DetectedPerson:
    shape = agreeing.shape
    found = PersonDetections(
        cameras=CAMERAS, joint_names=JOINTS, pixels=np.zeros((*shape, 2)), confidence=np.ones(shape), agreeing=agreeing,
        elsewhere=np.zeros(shape[:2], bool),
    )  # fmt: skip
    return DetectedPerson(found, PersonTrack())


def test_a_limb_is_open_where_fewer_than_two_cameras_agree_about_one_of_its_joints_for_some_time(agreeing):
    agreeing[2:7, 1, JOINTS.index("left_wrist")] = False
    agreeing[:, 1, JOINTS.index("neck")] = False
    agreeing[4:8, :, JOINTS.index("right_ankle")] = False
    poses = dict.fromkeys(range(COUNT))
    found = seen_by(agreeing).open_limbs(poses, 3.0)
    assert found == {"left_arm": [[2, 3, 4, 5, 6]], "right_leg": [[4, 5, 6, 7]]}
    assert seen_by(agreeing).open_limbs(poses, 4.0) == {"left_arm": [[2, 3, 4, 5, 6]]}
    del poses[4]
    assert seen_by(agreeing).open_limbs(poses, 2.0) == {"right_leg": [[5, 6, 7]]}

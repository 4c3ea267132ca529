"""The first estimate of the motion where nothing is given but the videos and the calibration."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from tests import worlds
from tests.pipelines.capture.reach import EMPTY, copy_half_trial, give_start, truth
from tests.regions import WORDS, painted
from tests.walking_take import walking_take

from marey.body.articulation.pose import Pose, PosedBody
from marey.fit.regions.limb_repair import repaired_limbs
from marey.fit.regions.places import PlaceSettings
from marey.fit.regions.region_search import NO_EVIDENCE, RegionSearch, thinned
from marey.fit.regions.region_track import RegionTrack, RegionTracker, RegionTrackSettings
from marey.geometry import rotations
from marey.pipelines.capture import by_regions, tasks, without_plate
from marey.pipelines.people.other_regions import OtherRegions
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.silhouettes import small_take
from marey.pipelines.silhouettes.small_take import SmallTake
from marey.pipelines.verdict import NotUsable

QUICK = RegionTrackSettings(
    places=PlaceSettings(step=0.3, coarse_step=0.6, height_step=0.3, below=1.2, postures=(0, 8), headings=2),
    frames=2, headings=4, kept=2, limb_directions=16, whole_shares=(0.3, 0.1), starts=1, window=0.1,
    shape_numbers=1, shape_steps=(1.0,),
)  # fmt: skip
"""Settings of a search that suffices for a person who stands with hanging arms."""


@pytest.fixture
def take(rng) -> tuple[SmallTake, RegionTrack, np.ndarray]:
    return walking_take(rng)


def test_both_facings_are_followed_until_the_scores_decide():
    frames = range(10)

    def scored(*scores):
        return RegionTrack(thinned(worlds.person()), {}, dict(zip(frames, scores, strict=True)), np.zeros(0))

    def shown(track):
        return replace(track, poses=dict.fromkeys(frames))

    # The first two frames show nobody: what the tracks score there does not count.
    front, back = shown(scored(0.1, 0.1, *[4.0] * 8)), shown(scored(0.9, 0.9, *[3.95] * 8))
    assert by_regions._undecided([back, front], 0.4) == [1, 0]
    assert by_regions._undecided([shown(scored(0.9, 0.9, *[3.6] * 8)), front], 0.4) == [1]


def test_only_tracks_that_face_opposite_ways_leave_the_facing_open():
    def facing(*headings):
        turns = [rotations.about(np.array([0.0, 0.0, 1.0]), heading) for heading in headings]
        poses = {frame: Pose(np.zeros(3), turn, np.zeros(1)) for frame, turn in enumerate(turns)}
        return RegionTrack(thinned(worlds.person()), poses, {}, np.zeros(0))

    track = facing(0.0, 0.1, 0.2)
    assert by_regions._opposed([track, facing(3.0, 3.1, 0.2)])
    assert not by_regions._opposed([track, facing(0.3, 0.4, 3.0)])
    assert not by_regions._opposed([track])


def test_a_limb_that_was_lost_in_a_whole_track_is_found_by_the_colours_of_the_other_side(monkeypatch):
    monkeypatch.setattr(by_regions, "repaired_limbs", partial(repaired_limbs, only=("left_arm", "right_arm")))
    body, cameras = thinned(worlds.person()), tuple(worlds.ring(size=(110, 120), focal=130.0))
    poses, rng = dict(enumerate(worlds.swing(body, 3))), np.random.default_rng(4)
    images = {frame: painted(PosedBody(body, pose), cameras, rng) for frame, pose in poses.items()}
    tracker = RegionTracker(RegionSearch(cameras, WORDS), images.__getitem__, tuple(poses), 30.0)
    lift, lost = body.skeleton.coordinate_names.index("left_shoulder_lift") - 6, {}
    for frame, pose in poses.items():
        angles = np.array(pose.angles)
        angles[lift] += 1.2
        lost[frame] = replace(pose, angles=angles)
    # The score of the last frame shows nobody, and its pose remains.
    scores = dict.fromkeys(poses, 1.0) | {2: -1.0}
    called: list[int] = []
    track = RegionTrack(body, lost, scores, np.zeros(0))
    found = by_regions._with_replaced_limbs(tracker, track, progress=called.append)
    wrist = body.skeleton.segment("left_hand")

    def away(frame: int, pose: Pose) -> float:
        origins = [PosedBody(body, each).segment_origin[wrist] for each in (pose, poses[frame])]
        return float(np.linalg.norm(origins[0] - origins[1]))

    assert called
    assert list(found.poses) == list(poses)
    for frame in range(2):
        # Three pixels of the images.
        assert away(frame, found.poses[frame]) < 0.075 < 0.3 < away(frame, lost[frame])
    np.testing.assert_array_equal(found.poses[2].angles, lost[2].angles)


@pytest.mark.slow
def test_a_person_at_no_common_place_of_the_cameras_is_not_usable(tmp_path, monkeypatch):
    folder = copy_half_trial(tmp_path / "reach")
    (folder / "background").rename(tmp_path / "background")
    monkeypatch.setattr(RegionTracker, "start", lambda *args, **settings: None)
    shown, progress = range(EMPTY, EMPTY + 2), RecordingProgress()
    with pytest.raises(NotUsable, match=r"No two cameras of .*cameras\.toml"):
        tasks.capture(folder, frames=shown, overlay=False, out=tmp_path / "results", progress=progress)


def search_quickly(monkeypatch):
    monkeypatch.setattr(by_regions, "RegionTracker", partial(RegionTracker, settings=QUICK))
    monkeypatch.setattr(without_plate, "MOST_ROUNDS", 2)
    monkeypatch.setattr(without_plate, "REPAIRED_ROUNDS", (1,))
    monkeypatch.setattr(small_take, "SHORT_SIDE", 96)


def mean_error(out: Path, shown: range) -> float:
    """Mean distance of the joints of the limbs, all of whose frames are measured [m]."""
    names, joints = truth()
    with np.load(out / "motion.npz") as motion:
        assert (motion["state"][shown] == 1).all()
        limbs = [i for i, n in enumerate(motion["joint_names"]) if n.endswith(("knee", "elbow", "ankle", "wrist"))]
        own = [names.index(str(motion["joint_names"][i])) for i in limbs]
        first = shown.start - EMPTY
        wanted = joints[first : first + len(shown), own]
        return float(np.linalg.norm(motion["joint_centres"][shown][:, limbs] - wanted, axis=2).mean())


@pytest.mark.slow
def test_a_person_is_followed_with_nothing_but_the_videos_and_the_calibration(tmp_path: Path, monkeypatch):
    folder = copy_half_trial(tmp_path / "reach")
    (folder / "background").rename(tmp_path / "background")
    search_quickly(monkeypatch)
    shown = range(EMPTY, EMPTY + 4)
    progress = RecordingProgress()
    tasks.capture(folder, frames=shown, overlay=False, out=tmp_path / "results", progress=progress)
    assert "found by colours and motion" in progress.warnings[0]
    assert {"Other people", "Search for a lost person", "Search for lost limbs"} <= set(progress.timings)
    # A person who is lost, or faces the other way, is off by 200 mm and more.
    assert mean_error(tmp_path / "results", shown) < 0.08


@pytest.mark.slow
def test_given_joints_take_the_place_of_the_search(tmp_path: Path, monkeypatch):
    folder = copy_half_trial(tmp_path / "reach")
    for name in ("cam01.png", "cam03.png"):
        (folder / "background" / name).unlink()
    search_quickly(monkeypatch)
    monkeypatch.setattr(RegionTracker, "start", None)
    monkeypatch.setattr(by_regions, "find_other_people", lambda *args, **settings: [])
    shown, progress = range(EMPTY + 40, EMPTY + 44), RecordingProgress()
    tasks.capture(
        folder, frames=shown, overlay=False, out=tmp_path / "results", progress=progress,
        start=give_start(folder, shown[1]),
    )  # fmt: skip
    assert "no images of the empty room for cam01, cam03: the person is followed by colours" in progress.warnings[0]
    assert mean_error(tmp_path / "results", shown) < 0.04


def test_without_open_limbs_nothing_is_searched():
    followed = SimpleNamespace(tracked=SimpleNamespace(poses={}))
    trial = SimpleNamespace(take=SimpleNamespace(rate=worlds.RATE))
    run = SimpleNamespace(trial=trial, person=SimpleNamespace(bridge=0.2))
    detected = SimpleNamespace(open_limbs=lambda frames, longest: {})
    assert by_regions.with_open_limbs(run, None, followed, detected) is followed


def test_other_people_are_no_evidence_where_limbs_of_one_of_several_people_are_searched(take, monkeypatch):
    small, track, _ = take
    cameras = [camera.scaled(2.0) for camera in small.cameras]
    box = np.zeros((cameras[1].height, cameras[1].width), bool)
    box[20:60, 30:70] = True

    def regions(frame, number, camera, place):
        np.testing.assert_allclose(place, PosedBody(track.body, track.poses[frame]).segment_origin.mean(axis=0))
        return OtherRegions(box, np.zeros_like(box), 0.0) if number == 1 else None

    def searched(run, bodies, reduced, drawn, number, images_of):
        return images_of(small, track)(4)

    monkeypatch.setattr(by_regions, "_with_lost_limbs", searched)
    run = SimpleNamespace(trial=SimpleNamespace(rig=cameras))
    drawn = SimpleNamespace(others=SimpleNamespace(regions=regions))
    found, plain = by_regions.search_for_limbs(run, None)(drawn, 2), small.images_of(4)
    covered = np.zeros(plain.words.shape, bool)
    covered[1, 10:30, 15:35] = True
    np.testing.assert_array_equal(found.words == NO_EVIDENCE, covered)
    np.testing.assert_array_equal(found.evidence, np.where(covered, 0, plain.evidence))
    alone = by_regions.search_for_limbs(run, None)(SimpleNamespace(others=None), 2)
    np.testing.assert_array_equal(alone.words, plain.words)

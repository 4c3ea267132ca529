"""A tracked person as arrays; tracks of its surface: their images, their terms, and what is reported of them."""

from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.body.people.person import person_body
from marey.fit.patches.kept_patches import KeptPatches
from marey.fit.patches.surface_tracks import SurfaceTracks
from marey.fit.recipes.frame_observations import FrameObservations
from marey.fit.recipes.person import PersonSettings
from marey.fit.recipes.sequence_equations import LocalTerms
from marey.fit.search.search import Search
from marey.io.stages import load_arrays, save_arrays
from marey.pipelines.capture import tracked
from marey.pipelines.capture.settings import CaptureSettings
from marey.pipelines.capture.tracked import (
    TrialImages,
    pack_candidates,
    pack_tracked,
    track_patches,
    tracks_text,
    unpack_tracked,
    with_placed_hips,
)
from marey.pipelines.progress import RecordingProgress


def test_poses_scores_and_sizes_are_the_same_after_saving(tmp_path, rng):
    body = worlds.person()
    body = body.with_numbers(0.3 * rng.normal(size=len(body.space)))
    poses = {frame: worlds.pose(body, yaw=0.1 * frame, at=(0.01 * frame, 0, 0)) for frame in (3, 4, 9)}
    scores = {3: 0.9, 4: 0.8, 9: 0.95}
    save_arrays(tmp_path / "tracked.npz", pack_tracked(poses, body, scores))
    found = unpack_tracked(load_arrays(tmp_path / "tracked.npz"), worlds.person())
    assert found.scores == scores
    np.testing.assert_allclose(found.body.vertices, body.vertices, atol=1e-12)
    assert list(found.poses) == list(poses)
    for frame, pose in poses.items():
        np.testing.assert_array_equal(found.poses[frame].angles, pose.angles)
        np.testing.assert_array_equal(found.poses[frame].translation, pose.translation)
        np.testing.assert_allclose(found.poses[frame].rotation, pose.rotation, atol=1e-12)


def test_candidates_are_packed_with_their_scores():
    body = worlds.scan()
    posed = PosedBody(body, worlds.pose(body))
    take = worlds.take([posed], worlds.ring(2))
    candidate = Search(take.levels(160.0).at(0), PersonSettings().start).judge(posed)
    arrays = pack_candidates({5: candidate}, body)
    assert arrays["frames"].tolist() == [5]
    assert arrays["score"].tolist() == [candidate.score]


def placing(body, **lengths):
    """Place the hips of a tracked body with lengths in the settings of its trial; its body, and the warnings."""
    settings = SimpleNamespace(**({"leg_length_m": None, "asis_distance_m": None} | lengths))
    progress = RecordingProgress()
    run: Any = SimpleNamespace(trial=SimpleNamespace(settings=settings), progress=progress)
    found = with_placed_hips(run, tracked.Tracked(body, {}, {}))
    return found.body, progress.warnings


def test_a_measured_leg_length_places_the_hips_of_a_tracked_body():
    body = person_body("coarse")
    number = body.space.names.index("hip_up")
    placed, warnings = placing(body, leg_length_m=0.95)
    assert placed.numbers[number] != body.numbers[number]
    assert not warnings
    assert placing(body)[0] is body


def test_a_measured_leg_length_that_cannot_be_used_is_named():
    same, warnings = placing(person_body("coarse"), leg_length_m=1.4)
    assert same.space.names
    assert "leg length is not used" in warnings[0]
    arms = person_body("coarse", preset="upper")
    same, warnings = placing(arms, leg_length_m=0.9)
    assert same is arms
    assert "not used" in warnings[0]


class Notes(RecordingProgress):
    """Keeps what is reported."""

    def __init__(self) -> None:
        super().__init__()
        self.notes: list[str] = []

    def report(self, text: str) -> None:
        self.notes.append(text)


@dataclass
class MadeRun:
    """What the stage needs of a run: images twice as large as the silhouettes, and settings."""

    images: dict[int, list[np.ndarray]]
    person: PersonSettings = field(default_factory=PersonSettings)
    progress: Notes = field(default_factory=Notes)

    @property
    def trial(self) -> Any:
        return SimpleNamespace(
            take=SimpleNamespace(at=lambda frames, cameras: ((f, [self.images[f][c] for c in cameras]) for f in frames))
        )


@pytest.fixture
def world(rng):
    """Four frames of a person in images of noise, which are twice as large as those of the refinement."""
    body, cameras = worlds.person(), worlds.ring()
    poses = dict(enumerate(worlds.swing(body, 4)))
    take = worlds.take([PosedBody(body, pose) for pose in poses.values()], cameras)
    shapes = [(2 * camera.height, 2 * camera.width, 3) for camera in cameras]
    images = {f: [rng.integers(90, 160, shape).astype(np.uint8) for shape in shapes] for f in poses}
    return body, poses, take, MadeRun(images)


def test_images_have_the_size_of_the_silhouettes(world):
    _, poses, take, run = world
    source = TrialImages(run, take.levels(run.person.fine_height))
    chosen = [2, 0]
    for frame, images in source.images(sorted(poses), chosen):
        masks = [source.levels.mask(frame, c) for c in chosen]
        assert [image.shape[:2] for image in images] == [mask.shape for mask in masks]
        assert [source.cameras(frame)[c].size[::-1] for c in chosen] == [mask.shape for mask in masks]


def test_each_round_tracks_with_its_own_poses_and_keeps_other_observations(world, monkeypatch):
    body, poses, take, run = world
    seen = []

    def followed(self, poses, body):
        seen.append(dict(poses))
        return SurfaceTracks(KeptPatches(), body.skeleton.segment_names, {f: np.full(21, np.nan) for f in poses})

    monkeypatch.setattr(TrialImages, "tracks", followed)
    found, of_round, counts = track_patches(run, take, body, poses, None, [])
    assert found == poses
    assert counts == {}
    moved = {f: replace(pose, translation=pose.translation + 0.01) for f, pose in poses.items()}
    alone = of_round(moved, body)
    assert isinstance(alone, LocalTerms)
    assert seen == [poses, moved]
    # The poses of the first round are known already.
    of_round(found, body)
    assert len(seen) == 2
    joined = track_patches(run, take, body, poses, FrameObservations({}).terms_of_round, [])[1](moved, body)
    assert isinstance(joined, LocalTerms)
    assert joined.local(0, PosedBody(body, poses[0])) is None
    assert "none" in run.progress.notes[0]


def test_another_answer_is_reported(world, monkeypatch):
    body, poses, take, run = world
    monkeypatch.setattr(TrialImages, "tracks", lambda *_: SurfaceTracks(KeptPatches(), body.skeleton.segment_names))
    monkeypatch.setattr(tracked, "without_jumps", lambda *_: {f: replace(p) for f, p in poses.items()})
    track_patches(run, take, body, poses, None, [])
    assert "The turn of the head" in run.progress.notes[-1]


def test_the_report_counts_the_tracks():
    assert tracks_text(SurfaceTracks(KeptPatches(), ())).startswith("Surface tracks: none")

    class Counted(SurfaceTracks):
        def counts(self):
            return {"head": (3, 20.4), "left_upperarm": (12, 7.6)}

    assert tracks_text(Counted(KeptPatches(), ())) == "Surface tracks: head 3 (20 frames), left upperarm 12 (8 frames)"


def test_tracks_are_the_default():
    assert CaptureSettings().surface_tracks

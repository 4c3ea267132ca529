import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.moving_surface import moving, scene, three_cameras
from tests.surfaces import no_points

from marey.cameras.rig import Rig
from marey.io.stages import FrameLog
from marey.io.video.take import Take, open_take
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.surface.tracks import (
    TracksSettings,
    drawn,
    fastest_frame,
    follow_surface,
    rejection_notes,
    tracks_settings,
    tracks_text,
)
from marey.surface.points.measured import MeasuredPoints
from marey.surface.tracks.following import ViewPatchSettings

FRAMES = 14
SETTINGS = TracksSettings(follow=ViewPatchSettings(noise=1.0), spacing=6.0)
RIG = Rig(three_cameras())
MADE = scene(world_from_plane=lambda f: moving(0.5 * f, turn=0.02 * np.sin(0.3 * f)))


@pytest.fixture(scope="module")
def take(tmp_path_factory) -> Take:
    folder = tmp_path_factory.mktemp("trial")
    for frame, images in MADE.frames(RIG.cameras, range(FRAMES)):
        for name, image in zip(RIG.names, images, strict=True):
            cv2.imwrite(str(folder / f"{name}_{frame + 1}.png"), image)
    return open_take(folder, RIG, rate=50.0)


def seeds(frame: int) -> MeasuredPoints:
    return MADE.seeds(RIG.cameras, frame, step=0.02)


def run(take: Take, folder: Path, seeds=seeds, **given):
    with FrameLog(folder / "tracks.log") as log:
        return follow_surface(
            take, RIG, seeds, log, folder / "state.npz", RecordingProgress(), settings=SETTINGS, **given
        )


@pytest.fixture(scope="module")
def followed(take, tmp_path_factory):
    """What an undisturbed run finds, and its folder."""
    folder = tmp_path_factory.mktemp("followed")
    return run(take, folder), folder


@pytest.mark.slow
def test_a_take_is_followed_and_described(take, followed):
    result, _ = followed
    trajectories = result.trajectories
    assert trajectories.rate == 50.0
    assert trajectories.frames.tolist() == list(range(FRAMES))
    assert len(trajectories.kept) > 80
    assert trajectories.measured[:, trajectories.kept].sum(axis=0).mean() > 10
    assert tracks_text(result).startswith(f"Tracks: {len(trajectories.kept)} trajectories of 1")
    removed = int(trajectories.removed.sum())
    assert removed > 0
    assert f" {removed} removed as too short" in rejection_notes(result)[0]
    picture = drawn(trajectories, take, RIG)
    assert picture is not None
    assert picture.shape == (120, 150, 3)
    assert fastest_frame(trajectories) in range(FRAMES)


@pytest.mark.slow
def test_an_interrupted_run_is_taken_up_and_gives_the_same(take, tmp_path, followed):
    whole = followed[0].trajectories

    def stopping(frame: int) -> MeasuredPoints:
        if frame == 12:
            raise KeyboardInterrupt
        return seeds(frame)

    with pytest.raises(KeyboardInterrupt):
        run(take, tmp_path, stopping)
    computed = []
    again = run(take, tmp_path, lambda frame: computed.append(frame) or seeds(frame)).trajectories
    assert computed == [10, 11, 12, 13]
    np.testing.assert_array_equal(again.position, whole.position)
    np.testing.assert_array_equal(again.covariance, whole.covariance)


@pytest.mark.slow
def test_a_state_of_other_settings_is_not_taken_up(take, tmp_path, followed):
    shutil.copy(followed[1] / "state.npz", tmp_path)
    computed = []
    run(take, tmp_path, lambda frame: computed.append(frame) or seeds(frame))
    assert computed == list(range(FRAMES))


def test_boxes_fit_the_size_of_the_images():
    small, large = (tracks_settings(Rig(tuple(c.scaled(f) for c in RIG)), noise=1.0, threads=1) for f in (1.0, 10.0))
    assert (small.follow.box, small.spacing) == (6.0, 4.0)
    assert (large.follow.box, large.spacing) == (1500 / 120, 1500 / 160)


def test_where_nothing_was_measured_nothing_is_followed(take, tmp_path):
    result = run(take, tmp_path, lambda frame: no_points(RIG.names))
    assert len(result.trajectories) == 0
    assert tracks_text(result) == "Tracks: no point could be followed from one frame to the next."
    assert rejection_notes(result) == []
    assert drawn(result.trajectories, take, RIG) is None

"""What the cameras of a trial show in common: tangents of silhouettes, and detected joints."""

import threading
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from marey.arrays import Floats, Mask
from marey.cameras.camera import Camera
from marey.fit.clocks.estimate import ClockEstimate
from marey.fit.clocks.flashes import flash_clocks, light_events
from marey.fit.clocks.signals import EpipolarSignal, joint_signals, tangent_signals
from marey.fit.clocks.sounds import onsets, sound_clocks
from marey.fit.solver.threads import map_in_two_threads
from marey.images.brightness import brightness_changes, cell_brightness
from marey.images.silhouettes.background import Background, shrunk
from marey.io.trial.key_points import read_key_points
from marey.io.trial.trial import Trial
from marey.io.video.sound import SOUND_RATE, read_sound
from marey.io.video.video import Clip
from marey.pipelines.progress import Progress
from marey.pipelines.silhouettes.empty_rooms import model_backgrounds, resized
from marey.pipelines.silhouettes.stages import SilhouetteState, update_silhouette


def silhouette_signals(trial: Trial, progress: Progress) -> list[EpipolarSignal]:
    """Measure the epipolar tangents of the silhouettes, of given ones or of those that the images show.

    Args:
        trial: The trial, opened by `read_free_trial`.
        progress: Progress reporter.

    Returns:
        The signals of each pair of cameras.
    """
    cameras, clips, names = list(trial.rig), trial.take.clips, trial.rig.names
    given = trial.masks or trial.evidence
    if all(name in given for name in names):
        masks: list[Iterator[Mask]] = [given[name].masks() for name in names]
    else:
        models, cameras = model_backgrounds(trial, progress)
        masks = [_silhouettes(*each) for each in zip(clips, models, cameras, strict=True)]
    with progress.stage("Silhouettes", sum(clip.count for clip in clips)) as step:
        return tangent_signals(cameras, [_counted(each, _locked(step)) for each in masks], trial.shutter)


def _silhouettes(clip: Clip, model: Background, camera: Camera) -> Iterator[Mask]:
    """Find the silhouettes in all pictures of one camera, independent of the others."""
    state = SilhouetteState(shrunk(model, camera.size))
    for image in clip.images(range(clip.count)):
        state = update_silhouette(state, resized(image, camera), None)
        yield state.mask


def _counted(masks: Iterator[Mask], step: Callable[[], None]) -> Iterator[Mask]:
    for mask in masks:
        step()
        yield mask


def _locked(step: Callable[[], None]) -> Callable[[], None]:
    """Return a step that several threads may call."""
    lock = threading.Lock()

    def locked() -> None:
        with lock:
            step()

    return locked


def key_point_signals(trial: Trial, progress: Progress) -> list[EpipolarSignal]:
    """Measure the epipolar planes of the detected joints of the most confident person in each image.

    Args:
        trial: The trial, opened by `read_free_trial`, with key points.
        progress: Progress reporter.

    Returns:
        The signals of each pair of cameras and joint.
    """
    assert trial.keypoints is not None
    counts = [clip.count for clip in trial.take.clips]
    with progress.stage("Key points"):
        points = read_key_points(trial.keypoints, trial.rig, count=max(counts), names=trial.file_names)
        return joint_signals(list(trial.rig), _of_cameras(points.pixels[:, :, 0], counts), trial.shutter)


def heard_clocks(trial: Trial) -> ClockEstimate | None:
    """Estimate the clocks from the sound of the videos.

    Args:
        trial: The trial, opened by `read_free_trial`.

    Returns:
        The clocks; None if fewer than two videos have sound.
    """
    found = [read_sound(clip.path) for clip in trial.take.clips]
    if sum(sound is not None for sound in found) < 2:
        return None
    heard = [None if sound is None else onsets(sound.samples, SOUND_RATE, sound.begin_s) for sound in found]
    return sound_clocks(trial.rig.names, heard)


def lit_clocks(trial: Trial, times: Sequence[Floats], progress: Progress) -> ClockEstimate | None:
    """Estimate the clocks from flashes, and from lamps that are switched on or off.

    Args:
        trial: The trial, opened by `read_free_trial`.
        times: (F,) times of each camera's pictures in its own video [s].
        progress: Progress reporter.

    Returns:
        The clocks; None if fewer than two videos show such a change of the light.
    """
    clips = trial.take.clips
    with progress.stage("Light", sum(clip.count for clip in clips)) as step:
        counted = _locked(step)
        cells = map_in_two_threads(lambda clip: _cells(clip, counted), clips)
    events = [light_events(brightness_changes(own), at) for own, at in zip(cells, times, strict=True)]
    return flash_clocks(trial.rig.names, events, times) if sum(map(bool, events)) >= 2 else None


def _cells(clip: Clip, step: Callable[[], None]) -> Floats:
    """Return the brightness of the cells of each picture (F, cells)."""
    found = []
    for image in clip.images(range(clip.count)):
        found.append(cell_brightness(image))
        step()
    return np.array(found)


def _of_cameras(pixels: Floats, counts: Sequence[int]) -> list[Floats]:
    return [np.ascontiguousarray(pixels[:count, c]) for c, count in enumerate(counts)]

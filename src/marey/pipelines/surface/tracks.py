"""The part of `marey surface` that follows the surface through the frames; it can be resumed."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from marey.arrays import Image
from marey.cameras.rig import Rig
from marey.fit.solver.threads import usable_threads
from marey.images.noise import noise_of
from marey.io.shapes.trajectories import write_trajectories
from marey.io.stages import FrameLog, load_arrays, save_arrays
from marey.io.video.pictures import write_picture
from marey.io.video.take import Take
from marey.pipelines.progress import Progress
from marey.pipelines.run_record import StageCache
from marey.surface.points.measured import MeasuredPoints
from marey.surface.tracks.appearances import picture_of
from marey.surface.tracks.filters import Filtered, FilterSettings, filtered
from marey.surface.tracks.following import ViewPatchSettings
from marey.surface.tracks.tracking import POINT_SPACING, Expected, Tracks, fitting_size, track, tracks_from
from marey.surface.tracks.trajectories import Sightings, Trajectories, gathered, sightings_of
from marey.view.pages.html import Still
from marey.view.pictures.vector_field import vector_field

_KEPT_EVERY = 10
"""Frames after which the state is stored from which an interrupted run is resumed."""
_FIELD_S = 0.05
"""Time over which the vectors in the image of the moving surface extend [s]. Chosen by eye."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TracksSettings:
    """Settings of following a surface."""

    follow: ViewPatchSettings
    filters: FilterSettings = field(default_factory=FilterSettings)
    spacing: float = POINT_SPACING
    """Spacing of the points [px]."""


def tracks_settings(rig: Rig, *, noise: float, threads: int) -> TracksSettings:
    """Choose boxes and spacing that fit the size of the images.

    Args:
        rig: The cameras.
        noise: Standard deviation of the noise of a pixel [grey levels].
        threads: Number of threads for the matching.

    Returns:
        The settings: in images of 960 px width a point every six pixels, search boxes of 16 and of 80 px.
    """
    width = max(camera.width for camera in rig)
    follow = ViewPatchSettings(noise=noise, box=max(6.0, width / 120), wide_box=max(20.0, width / 24), threads=threads)
    return TracksSettings(follow=follow, spacing=max(4.0, width / 160))


def follow_measured(
    take: Take, rig: Rig, parts: Sequence[MeasuredPoints], cache: StageCache, progress: Progress,
    *, filters: FilterSettings, depends: object, expected: Expected | None = None,
) -> Filtered:  # fmt: skip
    """Follow a measured surface, with settings that fit its images.

    Args:
        take: The images.
        rig: The cameras with which the surface was measured.
        parts: The measured surface: one part per frame, from the first frame of the take on.
        cache: Checkpoints.
        progress: Progress reporter.
        filters: Thresholds of false trajectories.
        depends: Everything that the measurement and the expected places depend on.
        expected: Predicts the places of lost points.

    Returns:
        The trajectories.
    """
    best = max(range(len(parts)), key=lambda number: len(parts[number]))
    images = [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in take.images(take.first + best)]
    noise = float(np.median([noise_of(image) for image in images]))
    settings = replace(tracks_settings(rig, noise=noise, threads=usable_threads()), filters=filters)
    pictures = [picture_of(image) for image in images]
    size = fitting_size(parts[best], pictures, list(rig), spacing=settings.spacing, settings=settings.follow)
    settings = replace(settings, follow=replace(settings.follow, size=size))
    same = replace(settings, follow=replace(settings.follow, threads=1), filters=FilterSettings())
    state = cache.folder / "tracks_state.npz"
    with cache.frames("tracks", depends=(depends, same)) as log:
        return follow_surface(
            take, rig, lambda frame: parts[frame - take.first], log, state, progress, settings=settings,
            expected=expected,
        )  # fmt: skip


def write_tracks(folder: Path, result: Filtered, take: Take, rig: Rig) -> list[Still]:
    """Write the trajectories, draw them, and return the image for a report."""
    write_trajectories(folder / "trajectories.npz", result.trajectories)
    picture = drawn(result.trajectories, take, rig)
    if picture is None:
        return []
    middle = rig.names[len(rig) // 2]
    write_picture(folder / f"tracks_{middle}.png", picture)
    return [Still(caption=f"{middle}: velocities of the points in the frame in which they are fastest", image=picture)]


def follow_surface(
    take: Take, rig: Rig, seeds: Callable[[int], MeasuredPoints], log: FrameLog, state: Path, progress: Progress,
    *, settings: TracksSettings, expected: Expected | None = None,
) -> Filtered:  # fmt: skip
    """Follow a measured surface through a take, and remove false trajectories.

    Args:
        take: The take; its frames are read once.
        rig: The cameras with which the surface was measured.
        seeds: Returns the measured surface of a frame.
        log: Stores the sightings of each frame; it belongs to these settings and inputs.
        state: A file with the state from which an interrupted run is resumed.
        progress: Progress reporter.
        settings: Settings.
        expected: Predicts the places of lost points.

    Returns:
        The trajectories.
    """
    known = _taken_up(log, state)
    first = take.first if known is None else known.frame
    with progress.stage("Tracks", take.end - take.first, done=len(log)) as step:
        pictures = _grey(take.frames(first=first))
        rows = track(
            pictures,
            list(rig),
            seeds,
            spacing=settings.spacing,
            settings=settings.follow,
            expected=expected,
            known=known,
        )
        for tracks in rows:
            log.append(_record(sightings_of(tracks)))
            if len(log) % _KEPT_EVERY == 0:
                save_arrays(state, tracks.arrays())
            step()
    with progress.stage("Rejection of false tracks"):
        sightings = [_sightings(record) for record in log]
        together = gathered(sightings, np.arange(take.count), rate=take.rate, camera_names=rig.names)
        return filtered(together, settings.filters)


def _taken_up(log: FrameLog, state: Path) -> Tracks | None:
    """Return the stored state of an interrupted run, and delete what was done after it."""
    if len(log) and state.exists():
        known = tracks_from(load_arrays(state))
        done = next((n + 1 for n, record in enumerate(log) if int(record["frame"]) == known.frame), None)
        if done is not None:
            log.cut(done)
            return known
    log.cut(0)
    state.unlink(missing_ok=True)
    return None


def _grey(frames: Iterator[tuple[int, Sequence[Image]]]) -> Iterator[tuple[int, list[np.ndarray]]]:
    for frame, images in frames:
        yield frame, [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in images]


def _record(sightings: Sightings) -> dict[str, np.ndarray]:
    single = {name: getattr(sightings, name).astype(np.float32) for name in ("covariance", "pixels")}
    numbers = {name: np.array(getattr(sightings, name)) for name in ("frame", "count", "which", "position")}
    return {**numbers, **single}


def _sightings(record: dict[str, np.ndarray]) -> Sightings:
    return Sightings(
        frame=int(record["frame"]), count=int(record["count"]), which=record["which"], position=record["position"],
        covariance=record["covariance"], pixels=record["pixels"],
    )  # fmt: skip


def tracks_text(result: Filtered) -> str:
    """Describe the trajectories in one line."""
    trajectories = result.trajectories
    kept = trajectories.kept
    if not len(kept):
        return "Tracks: no point could be followed from one frame to the next."
    long, removed = trajectories.measured[:, kept].sum(axis=0).mean(), int(trajectories.removed.sum())
    return (
        f"Tracks: {len(kept)} trajectories of {long:.1f} frames on average; {removed} removed as too short; "
        f"{result.unlike} cut where their motion differs from that of the surrounding surface, "
        f"{result.too_fast} above {result.speed:.2g} m/s or {result.acceleration:.2g} m/s2."
    )


def rejection_notes(result: Filtered) -> list[str]:
    """Return which trajectories were removed or cut, for the notes of a page; nothing if none was."""
    removed = int(result.trajectories.removed.sum())
    parts = (
        (removed, "removed as too short"),
        (result.unlike, "cut where their motion differs from that of the surrounding surface"),
        (result.too_fast, f"cut above {result.speed:.2g} m/s or {result.acceleration:.2g} m/s²"),
    )
    changed = [f"{number} {what}" for number, what in parts if number]
    return [f"Trajectories: {'; '.join(changed)}."] if changed else []


def fastest_frame(trajectories: Trajectories) -> int | None:
    """Return the row in which the kept points move fastest on average; None if none moves."""
    speed = np.linalg.norm(trajectories.velocity[:, trajectories.kept], axis=-1)
    known = np.isfinite(speed)
    enough = known.sum(axis=1) >= 0.5 * known.sum(axis=1).max(initial=1)
    mean = np.where(known, speed, 0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    return int(np.argmax(np.where(enough, mean, -1))) if known.any() else None


def drawn(trajectories: Trajectories, take: Take, rig: Rig) -> Image | None:
    """Draw the kept trajectories on the image of the middle camera in the frame in which they move fastest."""
    row = fastest_frame(trajectories)
    if row is None:
        return None
    frame, middle, kept = int(trajectories.frames[row]), len(rig) // 2, trajectories.kept
    position, velocity = (
        np.asarray(array[row, kept], float) for array in (trajectories.position, trajectories.velocity)
    )
    return vector_field(take.images(frame)[middle], rig.cameras[middle], position, velocity, seconds=_FIELD_S)

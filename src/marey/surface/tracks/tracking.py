"""Surface tracking: points of a moving surface are started, tracked, lost and found again over the frames.

[Plaenkers1999] section 2.2. `track` iterates over the frames; each of its steps is a function of the tracks so far.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from scipy.spatial import cKDTree

from marey.arrays import Floats, Integers, Mask
from marey.cameras.camera import Camera
from marey.surface.points.measured import MeasuredPoints
from marey.surface.tracks import appearances as looks
from marey.surface.tracks.appearances import Appearances, Picture
from marey.surface.tracks.following import Followed, ViewPatchSettings, between, follow, intersected
from marey.surface.tracks.local_motion import LocalMotionSettings, candidates, carried, misfit, radius_of
from marey.surface.tracks.uncertainty import PointsOfFrame, stated_covariance

Result = TypeVar("Result")
"""Type of the result of a task."""
Expected = Callable[[int, Floats, Integers], Floats]
"""Function of a frame, points' last measured positions (n, 3) [m] and the frames of these measurements (n,), which
predicts the positions in that frame (n, 3) [m]; NaN where unknown. See `marey.fit.points.lost_points`."""
POINT_SPACING = 6.0
"""Least distance of new points from tracked ones in the image [px]. Chosen by hand."""
DEFAULT = ViewPatchSettings()
"""Default settings of the patches that are matched over time and between views."""
_ARRAYS = ("number", "position", "last", "motion", "covariance", "pixels", "sd", "seen", "template", "across")
"""Names of the arrays of `Tracks`, in saved results too."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Tracks:
    """State of N points after a frame: the tracked points and those lost recently."""

    frame: int
    started: int
    """Number of points started so far, including dropped ones."""
    number: Integers
    """(N,) number of each point among the started ones, in ascending order."""
    position: Floats
    """(N, 3) measured or predicted positions [m]."""
    last: Floats
    """(N, 3) last measured positions [m]."""
    motion: Floats
    """(N, 3) displacement over the last frame [m]; NaN where unknown."""
    covariance: Floats
    """(N, 3, 3) covariance of the positions [m2], completed at the end of each frame; NaN for points not measured in
    this frame."""
    pixels: Floats
    """(N, C, 2) pixels in the views that show the points in this frame [px]."""
    sd: Floats
    """(N, C) standard deviations of these pixels by the matches [px]."""
    seen: Integers
    """(N,) last frame in which each point was measured."""
    template: Integers
    """(N,) view from which the others are matched."""
    across: Floats
    """(N, C, 2, 2) linear parts of the maps from the template view to each view."""
    appearances: Appearances
    """Appearances of the points."""

    @property
    def measured(self) -> Mask:
        """(N,) whether they were measured in this frame."""
        return np.asarray(self.seen == self.frame)

    def __len__(self) -> int:
        """Count the points."""
        return len(self.seen)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays from which tracking can be resumed."""
        own = {name: getattr(self, name) for name in _ARRAYS}
        return {
            "frame": np.array(self.frame),
            "started": np.array(self.started),
            **own,
            **{name: getattr(self.appearances, name) for name in looks.ARRAYS},
        }


def tracks_from(arrays: Mapping[str, np.ndarray]) -> Tracks:
    """Restore tracks from the result of `Tracks.arrays`."""
    appearances = Appearances(**{name: arrays[name] for name in looks.ARRAYS})
    own = {name: arrays[name] for name in _ARRAYS}
    return Tracks(frame=int(arrays["frame"]), started=int(arrays["started"]), appearances=appearances, **own)


def no_tracks(cameras: int, settings: ViewPatchSettings, *, frame: int) -> Tracks:
    """Return tracks without points."""
    return Tracks(
        frame=frame, started=0, number=np.zeros(0, np.int64), position=np.zeros((0, 3)),
        last=np.zeros((0, 3)), motion=np.zeros((0, 3)), covariance=np.zeros((0, 3, 3)),
        pixels=np.zeros((0, cameras, 2)), sd=np.zeros((0, cameras)), seen=np.zeros(0, np.int64),
        template=np.zeros(0, np.int64), across=np.zeros((0, cameras, 2, 2)),
        appearances=looks.unknown(0, cameras, half=settings.half),
    )  # fmt: skip


def advance(
    tracks: Tracks, before: Sequence[Picture], after: Sequence[Picture], cameras: Sequence[Camera],
    *, settings: ViewPatchSettings, expected: Expected | None = None,
) -> Tracks:  # fmt: skip
    """Track all points into the next frame.

    Each point is first predicted by its own last motion. Points without one, or not found, are then predicted by their
    neighbours' motion; those without neighbours are searched in a wide box, and the result must agree with the
    neighbours found by then. Last, points lost in earlier frames are searched where their neighbours, or a body model,
    predict them.

    Args:
        tracks: Tracks after the last frame.
        before: Images of the C cameras in the last frame.
        after: Images of the C cameras in the next frame.
        cameras: C cameras.
        settings: Sizes and limits.
        expected: Predicts the positions of lost points.

    Returns:
        Tracks after the next frame.
    """
    tracks = _without(tracks, tracks.seen < tracks.frame + 1 - settings.gap)
    radius = radius_of(tracks.position[tracks.measured], settings.local_motion)
    result, position = _emptied(tracks), tracks.position + tracks.motion
    alive = np.flatnonzero(tracks.measured)
    moving = alive[np.isfinite(tracks.motion[alive, 0])]
    result = _followed(tracks, result, moving, position, before, after, cameras, settings.box, settings)
    for wide in (False, True):
        missing = alive[result.seen[alive] < result.frame]
        near = _carried(tracks, result, missing, radius=radius, settings=settings.local_motion)
        lonely = ~np.isfinite(near[:, 0])
        position[missing] = np.where(lonely[:, None], tracks.position[missing], near)
        some = missing[lonely == wide]
        reach = settings.wide_box if wide else settings.box
        result = _followed(tracks, result, some, position, before, after, cameras, reach, settings)
        if wide:
            result = _agreeing(tracks, result, some, radius, settings)
    result = _found_again(tracks, result, after, cameras, settings, expected, radius)
    return _shown_again(result, after, cameras, settings)


def _without(tracks: Tracks, forgotten: Mask) -> Tracks:
    """Remove points."""
    own = {name: getattr(tracks, name)[~forgotten] for name in _ARRAYS}
    return replace(tracks, appearances=tracks.appearances[~forgotten], **own)


def _emptied(tracks: Tracks) -> Tracks:
    """Return the tracks of the next frame, in which no point has been measured yet."""
    return replace(
        tracks, frame=tracks.frame + 1, motion=np.full_like(tracks.motion, np.nan),
        covariance=np.full_like(tracks.covariance, np.nan), pixels=np.full_like(tracks.pixels, np.nan),
        sd=np.full_like(tracks.sd, np.nan),
    )  # fmt: skip


def _carried(
    tracks: Tracks, result: Tracks, which: Integers, *, radius: float, settings: LocalMotionSettings,
    count: int | None = None,
) -> Floats:  # fmt: skip
    """Predict the positions of points from the motion of their tracked neighbours."""
    both = tracks.measured & result.measured
    return carried(
        tracks.position[which], tracks.position[both], result.position[both], radius=radius, count=count,
        settings=settings,
    )  # fmt: skip


def _agreeing(tracks: Tracks, result: Tracks, which: Integers, radius: float, settings: ViewPatchSettings) -> Tracks:
    """Reject points found far from the positions that the surrounding surface predicts."""
    start = np.where(tracks.measured[:, None], tracks.position, np.nan)
    end = np.where(result.measured[:, None], result.position, np.nan)
    which = which[result.seen[which] == result.frame]
    near = candidates(start, which, radius=radius, settings=settings.local_motion)
    apart, _ = misfit(start, end, which, near, settings.local_motion)
    false = which[apart > settings.astray_ratio * radius]
    position, motion, seen = result.position.copy(), result.motion.copy(), result.seen.copy()
    covariance, pixels, sd = result.covariance.copy(), result.pixels.copy(), result.sd.copy()
    last = result.last.copy()
    position[false], motion[false], seen[false] = tracks.position[false], np.nan, tracks.seen[false]
    last[false] = tracks.last[false]
    covariance[false], pixels[false], sd[false] = np.nan, np.nan, np.nan
    return replace(
        result, position=position, last=last, motion=motion, covariance=covariance, pixels=pixels, sd=sd, seen=seen
    )  # fmt: skip


def _followed(
    tracks: Tracks, result: Tracks, which: Integers, position: Floats, before: Sequence[Picture],
    after: Sequence[Picture], cameras: Sequence[Camera], reach: float, settings: ViewPatchSettings,
) -> Tracks:  # fmt: skip
    """Track some points measured in the last frame."""
    if not len(which):
        return result
    # Differences of projections are used, so that residuals of calibration and lens stay constant.
    shift = [camera.project(position[which]) - camera.project(tracks.position[which]) for camera in cameras]
    shown = tracks.pixels[which]
    followed = follow(
        tracks.appearances[which], shown + np.stack(shift, axis=1), (before, shown, tracks.sd[which]), after, cameras,
        template=tracks.template[which], across=tracks.across[which], reach=reach, settings=settings,
    )  # fmt: skip
    return _written(result, which, followed, tracks.position[which], after)


def _written(
    result: Tracks, which: Integers, followed: Followed, origin: Floats, pictures: Sequence[Picture]
) -> Tracks:
    """Update the tracks with the points that were found."""
    found = followed.found
    rows = which[found]
    position, motion, covariance = result.position.copy(), result.motion.copy(), result.covariance.copy()
    pixels, sd, seen, template, across = (
        getattr(result, name).copy() for name in ("pixels", "sd", "seen", "template", "across")
    )
    last = result.last.copy()
    last[rows] = followed.position[found]
    position[rows], motion[rows] = followed.position[found], followed.position[found] - origin[found]
    covariance[rows], pixels[rows], seen[rows] = followed.covariance[found], followed.pixels[found], result.frame
    sd[rows] = followed.sd[found]
    template[rows], across[rows] = followed.template[found], followed.across[found]
    maps = result.appearances.maps.copy()
    maps[rows] = followed.maps[found]
    appearances = replace(result.appearances, maps=maps)
    renew = np.zeros(appearances.known.shape, bool)
    renew[rows] = followed.renew[found]
    appearances = looks.renewed(appearances, pictures, pixels, sd, renew)
    return replace(
        result, position=position, last=last, motion=motion, covariance=covariance, pixels=pixels, sd=sd, seen=seen,
        template=template, across=across, appearances=appearances,
    )  # fmt: skip


def _found_again(
    tracks: Tracks, result: Tracks, after: Sequence[Picture], cameras: Sequence[Camera], settings: ViewPatchSettings,
    expected: Expected | None, radius: float,
) -> Tracks:  # fmt: skip
    """Search lost points at their predicted positions; move those that are not found with their neighbours."""
    lost = np.flatnonzero(result.seen < result.frame)
    if not len(lost):
        return result
    far, near = settings.far_ratio, settings.local_motion
    carried = _carried(tracks, result, lost, radius=far * radius, settings=near, count=far * near.neighbours)
    guesses = [carried]
    if expected is not None:
        predicted = expected(result.frame, result.last[lost], result.seen[lost])
        guesses = [np.where(np.isfinite(carried), carried, predicted), predicted]
    position = result.position.copy()
    known = np.isfinite(guesses[0][:, 0])
    position[lost[known]] = guesses[0][known]
    result = replace(result, position=position)
    # Points lost in this frame were searched already.
    older = tracks.seen[lost] < tracks.frame
    for guess in guesses:
        still = older & np.isfinite(guess[:, 0]) & (result.seen[lost] < result.frame)
        result = _looked_for(result, lost[still], guess[still], after, cameras, settings)
    motion = result.motion.copy()
    motion[lost[older]] = np.nan
    return replace(result, motion=motion)


def _looked_for(
    result: Tracks, lost: Integers, place: Floats, after: Sequence[Picture], cameras: Sequence[Camera],
    settings: ViewPatchSettings,
) -> Tracks:  # fmt: skip
    """Search lost points about positions (n, 3) in every view."""
    if not len(lost):
        return result
    shown = np.stack([camera.project(place) for camera in cameras], axis=1)
    followed = follow(
        result.appearances[lost], shown, None, after, cameras, template=result.template[lost],
        across=result.across[lost], reach=settings.box, settings=settings,
    )  # fmt: skip
    return _written(result, lost, followed, place, after)


def _shown_again(
    result: Tracks, after: Sequence[Picture], cameras: Sequence[Camera], settings: ViewPatchSettings
) -> Tracks:
    """Search tracked points in views that did not show them in this frame so far."""
    pixels, sd, across = result.pixels.copy(), result.sd.copy(), result.across.copy()
    for view, camera in enumerate(cameras):
        rows = np.flatnonzero(result.measured & np.isnan(pixels[:, view, 0]))
        expected = camera.project(result.position[rows])
        for origin, picture in enumerate(after):
            mine = result.template[rows] == origin
            some = rows[mine]
            found = between(
                picture,
                after[view],
                pixels[some, origin],
                expected[mine],
                across[some, view],
                settings,
                least=settings.alike,
            )
            pixels[some, view] = found.pixels
            sd[some[found.good], view] = np.hypot(found.sd, result.sd[some, origin])[found.good]
            across[some[found.good], view] = found.maps[found.good]
    new = np.isfinite(pixels[..., 0]) & np.isnan(result.pixels[..., 0])
    appearances = looks.renewed(result.appearances, after, pixels, sd, new)
    return replace(result, pixels=pixels, sd=sd, across=across, appearances=appearances)


def start(
    tracks: Tracks, seeds: MeasuredPoints, pictures: Sequence[Picture], cameras: Sequence[Camera], *, spacing: float,
    settings: ViewPatchSettings,
) -> Tracks:  # fmt: skip
    """Start new points where the surface is visible and no point is tracked.

    Args:
        tracks: The points so far.
        seeds: Measured surface of this frame.
        pictures: Images of the C cameras in this frame.
        cameras: C cameras.
        spacing: Least distance of points in a seed's template image [px].
        settings: Sizes and limits.

    Returns:
        The old points, followed by the new ones.
    """
    chosen = _free_seeds(seeds, tracks.pixels[tracks.measured], spacing)
    new = _new_points(seeds[chosen], tracks, pictures, cameras, settings)
    both = {name: np.concatenate([getattr(tracks, name), getattr(new, name)]) for name in _ARRAYS}
    together = looks.joined(tracks.appearances, new.appearances)
    return Tracks(frame=tracks.frame, started=new.started, appearances=together, **both)


def _free_seeds(seeds: MeasuredPoints, taken: Floats, spacing: float) -> Integers:
    """Choose seeds at a distance from the tracked points, whose pixels (n, C, 2) are given, and from each other.

    A place that two templates have measured is chosen once: the seeds of one template are taken places in the image of
    the next.
    """
    chosen = np.zeros(0, np.int64)
    for view in range(seeds.pixels.shape[1]):
        there = np.concatenate([taken[:, view], seeds.pixels[chosen, view]])
        chosen = np.concatenate([chosen, _free_places(seeds, view, there, spacing)])
    return np.sort(chosen)


def _free_places(seeds: MeasuredPoints, view: int, taken: Floats, spacing: float) -> Integers:
    """Choose seeds of one template view, one per cell of a grid, at a distance from the points tracked there."""
    rows = np.flatnonzero(seeds.template == view)
    taken = taken[np.isfinite(taken[:, 0])]
    places = seeds.pixels[rows, view]
    if len(taken) and len(rows):
        apart = cKDTree(taken).query(places)[0] >= spacing
        rows, places = rows[apart], places[apart]
    cells = np.floor(places / spacing)
    off_middle = np.abs(places / spacing - cells - 0.5).max(axis=1) if len(rows) else np.zeros(0)
    order = np.lexsort((off_middle, cells[:, 1], cells[:, 0]))
    first = np.ones(len(rows), bool)
    first[1:] = np.any(np.diff(cells[order], axis=0) != 0, axis=1)
    return rows[order[first]]


def _new_points(
    seeds: MeasuredPoints,
    tracks: Tracks,
    pictures: Sequence[Picture],
    cameras: Sequence[Camera],
    settings: ViewPatchSettings,
) -> Tracks:
    """Match seeds between the views, and start points from the confirmed ones."""
    template, pixels = seeds.template, np.array(seeds.pixels)
    across = np.tile(np.eye(2), (*pixels.shape[:2], 1, 1))
    sd = np.full(pixels.shape[:2], np.nan)
    for origin, first in enumerate(pictures):
        for view, second in enumerate(pictures):
            rows = np.flatnonzero((template == origin) & np.isfinite(pixels[:, view, 0]))
            if view == origin or not len(rows):
                continue
            found = between(first, second, pixels[rows, origin], pixels[rows, view], across[rows, view], settings)
            pixels[rows, view], sd[rows, view] = found.pixels, found.sd
            across[rows[found.good], view] = found.maps[found.good]
    # Half of each match's variance is attributed to the template.
    others = np.isfinite(sd).any(axis=1)
    sd[others] *= np.sqrt(0.5)
    sd[others, template[others]] = np.sqrt(np.nanmean(sd[others] ** 2, axis=1))
    points = intersected(cameras, pixels, sd, settings)
    kept = np.isfinite(points.position[:, 0])
    appearances = looks.unknown(int(kept.sum()), len(pictures), half=settings.half)
    pixels = points.pixels[kept]
    shown = np.isfinite(pixels[..., 0])
    sd = np.where(shown, sd[kept], np.nan)
    appearances = looks.renewed(appearances, pictures, pixels, sd, shown)
    count = len(pixels)
    return Tracks(
        frame=tracks.frame, started=tracks.started + count, number=tracks.started + np.arange(count),
        position=points.position[kept], last=points.position[kept], motion=np.full((count, 3), np.nan),
        covariance=points.covariance[kept], pixels=pixels, sd=sd, seen=np.full(count, tracks.frame),
        template=template[kept], across=across[kept], appearances=appearances,
    )  # fmt: skip


def _with_stated_covariance(tracks: Tracks, cameras: Sequence[Camera], settings: ViewPatchSettings) -> Tracks:
    """Complete the covariance of the points measured in the tracks' frame, so far that of the matches alone."""
    here = tracks.measured
    names = ("position", "covariance", "pixels", "sd", "template", "across")
    points = PointsOfFrame(**{name: getattr(tracks, name)[here] for name in names})
    covariance = tracks.covariance.copy()
    covariance[here] = stated_covariance(points, cameras, floor_px=settings.floor_px, size=settings.size)
    return replace(tracks, covariance=covariance)


def fitting_size(
    seeds: MeasuredPoints, pictures: Sequence[Picture], cameras: Sequence[Camera], *, spacing: float,
    settings: ViewPatchSettings,
) -> int:  # fmt: skip
    """Choose the smallest patches with which most of a measured surface can be tracked; weak texture needs large ones.

    Args:
        seeds: Measured surface of one frame.
        pictures: Images of the C cameras in that frame.
        cameras: C cameras.
        spacing: Least distance of the points [px].
        settings: Limits; their size is the smallest one that is tried.

    Returns:
        Width and height of the patches [px], odd.
    """
    confirmed: dict[int, int] = {}
    empty = no_tracks(len(cameras), settings, frame=0)
    apart = _free_seeds(seeds, np.zeros((0, len(pictures), 2)), spacing)
    for factor in settings.enlarged:
        size = 2 * round(factor * settings.half) + 1
        confirmed[size] = len(_new_points(seeds[apart], empty, pictures, cameras, replace(settings, size=size)))
        if confirmed[size] >= settings.confirmed_share * len(apart):
            return size
    most = max(confirmed.values())
    return min(size for size, count in confirmed.items() if count >= settings.confirmed_share * most)


def track(
    frames: Iterable[tuple[int, Sequence[np.ndarray]]], cameras: Sequence[Camera],
    seeds: Callable[[int], MeasuredPoints], *, spacing: float = POINT_SPACING, settings: ViewPatchSettings = DEFAULT,
    expected: Expected | None = None, known: Tracks | None = None,
) -> Iterator[Tracks]:  # fmt: skip
    """Track the surface over consecutive frames.

    Args:
        frames: Frame numbers with C grey images (H, W) each; a resumed run starts with the last frame of the earlier
            one.
        cameras: C cameras.
        seeds: Returns the measured surface of a frame, from which points are started.
        spacing: Least distance of the points in the template images [px].
        settings: Sizes and limits.
        expected: Predicts the positions of lost points.
        known: Tracks of an earlier run after the first of the frames; None for a new run.

    Yields:
        The tracks after each frame; after the first one only in a new run.
    """
    with ThreadPoolExecutor(1) as beside:
        prepared = _prepared(frames, None if known is None else known.frame, seeds, beside)
        states = _states(prepared, cameras, spacing=spacing, settings=settings, expected=expected, known=known)
        # The next frame does not depend on the stated covariance, which is completed beside it.
        yield from _one_behind(beside.submit(_with_stated_covariance, state, cameras, settings) for state in states)


def _states(
    prepared: Iterable[tuple[int, list[Picture], MeasuredPoints | None]], cameras: Sequence[Camera],
    *, spacing: float, settings: ViewPatchSettings, expected: Expected | None, known: Tracks | None,
) -> Iterator[Tracks]:  # fmt: skip
    """Yield the tracks after each frame, with covariances of the matches alone."""
    before: list[Picture] = []
    for frame, pictures, measured in prepared:
        if measured is not None:
            if known is None:
                known = no_tracks(len(cameras), settings, frame=frame)
            else:
                known = advance(known, before, pictures, cameras, settings=settings, expected=expected)
            known = start(known, measured, pictures, cameras, spacing=spacing, settings=settings)
            yield known
        before = pictures


def _prepared(
    frames: Iterable[tuple[int, Sequence[np.ndarray]]], done: int | None, seeds: Callable[[int], MeasuredPoints],
    beside: ThreadPoolExecutor,
) -> Iterator[tuple[int, list[Picture], MeasuredPoints | None]]:  # fmt: skip
    """Prepare the images and the measured surface of each frame in another thread while the one before is in use.

    The frame that an earlier run has done needs no surface.
    """

    def prepare(frame: int, images: Sequence[np.ndarray]) -> tuple[int, list[Picture], MeasuredPoints | None]:
        return frame, [looks.picture_of(image) for image in images], None if frame == done else seeds(frame)

    return _one_behind(beside.submit(prepare, frame, images) for frame, images in frames)


def _one_behind(begun: Iterable[Future[Result]]) -> Iterator[Result]:
    """Yield the results of tasks, each after the next task has begun."""
    waiting: Future[Result] | None = None
    for task in begun:
        if waiting is not None:
            yield waiting.result()
        waiting = task
    if waiting is not None:
        yield waiting.result()

"""Tracking of points through a video: Lucas-Kanade between frames, then affine matching with an early reference."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from marey.arrays import Floats, Integers, Mask, freeze_fields
from marey.errors import SettingProblem
from marey.images.matching.matching import MatchSettings
from marey.images.matching.reference_patches import ReferencePatches
from marey.images.matching.splines import SplinePicture, spline_of

_NEIGHBOURS = 8
"""Number of neighbouring points from whose motion the position of a lost point is predicted. Chosen by hand; results
were not measured against other values."""

Pictures = Sequence[np.ndarray]
"""Grey images (H, W) of one size, one per frame."""
Progress = Callable[[int, int], None]
"""Called with the number of frames done and the number of all frames."""


def _quiet(_done: int, _all: int) -> None:
    """Report nothing."""


@dataclass(frozen=True, kw_only=True)
class FollowSettings:
    """Settings of the tracking of feature points.

    The defaults were chosen by hand; results were not measured against other values.

    Raises:
        SettingProblem: A value is impossible.
    """

    size: int = 13
    """Width and height of a patch [px], odd."""
    alike: float = 0.8
    """Least correlation with the reference; below it, a later reference is tried."""
    reach: float = 3.0
    """Largest distance of a match from the result of Lucas-Kanade [px]."""
    returned: float = 1.0
    """Largest distance between the start and the end of tracking forward and backward [px]."""
    noise: float = 1.5
    """Standard deviation of a pixel's noise [grey levels]."""
    window: int = 21
    """Width and height of Lucas-Kanade's window [px]."""
    levels: int = 3
    """Number of halvings of the image at the top of Lucas-Kanade's pyramid."""
    least_sd_px: float = 0.02
    """Lower limit of a match's standard deviation [px]."""
    further_searches: int = 3
    """Number of further searches for points that were not found, from their neighbours that were."""

    def __post_init__(self) -> None:
        faults = [
            f"{name} is {getattr(self, name):g}; it must be positive"
            for name in ("reach", "returned", "window")
            if not getattr(self, name) > 0
        ]
        if not 0 < self.alike < 1:
            faults.append(f"alike is {self.alike:g}; a correlation lies between 0 and 1")
        if self.levels < 0:
            faults.append(f"levels is {self.levels}; it must not be negative")
        if faults:
            raise SettingProblem(f"Points cannot be tracked with these settings: {'; '.join(faults)}.")
        self.matching()

    def matching(self) -> MatchSettings:
        """Return the settings of a match."""
        return MatchSettings(size=self.size, noise=self.noise, reach=self.reach, stretch=3.0)


DEFAULT = FollowSettings()
"""Default settings of the tracking of feature points."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FeatureTracks:
    """Positions of points of one video in each frame.

    Raises:
        SettingProblem: The arrays are inconsistent.
    """

    tracks: Floats
    """(F, 2, P) positions [px]; NaN where unknown."""
    tracks_sd: Floats
    """(F, 2, P) standard deviations of the positions [px]."""
    visible: Mask
    """(F, P) whether the point was found in the image."""
    predicted: Mask
    """(F, P) whether the position is predicted from the other points alone; never true where the point is visible."""

    def __post_init__(self) -> None:
        freeze_fields(self, "tracks", "tracks_sd")
        freeze_fields(self, "visible", "predicted", dtype=np.bool_)
        shape = self.tracks.shape
        if len(shape) != 3 or shape[1] != 2:
            raise SettingProblem(f"The tracks of one view must have the shape (frames, 2, points), not {shape}.")
        marks = (shape[0], shape[2])
        if self.tracks_sd.shape != shape or self.visible.shape != marks or self.predicted.shape != marks:
            raise SettingProblem("The tracks, their standard deviations and their flags differ in frames or points.")
        if np.any(self.visible & self.predicted):
            raise SettingProblem("A point cannot be both visible and predicted in the same frame.")


@dataclass(frozen=True, eq=False, kw_only=True)
class FollowedPoints:
    """Tracks with the reference patch used at each position."""

    found: FeatureTracks
    """Positions that were found in the images; none is predicted."""
    guesses: Floats
    """(F, 2, P) positions, for points that were not found by the motion of their neighbours [px]."""
    references: ReferencePatches
    """Reference patches of the points; the first P are from the start frame."""
    used: Integers
    """(F, P) index of the reference used."""
    maps: Floats
    """(F, P, 2, 2) linear parts of the affine maps from the start frame to each frame, the last known ones where the
    point was not found."""
    start: int
    """The frame in which the points were given."""


def follow_points(
    pictures: Pictures,
    points: Floats,
    *,
    frame: int = 0,
    settings: FollowSettings = DEFAULT,
    progress: Progress = _quiet,
) -> FollowedPoints:
    """Track points through a video, forward and backward in time from the frame in which they are given.

    Pyramidal Lucas-Kanade [Bouguet2001] predicts each point in the next frame, and back again as a check; there the
    patch of the first frame is matched by affine least squares. Unlike [Alexander2003] section 3.2, the reference is
    not renewed every ten frames but when the first no longer fits, and the first is tried again in every frame: only
    frames that need a later reference drift. A lost point moves with its neighbours until it is found again.

    Args:
        pictures: Grey images of the video.
        points: (P, 2) positions [px].
        frame: Frame of these positions.
        settings: Patches and limits.
        progress: Called after each frame.

    Returns:
        The tracks. Points along edges are found in the first frame only, and predicted from the others in the rest. A
        point whose patch in the first frame extends beyond the image, or is flat, is not found in any frame.

    Raises:
        SettingProblem: There are no points, or the frame or a point is not in the video.
    """
    points = np.asarray(points, float)
    _require_points(pictures, points, frame)
    count, total = len(points), len(pictures)
    references = ReferencePatches(half=settings.size // 2)
    first = spline_of(pictures[frame])
    references.add(first, points, frame=frame, points=np.arange(count))
    book = _Record(
        tracks=np.full((total, 2, count), np.nan), tracks_sd=np.full((total, 2, count), np.nan),
        guesses=np.full((total, 2, count), np.nan), used=np.full((total, count), -1), start=frame,
        maps=np.tile(np.eye(2), (total, count, 1, 1)), references=references, drift=np.zeros((count, 2)),
        singly=np.ones(count, bool), ahead=np.tile(np.eye(2), (count, 1, 1)),
    )  # fmt: skip
    book.singly = _write_start(book, first, points, frame, settings)
    done = 0
    for frames in (range(frame + 1, total), range(frame - 1, -1, -1)):
        done = _follow_one_way(pictures, frame, frames, book, settings, progress, done)
    seen = np.all(np.isfinite(book.tracks), axis=1)
    found = FeatureTracks(
        tracks=book.tracks, tracks_sd=book.tracks_sd, visible=seen, predicted=np.zeros((total, count), bool)
    )
    return FollowedPoints(
        found=found, guesses=book.guesses, references=references, used=book.used, maps=book.maps, start=frame
    )


def _require_points(pictures: Pictures, points: Floats, frame: int) -> None:
    if not 0 <= frame < len(pictures):
        raise SettingProblem(
            f"The points are those of frame {frame}, but the video has the frames 0 to {len(pictures) - 1}."
        )
    if points.ndim != 2 or points.shape[1:] != (2,) or not len(points):
        raise SettingProblem(f"The points must have the shape (points, 2), not {points.shape}.")
    height, width = pictures[frame].shape
    bad = np.flatnonzero(~np.all((points >= 0) & (points <= (width - 1, height - 1)), axis=1))
    if len(bad):
        x, y = points[bad[0]]
        raise SettingProblem(f"Point {bad[0]} at ({x:g}, {y:g}) is not in the image of {width} x {height} pixels.")


@dataclass(eq=False, kw_only=True)
class _Record:
    """State of the tracking so far."""

    tracks: Floats
    tracks_sd: Floats
    guesses: Floats
    used: Integers
    maps: Floats
    references: ReferencePatches
    drift: Floats
    """(R, 2) variance of the position of each reference, from those before it [px2]."""
    ahead: Floats
    """(R, 2, 2) linear part of each reference's own map, from the first."""
    start: int
    singly: Mask
    """(P,) which points have texture in both directions; the others move with their neighbours."""


class _Now(NamedTuple):
    """Positions of the points in the last processed frame."""

    place: Floats
    """(P, 2) positions, predicted where not found [px]."""
    seen: Mask
    youngest: Integers
    """(P,) latest reference of each point."""


def _write_start(book: _Record, first: SplinePicture, points: Floats, frame: int, settings: FollowSettings) -> Mask:
    """Keep the points with texture; return which (P,) have enough in both directions to be tracked individually."""
    count, matching = len(points), settings.matching()
    everywhere, maps = np.arange(count), np.tile(np.eye(2), (count, 1, 1))
    singly = book.references.match(first, everywhere, points, points, maps, matching).converged
    information, _, _ = book.references.equations(first, everywhere, points, points, maps, 1.0)
    least = matching.texture * matching.noise**2 * matching.size**2
    flat = ~(singly | (np.linalg.eigvalsh(information)[:, 1] > least))
    book.tracks[frame] = np.where(flat, np.nan, points.T)
    book.tracks_sd[frame] = np.where(flat, np.nan, 0.0)
    book.guesses[frame] = points.T
    book.used[frame] = np.where(flat, -1, everywhere)
    return singly


def _follow_one_way(
    pictures: Pictures,
    start: int,
    frames: range,
    book: _Record,
    settings: FollowSettings,
    progress: Progress,
    done: int,
) -> int:
    points = book.guesses[start].T.copy()
    now = _Now(points, book.singly, np.arange(len(points)))
    before, earlier, last = pictures[start], spline_of(pictures[start]), start
    for t in frames:
        picture = pictures[t]
        spline = spline_of(picture)
        guess = _carried(before, picture, now, points, settings)
        now = _found(book, spline, earlier, now, guess, t, last, settings)
        before, earlier, last, done = picture, spline, t, done + 1
        progress(done, len(pictures) - 1)
    return done


def _carried(before: np.ndarray, picture: np.ndarray, now: _Now, points: Floats, settings: FollowSettings) -> Floats:
    """Predict points (P, 2) in the next frame: by Lucas-Kanade if the backward check succeeds, else by neighbours."""
    start = np.asarray(now.place, np.float32)
    there, forward = _flow(before, picture, start, settings)
    here, backward = _flow(picture, before, there, settings)
    returned = np.linalg.norm(here - start, axis=1) <= settings.returned
    good = now.seen & forward & backward & returned
    return extrapolated(points, np.where(good[:, None], there, np.nan), now.place)[0]


def _flow(before: np.ndarray, after: np.ndarray, places: Floats, settings: FollowSettings) -> tuple[Floats, Mask]:
    """Track positions (P, 2) from one image to another by pyramidal Lucas-Kanade; return also where it succeeded."""
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        before, after, places[:, None], np.zeros_like(places[:, None]),
        winSize=(settings.window, settings.window), maxLevel=settings.levels,
    )  # fmt: skip
    return np.asarray(moved, np.float32)[:, 0], np.asarray(status)[:, 0] > 0


def extrapolated(points: Floats, places: Floats, otherwise: Floats) -> tuple[Floats, Floats]:
    """Predict unknown positions from the affine motion of the nearest known points.

    Args:
        points: (P, 2) positions in a frame in which all are known [px].
        places: (P, 2) positions in another frame [px]; NaN where unknown.
        otherwise: (P, 2) result if too few positions are known [px].

    Returns:
        The positions (P, 2), and the linear parts (P, 2, 2) of the motions used; NaN for known points.
    """
    known = np.all(np.isfinite(places), axis=1)
    filled, maps = np.where(known[:, None], places, otherwise), np.full((len(places), 2, 2), np.nan)
    if np.count_nonzero(known) < 3:
        return filled, maps
    rows = np.flatnonzero(~known)
    motion = _motions(points[rows], points[known], places[known] - points[known], 0)
    filled[rows] = points[rows] + motion[:, 0]
    maps[rows] = np.eye(2) + np.swapaxes(motion[:, 1:], 1, 2)
    return filled, maps


def predicted_by_neighbours(points: Floats, places: Floats) -> Floats:
    """Predict each known point from the nearest other points, independent of its own position.

    Args:
        points: (P, 2) positions in a frame in which all are known [px].
        places: (P, 2) positions in another frame [px]; NaN where unknown.

    Returns:
        (P, 2) predictions [px]; NaN for unknown points, and if fewer than three others are known.
    """
    known, predicted = np.all(np.isfinite(places), axis=1), np.full(places.shape, np.nan)
    if np.count_nonzero(known) > 3:
        own = points[known]
        predicted[known] = own + _motions(own, own, places[known] - own, 1)[:, 0]
    return predicted


def _motions(points: Floats, others: Floats, moved: Floats, skipped: int) -> Floats:
    """Fit affine motions (n, 3, 2) about points to the displacements of the nearest others after the skipped ones."""
    distance = np.linalg.norm(points[:, None] - others, axis=2)
    nearest = np.argsort(distance, axis=1)[:, skipped : skipped + _NEIGHBOURS]
    scale = np.take_along_axis(distance, nearest, 1)
    weight = 1 / (scale**2 + scale.max(axis=1, keepdims=True) ** 2 / 4 + 1e-9)
    offsets = others[nearest] - points[:, None]
    shifts = moved[nearest]
    # A weak regularisation towards a common shift determines the motion if the neighbours lie on a line.
    columns = np.concatenate([np.ones((*offsets.shape[:2], 1)), offsets], axis=2)
    normal = np.einsum("nka,nk,nkb->nab", columns, weight, columns)
    size = np.einsum("nk,nki->n", weight, offsets**2)[:, None]
    normal[:, [1, 2], [1, 2]] += 0.05 * size + 1e-9
    right = np.einsum("nka,nk,nki->nai", columns, weight, shifts)
    return np.linalg.solve(normal, right)


def _found(
    book: _Record,
    spline: SplinePicture,
    earlier: SplinePicture,
    now: _Now,
    guess: Floats,
    frame: int,
    last: int,
    settings: FollowSettings,
) -> _Now:
    """Match all points in a frame: with the first reference, then with the latest, then with the last frame."""
    count = len(guess)
    place, maps = guess.copy(), book.maps[last].copy()
    seen, youngest = np.zeros(count, bool), now.youngest.copy()
    first = np.arange(count)
    for attempt in (first, now.youngest, None, *settings.further_searches * (first, youngest)):
        if seen[book.singly].all():
            break
        if attempt is first and seen.any():
            _carry_along(book, place, maps, seen)
        left = ~seen & book.singly
        if attempt is None:
            left &= now.seen
            rows = np.flatnonzero(left)
            youngest[rows] = _renewed(book, earlier, rows, last)
            chosen = youngest[rows]
        else:
            rows = np.flatnonzero(left & ((attempt is first) | (attempt >= count)))
            chosen = attempt[rows]
        if len(rows):
            _match_rows(book, spline, rows, chosen, place, maps, seen, frame, settings)
    if seen.any() and not seen.all():
        _carry_along(book, place, maps, seen)
    book.guesses[frame], book.maps[frame] = place.T, maps
    return _Now(place, seen, youngest)


def _carry_along(book: _Record, place: Floats, maps: Floats, seen: Mask) -> None:
    """Move points that were not found with those that were; without any of these nothing changes."""
    points = book.guesses[book.start].T
    filled, turned = extrapolated(points, np.where(seen[:, None], place, np.nan), place)
    known = np.all(np.isfinite(turned), axis=(1, 2))
    place[known], maps[known] = filled[known], turned[known]


def _renewed(book: _Record, earlier: SplinePicture, rows: Integers, last: int) -> Integers:
    """Take new references from the last frame, with the variances of the positions there."""
    book.drift = np.concatenate([book.drift, book.tracks_sd[last][:, rows].T ** 2])
    book.ahead = np.concatenate([book.ahead, book.maps[last][rows]])
    return book.references.add(earlier, book.tracks[last][:, rows].T, frame=last, points=rows)


def _match_rows(
    book: _Record,
    spline: SplinePicture,
    rows: Integers,
    chosen: Integers,
    place: Floats,
    maps: Floats,
    seen: Mask,
    frame: int,
    settings: FollowSettings,
) -> None:
    """Match some points with one reference each; update positions, maps and flags of successful matches."""
    taken = book.references.frames[chosen]
    pixels = book.tracks[taken, :, rows]
    starts = maps[rows] @ np.linalg.inv(book.ahead[chosen])
    result = book.references.match(spline, chosen, pixels, place[rows], starts, settings.matching())
    good = result.converged & (result.correlation >= settings.alike)
    hit = rows[good]
    place[hit], seen[hit] = result.pixels[good], True
    maps[hit] = result.search_from_template[good] @ book.ahead[chosen[good]]
    variance = np.diagonal(result.covariance[good], axis1=1, axis2=2) + settings.least_sd_px**2
    variance = variance + book.drift[chosen[good]]
    book.tracks[frame][:, hit] = place[hit].T
    book.tracks_sd[frame][:, hit] = np.sqrt(variance).T
    book.used[frame, hit] = chosen[good]

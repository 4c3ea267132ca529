"""Points followed through a video: Lucas-Kanade from frame to frame, then affine matching with an early reference."""

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
"""Number of neighbouring points from whose motion the position of a lost point is predicted. Chosen by hand."""
_LEAST_SD = 0.02
"""Lower limit of a match's standard deviation [px]. Chosen by hand."""
_GROWTH = 3
"""Number of further searches for points that were not found, from their neighbours that were. Chosen by hand."""

Pictures = Sequence[np.ndarray]
"""Grey images (H, W) of one size, one per frame."""
Progress = Callable[[int, int], None]
"""Called with the number of frames done and the number of all frames."""


def _quiet(_done: int, _all: int) -> None:
    """Report nothing."""


@dataclass(frozen=True, kw_only=True)
class FollowSettings:
    """How points are followed.

    Raises:
        SettingProblem: A value is impossible.
    """

    size: int = 13
    """Width and height of a patch [px], odd."""
    alike: float = 0.8
    """Least correlation with the reference; below, a younger one is tried."""
    reach: float = 3.0
    """How far a match may end from where Lucas-Kanade brought the point [px]."""
    returned: float = 1.0
    """How far from its start a point may come back when it is followed forward and backward [px]."""
    noise: float = 1.5
    """Standard deviation of a pixel's noise [grey levels]."""
    window: int = 21
    """Width and height of Lucas-Kanade's window [px]."""
    levels: int = 3
    """Halvings of the picture that Lucas-Kanade begins with."""

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
            raise SettingProblem(f"Points cannot be followed with these settings: {'; '.join(faults)}.")
        self.matching()

    def matching(self) -> MatchSettings:
        """Give the settings of a match."""
        return MatchSettings(size=self.size, noise=self.noise, reach=self.reach, stretch=3.0)


DEFAULT = FollowSettings()
"""Default settings of the tracking of feature points."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FeatureTracks:
    """Where points of one video are, frame by frame.

    Raises:
        SettingProblem: The arrays do not fit together.
    """

    tracks: Floats
    """(F, 2, P) [px]; NaN where nothing is known."""
    tracks_sd: Floats
    """(F, 2, P) their standard deviations [px]."""
    visible: Mask
    """(F, P) whether the point was seen there."""
    predicted: Mask
    """(F, P) whether the place follows from the other points alone; never where the point was seen."""

    def __post_init__(self) -> None:
        freeze_fields(self, "tracks", "tracks_sd")
        freeze_fields(self, "visible", "predicted", dtype=np.bool_)
        shape = self.tracks.shape
        if len(shape) != 3 or shape[1] != 2:
            raise SettingProblem(f"Tracks of shape {shape} are none of one view (frames, 2, points).")
        marks = (shape[0], shape[2])
        if self.tracks_sd.shape != shape or self.visible.shape != marks or self.predicted.shape != marks:
            raise SettingProblem("The tracks, their standard deviations and their marks differ in frames or points.")
        if np.any(self.visible & self.predicted):
            raise SettingProblem("A point that is visible cannot be predicted at once.")


@dataclass(frozen=True, eq=False, kw_only=True)
class FollowedPoints:
    """Tracks with what each place was compared with."""

    found: FeatureTracks
    """Places that were seen; nothing is predicted."""
    guesses: Floats
    """(F, 2, P) where the others would be if they moved with their neighbours [px]."""
    references: ReferencePatches
    """What points were compared with; the first P were taken in the start's frame."""
    used: Integers
    """(F, P) which of them."""
    maps: Floats
    """(F, P, 2, 2) linear parts of the affine maps to the frame from the start's frame, the last known ones where the
    point was not seen."""
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
    """Follow points through a video, forward and backward in time from the frame in which they are given.

    Pyramidal Lucas-Kanade [Bouguet2001] brings each point to the next frame, and back again as a check; the affine
    match there is with the patch of the first frame. Unlike [Alexander2003] section 3.2 the reference is not renewed
    every ten frames but when the first no longer fits, and the first is tried again in every frame: only frames that
    need a younger reference drift. A point that is lost moves with its neighbours until it is found again.

    Args:
        pictures: The video's grey pictures.
        points: (P, 2) [px].
        frame: The frame in which they are there.
        settings: Patches and limits.
        progress: Is told of each frame.

    Returns:
        The tracks. Points along edges are seen in the first frame only, and guessed from the others in the rest. A
        point whose patch reaches beyond the picture, or is flat, in the first frame stays unseen in all.

    Raises:
        SettingProblem: There are no points, or the frame or a point is not in the video.
    """
    points = np.asarray(points, float)
    _require_points(pictures, points, frame)
    count, total = len(points), len(pictures)
    references = ReferencePatches(half=settings.size // 2)
    first = spline_of(pictures[frame])
    references.add(first, points, frame=frame, points=np.arange(count))
    book = _Book(
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
        raise SettingProblem(f"The points are of frame {frame}, the video has the frames 0 to {len(pictures) - 1}.")
    if points.ndim != 2 or points.shape[1:] != (2,) or not len(points):
        raise SettingProblem(f"Points to follow must have the shape (points, 2), not {points.shape}.")
    height, width = pictures[frame].shape
    bad = np.flatnonzero(~np.all((points >= 0) & (points <= (width - 1, height - 1)), axis=1))
    if len(bad):
        x, y = points[bad[0]]
        raise SettingProblem(f"Point {bad[0]} at ({x:g}, {y:g}) is not in the picture of {width} x {height} pixels.")


@dataclass(eq=False, kw_only=True)
class _Book:
    """What has been found so far."""

    tracks: Floats
    tracks_sd: Floats
    guesses: Floats
    used: Integers
    maps: Floats
    references: ReferencePatches
    drift: Floats
    """(R, 2) variance of the place of each reference, from those before it [px2]."""
    ahead: Floats
    """(R, 2, 2) linear part of each reference's own map, from the first."""
    start: int
    singly: Mask
    """(P,) which points have texture in both directions; the others only move along with them."""


class _Now(NamedTuple):
    """Where points are in the frame that was reached last."""

    place: Floats
    """(P, 2), guesses where not seen."""
    seen: Mask
    youngest: Integers
    """(P,) the reference that was made last."""


def _write_start(book: _Book, first: SplinePicture, points: Floats, frame: int, settings: FollowSettings) -> Mask:
    """Keep the points with any texture; tell which (P,) have enough in both directions to be followed singly."""
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
    book: _Book,
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
    """Bring the points (P, 2) to the next frame: by Lucas-Kanade where it comes back, else with their neighbours."""
    start = np.asarray(now.place, np.float32)
    there, forward = _flow(before, picture, start, settings)
    here, backward = _flow(picture, before, there, settings)
    returned = np.linalg.norm(here - start, axis=1) <= settings.returned
    good = now.seen & forward & backward & returned
    return extrapolated(points, np.where(good[:, None], there, np.nan), now.place)[0]


def _flow(before: np.ndarray, after: np.ndarray, places: Floats, settings: FollowSettings) -> tuple[Floats, Mask]:
    """Carry places (P, 2) from one picture to another by pyramidal Lucas-Kanade; tell where that went well."""
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        before, after, places[:, None], np.zeros_like(places[:, None]),
        winSize=(settings.window, settings.window), maxLevel=settings.levels,
    )  # fmt: skip
    return np.asarray(moved, np.float32)[:, 0], np.asarray(status)[:, 0] > 0


def extrapolated(points: Floats, places: Floats, otherwise: Floats) -> tuple[Floats, Floats]:
    """Fill in places that are not known: from the affine motion of the nearest points whose places are.

    Args:
        points: (P, 2) places in a frame in which all are known [px].
        places: (P, 2) in another one; NaN where not known.
        otherwise: (P, 2) what to say where too few are known [px].

    Returns:
        The places (P, 2), and the linear parts (P, 2, 2) of the motions that filled them; NaN for the others.
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
    """Give where the nearest other points say that each known point is, whatever was found of itself.

    Args:
        points: (P, 2) places in a frame in which all are known [px].
        places: (P, 2) in another one; NaN where not known.

    Returns:
        (P, 2); NaN where not known, and where fewer than three others are.
    """
    known, said = np.all(np.isfinite(places), axis=1), np.full(places.shape, np.nan)
    if np.count_nonzero(known) > 3:
        own = points[known]
        said[known] = own + _motions(own, own, places[known] - own, 1)[:, 0]
    return said


def _motions(points: Floats, others: Floats, moved: Floats, skipped: int) -> Floats:
    """Give the affine motions (n, 3, 2) about points by the nearest others, which moved so; skip the very nearest."""
    distance = np.linalg.norm(points[:, None] - others, axis=2)
    nearest = np.argsort(distance, axis=1)[:, skipped : skipped + _NEIGHBOURS]
    scale = np.take_along_axis(distance, nearest, 1)
    weight = 1 / (scale**2 + scale.max(axis=1, keepdims=True) ** 2 / 4 + 1e-9)
    offsets = others[nearest] - points[:, None]
    shifts = moved[nearest]
    # A weak pull towards a common shift settles what neighbours on a line leave open.
    columns = np.concatenate([np.ones((*offsets.shape[:2], 1)), offsets], axis=2)
    normal = np.einsum("nka,nk,nkb->nab", columns, weight, columns)
    size = np.einsum("nk,nki->n", weight, offsets**2)[:, None]
    normal[:, [1, 2], [1, 2]] += 0.05 * size + 1e-9
    right = np.einsum("nka,nk,nki->nai", columns, weight, shifts)
    return np.linalg.solve(normal, right)


def _found(
    book: _Book,
    spline: SplinePicture,
    earlier: SplinePicture,
    now: _Now,
    guess: Floats,
    frame: int,
    last: int,
    settings: FollowSettings,
) -> _Now:
    """Match all points in a frame: with the first reference, then with the youngest, then with the last frame."""
    count = len(guess)
    place, maps = guess.copy(), book.maps[last].copy()
    seen, youngest = np.zeros(count, bool), now.youngest.copy()
    first = np.arange(count)
    for attempt in (first, now.youngest, None, *_GROWTH * (first, youngest)):
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


def _carry_along(book: _Book, place: Floats, maps: Floats, seen: Mask) -> None:
    """Move what was not found with what was; nothing changes before anything was."""
    points = book.guesses[book.start].T
    filled, turned = extrapolated(points, np.where(seen[:, None], place, np.nan), place)
    known = np.all(np.isfinite(turned), axis=(1, 2))
    place[known], maps[known] = filled[known], turned[known]


def _renewed(book: _Book, earlier: SplinePicture, rows: Integers, last: int) -> Integers:
    """Take new references from the last frame; they inherit the doubt about the places there."""
    book.drift = np.concatenate([book.drift, book.tracks_sd[last][:, rows].T ** 2])
    book.ahead = np.concatenate([book.ahead, book.maps[last][rows]])
    return book.references.add(earlier, book.tracks[last][:, rows].T, frame=last, points=rows)


def _match_rows(
    book: _Book,
    spline: SplinePicture,
    rows: Integers,
    chosen: Integers,
    place: Floats,
    maps: Floats,
    seen: Mask,
    frame: int,
    settings: FollowSettings,
) -> None:
    """Match some points with a reference each; places, maps and marks are changed where that succeeds."""
    taken = book.references.frames[chosen]
    pixels = book.tracks[taken, :, rows]
    starts = maps[rows] @ np.linalg.inv(book.ahead[chosen])
    result = book.references.match(spline, chosen, pixels, place[rows], starts, settings.matching())
    good = result.converged & (result.correlation >= settings.alike)
    hit = rows[good]
    place[hit], seen[hit] = result.pixels[good], True
    maps[hit] = result.search_from_template[good] @ book.ahead[chosen[good]]
    variance = np.diagonal(result.covariance[good], axis1=1, axis2=2) + _LEAST_SD**2 + book.drift[chosen[good]]
    book.tracks[frame][:, hit] = place[hit].T
    book.tracks_sd[frame][:, hit] = np.sqrt(variance).T
    book.used[frame, hit] = chosen[good]

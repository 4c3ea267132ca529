"""Why one camera contradicts the others: it moved, zoomed, was turned, lost pictures, or has another clock.

Each explanation is a change of the camera's parameters, constant or from one picture on, of its clock, or of its
shutter. Of all cameras and explanations the one counts that explains most of what exceeds the noise.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.calibration.adjustment.solve import SolvedSession
from marey.calibration.adjustment.state import CAMERA, LENS
from marey.calibration.boards.corners import CornerSet
from marey.calibration.quality.reference_views import (
    CHANGES,
    DELAY,
    READOUT,
    ZOOM,
    ReferenceViews,
    lens_prior,
    reference_boards,
    reference_views,
)

_BASE = (*range(6), *range(LENS, CAMERA))
"""Changes that every explanation contains: focal lengths, centre and radial distortion, and the pose of the camera."""
_POSE = tuple(range(LENS, CAMERA))
"""Changes of a camera that moved."""
_LENS = (ZOOM, 2, 3)
"""Changes of a camera that zoomed or was focused anew: its focal lengths in one ratio, and its centre."""
_ROUNDS = 6
"""Number of times that views far off are weighted anew; chosen by hand."""
_FAR = 6.0
"""Cost of a view beyond its expectation, in standard deviations, from which it counts less; chosen by hand."""
_MOST_INSTANTS = 30
"""Number of instants that are tried first; chosen by hand."""
_MOST_LAG = 10
"""Largest number of lost pictures that is searched; chosen by hand."""
_MOST_DRIFT = 5
"""Largest delay at either end of a session with a drift that is searched [pictures]; chosen by hand."""
_MOST_STARTS = 12
"""Number of instants from which another reading of the pictures is tried first; chosen by hand."""
_LEAST_VIEWS = 6
"""Least number of views of a camera that others see, too; chosen by hand."""
BY_VIEW = ("unsteady", "irregular")
"""Kinds of explanations with unknowns of their own for each picture."""
LEAST_GAIN = 60.0
"""Least fall of the cost of an explanation that counts: in clean made sessions it was at most 12."""
LEAST_EXPLAINED = 0.7
"""Least share of the cost beyond noise that an explanation must explain."""
LEAST_FREELY_EXPLAINED = 0.85
"""The same for explanations with unknowns of their own for each picture, which explain more by chance."""
_LARGEST_ZOOM, _LARGEST_TURN = 0.3, np.radians(30.0)
"""Largest change of the focal length, as a ratio, and of the orientation [rad] that is taken for one; by hand."""
_LEAST_SHIFT_PX, _LEAST_DELAY = 1.0, 0.05
"""Least median shift of an unsteady image [px] and of irregular times [pictures]; by hand. In the rendered session
`boards4`, whose cameras are steady, compression and blur shift the views by less than 1 px."""
_LEAST_TURN, _LEAST_ZOOM = np.radians(0.03), 1e-3
"""Least rotation [rad] and change of the focal length, as a ratio, that are stated; chosen by hand."""
_LEAST_SIDE = 3
"""Least number of such views on either side of an instant; chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Cause:
    """Why a camera contradicts the others."""

    kind: str
    """moved, lens-changed, turned, exchanged, late, drift, lost, rolling, unsteady, or irregular."""
    camera: int
    picture: int | None
    """The first picture after the change; None for what is constant."""
    change: Floats
    """(18,) changes in the order of `reference_views` from the picture on; the translation is that of the centre."""
    lag: int
    """Number of pictures by which the camera is late after the change."""
    gain: float
    """By how much the cost falls, twice the logarithm of the likelihood."""
    share: float
    """Share of the cost beyond noise that is explained."""
    other: int | None = None
    """The other one of two cameras that were exchanged."""

    @property
    def is_small(self) -> bool:
        """Whether the change is small enough for equations that are linear in it; a reversed image is not."""
        turn, zoom = float(np.linalg.norm(self.change[LENS : LENS + 3])), abs(float(self.change[ZOOM]))
        return turn < _LARGEST_TURN and zoom < _LARGEST_ZOOM

    @property
    def is_other_clock(self) -> bool:
        """Whether another clock of the camera was measured, not only a lag of its pictures on one side."""
        return self.kind in ("late", "drift", "lost") and bool(self.change[DELAY] or self.change[READOUT])

    @property
    def is_notable(self) -> bool:
        """Whether the change is large enough to be stated."""
        turn, zoom = float(np.linalg.norm(self.change[LENS : LENS + 3])), abs(float(self.change[ZOOM]))
        delay = max(abs(float(self.change[DELAY])), abs(float(self.change[READOUT])))
        least = {
            "moved": turn > _LEAST_TURN, "lens-changed": zoom > _LEAST_ZOOM, "late": delay > _LEAST_DELAY,
            "drift": delay > _LEAST_DELAY, "rolling": delay > _LEAST_DELAY,
        }  # fmt: skip
        return bool(least.get(self.kind, True))


def find_cause(solved: SolvedSession, corners: CornerSet, *, videos: bool) -> Cause | None:
    """Find what explains that a camera contradicts the others.

    Args:
        solved: The solved session.
        corners: All corners, also those that were left out.
        videos: Whether consecutive instants are consecutive pictures of videos.

    Returns:
        The best explanation; None if the cameras agree, or if none explains enough.
    """
    views = sum(each.camera is not None for each in solved.left_out)
    if max(solved.adjusted.spread) == 0.0 and views < _LEAST_SIDE:
        return None
    if views > len(solved.corners.view_starts):
        # Most views contradict the others: no single camera does.
        return None
    cameras = range(len(corners.cameras))
    return best_cause([each for camera in cameras for each in explanations(solved, corners, camera, videos=videos)])


def best_cause(found: Sequence[Cause]) -> Cause | None:
    """Choose among explanations.

    Args:
        found: Explanations of one or several cameras.

    Returns:
        That of the greatest gain among those that explain enough; one that differs from picture to picture only if no
        other does. None if none does.
    """
    for freely, least in ((False, LEAST_EXPLAINED), (True, LEAST_FREELY_EXPLAINED)):
        good = [
            each for each in found
            if (each.kind in BY_VIEW) == freely and each.gain > LEAST_GAIN and each.share > least
            and each.is_small and each.is_notable
        ]  # fmt: skip
        if good:
            return max(good, key=lambda each: each.gain)
    return None


def explanations(solved: SolvedSession, corners: CornerSet, camera: int, *, videos: bool) -> Iterator[Cause]:
    """Iterate over the best explanation of each kind for one camera.

    Args:
        solved: The solved session.
        corners: All corners, also those that were left out.
        camera: The camera.
        videos: Whether consecutive instants are consecutive pictures of videos.

    Yields:
        The explanations; none if the camera agrees with the others.
    """
    boards = reference_boards(solved, corners, camera)
    views = reference_views(solved, corners, camera, boards)
    if np.count_nonzero(views.compared) < _LEAST_VIEWS:
        return
    fit = _Fit(views, lens_prior(solved.state, camera), solved.state.camera_translation[camera])
    if fit.none - fit.least < LEAST_GAIN:
        return
    for kind, start, columns in fit.tried(videos=videos):
        yield fit.cause(kind, start, fit.cost(columns, start))
    yield from fit.by_view(videos=videos)
    turned = reference_views(solved, corners, camera, boards, turned=True)
    yield from fit.from_start({1: turned}, "turned")
    if videos:
        lags = (*range(-_MOST_LAG, 0), *range(1, _MOST_LAG + 1))
        shifted = {lag: reference_views(solved, corners, camera, boards, lag=lag) for lag in lags}
        yield from fit.from_start(shifted, "lost")
        yield from fit.drifting(shifted)


class _Fit:
    """The views of one camera, and how well explanations fit them."""

    def __init__(self, views: ReferenceViews, prior: Floats, translation: Floats):
        self.views, self.prior, self.translation = views, prior, translation
        self.limit = views.coordinates + _FAR * np.sqrt(2.0 * views.coordinates)
        self.none, _ = self.cost((), None)
        self.least = float(self._bounded(views.alone).sum())

    def cause(self, kind: str, start: int | None, fitted: tuple[float, Floats], lag: int = 0) -> Cause:
        """Return an explanation with the share of the cost beyond noise that it explains."""
        cost, change = fitted
        # A rotation about the origin of the world displaces the centre of the camera, too.
        change = change.copy()
        change[LENS + 3 : CAMERA] -= np.cross(change[LENS : LENS + 3], self.translation)
        share = (self.none - cost) / max(self.none - self.least, 1e-9)
        return Cause(
            kind=kind, camera=self.views.camera, picture=start, change=change, lag=lag, gain=self.none - cost,
            share=share,
        )  # fmt: skip

    def tried(self, *, videos: bool) -> Iterator[tuple[str, int | None, tuple[int, ...]]]:
        """Iterate over explanations: kind, first picture, and changes."""
        if videos:
            yield "late", None, (DELAY,)
            yield "rolling", None, (READOUT,)
        for kind, columns in (("moved", _POSE), ("lens-changed", _LENS)):
            start = self.best_start(columns)
            if start is not None:
                yield kind, start, columns

    def starts(self) -> Integers:
        """Return the pictures at which a change may begin."""
        seen = np.unique(self.views.picture[self.views.compared])
        return seen[_LEAST_SIDE : len(seen) - _LEAST_SIDE + 1]

    def best_start(self, columns: tuple[int, ...]) -> int | None:
        starts = self.starts()
        if not len(starts):
            return None
        step = max(len(starts) // _MOST_INSTANTS, 1)
        costs = {int(each): self.cost(columns, int(each))[0] for each in starts[::step]}
        best = int(np.flatnonzero(starts == min(costs, key=lambda each: costs[each]))[0])
        for each in starts[max(best - step + 1, 0) : best + step]:
            if int(each) not in costs:
                costs[int(each)] = self.cost(columns, int(each))[0]
        return min(costs, key=lambda each: costs[each])

    def cost(
        self, extra: tuple[int, ...], start: int | None, square: Floats | None = None, time: Floats | None = None
    ) -> tuple[float, Floats]:
        """Fit an explanation.

        Args:
            extra: Changes besides those of the camera that always count.
            start: First picture to which they apply; None for all.
            square: (V, 19, 19) the views; by default as they are.
            time: (V,) factors of the changes, such as the time of a drift.

        Returns:
            Cost of all views, and the changes (18,).
        """
        share = np.ones(len(self.views.picture)) if start is None else (self.views.picture >= start).astype(float)
        share = share if time is None else time
        index, base = np.array([*_BASE, *extra]), len(_BASE)
        every = np.append(index, CHANGES)
        rows = (self.views.square if square is None else square)[:, every][:, :, every]
        factor = np.ones((len(rows), len(every)))
        factor[:, base:-1] = share[:, None]
        rows = rows * factor[:, :, None] * factor[:, None, :]
        prior = np.zeros((len(index), len(index)))
        prior[:base, :base] = self.prior[np.ix_(_BASE, _BASE)]
        weight = np.ones(len(rows))
        for _ in range(_ROUNDS):
            total = np.tensordot(weight, rows, 1)
            normal = total[:-1, :-1] + prior
            size = np.sqrt(np.maximum(np.diag(normal), 1e-30))
            change = np.linalg.lstsq(normal / size[:, None] / size, total[:-1, -1] / size, rcond=1e-12)[0] / size
            vector = np.append(-change, 1.0)
            quadratic = np.maximum(((rows @ vector) * vector).sum(axis=1), 0.0)
            weight = np.minimum(1.0, np.sqrt(self.limit / np.maximum(quadratic, 1e-12)))
        full = np.zeros(CHANGES)
        full[list(extra)] = change[base:]
        return float(self._bounded(quadratic).sum() + change @ prior @ change), full

    def _bounded(self, quadratic: Floats) -> Floats:
        return np.where(quadratic < self.limit, quadratic, 2.0 * np.sqrt(self.limit * quadratic) - self.limit)

    def by_view(self, *, videos: bool) -> Iterator[Cause]:
        """Iterate over changes that differ from picture to picture: shifts of the image, or irregular times."""
        for kind, columns, sd, least in (
            ("unsteady", (2, 3), 20.0, _LEAST_SHIFT_PX),
            ("irregular", (DELAY,), 1.0, _LEAST_DELAY),
        ):
            if kind == "irregular" and not videos:
                continue
            own = list(columns)
            inner = self.views.square[:, own][:, :, own] + np.eye(len(own)) / sd**2
            across = self.views.square[:, own]
            freed = self.views.square - across.transpose(0, 2, 1) @ np.linalg.solve(inner, across)
            shift = np.linalg.solve(inner, across[:, :, CHANGES:])[self.views.compared, :, 0]
            if np.median(np.linalg.norm(shift, axis=1)) > least:
                yield self.cause(kind, None, self.cost((), None, freed))

    def from_start(self, others: Mapping[int, ReferenceViews], kind: str) -> Iterator[Cause]:
        """Return the best of several other readings of the views from one picture on."""
        starts = self.starts()
        starts = starts[:: -(-len(starts) // _MOST_STARTS)] if len(starts) else starts
        best: tuple[float, int, int, Floats] | None = None
        for lag, other in others.items():
            square, _ = self._aligned(other)
            for start in starts.tolist():
                late = self.views.picture >= start
                mixed = np.where(late[:, None, None], square, self.views.square)
                cost, _ = self.cost((), None, mixed)
                if best is None or cost < best[0]:
                    best = cost, lag, start, square
        if best is not None:
            _, lag, start, square = best
            yield self.cause(kind, *self._best_near(start, square), lag)

    def _best_near(self, start: int, square: Floats) -> tuple[int, tuple[float, Floats]]:
        """Return the best first picture near one for another reading of the views, with its fit."""
        starts = self.starts()
        at, reach = int(np.searchsorted(starts, start)), -(-len(starts) // _MOST_STARTS)
        found = {}
        for each in starts[max(at - reach, 0) : at + reach + 1].tolist():
            late = self.views.picture >= each
            found[each] = self.cost((), None, np.where(late[:, None, None], square, self.views.square))
        best = min(found, key=lambda each: found[each][0])
        return best, found[best]

    def _aligned(self, other: ReferenceViews) -> tuple[Floats, Mask]:
        """Return other readings of the same views, and which are known; the others stay as they are."""
        index = {int(picture): k for k, picture in enumerate(other.picture)}
        at = np.array([index.get(int(picture), -1) for picture in self.views.picture])
        known = (at >= 0) & other.compared[at] & self.views.compared
        return np.where(known[:, None, None], other.square[at], self.views.square), known

    def drifting(self, others: Mapping[int, ReferenceViews]) -> Iterator[Cause]:
        """Return the best delay that grows evenly."""
        lags = np.array(sorted([0, *others]))
        squares = {0: self.views.square} | {lag: self._aligned(other)[0] for lag, other in others.items()}
        stacked = np.stack([squares[int(lag)] for lag in lags])
        seen = self.views.picture[self.views.compared]
        first, last = int(seen.min()), int(seen.max())
        time = (self.views.picture - first) / max(last - first, 1)
        best: tuple[float, int, int, Integers] | None = None
        for begin in range(-_MOST_DRIFT, _MOST_DRIFT + 1):
            for end in range(-_MOST_DRIFT, _MOST_DRIFT + 1):
                if begin == end:
                    continue
                row = np.round(begin + (end - begin) * time).astype(int) - lags[0]
                row = np.clip(row, 0, len(lags) - 1)
                cost, _ = self.cost((), None, stacked[row, np.arange(len(row))])
                if best is None or cost < best[0]:
                    best = cost, begin, end, row
        if best is not None:
            _, begin, end, row = best
            chosen = stacked[row, np.arange(len(row))]
            # The delay within a picture is that of the line less the whole pictures.
            rest = (end - begin) * time + begin - lags[row]
            shifted = _with_delay(chosen, rest)
            shifted = _with_drift(shifted, time)
            cost, change = self.cost((DELAY, READOUT), None, shifted)
            change = change.copy()
            change[READOUT] += end - begin
            yield self.cause("drift", None, (cost, change), 0)


def _with_delay(square: Floats, delay: Floats) -> Floats:
    """Return views (V, 19, 19) whose residuals are those after a delay (V,)."""
    change = np.tile(np.eye(CHANGES + 1), (len(square), 1, 1))
    change[:, DELAY, CHANGES] = -delay
    return np.asarray(change.transpose(0, 2, 1) @ square @ change)


def _with_drift(square: Floats, time: Floats) -> Floats:
    """Return views in which the column of the readout is replaced by the delay times the time (V,)."""
    change = np.tile(np.eye(CHANGES + 1), (len(square), 1, 1))
    change[:, READOUT, READOUT] = 0.0
    change[:, DELAY, READOUT] = time
    return np.asarray(change.transpose(0, 2, 1) @ square @ change)

"""What would explain that the silhouettes of a take's cameras contradict each other: each repair is tried."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal, Protocol

import numpy as np
from scipy.optimize import least_squares

from marey.arrays import Floats
from marey.cameras.camera import Camera
from marey.errors import SettingProblem
from marey.fit.consistency.tangents import LARGEST_DIFFERENCE_PX, Outline, differences_px
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform

Kind = Literal["exchanged", "mirrored", "upside down", "turned", "late", "equal", "moved", "focal length"]
"""Kinds of explanations: calibrations in another order; pictures flipped from left to right, from top to bottom, or
both; pictures of other instants; equal calibrations; a camera with another direction or focal length."""

CONTRADICTION_PX = 3.0
"""Median difference of the tangents of two cameras above which they contradict each other [px of images in which a
person is about 300 px high]. It was at most 1.9 px for 33 of 34 pairs of the cameras of six sound takes, and 4.2 px for
one pair of a recording whose calibration is known to be poor. The largest one of four cameras was 6.8 px or more with a
delay of 3 frames of `walk`, and 4.2 px in `reach`; with a camera turned by 1 degree, 5.4 px or more."""
CLEARLY_SMALLER = 2.0
"""Factor by which an explanation must reduce the differences. Of 98 planted faults in six takes, the right explanation
reduced them by a factor of 2.7 or more, but for one exchange of cameras with pictures of different sizes and for delays
that the motion hardly shows; the best wrong one reduced those of a recording without a fault by a factor of 1.5."""
RIVAL = 1.5
"""Explanations whose differences are within this factor of the best one's are rivals of it. Chosen by hand."""
NOISE_LEVEL_PX = 0.5
"""Differences below this [px] are equally small: they are the errors of silhouettes. Chosen by hand."""
LARGEST_TURN = 0.35
"""Largest rotation of a camera that was moved [rad]: a camera that was turned by more shows something else. Chosen by
hand."""
LARGEST_FOCAL_FACTOR = 2.0
"""Largest factor of another focal length, and of the calibrated one to a smaller one. Chosen by hand."""
COMMON_FACTOR_STARTS = (0.8, 1.0, 1.25)
"""Factors of the focal lengths of all cameras from which their fit starts: with 1 alone it ends at 0.99 for `jacks`
with focal lengths that are 20 % too large. Other values were not measured."""
LEAST_COMMON_FACTOR = 0.05
"""Least relative change of the focal lengths of all cameras that is named. It is 0.003 to 0.016 for `walk` and `reach`,
and 0.055 or less for recordings whose contradictions it hardly reduces."""
LARGEST_OWN_ERROR_PX = 2.0
"""Largest difference of one pair of cameras that errors of the silhouettes explain [px]. It was at most 1.9 px for
sound cameras. Of 90 sound recordings of 30 frames by two cameras of `stealth`, `walk`, `jacks` and `reach`, another
focal length halves differences of 0.6 to 1.8 px in three; of 75 by three or four cameras, in none."""
_EQUAL_M, _EQUAL_RAD = 1e-3, 1e-3
"""Differences of position [m] and direction [rad] below which two calibrations are equal."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Explanation:
    """One change of the cameras or of their pictures, and how well all cameras agree with it."""

    kind: Kind
    """What was changed."""
    numbers: tuple[int, ...]
    """The cameras that it concerns, by number."""
    amount: float = 0.0
    """How much: frames (late), radians (moved), factor (focal length); 0 where it has no meaning."""
    order: tuple[int, ...] = ()
    """(exchanged) for each camera the one whose calibration belongs to its pictures."""
    level_px: float
    """Mean over the pairs of cameras of the median difference of their tangents [px]."""

    @property
    def freedom(self) -> int:
        """Number of parameters that were fitted."""
        return {"late": 1, "focal length": 1, "moved": 3}.get(self.kind, 0)


class ShownOutlines(Protocol):
    """Returns the outlines of one camera, given by its number."""

    def __call__(self, camera: int, shift: int = 0) -> Sequence[Outline]:
        """Return the outlines of F frames, or of pictures that are some numbers later; empty ones where none is."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Contradictions:
    """How well the cameras of a take agree, and what would make them agree."""

    level_px: float
    """Mean over the pairs of cameras of the median difference of their tangents [px]; NaN if none can be compared."""
    pairs_px: Mapping[tuple[int, int], float]
    """Median difference of each pair of cameras [px]."""
    equal: tuple[tuple[int, int], ...]
    """Pairs of cameras whose calibrations are equal."""
    explanations: tuple[Explanation, ...]
    """The explanations that were tried, the best first; empty if the cameras agree."""

    @property
    def exist(self) -> bool:
        """Whether two cameras contradict each other."""
        return bool(self.equal) or max(self.pairs_px.values(), default=0.0) > CONTRADICTION_PX

    @property
    def within_errors(self) -> bool:
        """Whether errors of the silhouettes may be all that is explained: nothing confirms a single pair of cameras."""
        return not self.equal and len(self.pairs_px) < 2 and self.level_px <= LARGEST_OWN_ERROR_PX

    @property
    def best(self) -> Explanation | None:
        """The best explanation; None if none explains the contradictions."""
        return next((each for each in self.explanations if self._explains(each)), None)

    @property
    def rivals(self) -> tuple[Explanation, ...]:
        """Explanations about as good as the best one that concern other cameras, and have not more parameters."""
        best = self.best
        if best is None or best.kind == "equal":
            return ()
        limit = RIVAL * max(best.level_px, NOISE_LEVEL_PX)
        return tuple(
            each
            for each in self.explanations
            if each.level_px <= limit and each.freedom <= best.freedom and self._explains(each)
            and each.numbers != best.numbers
        )  # fmt: skip

    def _explains(self, explanation: Explanation) -> bool:
        limit = max(self.level_px / CLEARLY_SMALLER, NOISE_LEVEL_PX)
        return explanation.kind == "equal" or explanation.level_px < limit


def contradictions(
    cameras: Sequence[Camera], shown: ShownOutlines, *, longest_delay: int = 0, shifts: Sequence[int] | None = None,
    explain: bool = True,
) -> Contradictions:  # fmt: skip
    """Compare the silhouettes of all cameras, and try to explain contradictions.

    Args:
        cameras: C cameras.
        shown: The outlines.
        longest_delay: Largest delay of one camera that is tried [frames].
        shifts: (C,) by how many pictures each camera is late, if an estimate of the clocks is to be tried as well.
        explain: Whether explanations are tried.

    Returns:
        The contradictions.
    """
    equal = [pair for pair in combinations(range(len(cameras)), 2) if _equal(*(cameras[c] for c in pair))]
    found = differences_px(cameras, [shown(c) for c in range(len(cameras))])
    pairs = {pair: _median(each) for pair, each in found.items()}
    tried: list[Explanation] = []
    if explain and (equal or max(pairs.values(), default=0.0) > CONTRADICTION_PX):
        trial = _Trial(cameras, shown, found)
        tried = [*_of_equal(trial, equal), *trial.exchanges(), *trial.pictures(), *trial.delays(longest_delay)]
        tried += [] if shifts is None else trial.clocks(shifts)
        if min((each.level_px for each in tried), default=LARGEST_DIFFERENCE_PX) > NOISE_LEVEL_PX:
            # Fitted parameters cannot explain the pictures better than that.
            tried += [*trial.moves(), *trial.lenses()]
    order = sorted(tried, key=_rank)
    return Contradictions(level_px=_level(found), pairs_px=pairs, equal=tuple(equal), explanations=tuple(order))


def common_lens(cameras: Sequence[Camera], shown: ShownOutlines) -> Contradictions | None:
    """Find whether the pictures of all cameras were enlarged by one factor, which moves no tangent by much.

    Args:
        cameras: C cameras.
        shown: The outlines.

    Returns:
        The contradictions, which the focal length of all cameras explains; None if it does not.
    """
    found = differences_px(cameras, [shown(c) for c in range(len(cameras))])
    lens = _Trial(cameras, shown, found).common_lens()
    pairs = {pair: _median(each) for pair, each in found.items()}
    result = Contradictions(level_px=_level(found), pairs_px=pairs, equal=(), explanations=(lens,))
    halved = lens.level_px < result.level_px / CLEARLY_SMALLER
    return result if halved and abs(lens.amount - 1) > LEAST_COMMON_FACTOR else None


def _rank(explanation: Explanation) -> tuple[bool, float, int, float]:
    """Return a rank: equal calibrations first; of explanations that are equally good, those with fewer parameters."""
    level = max(explanation.level_px, NOISE_LEVEL_PX)
    return explanation.kind != "equal", level, explanation.freedom, explanation.level_px


def _equal(first: Camera, second: Camera) -> bool:
    """Whether two cameras have the same place and direction."""
    turn = first.camera_from_world.rotation @ second.camera_from_world.rotation.T
    angle = np.arccos(np.clip(0.5 * (np.trace(turn) - 1), -1, 1))
    return bool(np.linalg.norm(first.centre - second.centre) < _EQUAL_M and angle < _EQUAL_RAD)


def _median(difference: Floats) -> float:
    return float(np.nanmedian(np.minimum(np.abs(difference), LARGEST_DIFFERENCE_PX)))


def _level(found: Mapping[tuple[int, int], Floats]) -> float:
    return float(np.mean([_median(each) for each in found.values()])) if found else float("nan")


def _of_equal(trial: "_Trial", pairs: Sequence[tuple[int, int]]) -> Iterator[Explanation]:
    """Explain contradictions by equal calibrations; of two equal ones, that which contradicts the others is wrong."""
    if not pairs:
        return
    concerned = sorted({c for pair in pairs for c in pair})
    if len(pairs) == 1 and len(trial.cameras) > 3:
        levels = {c: trial.level_of([c]) for c in pairs[0]}
        wrong = max(levels, key=lambda c: levels[c])
        right = levels[pairs[0][0] + pairs[0][1] - wrong]
        if right < max(levels[wrong] / CLEARLY_SMALLER, NOISE_LEVEL_PX):
            concerned = [wrong]
    yield Explanation(kind="equal", numbers=tuple(concerned), level_px=0.0)


@dataclass(frozen=True, eq=False)
class _Trial:
    """Cameras and their outlines, with the differences of all pairs."""

    cameras: Sequence[Camera]
    shown: ShownOutlines
    found: Mapping[tuple[int, int], Floats]

    def level_of(self, chosen: Sequence[int]) -> float:
        """Return the mean difference of the pairs that contain one of some cameras [px]."""
        own = {pair: each for pair, each in self.found.items() if set(pair) & set(chosen)}
        return _level(own) if own else LARGEST_DIFFERENCE_PX

    def level(
        self,
        changed: Sequence[int],
        cameras: Mapping[int, Camera] | None = None,
        outlines: Mapping[int, Sequence[Outline]] | None = None,
    ) -> float:
        """Return the mean difference of all pairs with other cameras or outlines of some numbers [px]."""
        own = [(cameras or {}).get(c, camera) for c, camera in enumerate(self.cameras)]
        shown = [(outlines or {}).get(c) or self.shown(c) for c in range(len(own))]
        again = differences_px(own, shown, changed)
        # A pair that cannot be compared any more is no better than before.
        kept = {pair: each for pair, each in self.found.items() if not set(pair) & set(changed)}
        every = kept | again
        medians = [_median(every[pair]) if pair in every else LARGEST_DIFFERENCE_PX for pair in self.found]
        return float(np.mean(medians)) if medians else LARGEST_DIFFERENCE_PX

    def exchanges(self) -> Iterator[Explanation]:
        """Try the calibrations of two or three cameras in another order."""
        for order in _orders(len(self.cameras)):
            moved = tuple(c for c, other in enumerate(order) if c != other)
            if all(self.cameras[c].size == self.cameras[order[c]].size for c in moved):
                level = self.level(moved, {c: self.cameras[order[c]] for c in moved})
                yield Explanation(kind="exchanged", numbers=moved, order=order, level_px=level)

    def pictures(self) -> Iterator[Explanation]:
        """Try mirrored and turned pictures of each camera."""
        ways: tuple[tuple[Kind, bool, bool], ...] = (
            ("mirrored", True, False), ("upside down", False, True), ("turned", True, True),
        )  # fmt: skip
        for c, camera in enumerate(self.cameras):
            for kind, across, down in ways:
                shown = [_flipped(outline, camera, across=across, down=down) for outline in self.shown(c)]
                yield Explanation(kind=kind, numbers=(c,), level_px=self.level([c], outlines={c: shown}))

    def delays(self, longest: int) -> Iterator[Explanation]:
        """Try pictures of each camera that are some frames late or early, up to a largest number."""
        for c in range(len(self.cameras)) if longest else ():
            shifts = [shift for shift in range(-longest, longest + 1) if shift]
            levels = {shift: self.level([c], outlines={c: self.shown(c, shift)}) for shift in shifts}
            best = min(levels, key=lambda shift: levels[shift])
            yield Explanation(kind="late", numbers=(c,), amount=best, level_px=levels[best])

    def clocks(self, shifts: Sequence[int]) -> Iterator[Explanation]:
        """Try pictures of all cameras that are late by given numbers of frames, as few of them as possible."""
        usual = max(shifts, key=shifts.count)
        shifts = [shift - usual for shift in shifts]
        moved = tuple(c for c, shift in enumerate(shifts) if shift)
        if len(moved) > 1:
            level = self.level(moved, outlines={c: self.shown(c, shifts[c]) for c in moved})
            yield Explanation(kind="late", numbers=moved, amount=max(shifts, key=abs), level_px=level)

    def moves(self) -> Iterator[Explanation]:
        """Try another direction of each camera."""
        for c, camera in enumerate(self.cameras):
            turn = self._fitted([c], _turned, np.zeros(3), LARGEST_TURN)
            level = self.level([c], {c: _turned(camera, turn)})
            yield Explanation(kind="moved", numbers=(c,), amount=float(np.linalg.norm(turn)), level_px=level)

    def lenses(self) -> Iterator[Explanation]:
        """Try another focal length of each camera, and of all of them."""
        for c in range(len(self.cameras)):
            yield self._lens((c,), 1.0)
        yield self.common_lens()

    def common_lens(self) -> Explanation:
        """Try another focal length of all cameras by one factor, as of pictures that were enlarged."""
        every = tuple(range(len(self.cameras)))
        tried = [self._lens(every, factor) for factor in COMMON_FACTOR_STARTS]
        return min(tried, key=lambda each: each.level_px)

    def _lens(self, numbers: tuple[int, ...], start: float) -> Explanation:
        log = self._fitted(numbers, _zoomed, np.log([start]), float(np.log(LARGEST_FOCAL_FACTOR)))
        try:
            level = self.level(numbers, {c: _zoomed(self.cameras[c], log) for c in numbers})
        except SettingProblem:
            # A lens with strong distortion is not invertible with any focal length.
            level = LARGEST_DIFFERENCE_PX
        return Explanation(kind="focal length", numbers=numbers, amount=float(np.exp(log[0])), level_px=level)

    def _fitted(
        self, numbers: Sequence[int], changed: Callable[[Camera, Floats], Camera], start: Floats, limit: float
    ) -> Floats:
        """Return the parameters of a change of some cameras with which all tangents agree best."""
        known = {pair: np.isfinite(each) for pair, each in self.found.items() if set(numbers) & set(pair)}
        if not known:
            return start

        outlines = [self.shown(k) for k in range(len(self.cameras))]

        def residual(x: Floats) -> Floats:
            missing = np.full(next(iter(known.values())).shape, LARGEST_DIFFERENCE_PX)
            try:
                cameras = [changed(own, x) if k in numbers else own for k, own in enumerate(self.cameras)]
                again = differences_px(cameras, outlines, numbers)
            except SettingProblem:
                again = {}
            parts = [again.get(pair, missing)[where] for pair, where in known.items()]
            every = np.nan_to_num(np.concatenate(parts), nan=LARGEST_DIFFERENCE_PX)
            return np.asarray(np.clip(every, -LARGEST_DIFFERENCE_PX, LARGEST_DIFFERENCE_PX))

        found = least_squares(
            residual, start, bounds=(-limit, limit), loss="soft_l1", f_scale=1.0, diff_step=1e-4,
            x_scale=0.02, max_nfev=25,
        )  # fmt: skip
        return np.asarray(found.x)


def _orders(count: int) -> Iterator[tuple[int, ...]]:
    """List the orders of cameras in which two of them, or three in a cycle, are exchanged."""
    for size in (2, 3):
        for chosen in combinations(range(count), size):
            for step in range(1, size):
                order = list(range(count))
                for k, c in enumerate(chosen):
                    order[c] = chosen[(k + step) % size]
                yield tuple(order)


def _flipped(outline: Outline, camera: Camera, *, across: bool, down: bool) -> Outline:
    """Return the outline in a picture that is flipped from left to right, from top to bottom, or both."""
    size, flip = np.array(camera.size, float), np.array([across, down])
    return replace(outline, pixels=np.where(flip, size - 1 - outline.pixels, outline.pixels))


def _turned(camera: Camera, turn: Floats) -> Camera:
    """Return a camera that is turned about its centre by a rotation vector (3,) in its own axes [rad]."""
    rotation = rotations.exp(np.asarray(turn, float))
    pose = camera.camera_from_world
    return replace(camera, camera_from_world=RigidTransform(rotation @ pose.rotation, rotation @ pose.translation))


def _zoomed(camera: Camera, logarithm: Floats) -> Camera:
    """Return a camera with another focal length, by the logarithm (1,) of its factor."""
    matrix, factor = np.array(camera.matrix), np.exp(logarithm[0])
    matrix[0, :2] *= factor
    matrix[1, 1] *= factor
    return replace(camera, matrix=matrix)

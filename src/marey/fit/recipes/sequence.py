"""The whole sequence at once: every pose and the one shape in a single system, banded in time, bordered by the shape.

A pose's observations touch that pose and the shape; smoothness touches three neighbours in time. The
normal equations are block-banded with a border, and are solved as such ([Plaenkers1999] section 4.1 for the
weighting; the structure is ours), a long sequence in windows that overlap: time grows as the number of frames, and
memory hardly.
"""

from collections.abc import Callable, Container, Generator, Iterator, Mapping, MutableMapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from marey.arrays import Floats, Integers
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.skeleton import Skeleton
from marey.body.articulation.surface import Body, ShapeSpace
from marey.body.metaballs.metaball_person import reshaped
from marey.fit.recipes.track import TRUNK
from marey.fit.search.levels import FrameLevels
from marey.fit.solver.banded import System, Window, windows, with_shape_covariance
from marey.fit.solver.body_solver import bounded_step, dense_equations, shape_reach
from marey.fit.solver.moments import gather_moments
from marey.fit.solver.normal_equations import normal_equations
from marey.fit.solver.pose_solver import Schedule, add_dense, match_all
from marey.fit.solver.side_by_side import side_by_side
from marey.observations.correspondence import Residual, Sighting
from marey.observations.prior import Habit, JointLimits, ShapePrior


@dataclass(frozen=True, kw_only=True)
class SequenceSettings:
    """What is known of motion and shape before looking."""

    limb_acceleration: float = 95.0
    """Standard deviation of a limb's angular acceleration [rad/s2]."""
    trunk_acceleration: float = 47.0
    root_acceleration: float = 12.0
    """Standard deviation of the pelvis' acceleration [m/s2]."""
    habit: float = 0.1
    """How many observations the joints' habits are worth in each frame."""
    gate: tuple[float, float] = (20.0, 5.0)
    scale: tuple[float, float] = (6.0, 2.0)
    sigma_px: float = 3.2
    residual: Residual = "plane"
    vote: bool = True
    interior: bool = True
    """What outlines say, as in `Schedule`."""
    clip: float = 3.0
    """No shape number goes farther from the prior's mean than so many standard deviations."""


TRUST_M, TRUST_RAD, TRUST_SHAPE = 0.1, 0.2, 0.7
"""How far one round may go where the observations leave it open: Levenberg's and Marquardt's damping [m, rad, sd]."""


@dataclass(frozen=True, eq=False)
class SequenceFit:
    """The refined motion and shape, and what is known of them."""

    frames: Integers
    """(F,) the frames, in order."""
    poses: tuple[Pose, ...]
    body: Body
    """With the shape's numbers and, where they were free, their covariance."""
    covariance: Floats
    """(F, D + M, D + M) of each pose, and of the shape with it where that was free."""
    information: Floats
    """(F, D, D) what each frame's own observations say of its pose."""
    residual_px: float
    """Weighted root mean square of the matches' distances across the contours [px]."""

    @property
    def by_frame(self) -> dict[int, Pose]:
        """The poses by frame."""
        return dict(zip(map(int, self.frames), self.poses, strict=True))


def acceleration_spread(skeleton: Skeleton, settings: SequenceSettings) -> Floats:
    """Give the standard deviation (D,) of each coordinate's acceleration [m/s2, rad/s2]."""
    turns = [
        settings.trunk_acceleration if c.segment in TRUNK else settings.limb_acceleration for c in skeleton.coordinates
    ]
    return np.array([settings.root_acceleration] * 3 + [settings.trunk_acceleration] * 3 + turns)


WINDOW, OVERLAP = 8.0, 1.0
"""A longer take is refined in windows of so many seconds, each with neighbours of so many seconds on both sides."""
LONGEST_WINDOW, LONGEST_OVERLAP = 600, 120
"""The same in frames, where there are many in a second."""


Arrays = dict[str, Floats]


class FrameTerms(Protocol):
    """What other observations say of a frame."""

    @property
    def shared(self) -> int:
        """Count the unknowns G that all frames share beside the shape: they are found anew in each round."""

    def terms(self, frame: int, posed: PosedBody) -> tuple[Floats, Floats]:
        """Give what they say of pose, shape and the shared unknowns: (D + M + G, D + M + G) and (D + M + G,)."""


Further = Callable[[Mapping[int, Pose], Body], FrameTerms]
"""Makes other observations ready for a round, in which the poses by frame and the body stand so."""


@dataclass(frozen=True, eq=False)
class RefineMemory:
    """What a refinement has done so far, as arrays by name; on disk it survives an interruption, and leaves room."""

    rounds: MutableMapping[int, Arrays] = field(default_factory=dict)
    """Poses and shape after each round but the last."""
    parts: MutableMapping[tuple[int, int], Arrays] = field(default_factory=dict)
    """What the windows of the round in work said, by round and window."""


def refine_sequence(
    frames: Sequence[int],
    poses: Sequence[Pose],
    body: Body,
    levels: FrameLevels,
    *,
    rate: float,
    rounds: int,
    shape_frames: Sequence[int] = (),
    settings: SequenceSettings | None = None,
    blind: Container[int] = (),
    also: Further | None = None,
    done: Callable[[int], None] = lambda frame: None,
    memory: RefineMemory | None = None,
) -> SequenceFit:
    """Refine all poses, and the shape where frames for it are named, in one system.

    See `refine_in_pieces`, whose pieces this joins.
    """
    return joined(
        list(
            refine_in_pieces(
                frames, poses, body, levels, rate=rate, rounds=rounds, shape_frames=shape_frames, settings=settings,
                blind=blind, also=also, done=done, memory=memory,
            )
        )
    )  # fmt: skip


def refine_in_pieces(
    frames: Sequence[int],
    poses: Sequence[Pose],
    body: Body,
    levels: FrameLevels,
    *,
    rate: float,
    rounds: int,
    shape_frames: Sequence[int] = (),
    settings: SequenceSettings | None = None,
    blind: Container[int] = (),
    also: Further | None = None,
    done: Callable[[int], None] = lambda frame: None,
    memory: RefineMemory | None = None,
) -> Iterator[SequenceFit]:
    """Refine all poses, and the shape where frames for it are named; give the answer piece by piece.

    Up to some ten seconds are one system. A longer take is solved in windows, of which each also looks at a second
    before and after: what lies farther away does not change a frame's answer by any part of its standard deviation
    that counts (docs/accuracy.md), and neither memory nor time grow faster than the take. The shape hears the shape
    frames of all windows.

    Args:
        frames: (F,) in order; smoothness holds between frames whose numbers follow each other.
        poses: one a frame.
        body: the person; its shape numbers are free when `shape_frames` are named.
        levels: silhouettes.
        rate: frames in a second.
        rounds: how often correspondence and solution follow each other.
        shape_frames: frames whose outlines also speak of the shape.
        settings: what is known before.
        blind: frames whose silhouettes are not believed; only their neighbours speak of them.
        also: what else was observed in a frame, for example points of the surface.
        done: told of every frame in every round.
        memory: takes each window and each round as soon as it is done; what it holds already is not done again.
    """
    if rounds < 1:
        raise ValueError("at least one round is needed")
    memory = memory or RefineMemory()
    settings = settings or SequenceSettings()
    work = _Work(list(frames), levels, set(shape_frames), blind, rate, rounds, settings, done, memory, body, also)
    poses = list(poses)
    for round_ in range(rounds - 1):
        if round_ in memory.rounds:
            poses, body = _unpacked(memory.rounds[round_], work.first)
            for frame in frames:
                done(frame)
            continue
        work.hear(poses, body, round_)
        poses, body = work.stepped(poses, body, round_)
        memory.rounds[round_] = _packed(poses, body)
        memory.parts.clear()
    work.hear(poses, body, rounds - 1)
    yield from work.pieces(poses, body)


def _packed(poses: Sequence[Pose], body: Body) -> Arrays:
    return {
        "translation": np.array([pose.translation for pose in poses]),
        "rotation": np.array([pose.rotation for pose in poses]),
        "angles": np.array([pose.angles for pose in poses]),
        "numbers": np.array(body.numbers),
    }


def _unpacked(arrays: Arrays, body: Body) -> tuple[list[Pose], Body]:
    parts = zip(arrays["translation"], arrays["rotation"], arrays["angles"], strict=True)
    return [Pose(*part) for part in parts], reshaped(body, arrays["numbers"])


DISTINCT_FRAMES = 3.0
"""Frames whose misfits of the body are no repetition of each other's: however many are used, the shape is known no
better than from so many (docs/accuracy.md)."""


@dataclass(frozen=True, eq=False)
class _Equations:
    """One frame's normal equations, and how well it fits."""

    hessian: Floats
    gradient: Floats
    squares: float
    total: float


@dataclass(frozen=True, eq=False)
class _Work:
    """What stays the same over the rounds of a refinement."""

    frames: list[int]
    levels: FrameLevels
    free: set[int]
    blind: Container[int]
    rate: float
    rounds: int
    settings: SequenceSettings
    done: Callable[[int], None]
    memory: RefineMemory
    first: Body
    """As it was before; of other numbers it is always made from here, so that an interruption changes nothing."""
    also: Further | None = None

    @cached_property
    def windows(self) -> list[Window]:
        """The stretches that are solved at once."""
        length, overlap = round(WINDOW * self.rate), round(OVERLAP * self.rate)
        return windows(
            len(self.frames), min(max(length, 60), LONGEST_WINDOW), min(max(overlap, 15), LONGEST_OVERLAP)
        )  # fmt: skip

    def hear(self, poses: Sequence[Pose], body: Body, round_: int) -> None:
        """Go through the windows: match every frame once, eliminate each window's poses, and remember what is left."""
        begun = 0
        while (round_, begun) in self.memory.parts:
            begun += 1
        wanted = self.windows[begun:]
        for frame in self.frames[: wanted[0].first if wanted else None]:
            self.done(frame)
        if not wanted:
            return
        further = None if self.also is None else self.also(dict(zip(self.frames, poses, strict=True)), body)
        stream = self._equations(poses, body, round_, wanted[0].first, further)
        waiting: dict[int, _Equations] = {}
        for i, window in enumerate(wanted, begun):
            for f in range(max(waiting, default=window.first - 1) + 1, window.last):
                waiting[f] = next(stream)
            for f in [f for f in waiting if f < window.first]:
                del waiting[f]
            self.memory.parts[round_, i] = self._part(window, waiting, poses, body, last=round_ == self.rounds - 1)
        stream.close()

    def _equations(
        self, poses: Sequence[Pose], body: Body, round_: int, first: int, further: FrameTerms | None
    ) -> Generator[_Equations, None, None]:
        settings = self.settings
        schedule = Schedule(
            iterations=max(self.rounds, 2), gate=settings.gate, scale=settings.scale, cosine=0.5,
            sigma_px=settings.sigma_px, residual=settings.residual, vote=settings.vote, interior=settings.interior,
        )  # fmt: skip
        matching, scale = schedule.at(round_)
        priors = (JointLimits(), Habit(share=settings.habit))

        def equations(f: int, sightings: Sequence[Sighting]) -> _Equations:
            posed = PosedBody(body, poses[f])
            found, weights = match_all(posed, sightings, matching, scale)
            if self.frames[f] in self.free:
                hessian, gradient, _ = dense_equations(posed, found, weights, priors)
            else:
                hessian, gradient, _ = normal_equations(posed, gather_moments(posed, found, weights))
                add_dense(posed, priors, hessian, gradient)
            if further is not None:
                hessian, gradient = _added(hessian, gradient, *further.terms(self.frames[f], posed), posed.body)
            across = sum(float(w @ (m.residuals(posed) ** 2).sum(1)) for w, m in zip(weights, found, strict=True))
            return _Equations(hessian, gradient, across, sum(float(w.sum()) for w in weights))

        # The silhouettes are read here, one frame after the other; only what is computed from them runs side by side.
        tasks = ((f, self._sightings(self.frames[f])) for f in range(first, len(self.frames)))
        for f, found in enumerate(side_by_side(lambda task: equations(*task), tasks), first):
            self.done(self.frames[f])
            yield found

    def _sightings(self, frame: int) -> Sequence[Sighting]:
        return () if frame in self.blind else self.levels.at(frame).sightings

    def _part(
        self, window: Window, found: Mapping[int, _Equations], poses: Sequence[Pose], body: Body, *, last: bool
    ) -> Arrays:
        """Give what one window says: how its poses answer, and what its own frames ask of the shape."""
        degrees, first = len(body.skeleton), window.first
        shared = max(len(found[f].gradient) for f in range(first, window.last)) - degrees
        system = System.empty(window.last - first, degrees, shared)
        for f in range(first, window.last):
            system.add_frame(f - first, found[f].hessian, found[f].gradient, degrees)
        spread = acceleration_spread(body.skeleton, self.settings) / self.rate**2
        for f in range(first + 1, window.last - 1):
            if self.frames[f + 1] - self.frames[f - 1] == 2:
                system.add_smoothness(f - first, poses[first : window.last], spread)
        core = range(window.begin, window.end)
        own = [found[f] for f in core if len(found[f].gradient) > degrees]
        none = np.zeros((max(shared, len(body.space)),) * 2)
        part = system.eliminate(np.array([TRUST_M] * 3 + [TRUST_RAD] * (degrees - 3)), window.core) | {
            "corner": sum((e.hessian[degrees:, degrees:] for e in own), none),
            "shape_gradient": sum((e.gradient[degrees:] for e in own), np.zeros(len(none))),
            "squares": np.array(sum(found[f].squares for f in core)),
            "total": np.array(sum(found[f].total for f in core)),
        }
        if last:
            part |= system.covariances(degrees, window.core)
            part["information"] = np.array([found[f].hessian[:degrees, :degrees] for f in core])
        return part

    def _parts(self, round_: int) -> Iterator[Arrays]:
        return (self.memory.parts[round_, i] for i in range(len(self.windows)))

    def stepped(self, poses: Sequence[Pose], body: Body, round_: int) -> tuple[list[Pose], Body]:
        """Solve for the shape, and step."""
        shape = self._shape_step(poses, body, round_)
        moved: list[Pose] = []
        for window, part in zip(self.windows, self._parts(round_), strict=True):
            steps = -(part["own"] + part["by_shape"] @ shape[: part["by_shape"].shape[1]])
            own = poses[window.begin : window.end]
            moved += [pose.step(step) for pose, step in zip(own, steps.reshape(len(own), -1), strict=True)]
        return moved, reshaped(self.first, body.numbers + shape[: len(body.space)]) if self.free else body

    def _shape_step(self, poses: Sequence[Pose], body: Body, round_: int) -> Floats:
        """Give the step (M + G,) of the shape's numbers and of what else all frames share."""
        numbers, count = len(body.space), self._shared(body, round_)
        if not self.free and count == numbers:
            return np.zeros(numbers)
        information, gradient = _shape_prior(body, poses[0], count)
        if not self.free:
            gradient[:] = 0.0
        for part in self._parts(round_):
            information, gradient = information + part["corner"], gradient + part["shape_gradient"]
            if part["by_shape"].shape[1]:
                information, gradient = information - part["taken"], gradient - part["taken_gradient"]
        trusted = np.concatenate([_trusted(body.space), np.full(count - numbers, TRUST_M**2)])
        information = 0.5 * (information + information.T) + np.diag(1.0 / trusted)
        least, greatest = shape_reach(body, self.settings.clip)
        anywhere = np.full(count - numbers, _FAR)
        return bounded_step(information, gradient, np.append(least, -anywhere), np.append(greatest, anywhere))

    def _shared(self, body: Body, round_: int) -> int:
        """Count the shape's numbers and what else all frames share."""
        if self.also is None:
            return len(body.space)
        return max(len(part["corner"]) for part in self._parts(round_))

    def pieces(self, poses: Sequence[Pose], body: Body) -> Iterator[SequenceFit]:
        """Step for the last time, and give each window's answer with its covariances."""
        round_ = self.rounds - 1
        moved, stepped = self.stepped(poses, body, round_)
        numbers, degrees = len(body.space), len(body.skeleton)
        information, _ = _shape_prior(body, poses[0], self._shared(body, round_))
        squares = total = 0.0
        for part in self._parts(round_):
            squares, total = squares + float(part["squares"]), total + float(part["total"])
            information = information + part["corner"]
            if part["spread"].shape[2]:
                information = information - part["loss"]
        shape = np.linalg.inv(0.5 * (information + information.T))
        if self.free:
            alone = np.linalg.inv(shape[:numbers, :numbers])
            stepped = replace(stepped, numbers_covariance=self._stated(alone, poses[0], body))
        residual = float(np.sqrt(squares / total)) if total else float("nan")
        for window, part in zip(self.windows, self._parts(round_), strict=True):
            core = slice(window.begin, window.end)
            covariance = part["blocks"]
            if part["spread"].shape[2] or self.free:
                covariance = with_shape_covariance(part["blocks"], part["spread"], shape)
                known = degrees + (numbers if self.free else 0)
                covariance = covariance[:, :known, :known]
            yield SequenceFit(
                np.array(self.frames[core]), tuple(moved[core]), stepped, covariance, part["information"], residual
            )

    def _stated(self, information: Floats, pose: Pose, body: Body) -> Floats:
        """Give the covariance (M, M) of the shape's numbers from its information, the poses' share taken off."""
        prior, _ = _shape_prior(body, pose)
        alike = min(1.0, DISTINCT_FRAMES / len(self.free))
        stated = prior + alike * (0.5 * (information + information.T) - prior)
        return np.asarray(np.linalg.inv(stated))


def _trusted(space: ShapeSpace) -> Floats:
    """Give the variance (M,) within which one round may move the shape's numbers, each in its own unit."""
    variance = np.diag(space.prior_covariance)
    usual = np.median(variance) if len(variance) else 0.0
    return np.asarray(TRUST_SHAPE**2 * np.maximum(variance, usual))


_FAR = 1.0
"""How far what all frames share beside the shape may lie from where it stands: in effect anywhere [m, rad]."""


def _shape_prior(body: Body, pose: Pose, count: int | None = None) -> tuple[Floats, Floats]:
    """Give the prior's information and gradient at the body's numbers; of count unknowns, the others may be any."""
    white = ShapePrior().whiten(PosedBody(body, pose), shape=True)
    jacobian = white.jacobian[:, len(body.skeleton) :]
    numbers = len(body.space)
    count = numbers if count is None else count
    information, gradient = np.eye(count) / _FAR**2, np.zeros(count)
    information[:numbers, :numbers] = jacobian.T @ jacobian
    gradient[:numbers] = jacobian.T @ white.residual
    return information, gradient


def _added(hessian: Floats, gradient: Floats, more: Floats, pull: Floats, body: Body) -> tuple[Floats, Floats]:
    """Add further equations to a frame's; where the frame does not speak of the shape, nor do they."""
    degrees, numbers, size = len(body.skeleton), len(body.space), len(gradient)
    if size == degrees:
        kept = np.r_[0:degrees, degrees + numbers : len(pull)]
        if len(kept) == degrees:
            return hessian + more[:degrees, :degrees], gradient + pull[:degrees]
        silent = np.setdiff1d(np.arange(len(pull)), kept)
        more, pull = more.copy(), pull.copy()
        more[silent], more[:, silent], pull[silent] = 0.0, 0.0, 0.0
    more[:size, :size] += hessian
    pull[:size] += gradient
    return more, pull


def joined(pieces: Sequence[SequenceFit]) -> SequenceFit:
    """Join the pieces of a sequence."""
    return SequenceFit(
        np.concatenate([piece.frames for piece in pieces]), tuple(pose for piece in pieces for pose in piece.poses),
        pieces[-1].body, np.concatenate([piece.covariance for piece in pieces]),
        np.concatenate([piece.information for piece in pieces]), pieces[-1].residual_px,
    )  # fmt: skip

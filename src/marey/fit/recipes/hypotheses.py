"""Several answers to the same outlines: found limb by limb, followed through the take, and decided by all frames.

Where a limb is hidden in some views or few cameras see it, a pose that swings its elbow to the other side may agree
with the silhouettes as well. A fit returns one of the answers with a narrow standard deviation. Here the other
answers are tried, followed forward and backward for as long as they remain distinct, and compared over all frames
that they span, including the motion at both ends. The better path is kept. Where the frames do not decide, both paths
are returned.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from marey.arrays import Floats, Integers
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.fit.recipes.sequence import DISTINCT_FRAMES, SequenceFit, SequenceSettings, acceleration_spread
from marey.fit.recipes.track import TrackSettings, prediction_spread
from marey.fit.search.levels import FrameLevels
from marey.fit.search.limb_moves import bent, carried, limb_chains, moved_in_depth, swung
from marey.fit.search.pose_cost import outline_cost, prior_cost
from marey.fit.search.search import Search, StartSettings
from marey.fit.solver.picture_times import PictureMotion, PictureTimes
from marey.fit.solver.pose_solver import Schedule, fit_pose
from marey.fit.solver.threads import map_in_threads
from marey.observations.prior import Habit, JointLimits, NearPose


@dataclass(frozen=True, kw_only=True)
class HypothesisSettings:
    """When other answers are tried, followed and accepted. Fields without a source were chosen by hand."""

    interval: float = 0.3
    """Time between the frames in which other answers are tried [s]. With 0.2 s, the arms of `reach` cut at the hips
    were 10.1 instead of 8.9 mm off (`--preset upper`)."""
    carried: float = 1 / 3
    """Time to the frames before and after whose posture of the limb is tried, too [s]."""
    swings: tuple[float, ...] = (60.0, 120.0, 180.0, -120.0, -60.0)
    """Angles by which a bent limb is swung about the line between its ends [deg]."""
    placements: int = 3
    """Number of further postures of a limb, those that cover the silhouettes best."""
    fitted: int = 6
    """Number of postures of a limb that are fitted, those that agree best with the silhouettes before. With 4, a right
    posture of an arm of `stealth` is not among them: joints are 8.8 instead of 8.1 mm off, in 1.5 % less time."""
    worse: float = 0.05
    """Agreement with the silhouettes by which a posture may be worse before it is fitted. Without this limit, the
    same answers replaced others on `stealth` without camera 4 and on `reach` cut at the hips, in 1.5 times the
    processor time on `walk`."""
    passes: int = 2
    """Largest number of times that frames are tried: all at first, then those near answers that were replaced."""
    least_bend: float = 0.04
    """Least distance of an elbow or a knee from the line between the limb's ends for which it is swung [m]."""
    apart: float = 25.0
    """Largest turn of a segment between two answers from which on they are distinct [deg]."""
    merged: float = 12.0
    """Largest turn of a segment between two answers below which they are the same [deg]."""
    hopeless: float = 20.0
    """Log-likelihood of one frame by which an answer that is followed may be worse than the present one."""
    approach: float = 0.2
    """Time in which an answer approaches the present one where it meets it or is not followed any further [s]."""
    longest: float = 5.0
    """Longest time for which an answer is followed forward, and backward [s]: where a posture remains undetermined for
    a long time, other answers would be followed through the whole take from every frame in which they are tried."""
    patience: int = 5
    """Number of successive hopeless frames after which an answer is not followed any further."""
    clearly: float = 0.0
    """Logarithm of the odds that another answer must have to replace the present one."""
    possible: float = 0.05
    """Least probability of an answer that the stated intervals include."""


FIRST = Schedule(iterations=6, gate=(25.0, 5.0), scale=(10.0, 2.0), cosine=0.5, interior=True)
"""Schedule by which another answer is fitted to the silhouettes of the first frame. Chosen by hand."""
NEXT = Schedule(iterations=4, gate=(16.0, 5.0), scale=(6.0, 2.0), cosine=0.5, interior=True)
"""Schedule by which it is fitted in the frames that follow. Chosen by hand."""
_COMPARED = SequenceSettings()
"""Scale and standard deviation of the distances that are compared, and the other priors: those of the refinement."""
MISFIT_FACTOR = 8.0
"""Factor by which the log-likelihood of a path is too large, because the misfit of an outline is alike in neighbouring
pixels. Of 92 other answers that two cameras of `jacks`, `stealth`, `walk` or `reach` leave open and whose joints are at
least 25 mm more or less off, 13 were right. Their probabilities have a mean negative log-likelihood of 0.61 with the
factor 1 and of 0.18 with 7 or 8; without one of the takes, the best factor is 6 to 9, and 0.19 in the take left out."""
FORGOTTEN_AFTER = 50
"""Number of tried frames after which the costs of other answers are released. Chosen by hand: 15 s of a take."""
REST_SPREAD = 0.01
"""Standard deviation of what does not belong to the limb from its present value while the limb is fitted [m, rad].
Chosen by hand."""


@dataclass(frozen=True, eq=False)
class _Group:
    """Coordinates that differ between two answers."""

    name: str
    """Name in reports, for example "left arm"."""
    columns: Integers
    """Indices of the coordinates among the D of a pose."""
    segments: Integers
    """Segments whose turn distinguishes two answers."""
    proposals: Callable[[int, Mapping[int, Pose]], list[Pose]]
    """Other answers for a frame, given the present poses of this frame and of those in `beside`."""
    beside: int
    """Distance to the frames before and after whose posture of the limb is tried, too."""


@dataclass(frozen=True, eq=False)
class Alternative:
    """Another answer over successive frames."""

    name: str
    """Limb, for example "left arm"."""
    columns: Integers
    """Indices of the limb's coordinates among the D of a pose."""
    poses: Mapping[int, Pose]
    """Poses by frame."""
    probability: float
    """Probability of this answer; that of the returned poses is the rest."""


@dataclass(frozen=True, eq=False)
class OtherPostures:
    """Poses by frame, and other answers that the frames do not exclude."""

    poses: Mapping[int, Pose]
    """The most probable poses by frame."""
    alternatives: Sequence[Alternative] = ()
    """Other answers."""
    replaced: Sequence[Alternative] = field(default=())
    """Former poses that other answers have replaced, with their probability."""


LimbCheckpoint = Callable[[str, Callable[[], OtherPostures]], OtherPostures]
"""Returns what was stored of a limb, or calls the function that computes it, and stores that."""


def explore_hypotheses(
    levels: FrameLevels,
    fine: FrameLevels,
    rough: FrameLevels,
    body: Body,
    coarse: Body,
    poses: Mapping[int, Pose],
    *,
    rate: float,
    settings: HypothesisSettings | None = None,
    times: PictureTimes | None = None,
    only: Collection[int] | None = None,
    progress: Callable[[float], None] = lambda share: None,
    checkpoint: LimbCheckpoint = lambda limb, compute: compute(),
) -> OtherPostures:
    """Try other answers, follow them through the take, and keep the one that all frames together prefer.

    Args:
        levels: Silhouettes to which answers are fitted.
        fine: Silhouettes with which answers are compared.
        rough: Smaller silhouettes in which postures of a limb are searched for.
        body: The body.
        coarse: The same body with few vertices, for the search.
        poses: Present poses by frame.
        rate: Frame rate [Hz].
        settings: When other answers are tried and accepted.
        times: When the cameras have taken their pictures; None if that is at the instants of the frames.
        only: Frames in which other answers are tried; some at regular intervals by default.
        progress: Called after each frame in which other answers are tried, with the finished share of the work.
        checkpoint: Called for each limb with its name and a function that computes its result: the poses that change,
            the other answers and the former poses. Returns this result, or a stored one.
    """
    motions = {} if times is None else times.known_motions(poses)
    work = _Work(levels, fine, body, rate, settings or HypothesisSettings(), motions, only)
    current, alternatives, replaced = dict(sorted(poses.items())), list[Alternative](), list[Alternative]()
    groups = list(_groups(body, coarse, rough, work.settings, rate))
    for k, group in enumerate(groups):
        step = partial(_report_share, progress, k, len(groups))
        found = checkpoint(group.name, partial(work.explored, group, current, step))
        current |= found.poses
        alternatives += found.alternatives
        replaced += found.replaced
        work.forget_except(current)
    return OtherPostures(current, alternatives, replaced)


def _report_share(progress: Callable[[float], None], done: int, total: int, share: float) -> None:
    """Report the finished share of several parts, from the number of finished ones and the share of the present one."""
    progress((done + share) / total)


def _groups(
    body: Body, coarse: Body, rough: FrameLevels, settings: HypothesisSettings, rate: float
) -> Iterator[_Group]:  # fmt: skip
    """Iterate over the limbs."""
    skeleton, reach = body.skeleton, max(1, round(settings.carried * rate))
    for limb in limb_chains(skeleton):

        def other_limbs(frame: int, now: Mapping[int, Pose], limb=limb) -> list[Pose]:  # type: ignore[no-untyped-def]
            posed, small = PosedBody(body, now[frame]), rough.at(frame)
            viewpoints = [camera.centre for camera in small.cameras]
            near = [now[f] for f in (frame - reach, frame + reach) if f in now]
            found = [carried(posed.pose, other, limb.coordinates) for other in near]
            if bent(posed, limb) >= settings.least_bend:
                found += [swung(posed, limb, np.deg2rad(angle)) for angle in settings.swings]
                found += [pose for eye in viewpoints for pose in moved_in_depth(posed, limb, eye)]
            search = Search(small, StartSettings())
            placed = search.limb_proposals(
                PosedBody(coarse, now[frame]), limb.name.replace(" ", "_"), count=settings.placements
            )
            found += [other.pose for other in placed]
            scores = search.score(coarse, [now[frame], *found])
            order = np.argsort(-scores[1:])[: settings.fitted]
            return [found[i] for i in order if scores[1 + i] > scores[0] - settings.worse]

        yield _Group(limb.name, 6 + limb.coordinates, np.array(limb.segments[:2]), other_limbs, reach)


@dataclass(frozen=True, eq=False)
class _Tried:
    """Other answers of a frame that were fitted beside the present one."""

    frame: int
    beside: Mapping[int, Pose]
    """The present poses on which they depend, by frame."""
    answers: Sequence[tuple[float, Pose]]
    """Cost and pose of each one that is distinct from the present one and not hopeless, the best first."""

    def is_current(self, poses: Mapping[int, Pose]) -> bool:
        """Return whether the poses on which they depend are still the present ones."""
        return all(poses[frame] is pose for frame, pose in self.beside.items())


@dataclass(frozen=True, eq=False)
class _Work:
    """What stays the same while answers are tried."""

    levels: FrameLevels
    fine: FrameLevels
    body: Body
    rate: float
    settings: HypothesisSettings
    motions: Mapping[int, Sequence[PictureMotion]] = field(default_factory=dict)
    """Motions of the body until each camera's picture, by frame; without any there is none."""
    only: Collection[int] | None = None
    """Frames in which other answers are tried; None for some at regular intervals."""
    known: dict[tuple[int, int], tuple[Pose, float]] = field(default_factory=dict)
    """Cost of poses by frame and identity; the poses are kept so that identities stay unique."""

    def explored(self, group: _Group, poses: Mapping[int, Pose], progress: Callable[[float], None]) -> OtherPostures:
        """Try other answers of a limb.

        Args:
            group: The limb.
            poses: The present poses by frame.
            progress: Called after each frame in which other answers are tried, with the finished share of the limb.

        Returns:
            The poses that change, the other answers and the former poses.
        """
        current, others, replaced = dict(poses), list[Alternative](), list[Alternative]()
        frames = self.tried(poses, 0)
        for number in range(self.settings.passes):
            step = partial(_report_share, progress, number, self.settings.passes)
            others, better = self.swept(group, current, others, frames, step)
            replaced += better
            if not better:
                break
            frames = self.near(self.tried(poses, number + 1), better)
        changed = {frame: pose for frame, pose in current.items() if pose is not poses[frame]}
        return OtherPostures(changed, [a for a in others if a.probability >= self.settings.possible], replaced)

    def tried(self, poses: Mapping[int, Pose], number: int) -> list[int]:
        """Return the frames in which other answers are tried; by default, every second pass visits those in between."""
        frames = list(poses)
        if self.only is not None:
            return [frame for frame in frames if frame in self.only]
        step = max(1, round(self.settings.interval * self.rate))
        return frames[step // 2 if number % 2 == 0 else 0 :: step] or frames[:1]

    def near(self, frames: Sequence[int], replaced: Sequence[Alternative]) -> list[int]:
        """Return the frames from which an answer can be followed to frames in which another one was replaced."""
        reach, changed = self.settings.longest * self.rate, np.unique([f for other in replaced for f in other.poses])
        after = np.searchsorted(changed, frames)
        apart = np.minimum(
            np.abs(changed[np.minimum(after, len(changed) - 1)] - frames),
            np.abs(changed[np.maximum(after - 1, 0)] - frames),
        )
        return [frame for frame, distance in zip(frames, apart, strict=True) if distance <= reach]

    def swept(
        self, group: _Group, current: dict[int, Pose], others: Sequence[Alternative], frames: Sequence[int],
        progress: Callable[[float], None],
    ) -> tuple[list[Alternative], list[Alternative]]:  # fmt: skip
        """Try other answers in some frames; replace those in `current` that are worse.

        Args:
            group: The limb.
            current: The present poses by frame.
            others: Other answers that are known.
            frames: The frames in which other answers are tried.
            progress: Called after each frame in which other answers are tried, with the finished share of the pass.

        Returns:
            The known other answers, among them those that were replaced, and the latter alone.
        """
        others, replaced = list(others), list[Alternative]()
        tasks = ((frame, self.beside(group, frame, current)) for frame in frames)
        for k, tried in enumerate(map_in_threads(lambda task: self.fitted_others(group, *task), tasks)):
            frame = tried.frame
            progress((k + 1) / len(frames))
            if k % FORGOTTEN_AFTER == FORGOTTEN_AFTER - 1:
                self.forget_except(current)
            if not tried.is_current(current):
                tried = self.fitted_others(group, frame, self.beside(group, frame, current))
            pose = self.distinct(group, tried, others)
            path = None if pose is None else self.followed(group, frame, pose, current)
            if not path:
                continue
            found = Alternative(group.name, group.columns, path, self.probability(group, path, current))
            if found.probability > 1.0 / (1.0 + np.exp(-self.settings.clearly)):
                poses = {f: current[f] for f in path}
                former = Alternative(group.name, group.columns, poses, 1.0 - found.probability)
                current |= path
                replaced.append(former)
                others = [a for a in others if not set(a.poses) & set(path)] + [former]
            elif not any(self._alike(group, path, other.poses) for other in others):
                others.append(found)
        return others, replaced

    @staticmethod
    def beside(group: _Group, frame: int, poses: Mapping[int, Pose]) -> dict[int, Pose]:
        """Return the present poses on which the other answers of a frame depend."""
        return {f: poses[f] for f in (frame - group.beside, frame, frame + group.beside) if f in poses}

    def _alike(self, group: _Group, path: Mapping[int, Pose], other: Mapping[int, Pose]) -> bool:
        """Return whether two paths are the same answer in most frames that they share."""
        shared = sorted(path.keys() & other.keys())
        return bool(shared) and np.median([self._turn(group, path[f], other[f]) for f in shared]) < self.settings.apart

    def fitted_others(self, group: _Group, frame: int, beside: Mapping[int, Pose]) -> _Tried:
        """Fit other answers of a frame, given the present poses on which they depend."""
        present = beside[frame]
        starts = (s for s in group.proposals(frame, beside) if self._turn(group, s, present) > self.settings.merged)
        fitted = list(map_in_threads(lambda start: self.fitted(group, frame, start, present), starts))
        new = [pose for pose in fitted if self._turn(group, pose, present) > self.settings.apart]
        costs = list(map_in_threads(lambda pose: self.cost(frame, pose), new))
        allowed = self.cost(frame, present) + self.settings.hopeless
        answers = sorted(((c, p) for c, p in zip(costs, new, strict=True) if c < allowed), key=lambda each: each[0])
        return _Tried(frame, beside, answers)

    def distinct(self, group: _Group, tried: _Tried, known: Sequence[Alternative]) -> Pose | None:
        """Return the best other answer of a frame that is none of the known ones, if there is one."""
        others = [a.poses[tried.frame] for a in known if tried.frame in a.poses]
        apart = self.settings.apart
        for _, pose in tried.answers:
            if all(self._turn(group, pose, other) > apart for other in others):
                return pose
        return None

    def _turn(self, group: _Group, pose: Pose, other: Pose) -> float:
        """Return the largest turn of the group's segments between two poses [deg]."""
        first, second = (PosedBody(self.body, p).segment_rotation[group.segments] for p in (pose, other))
        cosine = 0.5 * (np.einsum("sij,sij->s", first, second) - 1.0)
        return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).max())

    def fitted(self, group: _Group, frame: int, start: Pose, rest: Pose, spread: Floats | None = None) -> Pose:
        """Fit an answer to the silhouettes of a frame; what does not belong to the group stays."""
        near = np.full(len(self.body.skeleton), REST_SPREAD)
        near[group.columns] = np.inf if spread is None else spread[group.columns]
        priors = (JointLimits(), Habit(share=_COMPARED.habit), NearPose(pose=start, spread=near))
        level = self.levels.at(frame)
        schedule = FIRST if spread is None else NEXT
        posed, motions = PosedBody(self.body, start), self.motions.get(frame)
        return fit_pose(posed, level.sightings, priors, schedule=schedule, motions=motions).posed.pose

    def cost(self, frame: int, pose: Pose) -> float:
        """Return the negative logarithm of the likelihood and the prior of a pose, except a constant."""
        key = (frame, id(pose))
        if key not in self.known:
            posed = PosedBody(self.body, pose)
            self.known[key] = (
                pose,
                (
                    outline_cost(
                        posed,
                        self.fine.at(frame),
                        scale=_COMPARED.scale[1],
                        sigma_px=_COMPARED.sigma_px,
                        motions=self.motions.get(frame),
                    )
                    + prior_cost(posed, habit=_COMPARED.habit)
                ),
            )
        return self.known[key][1]

    def forget_except(self, poses: Mapping[int, Pose]) -> None:
        """Release the costs of all other poses, so that memory does not grow with the answers of every limb."""
        # Other threads may store costs meanwhile.
        for key in [key for key, (pose, _) in list(self.known.items()) if pose is not poses[key[0]]]:
            del self.known[key]

    def followed(self, group: _Group, frame: int, pose: Pose, poses: Mapping[int, Pose]) -> dict[int, Pose]:
        """Follow an answer forward and backward until it meets the present one, or until it is hopeless."""
        sides = map_in_threads(lambda step: self._followed_to(group, frame, pose, poses, step), (1, -1))
        path = {frame: pose}
        for side in sides:
            path |= side
        return dict(sorted(path.items()))

    def _followed_to(
        self, group: _Group, frame: int, pose: Pose, poses: Mapping[int, Pose], step: int
    ) -> dict[int, Pose]:  # fmt: skip
        """Follow an answer forward (step 1) or backward (-1), and return its poses in the other frames."""
        spread = prediction_spread(self.body.skeleton, TrackSettings(), rate=self.rate)
        path, at, last, bad = {frame: pose}, frame, pose, 0
        reach = max(1, round(self.settings.longest * self.rate))
        while at + step in poses and abs(at - frame) < reach and bad < self.settings.patience:
            change = poses[at].change_to(poses[at + step])
            change[group.columns] = 0.0
            at += step
            last = self.fitted(group, at, last.step(change), poses[at], spread)
            path[at] = last
            if self._turn(group, last, poses[at]) < self.settings.merged:
                break
            bad = bad + 1 if self.cost(at, last) > self.cost(at, poses[at]) + self.settings.hopeless else 0
        end = at - step * bad
        path = {f: other for f, other in path.items() if (f - end) * step <= 0}
        return path | self._blended(end, step, path[end], poses)

    def _blended(self, frame: int, step: int, last: Pose, poses: Mapping[int, Pose]) -> dict[int, Pose]:
        """Return poses that approach the present ones after the last frame of an answer."""
        count = max(1, round(self.settings.approach * self.rate))
        change, found = poses[frame].change_to(last), {}
        for k in range(1, count):
            if frame + k * step not in poses:
                break
            share = 0.5 * (1.0 + np.cos(np.pi * k / count))
            found[frame + k * step] = poses[frame + k * step].step(share * change)
        return found

    def probability(self, group: _Group, path: Mapping[int, Pose], poses: Mapping[int, Pose]) -> float:
        """Return the probability of a path instead of the present poses.

        The misfit of the outlines is alike in neighbouring frames, so that all frames of a path together count as
        `DISTINCT_FRAMES` at most; see `marey.fit.recipes.sequence`. It is also alike in neighbouring pixels: see
        `MISFIT_FACTOR`.
        """
        apart = [f for f, pose in path.items() if self._turn(group, pose, poses[f]) > self.settings.merged]
        if not apart:
            return 0.0
        gain = sum(self.cost(f, poses[f]) - self.cost(f, path[f]) for f in apart)
        gain *= min(1.0, DISTINCT_FRAMES / len(apart))
        gain += self._roughness(path, poses, poses) - self._roughness(path, poses, path)
        gain /= MISFIT_FACTOR
        return float(1.0 / (1.0 + np.exp(np.clip(-gain, -700.0, 700.0))))

    def _roughness(self, span: Mapping[int, Pose], poses: Mapping[int, Pose], path: Mapping[int, Pose]) -> float:
        """Return the cost of the accelerations about the ends of a path."""
        spread = acceleration_spread(self.body.skeleton, _COMPARED) / self.rate**2
        first, last = min(span), max(span)
        near = sorted({f for end in (first, last) for f in range(end - 2, end + 3)} & poses.keys())
        whole = {**{f: poses[f] for f in near}, **{f: path[f] for f in near if f in path}}
        total = 0.0
        for f in near:
            if f - 1 in whole and f + 1 in whole:
                change = whole[f].change_to(whole[f + 1]) - whole[f - 1].change_to(whole[f])
                total += 0.5 * float(np.sum((change / spread) ** 2))
        return total


WIDEST_SHARE = 1.0 / 1.96**2
"""Least share of the squared distance to another answer by which the variance grows, so that the 95 % interval about
the present one contains it."""


def with_alternatives(fit: SequenceFit, alternatives: Sequence[Alternative]) -> SequenceFit:
    """Return a fit whose covariances include other answers.

    A mixture of answers i of probability p_i, distance d_i from the stated pose and equal covariance C has the second
    moment C + sum p_i d_i d_i' about that pose. No share is taken below `WIDEST_SHARE`.

    Args:
        fit: The fit of some frames.
        alternatives: Other answers.
    """
    covariance, degrees = np.array(fit.covariance), len(fit.body.skeleton)
    for k, (frame, pose) in enumerate(zip(map(int, fit.frames), fit.poses, strict=True)):
        for other in alternatives:
            if frame in other.poses:
                change = np.zeros(degrees)
                change[other.columns] = pose.change_to(other.poses[frame])[other.columns]
                share = max(other.probability, WIDEST_SHARE)
                covariance[k, :degrees, :degrees] += share * np.outer(change, change)
    return replace(fit, covariance=covariance)

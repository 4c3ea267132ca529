"""Joint refinement of all poses of a sequence and of the shape.

A pose's observations involve that pose and the shape; smoothness involves three neighbours in time. The normal
equations are therefore block-banded with a border, and are solved as such ([Plaenkers1999] section 4.1 for the
weighting; the structure is ours). A long sequence is solved in windows that overlap: time grows linearly with the
number of frames, and memory grows little.
"""

from collections.abc import Container, Generator, Iterator, MutableMapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from marey.arrays import Floats, Integers
from marey.body.articulation.pose import Pose, PosedBody, packed_poses, unpacked_poses
from marey.body.articulation.skeleton import Skeleton
from marey.body.articulation.surface import Body
from marey.body.metaballs.metaball_person import metaballs_of, reshaped
from marey.fit.progress import FrameProgress, no_progress
from marey.fit.recipes.sequence_equations import (
    UNKNOWN_SD,
    Arrays,
    FrameEquations,
    FrameTerms,
    FrameTermsFactory,
    LocalTerms,
    add_terms,
    shape_prior,
    step_variance,
    window_terms,
)
from marey.fit.recipes.track import TRUNK_SEGMENTS
from marey.fit.search.levels import FrameLevels
from marey.fit.solver.banded import Window, windows, with_shape_covariance
from marey.fit.solver.body_solver import STEP_SD_M, bounded_step, dense_equations, shape_reach
from marey.fit.solver.camera_terms import CameraUnknowns, with_cameras
from marey.fit.solver.matched_moments import gives_moments, match_moments
from marey.fit.solver.moments import gather_moments
from marey.fit.solver.normal_equations import normal_equations
from marey.fit.solver.picture_times import PictureTimes
from marey.fit.solver.pose_solver import CameraMatches, Schedule, add_dense, joined_matches, match_cameras
from marey.fit.solver.threads import map_in_threads
from marey.observations.correspondence import ObservedOutline, Residual
from marey.observations.prior import Habit, JointLimits


@dataclass(frozen=True, kw_only=True)
class SequenceSettings:
    """Priors of motion and shape, and how silhouettes are matched.

    The preliminary study estimated motion in rendered takes with the true silhouettes and 1 px of noise; its scripts
    were not kept. Fields without a source were chosen by hand; results were not measured against other values.
    """

    limb_acceleration: float = 95.0
    """Standard deviation of a limb's angular acceleration [rad/s2]: at 30 Hz, about 3 degrees from the mean of the two
    neighbouring poses, for which the preliminary study had joint errors of 4.2 mm on `reach` and 5.7 mm on `walk`; 4.5
    and 5.9 mm for 6 degrees, 4.0 and 6.1 mm for 1.5 degrees."""
    trunk_acceleration: float = 47.0
    """Standard deviation of the trunk's angular acceleration, and of the pelvis' [rad/s2]: half that of a limb, as in
    the preliminary study."""
    root_acceleration: float = 12.0
    """Standard deviation of the pelvis' acceleration [m/s2]."""
    habit: float = 0.1
    """Weight of the usual joint angles in each frame, as a number of observations. With 0.01 the steady error of
    `stealth` was 8.5 instead of 6.5 mm (docs/accuracy/rejected.md)."""
    gate: tuple[float, float] = (20.0, 5.0)
    """Greatest distance of a match, first and last [px]; see `Schedule`."""
    scale: tuple[float, float] = (6.0, 2.0)
    """Scale of the robust weights, first and last [px]; see `Schedule`."""
    sigma_px: float = 3.2
    """Standard deviation of a match [px]; see `Schedule`. For edges inside the silhouettes, 1.4 px was worse: `walk`
    7.8 instead of 7.1 mm (docs/accuracy/rejected.md)."""
    residual: Residual = "plane"
    """Residual of a contour pixel; see `Schedule`. The paper's ray is compared in docs/accuracy/rejected.md."""
    vote: bool = True
    """Whether neighbours decide between two limbs; see `Schedule`. The results are the same within 0.1 mm without it
    (docs/accuracy/rejected.md)."""
    interior: bool = True
    """Whether edges inside the silhouettes are used; see `Schedule`."""
    clip: float = 3.0
    """Largest distance of a shape parameter from the prior's mean, in standard deviations. From the preliminary study,
    in which the parameters of a real person ran to -5."""


@dataclass(frozen=True, eq=False)
class SequenceFit:
    """Refined motion and shape with their covariance."""

    frames: Integers
    """(F,) the frames, in order."""
    poses: tuple[Pose, ...]
    """One pose per frame."""
    body: Body
    """The body with its shape parameters and, where they were free, their covariance."""
    covariance: Floats
    """(F, D + M, D + M) covariance of each pose and the shape; (F, D, D) if the shape was fixed."""
    information: Floats
    """(F, D, D) information about each pose from the observations of its own frame."""
    residual_px: float
    """Weighted root mean square of the matches' distances across the contours [px]."""
    between_cameras: Floats | None = None
    """(F, D, D) covariance of each pose that the contradictions between the cameras reveal, for a known shape; see
    `BandedSystem.jackknife`. None where it was not computed."""
    camera_step: Floats | None = None
    """(G,) last step of the unknowns of the cameras, if they were estimated."""
    camera_covariance: Floats | None = None
    """(G, G) covariance of the unknowns of the cameras, if they were estimated: that of independent residuals."""

    @property
    def by_frame(self) -> dict[int, Pose]:
        """The poses by frame."""
        return dict(zip(map(int, self.frames), self.poses, strict=True))


def acceleration_spread(skeleton: Skeleton, settings: SequenceSettings) -> Floats:
    """Return the standard deviation (D,) of each coordinate's acceleration [m/s2, rad/s2]."""
    turns = [
        settings.trunk_acceleration if c.segment in TRUNK_SEGMENTS else settings.limb_acceleration
        for c in skeleton.coordinates
    ]
    return np.array([settings.root_acceleration] * 3 + [settings.trunk_acceleration] * 3 + turns)


WINDOW_LENGTH, WINDOW_OVERLAP = 8.0, 1.0
"""Length of the windows in which a longer take is refined, and of the neighbourhood on both sides of each [s]. The
overlap was chosen by its effect on the poses (docs/accuracy/capture.md, "Windows of 120 frames")."""
LONGEST_WINDOW, LONGEST_OVERLAP = 600, 120
"""Upper limits of both in frames, for high frame rates. They limit memory; chosen by hand."""


@dataclass(frozen=True, eq=False)
class RefineCheckpoint:
    """Intermediate results of a refinement; a mapping on disk survives an interruption and saves memory."""

    rounds: MutableMapping[int, Arrays] = field(default_factory=dict)
    """Poses and shape after each round but the last."""
    parts: MutableMapping[tuple[int, int], Arrays] = field(default_factory=dict)
    """Reduced normal equations of the windows of the current round, by round and window."""


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
    ignored_frames: Container[int] = (),
    extra_terms: FrameTermsFactory | None = None,
    times: PictureTimes | None = None,
    cameras: CameraUnknowns | None = None,
    progress: FrameProgress = no_progress,
    checkpoint: RefineCheckpoint | None = None,
) -> SequenceFit:
    """Refine all poses, and the shape if frames for it are given.

    The arguments are those of `refine_in_pieces`, whose results are joined.
    """
    return join_pieces(
        list(
            refine_in_pieces(
                frames, poses, body, levels, rate=rate, rounds=rounds, shape_frames=shape_frames, settings=settings,
                ignored_frames=ignored_frames, extra_terms=extra_terms, times=times, cameras=cameras, progress=progress,
                checkpoint=checkpoint,
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
    ignored_frames: Container[int] = (),
    extra_terms: FrameTermsFactory | None = None,
    times: PictureTimes | None = None,
    cameras: CameraUnknowns | None = None,
    progress: FrameProgress = no_progress,
    checkpoint: RefineCheckpoint | None = None,
) -> Iterator[SequenceFit]:
    """Refine all poses, and the shape if frames for it are given, and yield the result window by window.

    Up to about ten seconds are solved as one system. A longer take is solved in windows, each of which also uses one
    second before and after it: frames farther away change a pose by a negligible part of its standard deviation
    (docs/accuracy/capture.md), and memory and time grow at most linearly with the take. The shape is updated from the
    shape frames of all windows.

    Args:
        frames: (F,) in order; smoothness is required between frames whose numbers are consecutive.
        poses: One pose per frame.
        body: The person; its shape parameters are free if `shape_frames` are given.
        levels: Silhouettes.
        rate: Frame rate [Hz].
        rounds: Number of iterations, each of which matches and solves once.
        shape_frames: Frames whose outlines update the shape.
        settings: Priors, and how silhouettes are matched.
        ignored_frames: Frames whose silhouettes are ignored; their poses follow from their neighbours.
        extra_terms: Further observations, for example of surface points.
        times: When the cameras have taken their pictures; None if that is at the instants of the frames.
        cameras: Errors of the cameras of the silhouettes. Either they are estimated, or the covariances of the result
            are those of cameras with such errors.
        progress: Called with each frame in each round.
        checkpoint: Receives each window and each round as soon as it is done; those that it already holds are reused.

    Raises:
        ValueError: `rounds` is below 1.
    """
    if rounds < 1:
        raise ValueError("at least one round is needed")
    checkpoint = checkpoint or RefineCheckpoint()
    settings = settings or SequenceSettings()
    work = _Work(
        list(frames), levels, set(shape_frames), ignored_frames, rate, rounds, settings, progress, checkpoint, body,
        extra_terms, times, cameras,
    )  # fmt: skip
    poses, body = work.after_rounds(poses, body, rounds - 1)
    work.assemble_windows(poses, body, rounds - 1)
    yield from work.pieces(poses, body)


def refine_without_covariances(
    frames: Sequence[int],
    poses: Sequence[Pose],
    body: Body,
    levels: FrameLevels,
    *,
    rate: float,
    rounds: int,
    shape_frames: Sequence[int] = (),
    settings: SequenceSettings | None = None,
    extra_terms: FrameTermsFactory | None = None,
    times: PictureTimes | None = None,
    progress: FrameProgress = no_progress,
    checkpoint: RefineCheckpoint | None = None,
) -> tuple[list[Pose], Body]:
    """Refine as `refine_in_pieces` does, for poses that are refined once more: their covariances are not computed.

    The arguments are those of `refine_in_pieces`.

    Returns:
        The poses, and the body with the refined shape.
    """
    work = _Work(
        list(frames), levels, set(shape_frames), (), rate, rounds, settings or SequenceSettings(), progress,
        checkpoint or RefineCheckpoint(), body, extra_terms, times, stated=False,
    )  # fmt: skip
    return work.after_rounds(poses, body, rounds)


def _packed(poses: Sequence[Pose], body: Body) -> Arrays:
    return {**packed_poses(poses), "numbers": np.array(body.numbers)}


def _unpacked(arrays: Arrays, body: Body) -> tuple[list[Pose], Body]:
    return unpacked_poses(arrays), reshaped(body, arrays["numbers"])


DISTINCT_FRAMES = 3.0
"""Effective number of independent frames in the estimate of the shape. The body's misfits repeat between frames, so
that the shape is known no better than from this many frames however many are used. When it was introduced, lengths of
limbs in four rendered takes lay 0.74 standard deviations from the truth (root mean square); docs/accuracy/capture.md
has the present figures."""


@dataclass(frozen=True, eq=False)
class _Work:
    """Everything that stays the same over the rounds of a refinement."""

    frames: list[int]
    levels: FrameLevels
    free: set[int]
    ignored_frames: Container[int]
    rate: float
    rounds: int
    settings: SequenceSettings
    progress: FrameProgress
    checkpoint: RefineCheckpoint
    first: Body
    """The body at the start, from which bodies of other numbers are made, so that an interruption changes nothing."""
    extra_terms: FrameTermsFactory | None = None
    times: PictureTimes | None = None
    cameras: CameraUnknowns | None = None
    stated: bool = True
    """Whether the last round also computes covariances."""

    def after_rounds(self, poses: Sequence[Pose], body: Body, rounds: int) -> tuple[list[Pose], Body]:
        """Return poses and body after some rounds."""
        poses, kept = list(poses), self.checkpoint
        for round_ in range(rounds):
            if round_ in kept.rounds:
                poses, body = _unpacked(kept.rounds[round_], self.first)
                for frame in self.frames:
                    self.progress(frame)
                continue
            self.assemble_windows(poses, body, round_)
            poses, body = self.apply_step(poses, body, round_)
            kept.rounds[round_] = _packed(poses, body)
            kept.parts.clear()
        return poses, body

    def states(self, round_: int) -> bool:
        """Return whether covariances are computed in a round: in the last one, if at all."""
        return self.stated and round_ == self.rounds - 1

    @cached_property
    def windows(self) -> list[Window]:
        """Windows of frames that are solved together."""
        length, overlap = round(WINDOW_LENGTH * self.rate), round(WINDOW_OVERLAP * self.rate)
        return windows(
            len(self.frames), min(max(length, 60), LONGEST_WINDOW), min(max(overlap, 15), LONGEST_OVERLAP)
        )  # fmt: skip

    def assemble_windows(self, poses: Sequence[Pose], body: Body, round_: int) -> None:
        """Match each frame once, eliminate the poses of each window, and store the reduced equations."""
        begun = 0
        while (round_, begun) in self.checkpoint.parts:
            begun += 1
        wanted = self.windows[begun:]
        for frame in self.frames[: wanted[0].first if wanted else None]:
            self.progress(frame)
        if not wanted:
            return
        frame_terms = (
            None if self.extra_terms is None else self.extra_terms(dict(zip(self.frames, poses, strict=True)), body)
        )
        stream = self._equations(poses, body, round_, wanted[0].first, frame_terms)
        waiting: dict[int, FrameEquations] = {}
        for i, window in enumerate(wanted, begun):
            for f in range(max(waiting, default=window.first - 1) + 1, window.last):
                waiting[f] = next(stream)
            for f in [f for f in waiting if f < window.first]:
                del waiting[f]
            local_sd = frame_terms.local_sd if isinstance(frame_terms, LocalTerms) else None
            self.checkpoint.parts[round_, i] = window_terms(
                window, waiting, poses, body, frames=self.frames, last=self.states(round_), local_sd=local_sd,
                spread=acceleration_spread(body.skeleton, self.settings) / self.rate**2,
            )  # fmt: skip
        stream.close()

    def _equations(
        self, poses: Sequence[Pose], body: Body, round_: int, first: int, frame_terms: FrameTerms | None
    ) -> Generator[FrameEquations, None, None]:
        settings = self.settings
        schedule = Schedule(
            iterations=max(self.rounds, 2), gate=settings.gate, scale=settings.scale, cosine=0.5,
            sigma_px=settings.sigma_px, residual=settings.residual, vote=settings.vote, interior=settings.interior,
        )  # fmt: skip
        matching, scale = schedule.at(round_)
        priors = (JointLimits(), Habit(share=settings.habit))
        last = self.states(round_)
        by_frame = dict(zip(self.frames, poses, strict=True))

        def equations(f: int) -> FrameEquations:
            sightings = self._sightings(self.frames[f])
            posed, seen = PosedBody(body, poses[f]), list[CameraMatches]()
            if self._only_pose(f, round_) and gives_moments(matching):
                moments, _, total, across = match_moments(posed, sightings, matching, scale)
                hessian, gradient, _ = normal_equations(posed, moments)
                add_dense(posed, priors, hessian, gradient)
            else:
                late = (
                    None if self.times is None or not sightings else self.times.posed(self.frames[f], posed, by_frame)
                )
                seen = match_cameras(posed, sightings, matching, scale, late)
                found, weights = joined_matches(seen)
                if self.frames[f] in self.free:
                    hessian, gradient, _ = dense_equations(posed, found, weights, priors)
                else:
                    hessian, gradient, _ = normal_equations(posed, gather_moments(posed, found, weights))
                    add_dense(posed, priors, hessian, gradient)
                across = sum(float(w @ (m.residuals(posed) ** 2).sum(1)) for w, m in zip(weights, found, strict=True))
                total = sum(float(w.sum()) for w in weights)
            if frame_terms is not None:
                hessian, gradient = add_terms(hessian, gradient, *frame_terms.terms(self.frames[f], posed), posed.body)
            if (cameras := self._cameras_of(round_)) is not None:
                size = len(body.skeleton) + len(body.space) + (0 if frame_terms is None else frame_terms.shared)
                terms = cameras.terms(posed, seen, shape=self.frames[f] in self.free)
                hessian, gradient = with_cameras(hessian, gradient, terms, size=size)
            local = frame_terms.local(self.frames[f], posed) if isinstance(frame_terms, LocalTerms) else None
            apart = tuple(normal_equations(posed, gather_moments(posed, *own))[:2] for own in seen) if last else ()
            return FrameEquations(hessian, gradient, across, total, local, apart)

        for f, found in enumerate(map_in_threads(equations, range(first, len(self.frames))), first):
            self.progress(self.frames[f])
            yield found

    def _only_pose(self, f: int, round_: int) -> bool:
        """Return whether a frame's silhouettes determine nothing but its pose, at the instant of the frame."""
        alone = not self.states(round_) and self._cameras_of(round_) is None and self.times is None
        return alone and self.frames[f] not in self.free

    def _cameras_of(self, round_: int) -> CameraUnknowns | None:
        """Return the errors of the cameras if they matter in a round: without an estimate only in the last one."""
        matter = self.cameras is not None and (self.cameras.estimated or round_ == self.rounds - 1)
        return self.cameras if matter else None

    def _sightings(self, frame: int) -> Sequence[ObservedOutline]:
        return () if frame in self.ignored_frames else self.levels.at(frame).sightings

    def _all_window_terms(self, round_: int) -> Iterator[Arrays]:
        return (self.checkpoint.parts[round_, i] for i in range(len(self.windows)))

    def apply_step(self, poses: Sequence[Pose], body: Body, round_: int) -> tuple[list[Pose], Body]:
        """Solve for the shape's step, and apply the steps of shape and poses."""
        shape = self._shape_step(poses, body, round_)
        moved: list[Pose] = []
        for window, part in zip(self.windows, self._all_window_terms(round_), strict=True):
            steps = -(part["own"] + part["by_shape"] @ shape[: part["by_shape"].shape[1]])
            own = poses[window.begin : window.end]
            moved += [pose.step(step) for pose, step in zip(own, steps.reshape(len(own), -1), strict=True)]
        return moved, reshaped(self.first, body.numbers + shape[: len(body.space)]) if self.free else body

    def _shape_step(self, poses: Sequence[Pose], body: Body, round_: int) -> Floats:
        """Return the step (M + G,) of the shape parameters and of the other unknowns that all frames share."""
        numbers, count = len(body.space), self._shared(body, round_)
        cameras = self._cameras_of(round_)
        last = 0 if cameras is None else len(cameras)
        held = 0 if cameras is None or cameras.estimated else last
        if not self.free and count == numbers + held:
            return np.zeros(count)
        information, gradient = shape_prior(body, poses[0], count)
        if not self.free:
            gradient[:] = 0.0
        for part in self._all_window_terms(round_):
            information, gradient = information + part["corner"], gradient + part["shape_gradient"]
            if part["by_shape"].shape[1]:
                information, gradient = information - part["taken"], gradient - part["taken_gradient"]
        variance = np.concatenate([step_variance(body.space), np.full(count - numbers, STEP_SD_M**2)])
        anywhere = np.full(count - numbers, UNKNOWN_SD)
        if cameras is not None and cameras.estimated:
            gradient[count - last :] += cameras.offset
            variance[count - last :], anywhere[len(anywhere) - last :] = CAMERA_STEP_SD**2, FARTHEST_CAMERA
        information = 0.5 * (information + information.T) + np.diag(1.0 / variance)
        least, greatest = shape_reach(body, self.settings.clip)
        least, greatest, free = np.append(least, -anywhere), np.append(greatest, anywhere), slice(count - held)
        step = bounded_step(information[free, free], gradient[free], least[free], greatest[free])
        if (space := metaballs_of(body)) is not None:
            step[:numbers] *= space.possible_share(body.numbers, step[:numbers])
        return np.append(step, np.zeros(held))

    def _shared(self, body: Body, round_: int) -> int:
        """Return the number M + G of shape parameters and other unknowns that all frames share."""
        if self.extra_terms is None and self._cameras_of(round_) is None:
            return len(body.space)
        return max(len(part["corner"]) for part in self._all_window_terms(round_))

    def pieces(self, poses: Sequence[Pose], body: Body) -> Iterator[SequenceFit]:
        """Apply the last step, and yield the result of each window with its covariances."""
        round_ = self.rounds - 1
        moved, apply_step = self.apply_step(poses, body, round_)
        numbers, degrees = len(body.space), len(body.skeleton)
        information, _ = shape_prior(body, poses[0], self._shared(body, round_))
        squares = total = 0.0
        for part in self._all_window_terms(round_):
            squares, total = squares + float(part["squares"]), total + float(part["total"])
            information = information + part["corner"]
            if part["spread"].shape[2]:
                information = information - part["loss"]
        cameras = self._cameras_of(round_)
        known = len(information) - (0 if cameras is None or cameras.estimated else len(cameras))
        shape = np.linalg.inv(0.5 * (information + information.T)[:known, :known])
        response = -shape @ information[:known, known:]
        if self.free:
            alone = np.linalg.inv(shape[:numbers, :numbers])
            stated = self._shape_covariance(alone, poses[0], body) + response[:numbers] @ response[:numbers].T
            apply_step = replace(apply_step, numbers_covariance=stated)
        estimate: tuple[Floats | None, Floats | None] = (None, None)
        if cameras is not None and cameras.estimated:
            estimate = self._camera_estimate(poses, body, shape)
        residual = float(np.sqrt(squares / total)) if total else float("nan")
        for window, part in zip(self.windows, self._all_window_terms(round_), strict=True):
            core = slice(window.begin, window.end)
            covariance = part["blocks"]
            spread = part["spread"]
            if spread.shape[2] or self.free:
                covariance = with_shape_covariance(part["blocks"], spread[:, :, :known], shape)
                kept = degrees + (numbers if self.free else 0)
                covariance = covariance[:, :kept, :kept]
            if response.shape[1]:
                by_camera = -(spread[:, :, known:] + spread[:, :, :known] @ response)
                covariance[:, :degrees, :degrees] += by_camera @ np.swapaxes(by_camera, 1, 2)
            yield SequenceFit(
                np.array(self.frames[core]), tuple(moved[core]), apply_step, covariance, part["information"], residual,
                part["between_cameras"] if len(part["between_cameras"]) else None, *estimate,
            )  # fmt: skip

    def _camera_estimate(self, poses: Sequence[Pose], body: Body, shape: Floats) -> tuple[Floats, Floats]:
        """Return the step of the unknowns of the cameras in the last round, and their covariance."""
        count = 0 if self.cameras is None else len(self.cameras)
        return self._shape_step(poses, body, self.rounds - 1)[-count:], shape[-count:, -count:]

    def _shape_covariance(self, information: Floats, pose: Pose, body: Body) -> Floats:
        """Return the covariance (M, M) of the shape parameters from their information with the poses eliminated."""
        prior, _ = shape_prior(body, pose)
        alike = min(1.0, DISTINCT_FRAMES / len(self.free))
        stated = prior + alike * (0.5 * (information + information.T) - prior)
        return np.asarray(np.linalg.inv(stated))


CAMERA_STEP_SD, FARTHEST_CAMERA = 1.0, 3.0
"""Standard deviation of the step of a camera's unknown in one round (Levenberg-Marquardt damping), and the largest
step, in standard deviations of the unknown before the measurement. Chosen by hand."""


def join_pieces(pieces: Sequence[SequenceFit]) -> SequenceFit:
    """Join the windows of a refined sequence."""
    return SequenceFit(
        np.concatenate([piece.frames for piece in pieces]), tuple(pose for piece in pieces for pose in piece.poses),
        pieces[-1].body, np.concatenate([piece.covariance for piece in pieces]),
        np.concatenate([piece.information for piece in pieces]), pieces[-1].residual_px,
        _joined([piece.between_cameras for piece in pieces]), pieces[-1].camera_step, pieces[-1].camera_covariance,
    )  # fmt: skip


def _joined(parts: Sequence[Floats | None]) -> Floats | None:
    known = [part for part in parts if part is not None]
    return np.concatenate(known) if len(known) == len(parts) else None

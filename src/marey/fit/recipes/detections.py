"""Motion of a person from detected joints, and these joints as observations in the refinement of a sequence."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from marey.arrays import Floats, Integers, Mask, freeze_fields
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.cameras.camera import Camera
from marey.cameras.triangulate import triangulate
from marey.fit.recipes.person import PersonSettings, SilhouetteTake
from marey.fit.recipes.seen_people import PersonTrack, SeenPerson
from marey.fit.recipes.sequence_equations import FrameTerms, FrameTermsFactory, LocalTerms
from marey.fit.recipes.start_joints import start_from_joints
from marey.fit.recipes.track import prediction_spread
from marey.fit.solver.banded import LocalEquations
from marey.fit.solver.picture_times import PictureTimes
from marey.fit.solver.pose_solver import add_dense, solve_step
from marey.observations.detected_joints import JOINT_FREEDOM, DetectedJoints, t_weights
from marey.observations.observation import Observation
from marey.observations.prior import Habit, JointLimits, NearPose


@dataclass(frozen=True, kw_only=True)
class DetectionSettings:
    """Errors of detected joints, and how they are followed."""

    sd_m: float = 0.02
    """Standard deviation of a joint of full confidence from its place on the body, per axis of the image [m].

    The median residual of a detector on four takes is about half of that where joints are seen well.
    """
    least_confidence: float = 0.3
    """Joints of less confidence are not used. Chosen by hand; other values were not measured."""
    weakest: float = 0.2
    """Confidence below which the standard deviation does not grow further; it is inversely proportional above."""
    offset_sd_m: float = 0.03
    """Standard deviation of the constant offset of a detector's joint from the body's, per axis [m].

    On four takes a detector's knees and elbows are 25 to 50 mm from the true centres.
    """
    hip_offset_sd_m: float = 0.06
    """The same for hips, which are 23 to 56 mm from the true centres, to the same side in six takes [m].

    Joints of `jacks` are 10.9 instead of 11.2 mm off with it, of `market` 8.5 instead of 9.1 mm, and of `office` 15.9
    instead of 15.8 mm; with images of the empty room those of `jacks` are 10.3 instead of 10.8 mm off.
    """
    repeated_frames: float = 9.0
    """Number of frames over which a detector's error is about the same: beside silhouettes the variance of each joint
    is larger by this factor."""
    distinct_frames: float = 10.0
    """Effective number of independent frames in the estimate of an offset. Chosen by hand."""
    poor: float = 4.0
    """Largest residual of a frame above which a neutral posture is tried, too, in standard deviations. Chosen by
    hand."""
    steps: int = 10
    """Largest number of Gauss-Newton steps per frame."""
    stop: float = 1e-3
    """A shorter step ends the iteration [m, rad]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PersonDetections:
    """Detected joints of one person in all frames."""

    cameras: tuple[Camera, ...]
    """C cameras."""
    joint_names: tuple[str, ...]
    """Names of the J joint centres."""
    pixels: Floats
    """(F, C, J, 2) [px]; NaN where a joint was not found."""
    confidence: Floats
    """(F, C, J) from 0 to 1."""
    agreeing: Mask
    """(F, C, J) true where the images of several cameras agree about a joint."""
    elsewhere: Mask
    """(F, C) true where the detector found only other people in an image."""
    settings: DetectionSettings = field(default_factory=DetectionSettings)

    def __post_init__(self) -> None:
        freeze_fields(self, "pixels", "confidence")
        freeze_fields(self, "agreeing", "elsewhere", dtype=np.bool_)

    @staticmethod
    def of_track(
        cameras: Sequence[Camera], joint_names: Sequence[str], pixels: Floats, confidence: Floats, track: PersonTrack
    ) -> "PersonDetections":
        """Select the detections of one person.

        Args:
            cameras: C cameras.
            joint_names: Names of the J joints.
            pixels: (F, C, P, J, 2) of all persons [px].
            confidence: (F, C, P, J).
            track: The person.
        """
        shape = (*pixels.shape[:2], len(joint_names))
        own, sure, agreeing = np.full((*shape, 2), np.nan), np.zeros(shape), np.zeros(shape, bool)
        elsewhere = np.zeros(shape[:2], bool)
        for seen in track.seen:
            agreeing[seen.frame] = seen.agreeing
            elsewhere[seen.frame] = (seen.persons < 0) & np.isfinite(pixels[seen.frame]).any((1, 2, 3))
            for c, p in enumerate(seen.persons):
                if p >= 0:
                    own[seen.frame, c], sure[seen.frame, c] = pixels[seen.frame, c, p], confidence[seen.frame, c, p]
        return PersonDetections(
            cameras=tuple(cameras),
            joint_names=tuple(joint_names),
            pixels=own,
            confidence=sure,
            agreeing=agreeing,
            elsewhere=elsewhere,
        )

    def at_frames(self, times: PictureTimes) -> "PersonDetections":
        """Interpolate the joints of pictures that were not taken at their frame's instant.

        Args:
            times: When the cameras have taken their pictures.

        Returns:
            The joints at the instants of the frames, linear between two pictures; a joint that the neighbouring picture
            does not show stays where it was found.
        """
        pixels = np.array(self.pixels)
        count = len(pixels)
        frames, joints = np.arange(count)[:, None], np.arange(pixels.shape[2])
        for c in range(len(self.cameras)):
            own = times.of_pixels(c, self.pixels[:, c])
            # Of a late joint the picture before it is on the other side of the frame's instant.
            beside = np.clip(frames - np.sign(np.nan_to_num(own)).astype(int), 0, count - 1)
            gap = beside + own[beside, joints] - frames - own
            # At the ends of a video both may be the same picture.
            gap = np.where(np.abs(gap) < 0.5, np.inf, gap)
            share = -own / gap
            moved = self.pixels[:, c] + share[..., None] * (self.pixels[beside, c, joints] - self.pixels[:, c])
            pixels[:, c] = np.where(np.isfinite(moved), moved, self.pixels[:, c])
        return replace(self, pixels=pixels)

    def with_given(self, frame: int, pixels: Floats, confidence: Floats) -> "PersonDetections":
        """Replace joints of a frame by given ones, for example clicked ones.

        Of a joint that is given in two images or more, the other images do not agree.

        Args:
            frame: The frame.
            pixels: (C, J, 2) [px]; NaN where a joint is not given.
            confidence: (C, J) from 0 to 1.

        Returns:
            The joints with the given ones among them.
        """
        given = np.isfinite(pixels[..., 0])
        found, sure, agreeing = np.array(self.pixels), np.array(self.confidence), np.array(self.agreeing)
        elsewhere = np.array(self.elsewhere)
        found[frame] = np.where(given[..., None], pixels, found[frame])
        sure[frame] = np.where(given, confidence, sure[frame])
        before = agreeing[frame]
        agreeing[frame] = np.where(given.sum(axis=0) >= 2, given, before | (given & before.any(axis=0)))
        elsewhere[frame] &= ~given.any(axis=1)
        return replace(self, pixels=found, confidence=sure, agreeing=agreeing, elsewhere=elsewhere)

    def seen(self, frame: int, persons: Integers) -> SeenPerson:
        """Return the person in a frame, from the joints about which the images agree.

        Args:
            frame: The frame.
            persons: (C,) number of the person in each image; -1 where the detector did not find it.
        """
        agreeing = self.agreeing[frame]
        pixels = np.where(agreeing[..., None], self.pixels[frame], np.nan)
        points = triangulate(self.cameras, pixels, sigma_px=1.0).points
        return SeenPerson(frame, persons, points, agreeing & np.isfinite(points[:, 0]))

    @cached_property
    def used(self) -> Floats:
        """(F, C, J, 2) pixels of sufficient confidence, NaN elsewhere."""
        enough = self.confidence >= self.settings.least_confidence
        return np.where(enough[..., None], self.pixels, np.nan)

    @property
    def offset_sd_m(self) -> Floats:
        """(J,) standard deviation of the constant offset of each joint, per axis [m]."""
        usual, hip = self.settings.offset_sd_m, self.settings.hip_offset_sd_m
        return np.array([hip if name.endswith("_hip") else usual for name in self.joint_names])

    def segments(self, body: Body) -> Integers:
        """Return the segment (J,) of each joint; -1 for joints that the body does not have or does not follow."""
        joints = zip(body.joint_names, body.joint_segments, body.followed_joints, strict=True)
        followed = {name: segment for name, segment, follows in joints if follows}
        return np.array([followed.get(name, -1) for name in self.joint_names])

    def of_frame(
        self, frame: int, posed: PosedBody, offsets: Floats, *, agreeing_only: bool = False, repeated: float = 1.0
    ) -> list[DetectedJoints]:
        """Return the detected joints of a frame as observations.

        Args:
            frame: The frame.
            posed: The body in its approximate pose, which gives the distance from each camera.
            offsets: (J, 3) of the joints, in the frame of the segment that ends there [m].
            agreeing_only: Whether only joints are used about which several cameras agree, without robust weights: then
                a pose far from the truth is drawn to them, too.
            repeated: Factor of the variances.
        """
        segments, found = self.segments(posed.body), []
        for c, camera in enumerate(self.cameras):
            given = np.isfinite(self.used[frame, c, :, 0]) & (segments >= 0)
            if agreeing_only:
                given &= self.agreeing[frame, c]
            if not given.any():
                continue
            away = np.linalg.norm(posed.segment_origin[segments[given]] - camera.centre, axis=1)
            sure = np.clip(self.confidence[frame, c, given], self.settings.weakest, 1.0)
            sd = np.sqrt(repeated) * self.settings.sd_m * camera.matrix[0, 0] / (away * sure)
            found.append(
                DetectedJoints(
                    camera=camera,
                    segments=segments[given],
                    offsets=offsets[given],
                    pixels=self.used[frame, c, given],
                    sd_px=sd,
                    freedom=np.inf if agreeing_only else JOINT_FREEDOM,
                )
            )
        return found

    def log_likelihood(self, frame: int, posed: PosedBody, offsets: Floats) -> float:
        """Return the log-likelihood of a pose by the detected joints of a frame, except a constant [nat].

        Args:
            frame: The frame.
            posed: The posed body.
            offsets: (J, 3) of the joints, see `of_frame`.
        """
        total = 0.0
        for joints in self.of_frame(frame, posed, offsets, repeated=self.settings.repeated_frames):
            away = (joints.camera.project(joints.predict(posed)) - joints.pixels) / joints.sd_px[:, None]
            squares = np.nansum(away**2, axis=1)
            total -= 0.5 * (JOINT_FREEDOM + 2) * float(np.log1p(squares / JOINT_FREEDOM).sum())
        return total


def track_detections(
    detections: PersonDetections, track: PersonTrack, body: Body, settings: PersonSettings, *, rate: float,
    start: int | None = None,
) -> tuple[Body, dict[int, Pose], int]:  # fmt: skip
    """Estimate the pose in every frame of a person from its detected joints alone.

    The frame with the most agreeing joints, or a given one, gives pose and rough shape; the others are tracked from it
    in both directions. After a gap in which a prediction is worthless, the pose is found anew.

    Args:
        detections: The detected joints.
        track: The frames of the person.
        body: Body at its prior's mean.
        settings: Settings of the capture.
        rate: Frame rate [Hz].
        start: The frame of the person from which the tracking starts; None for the one with the most agreeing joints.

    Returns:
        The body with its rough shape, the poses by frame, and the frame of the start.

    Raises:
        MareyError: Too few joints are given in two cameras each.
    """
    def worth(seen: SeenPerson) -> tuple[bool, int]:
        return seen.frame == start, int(np.count_nonzero(seen.agreeing))

    runs = _runs(track.seen, longest=settings.track.longest_hole * rate)
    runs.sort(key=lambda run: max(map(worth, run)), reverse=True)
    poses: dict[int, Pose] = {}
    first = None
    for run in runs:
        best = max(run, key=worth)
        posed = _begin(detections, best, body, settings, rate)
        if first is None:
            first, body = best.frame, posed.body
        frames = [seen.frame for seen in run]
        begun = PosedBody(body, posed.pose)
        poses |= _follow(detections, begun, [f for f in frames if f >= best.frame], settings, rate)
        poses |= _follow(detections, begun, [f for f in reversed(frames) if f <= best.frame], settings, rate)
    assert first is not None
    return body, dict(sorted(poses.items())), first


def _runs(seen: Sequence[SeenPerson], *, longest: float) -> list[list[SeenPerson]]:
    """Split the frames of a person where none was found for longer than a number of frames."""
    runs = [[seen[0]]]
    for person in seen[1:]:
        if person.frame - runs[-1][-1].frame > longest:
            runs.append([])
        runs[-1].append(person)
    return runs


def _begin(
    detections: PersonDetections, seen: SeenPerson, body: Body, settings: PersonSettings, rate: float
) -> PosedBody:
    nothing = [np.zeros((camera.height, camera.width), bool) for camera in detections.cameras]
    take = SilhouetteTake(detections.cameras, lambda frame: nothing, (seen.frame,), rate)
    pixels = np.where(seen.agreeing[..., None], detections.pixels[seen.frame], np.nan)
    known = detections.segments(body) >= 0
    names = [name for name, has in zip(detections.joint_names, known, strict=True) if has]
    _, candidate = start_from_joints(take, seen.frame, names, pixels[:, known], body, settings)
    return replace(candidate.posed, body=body.with_numbers(candidate.posed.body.numbers))


def _follow(
    detections: PersonDetections, start: PosedBody, frames: Sequence[int], settings: PersonSettings, rate: float
) -> dict[int, Pose]:
    """Track the pose through frames that begin with the start's own."""
    found: dict[int, Pose] = {}
    pose, last = start.pose, frames[0]
    step: Floats = np.zeros(len(start.body.skeleton))
    for frame in frames:
        gap = max(1, abs(frame - last))
        spread = prediction_spread(start.body.skeleton, settings.track, rate=rate / gap)
        predicted = PosedBody(start.body, pose.step(settings.track.momentum * step) if gap == 1 else pose)
        near = NearPose(pose=predicted.pose, spread=spread)
        habit = Habit(share=settings.track.habit)
        posed = _fit_joints(detections, frame, predicted, [habit, near])
        worst, cost = _misfit(detections, frame, posed)
        if worst > detections.settings.poor:
            # Past the limit of a joint the prediction may lead to a wrong minimum; a neutral posture leads around it.
            other = _fit_joints(detections, frame, with_usual_limbs(predicted), [habit])
            posed = other if _misfit(detections, frame, other)[1] < cost else posed
        step = pose.change_to(posed.pose) if found and gap == 1 else np.zeros(len(step))
        pose, last = posed.pose, frame
        found[frame] = pose
    return found


def _fit_joints(detections: PersonDetections, frame: int, posed: PosedBody, priors: Sequence[Observation]) -> PosedBody:
    """Fit a pose to the agreeing joints of a frame."""
    zero, size = np.zeros((len(detections.joint_names), 3)), len(posed.body.skeleton)
    for _ in range(detections.settings.steps):
        information, gradient = np.zeros((size, size)), np.zeros(size)
        observed = detections.of_frame(frame, posed, zero, agreeing_only=True)
        add_dense(posed, [*observed, JointLimits(), *priors], information, gradient)
        change = solve_step(information, gradient)
        posed = replace(posed, pose=posed.pose.step(change))
        if np.abs(change).max() < detections.settings.stop:
            break
    return posed


def _misfit(detections: PersonDetections, frame: int, posed: PosedBody) -> tuple[float, float]:
    """Return the largest distance of the agreeing joints, in standard deviations, and their robust cost."""
    observed = detections.of_frame(frame, posed, np.zeros((len(detections.joint_names), 3)), agreeing_only=True)
    away = [joints.linearize(posed).residual.reshape(-1, 2) for joints in observed]
    squares = np.sum(np.concatenate([*away, np.zeros((1, 2))]) ** 2, axis=1)
    cost = (JOINT_FREEDOM + 2) * np.sum(np.log1p(squares / JOINT_FREEDOM))
    limits = JointLimits().whiten(posed).residual
    return float(np.sqrt(squares.max())), float(cost + limits @ limits)


def with_usual_limbs(posed: PosedBody) -> PosedBody:
    """Replace the angles of arms and legs by their usual values; those of the trunk are kept."""
    skeleton = posed.body.skeleton
    limbs = skeleton.segment_limb[skeleton.coordinate_segment] > 0
    angles = np.where(limbs, skeleton.habit[0], posed.pose.angles)
    return replace(posed, pose=replace(posed.pose, angles=angles))


@dataclass(frozen=True, eq=False)
class DetectionTerms:
    """Detected joints as terms of one round of a refinement; see `marey.fit.recipes.sequence_equations.FrameTerms`."""

    detections: PersonDetections
    offsets: Floats
    """(J, 3) see `joint_offsets`."""
    repeated: float = 1.0
    """Factor of the variances of the joints."""
    shared: int = 0
    """Number of unknowns that all frames share: none, since the offsets are estimated between the rounds."""

    @staticmethod
    def of_round(
        detections: PersonDetections, poses: Mapping[int, Pose], body: Body, *, alone: bool = False
    ) -> FrameTerms:
        """Estimate the offsets from the poses of the last round.

        Args:
            detections: The detected joints.
            poses: Poses by frame.
            body: The body of the poses.
            alone: Whether there are no silhouettes beside the joints.
        """
        repeated = 1.0 if alone else detections.settings.repeated_frames
        return DetectionTerms(detections, joint_offsets(detections, poses, body), repeated)

    def terms(self, frame: int, posed: PosedBody) -> tuple[Floats, Floats]:
        """Return the normal equations of a frame's detected joints by pose and shape."""
        size = len(posed.body.skeleton) + len(posed.body.space)
        information, gradient = np.zeros((size, size)), np.zeros(size)
        joints = self.detections.of_frame(frame, posed, self.offsets, repeated=self.repeated)
        add_dense(posed, joints, information, gradient, shape=True)
        return information, gradient


OFFSET_ROUNDS = 3
"""Rounds of robust weights in the estimate of the offsets. Chosen by hand."""


def joint_offsets(detections: PersonDetections, poses: Mapping[int, Pose], body: Body) -> Floats:
    """Estimate the constant offset of each detected joint from the body's joint, by robust least squares.

    Args:
        detections: The detected joints.
        poses: Poses by frame.
        body: The body of the poses.

    Returns:
        (J, 3) offsets in the frame of the segment that ends at the joint [m]; zero for joints that were not found.
    """
    settings, count = detections.settings, len(detections.joint_names)
    index = np.maximum(detections.segments(body), 0)
    alike = min(1.0, settings.distinct_frames / max(len(poses), 1))
    offsets = np.zeros((count, 3))
    for _ in range(OFFSET_ROUNDS):
        information, gradient = np.zeros((count, 3, 3)), np.zeros((count, 3))
        for frame, pose in poses.items():
            posed = PosedBody(body, pose)
            for joints in detections.of_frame(frame, posed, offsets):
                rows = np.flatnonzero(np.isin(index, joints.segments) & (detections.segments(body) >= 0))
                rows = rows[np.argsort(index[rows])][np.argsort(np.argsort(joints.segments))]
                turned = posed.segment_rotation[body.skeleton.parents[joints.segments]]
                seen, by_point = joints.camera.project_with_derivative(joints.predict(posed))
                residual = (seen - joints.pixels) / joints.sd_px[:, None]
                visible = np.isfinite(residual[:, 0])
                slope = (by_point @ turned) / joints.sd_px[:, None, None]
                weight = t_weights(np.sum(residual**2, axis=1))
                for i in np.flatnonzero(visible):
                    information[rows[i]] += weight[i] * slope[i].T @ slope[i]
                    gradient[rows[i]] += weight[i] * slope[i].T @ residual[i]
        prior = np.eye(3) / (detections.offset_sd_m**2)[:, None, None]
        pull = alike * gradient + offsets / detections.offset_sd_m[:, None] ** 2
        step = np.linalg.solve(alike * information + prior, pull[..., None])
        offsets = offsets - step[..., 0]
    return offsets


def terms_with(
    detections: PersonDetections, further: FrameTermsFactory | None, *, alone: bool = False
) -> FrameTermsFactory:
    """Return the detected joints as terms of the refinement, and further observations with them.

    Args:
        detections: The detected joints.
        further: Further observations.
        alone: Whether there are no silhouettes beside the joints.
    """

    def of_round(poses: Mapping[int, Pose], body: Body) -> FrameTerms:
        own = DetectionTerms.of_round(detections, poses, body, alone=alone)
        return JoinedTerms((own,) if further is None else (own, further(poses, body)))

    return of_round


@dataclass(frozen=True, eq=False)
class JoinedTerms:
    """Several kinds of further observations in one round of a refinement, none of them with shared unknowns."""

    kinds: tuple[FrameTerms, ...]
    """The terms of each kind; at most one of them has unknowns of a few frames."""
    shared: int = 0
    """Number of unknowns that all frames share."""

    def terms(self, frame: int, posed: PosedBody) -> tuple[Floats, Floats]:
        """Return the sum of the normal equations of a frame."""
        found = [kind.terms(frame, posed) for kind in self.kinds]
        return np.sum([information for information, _ in found], axis=0), np.sum([g for _, g in found], axis=0)

    @cached_property
    def _linked(self) -> LocalTerms | None:
        return next((kind for kind in self.kinds if isinstance(kind, LocalTerms)), None)

    @property
    def local_sd(self) -> float:
        """Standard deviation of an unknown of a few frames without observations."""
        return 1.0 if self._linked is None else self._linked.local_sd

    def local(self, frame: int, posed: PosedBody) -> LocalEquations | None:
        """Return the equations of a frame with unknowns of a few frames; None without any."""
        return None if self._linked is None else self._linked.local(frame, posed)

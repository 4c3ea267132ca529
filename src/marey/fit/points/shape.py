"""Estimation of a person's own metaballs and motion from measured points and silhouettes in one system."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from marey.arrays import Floats, Mask
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.body.metaballs.metaball_people import joint_spread, learned_metaballs
from marey.body.metaballs.metaball_person import (
    MetaballSpace,
    metaball_body,
    metaball_space,
    required_metaballs,
    single_radii,
)
from marey.body.people.person import CONSTANT, VARYING, family_body
from marey.errors import SettingProblem
from marey.fit.points.person_tracks import AttachedTracks, PersonTracks
from marey.fit.points.surface_points import MISFIT_PATCH_M, PersonPoints
from marey.fit.progress import FrameProgress, no_progress
from marey.fit.recipes.sequence import SequenceFit, SequenceSettings, join_pieces, refine_in_pieces
from marey.fit.recipes.sequence_equations import FrameTerms
from marey.fit.search.levels import FrameLevels
from marey.fit.solver.picture_times import PictureTimes
from marey.fit.solver.pose_solver import add_dense
from marey.observations.observation import Observation

FREED_SEGMENTS = ("abdomen", "thorax", "neck", "head")
"""Segments that a preset may fix for lack of outlines, but whose rotation is visible in surface points."""


@dataclass(frozen=True, kw_only=True)
class ShapeSettings:
    """Settings of the refinement with measured points.

    Fields without a source were chosen by hand; results were not measured against other values.
    """

    sequence: SequenceSettings = field(default_factory=SequenceSettings)
    """Settings of the sequence's system."""
    rounds: int = 3
    """Linearisations before the standard deviations are estimated again."""
    repeats: int = 2
    """Number of such estimates with each body, see `DETAILS_IN_TURN`."""
    begin_model_sd_m: float = 0.004
    """Initial standard deviation of the person's surface from that of the metaballs; later it is estimated [m]."""
    begin_scale_m: float = 0.02
    """Initial residual at which a point has a quarter of its weight [m]."""
    shape_frames: int = 60
    """Number of frames from which the shape is estimated."""
    points_a_frame: int = 1000
    """Number of points used per frame: neighbouring points are nearly redundant, and more would outweigh the
    silhouettes. With 3000 the skin of `arm3` is 0.08 mm nearer, but the shoulder 4 mm and the elbow 0.7 degrees worse
    (docs/accuracy/rejected.md)."""
    neighbours: float = 10.0
    """Number of contour pixels with a common deviation from the model, which count as one observation."""
    misfit_patch_m: float = MISFIT_PATCH_M
    """Size of the patches over which a person deviates from fitted metaballs by the same amount [m]."""
    first_scale_m: float = 0.05
    """Residual at which a point has a quarter of its weight while the pose comes from clicked joints [m]. Chosen by
    hand."""
    vertex_sd_m: float = 0.05
    """Standard deviation of vertices, many of which deviate together, from another body's, per axis [m]. Chosen by
    hand."""
    joint_centre_sd_m: float = 0.01
    """Standard deviation of joint centres from another body's, per axis [m]. Chosen by hand."""


SHAPE_DEFAULTS = ShapeSettings()
"""Default settings of the refinement with measured points."""

DETAILS_IN_TURN: tuple[str, ...] = ("simple", "full", "single")
"""Bodies in the order of the fit ([Plaenkers1999] section 4.4): simplified limbs for a rough start; all balls with
the learned person's numbers; all balls with radii of their own."""


def with_free_trunk(body: Body) -> Body:
    """Free the trunk's coordinates as in the full body, even if the preset fixes them."""
    every = family_body("coarse").skeleton
    have = {c.name for c in body.skeleton.coordinates}
    kept = tuple(c for c in every.coordinates if c.name in have or c.segment in FREED_SEGMENTS)
    return replace(body, skeleton=replace(every, coordinates=kept))


def with_coordinates(pose: Pose, old: Body, new: Body) -> Pose:
    """Convert a pose from one body's coordinates to another's; coordinates that the first lacks are zero."""
    angles = dict(zip((c.name for c in old.skeleton.coordinates), pose.angles, strict=True))
    wanted = [angles.get(c.name, 0.0) for c in new.skeleton.coordinates]
    return Pose(pose.translation, pose.rotation, np.array(wanted))


def metaballs_like(body: Body, detail: str = "full", settings: ShapeSettings = SHAPE_DEFAULTS) -> Body:
    """Make a person of metaballs with the shape of a body whose skin has the family's vertices.

    The skeleton, and the parts of the skin that exist and count, are kept. A body of metaballs is returned unchanged.

    Args:
        body: A learned body, as a capture estimates it, or one of metaballs.
        detail: "simple", or "full": all balls with the learned person's numbers.
        settings: Standard deviations of the two bodies from each other.

    Raises:
        SettingProblem: The body's skin has other vertices.
    """
    if body.metaballs is not None:
        return body
    if len(body.vertices) != len(family_body("fine").vertices):
        raise SettingProblem("A scan has no shape parameters for metaballs. Leave out body (--body).")
    general = learned_metaballs() if detail == "full" else metaball_space("simple")
    space = replace(general, mean=replace(general.mean, skeleton=body.skeleton))
    if detail == "full" and space.names == body.space.names:
        # The prior of this person, for example the stature, belongs to the learned body.
        space = replace(space, prior_mean=body.space.prior_mean, prior_covariance=body.space.prior_covariance)
        return _remade(space, body.numbers, body)
    beneath, beside = joint_spread()
    made = metaball_body(space, numbers_like(space, body, settings), body, keep_weights=True)
    return replace(made, joint_sd=VARYING * beneath, joint_offset_sd=np.hypot(CONSTANT * beneath, beside))


def numbers_like(space: MetaballSpace, body: Body, settings: ShapeSettings = SHAPE_DEFAULTS) -> Floats:
    """Return the numbers (N,) of the metaball person most similar to a body whose skin has the same vertices."""
    generic, there = metaball_body(space, template=body).space, np.unique(body.faces)
    weigh = np.concatenate([
        np.full(3 * len(there), 1 / settings.vertex_sd_m),
        np.full(body.joint_centres.size, 1 / settings.joint_centre_sd_m),
    ])  # fmt: skip
    modes = np.concatenate([generic.vertex_modes[:, there], generic.joint_modes], 1).reshape(len(space), -1) * weigh
    off = np.concatenate([body.vertices[there] - generic.vertex_mean[there], body.joint_centres - generic.joint_mean])
    prior = np.linalg.inv(space.prior_covariance)
    return np.asarray(
        np.linalg.solve(modes @ modes.T + prior, modes @ (off.ravel() * weigh) + prior @ space.prior_mean)
    )


def more_detailed(body: Body, detail: str, settings: ShapeSettings = SHAPE_DEFAULTS) -> Body:
    """Give a body of metaballs more balls, or more numbers: "full" has the learned person's, "single" all radii.

    Args:
        body: Body of metaballs.
        detail: One of `DETAILS_IN_TURN`; the body is returned unchanged if it is already that detailed.
        settings: Standard deviations of the two bodies from each other.
    """
    space = required_metaballs(body)
    if detail == "full" and has_simple_limbs(body):
        general = learned_metaballs()
        whole = replace(general, mean=replace(general.mean, skeleton=space.mean.skeleton))
        return _remade(whole, numbers_like(whole, body, settings), body)
    if detail == "single" and not any("_ball_" in name for name in space.names):
        names = [body.skeleton.segment_names[k] for k in np.flatnonzero(measured_segments(body))]
        single = single_radii(space, [name.rpartition("_")[2] for name in names])
        return _remade(single, np.concatenate([body.numbers, np.zeros(len(single) - len(space))]), body)
    return body


def has_simple_limbs(body: Body) -> bool:
    """Return whether a body has simplified limbs, each with a width."""
    return "upperarm_width" in body.space.names


def _remade(space: MetaballSpace, numbers: Floats, body: Body) -> Body:
    made = metaball_body(space, numbers, body, keep_weights=True)
    return replace(made, joint_sd=body.joint_sd, joint_offset_sd=body.joint_offset_sd)


def measured_segments(body: Body) -> Mask:
    """Return the segments (S,) that the preset follows."""
    return np.ones(len(body.skeleton.segment_names), bool) if body.followed is None else np.asarray(body.followed)


@dataclass(frozen=True, eq=False)
class ShapeEstimate:
    """A person's estimated shape and motion, with the standard deviations of the observations."""

    body: Body
    poses: dict[int, Pose]
    """Poses by frame."""
    model_sd_m: float
    """Standard deviation of points in addition to their own (variance component) [m]."""
    outline_sd_px: float
    """Standard deviation of the outlines' matches (variance component) [px]."""
    skin_sd_m: float = 0.006
    """Standard deviation of tracked points relative to their segments (variance component) [m]."""


@dataclass(frozen=True, eq=False)
class SurfaceMeasurements:
    """Measurements of a person's surface: points by frame, tracked points, and clicked joints."""

    points: PersonPoints
    """Points by frame."""
    tracks: PersonTracks | None = None
    """Tracked points, if any."""
    clicked: Mapping[int, Sequence[Observation]] = field(default_factory=dict)
    """Clicked joints, by frame."""

    def with_uncertainty(self, shaped: ShapeEstimate, scale_m: float = np.inf) -> "SurfaceMeasurements":
        """Set the standard deviations of both to those of an estimate, and the points' robust scale accordingly."""
        tracks = None if self.tracks is None else replace(self.tracks, skin_sd_m=shaped.skin_sd_m)
        return replace(self, points=with_uncertainty(self.points, shaped.model_sd_m, scale_m), tracks=tracks)

    def with_correlated_patches(self, patch_m: float) -> "SurfaceMeasurements":
        """Count the points of one patch of a size [m] as one.

        The fit itself uses patches of a centimetre only, so that radii can follow smaller features; its stated
        uncertainty would be several times too small.
        """
        tracks = None if self.tracks is None else replace(self.tracks, patch_m=patch_m)
        return replace(self, points=replace(self.points, patch_m=patch_m), tracks=tracks)

    def terms_of_round(self, poses: Mapping[int, Pose], body: Body) -> FrameTerms:
        """Prepare the measurements for a round of the refinement, see `sequence.FrameTermsFactory`."""
        return _RoundTerms(self, None if self.tracks is None else self.tracks.attached(poses, body))


@dataclass(frozen=True, eq=False)
class _RoundTerms:
    """Sum of the normal equations of all measurements."""

    measured: SurfaceMeasurements
    tracks: AttachedTracks | None

    @property
    def shared(self) -> int:
        return 0 if self.tracks is None else self.tracks.shared

    def terms(self, frame: int, posed: PosedBody) -> tuple[Floats, Floats]:
        hessian, gradient = self.measured.points.terms(frame, posed)
        add_dense(posed, self.measured.clicked.get(frame, ()), hessian, gradient, shape=True)
        if self.tracks is None:
            return hessian, gradient
        size, (more, pull) = len(gradient), self.tracks.terms(frame, posed)
        more[:size, :size] += hessian
        pull[:size] += gradient
        return more, pull


def final_covariances(
    found: ShapeEstimate, levels: FrameLevels, measured: SurfaceMeasurements, *, rate: float, settings: ShapeSettings,
    times: PictureTimes | None = None,
) -> Iterator[SequenceFit]:  # fmt: skip
    """Compute the uncertainty of a refined motion and shape, with correlated deviations of points taken into account.

    Args:
        found: Estimate, whose poses and body are kept.
        levels: Silhouettes.
        measured: Measurements with the uncertainty used in the refinement.
        rate: Frame rate [Hz].
        settings: Settings of the refinement.
        times: When the cameras have taken their pictures; None if that is at the instants of the frames.
    """
    frames = list(found.poses)
    for fit in refine_in_pieces(
        frames, list(found.poses.values()), found.body, levels, rate=rate, rounds=1,
        shape_frames=evenly_spaced(frames, settings.shape_frames),
        settings=replace(settings.sequence, sigma_px=found.outline_sd_px),
        extra_terms=measured.with_correlated_patches(settings.misfit_patch_m).terms_of_round, times=times,
    ):  # fmt: skip
        body = replace(found.body, numbers_covariance=fit.body.numbers_covariance)
        yield replace(fit, poses=tuple(found.poses[int(frame)] for frame in fit.frames), body=body)


def refine_shape(
    begun: ShapeEstimate,
    levels: FrameLevels,
    measured: SurfaceMeasurements,
    *,
    rate: float,
    repeats: int,
    settings: ShapeSettings,
    scale_m: float = np.inf,
    times: PictureTimes | None = None,
    progress: FrameProgress = no_progress,
) -> ShapeEstimate:
    """Refine shape and motion, and estimate the standard deviations that weigh the observations from the residuals.

    Args:
        begun: Body of metaballs, poses by frame, and initial standard deviations.
        levels: Silhouettes; a frame without any has its points only.
        measured: Measurements; their positions on the body are found again in every round.
        rate: Frame rate [Hz].
        repeats: Number of estimates of the standard deviations.
        settings: Settings of the refinement.
        scale_m: Upper limit of the residual at which a point has a quarter of its weight [m].
        times: When the cameras have taken their pictures; None if that is at the instants of the frames.
        progress: Called with each frame in each round.
    """
    for _ in range(repeats):
        measured = measured.with_uncertainty(begun, scale_m)
        pieces = refine_in_pieces(
            list(begun.poses), list(begun.poses.values()), begun.body, levels, rate=rate, rounds=settings.rounds,
            shape_frames=evenly_spaced(list(begun.poses), settings.shape_frames),
            settings=replace(settings.sequence, sigma_px=begun.outline_sd_px), extra_terms=measured.terms_of_round,
            times=times, progress=progress,
        )  # fmt: skip
        begun = reestimated(join_pieces(list(pieces)), measured, settings)
        scale_m = measured.points.scale_m
    return begun


def with_uncertainty(points: PersonPoints, model_sd_m: float, scale_m: float = np.inf) -> PersonPoints:
    """Set the points' standard deviation from the model, and the robust scale accordingly, up to the one given [m]."""
    return replace(points, model_sd_m=model_sd_m, scale_m=scale_m).with_narrower_scale(0.0)


def reestimated(fit: SequenceFit, measured: SurfaceMeasurements, settings: ShapeSettings) -> ShapeEstimate:
    """Estimate the standard deviations of all kinds of observations from the residuals (variance components)."""
    poses = fit.by_frame
    bodies = {f: PosedBody(fit.body, pose) for f, pose in poses.items()}
    outline = np.sqrt(settings.neighbours) * fit.residual_px
    tracks = None if measured.tracks is None else measured.tracks.attached(poses, fit.body).reestimated(bodies)
    return ShapeEstimate(
        fit.body, poses, measured.points.reestimated(bodies).model_sd_m,
        float(outline) if np.isfinite(outline) and outline > 0 else settings.sequence.sigma_px,
        ShapeEstimate.skin_sd_m if tracks is None else tracks.skin_sd_m,
    )  # fmt: skip


def evenly_spaced(frames: Sequence[int], most: int) -> list[int]:
    """Choose at most a number of frames, evenly spaced."""
    index = np.unique(np.linspace(0, len(frames) - 1, min(most, len(frames))).astype(int))
    return [frames[i] for i in index]

"""The recipe: a person's own metaballs and motion from measured points and silhouettes, in one system."""

from collections.abc import Callable, Iterator, Mapping, Sequence
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
from marey.fit.points.person_tracks import FastenedTracks, PersonTracks
from marey.fit.points.surface_points import PersonPoints
from marey.fit.recipes.sequence import FrameTerms, SequenceFit, SequenceSettings, joined, refine_in_pieces
from marey.fit.search.levels import FrameLevels
from marey.fit.solver.pose_solver import add_dense
from marey.observations.observation import Observation

TRUNK = ("abdomen", "thorax", "neck", "head")
"""Segments that a preset may hold still for want of outlines, but whose surface points show how they turn."""


@dataclass(frozen=True, kw_only=True)
class ShapeSettings:
    """How shape and motion are refined with measured points; the defaults are what measured best (docs/accuracy.md)."""

    sequence: SequenceSettings = field(default_factory=SequenceSettings)
    rounds: int = 3
    """Linearisations before the standard deviations are estimated again."""
    repeats: int = 2
    """How often that happens with each body, see `details`."""
    begin_model_sd_m: float = 0.004
    """How far the person's surface is believed to lie from the metaballs', before the fit says so [m]."""
    begin_scale_m: float = 0.02
    """Distance at which a point counts a quarter, at first [m]."""
    shape_frames: int = 60
    """Frames from which the shape is learned."""
    points_a_frame: int = 1000
    """Points of a frame that are used: their neighbours say nearly the same, and more would outvote the silhouettes
    (docs/accuracy.md)."""
    neighbours: float = 10.0
    """Pixels of a contour that lie off the model by as much: so many are worth one."""


ALIKE_M = 0.075
"""Over how many metres a person lies off fitted metaballs alike [m]: on the arm of docs/accuracy.md the residuals'
correlation is 0.8 within a centimetre, 0.5 at 2.5, 0.2 at five and none beyond 12, in all as in such a square."""

DETAILS_IN_TURN: tuple[str, ...] = ("simple", "full", "single")
"""The bodies in the order of the fit ([Plaenkers1999] section 4.4): the simplified limbs where a start is rough; all
balls with the learned person's numbers; all balls with radii of their own."""


def freed(body: Body) -> Body:
    """Let the trunk of a body turn as a whole person's does, whatever its preset holds still."""
    every = family_body("coarse").skeleton
    have = {c.name for c in body.skeleton.coordinates}
    kept = tuple(c for c in every.coordinates if c.name in have or c.segment in TRUNK)
    return replace(body, skeleton=replace(every, coordinates=kept))


def with_coordinates(pose: Pose, old: Body, new: Body) -> Pose:
    """Give a pose of one body's coordinates those of another's; what the first lacks is zero."""
    angles = dict(zip((c.name for c in old.skeleton.coordinates), pose.angles, strict=True))
    wanted = [angles.get(c.name, 0.0) for c in new.skeleton.coordinates]
    return Pose(pose.translation, pose.rotation, np.array(wanted))


def metaballs_like(body: Body, detail: str = "full") -> Body:
    """Give a person of metaballs the shape of a body whose skin has the family's vertices.

    Skeleton, and what of the skin is there and counts, stay. A body of metaballs is given as it is.

    Args:
        body: learned, as a capture finds it, or of metaballs.
        detail: "simple", or "full": all balls with the learned person's numbers.

    Raises:
        SettingProblem: The body's skin is another one.
    """
    if body.metaballs is not None:
        return body
    if len(body.vertices) != len(family_body("fine").vertices):
        raise SettingProblem("A scan has no numbers that metaballs could share; fit the shape without --body.")
    general = learned_metaballs() if detail == "full" else metaball_space("simple")
    space = replace(general, mean=replace(general.mean, skeleton=body.skeleton))
    if detail == "full" and space.names == body.space.names:
        # What is expected of this person, its stature among it, was said of the learned body.
        space = replace(space, prior_mean=body.space.prior_mean, prior_covariance=body.space.prior_covariance)
        return _remade(space, body.numbers, body)
    beneath, beside = joint_spread()
    made = metaball_body(space, numbers_like(space, body), body, keep_weights=True)
    return replace(made, joint_sd=VARYING * beneath, joint_offset_sd=np.hypot(CONSTANT * beneath, beside))


SKIN_SD, JOINT_SD = 0.05, 0.01
"""How far vertices, many of which lie off together, and joint centres may lie from another body's, by axis [m]."""


def numbers_like(space: MetaballSpace, body: Body) -> Floats:
    """Give the numbers (N,) of the metaball person most like a body whose skin has the same vertices."""
    generic, there = metaball_body(space, template=body).space, np.unique(body.faces)
    weigh = np.concatenate([np.full(3 * len(there), 1 / SKIN_SD), np.full(body.joint_centres.size, 1 / JOINT_SD)])
    modes = np.concatenate([generic.vertex_modes[:, there], generic.joint_modes], 1).reshape(len(space), -1) * weigh
    off = np.concatenate([body.vertices[there] - generic.vertex_mean[there], body.joint_centres - generic.joint_mean])
    prior = np.linalg.inv(space.prior_covariance)
    return np.asarray(
        np.linalg.solve(modes @ modes.T + prior, modes @ (off.ravel() * weigh) + prior @ space.prior_mean)
    )


def more_detailed(body: Body, detail: str) -> Body:
    """Give a body of metaballs more of them, or more numbers: "full" has the learned person's, "single" all radii.

    Args:
        body: of metaballs.
        detail: one of `DETAILS_IN_TURN`; the body itself where it is as detailed already.
    """
    space = required_metaballs(body)
    if detail == "full" and simplified(body):
        general = learned_metaballs()
        whole = replace(general, mean=replace(general.mean, skeleton=space.mean.skeleton))
        return _remade(whole, numbers_like(whole, body), body)
    if detail == "single" and not any("_ball_" in name for name in space.names):
        names = [body.skeleton.segment_names[k] for k in np.flatnonzero(measured_segments(body))]
        single = single_radii(space, [name.rpartition("_")[2] for name in names])
        return _remade(single, np.concatenate([body.numbers, np.zeros(len(single) - len(space))]), body)
    return body


def simplified(body: Body) -> bool:
    """Tell whether a body has simplified limbs, each with a width."""
    return "upperarm_width" in body.space.names


def _remade(space: MetaballSpace, numbers: Floats, body: Body) -> Body:
    made = metaball_body(space, numbers, body, keep_weights=True)
    return replace(made, joint_sd=body.joint_sd, joint_offset_sd=body.joint_offset_sd)


def measured_segments(body: Body) -> Mask:
    """Tell which segments (S,) the preset follows."""
    return np.ones(len(body.skeleton.segment_names), bool) if body.followed is None else np.asarray(body.followed)


@dataclass(frozen=True, eq=False)
class Shaped:
    """A person fitted so far."""

    body: Body
    poses: dict[int, Pose]
    model_sd_m: float
    """Of points, on top of their own (variance component) [m]."""
    outline_sd_px: float
    """Of outlines' matches (variance component) [px]."""
    skin_sd_m: float = 0.006
    """Of followed points in their segments (variance component) [m]."""


@dataclass(frozen=True, eq=False)
class OnSurface:
    """What was measured on a person: points of each frame, points that were followed, and joints that were clicked."""

    points: PersonPoints
    tracks: PersonTracks | None = None
    clicked: Mapping[int, Sequence[Observation]] = field(default_factory=dict)
    """Joints, by frame."""

    def believed(self, shaped: Shaped, scale_m: float = np.inf) -> "OnSurface":
        """Set how well both are believed to fit, and the points' robust scale that goes with it, see `believed`."""
        tracks = None if self.tracks is None else replace(self.tracks, skin_sd_m=shaped.skin_sd_m)
        return replace(self, points=believed(self.points, shaped.model_sd_m, scale_m), tracks=tracks)

    def as_alike(self) -> "OnSurface":
        """Count points as one over as many metres as a person lies off the metaballs alike (`ALIKE_M`).

        The fit itself counts them over a centimetre only, so that radii follow what is smaller than that; what it would
        state then is several times too certain.
        """
        tracks = None if self.tracks is None else replace(self.tracks, patch_m=ALIKE_M)
        return replace(self, points=replace(self.points, patch_m=ALIKE_M), tracks=tracks)

    def of_round(self, poses: Mapping[int, Pose], body: Body) -> FrameTerms:
        """Make it ready for a round of the refinement, see `sequence.Further`."""
        return _OfRound(self, None if self.tracks is None else self.tracks.fastened(poses, body))


@dataclass(frozen=True, eq=False)
class _OfRound:
    """All that was measured, as one sum of equations."""

    measured: OnSurface
    tracks: FastenedTracks | None

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


def stated(
    found: Shaped, levels: FrameLevels, measured: OnSurface, *, rate: float, settings: ShapeSettings
) -> Iterator[SequenceFit]:
    """Say how certain a refined motion and shape are, with points that lie off alike counted as one.

    Args:
        found: whose poses and body stay.
        levels: silhouettes.
        measured: as the refinement believed it.
        rate: frames in a second.
        settings: as there.
    """
    frames = list(found.poses)
    for fit in refine_in_pieces(
        frames, list(found.poses.values()), found.body, levels, rate=rate, rounds=1,
        shape_frames=evenly(frames, settings.shape_frames),
        settings=replace(settings.sequence, sigma_px=found.outline_sd_px), also=measured.as_alike().of_round,
    ):  # fmt: skip
        body = replace(found.body, numbers_covariance=fit.body.numbers_covariance)
        yield replace(fit, poses=tuple(found.poses[int(frame)] for frame in fit.frames), body=body)


def refine_shape(
    begun: Shaped,
    levels: FrameLevels,
    measured: OnSurface,
    *,
    rate: float,
    repeats: int,
    settings: ShapeSettings,
    scale_m: float = np.inf,
    done: Callable[[int], None] = lambda frame: None,
) -> Shaped:
    """Refine shape and motion until the standard deviations that weigh the observations agree with what is left over.

    Args:
        begun: a body of metaballs, poses by frame, and what is believed of the observations.
        levels: silhouettes; a frame without any has its points only.
        measured: points; where they lie on the body is found anew in every round.
        rate: frames in a second.
        repeats: how often.
        settings: how.
        scale_m: no greater a distance counts a quarter [m].
        done: told of every frame in every round.
    """
    for _ in range(repeats):
        measured = measured.believed(begun, scale_m)
        pieces = refine_in_pieces(
            list(begun.poses), list(begun.poses.values()), begun.body, levels, rate=rate, rounds=settings.rounds,
            shape_frames=evenly(list(begun.poses), settings.shape_frames),
            settings=replace(settings.sequence, sigma_px=begun.outline_sd_px), also=measured.of_round,
            done=done,
        )  # fmt: skip
        begun = reestimated(joined(list(pieces)), measured, settings)
        scale_m = measured.points.scale_m
    return begun


def believed(points: PersonPoints, model_sd_m: float, scale_m: float = np.inf) -> PersonPoints:
    """Set how well points are believed to fit, and the robust scale that goes with it, up to the one given [m]."""
    return replace(points, model_sd_m=model_sd_m, scale_m=scale_m).narrowed(0.0)


def reestimated(fit: SequenceFit, measured: OnSurface, settings: ShapeSettings) -> Shaped:
    """Estimate the kinds' standard deviations from what the fit left over (variance components)."""
    poses = fit.by_frame
    bodies = {f: PosedBody(fit.body, pose) for f, pose in poses.items()}
    outline = np.sqrt(settings.neighbours) * fit.residual_px
    tracks = None if measured.tracks is None else measured.tracks.fastened(poses, fit.body).reestimated(bodies)
    return Shaped(
        fit.body, poses, measured.points.reestimated(bodies).model_sd_m,
        float(outline) if np.isfinite(outline) and outline > 0 else settings.sequence.sigma_px,
        Shaped.skin_sd_m if tracks is None else tracks.skin_sd_m,
    )  # fmt: skip


def evenly(frames: Sequence[int], most: int) -> list[int]:
    """Choose at most so many frames, evenly."""
    index = np.unique(np.linspace(0, len(frames) - 1, min(most, len(frames))).astype(int))
    return [frames[i] for i in index]

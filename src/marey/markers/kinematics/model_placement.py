"""Points on the bodies of a scaled model through which it follows the segments of a person."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.body.articulation.jointed_body import JointedBody, ModelMarker
from marey.body.articulation.jointed_kinematics import PlacedBodies, place
from marey.body.articulation.model_points import SegmentOnModel, segments_on_model
from marey.body.articulation.model_scaling import JointPlaces, centre_in_ground, neutral_posture
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.trajectories import trajectories
from marey.markers.kinematics.inverse_kinematics import inverse_kinematics
from marey.markers.kinematics.tasks import CoordinateTask, MarkerTask, TaskSet

POINT_DISTANCE_M = 0.1
"""Distance of the points of a segment from its joint centre along its axes [m]. Chosen by hand, as about the distance
of markers on a segment; results were not measured with other values."""
_KINDS_TURNED = ("pelvis", "thigh", "upperarm")
"""Segments, without their side, whose axes a person and a model share in the reference posture. A shank's differ by the
torsion of the tibia, a forearm's by its pronation."""
_CENTRE_WEIGHT, _TURN_WEIGHT, _COORDINATE_WEIGHT = 1.0, 0.1, 1e-6
"""Weights in the reference posture: of a joint centre and of a point that shows a rotation [relative], and of a
coordinate against its neutral value [m2 per rad2 or m2]. Chosen by hand: a coordinate that is off by 0.1 rad costs as
much as points that are off by 0.1 mm."""
_FACING_S = 1.0
"""Time over which the direction of the pelvis is averaged for a thorax that was not measured [s]: about a gait cycle,
within which the pelvis turns to both sides. Chosen by hand."""
_UP = np.array([0.0, 1.0, 0.0])
"""Direction up in the ground of OpenSim's models."""
_AXES = "xyz"
"""Endings of the names of points along the axes of a segment."""


@dataclass(frozen=True, eq=False, kw_only=True)
class StandingPosture:
    """A posture of a person, in the ground of the model (Y up)."""

    joints: JointPlaces
    """Joint centres."""
    segments: tuple[str, ...]
    """S names."""
    rotation: Floats
    """(S, 3, 3) ground from anatomical axes."""
    origin: Floats
    """(S, 3) centre about which each segment rotates [m]."""
    own_feet: bool
    """Whether the axes of the feet were measured, rather than taken from the shanks."""

    def __post_init__(self) -> None:
        freeze_fields(self, "rotation", "origin")


@dataclass(frozen=True, eq=False, kw_only=True)
class SegmentPoint:
    """A point of a segment, and where it is on a body of the model."""

    label: str
    """Name of the point."""
    segment: str
    """Name of the segment."""
    offset: Floats
    """(3,) from the segment's origin, along its anatomical axes [m]."""
    body: str
    """Body of the model."""
    place: Floats
    """(3,) in the body [m]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "offset", "place")


@dataclass(frozen=True, eq=False, kw_only=True)
class PlacedSegments:
    """The segments of a person on a model."""

    points: tuple[SegmentPoint, ...]
    """Four points of each segment."""
    thorax_centre: Floats | None
    """(3,) the joint of the thorax in the reference posture, in the ground [m]; None if the model has no thorax."""


def place_segment_points(
    model: JointedBody, joints: Mapping[str, str], reference: StandingPosture
) -> PlacedSegments:
    """Find where points of a person's segments are on the bodies of a model.

    The model takes the reference posture: by inverse kinematics its joint centres meet those of the person, and pelvis,
    thorax, thighs, upper arms and measured feet take their rotations. Then four points of each segment, its joint
    centre and one along each axis, are fixed to the bodies where they are in this posture; so constant differences
    between the axes of person and model, as by the torsion of a tibia, have no effect on the motion. The thorax is
    upright in the reference posture, and has no place of its own: its points are about its joint in the model.

    Args:
        model: The model, scaled to the person.
        joints: Maps a joint centre to the body that rotates about it.
        reference: The person, standing about straight.

    Returns:
        The points of all segments that the model has.
    """
    known = segments_on_model(model, joints, reference.segments)
    posed = _posed(model, joints, known, reference, None)
    trunk = next((one for one in known if one.segment == "thorax"), None)
    centre = None
    if trunk is not None:
        centre = centre_in_ground(model, posed, trunk.body)
        posed = _posed(model, joints, known, reference, centre)
    points = []
    for one in known:
        s = reference.segments.index(one.segment)
        rotation = reference.rotation[s]
        origin = centre if one.segment == "thorax" and centre is not None else reference.origin[s]
        k = model.body_names.index(one.body)
        for ending, offset in zip(("o", *_AXES), np.vstack([np.zeros(3), POINT_DISTANCE_M * np.eye(3)]), strict=True):
            at = origin + rotation @ offset
            points.append(
                SegmentPoint(
                    label=f"{one.segment}_{ending}", segment=one.segment, offset=offset, body=one.body,
                    place=posed.rotation[k].T @ (at - posed.origin[k]),
                )
            )  # fmt: skip
    return PlacedSegments(points=tuple(points), thorax_centre=centre)


def _posed(
    model: JointedBody, joints: Mapping[str, str], known: Sequence[SegmentOnModel], reference: StandingPosture,
    thorax_centre: Floats | None,
) -> PlacedBodies:  # fmt: skip
    """Return the model in the reference posture, with an upright thorax if its centre is known."""
    markers: list[ModelMarker] = []
    places, weights = [], []
    neutral = place(model, neutral_posture(model))
    for name, body in joints.items():
        if name in reference.joints.names:
            k = model.body_names.index(body)
            centre = neutral.rotation[k].T @ (centre_in_ground(model, neutral, body) - neutral.origin[k])
            markers.append(ModelMarker(label=name, body=body, place=centre))
            places.append(reference.joints.places[reference.joints.names.index(name)])
            weights.append(_CENTRE_WEIGHT)
    for one in known:
        target = _target(one, reference, thorax_centre)
        if target is not None:
            markers += [
                ModelMarker(label=f"{one.segment}{a}{sign}", body=one.body, place=one.centre + step * one.axes[:, a])
                for a in range(3) for sign, step in (("+", POINT_DISTANCE_M), ("-", -POINT_DISTANCE_M))
            ]  # fmt: skip
            rotation, origin = target
            places += [
                origin + step * rotation[:, a] for a in range(3) for step in (POINT_DISTANCE_M, -POINT_DISTANCE_M)
            ]
            weights += [_TURN_WEIGHT] * 6
    labels = [marker.label for marker in markers]
    base = {m.coordinate for body in model.bodies if body.parent is None for m in body.motions}
    tasks = TaskSet(
        markers=tuple(MarkerTask(label=n, weight=w) for n, w in zip(labels, weights, strict=True)),
        coordinates=tuple(
            CoordinateTask(coordinate=c.name, weight=_COORDINATE_WEIGHT, value=0.0)
            for c, free in zip(model.coordinates, model.free, strict=True) 
            if free and c.rotational and c.name not in base
        ),
    )  # fmt: skip
    marked = replace(model, markers=tuple(markers))
    found = inverse_kinematics(marked, tasks, trajectories(labels, np.array(places)[None], 1.0))
    values = np.where(np.isfinite(found.coordinates[0]), found.coordinates[0], neutral_posture(model))
    return place(model, model.coupled(values))


def _target(
    one: SegmentOnModel, reference: StandingPosture, thorax_centre: Floats | None
) -> tuple[Floats, Floats] | None:
    """Return the axes that a body takes in the reference posture, and about where; None if they are not shared."""
    s, kind = reference.segments.index(one.segment), one.segment.rpartition("_")[2]
    if kind in _KINDS_TURNED or (kind == "foot" and reference.own_feet):
        return reference.rotation[s], reference.origin[s]
    if kind == "thorax" and thorax_centre is not None and "pelvis" in reference.segments:
        return _upright(reference.rotation[reference.segments.index("pelvis")][:, 2] * (1 - _UP)), thorax_centre
    return None


def with_upright_thorax(
    motion: BoneMotion, reference: StandingPosture, *, rate: float
) -> tuple[BoneMotion, StandingPosture]:
    """Add a thorax that was not measured: upright, facing where the pelvis faces on average.

    A trunk that moved with the pelvis instead would sway with every step.

    Args:
        motion: The segments of the person, in the ground of the model, with a pelvis and without a thorax.
        reference: The reference posture, with a pelvis and without a thorax.
        rate: Frame rate [Hz].

    Returns:
        Both with a thorax, whose standard deviations are unknown.
    """
    turn = motion.bone("pelvis")[0]
    facing = _running_mean(turn[:, :, 2] * (1 - _UP), round(_FACING_S * rate))
    standing = reference.rotation[reference.segments.index("pelvis")][:, 2] * (1 - _UP)
    count = len(motion)
    unknown = np.full((count, 1, 6, 6), np.nan)
    added = BoneMotion(
        segments=(*motion.segments, "thorax"), rotation=np.concatenate([motion.rotation, _upright(facing)[:, None]], 1),
        origin=np.concatenate([motion.origin, motion.bone("pelvis")[1][:, None]], 1),
        covariance=np.concatenate([motion.covariance, unknown], 1),
    )  # fmt: skip
    start = reference.origin[[reference.segments.index("pelvis")]]
    return added, replace(
        reference, segments=(*reference.segments, "thorax"), origin=np.concatenate([reference.origin, start]),
        rotation=np.concatenate([reference.rotation, _upright(standing)[None]]),
    )  # fmt: skip


def _upright(right: Floats) -> Floats:
    """Return axes (..., 3, 3) with Y up, and Z along a horizontal direction (..., 3)."""
    right = right / np.linalg.norm(right, axis=-1, keepdims=True)
    up = np.broadcast_to(_UP, right.shape)
    return np.stack([np.cross(up, right), up, right], -1)


def _running_mean(values: Floats, width: int) -> Floats:
    """Average values (F, 3) over a centred window, without missing ones; NaN where the value itself is missing."""
    known: Mask = np.asarray(np.isfinite(values).all(1))
    window = np.ones(2 * (width // 2) + 1)
    total = np.stack([np.convolve(np.where(known, column, 0.0), window, "full") for column in values.T], 1)
    counts = np.convolve(known.astype(float), window, "full")
    kept = slice(width // 2, width // 2 + len(values))
    return np.where(known[:, None], total[kept] / np.maximum(counts[kept], 1.0)[:, None], np.nan)


def thorax_on_pelvis(motion: BoneMotion, reference: StandingPosture, centre: Floats) -> BoneMotion:
    """Let the pelvis carry the origin of the thorax, as it carries the joint of a model's thorax.

    Args:
        motion: The segments of the person, in the ground of the model, with a pelvis and a thorax.
        reference: The reference posture.
        centre: (3,) the joint of the thorax in the reference posture [m].

    Returns:
        The motion with the origin of the thorax on the pelvis, with the covariance of the pelvis there.
    """
    pelvis, thorax = (motion.segments.index(name) for name in ("pelvis", "thorax"))
    s = reference.segments.index("pelvis")
    inside = reference.rotation[s].T @ (centre - reference.origin[s])
    x, y, z = inside
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn = motion.rotation[:, pelvis]
    slope = np.concatenate([-turn @ cross, np.broadcast_to(np.eye(3), turn.shape)], -1)
    origin, covariance = motion.origin.copy(), motion.covariance.copy()
    origin[:, thorax] = motion.origin[:, pelvis] + turn @ inside
    covariance[:, thorax, :3, 3:] = covariance[:, thorax, 3:, :3] = 0.0
    covariance[:, thorax, 3:, 3:] = slope @ motion.covariance[:, pelvis] @ np.swapaxes(slope, 1, 2)
    return replace(motion, origin=origin, covariance=covariance)


def segment_point_paths(points: Sequence[SegmentPoint], motion: BoneMotion) -> tuple[Floats, Floats]:
    """Compute the paths of points of segments, and their standard deviations.

    Args:
        points: P points.
        motion: The segments of the person over F frames.

    Returns:
        Positions (F, P, 3) [m], NaN where a segment has no pose, and standard deviations of a coordinate (F, P) [m]:
        the root of the mean of the variances along the three axes; NaN where unknown.
    """
    paths, spreads = [], []
    for point in points:
        s = motion.segments.index(point.segment)
        rotation, covariance = motion.rotation[:, s], motion.covariance[:, s]
        x, y, z = point.offset
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        slope = np.concatenate([-rotation @ cross, np.broadcast_to(np.eye(3), rotation.shape)], -1)
        variance = np.einsum("fia,fab,fib->f", slope, covariance, slope) / 3
        paths.append(motion.origin[:, s] + rotation @ point.offset)
        spreads.append(np.sqrt(variance))
    return np.stack(paths, 1), np.stack(spreads, 1)


def relative_weights(sd: Floats) -> Floats:
    """Return the weights (P,) of points, of which the largest is 1: the mean of 1 / variance over the frames.

    Args:
        sd: (F, P) standard deviations [m]. A point whose deviation is never known gets the median of the others.
    """
    known = np.isfinite(sd) & (sd > 0)
    inverse = np.where(known, 1 / np.where(known, sd, 1.0) ** 2, 0.0).sum(0) / np.maximum(known.sum(0), 1)
    inverse = np.where(known.any(0), inverse, np.median(inverse[known.any(0)]) if known.any() else 1.0)
    return np.asarray(inverse / inverse.max())

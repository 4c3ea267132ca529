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
_SHARED_AXES = {"pelvis": (0, 1, 2), "thorax": (0, 1, 2), "thigh": (0, 1, 2), "upperarm": (0, 1, 2), "forearm": (1,)}
"""Axes that a person and a model share in the reference posture, by the segment without its side: not those across a
shank, which differ by the torsion of the tibia, or across a forearm, which differ by its pronation."""
_POINT_WEIGHT, _COORDINATE_WEIGHT = 1.0, 1e-6
"""Weights in the reference posture: of a point [relative], and of a coordinate against its neutral value [m2 per rad2].
Chosen by hand: a coordinate that is off by 0.1 rad costs as much as points that are off by 0.1 mm."""
_CARRIERS = {
    "thorax": "pelvis", "left_upperarm": "thorax", "right_upperarm": "thorax", "left_forearm": "left_upperarm",
    "right_forearm": "right_upperarm",
}  # fmt: skip
"""Which segment carries the joint of which other one, carriers first."""
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
    carried: Mapping[str, tuple[str, Floats]]
    """For segments without a place of their own, in an order in which each comes after its carrier: the segment that
    carries it, and where its origin is from the origin of that one, along its anatomical axes (3,) [m]."""


def place_segment_points(model: JointedBody, joints: Mapping[str, str], reference: StandingPosture) -> PlacedSegments:
    """Find where points of a person's segments are on the bodies of a model.

    The model takes the reference posture: by inverse kinematics its joint centres meet those of the person, and pelvis,
    thorax, thighs, upper arms and measured feet take their rotations. Then four points of each segment, its joint
    centre and one along each axis, are fixed to the bodies where they are in this posture; so constant differences
    between the axes of person and model, as by the torsion of a tibia, have no effect on the motion. The thorax is
    upright in the reference posture.

    Models have one joint for the lumbar spine and none for the clavicles. So a thorax and the arms on it have no places
    of their own, which would pull at the pelvis: their points are about their joints in the model.

    Args:
        model: The model, scaled to the person.
        joints: Maps a joint centre to the body that rotates about it.
        reference: The person, standing about straight.

    Returns:
        The points of all segments that the model has.
    """
    known = segments_on_model(model, joints, reference.segments)
    by_name = {one.segment: one for one in known}
    carried = {
        name: carrier for name, carrier in _CARRIERS.items()
        if {name, carrier, "pelvis", "thorax"} <= set(by_name)
    }  # fmt: skip
    origins = {
        name: reference.origin[reference.segments.index(name)] for name in by_name if name not in carried
    }  # fmt: skip
    posed = _posed(model, joints, by_name, reference, origins)
    for name in carried:
        k = model.body_names.index(by_name[name].body)
        origins[name] = posed.origin[k] + posed.rotation[k] @ by_name[name].centre
        posed = _posed(model, joints, by_name, reference, origins)
    points = []
    for one in known:
        rotation, origin = reference.rotation[reference.segments.index(one.segment)], origins[one.segment]
        k = model.body_names.index(one.body)
        for ending, offset in zip(("o", *_AXES), np.vstack([np.zeros(3), POINT_DISTANCE_M * np.eye(3)]), strict=True):
            at = origin + rotation @ offset
            points.append(
                SegmentPoint(
                    label=f"{one.segment}_{ending}", segment=one.segment, offset=offset, body=one.body,
                    place=posed.rotation[k].T @ (at - posed.origin[k]),
                )
            )  # fmt: skip
    places = {
        name: (carrier, reference.rotation[reference.segments.index(carrier)].T @ (origins[name] - origins[carrier]))
        for name, carrier in carried.items()
    }  # fmt: skip
    return PlacedSegments(points=tuple(points), carried=places)


def _posed(
    model: JointedBody, joints: Mapping[str, str], known: Mapping[str, SegmentOnModel], reference: StandingPosture,
    origins: Mapping[str, Floats],
) -> PlacedBodies:  # fmt: skip
    """Return the model in the reference posture, by the segments whose origins (3,) are known [m]."""
    targets = [
        *_joint_targets(model, joints, known, reference, origins),
        *(target for name in origins for target in _axis_targets(known[name], reference, origins[name])),
    ]
    markers, places = [marker for marker, _ in targets], [at for _, at in targets]
    base = {m.coordinate for body in model.bodies if body.parent is None for m in body.motions}
    tasks = TaskSet(
        markers=tuple(MarkerTask(label=marker.label, weight=_POINT_WEIGHT) for marker in markers),
        coordinates=tuple(
            CoordinateTask(coordinate=c.name, weight=_COORDINATE_WEIGHT, value=0.0)
            for c, free in zip(model.coordinates, model.free, strict=True)
            if free and c.rotational and c.name not in base
        ),
    )  # fmt: skip
    marked = replace(model, markers=tuple(markers))
    seen = trajectories([marker.label for marker in markers], np.array(places)[None], 1.0)
    found = inverse_kinematics(marked, tasks, seen)
    values = np.where(np.isfinite(found.coordinates[0]), found.coordinates[0], neutral_posture(model))
    return place(model, model.coupled(values))


def _joint_targets(
    model: JointedBody, joints: Mapping[str, str], known: Mapping[str, SegmentOnModel], reference: StandingPosture,
    origins: Mapping[str, Floats],
) -> list[tuple[ModelMarker, Floats]]:  # fmt: skip
    """Return the joint centres on the model and where they should be; those of carried arms are left out."""
    neutral = place(model, neutral_posture(model))
    arms = {f"{side}_{joint}" for side in ("left", "right") for joint in ("shoulder", "elbow", "wrist")}
    skipped = arms if {"thorax", "pelvis"} <= set(known) else set()
    targets = []
    for name, body in joints.items():
        if name in reference.joints.names and name not in skipped:
            k = model.body_names.index(body)
            centre = neutral.rotation[k].T @ (centre_in_ground(model, neutral, body) - neutral.origin[k])
            marker = ModelMarker(label=name, body=body, place=centre)
            targets.append((marker, reference.joints.places[reference.joints.names.index(name)]))
    return targets


def _axis_targets(one: SegmentOnModel, reference: StandingPosture, origin: Floats) -> list[tuple[ModelMarker, Floats]]:
    """Return points on both sides of a segment's origin along the axes that person and model share."""
    kind = one.segment.rpartition("_")[2]
    rotation = reference.rotation[reference.segments.index(one.segment)]
    if kind == "thorax" and "pelvis" in reference.segments:
        rotation = _upright(reference.rotation[reference.segments.index("pelvis")][:, 2] * (1 - _UP))
    shared = (0, 1, 2) if kind == "foot" and reference.own_feet else _SHARED_AXES.get(kind, ())
    targets = []
    for a in shared:
        for step in (POINT_DISTANCE_M, -POINT_DISTANCE_M):
            label, at = f"{one.segment}{_AXES[a]}{step:+g}", one.centre + step * one.axes[:, a]
            targets.append((ModelMarker(label=label, body=one.body, place=at), origin + step * rotation[:, a]))
    return targets


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


def with_carried_segments(motion: BoneMotion, carried: Mapping[str, tuple[str, Floats]]) -> BoneMotion:
    """Let segments carry the origins of others, as the bodies of a model carry its joints.

    Args:
        motion: The segments of the person, in the ground of the model.
        carried: Which segment carries which, and where, as in `PlacedSegments`; segments without a motion are skipped.

    Returns:
        The motion with the origins on their carriers, each with the covariance of its carrier there.
    """
    origin, covariance = motion.origin.copy(), motion.covariance.copy()
    for name, (carrier, (x, y, z)) in carried.items():
        if not {name, carrier} <= set(motion.segments):
            continue
        own, on = motion.segments.index(name), motion.segments.index(carrier)
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        turn = motion.rotation[:, on]
        slope = np.concatenate([-turn @ cross, np.broadcast_to(np.eye(3), turn.shape)], -1)
        origin[:, own] = origin[:, on] + turn @ [x, y, z]
        covariance[:, own, :3, 3:] = covariance[:, own, 3:, :3] = 0.0
        covariance[:, own, 3:, 3:] = slope @ covariance[:, on] @ np.swapaxes(slope, 1, 2)
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

"""Poses, and the body in a pose: positions with their derivatives by every parameter."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from marey.arrays import Floats, Integers, freeze_fields
from marey.body.articulation import kinematics
from marey.body.articulation.skeleton import PackedSkeleton
from marey.body.articulation.surface import Body
from marey.geometry import rotations

PARTS = 6
"""Largest number of segments that carry a surface point: three corners of a face, whose segments overlap."""


@dataclass(frozen=True, eq=False)
class Pose:
    """Position and orientation of the pelvis, and the joint angles."""

    translation: Floats
    """(3,) the pelvis' centre in the world [m]."""
    rotation: Floats
    """(3, 3) world from pelvis."""
    angles: Floats
    """(D - 6,) of the joint coordinates [rad]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "translation", "rotation", "angles")

    def step(self, change: Floats) -> "Pose":
        """Apply a change (D,): translation [m], rotation about the world's axes [rad], joint angles [rad]."""
        turned = kinematics.turned(self.rotation, np.ascontiguousarray(change[3:6], float))
        return Pose(self.translation + change[:3], turned, self.angles + change[6:])

    def change_to(self, other: "Pose") -> Floats:
        """Return the change (D,) with self.step(change) = other."""
        turn = rotations.turn_between(self.rotation, other.rotation)
        return np.concatenate([other.translation - self.translation, turn, other.angles - self.angles])

    def between(self, other: "Pose", share: float) -> "Pose":
        """Interpolate to another pose; a share above 1 extrapolates."""
        return self.step(share * self.change_to(other))


def packed_poses(poses: Iterable[Pose]) -> dict[str, Floats]:
    """Stack poses of the same skeleton into arrays, for example for a file.

    Args:
        poses: N poses.

    Returns:
        `translation` (N, 3) [m], `rotation` (N, 3, 3), and `angles` (N, D - 6) [rad], for `unpacked_poses`.
    """
    stacked = tuple(poses)
    return {
        "translation": np.array([pose.translation for pose in stacked]),
        "rotation": np.array([pose.rotation for pose in stacked]),
        "angles": np.array([pose.angles for pose in stacked]),
    }


def unpacked_poses(arrays: Mapping[str, Floats]) -> list[Pose]:
    """Return the poses that `packed_poses` has stacked; other arrays in the mapping are ignored."""
    parts = zip(arrays["translation"], arrays["rotation"], arrays["angles"], strict=True)
    return [Pose(*part) for part in parts]


@dataclass(frozen=True, eq=False, kw_only=True)
class SkinPoints:
    """Points attached to the body's surface."""

    face: Integers
    """(n,) index of the face."""
    barycentric: Floats
    """(n, 3) weights of the face's corners."""

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.face)


class Jointed(Protocol):
    """Anything with segments that rotate on each other: a body, or metaballs."""

    @property
    def packed(self) -> PackedSkeleton:
        """The skeleton as arrays."""

    @property
    def joint_centres(self) -> Floats:
        """(S, 3) at rest [m]."""


class PosedSegments(ABC):
    """Segments in a pose."""

    pose: Pose
    """The pose."""

    @property
    @abstractmethod
    def carrier(self) -> Jointed:
        """The body or metaballs whose segments are posed."""

    @cached_property
    def _segments(self) -> tuple[Floats, Floats, Floats]:
        packed, pose = self.carrier.packed, self.pose
        posed: tuple[Floats, Floats, Floats] = kinematics.pose_segments(
            packed.parents, packed.coordinate_segment, packed.axes, self.carrier.joint_centres,
            pose.rotation, pose.translation, pose.angles,
        )  # fmt: skip
        return posed

    @property
    def segment_rotation(self) -> Floats:
        """(S, 3, 3) world from segment; the identity at rest."""
        return self._segments[0]

    @property
    def segment_origin(self) -> Floats:
        """(S, 3) joint centre about which each segment rotates [m, world]."""
        return self._segments[1]

    @property
    def world_axes(self) -> Floats:
        """(D - 6, 3) axes of the joint coordinates in the world."""
        return self._segments[2]


@dataclass(frozen=True, eq=False)
class PosedBody(PosedSegments):
    """A body in a pose: segments, skin, and their derivatives by pose and shape."""

    body: Body
    pose: Pose

    @property
    def carrier(self) -> Body:
        """The body, whose segments are posed."""
        return self.body

    @cached_property
    def vertices(self) -> Floats:
        """(V, 3) the skin [m, world]."""
        body = self.body
        return np.asarray(kinematics.blend_skin(
            body.vertices, body.vertex_segments, body.vertex_weights, body.joint_centres,
            self.segment_rotation, self.segment_origin,
        ))  # fmt: skip

    def points(self, where: SkinPoints) -> Floats:
        """Return the positions (n, 3) of surface points in the world."""
        return np.asarray(kinematics.points_on_faces(self.vertices, self.body.faces, where.face, where.barycentric))

    def parts(self, where: SkinPoints) -> tuple[Integers, Floats]:
        """Decompose surface points into the parts carried by their segments, see `kinematics.gather_parts`."""
        body = self.body
        segment = np.empty((len(where), PARTS), np.int64)
        part = np.empty((len(where), PARTS, 4))
        kinematics.gather_parts(
            body.faces, PARTS, body.vertices, body.vertex_segments, body.vertex_weights, body.joint_centres,
            where.face, where.barycentric, segment, part,
        )  # fmt: skip
        return segment, part

    def joint_parts(self, segments: Integers) -> tuple[Integers, Floats]:
        """Return the joint centres of segments in the form of `parts`."""
        segment = np.full((len(segments), 1), -1, np.int64)
        segment[:, 0] = segments
        part = np.zeros((len(segments), 1, 4))
        part[:, 0, 3] = 1.0
        return segment, part

    def constraint_jacobian(self, where: SkinPoints, rows: Floats, *, shape: bool = False) -> Floats:
        """Return the derivatives of rows p, for surface points p, by the pose and the shape.

        Args:
            where: n points.
            rows: (n, r, 3).
            shape: Whether the columns of the shape parameters are appended.

        Returns:
            (n, r, D) or (n, r, D + M).
        """
        body, packed = self.body, self.body.packed
        degrees = 6 + len(packed.axes)
        numbers = len(body.space) if shape else 0
        jacobian = np.zeros((*rows.shape[:2], degrees + numbers))
        segment, part = self.parts(where)
        rows = np.ascontiguousarray(rows)
        kinematics.pose_rows(
            packed.parents, packed.coordinate_segment, self.segment_rotation, self.segment_origin, self.world_axes,
            segment, part, rows, jacobian,
        )  # fmt: skip
        if numbers:
            kinematics.shape_rows(
                body.faces, body.vertex_segments, body.vertex_weights, body.space.modes_by_number_last,
                self.segment_rotation, self._anchored_by_number_last, where.face, where.barycentric, segment, part,
                rows, degrees, jacobian,
            )  # fmt: skip
        return jacobian

    def pose_jacobian(self, segment: Integers, part: Floats) -> Floats:
        """Return the derivatives of points by the pose.

        Args:
            segment: (n, parts) from `parts` or `joint_parts`.
            part: (n, parts, 4).

        Returns:
            (n, 3, D) [m by m or rad], for the changes that `Pose.step` takes.
        """
        packed = self.body.packed
        jacobian = np.empty((len(segment), 3, 6 + len(packed.axes)))
        kinematics.point_jacobian(
            packed.parents, packed.coordinate_segment, self.segment_rotation, self.segment_origin, self.world_axes,
            segment, part, jacobian,
        )  # fmt: skip
        return jacobian

    @cached_property
    def _origin_modes(self) -> tuple[Floats, Floats]:
        modes = self.body.space.joint_modes
        found: tuple[Floats, Floats] = kinematics.origin_modes(self.body.packed.parents, self.segment_rotation, modes)
        return found

    @cached_property
    def _anchored_by_number_last(self) -> Floats:
        """(S, 3, M)."""
        return np.ascontiguousarray(np.swapaxes(self._origin_modes[1], 1, 2))

    def shape_jacobian(self, where: SkinPoints) -> Floats:
        """Return the derivatives of surface points by the shape parameters: (n, 3, M) [m by unit of the number]."""
        body = self.body
        jacobian = np.empty((len(where), 3, len(body.space)))
        kinematics.shape_jacobian(
            body.faces, body.vertex_segments, body.vertex_weights, body.space.modes_by_vertex,
            self.segment_rotation, self._origin_modes[1], where.face, where.barycentric, jacobian,
        )  # fmt: skip
        return jacobian

    def origin_shape_jacobian(self) -> Floats:
        """Return the derivatives of the segments' origins by the shape parameters: (S, 3, M)."""
        return np.swapaxes(self._origin_modes[0], 1, 2)

    def moved(self, change: Floats) -> "PosedBody":
        """Apply a change (D,) of the pose or (D + M,) of pose and shape."""
        degrees = 6 + len(self.pose.angles)
        body = self.body
        if len(change) > degrees:
            body = body.with_numbers(body.numbers + change[degrees:])
        return replace(self, body=body, pose=self.pose.step(change[:degrees]))

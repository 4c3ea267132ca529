"""A person's body: a skinned surface on a skeleton, and the space of its shapes."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Protocol, Self

import numpy as np

from marey.arrays import Floats, Integers, Mask, freeze_fields, frozen
from marey.body.articulation.kinematics import share_faces
from marey.body.articulation.skeleton import JOINT_OF_SEGMENT, PackedSkeleton, Skeleton


class SkinModel(Protocol):
    """Interface of a model whose surface is a body's skin.

    `marey.body.metaballs` provides the only implementation. Use `metaballs_of` there to reach it.
    """

    @property
    def names(self) -> tuple[str, ...]:
        """(N,) meaning of each shape parameter."""

    def __len__(self) -> int:
        """Number of shape parameters."""

    def with_skeleton(self, skeleton: Skeleton) -> Self:
        """Return the same model on a skeleton with other coordinates."""


class FaceShares(NamedTuple):
    """The segments that carry each face, for the kernels."""

    number: Integers
    """(T,) number of segments."""
    segment: Integers
    """(T, N) in ascending order."""
    weight: Floats
    """(T, N, 3) for the three corners."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ShapeSpace:
    """Space of a body's shapes: vertices and joint centres are linear in a few shape parameters.

    vertices = mean + sum over i of number_i mode_i, and the joint centres with the same numbers.
    """

    names: tuple[str, ...]
    """(M,) meaning of each number."""
    vertex_mean: Floats
    """(V, 3) [m]."""
    vertex_modes: Floats
    """(M, V, 3) [m by unit of the number]."""
    joint_mean: Floats
    """(S, 3) [m]."""
    joint_modes: Floats
    """(M, S, 3) [m by unit of the number]."""
    prior_mean: Floats
    """(M,) mean of the numbers for an unknown person."""
    prior_covariance: Floats
    """(M, M) covariance of the numbers for an unknown person."""
    ranked: bool = True
    """Whether the first numbers explain most of the variation, so that a rough fit may omit the others."""

    def __post_init__(self) -> None:
        freeze_fields(
            self, "vertex_mean", "vertex_modes", "joint_mean", "joint_modes", "prior_mean", "prior_covariance"
        )

    def __len__(self) -> int:
        """Return the number of shape parameters."""
        return len(self.names)

    @cached_property
    def modes_by_vertex(self) -> Floats:
        """(V, M, 3) the vertices' modes, for kernels that iterate over vertices."""
        return frozen(np.swapaxes(self.vertex_modes, 0, 1))

    @cached_property
    def modes_by_number_last(self) -> Floats:
        """(V, 3, M) the vertices' modes, for kernels that sum over many numbers at once."""
        return frozen(np.moveaxis(self.vertex_modes, 0, 2))

    @cached_property
    def leading(self) -> Floats:
        """(M, M) directions of the numbers, one per row, of which the first ones explain most of the variation.

        If the numbers are ranked, these are the numbers themselves; else independent directions of unit variance,
        ordered by the variation of the skin under the prior.
        """
        if self.ranked:
            return frozen(np.eye(len(self)))
        root = np.linalg.cholesky(self.prior_covariance)
        skin = self.vertex_modes.reshape(len(self), -1)
        _, turn = np.linalg.eigh(root.T @ (skin @ skin.T) @ root)
        return frozen((root @ turn[:, ::-1]).T)

    @cached_property
    def by_rank(self) -> "ShapeSpace":
        """The same shapes as functions of steps along the `leading` directions: numbers (M,) = leading.T @ steps."""
        if self.ranked:
            return self
        steps = np.linalg.inv(self.leading.T)
        covariance = steps @ self.prior_covariance @ steps.T
        return ShapeSpace(
            names=tuple(f"direction_{i + 1}" for i in range(len(self))),
            vertex_mean=self.vertex_mean, vertex_modes=np.tensordot(self.leading, self.vertex_modes, 1),
            joint_mean=self.joint_mean, joint_modes=np.tensordot(self.leading, self.joint_modes, 1),
            prior_mean=steps @ self.prior_mean, prior_covariance=0.5 * (covariance + covariance.T),
        )  # fmt: skip

    def first(self, numbers: int) -> "ShapeSpace":
        """Keep only the first numbers."""
        return self.keep(range(numbers))

    def keep(self, which: "range | list[int] | Integers") -> "ShapeSpace":
        """Keep only some of the numbers; the others are fixed at the prior's mean."""
        index = np.asarray(which, dtype=np.int64)
        rest = np.setdiff1d(np.arange(len(self)), index)
        return ShapeSpace(
            names=tuple(self.names[i] for i in index),
            vertex_mean=self.vertex_mean + np.tensordot(self.prior_mean[rest], self.vertex_modes[rest], 1),
            vertex_modes=self.vertex_modes[index],
            joint_mean=self.joint_mean + np.tensordot(self.prior_mean[rest], self.joint_modes[rest], 1),
            joint_modes=self.joint_modes[index],
            prior_mean=self.prior_mean[index],
            prior_covariance=self.prior_covariance[np.ix_(index, index)],
            ranked=self.ranked,
        )

    def vertices(self, numbers: Floats) -> Floats:
        """Return the vertices (V, 3) at rest for shape parameters (M,) [m]."""
        return self.vertex_mean + np.tensordot(numbers, self.vertex_modes, 1)

    def joints(self, numbers: Floats) -> Floats:
        """Return the joint centres (S, 3) at rest for shape parameters (M,) [m]."""
        return self.joint_mean + np.tensordot(numbers, self.joint_modes, 1)


@dataclass(frozen=True, eq=False, kw_only=True)
class Body:
    """One person's body at rest: skeleton, skin, and its shape parameters."""

    skeleton: Skeleton
    """The skeleton."""
    space: ShapeSpace
    """The shapes this body may take; a scan has a space without numbers."""
    numbers: Floats
    """(M,) this person's shape parameters."""
    faces: Integers
    """(T, 3) corners counter-clockwise as seen from outside."""
    vertex_segments: Integers
    """(V, 4) segments that carry each vertex."""
    vertex_weights: Floats
    """(V, 4) their weights, of sum one; zero where fewer carry it."""
    outlined: Mask | None = None
    """(T,) faces whose outline is used; all if None. A preset leaves out the segments that it does not follow."""
    followed: Mask | None = None
    """(S,) segments whose motion is measured; all if None. A preset leaves out the segments that it does not follow."""
    joint_sd: Floats | None = None
    """(S,) standard deviation, per axis, of a joint centre from where skin and numbers place it, independent between
    postures [m]; None if unknown."""
    joint_offset_sd: Floats | None = None
    """(S,) standard deviation, per axis, of its constant offset from there in all postures [m]; None if unknown."""
    numbers_covariance: Floats | None = None
    """(M, M) covariance of the numbers, once they have been estimated."""
    metaballs: SkinModel | None = None
    """Metaballs of the same numbers whose surface is the skin; None if the skin is a mesh of its own."""

    def __post_init__(self) -> None:
        freeze_fields(self, "numbers", "vertex_weights")
        freeze_fields(self, "faces", "vertex_segments", dtype=np.int64)

    @property
    def packed(self) -> PackedSkeleton:
        """The skeleton as plain arrays."""
        return self.skeleton.packed

    @cached_property
    def vertices(self) -> Floats:
        """(V, 3) skin at rest [m]."""
        return frozen(self.space.vertices(self.numbers))

    @cached_property
    def joint_centres(self) -> Floats:
        """(S, 3) centre about which each segment rotates on its parent, at rest [m]."""
        return frozen(self.space.joints(self.numbers))

    @cached_property
    def face_segment(self) -> Integers:
        """(T,) segment that carries most of each face."""
        votes = np.zeros((len(self.faces), len(self.skeleton.segment_names)))
        for corner in range(3):
            v = self.faces[:, corner]
            for n in range(self.vertex_segments.shape[1]):
                np.add.at(votes, (np.arange(len(v)), self.vertex_segments[v, n]), self.vertex_weights[v, n])
        return frozen(np.argmax(votes, 1), np.int64)

    @cached_property
    def followed_joints(self) -> Mask:
        """(J,) named joints that are measured: those of segments whose parent is followed."""
        on = np.maximum(self.skeleton.parents, 0)[self.joint_segments]
        return frozen(np.ones(len(on)) if self.followed is None else self.followed[on], np.bool_)

    @cached_property
    def face_limb(self) -> Integers:
        """(T,) limb to which each face belongs, see `Skeleton.segment_limb`."""
        return frozen(self.skeleton.segment_limb[self.face_segment], np.int64)

    @cached_property
    def face_colour_part(self) -> Integers:
        """(T,) part to whose colours each face belongs, see `Skeleton.segment_colour_part`."""
        return frozen(self.skeleton.segment_colour_part[self.face_segment], np.int64)

    @cached_property
    def outline_counts(self) -> Mask:
        """(T,) whether the outline of each face is used."""
        return frozen(np.ones(len(self.faces)) if self.outlined is None else self.outlined, np.bool_)

    @cached_property
    def face_shares(self) -> FaceShares:
        """The segments that carry each face."""
        return FaceShares(*share_faces(self.faces, self.vertex_segments, self.vertex_weights))

    @cached_property
    def segment_pairs(self) -> tuple[Integers, Integers]:
        """(P, 2) pairs of segments k <= l that share a face, and (S, S) their numbers, -1 for all other pairs."""
        count, shares = len(self.skeleton.segment_names), self.face_shares
        numbers = np.full((count, count), -1)
        for number, carriers in zip(shares.number, shares.segment, strict=True):
            own = carriers[:number]
            numbers[np.ix_(own, own)] = 0
        pairs = np.argwhere(np.triu(numbers + 1) > 0)
        numbers[:] = -1
        numbers[pairs[:, 0], pairs[:, 1]] = np.arange(len(pairs))
        return frozen(pairs, np.int64), frozen(numbers, np.int64)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joint centres that results report."""
        return tuple(JOINT_OF_SEGMENT[s] for s in self.skeleton.segment_names if s in JOINT_OF_SEGMENT)

    @property
    def joint_segments(self) -> Integers:
        """(J,) segment whose centre each reported joint is."""
        return np.array([k for k, s in enumerate(self.skeleton.segment_names) if s in JOINT_OF_SEGMENT])

    def with_numbers(self, numbers: Floats) -> "Body":
        """Return the body with other shape parameters."""
        return self._share_topology(replace(self, numbers=numbers))

    def within(self, space: ShapeSpace, numbers: Floats) -> "Body":
        """Return the same surface in another space of shapes, without metaballs, with its shape parameters."""
        # Found once for all such bodies, the segments and limbs of the faces are shared with them.
        _ = self.face_limb
        return self._share_topology(replace(self, space=space, numbers=numbers, metaballs=None))

    def _share_topology(self, other: "Body") -> "Body":
        """Return another body of the same faces with those known properties that depend on the topology alone."""
        for name in ("face_segment", "face_limb", "face_colour_part", "outline_counts", "face_shares", "segment_pairs"):
            if name in self.__dict__:
                other.__dict__[name] = self.__dict__[name]
        return other

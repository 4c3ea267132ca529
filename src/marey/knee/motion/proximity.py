"""Proximity of the cartilages of two bones over an activity: distances, areas and centres, with uncertainty."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, Mask, frozen
from marey.errors import MareyError
from marey.geometry import rotations
from marey.knee.motion.joint_surface import COMPARTMENTS, JointSurface, StructureVertices

LIMIT_MM = 5.0
"""Default distance [mm] up to which surfaces count as near; chosen by hand."""
NEAR_MM = 3.0
"""Distance [mm] below which surfaces count as close; chosen by hand."""
Step = Callable[[], None]


@dataclass(frozen=True, eq=False, kw_only=True)
class RelativePoses:
    """Poses of one bone in another's frame over F frames, as p_base = R p_moving + t; NaN where unknown."""

    rotation: Floats
    """(F, 3, 3)."""
    translation_mm: Floats
    """(F, 3)."""
    covariance: Floats | None = None
    """(F, 6, 6) of the rotation error exp(turn) to the right of the rotation [rad] and of the translation [mm]."""

    @property
    def known(self) -> Mask:
        """(F,) frames with a pose."""
        return np.asarray(np.isfinite(self.rotation).all((1, 2)) & np.isfinite(self.translation_mm).all(1))


@dataclass(frozen=True, eq=False, kw_only=True)
class Proximity:
    """Proximity of two articular surfaces over F frames, in C compartments of the base's surface."""

    name: str
    """Such as `tibiofemoral`."""
    base: StructureVertices
    """The vertices in whose frame the centres of proximity are."""
    moving: StructureVertices
    """The vertices of the other surface."""
    limit_mm: float
    compartments: tuple[str, ...]
    """Names of the C compartments; only `all` where the knee's side is not known."""
    base_distance_mm: Floats
    """(F, V) distance of each vertex of the base from the other surface, negative where they overlap; NaN where there
    is no pose, or where the vertex lies beside and below the other's rim."""
    moving_distance_mm: Floats
    """(F, W) the same for the vertices of the moving surface."""
    gap_mm: Floats
    """(F, C) the least distance."""
    gap_sd_mm: Floats
    """(F, C) its standard deviation, from the bones' poses only, to first order; NaN where these have no covariance."""
    overlap_mm2: Floats
    """(F, C) area of the base that overlaps."""
    close_mm2: Floats
    """(F, C) area of the base nearer than `NEAR_MM`."""
    near_mm2: Floats
    """(F, C) area of the base nearer than the limit."""
    centre_mm: Floats
    """(F, C, 3) centre of proximity on the base, in its frame; NaN where nothing is near."""
    centre_sd_mm: Floats
    """(F, C, 3)."""
    moving_centre_mm: Floats
    """(F, C, 3) centre of proximity on the moving surface, in its own frame."""
    moving_centre_sd_mm: Floats
    """(F, C, 3)."""

    def __post_init__(self) -> None:
        for name in vars(self):
            if name.endswith(("_mm", "_mm2")) and name != "limit_mm":
                # Maps are large; single precision is sufficient: at 1 m its resolution is 0.1 micrometres.
                kind = np.float32 if name.endswith("_distance_mm") else np.float64
                object.__setattr__(self, name, frozen(getattr(self, name), kind))

    def __len__(self) -> int:
        return len(self.gap_mm)

    @property
    def unsure(self) -> Mask:
        """(F, C) where the gap, or the overlap, is smaller than its standard deviation."""
        with np.errstate(invalid="ignore"):
            return np.asarray(np.abs(self.gap_mm) < self.gap_sd_mm)


def proximity(
    name: str, base: JointSurface, moving: JointSurface, poses: RelativePoses, *, limit_mm: float = LIMIT_MM,
    step: Step = lambda: None,
) -> Proximity:  # fmt: skip
    """Measure the proximity of two articular surfaces in each frame.

    The distance of a vertex is that to the nearest point of the other surface, negative below it. The centre of
    proximity is the mean of a surface's vertices, weighted by their areas and by the difference of the limit and their
    distances, then projected to the surface. Unlike the inverse of the distance, these weights are defined where the
    surfaces overlap, and continuous as a vertex comes within the limit.

    Standard deviations propagate the poses' covariance to first order: moving one bone by d changes a vertex' distance
    by the component of d along the direction in which that distance is measured.

    Args:
        name: Name of the joint.
        base: Bone in whose frame the poses are given.
        moving: The other one.
        poses: F of them.
        limit_mm: Distance up to which surfaces count as near.
        step: Called after each frame.

    Raises:
        MareyError: The limit is not above zero.
    """
    if not limit_mm > 0:
        raise MareyError(f"The limit of proximity must be above zero, not {limit_mm:g} mm.")
    sided = base.lateral is not None
    frames = _Frames(base, moving, limit_mm, COMPARTMENTS if sided else ("all",), len(poses.rotation))
    for frame, known in enumerate(poses.known):
        if known:
            frames.fill(frame, poses)
        step()
    return frames.finished(name)


class _Frames:
    """Measurements, accumulated frame by frame."""

    def __init__(
        self, base: JointSurface, moving: JointSurface, limit_mm: float, compartments: tuple[str, ...], frames: int
    ):
        self._base, self._moving, self._limit, self._names = base, moving, limit_mm, compartments
        count = len(compartments)
        self._maps = [np.full((frames, len(s.surface.vertices_mm)), np.nan, np.float32) for s in (base, moving)]
        self._gap, self._gap_sd = np.full((2, frames, count), np.nan)
        self._areas = np.full((3, frames, count), np.nan)
        self._centres, self._centres_sd = np.full((2, 2, frames, count, 3), np.nan)
        self._guess: list[Integers | None] = [None, None]

    def fill(self, frame: int, poses: RelativePoses) -> None:
        """Measure a frame that has a pose."""
        turn, shift = poses.rotation[frame], poses.translation_mm[frame]
        covariance = np.full((6, 6), np.nan) if poses.covariance is None else poses.covariance[frame]
        base, moving = self._base.surface.vertices_mm, self._moving.surface.vertices_mm
        onto_moving = self._moving.heights((base - shift) @ turn, self._guess[0])
        onto_base = self._base.heights(moving @ turn.T + shift, self._guess[1])
        self._guess = [onto_moving.triangle, onto_base.triangle]
        self._maps[0][frame], self._maps[1][frame] = onto_moving.distance_mm, onto_base.distance_mm

        def of_base(chosen: Integers) -> Floats:
            # The nearest point moves and the vertex does not, so its distance decreases as that point comes nearer.
            return -_by_pose(onto_moving.upward[chosen] @ turn.T, onto_moving.places_mm[chosen], turn)

        def of_moving(chosen: Integers) -> Floats:
            return _by_pose(onto_base.upward[chosen], moving[chosen], turn)

        lateral = self._base.lateral
        below = None if lateral is None else self._base.of_lateral(onto_base.triangle)
        for c, name in enumerate(self._names):
            here = _within(name, lateral, len(base))
            self._measure(frame, c, here, onto_moving.distance_mm, of_base, covariance)
            self._centre(0, frame, c, here, onto_moving.distance_mm, of_base, covariance)
            there = _within(name, below, len(moving))
            self._centre(1, frame, c, there, onto_base.distance_mm, of_moving, covariance)

    def _measure(
        self, frame: int, c: int, here: Integers, distance: Floats, by_pose: "_ByPose", covariance: Floats
    ) -> None:
        """Record the gap and the areas of one compartment of the base."""
        known = here[np.isfinite(distance[here])]
        if not len(known):
            return
        nearest = known[[np.argmin(distance[known])]]
        self._gap[frame, c] = distance[nearest[0]]
        wrt = by_pose(nearest)[0]
        self._gap_sd[frame, c] = np.sqrt(wrt @ covariance @ wrt)
        for row, most in zip(self._areas, (0.0, NEAR_MM, self._limit), strict=True):
            row[frame, c] = self._base.surface.vertex_areas_mm2[known[distance[known] < most]].sum()

    def _centre(
        self, which: int, frame: int, c: int, here: Integers, distance: Floats, by_pose: "_ByPose", covariance: Floats
    ) -> None:  # fmt: skip
        """Record a centre of proximity and its standard deviation."""
        near = here[distance[here] < self._limit]
        if not len(near):
            return
        side = (self._base, self._moving)[which]
        places, area = side.surface.vertices_mm[near], side.surface.vertex_areas_mm2[near]
        weight = area * (self._limit - distance[near])
        centre = weight @ places / weight.sum()
        # d centre = sum (place - centre) d weight / sum weight, and a weight decreases by its area with the distance.
        jacobian = -(places - centre).T @ (area[:, None] * by_pose(near)) / weight.sum()
        self._centres[which, frame, c] = centre
        self._centres_sd[which, frame, c] = np.sqrt(np.diag(jacobian @ covariance @ jacobian.T))

    def finished(self, name: str) -> Proximity:
        """Return all measurements, with the centres on their surfaces."""
        return Proximity(
            name=name, base=self._base, moving=self._moving, limit_mm=self._limit, compartments=self._names,
            base_distance_mm=self._maps[0], moving_distance_mm=self._maps[1], gap_mm=self._gap,
            gap_sd_mm=self._gap_sd, overlap_mm2=self._areas[0], close_mm2=self._areas[1], near_mm2=self._areas[2],
            centre_mm=self._base.onto(self._centres[0]), centre_sd_mm=self._centres_sd[0],
            moving_centre_mm=self._moving.onto(self._centres[1]), moving_centre_sd_mm=self._centres_sd[1],
        )  # fmt: skip


_ByPose = Callable[[Integers], Floats]
"""Maps vertices (n,) to the derivatives (n, 6) of their distances with respect to the pose."""


def _within(compartment: str, lateral: Mask | None, count: int) -> Integers:
    """Return the indices of the vertices of a compartment."""
    if lateral is None or compartment == "all":
        return np.arange(count)
    return np.flatnonzero(lateral if compartment == "lateral" else ~lateral)


def _by_pose(upward: Floats, places: Floats, turn: Floats) -> Floats:
    """Return the derivatives of the height of points that move with a bone with respect to its pose.

    Args:
        upward: (N, 3) in the base's frame.
        places: (N, 3) in the moving bone's frame.
        turn: (3, 3) base from moving.

    Returns:
        (N, 6) with respect to the rotation to the right and the translation: a point R exp(w) p + t moves by
        -R [p] w + t.
    """
    return np.concatenate([np.einsum("ni,nij->nj", upward, -turn @ rotations.hat(places)), upward], 1)

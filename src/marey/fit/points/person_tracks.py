"""Points followed on a person's skin: each rides on its segment, at one and the same place in all frames."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from marey.arrays import Floats, Integers
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.body.metaballs.metaball_person import required_metaballs
from marey.body.metaballs.metaballs import PosedMetaballs
from marey.fit.points.point_equations import moves_of_segments
from marey.fit.points.surface_points import alike
from marey.fit.solver.weights import component, geman_mcclure
from marey.surface.tracks.trajectories import Trajectories

NEAR_M = 0.05
"""Points farther from the skin belong to nobody [m]."""
ELSEWHERE_M = 0.0005
"""By so much a neighbour's motion must suit a point better than that of the segment on whose skin it lies [m]."""
BESIDE_M = 0.1
"""As far from a joint a point may belong to the other segment there [m]."""
LEAST_FRAMES = 5
"""A point followed in fewer frames says hardly more than where it began."""
LEAST_SKIN_SD, LEAST_LEFT = 3e-4, 0.2
STEPS_OF_SCALE = 4.0
"""The robust scale in standard deviations of a coordinate."""
SHRINKS = 0.912
"""What the robust weights leave of a normal deviation's standard deviation at that scale, in three coordinates."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PersonTracks:
    """Trajectories on a person's skin, and how well it is believed to stay on its segment."""

    frames: Integers
    """(F,) rising."""
    position: Floats
    """(F, N, 3) in the world [m], NaN where not measured."""
    variance: Floats
    """(F, N) of a coordinate [m2]."""
    skin_sd_m: float = 0.006
    """How far a place of the skin moves about in its segment, as a standard deviation of a coordinate [m]; the fit's
    residuals say it."""
    patch_m: float = 0.06
    """Over how many metres it moves alike: points in a cell of so many count as one."""

    @staticmethod
    def of(trajectories: Trajectories) -> "PersonTracks":
        """Take trajectories that were not taken out, with the mean variance of their coordinates (zero if unknown)."""
        kept = np.flatnonzero(~trajectories.removed)
        variance = np.trace(trajectories.covariance[:, kept], axis1=2, axis2=3).astype(float) / 3.0
        return PersonTracks(
            frames=np.array(trajectories.frames), position=trajectories.position[:, kept].astype(float),
            variance=np.nan_to_num(variance),
        )  # fmt: skip

    def fastened(self, poses: Mapping[int, Pose], body: Body) -> "FastenedTracks":
        """Find the segment that carries each point, and the place in it that suits all frames best.

        Args:
            poses: of the frames that are looked at.
            body: in these poses.
        """
        rows = [row for row, frame in enumerate(self.frames) if int(frame) in poses]
        if not rows:
            count = self.position.shape[1]
            return FastenedTracks(self, body, np.full(count, -1), np.zeros((count, 3)))
        posed = [PosedBody(body, poses[int(self.frames[row])]) for row in rows]
        position = self.position[rows]
        near = _nearest_segments(posed, position)
        segment, place = _carriers(posed, position, near, STEPS_OF_SCALE * self.skin_sd_m)
        return FastenedTracks(self, body, segment, place)


def _nearest_segments(posed: Sequence[PosedBody], position: Floats) -> Integers:
    """Give the segment (N,) on whose skin each point (F, N, 3) lies in most frames, -1 where on none."""
    body = posed[0].body
    used = np.unique(body.faces)
    segment = body.vertex_segments[used, np.argmax(body.vertex_weights[used], axis=1)]
    votes = np.zeros((position.shape[1], len(body.skeleton.segment_names) + 1), np.int64)
    for there, points in zip(posed, position, strict=True):
        seen = np.flatnonzero(np.isfinite(points).all(1))
        away, which = cKDTree(there.vertices[used]).query(points[seen])
        np.add.at(votes, (seen, np.where(away < NEAR_M, segment[which], -1)), 1)
    enough = votes.sum(1) >= LEAST_FRAMES
    return np.where(enough, (np.argmax(votes, axis=1) + 1) % votes.shape[1] - 1, -1)


def _carriers(posed: Sequence[PosedBody], position: Floats, near: Integers, scale: float) -> tuple[Integers, Floats]:
    """Choose the nearest segment, or beside a joint the other one there where each point stays more in its place.

    Where the body is not in place yet, a point beside a joint lies on the wrong segment's skin, but its motion tells.

    Returns:
        (N,) the segment, -1 where none carries the point; (N, 3) the place in it [m].
    """
    parents = posed[0].body.skeleton.parents
    segment, place = near.copy(), np.zeros((len(near), 3))
    least = np.full(len(near), np.inf)
    for k in range(len(parents)):
        own = np.flatnonzero(near == k)
        place[own], least[own] = _typical(_in_segment(posed, position[:, own], k), scale)
    nearest = place.copy()
    for k, parent in enumerate(parents):
        for there, other in ((k, parent), (parent, k)):
            # The joint between the two lies at the child's origin.
            joint = np.zeros(3) if there == k else _in_segment(posed, _origins(posed, k)[:, None], there).mean((0, 1))
            beside = (near == there) & (np.linalg.norm(nearest - joint, axis=1) < BESIDE_M)
            tried = np.flatnonzero(beside if parent >= 0 else [])
            typical, off = _typical(_in_segment(posed, position[:, tried], other), scale)
            better = off < least[tried] - ELSEWHERE_M
            kept = tried[better]
            segment[kept], least[kept], place[kept] = other, off[better], typical[better]
    return segment, place


def _origins(posed: Sequence[PosedBody], k: int) -> Floats:
    """Give the joint centre (F, 3) about which a segment turns [m]."""
    return np.stack([there.segment_origin[k] for there in posed])


def _in_segment(posed: Sequence[PosedBody], position: Floats, k: int) -> Floats:
    """Give where points (F, n, 3) lie in a segment (F, n, 3) [m]."""
    turn = np.stack([there.segment_rotation[k] for there in posed])
    return np.einsum("fba,fnb->fna", turn, position - _origins(posed, k)[:, None])


def _typical(places: Floats, scale: float, rounds: int = 3) -> tuple[Floats, Floats]:
    """Give for places (F, N, 3) the robust mean over the frames (N, 3), and how far (N,) they lie about it [m]."""
    there = np.isfinite(places[..., 0])
    filled, weight = np.where(there[..., None], places, 0.0), there.astype(float)
    mean = np.zeros(places.shape[1:])
    for _ in range(rounds):
        mean = np.sum(filled * weight[..., None], 0) / np.maximum(weight.sum(0), 1e-9)[:, None]
        square = np.sum((filled - mean) ** 2, axis=2)
        weight = there / (1.0 + square / scale**2) ** 2
    spread = np.sum(there * square / (1.0 + square / scale**2), axis=0) / np.maximum(there.sum(0), 1)
    return mean, np.sqrt(spread)


@dataclass(frozen=True, eq=False)
class FastenedTracks:
    """Trajectories at their places in the segments: what they say of a frame's pose, of numbers, and of the places.

    The places of one segment may all be wrong together: six unknowns of each segment, shared by all frames, are the
    last columns of the equations. What else a point's own place may be wrong by is a mean over tens of frames; it is
    taken as known until the next round. (Ours.)
    """

    tracks: PersonTracks
    body: Body
    segment: Integers
    """(N,) -1 where no segment carries a point."""
    place: Floats
    """(N, 3) in the segment [m]."""

    @property
    def shared(self) -> int:
        """Count the unknowns that all frames share."""
        return 6 * len(self.body.skeleton.segment_names)

    def terms(self, frame: int, posed: PosedBody) -> tuple[Floats, Floats]:
        """Give the normal equations (D + N + 6 S, ...), (D + N + 6 S,) of a frame."""
        degrees, numbers = len(posed.body.skeleton), len(posed.body.space)
        size = degrees + numbers + self.shared
        hessian, gradient = np.zeros((size, size)), np.zeros(size)
        which, residual = self.residuals(frame, posed)
        if not len(which):
            return hessian, gradient
        weight = self.weights(frame, which, residual)
        moves = _moves(posed)
        root = posed.segment_origin[0]
        at = residual + self._measured(frame)[which] - root
        for k in np.unique(self.segment[which]):
            own = self.segment[which] == k
            square, linear = _by_twist(at[own], residual[own], weight[own])
            rows = np.zeros((6, size))
            rows[:, : degrees + numbers] = moves[k]
            rows[:, degrees + numbers + 6 * k : degrees + numbers + 6 * k + 6] = _of_places(posed, k)
            hessian += rows.T @ square @ rows
            gradient += rows.T @ linear
        return hessian, gradient

    def residuals(self, frame: int, posed: PosedBody) -> tuple[Integers, Floats]:
        """Give which points (n,) were measured in a frame, and how far (n, 3) beside it they are carried [m]."""
        measured = self._measured(frame)
        which = np.flatnonzero((self.segment >= 0) & np.isfinite(measured).all(1))
        segment = self.segment[which]
        turned = np.einsum("nab,nb->na", posed.segment_rotation[segment], self.place[which])
        return which, posed.segment_origin[segment] + turned - measured[which]

    def _measured(self, frame: int) -> Floats:
        row = np.flatnonzero(self.tracks.frames == frame)
        return self.tracks.position[row[0]] if len(row) else np.full((len(self.segment), 3), np.nan)

    def _known(self, frame: int, which: Integers) -> tuple[Floats, Floats]:
        """Give what is known of the variance of a coordinate, and how many points move alike (n,)."""
        row = np.flatnonzero(self.tracks.frames == frame)[0]
        return self.tracks.variance[row, which], alike(self.tracks.position[row, which], self.tracks.patch_m)

    def weights(self, frame: int, which: Integers, residual: Floats) -> Floats:
        """Give how much (n,) points of a frame count that lie residual (n, 3) beside their places [1/m2]."""
        known, count = self._known(frame, which)
        return geman_mcclure(residual, STEPS_OF_SCALE * self.tracks.skin_sd_m) / (
            known + self.tracks.skin_sd_m**2 * count
        )

    def reestimated(self, bodies: Mapping[int, PosedBody]) -> PersonTracks:
        """Estimate anew how far skin moves about in its segments, from what the fit left over (variance component)."""
        residuals, known, weights = [], [], []
        for frame, posed in bodies.items():
            which, residual = self.residuals(frame, posed)
            if len(which):
                weights.append(np.repeat(geman_mcclure(residual, STEPS_OF_SCALE * self.tracks.skin_sd_m), 3))
                known.append(np.repeat(self._known(frame, which)[0], 3))
                residuals.append(residual.ravel())
        if not residuals:
            return self.tracks
        # Each point's place was taken from its own observations.
        left = 1.0 - np.count_nonzero(self.segment >= 0) / max(sum(map(len, residuals)) / 3.0, 1.0)
        residual = np.concatenate(residuals) / SHRINKS
        sd = component(residual, np.concatenate(known), np.concatenate(weights), left=max(left, LEAST_LEFT))
        return replace(self.tracks, skin_sd_m=max(sd, LEAST_SKIN_SD))


def _moves(posed: PosedBody) -> Floats:
    """Give how each segment's shift, and turn about the root's origin, follow pose and numbers: (S, 6, D + N)."""
    space = required_metaballs(posed.body)
    surface = PosedMetaballs(space.balls(posed.body.numbers), posed.pose)
    return moves_of_segments(surface, space)


def _by_twist(at: Floats, residual: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Sum up what points (n, 3) about a centre say of a shift and a turn about it: (6, 6), (6,)."""
    rows = np.zeros((len(at), 3, 6))
    rows[:, :, :3] = np.eye(3)
    for axis, (b, c) in enumerate(((1, 2), (2, 0), (0, 1))):
        # A turn about an axis moves what lies along the next one along the third.
        rows[:, c, 3 + axis] = at[:, b]
        rows[:, b, 3 + axis] = -at[:, c]
    weighted = (rows * weight[:, None, None]).reshape(-1, 6)
    return weighted.T @ rows.reshape(-1, 6), weighted.T @ residual.ravel()


def _of_places(posed: PosedBody, k: int) -> Floats:
    """Give the shift, and turn about the root's origin, by a motion of all places of a segment: (6, 6)."""
    turn = posed.segment_rotation[k]
    x, y, z = posed.segment_origin[0] - posed.segment_origin[k]
    across = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
    found = np.zeros((6, 6))
    found[:3, :3] = found[3:, 3:] = turn
    found[:3, 3:] = across @ turn
    return found

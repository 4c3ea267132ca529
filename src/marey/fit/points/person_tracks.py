"""Points tracked on a person's skin, each attached to its segment at one position in all frames."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from marey.arrays import Floats, Integers
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.body.metaballs.metaball_person import required_metaballs
from marey.body.metaballs.metaballs import PosedMetaballs
from marey.fit.points.carry import CarrySettings
from marey.fit.points.point_equations import moves_of_segments
from marey.fit.points.surface_points import patch_counts
from marey.fit.solver.threads import map_in_threads
from marey.fit.solver.weights import SCALE_IN_SD, component_sd, geman_mcclure
from marey.surface.tracks.trajectories import Trajectories

ROBUST_SD_SHARE_3D = 0.912
"""Share of a normal standard deviation that remains under the robust weights at `SCALE_IN_SD`, for three coordinates:
the integral over the weights, sqrt(E[w r^2] / (3 E[w])), of the length r of a vector with three normal coordinates."""


@dataclass(frozen=True, kw_only=True)
class PersonTrackSettings:
    """Settings of points tracked on a person's skin.

    The defaults were chosen by hand; results were not measured against other values.
    """

    near_m: float = CarrySettings.near_m
    """Points farther from the skin are ignored [m]; as in the motion from trajectories."""
    least_gain_m: float = 0.0005
    """Least decrease of a point's residual for which it is attached to a neighbouring segment instead of the nearest
    one [m]."""
    joint_reach_m: float = 0.1
    """Distance from a joint within which a point may belong to the other segment there [m]."""
    least_frames: int = 5
    """Points tracked in fewer frames are ignored: they constrain the motion too little."""
    least_skin_sd_m: float = 3e-4
    """Lower limit of the skin's estimated standard deviation [m]."""
    least_redundancy: float = 0.2
    """Lower limit of the redundancy, as a share of the observations."""


PERSON_TRACK_DEFAULTS = PersonTrackSettings()
"""Default settings of points tracked on a person's skin."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PersonTracks:
    """Trajectories on a person's skin, and the standard deviation of the skin relative to its segment."""

    frames: Integers
    """(F,) ascending."""
    position: Floats
    """(F, N, 3) in the world [m], NaN where not measured."""
    variance: Floats
    """(F, N) variance of a coordinate [m2]."""
    skin_sd_m: float = 0.006
    """Standard deviation of a skin point relative to its segment, per coordinate [m]; estimated from the fit's
    residuals."""
    patch_m: float = 0.06
    """Size of the cells in which the skin's motion is correlated: points in one cell count as one [m].
    With 0.02 m the skin of `arm3` is 2.70 instead of 2.48 mm off (docs/accuracy/rejected.md)."""
    settings: PersonTrackSettings = PERSON_TRACK_DEFAULTS
    """How points are attached to segments, and limits of the estimates."""

    @staticmethod
    def of(trajectories: Trajectories, settings: PersonTrackSettings = PERSON_TRACK_DEFAULTS) -> "PersonTracks":
        """Take the trajectories that were not removed, with their coordinates' mean variance (zero if unknown)."""
        kept = np.flatnonzero(~trajectories.removed)
        variance = np.trace(trajectories.covariance[:, kept], axis1=2, axis2=3).astype(float) / 3.0
        return PersonTracks(
            frames=np.array(trajectories.frames), position=trajectories.position[:, kept].astype(float),
            variance=np.nan_to_num(variance), settings=settings,
        )  # fmt: skip

    def attached(self, poses: Mapping[int, Pose], body: Body) -> "AttachedTracks":
        """Find the segment that carries each point, and its position in the segment that fits all frames best.

        Args:
            poses: Poses of the frames that are used.
            body: Body in these poses.
        """
        rows = [row for row, frame in enumerate(self.frames) if int(frame) in poses]
        if not rows:
            count = self.position.shape[1]
            return AttachedTracks(self, body, np.full(count, -1), np.zeros((count, 3)))
        posed = [PosedBody(body, poses[int(self.frames[row])]) for row in rows]
        position = self.position[rows]
        near = _nearest_segments(posed, position, self.settings)
        segment, place = _carriers(posed, position, near, SCALE_IN_SD * self.skin_sd_m, self.settings)
        return AttachedTracks(self, body, segment, place)


def _nearest_segments(posed: Sequence[PosedBody], position: Floats, settings: PersonTrackSettings) -> Integers:
    """Return the segment (N,) on whose skin each point (F, N, 3) lies in most frames, -1 if on none."""
    body = posed[0].body
    used = np.unique(body.faces)
    segment = body.vertex_segments[used, np.argmax(body.vertex_weights[used], axis=1)]
    votes = np.zeros((position.shape[1], len(body.skeleton.segment_names) + 1), np.int64)

    def nearest(given: tuple[PosedBody, Floats]) -> tuple[Integers, Integers]:
        there, points = given
        seen = np.flatnonzero(np.isfinite(points).all(1))
        away, which = cKDTree(there.vertices[used]).query(points[seen])
        return seen, np.where(away < settings.near_m, segment[which], -1)

    for seen, own in map_in_threads(nearest, zip(posed, position, strict=True)):
        votes[seen, own] += 1
    enough = votes.sum(1) >= settings.least_frames
    return np.where(enough, (np.argmax(votes, axis=1) + 1) % votes.shape[1] - 1, -1)


def _carriers(
    posed: Sequence[PosedBody], position: Floats, near: Integers, scale: float, settings: PersonTrackSettings
) -> tuple[Integers, Floats]:
    """Choose the nearest segment or, near a joint, the other one there if the point moves less relative to it.

    If the pose is only approximate, a point near a joint lies on the wrong segment's skin; its motion decides.

    Returns:
        (N,) the segment, -1 if none carries the point; (N, 3) the position in it [m].
    """
    parents = posed[0].body.skeleton.parents
    segment, place = near.copy(), np.zeros((len(near), 3))
    least = np.full(len(near), np.inf)
    for k in range(len(parents)):
        own = np.flatnonzero(near == k)
        place[own], least[own] = _robust_mean(_local_positions(posed, position[:, own], k), scale)
    nearest = place.copy()
    for k, parent in enumerate(parents):
        for there, other in ((k, parent), (parent, k)):
            # The joint between the two is the child's origin.
            joint = (
                np.zeros(3) if there == k else _local_positions(posed, _origins(posed, k)[:, None], there).mean((0, 1))
            )
            beside = (near == there) & (np.linalg.norm(nearest - joint, axis=1) < settings.joint_reach_m)
            tried = np.flatnonzero(beside if parent >= 0 else [])
            typical, off = _robust_mean(_local_positions(posed, position[:, tried], other), scale)
            better = off < least[tried] - settings.least_gain_m
            kept = tried[better]
            segment[kept], least[kept], place[kept] = other, off[better], typical[better]
    return segment, place


def _origins(posed: Sequence[PosedBody], k: int) -> Floats:
    """Return the joint centre (F, 3) about which a segment turns [m]."""
    return np.stack([there.segment_origin[k] for there in posed])


def _local_positions(posed: Sequence[PosedBody], position: Floats, k: int) -> Floats:
    """Return the positions (F, n, 3) of points (F, n, 3) relative to a segment [m]."""
    turn = np.stack([there.segment_rotation[k] for there in posed])
    return np.asarray(np.einsum("fba,fnb->fna", turn, position - _origins(posed, k)[:, None]))


def _robust_mean(places: Floats, scale: float, rounds: int = 3) -> tuple[Floats, Floats]:
    """Return the robust mean (N, 3) of positions (F, N, 3) over the frames, and the deviation (N,) from it [m]."""
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
class AttachedTracks:
    """Trajectories attached to segments, and their normal equations for pose, shape parameters and positions.

    The positions on one segment may share a common error: six unknowns of each segment, shared by all frames, are the
    last columns of the equations. The remaining error of a point's own position is a mean over tens of frames; the
    position is taken as known until the next round. (Ours.)
    """

    tracks: PersonTracks
    body: Body
    segment: Integers
    """(N,) carrying segment, -1 for none."""
    place: Floats
    """(N, 3) in the segment [m]."""

    @property
    def shared(self) -> int:
        """Return the number of unknowns that all frames share."""
        return 6 * len(self.body.skeleton.segment_names)

    def terms(self, frame: int, posed: PosedBody) -> tuple[Floats, Floats]:
        """Return the normal equations (D + N + 6 S, D + N + 6 S), (D + N + 6 S,) of a frame."""
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
            square, linear = _twist_terms(at[own], residual[own], weight[own])
            rows = np.zeros((6, size))
            rows[:, : degrees + numbers] = moves[k]
            rows[:, degrees + numbers + 6 * k : degrees + numbers + 6 * k + 6] = _place_motion(posed, k)
            hessian += rows.T @ square @ rows
            gradient += rows.T @ linear
        return hessian, gradient

    def residuals(self, frame: int, posed: PosedBody) -> tuple[Integers, Floats]:
        """Return the indices (n,) of the points measured in a frame, and their residuals (n, 3) [m]."""
        measured = self._measured(frame)
        which = np.flatnonzero((self.segment >= 0) & np.isfinite(measured).all(1))
        segment = self.segment[which]
        turned = np.einsum("nab,nb->na", posed.segment_rotation[segment], self.place[which])
        return which, posed.segment_origin[segment] + turned - measured[which]

    def _measured(self, frame: int) -> Floats:
        row = np.flatnonzero(self.tracks.frames == frame)
        return self.tracks.position[row[0]] if len(row) else np.full((len(self.segment), 3), np.nan)

    def _known(self, frame: int, which: Integers) -> tuple[Floats, Floats]:
        """Return the known variance of a coordinate, and the number of points in each point's patch (n,)."""
        row = np.flatnonzero(self.tracks.frames == frame)[0]
        return self.tracks.variance[row, which], patch_counts(self.tracks.position[row, which], self.tracks.patch_m)

    def weights(self, frame: int, which: Integers, residual: Floats) -> Floats:
        """Return the weights (n,) of points of a frame with residuals (n, 3) [1/m2]."""
        known, count = self._known(frame, which)
        return geman_mcclure(residual, SCALE_IN_SD * self.tracks.skin_sd_m) / (known + self.tracks.skin_sd_m**2 * count)

    def reestimated(self, bodies: Mapping[int, PosedBody]) -> PersonTracks:
        """Estimate the skin's standard deviation relative to its segments from the residuals (variance component)."""
        residuals, known, weights = [], [], []
        for frame, posed in bodies.items():
            which, residual = self.residuals(frame, posed)
            if len(which):
                weights.append(np.repeat(geman_mcclure(residual, SCALE_IN_SD * self.tracks.skin_sd_m), 3))
                known.append(np.repeat(self._known(frame, which)[0], 3))
                residuals.append(residual.ravel())
        if not residuals:
            return self.tracks
        # Each point's position was estimated from its own observations.
        left = 1.0 - np.count_nonzero(self.segment >= 0) / max(sum(map(len, residuals)) / 3.0, 1.0)
        residual = np.concatenate(residuals) / ROBUST_SD_SHARE_3D
        settings = self.tracks.settings
        redundancy = max(float(left), settings.least_redundancy)
        sd = component_sd(residual, np.concatenate(known), np.concatenate(weights), left=redundancy)
        return replace(self.tracks, skin_sd_m=max(sd, settings.least_skin_sd_m))


def _moves(posed: PosedBody) -> Floats:
    """Return the derivatives (S, 6, D + N) of segments' shifts, and rotations about the root, by pose and numbers."""
    space = required_metaballs(posed.body)
    surface = PosedMetaballs(space.balls(posed.body.numbers), posed.pose)
    return moves_of_segments(surface, space)


def _twist_terms(at: Floats, residual: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Sum the normal equations (6, 6), (6,) of points (n, 3) for a shift and a rotation about a centre."""
    rows = np.zeros((len(at), 3, 6))
    rows[:, :, :3] = np.eye(3)
    for axis, (b, c) in enumerate(((1, 2), (2, 0), (0, 1))):
        # A rotation about an axis moves a point on the next axis along the third one.
        rows[:, c, 3 + axis] = at[:, b]
        rows[:, b, 3 + axis] = -at[:, c]
    weighted = (rows * weight[:, None, None]).reshape(-1, 6)
    return weighted.T @ rows.reshape(-1, 6), weighted.T @ residual.ravel()


def _place_motion(posed: PosedBody, k: int) -> Floats:
    """Return the shift and rotation about the root's origin (6, 6) by a motion of all positions of a segment."""
    turn = posed.segment_rotation[k]
    x, y, z = posed.segment_origin[0] - posed.segment_origin[k]
    across = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
    found = np.zeros((6, 6))
    found[:3, :3] = found[3:, 3:] = turn
    found[:3, 3:] = across @ turn
    return found

"""Cameras from the detected joints of one person and approximate focal lengths alone.

Cameras, focal lengths, joints and lengths of bones are adjusted together ([Triggs1999]): each bone has one length in
all frames, which is known approximately and sets the scale. A detector sees the same joint elsewhere from another side,
in all frames alike: each joint has an unknown constant error in each camera. The joints of each frame are eliminated
first.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.cameras.camera import Camera
from marey.cameras.parameters import PARAMETERS, focal_basis, pose_basis, project_with_slopes, stepped_camera
from marey.fit.cameras.joint_pairs import JointSightings, chained_cameras, triangulated_joints
from marey.fit.cameras.refine import motions_as_a_whole
from marey.geometry.rigid import RigidTransform
from marey.observations.detected_joints import t_weights

JOINT_SD_RAD = 0.006
"""Standard deviation of a detected joint of full confidence, per axis [rad]: 20 mm at 3.3 m, as for a capture."""
BIAS_RAD = 0.006
"""Standard deviation of the constant error of a joint in one camera, per axis [rad]: 20 mm at 3.3 m. A detector's knees
and elbows are 25 to 50 mm from the true centres (`marey.fit.recipes.detections`)."""
BONE_SD = 0.05
"""Standard deviation of a detected bone's length in a frame from its constant one, relative. It is relative because an
absolute one draws the scale to zero. Chosen by hand."""
FOCAL_SD = 0.05
"""Standard deviation of an approximate focal length, relative."""
STEP_SD = 0.3
"""Standard deviation of a step of a camera's unknown, which damps the steps [rad, m]. Chosen by hand."""
POINT_SD_M = 30.0
"""Standard deviation of a joint before the measurement [m]: numerical, for joints that are not seen."""
JOINT_ROUNDS = 40
"""Largest number of Gauss-Newton steps. Chosen by hand."""
JOINTS_SETTLED = 1e-5
"""Largest step that ends the iteration [rad, m, 1]."""
LEAST_SEEN_FRAMES = 15
"""Least number of frames in which two cameras see joints. Chosen by hand."""
MOST_TURN_RAD, MOST_SHIFT = 0.15, 0.15
"""Standard deviations of a camera's orientation about any axis [rad] and of its position, relative to its distance from
the person, above which the take does not determine it. Chosen by hand."""
ANKLE_HEIGHT_M = 0.08
"""Height of the centre of an ankle above the floor [m]. Chosen by hand."""
STANDING_SHARE = 10.0
"""Percentile of the ankles' heights at which they stand on the floor. Chosen by hand."""
LEAST_WAY = 0.7
"""Least way from the beginning to the end of a walk, relative to the height of the shoulders above the ankles, from
which it counts as horizontal. Chosen by hand."""
UNKNOWNS = 7
"""Unknowns of a camera: rotation about its centre [rad], shift of the centre [m], and relative focal length."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BoneLengths:
    """What is known of the lengths of the bones `marey.fit.cameras.joint_pairs.BONES` before the measurement."""

    expected_m: Floats
    """(B,) [m]."""
    covariance: Floats
    """(B, B) of their natural logarithms, with the distances of a detector's joints from the body's."""

    def __post_init__(self) -> None:
        freeze_fields(self, "expected_m", "covariance")

    @property
    def scale_sd(self) -> float:
        """Standard deviation of the scale that the lengths give, relative."""
        return float(1 / np.sqrt(np.linalg.inv(self.covariance).sum()))


@dataclass(frozen=True, eq=False, kw_only=True)
class PlacedCameras:
    """Cameras that were placed by detected joints."""

    cameras: tuple[Camera, ...]
    """The cameras, with Z up along the person and the floor at 0."""
    covariance: Floats
    """(15 C, 15 C) of the cameras' parameters, in the world in which the cameras as a whole are at rest, at their
    scale."""
    points: Floats
    """(F, J, 3) the joints [m]; NaN where they were not seen by two cameras."""
    residual_px: float
    """Median distance of the joints from their projections [px]."""
    scale_sd: float
    """Standard deviation of the scale, relative."""
    undetermined: tuple[str, ...]
    """Cameras that the joints do not determine."""

    def __post_init__(self) -> None:
        freeze_fields(self, "covariance", "points")


def place_cameras(
    cameras: Sequence[Camera], seen: JointSightings, lengths: BoneLengths, *, focal_sd: float = FOCAL_SD
) -> PlacedCameras:
    """Place cameras by the joints of a person who moves before them.

    Args:
        cameras: C cameras whose lenses are known approximately; their poses are ignored.
        seen: Detected joints of one person.
        lengths: Expected lengths of the bones; they set the scale.
        focal_sd: Standard deviation of the focal lengths, relative.

    Returns:
        The cameras. If some of them share too few joints with the others, all are returned without poses.
    """
    started, left = chained_cameras(cameras, seen, lengths.expected_m)
    if left or np.count_nonzero((seen.used.any(axis=2)).sum(axis=1) >= 2) < LEAST_SEEN_FRAMES:
        return _nothing(cameras, left or tuple(camera.name for camera in cameras), lengths)
    problem = JointProblem(seen=seen, lengths=lengths, focal_sd=focal_sd)
    adjusted = problem.adjusted(started)
    world = standing_world(seen.joint_names, adjusted.points)
    placed = tuple(camera.moved(world) for camera in adjusted.cameras)
    covariance = _in_world(adjusted.cameras, placed, adjusted.covariance, world)
    points = world.apply(adjusted.points)
    return PlacedCameras(
        cameras=placed, covariance=covariance, points=points, residual_px=adjusted.residual_px,
        scale_sd=lengths.scale_sd, undetermined=undetermined_cameras(placed, covariance, points),
    )  # fmt: skip


def _nothing(cameras: Sequence[Camera], names: tuple[str, ...], lengths: BoneLengths) -> PlacedCameras:
    return PlacedCameras(
        cameras=tuple(cameras), covariance=np.full((PARAMETERS * len(cameras),) * 2, np.nan),
        points=np.zeros((0, 0, 3)), residual_px=np.nan, scale_sd=lengths.scale_sd, undetermined=names,
    )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameRows:
    """The residuals of one frame in standard deviations, and their derivatives."""

    residual: Floats
    """(M,)."""
    by_point: Floats
    """(M, 3 J) by the joints [1/m]."""
    by_shared: Floats
    """(M, G) by the unknowns of all frames."""
    away_px: Floats
    """(N,) distances of the joints from their projections [px]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class JointAdjustment:
    """Adjusted cameras and joints."""

    cameras: tuple[Camera, ...]
    points: Floats
    covariance: Floats
    residual_px: float


@dataclass(frozen=True, eq=False, kw_only=True)
class JointProblem:
    """The least-squares problem of cameras, joints and lengths of bones."""

    seen: JointSightings
    lengths: BoneLengths
    focal_sd: float

    def adjusted(self, started: Sequence[Camera]) -> JointAdjustment:
        """Adjust all unknowns by damped Gauss-Newton steps with robust weights.

        Args:
            started: Cameras in approximate poses.
        """
        state = JointState(
            cameras=tuple(started), points=triangulated_joints(started, self.seen), focal=np.zeros(len(started)),
            logs=np.log(self.lengths.expected_m),
            bias=np.zeros((len(started), len(self.seen.joint_names), 2)),
        )  # fmt: skip
        damping = np.zeros(state.size)
        damping[: UNKNOWNS * len(started)] = np.tile([STEP_SD**-2.0] * 6 + [0.0], len(started))
        for _ in range(JOINT_ROUNDS):
            reduced = [_reduced(self._frame(state, frame)) for frame in range(len(state.points))]
            matrix, right = self._prior(state)
            matrix = matrix + sum(each[0] for each in reduced) + np.diag(damping)
            step = -np.linalg.solve(matrix, right + sum(each[1] for each in reduced))
            moved = np.array([own + link @ step for _, _, own, link in reduced])
            state = state.stepped(step, moved.reshape(state.points.shape))
            if np.abs(step[: UNKNOWNS * len(started)]).max() < JOINTS_SETTLED:
                break
        rows = [self._frame(state, frame) for frame in range(len(state.points))]
        information = self._prior(state)[0] + sum(_reduced(each)[0] for each in rows)
        return JointAdjustment(
            cameras=state.cameras, points=np.where(_twice(self.seen.used)[..., None], state.points, np.nan),
            covariance=_covariance(state, information, self.focal_sd),
            residual_px=float(np.median(np.concatenate([each.away_px for each in rows]))),
        )  # fmt: skip

    def _prior(self, state: "JointState") -> tuple[Floats, Floats]:
        """Return information (G, G) and gradient (G,) of what is known of focal lengths, bones and constant errors."""
        cameras, bones = UNKNOWNS * len(state.cameras), slice(state.first_bone, state.first_bias)
        matrix, right = np.zeros((state.size,) * 2), np.zeros(state.size)
        at = np.arange(6, cameras, UNKNOWNS)
        matrix[at, at], right[at] = self.focal_sd**-2.0, state.focal / self.focal_sd**2
        known = np.linalg.inv(self.lengths.covariance)
        matrix[bones, bones], right[bones] = known, known @ (state.logs - np.log(self.lengths.expected_m))
        errors = np.arange(state.first_bias, state.size)
        matrix[errors, errors], right[errors] = 1.0, state.bias.ravel()
        return matrix, right

    def _frame(self, state: "JointState", frame: int) -> FrameRows:
        """Return the residuals of a frame."""
        points = state.points[frame]
        used = self.seen.used[frame] & _twice(self.seen.used)[frame] & np.isfinite(points).all(axis=1)
        points = np.where(used.any(axis=0)[:, None], points, 0.0)
        parts = [self._seen(state, points, frame, c, used[c]) for c in range(len(state.cameras))]
        parts.append(self._bones(state, points, used.any(axis=0)))
        residual, by_point, by_shared, away = (np.concatenate(kind) for kind in zip(*parts, strict=True))
        return FrameRows(residual=residual, by_point=by_point, by_shared=by_shared, away_px=away)

    def _seen(
        self, state: "JointState", points: Floats, frame: int, c: int, used: Mask
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Return the residuals of one camera's joints, their derivatives, and the distances [px]."""
        camera, known = state.cameras[c], np.flatnonzero(used)
        pixels, slope, by_camera = project_with_slopes(camera, points[known])
        bias = BIAS_RAD * camera.matrix[0, 0]
        off = pixels - self.seen.pixels[frame, c, known]
        good = np.isfinite(off).all(axis=1)
        known, off, slope, by_camera = known[good], off[good], slope[good], by_camera[good]
        away = np.linalg.norm(off, axis=1)
        off = off + bias * state.bias[c, known]
        sd = JOINT_SD_RAD * camera.matrix[0, 0] / self.seen.confidence[frame, c, known]
        share = (np.sqrt(t_weights(np.sum((off / sd[:, None]) ** 2, axis=1))) / sd)[:, None, None]
        count = np.arange(len(known))
        own, shared = np.zeros((len(known), 2, len(points), 3)), np.zeros((len(known), 2, state.size))
        own[count, :, known] = share * slope
        shared[..., UNKNOWNS * c : UNKNOWNS * (c + 1)] = share * (by_camera @ camera_basis(camera))
        for axis in range(2):
            shared[count, axis, state.first_bias + 2 * (c * len(points) + known) + axis] = share[:, 0, 0] * bias
        return (share[..., 0] * off).ravel(), own.reshape(-1, points.size), shared.reshape(-1, state.size), away

    def _bones(self, state: "JointState", points: Floats, known: Mask) -> tuple[Floats, Floats, Floats, Floats]:
        """Return the residuals of the bones' lengths, their derivatives, and no distances."""
        bones = self.seen.bones()
        first, second = np.array(bones["first"]), np.array(bones["second"])
        apart = points[first] - points[second]
        length = np.linalg.norm(apart, axis=1)
        good = np.flatnonzero(known[first] & known[second] & (length > 0))
        off = (np.log(length[good]) - state.logs[good]) / BONE_SD
        share = np.sqrt(t_weights(off**2)) / BONE_SD
        along = apart[good] / length[good, None] ** 2 * share[:, None]
        by_point, by_shared = np.zeros((len(good), len(points), 3)), np.zeros((len(good), state.size))
        rows = np.arange(len(good))
        by_point[rows, first[good]], by_point[rows, second[good]] = along, -along
        by_shared[rows, state.first_bone + good] = -share
        return off * share * BONE_SD, by_point.reshape(len(good), points.size), by_shared, np.zeros(0)


@dataclass(frozen=True, eq=False, kw_only=True)
class JointState:
    """The unknowns: cameras, joints, logarithms of the bones' lengths, and constant errors of the joints."""

    cameras: tuple[Camera, ...]
    points: Floats
    """(F, J, 3) [m]; NaN where unknown."""
    focal: Floats
    """(C,) relative change of the focal lengths so far."""
    logs: Floats
    """(B,) logarithms of the lengths."""
    bias: Floats
    """(C, J, 2) constant errors in units of `BIAS_RAD`."""

    @property
    def first_bone(self) -> int:
        """Place of the first bone among the shared unknowns."""
        return UNKNOWNS * len(self.cameras)

    @property
    def first_bias(self) -> int:
        """Place of the first constant error among the shared unknowns."""
        return self.first_bone + len(self.logs)

    @property
    def size(self) -> int:
        """Number G of shared unknowns."""
        return self.first_bias + self.bias.size

    def stepped(self, step: Floats, moved: Floats) -> "JointState":
        """Return the state after a step (G,) of the shared unknowns and minus a step (F, J, 3) of the joints."""
        own = step[: self.first_bone].reshape(-1, UNKNOWNS)
        return JointState(
            cameras=tuple(
                stepped_camera(camera, camera_basis(camera) @ each)
                for camera, each in zip(self.cameras, own, strict=True)
            ),
            points=self.points - moved, focal=self.focal + own[:, 6],
            logs=self.logs + step[self.first_bone : self.first_bias],
            bias=self.bias + step[self.first_bias :].reshape(self.bias.shape),
        )  # fmt: skip


def _covariance(state: JointState, information: Floats, focal_sd: float) -> Floats:
    """Return the covariance (15 C, 15 C) of the cameras' parameters, with the cameras as a whole at rest."""
    basis, count = block_basis(state.cameras), state.first_bone
    scale = np.tile([1.0] * 6 + [focal_sd], len(state.cameras))
    free = motions_as_a_whole(basis * scale, state.cameras)[1] * scale[:, None]
    cross = information[:count, count:]
    own = information[:count, :count] - cross @ np.linalg.solve(information[count:, count:], cross.T)
    spread = basis @ free
    return np.asarray(spread @ np.linalg.inv(free.T @ own @ free) @ spread.T)


def _reduced(rows: FrameRows) -> tuple[Floats, Floats, Floats, Floats]:
    """Eliminate the joints of a frame.

    Returns:
        Information (G, G) and gradient (G,) of the shared unknowns, and the joints' own step (3 J,) and its change by
        the shared unknowns (3 J, G).
    """
    square = rows.by_point.T @ rows.by_point + POINT_SD_M**-2.0 * np.eye(rows.by_point.shape[1])
    border, pull = rows.by_point.T @ rows.by_shared, rows.by_point.T @ rows.residual
    back = np.linalg.solve(square, np.column_stack([pull, border]))
    own, link = back[:, 0], back[:, 1:]
    matrix = rows.by_shared.T @ rows.by_shared - border.T @ link
    return matrix, rows.by_shared.T @ rows.residual - border.T @ own, own, link


def camera_basis(camera: Camera) -> Floats:
    """Return the change (15, 7) of a camera's parameters by its unknowns."""
    return np.hstack([pose_basis(camera), focal_basis(camera)])


def block_basis(cameras: Sequence[Camera]) -> Floats:
    """Return the change (15 C, 7 C) of all cameras' parameters by their unknowns."""
    basis = np.zeros((PARAMETERS * len(cameras), UNKNOWNS * len(cameras)))
    for c, camera in enumerate(cameras):
        basis[PARAMETERS * c : PARAMETERS * (c + 1), UNKNOWNS * c : UNKNOWNS * (c + 1)] = camera_basis(camera)
    return basis


def _twice(used: Mask) -> Mask:
    """Return which joints (F, J) at least two cameras see."""
    return np.asarray(np.count_nonzero(used, axis=1) >= 2)


def _in_world(before: Sequence[Camera], after: Sequence[Camera], covariance: Floats, world: RigidTransform) -> Floats:
    """Return the covariance (15 C, 15 C) of cameras that were moved into another world."""
    turn = np.eye(UNKNOWNS)
    turn[3:6, 3:6] = world.rotation
    inverse = np.linalg.pinv(block_basis(before))
    change = block_basis(after) @ np.kron(np.eye(len(before)), turn) @ inverse
    return np.asarray(change @ covariance @ change.T)


def undetermined_cameras(cameras: Sequence[Camera], covariance: Floats, points: Floats) -> tuple[str, ...]:
    """Return the names of the cameras whose standard deviations are too large.

    Args:
        cameras: C cameras.
        covariance: (15 C, 15 C) of their parameters.
        points: (F, J, 3) the joints, NaN where unknown [m].
    """
    inverse = np.linalg.pinv(block_basis(cameras))
    own = np.sqrt(np.diag(inverse @ covariance @ inverse.T)).reshape(-1, UNKNOWNS)
    middle, names = np.nanmedian(points.reshape(-1, 3), axis=0), []
    for camera, sd in zip(cameras, own, strict=True):
        distance = np.linalg.norm(camera.centre - middle)
        if not (sd[:3].max() < MOST_TURN_RAD and sd[3:6].max() < MOST_SHIFT * distance):
            names.append(camera.name)
    return tuple(names)


def standing_world(joint_names: Sequence[str], points: Floats) -> RigidTransform:
    """Return the transform to a world with Z up along the person, the floor at 0, X to its right, and Y ahead.

    A person who walks leans forward, but the way is horizontal: Z is perpendicular to it.

    Args:
        joint_names: J names.
        points: (F, J, 3) in another world, NaN where unknown [m].
    """
    place = {name: k for k, name in enumerate(joint_names)}

    def middle(joint: str) -> Floats:
        return np.asarray(0.5 * (points[:, place[f"left_{joint}"]] + points[:, place[f"right_{joint}"]]))

    up = np.nanmedian(middle("shoulder") - middle("ankle"), axis=0)
    way = way_of(middle("hip"))
    if np.linalg.norm(way) > LEAST_WAY * np.linalg.norm(up):
        up = up - way * (up @ way) / (way @ way)
    up = up / np.linalg.norm(up)
    across = np.nanmedian(points[:, place["right_hip"]] - points[:, place["left_hip"]], axis=0)
    across = across - up * (across @ up)
    across = across / np.linalg.norm(across)
    rotation = np.stack([across, np.cross(up, across), up])
    ankles = np.concatenate([points[:, place[f"{side}_ankle"]] for side in ("left", "right")]) @ rotation.T
    origin = np.nanmedian(middle("hip"), axis=0) @ rotation.T
    floor = np.nanpercentile(ankles[:, 2], STANDING_SHARE) - ANKLE_HEIGHT_M
    return RigidTransform(rotation, -np.array([origin[0], origin[1], floor]))


def way_of(places: Floats) -> Floats:
    """Return the way (3,) from the first to the last tenth of the known places (F, 3) [m]."""
    known = places[np.isfinite(places[:, 0])]
    tenth = max(len(known) // 10, 1)
    return np.asarray(known[-tenth:].mean(axis=0) - known[:tenth].mean(axis=0))

"""Poses of cameras from detected joints of one person and approximate focal lengths alone.

Pairs of cameras are placed by their essential matrices ([Nister2004], by OpenCV, robust), the length of each baseline by
the lengths of the person's bones, and all cameras, focal lengths, joints and lengths of bones are adjusted together:
each bone has one length in all frames.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np

from marey.arrays import Floats, Mask
from marey.cameras.camera import Camera
from marey.cameras.parameters import PARAMETERS, focal_basis, pose_basis, project_with_slopes, stepped_camera
from marey.cameras.triangulate import triangulate
from marey.geometry.rigid import RigidTransform
from marey.observations.detected_joints import t_weights

BONES = tuple(
    (f"{side}_{a}", f"{side}_{b}")
    for side in ("left", "right")
    for a, b in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"))
)
"""Bones whose lengths are constant, by the names of their joints."""
LEAST_CONFIDENCE = 0.5
"""Joints of less confidence are not used. Chosen by hand."""
INLIER_RAD = 0.012
"""Largest distance of a joint from its epipolar line [rad]: a detector sees a joint elsewhere from each side. Chosen by
hand."""
LEAST_JOINTS = 60
"""Number of joints that two cameras must share. Chosen by hand."""
JOINT_SD_RAD = 0.006
"""Standard deviation of a detected joint of full confidence, per axis [rad]. Chosen by hand."""
BONE_SD_M, LENGTH_SD = 0.015, 0.1
"""Standard deviations of a detected bone's length from its constant one [m], and of that from the expected one,
relative. Chosen by hand."""
FOCAL_SD = 0.05
"""Standard deviation of an approximate focal length, relative."""
ROUNDS = 30
"""Number of Gauss-Newton steps. Chosen by hand."""
STEP_SD = 0.3
"""Standard deviation of a step of a camera's unknown, which damps the first steps [rad, m]. Chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class JointSightings:
    """Detected joints of one person."""

    joint_names: tuple[str, ...]
    """J names."""
    pixels: Floats
    """(F, C, J, 2) [px]; NaN where a joint was not found."""
    confidence: Floats
    """(F, C, J) from 0 to 1."""

    @property
    def used(self) -> Mask:
        """(F, C, J) joints of sufficient confidence."""
        return np.isfinite(self.pixels[..., 0]) & (self.confidence >= LEAST_CONFIDENCE)

    def bones(self) -> list[tuple[int, int]]:
        """Return the numbers of the joints of each bone of `BONES`."""
        return [(self.joint_names.index(a), self.joint_names.index(b)) for a, b in BONES]


@dataclass(frozen=True, eq=False, kw_only=True)
class PlacedCameras:
    """Cameras that were placed by detected joints."""

    cameras: tuple[Camera, ...]
    points: Floats
    """(F, J, 3) the joints [m]; NaN where they were not seen by two cameras."""
    residual_px: float
    """Median distance of the joints from their projections [px]."""
    undetermined: tuple[str, ...] = ()
    """Cameras that share too few joints with the others."""


def place_cameras(
    cameras: Sequence[Camera], seen: JointSightings, lengths_m: Mapping[tuple[str, str], float]
) -> PlacedCameras:
    """Place cameras by the joints that they share.

    Args:
        cameras: C cameras whose lenses are known approximately; their poses are ignored.
        seen: Detected joints.
        lengths_m: Expected length of each bone of `BONES` [m]; they set the scale.

    Returns:
        The cameras in a world whose Z points up along the standing person, with the floor at 0.
    """
    expected = np.array([lengths_m[bone] for bone in BONES])
    placed, left = _chained(cameras, seen, expected)
    if left:
        return PlacedCameras(cameras=tuple(placed), points=np.zeros((0, 0, 3)), residual_px=np.nan, undetermined=left)
    points = _triangulated(placed, seen).copy()
    current, points, residual = _adjusted(placed, seen, points, expected)
    world = _standing_world(seen, points)
    return PlacedCameras(
        cameras=tuple(camera.moved(world) for camera in current), points=world.apply(points), residual_px=residual
    )


def _chained(
    cameras: Sequence[Camera], seen: JointSightings, expected: Floats
) -> tuple[list[Camera], tuple[str, ...]]:
    """Place the cameras one after the other, the pair that shares most joints first."""
    links = {}
    for i, j in combinations(range(len(cameras)), 2):
        found = _relative(cameras[i], cameras[j], seen, (i, j), expected)
        if found is not None:
            links[i, j] = found
    placed: dict[int, RigidTransform] = {}
    if links:
        placed[max(links, key=lambda pair: links[pair][1])[0]] = RigidTransform.identity()
    while True:
        open_links = {pair: link for pair, link in links.items() if (pair[0] in placed) != (pair[1] in placed)}
        if not open_links:
            break
        (i, j), (second_from_first, _) = max(open_links.items(), key=lambda item: item[1][1])
        if i in placed:
            placed[j] = second_from_first @ placed[i]
        else:
            placed[i] = second_from_first.inverse() @ placed[j]
    left = tuple(camera.name for c, camera in enumerate(cameras) if c not in placed)
    return [
        replace(camera, camera_from_world=placed.get(c, RigidTransform.identity())) for c, camera in enumerate(cameras)
    ], left


def _relative(
    first: Camera, second: Camera, seen: JointSightings, pair: tuple[int, int], expected: Floats
) -> tuple[RigidTransform, int] | None:
    """Return the pose of the second camera relative to the first one, and the number of joints that agree with it."""
    both = seen.used[:, pair[0]] & seen.used[:, pair[1]]
    one, other = first.undistort(seen.pixels[:, pair[0]][both]), second.undistort(seen.pixels[:, pair[1]][both])
    known = np.isfinite(one).all(1) & np.isfinite(other).all(1)
    if np.count_nonzero(known) < LEAST_JOINTS:
        return None
    matrix, inside = cv2.findEssentialMat(
        one[known], other[known], np.eye(3), method=cv2.USAC_MAGSAC, prob=0.9999, threshold=INLIER_RAD, maxIters=5000
    )
    if matrix is None or matrix.shape != (3, 3) or np.count_nonzero(inside) < LEAST_JOINTS:
        return None
    count, rotation, shift, _ = cv2.recoverPose(matrix, one[known], other[known], np.eye(3), mask=inside.copy())
    trial = [
        replace(first, camera_from_world=RigidTransform.identity()),
        replace(second, camera_from_world=RigidTransform(rotation, shift.ravel())),
    ]
    own = replace(seen, pixels=seen.pixels[:, list(pair)], confidence=seen.confidence[:, list(pair)])
    points = _triangulated(trial, own)
    ratio = expected / np.nanmedian(_lengths(points, own.bones()), axis=0)
    scale = float(np.nanmedian(ratio))
    return (RigidTransform(rotation, shift.ravel() * scale), int(count)) if np.isfinite(scale) else None


def _lengths(points: Floats, bones: Sequence[tuple[int, int]]) -> Floats:
    """Return the lengths (F, B) of bones."""
    first, second = np.array(bones).T
    return np.asarray(np.linalg.norm(points[:, first] - points[:, second], axis=-1))


def _triangulated(cameras: Sequence[Camera], seen: JointSightings) -> Floats:
    frames, _, joints = seen.used.shape
    pixels = np.where(seen.used[..., None], seen.pixels, np.nan)
    flat = np.moveaxis(pixels, 1, 0).reshape(len(cameras), -1, 2)
    return triangulate(cameras, flat, sigma_px=3.0).points.reshape(frames, joints, 3)


def _adjusted(
    cameras: Sequence[Camera], seen: JointSightings, points: Floats, expected: Floats
) -> tuple[list[Camera], Floats, float]:
    """Adjust cameras, focal lengths, joints and lengths of bones together."""
    current, lengths = list(cameras), expected.copy()
    focal = np.zeros(len(cameras))
    count = 7 * len(cameras)


    for _ in range(ROUNDS):
        bases = [np.hstack([pose_basis(camera), focal_basis(camera)]) for camera in current]
        matrix = np.diag(np.r_[np.tile([STEP_SD**-2.0] * 6 + [FOCAL_SD**-2.0], len(cameras)),
                               (LENGTH_SD * expected) ** -2.0])  # fmt: skip
        right = np.r_[np.zeros(count), (lengths - expected) / (LENGTH_SD * expected) ** 2]
        right[6:count:7] = focal / FOCAL_SD**2
        blocks = []
        errors = []
        for frame, own in enumerate(points):
            square, border, pull, corner, edge, off = _frame_equations(
                current, bases, seen, frame, own, lengths, count
            )
            back = np.linalg.solve(square, np.column_stack([pull, border]))
            matrix += corner - border.T @ back[:, 1:]
            right += edge - border.T @ back[:, 0]
            blocks.append(back)
            errors.append(off)
        step = -np.linalg.solve(matrix, right)
        lengths = lengths + step[count:]
        for c, basis in enumerate(bases):
            own_step = step[7 * c : 7 * c + 7]
            focal[c] += own_step[6]
            current[c] = stepped_camera(current[c], basis @ own_step)
        for frame, back in enumerate(blocks):
            points[frame] -= (back[:, 0] + back[:, 1:] @ step).reshape(-1, 3)
        if np.abs(step).max() < 1e-5:
            break
    points[np.count_nonzero(seen.used, axis=1) < 2] = np.nan
    return current, points, float(np.median(np.concatenate(errors)))


def _frame_equations(
    cameras: Sequence[Camera], bases: Sequence[Floats], seen: JointSightings, frame: int, points: Floats,
    lengths: Floats, count: int,
) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats]:  # fmt: skip
    """Return the equations of one frame's joints (3 J), their border by cameras and lengths, and the distances [px]."""
    size, total = points.size, count + len(lengths)
    twice = np.count_nonzero(seen.used[frame], axis=0) >= 2
    twice &= np.isfinite(points).all(1)
    points[~twice] = 0.0
    square, pull = 1e-3 * np.eye(size), np.zeros(size)
    border, corner, edge = np.zeros((size, total)), np.zeros((total, total)), np.zeros(total)
    distances = []
    for c, camera in enumerate(cameras):
        known = np.flatnonzero(seen.used[frame, c] & twice)
        pixels, by_point, slopes = project_with_slopes(camera, points[known])
        sd = JOINT_SD_RAD * camera.matrix[0, 0] / seen.confidence[frame, c, known]
        residual = (pixels - seen.pixels[frame, c, known]) / sd[:, None]
        good = np.isfinite(residual).all(1)
        weight = np.where(good, np.sqrt(t_weights(np.sum(np.nan_to_num(residual) ** 2, axis=1))), 0.0)
        residual = np.where(good[:, None], residual, 0.0) * weight[:, None]
        share = (weight / sd)[:, None, None]
        by_point = np.where(good[:, None, None], by_point, 0.0) * share
        by_camera = np.where(good[:, None, None], slopes, 0.0) @ bases[c] * share
        at = slice(7 * c, 7 * c + 7)
        for k, joint in enumerate(known):
            here = slice(3 * joint, 3 * joint + 3)
            square[here, here] += by_point[k].T @ by_point[k]
            pull[here] += by_point[k].T @ residual[k]
            border[here, at] += by_point[k].T @ by_camera[k]
            corner[at, at] += by_camera[k].T @ by_camera[k]
            edge[at] += by_camera[k].T @ residual[k]
        distances.append(np.linalg.norm(pixels - seen.pixels[frame, c, known], axis=1)[good])
    for b, (first, second) in enumerate(seen.bones()):
        if not (twice[first] and twice[second]):
            continue
        apart = points[first] - points[second]
        length = float(np.linalg.norm(apart))
        row, scale = np.zeros(size), 1 / BONE_SD_M
        row[3 * first : 3 * first + 3], row[3 * second : 3 * second + 3] = apart / length, -apart / length
        off = (length - lengths[b]) * scale
        weight = float(t_weights(np.array([off**2]))[0])
        square += weight * scale**2 * np.outer(row, row)
        pull += weight * scale * off * row
        border[:, count + b] -= weight * scale**2 * row
        corner[count + b, count + b] += weight * scale**2
        edge[count + b] -= weight * scale * off
    return square, border, pull, corner, edge, np.concatenate(distances)


ANKLE_HEIGHT_M = 0.08
"""Height of the centre of an ankle above the floor [m]; the mean of people."""
FLOOR_SHARE = 10.0
"""Percentile of the ankles' heights that stand on the floor. Chosen by hand."""


def _standing_world(seen: JointSightings, points: Floats) -> RigidTransform:
    """Return the transform to a world with Z up along the person, the floor at 0, and X along the shoulders."""
    place = {name: k for k, name in enumerate(seen.joint_names)}

    def middle(joint: str) -> Floats:
        return 0.5 * (points[:, place[f"left_{joint}"]] + points[:, place[f"right_{joint}"]])

    up = np.nanmedian(middle("shoulder") - middle("ankle"), axis=0)
    up /= np.linalg.norm(up)
    across = np.nanmedian(points[:, place["right_shoulder"]] - points[:, place["left_shoulder"]], axis=0)
    across -= up * (across @ up)
    across /= np.linalg.norm(across)
    rotation = np.stack([across, np.cross(up, across), up])
    ankles = np.concatenate([points[:, place[f"{side}_ankle"]] for side in ("left", "right")]) @ rotation.T
    origin = np.nanmedian(middle("hip"), axis=0) @ rotation.T
    floor = np.nanpercentile(ankles[:, 2], FLOOR_SHARE) - ANKLE_HEIGHT_M
    return RigidTransform(rotation, -np.array([origin[0], origin[1], floor]))

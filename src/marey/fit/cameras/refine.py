"""Joint refinement of cameras, motion and shape in the least squares of a capture.

The unknowns of the cameras are shared by all frames, as those of the shape are: they border the banded equations of the
poses. Rim points in front of the outlines, detected joints if given, smoothness and constant lengths of the bones
determine them together ([Plaenkers1999] for the weights; the structure is ours).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.pose import Pose
from marey.body.articulation.surface import Body
from marey.cameras.camera import Camera
from marey.cameras.parameters import PARAMETERS, focal_basis, pose_basis
from marey.fit.recipes.person import PersonSettings, SilhouetteTake
from marey.fit.recipes.sequence import DISTINCT_FRAMES, refine_sequence
from marey.fit.recipes.sequence_equations import FrameTermsFactory
from marey.fit.solver.camera_terms import CameraUnknowns
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform


@dataclass(frozen=True, kw_only=True)
class CameraPrior:
    """Standard deviations of the errors of a camera before its refinement; zero for what is known."""

    turn_rad: float = 0.0
    """Of its orientation, about each axis [rad]."""
    shift_m: float = 0.0
    """Of its position, along each axis [m]."""
    focal: float = 0.0
    """Of its focal length, relative."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RefinedCameras:
    """Cameras that were refined together with the motion."""

    cameras: tuple[Camera, ...]
    covariance: Floats
    """(15 C, 15 C) of the cameras' parameters, zero for those that were not estimated; if all were, in the world in
    which the cameras as a whole are at rest, at their scale. Misfits of body and silhouettes
    repeat between frames, so that the cameras are known no better than from `DISTINCT_FRAMES` frames."""
    poses: Mapping[int, Pose]
    body: Body
    undetermined: tuple[str, ...]
    """Cameras with an unknown whose standard deviation is not much smaller than before: the take does not determine
    it."""
    steps: tuple[float, ...]
    """Largest step of an unknown in each round, in its standard deviations before the measurement."""


def prior_basis(cameras: Sequence[Camera], priors: Sequence[CameraPrior]) -> Floats:
    """Return the changes (15 C, G) of the parameters for unknowns of standard deviation one."""
    columns = []
    for c, (camera, prior) in enumerate(zip(cameras, priors, strict=True)):
        own = np.hstack([pose_basis(camera), focal_basis(camera)])
        own = own * np.array([prior.turn_rad] * 3 + [prior.shift_m] * 3 + [prior.focal])
        own = own[:, np.any(own != 0, axis=0)]
        block = np.zeros((PARAMETERS * len(cameras), own.shape[1]))
        block[PARAMETERS * c : PARAMETERS * (c + 1)] = own
        columns.append(block)
    return np.hstack(columns)


CAMERA_ROUNDS = 8
"""Largest number of rounds, each of which matches and solves once."""
UNDETERMINED = 0.5
"""Ratio of an unknown's standard deviation to that before the measurement above which it is not determined. Chosen by
hand."""


def refine_cameras(
    take: SilhouetteTake, body: Body, poses: Mapping[int, Pose], for_shape: Sequence[int], settings: PersonSettings,
    *, priors: Sequence[CameraPrior], height: float,
    terms_of: Callable[[Sequence[Camera]], FrameTermsFactory | None] | None = None,
    rounds: int = CAMERA_ROUNDS, progress: Callable[[], object] = lambda: None,
) -> RefinedCameras:  # fmt: skip
    """Refine cameras together with the motion and the shape of a person.

    Args:
        take: Cameras and silhouettes.
        body: Body whose shape is refined.
        poses: Poses by frame.
        for_shape: Frames from which the shape is estimated; without any it is kept.
        settings: Settings of the capture.
        priors: What is known of each camera. If all are unknown, place, orientation and scale of the cameras as a whole
            are kept, which no observation of a person determines.
        height: Height of the person in the images [px].
        terms_of: Returns further observations for given cameras.
        rounds: Number of rounds.
        progress: Called after each round.

    Returns:
        The cameras, with motion and body.
    """
    cameras, body, poses = take.cameras, body, dict(poses)
    basis = prior_basis(cameras, priors)
    if all(prior.turn_rad and prior.shift_m for prior in priors):
        basis = basis @ motions_as_a_whole(basis, cameras)[1]
    offset = np.zeros(basis.shape[1])
    steps: list[float] = []
    first, last = settings.sequence.gate, settings.sequence.scale
    for round_ in range(rounds):
        share = min(round_ / max(rounds // 2, 1), 1.0)
        gate, scale = (a * (b / a) ** share for a, b in (first, last))
        own = replace(settings.sequence, gate=(gate, gate), scale=(scale, scale))
        current = replace(take, cameras=cameras)
        unknowns = CameraUnknowns(cameras=cameras, basis=basis, offset=offset, estimated=True)
        fit = refine_sequence(
            list(poses), list(poses.values()), body, current.levels(height), rate=take.rate, rounds=1,
            shape_frames=for_shape, settings=own, extra_terms=None if terms_of is None else terms_of(cameras),
            times=take.times, cameras=unknowns,
        )  # fmt: skip
        if fit.camera_step is None or fit.camera_covariance is None:
            raise ValueError("the refinement has not estimated the cameras")
        known = fit.camera_covariance
        cameras, offset = unknowns.stepped(fit.camera_step), offset + fit.camera_step
        body, poses = fit.body, fit.by_frame
        steps.append(float(np.abs(fit.camera_step).max()))
        progress()
    known = _of_distinct_frames(known, len(poses))
    covariance = basis @ known @ basis.T
    return RefinedCameras(
        cameras=cameras, covariance=covariance, poses=poses, body=body, steps=tuple(steps),
        undetermined=_undetermined(cameras, covariance, priors),
    )


def motions_as_a_whole(basis: Floats, cameras: Sequence[Camera]) -> tuple[Floats, Floats]:
    """Return the unknowns that move, turn and scale the cameras as a whole, which no person determines.

    Args:
        basis: (15 C, G) changes of the parameters per unknown.
        cameras: C cameras.

    Returns:
        (G, 7) and (G, G - 7): these seven, and an orthonormal basis of what is perpendicular to them.
    """
    middle = np.mean([camera.centre for camera in cameras], axis=0)
    motions = []
    for k in range(7):
        twist, change = np.eye(7)[k] * _SMALL, []
        world = RigidTransform(rotations.exp(twist[:3]), twist[3:6])
        for camera in cameras:
            moved = camera.moved(world)
            turn = moved.camera_from_world.rotation @ camera.camera_from_world.rotation.T
            shift = moved.centre - camera.centre + twist[6] * (camera.centre - middle)
            change.append(pose_basis(camera) @ np.r_[rotations.log(turn), shift] / _SMALL)
        motions.append(np.linalg.lstsq(basis, np.concatenate(change), rcond=None)[0])
    left, _, _ = np.linalg.svd(np.array(motions).T, full_matrices=True)
    return np.array(motions).T, np.asarray(left[:, 7:])


_SMALL = 1e-6
"""Motion of the world for numerical derivatives [rad, m]."""


def _undetermined(cameras: Sequence[Camera], covariance: Floats, priors: Sequence[CameraPrior]) -> tuple[str, ...]:
    """Return the names of the cameras whose standard deviations are not much smaller than before."""
    names = []
    for c, (camera, prior) in enumerate(zip(cameras, priors, strict=True)):
        own, inverse = covariance[PARAMETERS * c : PARAMETERS * (c + 1)], np.linalg.pinv(pose_basis(camera))
        sd = np.sqrt(np.diag(inverse @ own[:, PARAMETERS * c : PARAMETERS * (c + 1)] @ inverse.T))
        before = np.array([prior.turn_rad] * 3 + [prior.shift_m] * 3)
        if np.any(sd > UNDETERMINED * before + 1e-12):
            names.append(camera.name)
    return tuple(names)


def _of_distinct_frames(covariance: Floats, frames: int) -> Floats:
    """Return the covariance (G, G) of the unknowns if only a few frames are independent of each other."""
    before = np.eye(len(covariance))
    information = np.linalg.inv(0.5 * (covariance + covariance.T)) - before
    return np.asarray(np.linalg.inv(before + min(1.0, DISTINCT_FRAMES / frames) * information))

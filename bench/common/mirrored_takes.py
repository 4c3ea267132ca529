"""A rendered take as in a mirror: the right arm of the take becomes a left arm on which nothing was tuned.

The world is reflected by x = 0 and every image from left to right, so that cameras, videos and truth agree as before.
"""

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.geometry.rigid import RigidTransform
from marey.io.calibration.readers import read_rig, write_cameras_toml

_MIRROR = np.diag([-1.0, 1.0, 1.0])
_TANGENTIAL = 3
"""Index of the coefficient of tangential distortion that changes its sign, in OpenCV's order."""
_SYMMETRIC = 8
"""Number of coefficients of radial and tangential distortion; those of thin prisms and tilted sensors follow."""
_SIDES = (("Left", "Right"), ("left", "right"), ("l_", "r_"), ("L", "R"))
"""Beginnings of names that belong to one side."""


def mirrored_take(trial: Path, out: Path) -> Path:
    """Mirror a take with images of the empty room and the truth of an arm, unless that was done before.

    Args:
        trial: The folder of the take.
        out: The folder for the mirrored one.

    Returns:
        The folder of the mirrored take.
    """
    if (out / "truth").is_dir():
        return out
    shutil.rmtree(out, ignore_errors=True)
    (out / "background").mkdir(parents=True)
    rig = read_rig(trial / "cameras.toml")
    write_cameras_toml(Rig(tuple(mirrored_camera(camera) for camera in rig)), out / "cameras.toml")
    for video in sorted(trial.glob("*.mp4")):
        _mirror_video(video, out / f"{video.stem}.avi")
    for picture in sorted((trial / "background").glob("*.png")):
        cv2.imwrite(str(out / "background" / picture.name), cv2.flip(cv2.imread(str(picture)), 1))
    with np.load(trial / "truth" / "truth.npz") as file:
        truth = mirrored_truth(dict(file))
    (out / "unfinished").mkdir()
    np.savez_compressed(out / "unfinished" / "truth.npz", **truth)
    (out / "unfinished").rename(out / "truth")
    return out


def mirrored_camera(camera: Camera) -> Camera:
    """Return the camera that sees the mirrored world in mirrored images; its lens may be radial and tangential."""
    if len(camera.distortion) > _SYMMETRIC:
        raise ValueError(f"{camera.name} has distortion coefficients that are not mirrored here")
    matrix, distortion = np.array(camera.matrix), np.array(camera.distortion)
    matrix[0, 2] = camera.width - 1 - matrix[0, 2]
    matrix[0, 1] = -matrix[0, 1]
    if len(distortion) > _TANGENTIAL and not camera.fisheye:
        distortion[_TANGENTIAL] = -distortion[_TANGENTIAL]
    pose = camera.camera_from_world
    moved = RigidTransform(_MIRROR @ pose.rotation @ _MIRROR, _MIRROR @ pose.translation)
    return replace(camera, matrix=matrix, distortion=distortion, camera_from_world=moved)


def mirrored_truth(truth: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the truth of the mirrored take: places and rotations are reflected, left and right change names."""
    return truth | {
        "joints": truth["joints"] @ _MIRROR,
        "joint_names": np.array([_other_side(str(name)) for name in truth["joint_names"]]),
        "vertices": (truth["vertices"] @ _MIRROR).astype(truth["vertices"].dtype),
        "faces": truth["faces"][:, ::-1],
        "bone_rotation": (_MIRROR @ truth["bone_rotation"] @ _MIRROR).astype(truth["bone_rotation"].dtype),
        "limb_names": np.array([_other_side(str(name)) for name in truth["limb_names"]]),
    }


def _other_side(name: str) -> str:
    for pair in _SIDES:
        for own, other in (pair, pair[::-1]):
            if name.startswith(own) and (len(own) > 1 or name[1:2].isupper()):
                return other + name.removeprefix(own)
    return name


def _mirror_video(source: Path, target: Path) -> None:
    """Mirror a video without further compression."""
    video = cv2.VideoCapture(str(source))
    size = tuple(int(video.get(key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    writer = cv2.VideoWriter(str(target), cv2.VideoWriter.fourcc(*"FFV1"), video.get(cv2.CAP_PROP_FPS), size)
    read, picture = video.read()
    while read:
        writer.write(cv2.flip(picture, 1))
        read, picture = video.read()
    writer.release()
    video.release()

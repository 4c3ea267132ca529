"""Made cameras for tests of calibrations, and their files in the forms of other programs."""

from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform

POINTS = np.array([[0.1, 0.2, 0.3], [-0.5, 0.4, 1.2], [0.6, -0.7, 1.7], [0.0, 0.0, 0.0]])
"""Points before all cameras [m]."""


def looking_camera(
    name: str, centre: tuple[float, float, float], *, size: tuple[int, int] = (1280, 720), lens: tuple[float, ...] = ()
) -> Camera:
    """Return a camera that looks at the point (0, 0, 1) from its centre, with Z up."""
    forward = np.array([0.0, 0.0, 1.0]) - centre
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    matrix = np.array([[1000.0, 0, size[0] / 2 - 3.5], [0, 1002.0, size[1] / 2 + 2.5], [0, 0, 1]])
    pose = RigidTransform(rotation, -rotation @ centre)
    return Camera(name=name, size=size, matrix=matrix, distortion=np.array(lens), camera_from_world=pose)


def made_rig(
    names: tuple[str, ...] = ("cam01", "cam02", "cam03"), lens: tuple[float, ...] = (-0.1, 0.03, 0.001, -0.002)
) -> Rig:
    """Return cameras around the origin."""
    angles = np.linspace(0.3, 5.5, len(names))
    centres = [(4 * np.cos(angle), 4 * np.sin(angle), 1.0 + 0.3 * k) for k, angle in enumerate(angles)]
    return Rig(tuple(looking_camera(name, centre, lens=lens) for name, centre in zip(names, centres, strict=True)))


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return a quaternion, real part first, of a rotation of less than half a turn."""
    vector = rotations.log(rotation)
    angle = np.linalg.norm(vector)
    return np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * vector / angle])


def write_xcp(
    path: Path, rig: Rig, *, radial: str = "Vicon3Parameter {x} {y} 0 0 0", changes: dict[str, str] | None = None
) -> None:
    """Write the cameras as Vicon Nexus does; changes replace texts of the file."""
    cameras = []
    for camera in rig:
        w, *v = quaternion(camera.camera_from_world.rotation)
        x, y = camera.matrix[:2, 2]
        values = {
            "FOCAL_LENGTH": camera.matrix[0, 0], "FRAME": 0, "ORIENTATION": " ".join(map(repr, map(float, [*v, w]))),
            "POSITION": " ".join(map(repr, (camera.centre * 1000).tolist())), "PRINCIPAL_POINT": f"{x} {y}",
            "VICON_RADIAL2": radial.format(x=x, y=y), "WORLD_ERROR": 0.5,
        }  # fmt: skip
        frame = " ".join(f"{key}={quoteattr(str(value))}" for key, value in values.items() if value != "")
        cameras.append(
            f'<Camera DEVICEID="{camera.name}" TYPE="VideoInputDevice" PIXEL_ASPECT_RATIO="'
            f'{float(camera.matrix[0, 0] / camera.matrix[1, 1])!r}" SENSOR_SIZE="{camera.width} {camera.height}">'
            f"<KeyFrames><KeyFrame {frame}/></KeyFrames></Camera>"
        )
    text = f'<?xml version="1.0" encoding="UTF-8"?><Cameras>{"".join(cameras)}</Cameras>'
    for old, new in (changes or {}).items():
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)


def write_colmap(folder: Path, rig: Rig, *, model: str = "OPENCV", pictures: str = "{}.jpg") -> None:
    """Write cameras.txt and images.txt, whose pixels are counted from the corner of the image."""
    lenses, poses = ["# Camera list"], ["# Image list"]
    for number, camera in enumerate(rig, 1):
        (fx, _, cx), (_, fy, cy) = camera.matrix[:2].tolist()
        parameters = [fx, fy, cx + 0.5, cy + 0.5, *camera.distortion.tolist()]
        lenses.append(f"{number} {model} {camera.width} {camera.height} {' '.join(map(repr, parameters))}")
        pose = [*quaternion(camera.camera_from_world.rotation).tolist(), *camera.camera_from_world.translation.tolist()]
        poses += [f"{number} {' '.join(map(repr, pose))} {number} {pictures.format(camera.name)}", "1.0 2.0 -1"]
    (folder / "cameras.txt").write_text("\n".join(lenses) + "\n")
    (folder / "images.txt").write_text("\n".join(poses) + "\n")


def opencap_table(camera: Camera, board_from_world: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Return the arrays of a camera of OpenCap, in a world that the board defines."""
    turn = np.eye(3) if board_from_world is None else board_from_world
    rotation = camera.camera_from_world.rotation @ turn.T
    return {
        "intrinsicMat": camera.matrix.copy(),
        "distortion": np.pad(camera.distortion, (0, 5 - len(camera.distortion)))[None],
        "imageSize": np.array([[camera.height], [camera.width]]),
        "rotation": rotation,
        "translation": camera.camera_from_world.translation[:, None] * 1000,
        "rotation_EulerAngles": np.zeros((3, 1)),
    }


def assert_same_pixels(rig: Rig, other: Rig, *, tolerance: float = 1e-6) -> None:
    """Check that two rigs of equal names project points to the same pixels."""
    assert rig.names == other.names
    for one, two in zip(rig, other, strict=True):
        assert one.size == two.size
        assert np.abs(one.project(POINTS) - two.project(POINTS)).max() < tolerance

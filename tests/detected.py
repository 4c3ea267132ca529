"""Key points of made people: what a detector would find in their images, with errors that are known."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.pose import PosedBody
from marey.body.articulation.skeleton import JOINT_OF_SEGMENT
from marey.cameras.camera import Camera
from marey.io.trial.key_points import JOINTS, LAYOUTS

SEGMENTS = {joint: segment for segment, joint in JOINT_OF_SEGMENT.items()}
"""The segment that begins at a joint."""


def joints(posed: PosedBody, offsets: Floats | None = None) -> Floats:
    """Return the joint centres (J, 3), each with an offset in the frame of the segment that ends there [m]."""
    skeleton = posed.body.skeleton
    index = np.array([skeleton.segment(SEGMENTS[name]) for name in JOINTS])
    turned = posed.segment_rotation[skeleton.parents[index]]
    moved = np.zeros((len(JOINTS), 3)) if offsets is None else offsets
    return posed.segment_origin[index] + np.einsum("jab,jb->ja", turned, moved)


def detections(
    people: Sequence[Sequence[PosedBody | None]], cameras: Sequence[Camera], *, noise: float = 0.0,
    rng: np.random.Generator | None = None, offsets: Floats | None = None, confidence: float = 1.0,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Detect the joints of people in every image.

    Args:
        people: For each person the posed body of each frame, None where the person is away.
        cameras: C cameras.
        noise: Standard deviation of the pixels [px].
        rng: Generator of the noise.
        offsets: (J, 3) of the detected joints from the true ones [m].
        confidence: The detector's confidence.

    Returns:
        Pixels (F, C, P, J, 2) and confidence (F, C, P, J); person p is in place p.
    """
    shape = (len(people[0]), len(cameras), len(people), len(JOINTS))
    pixels, sure = np.full((*shape, 2), np.nan), np.zeros(shape)
    for p, motion in enumerate(people):
        for frame, posed in enumerate(motion):
            if posed is not None:
                places = joints(posed, offsets)
                pixels[frame, :, p] = [camera.project(places) for camera in cameras]
                sure[frame, :, p] = confidence
    if rng is not None:
        pixels += rng.normal(size=pixels.shape) * noise
    return pixels, sure


def openpose(pixels: Floats, confidence: float = 0.9, *, layout: int = 26) -> dict:
    """Return the person of joints (J, 2) as OpenPose writes it; points without a pixel are 0, 0, 0.

    A point of which a joint is only a part, such as a shoulder of the neck, is that of its own joint.
    """
    points = np.zeros((layout, 3))
    for joint, which in sorted(LAYOUTS[layout][1].items(), key=lambda item: -len(item[1])):
        row = pixels[JOINTS.index(joint)]
        if np.isfinite(row).all():
            points[list(which)] = [*row, confidence]
    return {"pose_keypoints_2d": points.ravel().tolist()}


def write_folder(folder: Path, cameras: Sequence[str], people: Sequence[Sequence[Sequence[dict]]]) -> Path:
    """Write the persons of each frame and camera as OpenPose does."""
    for frame, views in enumerate(people):
        for camera, persons in zip(cameras, views, strict=True):
            path = folder / f"{camera}_json" / f"{camera}_{frame:06d}.json"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps({"version": 1.3, "people": list(persons)}))
    return folder

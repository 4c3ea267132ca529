"""What a drawn body says of an image: its parts, the prior of its silhouette, and textures inside it."""

import cv2
import numpy as np

from marey.arrays import Floats, Image, Integers, Mask, frozen
from marey.body.articulation.pose import PosedBody
from marey.cameras.camera import Camera
from marey.images.boxes import box_about
from marey.images.features.texture import texture_cells
from marey.observations.correspondence import view_of

LEAST_SD_PX = 1.5
"""Least standard deviation of the outline from the drawn body [px]. Chosen by hand."""
STEEPNESS, STRONGEST = 1.7, 6.0
"""Slope of the prior: the log-likelihood ratio per standard deviation of distance, which makes the logistic function
resemble the normal distribution's; and the largest ratio. Values of the preliminary study; others were not measured."""
TEXTURE_MARGIN = 24
"""Width of the surroundings that are used for the textures inside the body [px]. With it, up to 0.3 % of the cells in
images of three takes differ from those that the whole image gives; with 16, up to 1.3 %."""


def length_px(posed: PosedBody, camera: Camera, length_m: float) -> float:
    """Return a length at the body in pixels of a camera, at least `LEAST_SD_PX`."""
    distance = np.linalg.norm(posed.segment_origin.mean(axis=0) - camera.centre)
    return float(max(length_m * camera.matrix[0, 0] / distance, LEAST_SD_PX))


def part_map(posed: PosedBody, camera: Camera) -> Integers:
    """Return the part of the body at each pixel of an image (height, width); -1 outside."""
    view = view_of(posed, camera)
    parts = np.full((camera.height, camera.width), -1, np.int16)
    x, y = view.corner
    height, width = view.face.shape
    parts[y : y + height, x : x + width] = np.where(view.face >= 0, posed.body.face_colour_part[view.face], -1)
    return frozen(parts, np.int64)


def outline_prior(parts: Integers, deviations: Floats) -> Floats:
    """Return the prior of a silhouette about a drawn body, [Rosenhahn2006] eq. (4).

    Unlike the paper, its weight is not a constant: it is inversely proportional to the standard deviation of the
    outline of the nearest part.

    Args:
        parts: (H, W) part at each pixel of the drawn body; -1 outside. The body must not be empty.
        deviations: (P,) standard deviation of each part's outline [px].

    Returns:
        (H, W) log-likelihood ratio, positive inside.
    """
    slopes = (STEEPNESS / deviations).astype(np.float32)
    prior = np.full(parts.shape, -STRONGEST, np.float32)
    box = box_about(parts >= 0, STRONGEST / float(slopes[np.unique(parts[parts >= 0])].min()) + 2)
    parts = parts[box]
    inside = parts >= 0
    outside = np.ascontiguousarray(~inside).view(np.uint8)
    away, nearest = cv2.distanceTransformWithLabels(outside, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    part_of = np.zeros(int(nearest.max()) + 1, np.int16)
    part_of[nearest[inside]] = parts[inside]
    depth = cv2.distanceTransform(np.ascontiguousarray(inside).view(np.uint8), cv2.DIST_L2, 3)
    prior[box] = np.clip((depth - away) * slopes[part_of[nearest]], -STRONGEST, STRONGEST)
    return prior


def cells_inside(picture: Image, inside: Mask) -> Integers:
    """Return the texture cell of each pixel (height, width) inside a region; -1 outside."""
    cells = np.full(inside.shape, -1, np.int16)
    if inside.any():
        box = box_about(inside, TEXTURE_MARGIN)
        own = texture_cells(np.ascontiguousarray(picture[box])).astype(np.int16)
        cells[box] = np.where(inside[box], own, -1)
    return np.asarray(cells)

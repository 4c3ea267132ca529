"""First answers in perspective: depths from distances that stay, and the iterative extension of factorisation."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.nonrigid.core.completion import complete_tracks
from marey.nonrigid.core.metric_upgrade import rotation_candidates
from marey.nonrigid.core.rotation_paths import MIRROR
from marey.nonrigid.core.smooth_shapes import smooth_shapes
from marey.nonrigid.in_space.factorisation import factorise_points
from marey.nonrigid.one_camera.inextensible import inextensible_depths
from marey.nonrigid.one_camera.perspective_model import PerspectiveModel, begin, improve

RANKS = (1, 2, 3)
"""Numbers of basis shapes for which rotations are sought without perspective; the others follow in perspective."""
COMPLETING_RANK = 15
FILLING_RANK = 6
RIGID_ROUNDS = 15
EXTENSIONS = 2
"""Times that depths correct the tracks and the corrected tracks give shapes."""
ROUNDS = 8
FIRST_NOISE = 0.02
"""In shares of the object's size in the image, for the rigid answer."""
NEAREST = 0.05
"""A depth below this share of the mean depth is no answer."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Start:
    """Poses and shapes to refine."""

    rotation: Floats
    """(F, 3, 3) camera from object."""
    shift: Floats
    """(F, 3)."""
    shapes: Floats
    """(F, 3, P) in the object's frame."""

    def mirrored(self) -> "Start":
        """Give the other answer that an orthographic camera would not tell from this one."""
        return Start(rotation=MIRROR @ self.rotation @ MIRROR, shift=self.shift, shapes=MIRROR @ self.shapes)

    def usable(self) -> bool:
        """Tell whether all points lie well before the camera."""
        depth = (self.rotation @ self.shapes)[:, 2] + self.shift[:, 2:]
        return bool(np.isfinite(self.shapes).all() and depth.min() > NEAREST * depth.mean() > 0)


def start_of(model: PerspectiveModel) -> Start:
    """Take a model's answer as a start."""
    return Start(rotation=model.rotation, shift=model.shift, shapes=model.shapes)


def inextensible_start(known: Floats, seen: Mask, pairs: Integers) -> Start:
    """Start from depths that keep the distances of neighbours, gaps filled by a low rank in space.

    Args:
        known: (F, 2, P) normalised image coordinates, of any value where not seen.
        seen: (F, P).
        pairs: (E, 2) neighbours.
    """
    rays = np.concatenate([known, np.ones_like(known[:, :1])], 1)
    depth = inextensible_depths(rays, seen, pairs)[0]
    points = rays * (depth / np.nanmean(depth))[:, None]
    found = factorise_points(np.swapaxes(points, 1, 2), rank=min(FILLING_RANK, len(known) // 3))
    shapes = np.swapaxes(found.rotation, 1, 2) @ (points - found.translation[:, :, None])
    shapes = np.where(np.isfinite(shapes), shapes, found.shape)
    return Start(rotation=found.rotation, shift=found.translation, shapes=shapes)


def affine_starts(known: Floats, seen: Mask, modes: int) -> Iterator[Start]:
    """Start from rotations without perspective, from both signs of depth, and carry perspective in step by step.

    The iterative extension of [Alexander2003] section 2.4: a rigid answer in perspective gives depths; tracks times
    depths are what an orthographic camera of one scale would see ([Christy1996]); they give shapes, and these better
    depths. Here the model is refined in perspective between two such steps.

    Args:
        known: (F, 2, P) normalised image coordinates, of any value where not seen.
        seen: (F, P).
        modes: number of displacements.
    """
    weight = seen.astype(float)
    middle = (known * weight[:, None]).sum(2) / weight.sum(1)[:, None]
    centred = np.where(seen[:, None], known - middle[:, :, None], 0)
    size = float(np.sqrt((centred**2).sum() / (2 * weight.sum())))
    complete = centred / size if seen.all() else complete_tracks(centred / size, seen, COMPLETING_RANK)[0]
    shift = np.concatenate([middle, np.ones((len(known), 1))], 1)
    for _, rotation in rotation_candidates(complete, RANKS):
        shapes = np.broadcast_to((smooth_shapes(complete, rotation) * size).mean(0), (len(known), 3, known.shape[2]))
        flat = Start(rotation=rotation, shift=shift, shapes=shapes)
        for start in (flat, flat.mirrored()):
            if start.usable():
                yield from _extended(start, known, weight, complete * size + middle[:, :, None], size, modes)


def _extended(
    start: Start, known: Floats, weight: Floats, complete: Floats, size: float, modes: int
) -> Iterator[Start]:
    none = np.zeros((0, 2), int)
    try:
        model = begin(start.rotation, start.shift, start.shapes, 0, FIRST_NOISE * size, none)
        improve(model, known, weight, RIGID_ROUNDS, 1e-6 * size)
        for _ in range(EXTENSIONS):
            points = model.points
            seen_there = np.where(weight[:, None] > 0, known, complete)
            corrected = seen_there * points[:, 2:]
            shapes = smooth_shapes(corrected - corrected.mean(2, keepdims=True), model.rotation)
            model = begin(model.rotation, model.shift, shapes, modes, float(np.sqrt(model.variance)), none)
            improve(model, known, weight, ROUNDS, 1e-6 * size)
    except np.linalg.LinAlgError:
        return
    found = start_of(model)
    if found.usable():
        yield found

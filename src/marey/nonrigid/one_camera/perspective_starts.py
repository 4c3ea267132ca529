"""Initial solutions in perspective: depths from constant distances, and the iterative extension of factorisation."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.nonrigid.core.completion import COMPLETION_RANK, complete_tracks
from marey.nonrigid.core.metric_upgrade import MetricUpgradeSettings, rotation_candidates
from marey.nonrigid.core.rotation_paths import MIRROR
from marey.nonrigid.core.smooth_shapes import smooth_shapes
from marey.nonrigid.in_space.factorisation import factorise_points
from marey.nonrigid.one_camera.inextensible import InextensibleSettings, inextensible_depths
from marey.nonrigid.one_camera.perspective_model import PerspectiveModel, initial_model, refine

_NEAREST = 0.05
"""Initial solutions with a depth below this fraction of the mean depth are rejected. Chosen by hand; results were not
measured against other values."""
_LEAST_NOISE = 1e-6
"""Least standard deviation of the noise, as a fraction of the object's size in the image; keeps exact data solvable."""


@dataclass(frozen=True, kw_only=True)
class PerspectiveStartSettings:
    """Settings of the initial solutions; chosen by hand, results were not measured against other values."""

    upgrade: MetricUpgradeSettings = field(default_factory=lambda: MetricUpgradeSettings(ranks=(1, 2, 3)))
    """Settings of the search for rotations without perspective; further basis shapes follow in perspective."""
    completion_rank: int = COMPLETION_RANK
    """Rank, beside the translation, of the completed tracks from which rotations are computed."""
    filling_rank: int = 6
    """Number of basis shapes with which missing points are predicted in space."""
    rigid_rounds: int = 15
    """Number of rounds of expectation maximisation of the rigid solution."""
    extensions: int = 2
    """Number of times that depths correct the tracks and the corrected tracks give shapes."""
    rounds: int = 8
    """Number of rounds of expectation maximisation in each extension."""
    initial_noise: float = 0.02
    """Initial standard deviation of the noise for the rigid solution, as a fraction of the object's size in the
    image."""
    depths: InextensibleSettings = field(default_factory=InextensibleSettings)
    """Settings of the depths from constant distances."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PerspectiveStart:
    """Initial poses and shapes."""

    rotation: Floats
    """(F, 3, 3) camera from object."""
    shift: Floats
    """(F, 3) object's origin in camera axes."""
    shapes: Floats
    """(F, 3, P) in the object's frame."""

    def mirrored(self) -> "PerspectiveStart":
        """Mirror depth; an orthographic camera does not distinguish the two solutions."""
        return PerspectiveStart(rotation=MIRROR @ self.rotation @ MIRROR, shift=self.shift, shapes=MIRROR @ self.shapes)

    def usable(self) -> bool:
        """Check whether all points lie well in front of the camera."""
        depth = (self.rotation @ self.shapes)[:, 2] + self.shift[:, 2:]
        return bool(np.isfinite(self.shapes).all() and depth.min() > _NEAREST * depth.mean() > 0)


def start_of(model: PerspectiveModel) -> PerspectiveStart:
    """Convert a model to an initial solution."""
    return PerspectiveStart(rotation=model.rotation, shift=model.shift, shapes=model.shapes)


def inextensible_start(
    known: Floats, seen: Mask, pairs: Integers, settings: PerspectiveStartSettings = PerspectiveStartSettings()
) -> PerspectiveStart:
    """Compute an initial solution from constant distances between neighbours, with gaps filled by a low rank in space.

    Args:
        known: (F, 2, P) normalised image coordinates, with arbitrary values where not seen.
        seen: (F, P).
        pairs: (E, 2) neighbouring points.
        settings: Tuned constants.
    """
    rays = np.concatenate([known, np.ones_like(known[:, :1])], 1)
    depth = inextensible_depths(rays, seen, pairs, settings.depths)[0]
    points = rays * (depth / np.nanmean(depth))[:, None]
    found = factorise_points(np.swapaxes(points, 1, 2), rank=min(settings.filling_rank, len(known) // 3))
    shapes = np.swapaxes(found.rotation, 1, 2) @ (points - found.translation[:, :, None])
    shapes = np.where(np.isfinite(shapes), shapes, found.shape)
    return PerspectiveStart(rotation=found.rotation, shift=found.translation, shapes=shapes)


def affine_starts(
    known: Floats, seen: Mask, modes: int, settings: PerspectiveStartSettings = PerspectiveStartSettings()
) -> Iterator[PerspectiveStart]:
    """Compute initial solutions from rotations without perspective, for both signs of depth.

    The iterative extension of [Alexander2003] section 2.4: a rigid solution in perspective gives depths; tracks times
    depths are the image of an orthographic camera of constant scale ([Christy1996]); they give shapes, and these better
    depths. Here the model is refined in perspective between two such steps.

    Args:
        known: (F, 2, P) normalised image coordinates, with arbitrary values where not seen.
        seen: (F, P).
        modes: Number of deformation modes.
        settings: Tuned constants.

    Yields:
        Initial solutions with all points in front of the camera.
    """
    weight = seen.astype(float)
    middle = (known * weight[:, None]).sum(2) / weight.sum(1)[:, None]
    centred = np.where(seen[:, None], known - middle[:, :, None], 0)
    size = float(np.sqrt((centred**2).sum() / (2 * weight.sum())))
    complete = centred / size if seen.all() else complete_tracks(centred / size, seen, settings.completion_rank)[0]
    shift = np.concatenate([middle, np.ones((len(known), 1))], 1)
    for _, rotation in rotation_candidates(complete, settings.upgrade):
        shapes = np.broadcast_to((smooth_shapes(complete, rotation) * size).mean(0), (len(known), 3, known.shape[2]))
        flat = PerspectiveStart(rotation=rotation, shift=shift, shapes=shapes)
        for start in (flat, flat.mirrored()):
            if start.usable():
                whole = complete * size + middle[:, :, None]
                yield from _extended(start, known, weight, whole, size, modes, settings)


def _extended(
    start: PerspectiveStart,
    known: Floats,
    weight: Floats,
    complete: Floats,
    size: float,
    modes: int,
    settings: PerspectiveStartSettings,
) -> Iterator[PerspectiveStart]:
    """Extend a rigid orthographic solution to perspective; yields nothing where this fails."""
    none = np.zeros((0, 2), int)
    try:
        model = initial_model(start.rotation, start.shift, start.shapes, 0, settings.initial_noise * size, none)
        refine(model, known, weight, settings.rigid_rounds, _LEAST_NOISE * size)
        for _ in range(settings.extensions):
            points = model.points
            seen_there = np.where(weight[:, None] > 0, known, complete)
            corrected = seen_there * points[:, 2:]
            shapes = smooth_shapes(corrected - corrected.mean(2, keepdims=True), model.rotation)
            model = initial_model(model.rotation, model.shift, shapes, modes, float(np.sqrt(model.variance)), none)
            refine(model, known, weight, settings.rounds, _LEAST_NOISE * size)
    except np.linalg.LinAlgError:
        return
    found = start_of(model)
    if found.usable():
        yield found

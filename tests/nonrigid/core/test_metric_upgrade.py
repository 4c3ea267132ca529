"""Rotations from the tracks of a rigid and of a deforming shape."""

import numpy as np
import pytest

from marey.geometry import rotations
from marey.nonrigid.core.metric_upgrade import MetricUpgradeSettings, rotation_candidates


@pytest.mark.parametrize("modes", [0, 2])
def test_the_rotations_of_exact_tracks_are_found_but_for_axes_and_depth(rng, modes):
    frames, points = 120, 20
    path = rotations.exp(np.cumsum(0.1 * rng.normal(size=(frames, 3)), 0))
    shapes = rng.normal(size=(3, points)) + np.einsum(
        "fm,mip->fip", 0.3 * rng.normal(size=(frames, modes)), rng.normal(size=(modes, 3, points))
    )
    shapes = np.broadcast_to(shapes, (frames, 3, points))
    shapes = shapes - shapes.mean(2, keepdims=True)
    found = dict(rotation_candidates((path @ shapes)[:, :2]))
    nearest = []
    for rotation in found.values():
        for mirror in (np.eye(3), np.diag([1.0, 1, -1])):
            seen = mirror @ rotation @ mirror
            axes = rotations.mean(np.swapaxes(seen, 1, 2) @ path)
            nearest.append(np.linalg.norm(rotations.log(seen @ axes @ np.swapaxes(path, 1, 2)), axis=1).max())
    assert min(nearest) < 1e-4


def test_the_rotations_turn_with_the_axes_of_the_image(rng):
    frames, points = 60, 20
    path = rotations.exp(np.cumsum(0.1 * rng.normal(size=(frames, 3)), 0))
    shapes = rng.normal(size=(3, points)) + 0.2 * rng.normal(size=(frames, 3, points))
    tracks = (path @ (shapes - shapes.mean(2, keepdims=True)))[:, :2]
    turn = rotations.about(np.array([0.0, 0.0, 1.0]), 0.65)
    once = MetricUpgradeSettings(ranks=(2,), random_starts=0)
    _, found = next(rotation_candidates(tracks, once))
    _, turned = next(rotation_candidates(turn[:2, :2] @ tracks, once))
    axes = np.swapaxes(turn @ found, 1, 2) @ turned
    assert np.allclose(axes, axes[0], atol=1e-6)

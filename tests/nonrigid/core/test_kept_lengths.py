"""Constant distances: selection of pairs, derivatives, and a gain in depth."""

import numpy as np
import pytest

from marey.geometry import rotations
from marey.nonrigid.core.deforming_model import initial_model, refine
from marey.nonrigid.core.kept_lengths import (
    choose_lengths,
    cost,
    departures,
    derivatives,
    point_equations,
    weight_equations,
)

STEP = 1e-6


@pytest.fixture
def scissors(rng):
    """Two rigid blades of eight points each that open and close about a joint: shapes (F, 3, P)."""
    frames = 80
    blades = rng.normal(size=(2, 3, 8))
    angle = 0.5 * np.sin(np.arange(frames) / 8)
    turns = rotations.exp(angle[:, None] * np.array([0.3, 1.0, 0.2]))
    shapes = np.concatenate([np.broadcast_to(blades[0], (frames, 3, 8)), turns @ blades[1]], 2)
    return shapes - shapes.mean(2, keepdims=True)


def test_the_pairs_of_one_rigid_part_are_selected(scissors):
    kept = choose_lengths(scissors)
    assert (kept.pairs[:, 0] < 8).tolist() == (kept.pairs[:, 1] < 8).tolist()
    np.testing.assert_allclose(departures(kept, scissors)[0], 0, atol=1e-9)


def test_derivatives_by_the_weights_agree_with_differences(scissors, rng):
    modes, kept = rng.normal(size=(3, 3, 16)), choose_lengths(scissors)
    along = departures(kept, scissors)[1]
    found = derivatives(kept, along, modes)
    for m in range(3):
        ahead, behind = (departures(kept, scissors + sign * STEP * modes[m])[0] for sign in (1, -1))
        np.testing.assert_allclose(found[..., m], (ahead - behind) / (2 * STEP), atol=1e-7)


def test_right_sides_are_minus_the_costs_gradient(scissors, rng):
    modes, kept = rng.normal(size=(2, 3, 16)), choose_lengths(scissors)
    shapes = scissors + 0.1 * rng.normal(size=scissors.shape)
    by_weight, by_point = weight_equations(kept, shapes, modes)[1], point_equations(kept, shapes)[1]
    for change, found in ((modes[0], by_weight[5, 0]), (np.eye(3)[:, :1] * (np.arange(16) == 4), by_point[5, 0, 4])):
        moved = np.zeros_like(shapes)
        moved[5] = STEP * change
        slope = (cost(kept, shapes + moved) - cost(kept, shapes - moved)) / (2 * STEP)
        assert found == pytest.approx(-slope, rel=1e-5)


def test_constant_distances_improve_depth_before_a_slow_camera(scissors, rng):
    path = rotations.exp(0.012 * np.arange(len(scissors))[:, None] * np.array([0.1, 0.2, 1.0]))
    tracks = (path @ scissors)[:, :2] + 0.01 * rng.normal(size=(len(scissors), 2, 16))
    tracks = tracks - tracks.mean(2, keepdims=True)
    seen = np.ones((len(scissors), 16))
    rough = scissors + 0.15 * (scissors.mean(0) - scissors) + 0.05 * rng.normal(size=(3, 16))
    errors = []
    for held in (False, True):
        model = initial_model(tracks, seen, path, rough, 4, 0.01)
        refine(model, tracks, seen, 6)
        model.lengths = choose_lengths(model.shapes) if held else None
        refine(model, tracks, seen, 10)
        errors.append(np.sqrt(np.mean((model.rotation @ model.shapes - path @ scissors) ** 2)))
    assert errors[1] < 0.9 * errors[0]

"""Poses of a wand from places of its points."""

import numpy as np
from tests.made_wands import WAND

from marey.calibration.adjustment.wand_start import wand_poses
from marey.geometry import rotations


def placed(rng, count):
    """Return poses of wands in as many pictures, and the places of their points."""
    rotation = rotations.exp(rng.normal(size=(count, 3)) * 2.0)
    translation = rng.normal(size=(count, 3))
    return rotation, translation, np.einsum("fij,pj->fpi", rotation, WAND.points) + translation[:, None]


def test_a_wand_lies_where_its_points_are(rng):
    rotation, translation, points = placed(rng, 30)
    points[::3, 0] = np.nan
    found = wand_poses(WAND, points)
    assert found[2].all()
    # Points of a stick do not show how far it is turned about itself.
    np.testing.assert_allclose(found[0][:, :, 0], rotation[:, :, 0], atol=1e-9)
    np.testing.assert_allclose(found[1], translation, atol=1e-9)
    identity = np.broadcast_to(np.eye(3), (30, 3, 3))
    np.testing.assert_allclose(found[0] @ np.swapaxes(found[0], 1, 2), identity, atol=1e-9)


def test_the_most_likely_line_through_noisy_points_is_taken(rng):
    _, _, points = placed(rng, 1)
    noisy = points + rng.normal(size=points.shape) * 0.004
    rotation, translation, known = wand_poses(WAND, noisy)
    assert known.all()

    def squares(turn, shift):
        return float(np.sum((WAND.points @ turn.T + shift - noisy[0]) ** 2))

    least = squares(rotation[0], translation[0])
    for step in rng.normal(size=(50, 6)) * 1e-3:
        assert squares(rotations.exp(step[:3]) @ rotation[0], translation[0] + step[3:]) > least


def test_pictures_without_two_points_or_with_other_lengths_have_no_pose(rng):
    _, _, points = placed(rng, 5)
    points[0, 1:] = np.nan
    points[1] = np.nan
    points[2] *= 3.0
    points[3] = points[3, :1]
    assert list(wand_poses(WAND, points)[2]) == [False, False, False, False, True]

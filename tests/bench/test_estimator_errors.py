"""Errors of knee angles are those of all frames in which the bones are known."""

import numpy as np
from bench.markers.estimator import knee

from marey.geometry import rotations


def test_a_frame_without_bones_hides_no_other_frame():
    flexion = np.linspace(0.0, 4.0, 9)
    shank = rotations.exp(flexion[:, None] * np.array([0.0, 0.0, 1.0]))
    shank[3] = np.nan
    angles = knee(np.broadcast_to(np.eye(3), (9, 3, 3)), shank)
    known = np.arange(9) != 3
    np.testing.assert_allclose(angles[known, 0], flexion[known], atol=1e-12)
    assert np.isnan(angles[3]).all()

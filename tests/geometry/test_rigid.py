"""Laws of rigid motions and twists; the scales of rotation and translation are drawn apart."""

import numpy as np
import pytest
import scipy.linalg
from tests.reference_twists import adjoint, exp, log

from marey.geometry import rotations, twists
from marey.geometry.rigid import RigidTransform

SCALES = [(r, t) for r in (1e-12, 1e-6, 9e-3, 1.0, 3.0) for t in (1e-6, 1.0, 200.0)]


@pytest.mark.parametrize(("turn", "shift"), SCALES)
def test_the_exponential_of_a_twist_is_the_matrix_exponential(rng, turn, shift):
    w = rng.normal(size=3)
    twist = np.concatenate([rng.normal(size=3) * shift, w / np.linalg.norm(w) * turn])
    matrix = np.zeros((4, 4))
    matrix[:3, :3], matrix[:3, 3] = rotations.hat(twist[3:]), twist[:3]
    np.testing.assert_allclose(exp(twist), scipy.linalg.expm(matrix), atol=1e-13 * max(1, shift))
    np.testing.assert_allclose(log(exp(twist)), twist, rtol=1e-8, atol=1e-12 * max(1, shift))


def test_a_joint_leaves_the_points_of_its_axis_where_they_are(rng):
    point, axis = rng.normal(size=3), np.array([0.6, 0.0, 0.8])
    motion = exp(twists.about_axis(point, axis) * 1.3)
    for along in (0.0, -2.0, 5.0):
        on_axis = np.append(point + along * axis, 1.0)
        np.testing.assert_allclose(motion @ on_axis, on_axis, atol=1e-14)


def test_transforms_are_a_group_and_the_adjoint_carries_twists(rng):
    a = RigidTransform.from_vector(rng.normal(size=3), rng.normal(size=3) * 10)
    b = RigidTransform.from_vector(rng.normal(size=3), rng.normal(size=3))
    points = rng.normal(size=(5, 3))
    np.testing.assert_allclose((a @ b).apply(points), a.apply(b.apply(points)), atol=1e-13)
    np.testing.assert_allclose((a @ a.inverse()).matrix, np.eye(4), atol=1e-14)
    twist = rng.normal(size=6) * 0.3
    np.testing.assert_allclose(
        a.matrix @ exp(twist),
        exp(adjoint(a) @ twist) @ a.matrix,
        atol=1e-13,
    )


def test_a_transform_does_not_change_with_the_arrays_it_was_made_from():
    translation = np.zeros(3)
    transform = RigidTransform(np.eye(3), translation)
    translation[0] = 1.0
    assert transform.translation[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        transform.translation[0] = 1.0

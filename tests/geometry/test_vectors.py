import numpy as np

from marey.geometry.vectors import SHORTEST, unit, unit_or_zero


def test_vectors_have_length_one_and_keep_their_direction(rng):
    vectors = rng.normal(size=(4, 5, 3))
    for scaled in (unit(vectors), unit_or_zero(vectors)):
        np.testing.assert_allclose(np.linalg.norm(scaled, axis=-1), 1)
        np.testing.assert_allclose(np.cross(scaled, vectors), 0, atol=1e-12)
        assert ((scaled * vectors).sum(-1) > 0).all()


def test_a_vector_without_length_stays_zero():
    vectors = np.array([[0.0, 0, 0], [0.1 * SHORTEST, 0, 0], [0, 3, 4]])
    np.testing.assert_allclose(unit_or_zero(vectors), [[0, 0, 0], [0.1, 0, 0], [0, 0.6, 0.8]])

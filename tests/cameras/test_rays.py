import numpy as np

from marey.cameras.rays import PluckerLines


def test_the_distance_is_that_of_the_perpendicular(rng):
    start, direction = rng.normal(size=(50, 3)), rng.normal(size=(50, 3))
    lines = PluckerLines.through(start, direction)
    along = start + rng.normal(size=(50, 1)) * direction
    side = np.cross(direction, rng.normal(size=(50, 3)))
    side *= rng.uniform(0, 2, (50, 1)) / np.linalg.norm(side, axis=1, keepdims=True)
    assert np.allclose(lines.distances(along + side), np.linalg.norm(side, axis=1))
    nearest_to_origin = np.cross(lines.directions, lines.moments)
    assert np.allclose(lines.distances(nearest_to_origin), 0, atol=1e-12)


def test_lines_can_be_picked():
    lines = PluckerLines.through(np.zeros(3), np.eye(3))
    assert len(lines) == 3
    assert np.array_equal(lines[1:].directions, np.eye(3)[1:])

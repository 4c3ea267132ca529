"""A subdivided skin has the same shape."""

import numpy as np
import pytest

from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.subdivision import divided_faces, edges_of, subdivided
from marey.body.metaballs.metaball_person import metaball_body, metaball_space


@pytest.fixture(scope="module")
def body():
    from marey.body.people.person import family_body

    return metaball_body(metaball_space("simple"), template=family_body("coarse"))


def test_a_closed_surface_stays_closed(body):
    faces = divided_faces(body.faces, len(body.vertices))
    assert len(faces) == 4 * len(body.faces)
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert len(np.unique(directed, axis=0)) == len(directed)
    assert len(edges_of(faces)[0]) * 2 == len(directed)


def test_old_vertices_stay_and_new_ones_lie_between(body, rng):
    fine = subdivided(body)
    np.testing.assert_array_equal(fine.vertices[: len(body.vertices)], body.vertices)
    edges, _ = edges_of(body.faces)
    np.testing.assert_allclose(fine.vertices[len(body.vertices) :], body.vertices[edges].mean(1))
    np.testing.assert_allclose(fine.vertex_weights.sum(1), 1.0)
    pose = Pose(np.zeros(3), np.eye(3), rng.normal(size=len(body.skeleton) - 6) * 0.3)
    np.testing.assert_allclose(
        PosedBody(fine, pose).vertices[: len(body.vertices)], PosedBody(body, pose).vertices, atol=1e-12
    )
    assert len(fine.space) == 0

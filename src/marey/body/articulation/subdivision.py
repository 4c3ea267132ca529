"""Subdivision of a body's skin: every triangle is divided into four, and its corners stay in place."""

from dataclasses import replace

import numpy as np

from marey.arrays import Floats, Integers
from marey.body.articulation.surface import Body, ShapeSpace


def edges_of(faces: Integers) -> tuple[Integers, Integers]:
    """List the edges of triangles.

    Args:
        faces: (T, 3).

    Returns:
        (E, 2) vertices of each edge; (T, 3) the edges of each triangle, between corners 0-1, 1-2 and 2-0.
    """
    pairs = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, which = np.unique(pairs, axis=0, return_inverse=True)
    return edges, which.reshape(-1, 3)


def divided_faces(faces: Integers, count: int) -> Integers:
    """Divide triangles (T, 3) of `count` vertices into four each; the edges' midpoints follow the vertices."""
    _, middle = edges_of(faces)
    a, b, c = faces.T
    ab, bc, ca = (middle + count).T
    return np.stack([np.stack(part, 1) for part in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))], 1).reshape(
        -1, 3
    )  # fmt: skip


def subdivided(body: Body) -> Body:
    """Return a body with four times as many triangles and no shape parameters, for drawing."""
    edges, _ = edges_of(body.faces)
    vertices = np.concatenate([body.vertices, body.vertices[edges].mean(1)])
    segments, weights = _with_middles(body, edges)
    bare = ShapeSpace(
        names=(), vertex_mean=vertices, vertex_modes=np.zeros((0, *vertices.shape)), joint_mean=body.joint_centres,
        joint_modes=np.zeros((0, *body.joint_centres.shape)), prior_mean=np.zeros(0), prior_covariance=np.zeros((0, 0)),
    )  # fmt: skip
    return replace(
        body, space=bare, numbers=np.zeros(0), faces=divided_faces(body.faces, len(body.vertices)),
        vertex_segments=segments, vertex_weights=weights, metaballs=None, numbers_covariance=None,
        outlined=None if body.outlined is None else np.repeat(body.outlined, 4),
    )  # fmt: skip


def _with_middles(body: Body, edges: Integers) -> tuple[Integers, Floats]:
    """Return segments and weights (V + E, 4) of the vertices and the midpoints of edges (E, 2)."""
    whole = np.zeros((len(body.vertices), len(body.skeleton.segment_names)))
    np.put_along_axis(whole, body.vertex_segments, 0.0, 1)
    for column in range(body.vertex_segments.shape[1]):
        rows = np.arange(len(whole))
        whole[rows, body.vertex_segments[:, column]] += body.vertex_weights[:, column]
    middle = whole[edges].mean(1)
    order = np.argsort(-middle, axis=1, kind="stable")[:, :4]
    weights = np.take_along_axis(middle, order, 1)
    return (
        np.concatenate([body.vertex_segments, order]),
        np.concatenate([body.vertex_weights, weights / weights.sum(1, keepdims=True)]),
    )

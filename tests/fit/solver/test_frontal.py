"""The frontal factorisation against dense linear algebra."""

import numpy as np
import pytest

from marey.fit.solver.frontal import FrameGroups, FrontalFactor

FRAMES, DEGREES, WIDTH = 7, 3, 2
SPANS = {0: [0, 1, 2], 1: [0, 6], 2: [3], 3: [2, 3, 4], 4: [5, 6], 5: [1, 2, 3, 4, 5, 6]}
"""Frames of each group: neighbours, a gap, a single one, one that takes the place of another, and nearly all."""


def random_equations(rng, spans):
    """Random equations of the factor's form, and the same matrix dense: the poses first, then the groups."""
    poses, size = FRAMES * DEGREES, FRAMES * DEGREES + len(spans) * WIDTH
    dense = np.zeros((size, size))
    own = np.tile(0.3 * np.eye(WIDTH), (len(spans), 1, 1))
    members = [np.array([g for g, frames in spans.items() if f in frames], int) for f in range(FRAMES)]
    by_pose = [np.zeros((DEGREES, len(each), WIDTH)) for each in members]
    for g in spans:
        dense[poses + g * WIDTH :, poses + g * WIDTH :][:WIDTH, :WIDTH] += own[g]
    for f in range(FRAMES):
        span = list(range(f * DEGREES, min(f + 3, FRAMES) * DEGREES))
        rows = rng.normal(size=(12, len(span)))
        dense[np.ix_(span, span)] += rows.T @ rows
        for n, g in enumerate(members[f]):
            rows = rng.normal(size=(4, DEGREES + WIDTH))
            columns = [*range(f * DEGREES, (f + 1) * DEGREES), *range(poses + g * WIDTH, poses + (g + 1) * WIDTH)]
            dense[np.ix_(columns, columns)] += rows.T @ rows
            by_pose[f][:, n] += rows[:, :DEGREES].T @ rows[:, DEGREES:]
            own[g] += rows[:, DEGREES:].T @ rows[:, DEGREES:]
    blocks = np.zeros((FRAMES, 3, DEGREES, DEGREES))
    for f in range(FRAMES):
        for k in range(min(3, FRAMES - f)):
            rows, columns = (slice(i * DEGREES, (i + 1) * DEGREES) for i in (f, f + k))
            blocks[f, k] = dense[rows, columns]
    gradient = rng.normal(size=(len(spans), WIDTH))
    return blocks, FrameGroups(members, by_pose, own, gradient) if spans else None, dense


@pytest.mark.parametrize("spans", [{}, SPANS])
def test_solutions_are_those_of_the_dense_matrix(rng, spans):
    blocks, groups, dense = random_equations(rng, spans)
    right, of_groups = rng.normal(size=(FRAMES * DEGREES, 4)), rng.normal(size=(len(spans), WIDTH, 4))
    expected = np.linalg.solve(dense, np.concatenate([right, of_groups.reshape(-1, 4)]))[: len(right)]
    found = FrontalFactor(blocks, groups).solve(right, of_groups if spans else None)
    np.testing.assert_allclose(found, expected, atol=1e-9)


@pytest.mark.parametrize("spans", [{}, SPANS])
def test_groups_without_right_sides_have_zeros(rng, spans):
    blocks, groups, dense = random_equations(rng, spans)
    right = rng.normal(size=(FRAMES * DEGREES, 1))
    expected = np.linalg.solve(dense, np.concatenate([right, np.zeros((len(spans) * WIDTH, 1))]))[: len(right)]
    np.testing.assert_allclose(FrontalFactor(blocks, groups).solve(right), expected, atol=1e-9)


@pytest.mark.parametrize("spans", [{}, SPANS])
def test_blocks_of_the_inverse_are_those_of_the_dense_inverse(rng, spans):
    blocks, groups, dense = random_equations(rng, spans)
    inverse, found = np.linalg.inv(dense), FrontalFactor(blocks, groups).inverse_blocks()
    for f in range(FRAMES):
        own = slice(f * DEGREES, (f + 1) * DEGREES)
        np.testing.assert_allclose(found[f], inverse[own, own], atol=1e-9 * np.abs(inverse).max())


def test_only_the_upper_triangle_of_the_diagonal_blocks_is_read(rng):
    blocks, groups, _ = random_equations(rng, SPANS)
    right = rng.normal(size=(FRAMES * DEGREES, 1))
    expected = FrontalFactor(blocks, groups).solve(right)
    blocks[:, 0] = np.triu(blocks[:, 0])
    np.testing.assert_allclose(FrontalFactor(blocks, groups).solve(right), expected, atol=1e-9)


def test_singular_equations_are_refused():
    with pytest.raises(np.linalg.LinAlgError):
        FrontalFactor(np.zeros((2, 3, DEGREES, DEGREES)))

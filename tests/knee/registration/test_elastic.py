import numpy as np
import pytest
from tests.made_bones import made_bone

from marey.knee.registration import elastic as elastic_registration
from marey.knee.registration.elastic import ElasticSettings, _Stabiliser, register_elastically, surface_distances
from marey.knee.space.surface import TriangleSurface

QUICK = ElasticSettings(steps_mm=(12.0, 6.0), image_mm=3.0, bands_mm=(16.0, 6.0), bend_sd_per_mm=(0.004, 0.02))


@pytest.fixture(scope="module")
def pair():
    template = made_bone(seed=1, fine=4)
    subject = made_bone(seed=2, size=1.08, shaft_mm=50.0, fine=4)
    return template, subject, register_elastically(template, subject, QUICK)


@pytest.mark.slow
def test_one_made_bone_becomes_another_of_another_size_shape_and_field_of_view(pair):
    template, subject, found = pair
    before = surface_distances(template, subject, (), ()).mean()
    assert before > 1.5
    assert found.surface_distance_mm < 0.5
    assert found.least_determinant > 0


def test_vertices_stay_in_their_order_and_carry_their_normals(pair):
    template, _, found = pair
    assert found.registered.faces.shape == template.faces.shape
    back = found.deformation.template_points(found.registered.vertices_mm)
    np.testing.assert_allclose(back, template.vertices_mm, atol=1e-6)
    agree = np.einsum("vi,vi->v", found.normals, found.registered.vertex_normals)
    # The mesh's own normals are means over faces that lean by up to an edge over a radius, 5 degrees, and more at the
    # rim of the cut.
    assert np.median(agree) > np.cos(np.radians(3))
    assert np.percentile(agree, 5) > np.cos(np.radians(15))


@pytest.mark.slow
def test_a_bone_on_itself_stays():
    bone = made_bone(fine=4)
    found = register_elastically(bone, TriangleSurface(vertices_mm=bone.vertices_mm, faces=bone.faces), QUICK)
    assert np.abs(found.deformation.displacement_mm).max() < 0.01


def test_the_stabiliser_is_half_the_derivative_of_its_cost(rng):
    field, tension = rng.normal(size=(3, 5, 6, 4)), rng.uniform(0, 1, (5, 6, 4))
    for tight in (np.zeros_like(tension), tension):
        stabiliser = _Stabiliser(2.0, 0.1, tight)
        cost = 0.0
        for a in range(1, 4):
            cost += (np.diff(field, 2, axis=a) ** 2).sum()
            cost += sum(2 * (np.diff(np.diff(field, axis=a), axis=b) ** 2).sum() for b in range(a + 1, 4))
            ahead, behind = (np.delete(tight, end, axis=a - 1) for end in (0, -1))
            cost += (0.5 * (ahead + behind) * np.diff(field, axis=a) ** 2).sum()
        cost /= (2.0**2 * 0.1) ** 2
        # A quadratic form: the field times half its derivative is the cost.
        np.testing.assert_allclose((field * stabiliser.pull(field)).sum(), cost)
        other = rng.normal(size=field.shape)
        np.testing.assert_allclose((other * stabiliser.pull(field)).sum(), (field * stabiliser.pull(other)).sum())


def differences(shape: tuple[int, int, int], *axes: int) -> np.ndarray:
    """Give the matrix of successive differences along axes, of a grid's numbers in a row."""
    kept = list(shape)
    matrix = np.eye(int(np.prod(shape)))
    for axis in axes:
        grid = matrix.reshape(*kept, -1)
        matrix = np.diff(grid, axis=axis)
        kept[axis] -= 1
        matrix = matrix.reshape(int(np.prod(kept)), -1)
    return matrix


def test_a_step_solves_the_dense_normal_equations_of_eq_1_with_controlled_continuity(rng):
    # [Alexander2003] eq. (1) linearised: the sum of w (M - S - grad M . change)^2 and of the squared second
    # derivatives of the field, whose deviation at a node is bend_sd.
    shape, step, sd = (5, 4, 6), 3.0, 0.3
    field, slope = rng.normal(size=(2, 3, *shape))
    weight, residual = rng.uniform(0, 5, shape), rng.normal(size=shape)
    bending = sum((1 if a == b else 2) * differences(shape, a, b).T @ differences(shape, a, b)
                  for a in range(3) for b in range(a, 3)) / (step**2 * sd) ** 2  # fmt: skip
    seen = np.concatenate([np.diag(part.ravel()) for part in slope], axis=1)
    weights = np.diag(weight.ravel())
    matrix = seen.T @ weights @ seen + np.kron(np.eye(3), bending)
    pull = seen.T @ weights @ residual.ravel() - np.kron(np.eye(3), bending) @ field.ravel()
    found = elastic_registration._solve(
        slope, weight, residual, field, _Stabiliser(step, sd, np.zeros(shape)), tolerance=1e-20
    )
    np.testing.assert_allclose(found.ravel(), np.linalg.solve(matrix, pull), atol=1e-4)


def test_another_size_and_slant_cost_nothing():
    nodes = np.stack(np.meshgrid(*(np.arange(n) for n in (5, 6, 4)), indexing="ij"))
    field = np.einsum("ij,jxyz->ixyz", np.array([[0.1, 0.2, 0], [0, -0.1, 0.3], [0.2, 0, 0.05]]), nodes)
    np.testing.assert_allclose(_Stabiliser(2.0, 0.1, np.zeros((5, 6, 4))).pull(field), 0, atol=1e-10)

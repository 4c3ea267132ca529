import numpy as np
import pytest
from scipy import ndimage

from marey.errors import MareyError
from marey.knee.registration.deformation import Deformation


def waves(height_mm: float) -> Deformation:
    """Waves of 40 mm length along y that push along x, and other ones."""
    nodes = 3.0 * np.stack(np.meshgrid(*(np.arange(n) for n in (20, 22, 18)), indexing="ij"))
    field = np.stack([np.sin(nodes[1] / 6.4), 0.5 * np.cos(nodes[2] / 8), np.sin(nodes[0] / 6.4)])
    return Deformation(origin_mm=np.array([-10.0, 5, 0]), step_mm=3.0, displacement_mm=height_mm * field)


def test_the_inverse_brings_points_back(rng):
    deformation = waves(3.0)
    points = rng.uniform((-20, 0, -5), (60, 75, 60), (500, 3))
    np.testing.assert_allclose(deformation.template_points(deformation.subject_points(points)), points, atol=1e-6)


def test_displacements_are_those_of_scipys_spline_also_at_the_ends(rng):
    field = Deformation(origin_mm=np.array([1.0, -2, 3]), step_mm=2.0, displacement_mm=rng.normal(size=(3, 6, 5, 7)))
    places = rng.uniform(-12, 22, (200, 3))
    nodes = ((places - field.origin_mm) / 2.0).T
    for axis, part in enumerate(field.displacement_mm):
        smooth = ndimage.spline_filter(part, 3, mode="nearest")
        wanted = ndimage.map_coordinates(smooth, nodes, order=3, mode="nearest", prefilter=False)
        np.testing.assert_allclose((places - field.template_points(places))[:, axis], wanted, atol=1e-12)


def test_jacobians_are_the_derivatives_and_carry_normals(rng):
    deformation = waves(3.0)
    point, direction = rng.uniform(10, 40, 3), np.array([0.6, 0.0, 0.8])
    moved = deformation.template_points(np.array([point, point + 1e-4 * direction]))
    np.testing.assert_allclose(deformation.jacobians(point) @ direction, (moved[1] - moved[0]) / 1e-4, atol=1e-4)
    # A plane of the template through the point: its directions stay across its normal where it is carried.
    normal, across = np.array([0.0, 0, 1]), np.array([[1.0, 0, 0], [0, 1, 0]])
    place = deformation.template_points(point)
    there = deformation.subject_points(place + 1e-4 * across) - deformation.subject_points(place)
    carried = deformation.subject_normals(point[None], normal[None])[0]
    np.testing.assert_allclose(there / 1e-4 @ carried, 0, atol=1e-3)


def test_a_fold_is_seen():
    assert waves(3.0).least_determinant > 0.5
    folded = waves(12.0)
    assert folded.least_determinant < 0
    with pytest.raises(MareyError, match="folds"):
        folded.subject_points(np.random.default_rng(0).uniform(0, 40, (60, 3)))


def test_a_fold_between_the_places_looked_at_first_is_found(rng):
    nodes = rng.normal(0, 1.2, (3, 6, 6, 6))
    deformation = Deformation(origin_mm=np.zeros(3), step_mm=3.0, displacement_mm=nodes)
    places = rng.uniform(0, 15, (20000, 3))
    anywhere = np.linalg.det(deformation.jacobians(places)).min()
    # No random position is lower by more than the error at 1/16 of a step.
    assert deformation.least_determinant < anywhere + 0.05

import numpy as np
import pytest

from marey.errors import MareyError
from marey.geometry import rotations
from marey.knee.bones.template_fit import TemplatePlacement, TemplateProblem, check_size, place_template, template_bones
from marey.knee.space.resampling import resampled, upright_grid
from marey.knee.space.structures import LABELS
from marey.knee.space.volume import Labels, VoxelGrid


def test_a_mirrored_placement_goes_there_and_back_and_normals_stay_outward(rng):
    matrix = 1.1 * rotations.exp(np.array([0.1, -0.2, 0.3])) @ np.diag([-1.0, 1.0, 1.0])
    placement = TemplatePlacement(matrix=matrix, shift=np.array([3.0, -4.0, 5.0]))
    outward = rng.normal(size=(50, 3))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    points = placement.image_from_template(10 * outward)
    np.testing.assert_allclose(placement.template_from_image(points), 10 * outward, atol=1e-12)
    middle = placement.image_from_template(np.zeros(3))
    np.testing.assert_allclose(placement.image_normals(outward), (points - middle) / 11.0, atol=1e-12)


def balls(spacing: float = 2.0) -> Labels:
    """A femur over a tibia, both balls; the tibia is cut by the labels' end."""
    grid = VoxelGrid(shape=(40, 30, 30), lps_from_voxel=np.diag([-spacing, spacing, spacing, 1.0]))
    k, j, i = np.meshgrid(*[np.arange(n) * spacing for n in grid.shape], indexing="ij")
    labels = np.zeros(grid.shape, dtype=np.uint8)
    labels[np.sqrt((k - 58) ** 2 + (j - 29) ** 2 + (i - 29) ** 2) < 15] = LABELS["femur"]
    labels[np.sqrt((k - 8) ** 2 + (j - 29) ** 2 + (i - 29) ** 2) < 20] = LABELS["tibia"]
    return Labels(labels=labels, grid=grid)


def test_points_of_a_template_lie_on_its_bones_and_not_where_its_labels_end():
    bones = template_bones(balls())
    femur = bones["femur"]
    away = femur.points_mm - [-29.0, 29.0, 58.0]
    # The ball of 2 mm voxels is uncertain by half of one, and so is its edge on the grid of 1 mm by half a millimetre.
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), 15, atol=1.6)
    assert np.einsum("ni,ni->n", away / 15, femur.normals).min() > 0.8
    assert bones["tibia"].points_mm[:, 2].min() > 2.0


@pytest.mark.slow
def test_the_placement_of_a_template_without_a_patella_uses_the_grown_bones():
    labels = balls()
    bones = template_bones(labels)
    grid = upright_grid(labels.grid, 1.0)
    grown = {name: resampled(labels.mask(name).astype(np.float32), labels.grid, grid) > 0.5 for name in bones}
    likeness = {name: mask.astype(np.float32) for name, mask in grown.items()}
    fit = place_template(bones, grown | {"patella": grown["femur"]}, likeness, grid)
    assert list(fit.placements) == ["femur", "tibia"]
    assert fit.fit > 0.8
    moved = fit.placements["femur"].image_from_template(bones["femur"].points_mm)
    # Half a voxel of the labels, and half a one of the grid at work.
    assert abs(np.linalg.norm(moved - [-29.0, 29.0, 58.0], axis=1) - 15).mean() < 1


def test_a_template_without_a_tibia_cannot_be_placed():
    labels = balls().labels.copy()
    labels[labels == LABELS["tibia"]] = 0
    with pytest.raises(MareyError, match="no tibia"):
        template_bones(Labels(labels=labels, grid=balls().grid))


def test_a_template_with_a_wrong_voxel_size_is_reported():
    check_size([TemplatePlacement(matrix=1.3 * np.diag([-1.0, 1, 1]), shift=np.zeros(3))])
    with pytest.raises(TemplateProblem, match=r"scaled by 2\.00"):
        check_size([TemplatePlacement(matrix=2 * np.eye(3), shift=np.zeros(3))] * 2)

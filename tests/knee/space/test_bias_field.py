import numpy as np
import pytest
from tests.made_knees import made_grid, made_labels, made_volume

from marey.errors import MareyError
from marey.knee.space.bias_field import between_two_classes, bias_field
from marey.knee.space.volume import Volume, VoxelGrid


def test_marrow_of_all_bones_becomes_alike():
    grid = made_grid((2.0, 2.0, 2.5))
    volume, labels = made_volume(grid, "bright", noise=2.0), made_labels(grid).labels
    corrected = volume.intensity / bias_field(volume).on(grid)

    def unevenness(values: np.ndarray) -> float:
        marrow = values[(labels > 0) & (values > 60)]
        return float(marrow.std() / marrow.mean())

    assert unevenness(volume.intensity) > 0.06
    assert unevenness(corrected) < 0.6 * unevenness(volume.intensity)


def test_the_field_is_one_in_the_middle_of_the_body():
    grid = made_grid((2.0, 2.0, 2.5))
    field = bias_field(made_volume(grid, "dark"))
    body = made_labels(grid).labels > 0
    assert abs(np.median(field.on(grid)[body]) - 1) < 0.15
    assert field.factor.min() > 0.5


def test_a_piece_of_an_image_is_too_small(rng):
    grid = VoxelGrid(shape=(3, 5, 5), lps_from_voxel=np.eye(4))
    with pytest.raises(MareyError, match="too small"):
        bias_field(Volume(intensity=rng.uniform(10, 200, grid.shape), grid=grid))


def test_two_classes_are_parted_between_them(rng):
    values = np.concatenate([rng.normal(10, 2, 3000), rng.normal(50, 3, 1000)])
    assert 16 < between_two_classes(values) < 40

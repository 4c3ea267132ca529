import numpy as np
import pytest
from tests.made_knees import made_grid, made_labels, made_volume

from marey.errors import MareyError
from marey.knee.bones.marrow import MarrowSettings, prepare
from marey.knee.bones.seeds import marrow_of
from marey.knee.space.volume import Volume


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["dark", "bright"])
def test_the_kind_of_marrow_is_recognised(kind):
    assert marrow_of(prepare(made_volume(made_grid((1.5, 1.5, 2.0)), kind))).kind == kind


@pytest.mark.slow
def test_seeds_lie_in_the_bones():
    grid = made_grid((1.5, 1.5, 2.0))
    knee = prepare(made_volume(grid, "dark"))
    marrow = marrow_of(knee)
    labels = made_labels(grid)
    for name in ("femur", "tibia"):
        place = knee.grid.lps(getattr(marrow, name).voxel[::-1].astype(float))
        i, j, k = np.rint(grid.voxels(place)).astype(int)
        assert labels.mask(name)[k, j, i]


@pytest.mark.slow
def test_an_image_without_a_knee_is_reported(rng):
    grid = made_grid((2.5, 2.5, 2.5))
    blank = Volume(intensity=rng.uniform(10, 60, grid.shape), grid=grid)
    with pytest.raises(MareyError, match="No femur above a tibia"):
        marrow_of(prepare(blank))


@pytest.mark.slow
def test_air_is_as_bright_as_its_noise_and_unknown_where_too_little_is_in_view():
    grid = made_grid((1.5, 1.5, 2.0))
    volume = made_volume(grid, "dark")
    knee = prepare(volume)
    assert knee.air_level is not None
    assert knee.air_level < np.percentile(knee.intensity[knee.body], 5)
    air = int((~knee.body).sum())
    assert prepare(volume, settings=MarrowSettings(least_air_voxels=air)).air_level is None


@pytest.mark.slow
def test_an_image_without_a_body_is_refused():
    with pytest.raises(MareyError, match="No body is found"):
        prepare(made_volume(made_grid((2.5, 2.5, 2.5)), "dark"), settings=MarrowSettings(skin_mm=100.0))

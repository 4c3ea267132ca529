import numpy as np
from tests.textures import make_pair

from marey.images.matching.matching import match
from marey.surface.tracks.appearances import joined, picture_of, renewed, unknown


def cut(count=12):
    pair = make_pair(np.random.default_rng(2), (100, 120), noise=1.0)
    pictures = [picture_of(pair.template), picture_of(pair.search)]
    rng = np.random.default_rng(3)
    pixels = np.stack([rng.uniform(20, 80, (count, 2)), rng.uniform(20, 80, (count, 2))], axis=1)
    sd, every = np.full((count, 2), 0.05), np.ones((count, 2), bool)
    return pictures, pixels, renewed(unknown(count, 2, half=6), pictures, pixels, sd, every)


def test_a_tile_is_matched_like_the_image_it_was_cut_from():
    pictures, pixels, appearances = cut()
    drawn, centres = appearances.picture(0, np.arange(len(appearances)))
    from_tiles = match(drawn, pictures[0].spline, centres, pixels[:, 0] + 0.3)
    from_picture = match(pictures[0].spline, pictures[0].spline, pixels[:, 0], pixels[:, 0] + 0.3)
    assert from_picture.converged.all()
    np.testing.assert_allclose(from_tiles.pixels, from_picture.pixels, atol=1e-6)
    np.testing.assert_allclose(from_tiles.covariance, from_picture.covariance, rtol=1e-5, atol=1e-9)


def test_patches_are_extracted_only_where_requested():
    pictures, pixels, appearances = cut()
    which = np.zeros((12, 2), bool)
    which[3, 1] = True
    again = renewed(appearances, pictures, pixels[::-1], np.full((len(pixels), 2), 0.1), which)
    assert np.flatnonzero((again.tiles != appearances.tiles).any(axis=(1, 2, 3))).tolist() == [3]
    np.testing.assert_array_equal(again.tiles[:, 0], appearances.tiles[:, 0])
    assert np.argwhere(again.sd == 0.1).tolist() == [[3, 1]]


def test_beside_the_border_nothing_is_cut_out():
    pictures, pixels, _ = cut()
    pixels = pixels.copy()
    pixels[0, 0], pixels[1, 1], pixels[2, 0] = [4.0, 50.0], [60.0, 95.5], [np.nan, 50.0]
    appearances = renewed(unknown(12, 2, half=6), pictures, pixels, np.full((12, 2), 0.05), np.ones((12, 2), bool))
    assert np.argwhere(~appearances.known[:, 0]).ravel().tolist() == [0, 2]
    assert np.isfinite(appearances.tiles[appearances.known]).all()


def test_drawn_patches_resemble_the_image_through_their_maps():
    _, _, appearances = cut()
    patches = appearances.patches(0, np.arange(len(appearances)), size=13)
    appearances.maps[:, 0] = [[0.0, -1.0], [1.0, 0.0]]
    turned = appearances.patches(0, np.arange(len(appearances)), size=13)
    # A quarter turn carries what lay at (x, y) to (-y, x).
    np.testing.assert_allclose(turned, np.rot90(patches, -1, axes=(1, 2)), atol=1e-3)
    assert joined(appearances, appearances[np.arange(2)]).tiles.shape[0] == 14

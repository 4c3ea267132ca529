"""Edges of limbs inside a silhouette: found where the image shows them, and nowhere else."""

import numpy as np
import pytest

from marey.images.silhouettes.interior import InteriorEdges, _sharpest, find_edges, in_company, strongest_steps

SKIN, SHIRT = np.array([90.0, 120, 180]), np.array([160.0, 70, 60])
NOISE = np.full(3, 2.0)
SIZE, CENTRE = 240, (119.5, 119.5)


def coverage(distance):
    """Share of a pixel that lies on the inner side of a border, blurred as by optics: distance is inwards."""
    return 1 / (1 + np.exp(-np.clip(distance / 0.4, -50, 50)))


def limb_before_trunk(rng, *, tilt=0.0, half=9.0, limb=SKIN, trunk=SHIRT, shade=0.0, noise=2.0):
    """A straight limb before a trunk that fills the image; its two borders lie half a width from the centre."""
    y, x = np.mgrid[:SIZE, :SIZE].astype(float)
    across = (x - CENTRE[0]) * np.cos(tilt) + (y - CENTRE[1]) * np.sin(tilt)
    share = coverage(half - np.abs(across))[..., None]
    light = (1 + shade * np.clip(across / half, -1, 1))[..., None]
    picture = light * (share * limb + (1 - share) * trunk) + rng.normal(0, noise, (SIZE, SIZE, 3))
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def places(*, tilt=0.0, half=9.0, off=0.0, length=60, limb=1):
    """Where a surface expects the limb's left border, off by some pixels to the right."""
    along = np.arange(-length / 2, length / 2)
    normal = np.array([np.cos(tilt), np.sin(tilt)])
    border = np.array(CENTRE) + (off - half) * normal + along[:, None] * [-normal[1], normal[0]]
    return InteriorEdges(
        pixels=np.round(border), inward=np.tile(normal, (length, 1)), limb=np.full(length, limb, np.int64)
    )


def border_error(found, *, tilt=0.0, half=9.0):
    normal = np.array([np.cos(tilt), np.sin(tilt)])
    return (found.pixels - CENTRE) @ normal + half


EVERYWHERE = np.ones((SIZE, SIZE), bool)


@pytest.mark.parametrize("tilt", [0.0, 0.5, 1.2])
@pytest.mark.parametrize("off", [-4.0, 0.0, 3.0])
def test_a_limbs_border_is_found_to_parts_of_a_pixel(rng, tilt, off):
    expected = places(tilt=tilt, off=off)
    found = find_edges(limb_before_trunk(rng, tilt=tilt), EVERYWHERE, expected, NOISE)
    assert len(found) > 0.9 * len(expected)
    error = border_error(found, tilt=tilt)
    # Five pixels along the edge are averaged, so that noise of 2 against a step of 100 hardly shows.
    assert abs(np.median(error)) < 0.15
    assert np.quantile(np.abs(error), 0.95) < 0.5
    assert set(found.limb) == {1}


def test_light_and_shadow_are_no_border(rng):
    # The same limb and the same trunk, of one colour: only how they are lit differs.
    lit = limb_before_trunk(rng, limb=SHIRT, trunk=0.45 * SHIRT)
    assert len(find_edges(lit, EVERYWHERE, places(), NOISE)) == 0
    # A real border is found in uneven light, too.
    uneven = find_edges(limb_before_trunk(rng, shade=0.3), EVERYWHERE, places(), NOISE)
    assert len(uneven) > 50
    assert abs(np.median(border_error(uneven))) < 0.3


def test_an_image_without_support_gives_nothing(rng):
    expected = places()
    plain = np.clip(rng.normal(SHIRT, 2.0, (SIZE, SIZE, 3)), 0, 255).astype(np.uint8)
    assert len(find_edges(plain, EVERYWHERE, expected, NOISE)) == 0
    spots = np.where(rng.random((SIZE // 4, SIZE // 4, 1)) > 0.5, SKIN, SHIRT)
    texture = np.kron(spots, np.ones((4, 4, 1))).astype(np.uint8)
    assert len(find_edges(texture, EVERYWHERE, expected, NOISE)) < 0.1 * len(expected)
    # In a grey image there is no hue.
    grey = np.repeat(limb_before_trunk(rng).mean(2, keepdims=True), 3, 2).astype(np.uint8)
    assert len(find_edges(grey, EVERYWHERE, expected, NOISE)) == 0


def test_two_borders_within_reach_are_none(rng):
    # A thin limb shows both of its borders; which of them was predicted is ambiguous.
    thin = limb_before_trunk(rng, half=3.0)
    assert len(find_edges(thin, EVERYWHERE, places(half=3.0, off=3.0), NOISE)) == 0


def test_the_outline_of_the_silhouette_is_not_an_interior_edge(rng):
    picture, left = limb_before_trunk(rng), int(CENTRE[0] - 9)
    person = EVERYWHERE.copy()
    person[:, : left + 1] = False
    assert len(find_edges(picture, person, places(off=5.0), NOISE)) == 0


def test_no_edge_is_expected_without_a_person(rng):
    picture = limb_before_trunk(rng)
    assert len(find_edges(picture, ~EVERYWHERE, places(), NOISE)) == 0
    assert len(find_edges(picture, EVERYWHERE, InteriorEdges.none(), NOISE)) == 0


def test_places_at_the_images_border_stay_in_the_image(rng):
    corner = InteriorEdges(
        pixels=np.array([[0.0, 0], [SIZE - 1, SIZE - 1], [3, SIZE - 1]]),
        inward=np.array([[1.0, 0], [0, 1], [0.6, 0.8]]),
        limb=np.zeros(3, np.int64),
    )
    depth = np.full((SIZE, SIZE), 100, np.float32)
    found = strongest_steps(limb_before_trunk(rng), depth, 0, 0, corner.pixels, corner.inward, 1 / NOISE, 8)
    assert np.isnan(found).all()


def test_an_edge_alone_or_out_of_line_is_left_out():
    expected = places(length=40)
    offset = np.full(40, 2.0)
    offset[10] = -4.0
    offset[20:] = np.nan
    offset[30] = 2.0
    keep = in_company(expected.pixels, expected.inward, expected.limb, offset)
    assert keep[:9].all()
    assert keep[11:17].all()
    assert not keep[[10, 30]].any()
    assert not keep[20:].any()
    # Edges of another limb do not support an edge.
    apart = in_company(expected.pixels, expected.inward, np.arange(40), np.where(np.arange(40) < 20, 2.0, np.nan))
    assert apart[:20].all()


def test_the_usual_offset_of_neighbours_is_their_median(rng):
    pixels, inward, limb = rng.uniform(0, 20, (60, 2)), np.tile([1.0, 0.0], (60, 1)), np.zeros(60, int)
    offset = np.where(rng.random(60) < 0.8, rng.normal(0, 1.5, 60), np.nan)
    near = np.linalg.norm(pixels[:, None] - pixels, axis=-1) <= 8.0
    shown = near & np.isfinite(offset)
    usual = np.array([np.nanmedian(offset[found]) for found in near])
    expected = (shown.sum(1) >= 0.6 * near.sum(1)) & (np.abs(offset - usual) <= 1.5)
    assert 5 < expected.sum() < 55
    np.testing.assert_array_equal(in_company(pixels, inward, limb, offset), expected)
    assert not in_company(pixels, 0 * inward, limb, offset).any()


def test_edges_in_a_resized_image_are_the_same_places():
    expected = places()
    small = expected.scaled(0.5)
    # The image's corner, at -0.5, stays its corner.
    np.testing.assert_allclose(small.pixels + 0.5, 0.5 * (expected.pixels + 0.5))
    np.testing.assert_allclose(small.scaled(2.0).pixels, expected.pixels)


@pytest.mark.parametrize("edge", [8.6, 9.0, 9.4, 10.0, 10.3, 11.0, 11.4])
def test_the_steepest_change_is_found_up_to_a_step_beside_the_given_place(edge):
    # The contrast of two neighbours is largest at the middle of a smooth border, and symmetrical about it.
    profile = 100.0 / (1.0 + np.exp(-(np.arange(21.0) - edge)))[:, None] * np.array([1.0, 0.5, 0.2])
    np.testing.assert_allclose(_sharpest(profile, np.ones(3), 10), edge, atol=0.05)


def test_the_steepest_change_does_not_depend_on_what_unused_memory_contains(monkeypatch):
    profile = 100.0 / (1.0 + np.exp(-(np.arange(21.0) - 8.7)))[:, None] * np.array([1.0, 0.5, 0.2])
    monkeypatch.setattr(np, "empty", lambda shape: np.full(shape, 1e9))
    np.testing.assert_allclose(_sharpest.py_func(profile, np.ones(3), 10), 8.7, atol=0.05)

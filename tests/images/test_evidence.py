from math import gamma, pi

import numpy as np

from marey.images import background as backgrounds
from marey.images.densities import COMMON, unknown
from marey.images.evidence import FREEDOM, LIMIT, UNKNOWN_SHARE, evidence


def scene(rng, shift):
    room = np.clip(rng.normal(120, 20, (30, 40, 3)), 30, 220).astype(np.uint8)
    background = backgrounds.from_pictures([room])
    plain = backgrounds.Exposure(gain=np.ones(3), offset=np.zeros(3), noise=np.full(3, 3.0), jitter=0.0)
    picture = np.clip(room + np.array(shift), 0, 255).astype(np.uint8)
    return picture, backgrounds.exposed(background, plain), background, plain


def test_where_the_background_explains_the_pixel_the_ratio_is_that_of_the_densities(rng):
    picture, light, background, plain = scene(rng, (1, -1, 2))
    found, shade = evidence(picture, light, background, plain, unknown(3))
    misfit = (((picture - light) / 3.0) ** 2).sum(axis=2)
    peak = gamma((FREEDOM + 3) / 2) / gamma(FREEDOM / 2) / (FREEDOM * pi) ** 1.5
    rest = peak / 27 * (1 + misfit / FREEDOM) ** (-(FREEDOM + 3) / 2)
    # Of one colour in the cube the share that was seen and the share that was not are equal at first.
    person = COMMON[3] / 256**3 * ((1 - UNKNOWN_SHARE) + UNKNOWN_SHARE)
    assert np.allclose(found, np.maximum(np.log(person / rest), -LIMIT), atol=1e-3)
    assert not shade.any()


def test_a_darkening_keeps_its_share_of_light(rng):
    _, light, background, plain = scene(rng, (0, 0, 0))
    dark = np.round(0.8 * light).astype(np.uint8)
    _, shade = evidence(dark, light, background, plain, unknown(3))
    assert abs(np.median(shade[shade > 0]) - 0.8) < 0.01


def test_far_pixels_are_left_out(rng):
    picture, light, background, plain = scene(rng, (60, -60, 60))
    near = np.zeros((30, 40), bool)
    near[:10] = True
    found, _ = evidence(picture, light, background, plain, unknown(3), near=near)
    assert (found[10:] == -LIMIT).all()
    assert (found[:10] > 0).mean() > 0.9

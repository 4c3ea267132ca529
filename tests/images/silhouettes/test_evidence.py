from dataclasses import replace
from math import gamma, pi

import cv2
import numpy as np
import pytest

from marey.images.silhouettes import background as backgrounds
from marey.images.silhouettes.densities import COMMON, RATIO_BINS, RATIO_RANGE, LocalDensities, unknown
from marey.images.silhouettes.evidence import (
    FREEDOM,
    LIMIT,
    SHADE_SLACK,
    SHADOW_SHARE,
    UNKNOWN_SHARE,
    VEIL,
    VEIL_SHARE,
    VEIL_SLACK,
    evidence,
)


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
    # At first, the observed and the unobserved share of a colour in the cube are equal.
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


def plain_evidence(picture, light, steepness, confidence, shown, look, reach, local=None):
    """The result of the kernel, computed pixel by pixel in plain Python."""
    height, width, channels = picture.shape
    window = (2 * reach + 1, 2 * reach + 1)
    blurred = [
        cv2.blur(one.astype(np.float32), window, borderType=cv2.BORDER_REPLICATE).reshape(height, width, -1)
        for one in ((picture * light).sum(2), (light**2).sum(2), picture - light)
    ]
    shade, change = (blurred[0] / blurred[1])[..., 0], blurred[2]
    peak = gamma((FREEDOM + channels) / 2) / gamma(FREEDOM / 2) / (FREEDOM * pi) ** (channels / 2)
    found, dark = np.zeros((height, width)), np.zeros((height, width))
    power = -(FREEDOM + channels) / 2
    for y, x in np.ndindex(height, width):
        own, rest = picture[y, x].astype(float), light[y, x].astype(float)
        variance = shown.noise.astype(float) ** 2 + shown.jitter**2 * steepness[y, x]
        misfit = ((own - rest) ** 2 / variance).sum()
        density = plain = peak * (1 + misfit / FREEDOM) ** power / np.sqrt(variance.prod())
        if misfit > 2 * channels:
            square = (rest**2).sum()
            places = [(y, x), (y - reach, x), (y + reach, x), (y, x - reach), (y, x + reach)]
            places = [(min(max(row, 0), height - 1), min(max(col, 0), width - 1)) for row, col in places]
            ratio, at = min((abs(shade[p] - (own @ rest) / square), i) for i, p in enumerate(places))
            ratio, around = shade[places[at]], change[places[at]].astype(float)
            shadow = 0.0
            if RATIO_RANGE[0] < ratio < RATIO_RANGE[1]:
                widths = variance + SHADE_SLACK**2 / channels * square
                place = int((ratio - RATIO_RANGE[0]) * RATIO_BINS / (RATIO_RANGE[1] - RATIO_RANGE[0]))
                known = look.shadow[place] * np.sqrt(widths.sum() / (channels * square * widths.prod()))
                away = ((own - ratio * rest) ** 2 / widths).sum()
                shadow = 2.5 * SHADOW_SHARE * peak * known * (1 + away / FREEDOM) ** power
            dark[y, x] = ratio if shadow > plain else 0.0
            variance = variance + VEIL_SLACK**2 * (own - rest) ** 2
            away = ((own - rest - around) ** 2 / variance).sum()
            scale = 8 * pi * VEIL**3 if channels == 3 else 2 * VEIL
            veil = VEIL_SHARE * np.exp(-int(np.linalg.norm(around)) / VEIL) / scale
            density = plain + shadow + veil * (1 + away / FREEDOM) ** power
        colour = tuple(picture[y, x] >> 3) if channels == 3 else (picture[y, x, 0],)
        around, person = look.surroundings[colour], look.person[colour]
        if local is not None:
            share = local.surroundings_share[y, x]
            around = share * local.surroundings[y, x] + (1 - share) * around
            share = local.person_share[y, x]
            person = share * local.person[y, x] + (1 - share) * person
        density = confidence[y, x] * density + (1 - confidence[y, x]) * around
        uniform = UNKNOWN_SHARE * COMMON[channels] * 256.0**-channels
        person = (1 - UNKNOWN_SHARE) * person + uniform
        found[y, x] = np.clip(np.log(person / density), -LIMIT, LIMIT)
    return found, dark


@pytest.mark.parametrize("placed", [False, True])
@pytest.mark.parametrize("channels", [1, 3])
def test_the_rows_are_what_each_pixel_by_itself_gives(rng, channels, placed):
    room = np.clip(rng.normal(120, 20, (40, 50, channels)), 30, 220).astype(np.uint8)
    background = backgrounds.from_pictures([room])
    confidence = rng.uniform(0.3, 1.0, (40, 50)).astype(np.float32)
    background = replace(background, confidence=confidence)
    shown = backgrounds.Exposure(
        gain=np.ones(channels), offset=np.zeros(channels), noise=np.full(channels, 3.0), jitter=0.3
    )
    picture = room.astype(float)
    picture[:20] *= 0.7
    picture[10:30, 10:25] = rng.uniform(0, 255, (20, 15, channels))
    picture[25:, 30:] += 15
    picture = np.clip(picture + rng.normal(0, 2, picture.shape), 0, 255).astype(np.uint8)
    look = unknown(channels)
    person = rng.uniform(0, 2, look.person.shape) * look.person
    around = rng.uniform(0, 2, look.surroundings.shape) * look.surroundings
    look = replace(look, person=person, surroundings=around)
    light = backgrounds.exposed(background, shown)
    names = ("person", "person_share", "surroundings", "surroundings_share")
    scales = (256.0**-channels, 1.0) * 2
    given = {name: scale * rng.random((40, 50)) for name, scale in zip(names, scales, strict=True)}
    local = LocalDensities(**given) if placed else None
    found, dark = evidence(picture, light, background, shown, look, local=local)
    expected, shaded = plain_evidence(
        picture, light, background.steepness, background.confidence, shown, look, 2, local
    )
    # A darkening at the very edge of its bins, or a strength at a whole number, may fall to either side.
    assert np.quantile(np.abs(found - expected), 0.995) < 1e-3
    assert (np.abs(dark - shaded) > 1e-4).mean() < 0.005
    assert (shaded > 0).mean() > 0.2

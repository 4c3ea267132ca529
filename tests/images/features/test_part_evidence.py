"""Evidence that depends on the place: parts, surroundings near a pixel, and textures of one colour."""

import cv2
import numpy as np
import pytest

from marey.images.features.part_evidence import (
    PART_SHARE,
    TEXTURE_LIMIT,
    colour_cells,
    nearest_part,
    part_evidence,
)
from marey.images.features.texture import CELLS, texture_cells, texture_density
from marey.images.silhouettes.densities import colour_density
from marey.images.silhouettes.level_sets import evolve
from marey.images.silhouettes.part_colours import PartColourCounts

SIZE = (160, 200)
AREA = 1e-5
SHIRT, TROUSERS, LEFT, RIGHT = (60, 70, 180), (150, 110, 50), (100, 105, 95), (60, 180, 70)


def drawn():
    """A shirt above trousers."""
    parts = np.full(SIZE, -1)
    parts[40:80, 80:120], parts[80:130, 80:120] = 0, 1
    return parts


def filmed(rng, channels=3):
    image, parts = np.empty((*SIZE, 3)), drawn()
    image[:, :100], image[:, 100:], image[parts == 0], image[parts == 1] = LEFT, RIGHT, SHIRT, TROUSERS
    image = np.clip(np.rint(image + rng.normal(0, 3, image.shape)), 0, 255).astype(np.uint8)
    return image if channels == 3 else image[..., 2:]


def learned(image, parts, *, textures=CELLS):
    counts = PartColourCounts(1, 2, image.shape[2], textures)
    counts.add(0, image, parts, AREA, texture_cells(image) if textures else None)
    return counts.learned()[0]


def test_each_pixel_has_its_nearest_part_and_distance():
    parts, away = nearest_part(drawn())
    assert parts[45, 100] == parts[10, 100] == 0
    assert parts[125, 100] == parts[150, 150] == 1
    assert away[60, 100] == 0
    assert away[60, 130] == pytest.approx(11, abs=0.2)


@pytest.mark.parametrize("channels", [1, 3])
def test_cells_index_the_flattened_densities(rng, channels):
    image = rng.integers(0, 256, (9, 11, channels), dtype=np.uint8)
    cells = colour_cells(image, 3)
    if channels == 1:
        np.testing.assert_array_equal(cells, image[..., 0])
    else:
        np.testing.assert_array_equal(cells, np.ravel_multi_index(tuple((image >> 3).transpose(2, 0, 1)), (32,) * 3))


@pytest.mark.parametrize("channels", [1, 3])
def test_a_colour_is_probable_in_its_own_part_and_on_its_own_side_of_the_room(rng, channels):
    image, parts = filmed(rng, channels), drawn()
    local = part_evidence(image, parts, learned(image, parts), 4.0)
    swapped = part_evidence(image, np.where(parts >= 0, 1 - parts, -1), learned(image, parts), 4.0)
    inside = parts >= 0
    assert np.median(local.person[inside]) > 5 * np.median(swapped.person[inside])
    np.testing.assert_allclose(local.person_share[inside], PART_SHARE)
    other_wall = image.copy()
    other_wall[60, 75] = image[60, 135]
    there = part_evidence(other_wall, parts, learned(image, parts), 4.0)
    assert there.surroundings[60, 75] < 0.5 * local.surroundings[60, 75]


def test_the_densities_of_the_surroundings_integrate_to_one(rng):
    """A pixel of each coarse colour, in turn at one place: the sum over all colours is one."""
    image, parts = filmed(rng, 1), drawn()
    total = 0.0
    for level in range(0, 256, 16):
        # Beside the shirt, so near that it is not learned from.
        image[60, 121] = level
        total += 16 * part_evidence(image, parts, learned(image, parts, textures=0), 4.0).surroundings[60, 121]
    assert total == pytest.approx(1, abs=1e-4)


def test_far_from_the_body_nothing_local_is_known(rng):
    image, parts = np.zeros((300, 400, 3), np.uint8), np.full((300, 400), -1)
    parts[20:60, 20:60] = 0
    image[20:60, 20:60] = 200
    found = part_evidence(image, parts, learned(image, parts), 4.0)
    for share in (found.person_share, found.surroundings_share, found.texture):
        assert (share[200:, 200:] == 0).all()


def two_textures(rng, body):
    """Fine speckles on a body and coarse ones around it, with the same distribution of grey values."""
    fine, coarse = (cv2.GaussianBlur(rng.normal(0, 1, SIZE), (0, 0), s) for s in (1.0, 4.0))
    grey = np.where(body, fine / fine.std(), coarse / coarse.std())
    return np.clip(np.rint(120 + 30 * grey), 0, 255).astype(np.uint8)[..., None].repeat(3, 2)


def test_two_textures_of_one_colour_are_separated_by_the_texture_and_not_by_the_colour(rng):
    body = np.zeros(SIZE, bool)
    body[40:120, 60:140] = True
    # At the resolution of the texture, half a structure is added to each side.
    known, image = two_textures(rng, body), two_textures(rng, body)
    start = np.roll(body, (12, 14), (0, 1))

    def overlap(inside, outside, cells):
        votes = np.log(inside[cells] + 1e-9) - np.log(outside[cells] + 1e-9)
        votes = cv2.GaussianBlur(np.clip(votes, -2, 2), (0, 0), 2.0)
        region = evolve(votes, start, length=1.0)
        return np.count_nonzero(region & body) / np.count_nonzero(region | body)

    seen, cells = texture_cells(known), texture_cells(image)
    texture = overlap(texture_density(seen, body), texture_density(seen, ~body), cells)
    of_body, of_rest = (colour_density(known[..., :1], side) for side in (body, ~body))
    colour = overlap(of_body, of_rest, image[..., 0])
    assert texture > 0.7
    assert colour < texture - 0.1


def test_the_texture_of_a_part_counts_for_it_and_that_of_the_surroundings_against_it(rng):
    body = drawn() >= 0
    parts = np.where(body, 0, -1)
    colours = learned(two_textures(rng, body), parts)
    found = part_evidence(two_textures(rng, body), parts, colours, 3.0).texture
    assert np.abs(found).max() <= TEXTURE_LIMIT
    assert found[50:120, 90:110].mean() > 0.2
    away = nearest_part(parts)[1]
    assert found[(away > 8) & (away < 12)].mean() < -0.05
    assert (found[away > 40] == 0).all()


def test_without_textures_there_is_no_evidence_of_them(rng):
    image, parts = filmed(rng), drawn()
    assert part_evidence(image, parts, learned(image, parts, textures=0), 4.0).texture is None


def test_an_empty_body_is_refused(rng):
    image = filmed(rng)
    with pytest.raises(ValueError, match="the drawn body is empty"):
        part_evidence(image, np.full(SIZE, -1), learned(image, drawn()), 4.0)

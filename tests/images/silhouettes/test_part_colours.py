"""Colours of the parts of a body, carried between cameras as far as they agree, and what hides a part."""

import numpy as np
import pytest

from marey.images.silhouettes.densities import COMMON
from marey.images.silhouettes.part_colours import (
    LEAST_PIXELS,
    UNIFORM_SHARE,
    WHOLE_SHARE,
    PartColourCounts,
    hidden_region,
    joined_hidden,
)

SIZE = (120, 160)
SHIRT, TROUSERS, WALL, BOX = (60, 70, 180), (150, 110, 50), (100, 105, 95), (30, 160, 200)
AREA = 1e-5


def drawn() -> np.ndarray:
    """A body of two parts: a shirt above trousers."""
    parts = np.full(SIZE, -1)
    parts[30:60, 60:90] = 0
    parts[60:100, 60:90] = 1
    return parts


def filmed(rng, *, shirt=SHIRT, trousers=TROUSERS, box=None, channels=3) -> np.ndarray:
    """An image of the body; a box may hide a region of it."""
    image = np.empty((*SIZE, 3))
    parts = drawn()
    image[:], image[parts == 0], image[parts == 1] = WALL, shirt, trousers
    if box is not None:
        image[box] = BOX
    noisy = np.clip(np.round(image + rng.normal(0, 3, image.shape)), 0, 255).astype(np.uint8)
    return noisy if channels == 3 else noisy[..., 2:]


def learned(rng, *, channels=3, **of_third):
    """The colours in four cameras; the third one may see something else."""
    counts = PartColourCounts(4, 2, channels)
    for _ in range(4):
        for camera in range(4):
            counts.add(camera, filmed(rng, channels=channels, **(of_third if camera == 2 else {})), drawn(), AREA)
    return counts.learned()


def density(colours, part, colour) -> float:
    """The density of a colour, per unit of the colour space, from its cell and the neighbouring ones."""
    bins = colours.density.shape[1]
    cell = np.array(colour) * bins // 256
    near = tuple(slice(max(c - 1, 0), c + 2) for c in cell)
    return float(colours.density[part][near].sum())


def test_each_part_has_its_own_colours_besides_those_of_the_body_and_unknown_ones(rng):
    for colours in learned(rng):
        own, other = density(colours, 0, SHIRT), density(colours, 0, TROUSERS)
        # Two parts of equal weight make up the whole body.
        assert other / own == pytest.approx(0.5 * WHOLE_SHARE / (1 - 0.5 * WHOLE_SHARE - UNIFORM_SHARE), rel=0.1)
        assert density(colours, 1, TROUSERS) > 10 * density(colours, 1, SHIRT)
        assert colours.density.min() > 0


def test_a_density_sums_to_one_besides_the_unknown_colours(rng):
    for channels in (3, 1):
        for colours in learned(rng, channels=channels):
            axes = tuple(range(1, colours.density.ndim))
            volume = (256 / colours.density.shape[1]) ** channels
            expected = 1 - UNIFORM_SHARE + UNIFORM_SHARE * COMMON[channels]
            np.testing.assert_allclose(colours.density.sum(axis=axes) * volume, expected, rtol=1e-3)


def test_a_camera_whose_part_something_else_covers_uses_the_colours_of_the_others(rng):
    first, _, third, _ = learned(rng, shirt=BOX)
    assert density(third, 0, SHIRT) > 10 * density(third, 0, BOX)
    # In the other cameras the wrong colours of the third one have little effect.
    assert density(first, 0, SHIRT) > 5 * density(first, 0, BOX)
    # Its trousers are visible, and keep its own colours.
    assert density(third, 1, TROUSERS) == pytest.approx(density(first, 1, TROUSERS), rel=0.1)


def test_a_camera_that_shows_a_part_in_slightly_other_colours_keeps_them(rng):
    other = tuple(c + 6 for c in SHIRT)
    first, _, third, _ = learned(rng, shirt=other)
    assert density(third, 0, other) > density(first, 0, other)


def test_a_part_that_one_camera_never_sees_has_the_colours_of_the_others(rng):
    counts = PartColourCounts(2, 2, 3)
    hidden = np.where(drawn() == 0, -1, drawn())
    few = np.full(SIZE, -1)
    few.flat[: LEAST_PIXELS - 1] = 0
    counts.add(0, filmed(rng), drawn(), AREA)
    counts.add(1, filmed(rng), hidden, AREA)
    counts.add(1, filmed(rng), few, AREA)
    first, second = counts.learned()
    assert density(second, 0, SHIRT) > 0.8 * density(first, 0, SHIRT) > 0
    # The few pixels of the wall were not learned.
    assert density(second, 0, WALL) < 0.02 * density(second, 0, SHIRT)


def test_a_part_that_is_seen_by_one_camera_only_has_its_own_colours(rng):
    counts = PartColourCounts(1, 2, 3)
    counts.add(0, filmed(rng), drawn(), AREA)
    [only] = counts.learned()
    assert density(only, 0, SHIRT) > 10 * density(only, 0, TROUSERS)


@pytest.mark.parametrize("channels", [3, 1], ids=["colour", "grey"])
def test_what_hides_the_body_is_found_and_nothing_else(rng, channels):
    colours = learned(rng, channels=channels)[0]
    nothing = hidden_region(filmed(rng, channels=channels), drawn(), colours)
    assert nothing.dtype == bool
    assert nothing.sum() <= 0.01 * (drawn() >= 0).sum()
    # The box reaches beyond the body: its colours are those of the surroundings.
    box = np.zeros(SIZE, bool)
    box[40:75, 75:140] = True
    found = hidden_region(filmed(rng, box=box, channels=channels), drawn(), colours)
    true = box & (drawn() >= 0)
    assert np.count_nonzero(found & true) / np.count_nonzero(found | true) > 0.8
    assert not found[drawn() < 0].any()


def test_a_colour_that_neither_body_nor_surroundings_have_hides_nothing(rng):
    colours = learned(rng)[0]
    patch = np.zeros(SIZE, bool)
    patch[40:50, 65:75] = True
    assert not hidden_region(filmed(rng, box=patch), drawn(), colours).any()


def test_an_image_without_a_body_has_no_hidden_region(rng):
    colours = learned(rng)[0]
    assert not hidden_region(filmed(rng), np.full(SIZE, -1), colours).any()


def test_what_the_silhouette_lacks_deep_inside_the_body_is_hidden():
    body = drawn() >= 0
    found, hidden = body.copy(), np.zeros(SIZE, bool)
    found[30:100, 60:75] = False
    hidden[35, 85] = True
    joined = joined_hidden(hidden, body, found, slack=4.0)
    assert joined[35, 85]
    x = np.flatnonzero(joined[65])
    # Pixels deeper than 4 px inside the body which the silhouette lacks.
    np.testing.assert_array_equal(x, np.arange(64, 75))
    np.testing.assert_array_equal(joined_hidden(hidden, body, body, slack=4.0), hidden)


def test_what_the_silhouette_has_beside_a_hidden_part_is_hidden_too():
    body = drawn() >= 0
    hidden, found = np.zeros(SIZE, bool), body.copy()
    hidden[40:60, 60:90] = True
    found[45:80, 50:60] = True
    joined = joined_hidden(hidden, body, found, slack=4.0)
    assert joined[45:60, 50:60].all()
    # Beside a visible part the silhouette may lie outside the drawn body.
    assert not joined[62:].any()


def test_the_textures_are_carried_between_cameras_as_the_colours_are(rng):
    """A camera that sees other colours has the texture of the others; one that agrees keeps its own."""

    def of_cameras(textures, **of_third):
        counts = PartColourCounts(4, 2, 3, 5)
        for camera in range(4):
            shown = of_third if camera == 2 else {}
            cells = np.full(SIZE, textures[camera])
            cells[:, 75:] = -1
            counts.add(camera, filmed(rng, **shown), drawn(), AREA, cells)
        return counts.learned()

    hidden = of_cameras([1, 1, 4, 1], shirt=BOX)
    assert [int(each.texture[0].argmax()) for each in hidden] == [1, 1, 1, 1]
    agreed = of_cameras([1, 1, 4, 1])
    assert [int(each.texture[0].argmax()) for each in agreed] == [1, 1, 4, 1]
    same = of_cameras([1, 1, 1, 1])
    for each in same:
        np.testing.assert_allclose(each.texture.sum(axis=1), 1, rtol=1e-5)
        # Cameras that see the same have the same density, carried or their own.
        np.testing.assert_allclose(each.texture, same[0].texture, rtol=1e-5)


def test_without_textures_there_is_no_density_of_them(rng):
    assert learned(rng)[0].texture is None

import gc
import weakref

import numpy as np
import pytest

from marey.images.silhouettes import background as backgrounds
from marey.images.silhouettes.silhouettes import SilhouetteSettings, segment, shape_term, visible_part

SHAPE = (120, 160)


def room(rng, shape=SHAPE):
    """A floor of tiles with some texture, (H, W, 3) grey levels."""
    y, x = np.indices(shape)
    tiles = 90 + 30 * ((y // 12 + x // 12) % 2) + rng.normal(0, 3, shape)
    return tiles[..., None] * np.array([0.9, 1.0, 1.1])


def person(shape=SHAPE, shift=0):
    y, x = np.indices(shape)
    trunk = (abs(y - 50) < 30) & (abs(x - 80 - shift) < 10)
    legs = (y >= 75) & (y < 110) & (abs(abs(x - 80 - shift) - 7) < 4)
    return trunk | legs


def shown(picture, rng, noise=2.0):
    return np.clip(np.round(picture + rng.normal(0, noise, picture.shape)), 0, 255).astype(np.uint8)


def overlap(one, other):
    return (one & other).sum() / (one | other).sum()


@pytest.fixture
def empty(rng):
    return room(rng)


@pytest.fixture
def background(empty, rng):
    return backgrounds.from_pictures([shown(empty, rng)])


def with_person(empty, shift=0, colour=(40.0, 60.0, 150.0)):
    return np.where(person(shift=shift)[..., None], np.array(colour), empty)


def test_a_person_is_found_without_a_start(empty, background, rng):
    found = segment(shown(with_person(empty), rng), background)
    assert overlap(found.mask, person()) > 0.97


def test_a_limb_before_stripes_of_its_own_colour_is_not_cut_off(rng):
    y, x = np.indices(SHAPE)
    stripes = (x // 4) % 2 == 0
    skin = np.array([100.0, 120.0, 150.0])
    empty = np.where(stripes[..., None], skin, 0.6 * skin) + rng.normal(0, 1, (*SHAPE, 1))
    arm = (abs(y - 40) < 4) & (x >= 90) & (x < 130)
    body = np.where(person()[..., None], np.array([40.0, 60.0, 150.0]), empty)
    picture = shown(np.where(arm[..., None], skin, body), rng)
    mask = segment(picture, backgrounds.from_pictures([shown(empty, rng)])).mask
    # The image shows no border where the stripe has the arm's colour; all other stripes show it, up to the hand.
    assert mask[arm & ~stripes & (x >= 115)].mean() > 0.8
    assert overlap(mask & ~arm, person() & ~arm) > 0.95


def test_a_person_below_the_least_size_of_the_settings_is_not_found(empty, background, rng):
    picture = shown(with_person(empty), rng)
    assert not segment(picture, background, settings=SilhouetteSettings(least_person_share=0.9)).mask.any()


def test_an_empty_room_gives_an_empty_mask(empty, background, rng):
    assert not segment(shown(empty, rng), background).mask.any()


@pytest.mark.parametrize(("gain", "offset"), [(0.85, 0.0), (1.15, -6.0)])
def test_a_changed_exposure_is_no_person_and_the_person_is_still_found(empty, background, rng, gain, offset):
    assert not segment(shown(gain * empty + offset, rng), background).mask.any()
    found = segment(shown(gain * with_person(empty) + offset, rng), background)
    assert overlap(found.mask, person()) > 0.97


def test_a_cast_shadow_is_not_the_person(empty, background, rng):
    y, x = np.indices(SHAPE)
    ellipse = ((y - 100) / 14) ** 2 + ((x - 112) / 34) ** 2
    shade = 1 - 0.3 / (1 + np.exp(8 * (ellipse - 1)))
    found = segment(shown(np.where(person()[..., None], with_person(empty), empty * shade[..., None]), rng), background)
    assert overlap(found.mask, person()) > 0.95


def test_the_border_is_not_biased(empty, background, rng):
    counts = [segment(shown(with_person(empty), rng), background).mask.sum() for _ in range(3)]
    perimeter = 2 * (60 + 20) + 2 * 2 * 35
    assert abs(np.mean(counts) - person().sum()) / perimeter < 0.25


def test_the_person_is_followed_from_a_start_that_is_off(empty, background, rng):
    first = segment(shown(with_person(empty), rng), background)
    moved = segment(shown(with_person(empty, shift=5), rng), background, start=first.mask, before=first)
    assert overlap(moved.mask, person(shift=5)) > 0.97


def test_grey_images_do_too(empty, rng):
    plate = backgrounds.from_pictures([backgrounds.grey(shown(empty, rng))])
    image = backgrounds.grey(shown(with_person(empty, colour=(20.0, 20.0, 20.0)), rng))
    assert overlap(segment(image, plate).mask, person()) > 0.9


def test_a_prior_decides_where_the_image_does_not(empty, background, rng):
    image = shown(empty, rng)
    prior = np.where(person(), 30.0, -30.0)
    assert overlap(segment(image, background, prior=prior).mask, person()) > 0.9


def test_another_person_beside_the_first_is_ignored_where_the_image_gives_no_evidence(empty, background, rng):
    both = with_person(with_person(empty, shift=22, colour=(150.0, 60.0, 40.0)))
    image, beside = shown(both, rng), person(shift=22) & ~person()
    prior = shape_term(person(), 1.0, 4.0)
    merged = segment(image, background, start=person(), prior=prior)
    apart = segment(image, background, start=person(), prior=prior, ignored=beside)
    assert (merged.mask & beside).sum() > 0.1 * beside.sum()
    assert (apart.mask & beside).sum() < 0.5 * (merged.mask & beside).sum()
    assert overlap(apart.mask, person()) > 0.9


def test_a_start_of_another_size_is_rejected(empty, background, rng):
    with pytest.raises(ValueError, match="start"):
        segment(shown(empty, rng), background, start=np.zeros((3, 3), bool))
    with pytest.raises(ValueError, match="region without evidence"):
        segment(shown(empty, rng), background, ignored=np.zeros((3, 3), bool))


def test_a_black_bar_is_no_person(empty, background, rng):
    image = with_person(empty)
    image[-6:] = 1
    found = segment(shown(image, rng), background)
    assert not found.mask[-6:].any()
    assert overlap(found.mask, person()) > 0.97


def test_nothing_is_found_far_from_the_start(empty, background, rng):
    twins = np.where(person(shift=-50)[..., None], np.array([40.0, 60.0, 150.0]), with_person(empty))
    found = segment(shown(twins, rng), background, start=person())
    assert overlap(found.mask, person()) > 0.95


def test_a_reflection_on_the_floor_is_not_the_person(empty, background, rng):
    y, x = np.indices(SHAPE)
    veil = 18 * np.exp(-(((y - 100) / 14) ** 2 + ((x - 112) / 20) ** 2))
    image = np.where(person()[..., None], with_person(empty), empty + veil[..., None] * np.array([0.7, 0.9, 1.0]))
    assert overlap(segment(shown(image, rng), background).mask, person()) > 0.95


def test_the_shape_term_is_the_signed_distance():
    term = shape_term(person(), 0.5, 4.0)
    assert term[50, 80] == 2.0
    assert term[5, 5] == -2.0
    assert (np.sign(term) == np.where(person(), 1, -1)).all()


def test_in_a_large_image_a_person_and_an_empty_room_are_recognised_without_a_start(rng):
    shape = (360, 480)
    empty = np.kron(room(rng), np.ones((3, 3, 1)))
    background = backgrounds.from_pictures([shown(empty, rng)])
    expected = np.kron(person(), np.ones((3, 3))) > 0
    image = np.where(expected[..., None], np.array([40.0, 60.0, 150.0]), empty)
    assert expected.shape == shape
    assert overlap(segment(shown(image, rng), background).mask, expected) > 0.98
    unoccupied = segment(shown(empty, rng), background)
    assert unoccupied.mask.shape == shape
    assert not unoccupied.mask.any()


def test_a_background_is_released_after_its_images(empty, rng):
    room_image = backgrounds.from_pictures([shown(empty, rng)])
    segment(shown(with_person(empty), rng), room_image)
    released = weakref.ref(room_image)
    gc.disable()
    try:
        del room_image
        assert released() is None
    finally:
        gc.enable()


def test_black_bars_are_no_part_of_what_is_shown(rng, empty, background):
    picture = empty.copy()
    picture[:7] = 2
    picture[:, -3:] = 2
    exposure = backgrounds.exposure(shown(picture, rng, 1.0), background)
    rows, columns = visible_part(shown(picture, rng, 1.0), background, exposure)
    assert (rows.start, rows.stop, columns.start, columns.stop) == (7, 120, 0, 157)
    whole = backgrounds.exposure(shown(empty, rng, 1.0), background)
    rows, columns = visible_part(shown(empty, rng, 1.0), background, whole)
    assert (rows.start, rows.stop, columns.start, columns.stop) == (0, 120, 0, 160)

import numpy as np
import pytest

from marey.images.silhouettes import background as backgrounds


def textured(rng, shape=(60, 80, 3)):
    return np.clip(rng.normal(120, 30, shape), 20, 235)


def shown(picture, rng, noise=2.0):
    return np.clip(np.round(picture + rng.normal(0, noise, picture.shape)), 0, 255).astype(np.uint8)


def test_gain_offset_and_noise_are_found_though_a_quarter_is_covered(rng):
    truth = textured(rng)
    plate = backgrounds.from_pictures([np.round(truth).astype(np.uint8)])
    picture = 0.9 * truth + 5.0
    picture[10:40, 10:50] = (10, 20, 200)
    exposure = backgrounds.exposure(shown(picture, rng, 3.0), plate)
    assert np.allclose(exposure.gain, 0.9, atol=0.01)
    assert np.allclose(exposure.offset, 5.0, atol=1.5)
    assert np.allclose(exposure.noise, 3.0, rtol=0.35)


def test_the_median_of_a_clip_excludes_a_person_who_walks_through(rng):
    truth = textured(rng)
    pictures = []
    for k in range(9):
        picture = truth.copy()
        picture[:, 8 * k : 8 * k + 8] = 0
        pictures.append(shown(picture, rng, 1.0))
    assert abs(backgrounds.from_pictures(pictures).mean - truth).max() < 5


def test_the_take_itself_gives_the_background_where_each_pixel_is_empty_at_some_time(rng):
    truth = textured(rng)
    pictures = []
    for k in range(10):
        picture = truth.copy()
        # A moving person of changing colour covers 60 % of the frames.
        if k < 6:
            picture[20:40, 20:40] = 25.0 * k
        pictures.append(shown(picture, rng, 1.0))
    assert abs(backgrounds.from_take(pictures).mean - truth).max() < 6


def test_pictures_of_two_sizes_are_rejected():
    with pytest.raises(ValueError, match="one size"):
        backgrounds.from_pictures([np.zeros((4, 4, 3), np.uint8), np.zeros((5, 4, 3), np.uint8)])
    with pytest.raises(ValueError, match="at least one"):
        backgrounds.from_take([])
    plate = backgrounds.from_pictures([np.zeros((4, 4, 3), np.uint8)])
    with pytest.raises(ValueError, match="but its background"):
        backgrounds.exposure(np.zeros((5, 4, 3), np.uint8), plate)


def smooth_room(shape=(120, 160)):
    y, x = np.indices(shape)
    return np.stack([100 + 0.3 * x, 110 + 0.2 * y, 120 + 0.1 * x], axis=2)


def take_of(room, rng, count=8):
    """Images of a dark figure that walks through the room."""
    pictures = []
    for k in range(count):
        picture = room.copy()
        picture[20:110, 5 + 18 * k : 20 + 18 * k] = 30
        pictures.append(shown(picture, rng, 1.0))
    return pictures


def test_an_error_in_the_background_image_is_corrected_from_the_take(rng):
    room = smooth_room()
    plate = room.copy()
    plate[40:80, 60:80] = (40, 60, 170)
    corrected = backgrounds.with_reduced_weight(backgrounds.from_pictures([shown(plate, rng, 1.0)]), take_of(room, rng))
    assert abs(corrected.mean[40:80, 60:80] - room[40:80, 60:80]).mean() < 3


def test_the_settings_decide_what_is_a_ghost(rng):
    room = smooth_room()
    plate = room.copy()
    plate[40:80, 60:80] = (40, 60, 170)
    settings = backgrounds.BackgroundSettings(ghost_ratio=1e6)
    empty = backgrounds.from_pictures([shown(plate, rng, 1.0)])
    kept = backgrounds.with_reduced_weight(empty, take_of(room, rng), settings)
    assert abs(kept.mean[45:75, 65:75] - plate[45:75, 65:75]).mean() < 3


def test_a_person_who_never_moves_is_not_added_to_the_background(rng):
    room = smooth_room()
    pictures = []
    for _ in range(6):
        picture = room.copy()
        picture[40:80, 60:80] = (40, 60, 170)
        pictures.append(shown(picture, rng, 1.0))
    kept = backgrounds.with_reduced_weight(backgrounds.from_pictures([shown(room, rng, 1.0)]), pictures)
    assert abs(kept.mean[40:80, 60:80] - room[40:80, 60:80]).mean() < 3


def swaying(room, rng):
    """Images of a person who sways in one place, so that the middle of the body always hides the room."""
    pictures = []
    for down, right in [(-10, -10), (10, 10)] + 10 * [(0, 0)]:
        picture = room.copy()
        picture[30 + down : 90 + down, 50 + right : 90 + right] = (40, 60, 170)
        pictures.append(shown(picture, rng, 1.0))
    return pictures


def test_a_background_keeps_its_weight_behind_a_person_who_stays_in_one_place(rng):
    room = smooth_room()
    kept = backgrounds.with_reduced_weight(backgrounds.from_pictures([shown(room, rng, 1.0)]), swaying(room, rng))
    assert kept.confidence.min() == 1.0


def test_a_background_behind_more_than_the_followed_limb_has_a_reduced_weight(rng):
    room = smooth_room()
    empty = backgrounds.from_pictures([shown(room, rng, 1.0)])
    kept = backgrounds.with_reduced_weight(empty, swaying(room, rng), limb=True)
    assert kept.confidence[45:75, 65:75].max() < 1.0


def test_a_background_that_shows_the_person_has_a_reduced_weight_where_the_person_stays(rng):
    room = smooth_room()
    plate = room.copy()
    plate[40:80, 60:80] = (170, 60, 40)
    kept = backgrounds.with_reduced_weight(backgrounds.from_pictures([shown(plate, rng, 1.0)]), swaying(room, rng))
    assert kept.confidence[45:75, 65:75].max() < 1.0


def test_an_unreliable_background_is_learned_outside_the_person(rng):
    room = smooth_room()
    wrong = backgrounds.from_pictures([shown(room + 40, rng, 1.0)])
    confidence = np.ones((120, 160))
    confidence[:60] = 0.5
    background = backgrounds.Background(
        mean=wrong.mean, steepness=wrong.steepness, confidence=confidence, size=wrong.size
    )
    plain = backgrounds.Exposure(gain=np.ones(3), offset=np.zeros(3), noise=np.ones(3), jitter=0.1)
    person = np.zeros((120, 160), bool)
    person[:60, :40] = True
    for _ in range(6):
        background = backgrounds.updated_from_frame(background, shown(room, rng, 1.0), plain, person)
    assert abs(background.mean[:60, 40:] - room[:60, 40:]).mean() < 3
    assert abs(background.mean[:60, :40] - room[:60, :40] - 40).mean() < 3
    assert abs(background.mean[60:] - room[60:] - 40).mean() < 3
    assert (background.confidence[:60, 40:] > 0.95).all()


def test_a_take_that_begins_empty_shows_its_background_though_a_person_then_stays(rng):
    room, pictures = smooth_room(), []
    for k in range(12):
        picture = room.copy()
        if k >= 3:
            picture[30:100, 60:85] = (40, 60, 170)
        pictures.append(shown(picture, rng, 1.0))
    assert abs(backgrounds.from_take(pictures).mean - room)[35:95, 65:80].mean() < 3


def test_the_frames_worth_seeing_are_frames_of_the_take():
    assert list(backgrounds.background_frames(3)) == [0, 1, 2]
    assert set(backgrounds.background_frames(500)) >= {*range(10), 499}


@pytest.mark.parametrize("channels", [1, 3])
def test_the_mean_misfit_is_that_of_the_formula(rng, channels):
    picture = rng.integers(0, 255, (20, 30, channels), dtype=np.uint8)
    light = rng.uniform(0, 255, picture.shape).astype(np.float32)
    steepness = rng.uniform(0, 30, picture.shape[:2]).astype(np.float32)
    noise, jitter = rng.uniform(1.0, 3.0, channels), np.float32(0.1)
    expected = ((picture - light.astype(float)) ** 2 / (noise + jitter * steepness[..., None])).mean(axis=2)
    found = backgrounds._mean_misfit(picture, light, steepness, noise, jitter)
    np.testing.assert_allclose(found, expected, rtol=1e-5)

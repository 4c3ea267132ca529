import numpy as np
import pytest
from tests.textures import Texture

from marey.images.silhouettes.unexplained import RoomTexture, unexplained_texture


@pytest.fixture
def room(rng):
    y, x = np.indices((120, 160), float)
    return np.repeat(Texture.draw(rng, contrast=15.0)(np.stack([x, y], axis=-1))[..., None], 3, axis=-1)


def noisy(values, rng):
    return np.clip(np.round(values + rng.normal(0, 2, values.shape)), 0, 255).astype(np.uint8)


def test_the_room_and_a_shadow_on_it_are_explained(rng, room):
    shadow = room.copy()
    shadow[40:90, 30:100] *= 0.6
    found = unexplained_texture(noisy(shadow, rng), RoomTexture.of(room))
    assert found.mean() < 0.01


def test_speckles_of_the_rooms_colour_are_not(rng, room):
    body = room.copy()
    body[30:100, 50:120] = room.mean() + 25 * np.sign(rng.normal(0, 1, (70, 70, 1)))
    found = unexplained_texture(noisy(body, rng), RoomTexture.of(room))
    assert found[40:90, 60:110].all()
    outside = np.ones(found.shape, bool)
    outside[30:100, 50:120] = False
    assert not found[outside].any()

import numpy as np

from marey.view.pictures.flat_cartilage import flat_picture
from marey.view.pictures.knee_maps import BARE, thickness_colours


def test_thick_is_red_thin_is_blue_and_bare_is_bone():
    thin, thick, bare, unknown = thickness_colours(np.array([0.3, 3.9, 0.0, np.nan]))
    assert thin[2] > thin[0]
    assert thick[0] > thick[2]
    assert tuple(bare) == tuple(unknown) == BARE


def test_the_image_shows_cartilage_only_where_it_is():
    x, y = np.meshgrid(np.arange(-20.0, 21), np.arange(-10.0, 11))
    thickness = np.where(x.ravel() < 0, 3.0, 0.0)
    picture = flat_picture(x.ravel(), y.ravel(), thickness)
    middle = picture[picture.shape[0] // 2]
    coloured = (middle.astype(int).max(1) - middle.astype(int).min(1)) > 60
    # 6 pixels per millimetre over 19 mm, and the scale's bar.
    assert 6 * 17 < coloured.sum() < 6 * 24 + 20

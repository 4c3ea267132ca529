"""Options of a calibration that are parsed from text."""

import pytest

from marey.errors import SettingProblem
from marey.pipelines.calibrate.settings import given_lens_models


def test_a_model_of_all_lenses_or_of_one_camera_is_read():
    assert given_lens_models(None) == ()
    assert given_lens_models("k2, k1") == (("", ("k1", "k2")),)
    assert given_lens_models({"": "none", "cam02": "k1,k2,p1,p2,k3"}) == (
        ("", ()),
        ("cam02", ("k1", "k2", "p1", "p2", "k3")),
    )


@pytest.mark.parametrize("text", ["", "k2", "k1,p1", "k1,k4", "none,k1", "k1 k2"])
def test_coefficients_that_are_no_model_are_refused_in_one_line(text: str):
    with pytest.raises(SettingProblem, match="it should be none, k1") as caught:
        given_lens_models(text)
    assert "\n" not in str(caught.value)

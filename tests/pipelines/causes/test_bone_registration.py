"""A template that does not fit: a planted unit or side is named with its figures, and a sound template has no cause."""

from functools import cache

import numpy as np
import pytest
from tests.made_bones import made_bone

from marey.knee.registration.sided import SidedRegistration, register_on_either_side
from marey.knee.space.sides import mirrored
from marey.knee.space.surface import TriangleSurface
from marey.pipelines.causes import bone_registration
from marey.pipelines.causes.bone_registration import side_reasons, tried_text, unit_reasons


def scaled(bone: TriangleSurface, factor: float) -> TriangleSurface:
    return TriangleSurface(vertices_mm=bone.vertices_mm * factor, faces=bone.faces)


@pytest.fixture(scope="module")
def subject() -> TriangleSurface:
    return made_bone(shaft_mm=30.0, size=0.55, fine=2)


@pytest.fixture(scope="module")
def sound(subject: TriangleSurface) -> SidedRegistration:
    return register_on_either_side(scaled(subject, 0.95), subject)


@pytest.mark.slow
def test_a_wrong_unit_is_named_and_a_sound_one_is_not(subject, sound):
    [reason] = unit_reasons(scaled(subject, 9.5), subject, None)
    assert reason.cause == "unit"
    assert "multiplied by 0.1" in reason.what
    assert "without this they cannot be registered" in reason.what
    assert unit_reasons(scaled(subject, 0.95), subject, sound) == ()


@pytest.mark.slow
def test_a_side_is_only_named_if_it_was_given_wrongly(subject, monkeypatch):
    # The same template is registered several times.
    monkeypatch.setattr(bone_registration, "register_on_either_side", cache(register_on_either_side))
    template = mirrored(scaled(subject, 0.95))
    [reason] = side_reasons(template, subject, False, fits=True)
    assert (reason.level, reason.cause) == ("usable with limits", "sides")
    assert "The template is of the other side, and not as given" in reason.what
    assert side_reasons(template, subject, False, fits=False)[0].level == "not usable"
    assert side_reasons(template, subject, True, fits=True) == ()
    assert side_reasons(template, subject, None, fits=False) == ()


@pytest.mark.slow
@pytest.mark.parametrize("given", [False, True])
def test_a_side_that_hardly_differs_is_a_limit_if_the_shapes_contradict_it(subject, sound, monkeypatch, given):
    unclear = SidedRegistration(rigid=sound.rigid, mirrored=True, same_side_mm=0.5, other_side_mm=0.4)
    monkeypatch.setattr(bone_registration, "register_on_either_side", lambda *bones: unclear)
    reasons = side_reasons(subject, subject, given, fits=True)
    assert [(each.level, each.cause) for each in reasons] == ([] if given else [("usable with limits", "sides")])
    assert all("may be of the other side" in each.what for each in reasons)
    assert all("0.40 mm instead of 0.50 mm" in each.what for each in reasons)


@pytest.mark.slow
def test_what_was_tried_is_stated_with_its_figures(sound):
    text = tried_text(sound)
    assert f"{sound.rigid.surface_distance_mm:.2f} mm from each other" in text
    assert f"{sound.same_side_mm:.2f} mm on the same side" in text
    assert np.isfinite([sound.same_side_mm, sound.other_side_mm]).all()

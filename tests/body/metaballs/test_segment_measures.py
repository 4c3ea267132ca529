"""Volumes, masses and girths of segments."""

import numpy as np
import pytest

from marey.body.metaballs.metaball_person import metaball_body, metaball_space
from marey.body.metaballs.segment_measures import DENSITY, DENSITY_SD, segment_measures
from marey.body.metaballs.spline_skin import sample_skin, tessellate


@pytest.fixture(scope="module")
def space():
    return metaball_space("simple")


@pytest.fixture(scope="module")
def whole(space):
    return segment_measures(space, np.zeros(len(space)), None, segments=np.ones(21, bool))


def mesh_volume(body):
    a, b, c = (body.vertices[body.faces[:, corner]] for corner in range(3))
    return np.einsum("ta,ta->t", a, np.cross(b, c)).sum() / 6


@pytest.mark.slow
def test_the_segments_make_up_the_body(space, whole):
    # The mesh has creases and fingers in which the metaballs' own surface is a little wider.
    body = metaball_body(space)
    assert np.nansum(whole.volume) == pytest.approx(mesh_volume(body), rel=0.04)
    assert np.nansum(whole.volume) == pytest.approx(mesh_volume(tessellate(sample_skin(balls_of(body)))), rel=0.02)
    # The generic person's density is between that of lungs with air and of bone.
    assert 1000 < np.nansum(whole.mass) / np.nansum(whole.volume) < 1080


def balls_of(body):
    return body.metaballs.balls(body.numbers).at_rest()


SHARES = {
    "head": 0.0681, "trunk": 0.4302, "upperarm": 0.0263, "forearm": 0.0150, "hand": 0.0059, "thigh": 0.1447,
    "shank": 0.0457, "foot": 0.0133,
}  # fmt: skip
"""Of the body's mass, mean of women and men [deLeva1996] table 4; the head with the neck."""
PARTS = {"head": ("neck",), "trunk": ("thorax", "abdomen", "pelvis"), "foot": ("toes",)}


@pytest.mark.slow
@pytest.mark.parametrize("detail", ["simple", "full"])
def test_a_generic_person_is_as_heavy_as_people_are(detail):
    """Body mass index of an average body, and each segment's share of the mass as people's."""
    space = metaball_space(detail)
    whole = segment_measures(space, np.zeros(len(space)), None, segments=np.ones(21, bool))
    mass = dict(zip(whole.names, whole.mass / np.nansum(whole.mass), strict=True))
    assert 55 < np.nansum(whole.mass) < 85
    for name, share in SHARES.items():
        one_side = [name, f"left_{name}", *PARTS.get(name, ()), *(f"left_{part}" for part in PARTS.get(name, ()))]
        # A limb's two ends are cut elsewhere by everybody.
        assert sum(mass.get(part, 0.0) for part in one_side) == pytest.approx(share, rel=0.25), name
    for name, value in mass.items():
        if name.startswith("left_") and "clavicle" not in name:
            assert value == pytest.approx(mass[name.replace("left", "right")], rel=0.03)


def test_what_lies_about_a_clavicle_belongs_to_the_thorax(whole):
    for values in (whole.volume, whole.mass, whole.centre[:, 0], whole.inertia[:, 0]):
        assert [n for n, value in zip(whole.names, values, strict=True) if np.isnan(value)] == [
            "left_clavicle", "right_clavicle",
        ]  # fmt: skip


def test_inertia_is_that_of_some_body(whole):
    for xx, yy, zz, xy, xz, yz in whole.inertia[np.isfinite(whole.volume)]:
        values = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        assert values[0] > 0
        assert values[2] < values[0] + values[1] + 1e-9


def test_wider_people_have_wider_girths_and_longer_ones_more_volume(space, whole):
    numbers = np.zeros(len(space))
    numbers[[space.names.index("thigh_width"), space.names.index("forearm_length")]] = 0.1
    other = segment_measures(space, numbers, None, segments=np.ones(21, bool))
    thigh, forearm = whole.names.index("left_thigh"), whole.names.index("left_forearm")
    assert other.girth[thigh, 1] / whole.girth[thigh, 1] == pytest.approx(1.1, abs=0.02)
    assert other.volume[forearm] / whole.volume[forearm] == pytest.approx(1.1, abs=0.03)


@pytest.mark.slow
def test_standard_deviations_follow_the_numbers(space):
    wanted = np.array([name == "left_thigh" for name in space.mean.skeleton.segment_names])
    covariance = np.zeros((len(space), len(space)))
    at = space.names.index("thigh_width")
    covariance[at, at] = 0.03**2
    found = segment_measures(space, np.zeros(len(space)), covariance, segments=wanted)
    # A width is a share of every girth, and the volume grows with its square; 32 draws know it to an eighth.
    assert found.girth_sd[0, 1] / found.girth[0, 1] == pytest.approx(0.03, rel=3 / 8)
    assert found.volume_sd[0] / found.volume[0] == pytest.approx(0.06, rel=0.5)
    assert found.mass_sd[0] > DENSITY_SD * found.mass[0]
    assert found.names == ("left_thigh",)
    assert found.mass[0] == pytest.approx(found.volume[0] * DENSITY["thigh"])


def test_without_a_covariance_standard_deviations_are_nan(whole):
    assert np.isnan(whole.volume_sd).all()
    assert np.isnan(whole.girth[whole.names.index("head")]).all()

"""The skin over metaballs: closed, outward, on the surface; and the body it makes."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.skeleton import LIMBS
from marey.body.metaballs.metaball_people import metaball_person
from marey.body.metaballs.metaball_person import metaball_body, metaball_space
from marey.body.metaballs.spline_skin import sample_skin, spline_body, spline_skin, tessellate


def person(detail: str, seed: int | None):
    """A person of metaballs: the generic one, or one as they are expected among people."""
    space = metaball_space(detail)
    if seed is None:
        return space.mean
    drawn = np.random.default_rng(seed).normal(size=len(space))
    return space.balls(0.8 * np.linalg.cholesky(space.prior_covariance) @ drawn)


PEOPLE = [("full", None), ("simple", 3), ("full", 2)]


@pytest.fixture(scope="module", params=PEOPLE, ids=str)
def balls(request):
    return person(*request.param)


@pytest.fixture(scope="module")
def skin(balls):
    return spline_skin(balls)


def limbs(skin):
    number = np.array([LIMBS.index(part) for part in skin.part])
    return np.where(number == 0, -1, number)


def edges(faces):
    return [(int(a), int(b)) for face in faces for a, b in zip(face, np.roll(face, -1), strict=True)]


def in_hands(balls, skin):
    """Return which vertices lie beyond the wrists."""
    names = balls.skeleton.segment_names
    beyond = np.zeros(len(skin.part), bool)
    for side in ("left", "right"):
        elbow, wrist = (balls.joint_centres[names.index(f"{side}_{name}")] for name in ("forearm", "hand"))
        beyond |= (np.array(skin.part) == f"{side}_arm") & ((skin.vertices - wrist) @ (wrist - elbow) > 0)
    return beyond


@pytest.mark.slow
def test_the_skin_is_one_closed_surface_without_handles(skin):
    found = Counter(edges(skin.faces))
    assert max(found.values()) == 1, "two faces go along an edge in the same direction"
    assert all((b, a) in found for a, b in found), "an edge has one face only"
    assert len(skin.vertices) - len(found) // 2 + len(skin.faces) == 2
    assert np.array_equal(np.unique(skin.faces), np.arange(len(skin.vertices)))


@pytest.mark.slow
def test_the_skin_lies_on_the_metaballs(balls, skin):
    """All but the hands, which are mittens; between samples to a fraction of a millimetre."""
    off = np.abs(balls.at_rest().distance(skin.vertices, limbs(skin)))[~in_hands(balls, skin)]
    assert np.percentile(off, 95) < 2e-4
    assert np.percentile(off, 99) < 1e-3
    assert np.percentile(off, 99.9) < 5e-3, "edges of the toes"
    assert off.max() < 15e-3, "the crease at the crotch"


@pytest.mark.slow
def test_no_face_looks_inward(balls, skin):
    """Away from creases, where the surface itself has no normal, and hands."""
    corner = skin.vertices[skin.faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    outward = balls.at_rest().distances(skin.vertices, limbs(skin)).by_point[skin.faces].mean(1)
    folded = np.einsum("ta,ta->t", normal, outward) <= 0
    looked_at = ~in_hands(balls, skin)[skin.faces].any(1) & (np.abs(corner[:, :, 0]).max(1) > 0.005)
    assert np.mean(folded[looked_at]) < 1e-3
    assert np.linalg.norm(normal, axis=1).min() > 0


@pytest.mark.slow
def test_the_skin_encloses_what_the_metaballs_do(balls, skin):
    a, b, c = (skin.vertices[skin.faces[:, corner]] for corner in range(3))
    volume = np.einsum("ta,ta->t", a, np.cross(b, c)).sum() / 6
    step = 0.016
    low, high = skin.vertices.min(0) - 0.01, skin.vertices.max(0) + 0.01
    grid = np.stack(np.meshgrid(*(np.arange(*ends, step) for ends in zip(low, high, strict=True))), -1).reshape(-1, 3)
    inside = np.count_nonzero(balls.at_rest().field(grid) > 0.5) * step**3
    assert volume == pytest.approx(inside, rel=0.015)


@pytest.mark.slow
def test_a_coarser_skin_has_fewer_vertices_and_is_closed_as_well():
    samples = sample_skin(person("simple", None).at_rest(), samples=3)
    counts = [len(tessellate(samples, fineness).vertices) for fineness in (1, 2)]
    assert counts[1] / counts[0] == pytest.approx(4, rel=0.1)
    found = Counter(edges(tessellate(samples, 1).faces))
    assert all((b, a) in found for a, b in found)


@pytest.mark.slow
def test_both_sides_of_a_symmetric_person_are_alike():
    skin = spline_skin(person("simple", None), fineness=2)
    away, _ = cKDTree(skin.vertices).query(skin.vertices * [-1, 1, 1])
    assert away.max() < 1e-4


@pytest.fixture(scope="module")
def dressed():
    """The generic body, and the same in its skin of patches."""
    body = metaball_person("simple", "coarse")
    return body, spline_body(body, 2)


@pytest.mark.slow
def test_a_body_keeps_its_person_and_gets_the_skin(rng):
    body = metaball_person("simple", "coarse")
    body = body.with_numbers(0.3 * np.linalg.cholesky(body.space.prior_covariance) @ rng.normal(size=len(body.space)))
    body = metaball_body(body.metaballs, body.numbers, body)
    made = spline_body(body, 2)
    np.testing.assert_array_equal(made.joint_centres, body.joint_centres)
    np.testing.assert_array_equal(made.numbers, body.numbers)
    assert made.space.names == body.space.names
    np.testing.assert_allclose(made.vertex_weights.sum(1), 1.0)
    skin = spline_skin(body.metaballs.balls(body.numbers), 2)
    np.testing.assert_allclose(made.vertices, skin.vertices, atol=1e-12)
    np.testing.assert_array_equal(made.faces, skin.faces)


@pytest.mark.slow
def test_the_skin_moves_with_the_numbers_as_the_metaballs_do(dressed, rng):
    body, made = dressed
    step = 0.005 * rng.normal(size=len(body.numbers))
    good = np.abs(body.metaballs.balls(made.numbers).at_rest().distance(made.vertices)) < 1e-4
    moved = made.with_numbers(made.numbers + step)
    off = np.abs(body.metaballs.balls(moved.numbers).at_rest().distance(moved.vertices))[good]
    assert np.median(off) < 1e-4
    assert np.median(np.linalg.norm(moved.vertices - made.vertices, axis=1)) > 1e-3


@pytest.mark.slow
def test_a_bent_knee_moves_the_shank_and_not_the_head(dressed):
    _, made = dressed
    angles = np.zeros(len(made.skeleton.coordinates))
    angles[[c.name for c in made.skeleton.coordinates].index("left_knee_flexion")] = 1.0
    moved = np.linalg.norm(
        PosedBody(made, Pose(made.joint_centres[0], np.eye(3), angles)).vertices - made.vertices, axis=1
    )
    below = (made.vertices[:, 2] < -0.5) & (made.vertices[:, 0] > 0.03)
    assert moved[below].min() > 0.05
    assert moved[made.vertices[:, 2] > 0].max() < 1e-3


@pytest.mark.slow
def test_a_preset_keeps_its_parts():
    body = metaball_person("simple", "coarse", preset="right_arm")
    made = spline_body(body, 2)
    assert set(made.face_segment) <= set(body.face_segment)
    assert body.skeleton.segment("left_forearm") not in made.face_segment
    outlined = {made.skeleton.segment_names[k] for k in made.face_segment[made.outline_counts]}
    assert "right_forearm" in outlined
    assert "head" not in outlined


def test_a_mesh_without_metaballs_has_no_cross_sections(rng):
    from tests import people

    with pytest.raises(ValueError, match="metaballs"):
        spline_body(people.stick_person(rng))


@pytest.mark.slow
def test_bones_may_lie_beside_the_balls():
    """The balls of the trunk moved forward until the spine stands out of the back, those of a forearm aside."""
    balls = person("simple", None)
    names = np.array(balls.skeleton.segment_names)[balls.segment]
    off = np.where(np.isin(names, ["pelvis", "abdomen", "thorax"])[:, None], [0, -0.09, 0], 0.0)
    off = off + np.where((names == "left_forearm")[:, None], [0, 0.035, 0], 0.0)
    moved = replace(balls, centre=balls.centre + off)
    spine = np.array([[0.0, y, z] for y, z in [(0.038, 0.15), (0.037, 0.3)]])
    assert moved.at_rest().field(spine).min() < 0.5, "the case is none"
    found = Counter(edges(spline_skin(moved, 1).faces))
    assert all((b, a) in found for a, b in found)

"""Correspondence between points of the surface and points of an outline."""

from dataclasses import replace

import numpy as np
import pytest
from tests import worlds
from tests.reference_outlines import match_outline, match_rays

from marey.body.articulation.pose import PosedBody
from marey.images.silhouettes.nearest import sort_into_cells
from marey.observations.correspondence import (
    ObservedOutline,
    OutlineMatchSettings,
    outline_matches,
    pair_both_ways,
    view_of,
)


@pytest.fixture(scope="module")
def scene():
    body, camera = worlds.person("fine"), worlds.ring(1)[0]
    posed = PosedBody(body, worlds.pose(body))
    return posed, camera, ObservedOutline.of(camera, view_of(posed, camera).mask())


def shifted(posed, metres):
    return replace(posed, pose=worlds.pose(posed.body, at=metres))


def test_a_body_in_place_matches_its_own_outline_within_a_pixel(scene):
    posed, camera, sighting = scene
    match = match_outline(posed, view_of(posed, camera), sighting, OutlineMatchSettings())
    assert len(match.where) == pytest.approx(2 * len(sighting.contour.pixels), rel=0.02)
    # The rim's points and the contour's pixels are the same pixels.
    assert np.abs(match.residuals(posed)).max() < 1.0
    rays = match_rays(posed, view_of(posed, camera), sighting, OutlineMatchSettings())
    assert np.linalg.norm(rays.residuals(posed), axis=1).max() < 1.0


@pytest.mark.parametrize("metres", [0.0, 0.03, 1.0, 50.0])
def test_drawing_and_matching_in_one_go_give_the_same(scene, metres):
    posed, camera, sighting = scene
    moved = shifted(posed, np.array([metres, 0.3 * metres, 0.0]))
    outline = outline_matches(moved, sighting, OutlineMatchSettings())
    expected = match_outline(moved, view_of(moved, camera), sighting, OutlineMatchSettings())
    assert (outline is None) == (expected is None)
    if outline is not None and expected is not None:
        assert outline.counts.sum() == len(expected.where)
        match, repeated = outline.match, outline.counts.astype(int)
        assert metres > 0.0 or len(match.where) < 0.6 * len(expected.where)
        for name in ("normals", "offsets", "pixels_per_metre"):
            ours, theirs = np.repeat(getattr(match, name), repeated, 0), getattr(expected, name)
            np.testing.assert_allclose(np.sort(ours, 0), np.sort(theirs, 0), rtol=1e-12)
        residual = np.repeat(match.residuals(moved)[:, 0], repeated)
        np.testing.assert_allclose(np.sort(residual), np.sort(expected.residuals(moved)[:, 0]), atol=1e-9)


def test_residuals_are_pixels_across_the_contour_towards_the_inside(scene):
    posed, camera, sighting = scene
    right = camera.camera_from_world.rotation[0]
    moved = shifted(posed, 0.02 * right)
    match = match_outline(moved, view_of(moved, camera), sighting, OutlineMatchSettings())
    pixel = 300.0 * 0.02 / 3.2
    points = camera.project(moved.points(match.where))
    mean = points.mean(0)[0]
    along = match.normals @ right
    across = np.abs(along) > 0.9
    residual = match.residuals(moved)[:, 0]
    # What moved to the right lies farther inside on the left of a limb and farther outside on its right.
    np.testing.assert_allclose(np.median(np.sign(along[across]) * residual[across]), pixel, atol=0.35)
    assert np.isfinite(mean)


def test_rays_and_planes_see_the_same_points_and_planes_are_the_nearer(scene):
    posed, camera, sighting = scene
    moved = shifted(posed, (0.01, 0.01, 0.02))
    view = view_of(moved, camera)
    planes, rays = (match(moved, view, sighting, OutlineMatchSettings()) for match in (match_outline, match_rays))
    np.testing.assert_array_equal(planes.where.face, rays.where.face)
    near, far = np.abs(planes.residuals(moved)[:, 0]), np.linalg.norm(rays.residuals(moved), axis=1)
    # A plane through a ray is never farther away than the ray; both measure in pixels at the point's depth.
    assert (near <= far * 1.05 + 1e-6).all()


def test_matches_keep_to_the_gate_and_to_the_direction(scene):
    posed, camera, sighting = scene
    moved = shifted(posed, (0.05, 0.02, 0.03))
    view = view_of(moved, camera)
    wide = match_outline(moved, view, sighting, OutlineMatchSettings(gate=25.0, cosine=0.3))
    narrow = match_outline(moved, view, sighting, OutlineMatchSettings(gate=3.0, cosine=0.3))
    strict = match_outline(moved, view, sighting, OutlineMatchSettings(gate=25.0, cosine=0.95))
    assert len(narrow.where) < len(wide.where)
    assert len(strict.where) < len(wide.where)
    assert np.abs(narrow.residuals(moved)).max() <= 3.0 * 1.05


def test_faces_whose_outline_does_not_count_are_not_matched(scene):
    posed, camera, sighting = scene
    body = posed.body
    legs = np.array([name.endswith(("thigh", "shank", "foot", "toes")) for name in body.skeleton.segment_names])
    without = replace(posed, body=replace(body, outlined=~legs[body.face_segment]))
    match = match_outline(without, view_of(without, camera), sighting, OutlineMatchSettings())
    assert len(match.where) > 100
    assert not legs[body.face_segment[match.where.face]].any()
    nothing = replace(posed, body=replace(body, outlined=np.zeros(len(body.faces), bool)))
    assert match_outline(nothing, view_of(nothing, camera), sighting, OutlineMatchSettings()) is None


def test_without_a_silhouette_or_without_a_body_in_view_nothing_matches(scene):
    posed, camera, sighting = scene
    empty_outline = ObservedOutline.of(camera, np.zeros((camera.height, camera.width), bool))
    away = shifted(posed, (0, 0, 30))
    for match in (match_outline, match_rays):
        assert match(posed, view_of(posed, camera), empty_outline, OutlineMatchSettings()) is None
        assert match(away, view_of(away, camera), sighting, OutlineMatchSettings()) is None


def test_a_body_partly_behind_the_camera_is_drawn_in_front_of_it():
    body = worlds.person()
    camera = worlds.looking_at(np.array([0.0, 0, -0.3]), np.array([0.05, -0.02, 0.55]), size=(100, 120), focal=60.0)
    posed = PosedBody(body, worlds.pose(body))
    depths = camera.depths(posed.vertices)
    assert depths.min() < 0 < depths.max()
    view = view_of(posed, camera)
    assert view.mask().any()
    assert np.isfinite(view.rim(body.faces).depth).all()


def test_pairs_are_those_that_a_look_at_all_of_them_finds(rng):
    rim, contour = rng.uniform(0, 60, (80, 2)), rng.uniform(0, 60, (90, 2))
    rim_in, contour_in = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in rng.normal(size=(2, 90, 2)))
    rim_in = rim_in[:80]
    rim_counts, contour_counts = rng.random(80) > 0.2, rng.random(90) > 0.2
    gate, cosine = 6.0, 0.1
    one_limb = np.zeros(80, np.int64)
    found = pair_both_ways(
        rim, rim_in, one_limb, rim_counts, sort_into_cells(contour), contour_in, contour_counts, gate, cosine, False
    )  # fmt: skip
    distance = np.linalg.norm(rim[:, None] - contour, axis=2)
    fits = (distance <= gate) & (rim_in @ contour_in.T >= cosine) & rim_counts[:, None] & contour_counts
    wanted = [(i, distance[i].argmin()) for i in range(80) if fits[i, distance[i].argmin()]]
    wanted += [(distance[:, j].argmin(), j) for j in range(90) if fits[distance[:, j].argmin(), j]]
    assert list(zip(*found, strict=True)) == wanted


def test_an_outline_may_be_observed_by_its_rays_as_well(scene):
    posed, camera, sighting = scene
    moved = shifted(posed, (0.01, 0.01, 0.02))
    planes, rays = (outline_matches(moved, sighting, OutlineMatchSettings(residual=kind)) for kind in ("plane", "ray"))
    np.testing.assert_array_equal(planes.match.where.face, rays.match.where.face)
    np.testing.assert_array_equal(planes.counts, rays.counts)
    expected = match_rays(moved, view_of(moved, camera), sighting, OutlineMatchSettings())
    # Each pair is listed once here and as often as it was found there.
    far = np.repeat(np.linalg.norm(rays.match.residuals(moved), axis=1), rays.counts.astype(int))
    np.testing.assert_allclose(np.sort(far), np.sort(np.linalg.norm(expected.residuals(moved), axis=1)), atol=1e-9)

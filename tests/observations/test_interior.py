"""Matching of a limb in front of the trunk with the edges of the image."""

from dataclasses import replace

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.fit.solver.pose_solver import Schedule, fit_pose
from marey.images.silhouettes.contours import trace_contour
from marey.images.silhouettes.interior import InteriorEdges
from marey.observations.correspondence import ObservedOutline, OutlineMatchSettings, outline_matches, view_of
from marey.observations.interior import all_matches, interior_matches
from marey.observations.prior import Habit, JointLimits

BEFORE_THE_TRUNK = {"left_shoulder_lift": 30, "left_elbow_flexion": 15}
"""From the left, upper arm and forearm cross the trunk [deg]."""


@pytest.fixture(scope="module")
def scene():
    body = worlds.scan("fine")
    camera = worlds.looking_at(np.array([0.0, 0, 0.1]), np.array([2.9, -1.2, 0.4]))
    posed = PosedBody(body, worlds.pose(body, BEFORE_THE_TRUNK))
    return posed, camera, sighting_of(posed, camera)


SCHEDULE = Schedule(iterations=6, gate=(8.0, 3.0), scale=(4.0, 2.0), interior=True)


def edges_of(posed, camera):
    """The edges that a perfect image shows: half a pixel outside of the rim's outermost pixels."""
    rim = view_of(posed, camera).interior_rim(posed.body.faces, posed.body.face_limb)
    limb = posed.body.face_limb[rim.face]
    directed = np.linalg.norm(rim.inward, axis=1) > 0.5
    pixels, inward = (rim.pixels - 0.5 * rim.inward)[directed], rim.inward[directed]
    return InteriorEdges(pixels=pixels, inward=inward, limb=limb[directed])


def sighting_of(posed, camera):
    return ObservedOutline(camera, trace_contour(view_of(posed, camera).mask()), edges_of(posed, camera))


def test_a_body_in_place_matches_the_edges_of_its_limbs(scene):
    posed, _, sighting = scene
    found = interior_matches(posed, sighting, OutlineMatchSettings(interior=True))
    # The forearm shows two borders before the trunk, each of some centimetres; every pixel finds itself.
    assert len(found.match.where) >= 0.95 * len(sighting.interior) > 40
    assert np.abs(found.match.residuals(posed)).max() < 1.0
    assert abs(np.median(found.match.residuals(posed))) < 0.05
    assert set(found.counts) <= {1.0, 2.0}


def test_a_moved_limb_sees_its_edges_a_few_pixels_off_and_no_farther(scene):
    posed, _, sighting = scene
    column = worlds.column(posed.body.skeleton, "left_shoulder_lift")
    angles = posed.pose.angles.copy()
    angles[column] += np.deg2rad(7)
    moved = replace(posed, pose=replace(posed.pose, angles=angles))
    found = interior_matches(moved, sighting, OutlineMatchSettings(interior=True, interior_gate=3.0))
    assert np.abs(found.match.residuals(moved)).max() <= 3.3
    assert len(found.match.where) > 20
    wide = interior_matches(moved, sighting, OutlineMatchSettings(interior=True, interior_gate=12.0))
    assert len(wide.match.where) > len(found.match.where)


def test_only_edges_of_the_same_limb_match(scene):
    posed, _, sighting = scene
    others = replace(sighting, interior=replace(sighting.interior, limb=sighting.interior.limb + 7))
    assert interior_matches(posed, others, OutlineMatchSettings(interior=True)) is None


def test_without_interior_edges_there_are_no_matches(scene):
    posed, _, sighting = scene
    for edges in (None, InteriorEdges.none()):
        assert interior_matches(posed, replace(sighting, interior=edges), OutlineMatchSettings(interior=True)) is None
    assert interior_matches(posed, sighting, OutlineMatchSettings()) is None


def test_interior_edges_determine_what_one_silhouette_does_not(scene):
    truth, camera, sighting = scene
    column = worlds.column(truth.body.skeleton, "left_shoulder_lift")
    angles = truth.pose.angles.copy()
    angles[column] += np.deg2rad(6)
    start = replace(truth, pose=replace(truth.pose, angles=angles))
    wrist = truth.body.skeleton.segment("left_hand")
    errors = []
    for edges in (sighting.interior, None):
        seen = [replace(sighting, interior=edges)]
        prior = (JointLimits(), Habit(share=0.01))
        fit = fit_pose(start, seen, prior, schedule=SCHEDULE)
        # What the camera does not see, depth, is left out.
        apart = camera.project(fit.posed.segment_origin[wrist]) - camera.project(truth.segment_origin[wrist])
        errors.append(float(np.linalg.norm(apart)))
    assert errors[0] < 1.0
    assert errors[0] < 0.5 * errors[1]


def test_outline_and_edges_are_seen_in_one_drawing(scene):
    posed, camera, sighting = scene
    alone = [see(posed, sighting, OutlineMatchSettings(interior=True)) for see in (outline_matches, interior_matches)]
    both = all_matches(posed, sighting, OutlineMatchSettings(interior=True))
    for one, other in zip(both, alone, strict=True):
        np.testing.assert_array_equal(one.match.where.face, other.match.where.face)
        np.testing.assert_array_equal(one.match.offsets, other.match.offsets)
    assert len(all_matches(posed, sighting, OutlineMatchSettings())) == 1
    empty_outline = ObservedOutline.of(camera, np.zeros((camera.height, camera.width), bool))
    assert all_matches(posed, empty_outline, OutlineMatchSettings(interior=True)) == []

"""Estimation of a person's metaballs from measured points and silhouettes together."""

from dataclasses import replace

import numpy as np
import pytest
from tests import worlds
from tests.fit import metaball_worlds as world

from marey.body.articulation.pose import Pose, PosedBody
from marey.body.metaballs.metaball_person import metaball_body, metaball_space, single_radii
from marey.body.people.person import family_body, person_body
from marey.errors import SettingProblem
from marey.fit.points.person_tracks import PersonTracks
from marey.fit.points.shape import (
    ShapeEstimate,
    ShapeSettings,
    SurfaceMeasurements,
    evenly_spaced,
    final_covariances,
    has_simple_limbs,
    metaballs_like,
    more_detailed,
    refine_shape,
    with_coordinates,
    with_free_trunk,
)
from marey.fit.points.shape_start import start_from_clicked_joints
from marey.fit.points.surface_points import PersonPoints
from marey.fit.recipes.sequence import refine_sequence
from marey.fit.recipes.start_joints import clicked_joints
from marey.fit.search.levels import FrameLevels


@pytest.fixture(scope="module")
def arm():
    return person_body("fine", preset="right_arm")


def test_the_trunk_of_an_arms_preset_is_freed(arm):
    whole = with_free_trunk(arm)
    names = {c.name for c in whole.skeleton.coordinates}
    assert {c.name for c in arm.skeleton.coordinates} < names
    assert "lumbar_flexion" in names
    assert "left_elbow_flexion" not in names
    pose = Pose(np.zeros(3), np.eye(3), np.arange(len(arm.skeleton) - 6) * 0.05)
    moved = with_coordinates(pose, arm, whole)
    np.testing.assert_allclose(PosedBody(whole, moved).vertices, PosedBody(arm, pose).vertices, atol=1e-12)


@pytest.mark.slow
def test_metaballs_keep_a_learned_persons_numbers_and_preset(arm, rng):
    body = with_free_trunk(
        arm.with_numbers(0.5 * rng.normal(size=len(arm.space)) * np.sqrt(np.diag(arm.space.prior_covariance)))
    )
    balls = metaballs_like(body)
    np.testing.assert_array_equal(balls.numbers, body.numbers)
    np.testing.assert_allclose(balls.joint_centres, body.joint_centres, atol=1e-9)
    np.testing.assert_array_equal(balls.faces, body.faces)
    np.testing.assert_array_equal(balls.followed, body.followed)
    used = np.unique(body.faces)
    away = np.linalg.norm((balls.vertices - body.vertices)[used], axis=1)
    assert np.median(away) < 0.005
    assert metaballs_like(balls) is balls


def test_simple_metaballs_approximate_a_body_by_lengths_and_widths(arm):
    body = with_free_trunk(arm)
    balls = metaballs_like(body, "simple")
    assert "upperarm_width" in balls.space.names
    for name in ("right_forearm", "right_hand"):
        k = body.skeleton.segment(name)
        assert np.linalg.norm(balls.joint_centres[k] - body.joint_centres[k]) < 0.03


def test_a_scan_without_numbers_is_rejected():
    with pytest.raises(SettingProblem, match=r"Leave out body \(--body\)"):
        metaballs_like(family_body("coarse"))


@pytest.mark.slow
def test_more_detail_keeps_the_shape(arm):
    simple = metaballs_like(with_free_trunk(arm), "simple")
    full = more_detailed(simple, "full")
    assert len(full.metaballs.mean) > len(simple.metaballs.mean)
    used = np.unique(arm.faces)
    assert np.median(np.linalg.norm((full.vertices - simple.vertices)[used], axis=1)) < 0.012
    assert has_simple_limbs(simple)
    assert not has_simple_limbs(full)
    assert more_detailed(full, "full") is full
    single = more_detailed(full, "single")
    assert len(single.space) > 3 * len(full.space)
    np.testing.assert_allclose(single.vertices, full.vertices, atol=1e-4)
    assert not any("thigh_ball" in name for name in single.space.names)
    assert more_detailed(single, "single") is single
    with pytest.raises(ValueError, match="no metaballs"):
        more_detailed(arm, "full")


def test_single_radii_move_one_ball_on_both_sides():
    space = single_radii(metaball_space("simple"), ["forearm"], sd=0.1)
    at = space.names.index("forearm_ball_2_depth")
    moved = np.argwhere(space.radii_modes[at])
    assert len(moved) == 2
    sides = {space.mean.skeleton.segment_names[space.mean.segment[ball]] for ball, _ in moved}
    assert sides == {"left_forearm", "right_forearm"}
    assert set(moved[:, 1]) == {1}
    assert space.prior_covariance[at, at] == pytest.approx(0.01)
    numbers = np.zeros(len(space))
    numbers[at] = 0.1
    np.testing.assert_allclose(
        space.balls(numbers).radii[moved[:, 0], 1], 1.1 * space.mean.radii[moved[:, 0], 1], rtol=1e-12
    )


def test_frames_are_evenly_spaced():
    assert evenly_spaced([3, 4, 5, 6, 7], 3) == [3, 5, 7]
    assert evenly_spaced([3], 60) == [3]


@pytest.fixture(scope="module")
def scene():
    """An arm of other sizes over five frames, points from one side, and a start beside."""
    rng = np.random.default_rng(31)
    space = world.arm_space()
    truth = np.zeros(len(space))
    truth[[space.names.index(f"{name}") for name in ("upperarm_length", "forearm_width")]] = 0.05, 0.08
    body = world.person(space, truth)
    first = world.arm_poses(rng, 1)[0]
    change = np.concatenate([np.zeros(6), np.deg2rad([1, 2, 1, 6, 2, 0])])
    poses = {f: first.step(f * change) for f in range(5)}
    points = {f: world.measured(body, p, 1200, 5e-4, rng, side=np.array([0, -1.0, 0])) for f, p in poses.items()}
    start = {f: p.step(rng.normal(size=len(body.skeleton)) * 0.015) for f, p in poses.items()}
    return space, truth, body, poses, points, start


@pytest.mark.slow
@pytest.mark.parametrize("outlines", [False, True], ids=["points", "points and silhouettes"])
def test_shape_and_motion_are_recovered(scene, outlines):
    space, truth, body, poses, points, start = scene
    cameras = worlds.ring(3)
    posed = [PosedBody(body, pose) for pose in poses.values()]
    seen = worlds.levels(posed, cameras, noise=0.5, rng=np.random.default_rng(3))
    blank = FrameLevels(cameras, lambda f: [np.zeros((240, 200), bool) for _ in cameras], 1.0)
    generic = replace(metaball_body(space), skeleton=space.mean.skeleton)
    found = refine_shape(
        ShapeEstimate(generic, start, 0.004, 3.2), seen if outlines else blank,
        SurfaceMeasurements(PersonPoints(by_frame=points)), rate=30.0, repeats=3, settings=ShapeSettings(),
        scale_m=0.02,
    )  # fmt: skip
    numbers, covariance = found.body.numbers, found.body.numbers_covariance
    for name in ("upperarm_length", "forearm_width"):
        at = space.names.index(name)
        assert abs(numbers[at] - truth[at]) < 4 * np.sqrt(covariance[at, at])
        assert abs(numbers[at] - truth[at]) < 0.4 * abs(truth[at])
    # Half a millimetre of noise is known; what is left is the model's, and there is nearly none.
    assert found.model_sd_m < 0.0015
    for joint, most in (("right_forearm", 0.006), ("right_hand", 0.008)):
        k = body.skeleton.segment(joint)
        away = [
            PosedBody(found.body, found.poses[f]).segment_origin[k] - PosedBody(body, p).segment_origin[k]
            for f, p in poses.items()
        ]
        assert np.mean(np.linalg.norm(away, axis=1)) < most


@pytest.mark.slow
def test_balls_keep_a_size_where_points_pull_them_to_nothing(scene):
    """A sequence's step that no metaballs follow is shortened, instead of ending the run."""
    space, _, _, _, points, start = scene
    small = {f: replace(own, points=own.points.mean(0) + 0.02 * (own.points - own.points.mean(0)))
             for f, own in points.items()}  # fmt: skip
    loose = replace(space, prior_covariance=1e4 * space.prior_covariance)
    blank = FrameLevels(worlds.ring(2), lambda f: [np.zeros((240, 200), bool)] * 2, 1.0)
    measured = SurfaceMeasurements(PersonPoints(by_frame=small, model_sd_m=1e-3, scale_m=np.inf))
    found = refine_sequence(
        list(start), list(start.values()), world.person(loose, np.zeros(len(space))), blank, rate=30.0, rounds=3,
        shape_frames=list(start), settings=ShapeSettings().sequence, extra_terms=measured.terms_of_round,
    )  # fmt: skip
    assert loose.is_possible(found.body.numbers)
    assert not np.array_equal(found.body.numbers, np.zeros(len(space)))


def carried(posed, count, rng, noise=3e-4):
    """Points attached to the arm's segments, in all frames."""
    body = posed[0].body
    strongest = body.vertex_segments[np.arange(len(body.vertices)), body.vertex_weights.argmax(1)]
    arm = [body.skeleton.segment(f"right_{name}") for name in ("upperarm", "forearm", "hand")]
    which = rng.choice(np.flatnonzero(np.isin(strongest, arm)), count)
    segment, away = strongest[which], body.vertices[which] - body.joint_centres[strongest[which]]
    position = [p.segment_origin[segment] + np.einsum("nab,nb->na", p.segment_rotation[segment], away) for p in posed]
    return np.array(position) + rng.normal(size=(len(posed), count, 3)) * noise


@pytest.mark.slow
def test_tracked_points_determine_a_limbs_rotation_about_itself(scene):
    space, _, body, poses, points, start = scene
    rng = np.random.default_rng(4)
    position = carried([PosedBody(body, pose) for pose in poses.values()], 300, rng)
    tracks = PersonTracks(
        frames=np.arange(5), position=position, variance=np.full(position.shape[:2], 9e-8), patch_m=0.005
    )  # fmt: skip
    blank = FrameLevels(worlds.ring(2), lambda f: [np.zeros((240, 200), bool)] * 2, 1.0)
    generic = replace(metaball_body(space), skeleton=space.mean.skeleton)
    turn = 6 + [c.name for c in body.skeleton.coordinates].index("right_shoulder_turn")
    change = []
    for followed in (None, tracks):
        found = refine_shape(
            ShapeEstimate(generic, start, 0.004, 3.2), blank,
            SurfaceMeasurements(PersonPoints(by_frame=points), followed),
            rate=30.0, repeats=2, settings=ShapeSettings(), scale_m=0.02,
        )  # fmt: skip
        off = np.array([found.poses[f].change_to(pose)[turn] for f, pose in poses.items()])
        change.append(np.std(off))
        assert found.skin_sd_m < 0.003 if followed else found.skin_sd_m == ShapeEstimate.skin_sd_m
    # Points determine what all frames have in common; tracks determine the rotation from frame to frame.
    assert change[1] < 0.75 * change[0]
    assert change[1] < np.deg2rad(0.1)


def test_the_final_covariance_counts_correlated_points_as_one(scene):
    space, truth, body, poses, points, _ = scene
    blank = FrameLevels(worlds.ring(2), lambda f: [np.zeros((240, 200), bool)] * 2, 1.0)
    found = ShapeEstimate(body, poses, 0.002, 3.2)
    measured = SurfaceMeasurements(PersonPoints(by_frame=points)).with_uncertainty(found)
    plain = refine_sequence(
        list(poses), list(poses.values()), body, blank, rate=30.0, rounds=1, shape_frames=list(poses),
        settings=ShapeSettings().sequence, extra_terms=measured.terms_of_round,
    )  # fmt: skip
    stated = list(final_covariances(found, blank, measured, rate=30.0, settings=ShapeSettings()))
    assert [p for fit in stated for p in fit.poses] == list(poses.values())
    np.testing.assert_array_equal(stated[-1].body.numbers, truth)
    at = space.names.index("forearm_width")
    sds = [np.sqrt(fit.body.numbers_covariance[at, at]) for fit in (plain, stated[-1])]
    assert 1.5 * sds[0] < sds[1] < np.sqrt(space.prior_covariance[at, at])


@pytest.mark.slow
def test_clicked_joints_determine_what_points_of_one_side_do_not(arm):
    rng, cameras = np.random.default_rng(6), worlds.ring(3)
    whole = with_free_trunk(arm)
    truth = PosedBody(whole, Pose(np.zeros(3), np.eye(3), 0.3 * rng.normal(size=len(whole.skeleton) - 6)))
    joints = ("right_shoulder", "right_elbow", "right_wrist")
    segments = [whole.skeleton.segment(f"right_{name}") for name in ("upperarm", "forearm", "hand")]
    pixels = np.stack([camera.project(truth.segment_origin[segments]) for camera in cameras])
    clicked = clicked_joints(cameras, joints, pixels, truth)
    for own, camera in zip(clicked, cameras, strict=True):
        away = np.linalg.norm(truth.segment_origin.mean(0) - camera.centre)
        assert own.sigma_px == pytest.approx(0.01 * camera.matrix[0, 0] / away)
    points = {7: world.measured(metaballs_like(whole), truth.pose, 400, 1e-3, rng, side=np.array([0, -1.0, 0]))}
    begun = start_from_clicked_joints(truth, {7: clicked}, points, ShapeSettings())
    moved = PosedBody(begun.body, begun.poses[7]).segment_origin[segments] - truth.segment_origin[segments]
    assert np.linalg.norm(moved, axis=1).max() < 0.01

"""Tracks of a rendered, textured body: recovered turns within the stated intervals, and where nothing is to be seen."""

from dataclasses import replace

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.fit.patches.patch_geometry import information_along, positive_part, surface_at, with_more_noise
from marey.fit.patches.patch_settings import SurfaceTrackSettings
from marey.fit.patches.patch_tracker import segment_axes, tracked_segments
from marey.fit.patches.surface_tracks import SurfaceTrackTerms, track_surface
from marey.fit.recipes.detections import JoinedTerms
from marey.fit.recipes.frame_observations import FrameObservations
from marey.fit.recipes.sequence import refine_sequence
from marey.fit.recipes.sequence_equations import LocalTerms
from marey.geometry import rotations
from marey.observations.correspondence import view_of
from marey.process import limited_cores

FRAMES, NOISE = 14, 2.0
TURN = np.deg2rad(14)


def pattern(points):
    """Grey values of a texture of some centimetres, by the place on the body at rest."""
    x, y, z = (70 * points).T
    return 110 + 25 * (np.sin(x + 1.3 * np.sin(0.7 * z)) + np.sin(y + 0.4 * z) + np.sin(1.2 * z + np.cos(x)))


def picture(posed, camera, rng, *, textured=True):
    """An image of the body, with noise."""
    view = view_of(posed, camera)
    rows, columns = np.nonzero(view.face >= 0)
    pixels = np.stack([columns, rows], 1) + np.array(view.corner)
    face, weights = surface_at(view, posed.body.faces, pixels)
    rest = np.einsum("nk,nkj->nj", weights, posed.body.vertices[posed.body.faces[face]])
    grey = np.full((camera.height, camera.width), 60.0)
    grey[pixels[:, 1], pixels[:, 0]] = pattern(rest) if textured else 120.0
    grey += rng.normal(size=grey.shape) * NOISE
    return np.repeat(np.clip(np.rint(grey), 0, 255).astype(np.uint8)[..., None], 3, 2)


def with_turn(pose, body, turn):
    angles = np.array(pose.angles)
    angles[worlds.column(body.skeleton, "head_rotation")] += turn
    return replace(pose, angles=angles)


@pytest.fixture(scope="module")
def world():
    """A person whose head turns, and the poses without that turn."""
    rng = np.random.default_rng(11)
    body, cameras = worlds.person("fine"), worlds.ring(size=(360, 440), focal=560.0)
    start = worlds.swing(body, FRAMES)
    turns = TURN * np.sin(2 * np.pi * np.arange(FRAMES) / FRAMES)
    truth = [PosedBody(body, with_turn(pose, body, turn)) for pose, turn in zip(start, turns, strict=True)]
    images = {f: [picture(posed, camera, rng) for camera in cameras] for f, posed in enumerate(truth)}
    masks = worlds.seen(truth, cameras)
    return body, cameras, start, truth, images, masks


def reader_of(images):
    return lambda frames, cameras: ((f, [images[f][c] for c in cameras]) for f in frames)


def tracks_of(world, poses=None, *, images=None, **settings):
    body, cameras, start, _, own, masks = world
    images = images or own
    return track_surface(
        cameras, reader_of(images), lambda f, c: masks[f][c],
        dict(enumerate(start if poses is None else poses)), body, SurfaceTrackSettings(**settings),
    )  # fmt: skip


@pytest.mark.slow
def test_tracked_patches_lie_where_the_body_really_is(world):
    _, _, _, truth, _, _ = world
    tracks = tracks_of(world, [posed.pose for posed in truth])
    squares = []
    for frame, batches in tracks.by_frame.items():
        for batch in batches:
            away = batch.derivatives(truth[frame]).residual
            squares.append(np.einsum("ni,nij,nj->n", away, batch.information, away))
    squares = np.concatenate(squares)
    assert len(squares) > 500
    # Two degrees of freedom each. The variances include slip and shading, which a rendered body does not have.
    assert np.mean(squares) / 2 < 1.2
    assert {"head", "thorax", "left_thigh", "right_upperarm"} <= set(tracks.counts())
    assert all(count >= 1 and length >= 3 for count, length in tracks.counts().values())
    assert "left_hand" not in tracks.counts()


@pytest.mark.slow
def test_tracks_recover_the_turn_of_the_head(world):
    body, cameras, start, truth, _, _ = world
    levels = worlds.levels(truth, cameras)
    settings = SurfaceTrackSettings()

    def terms(poses, body):
        return SurfaceTrackTerms(tracks_of(world, list(poses.values())), settings.offset_sd_m)

    fit = refine_sequence(range(FRAMES), start, body, levels, rate=30, rounds=3, extra_terms=terms)
    s = body.skeleton.segment_names.index("head")
    both = [
        [posed.segment_rotation[s] for posed in truth],
        [PosedBody(fit.body, p).segment_rotation[s] for p in fit.poses],
    ]
    since = [np.array([m @ rotation[0].T for m in rotation]) for rotation in both]
    error = np.linalg.norm(rotations.log(since[1] @ np.swapaxes(since[0], 1, 2)), axis=1)
    own = [6 + worlds.column(body.skeleton, name) for name in ("neck_rotation", "head_rotation")]
    stated = np.sqrt(fit.covariance[:, own][:, :, own].sum((1, 2)))
    # Without tracks the error is that of the start, up to the head's outline.
    assert np.abs(error).max() < 0.35 * TURN
    assert (error < 3.0 * np.sqrt(stated**2 + stated[0] ** 2) + 0.01).mean() > 0.9


@pytest.mark.slow
def test_a_jump_of_the_poses_does_not_end_the_tracks(world):
    body, _, _, truth, _, _ = world
    poses = [with_turn(posed.pose, body, 0.9 if f >= 7 else 0.0) for f, posed in enumerate(truth)]
    tracks = tracks_of(world, poses)
    s = body.skeleton.segment_names.index("head")
    change = np.array([tracks.turns[f][s] for f in range(FRAMES)])
    # From the seventh frame on the pose is turned too far by 0.9 rad, which the patches undo at once.
    assert change[7] == pytest.approx(-0.9, abs=0.1)
    assert np.abs(np.delete(change, [0, 7])).max() < 0.1
    lengths = tracks.counts()["head"][1]
    assert lengths > 8


@pytest.mark.slow
def test_a_body_without_texture_has_no_tracks(world):
    _, cameras, _, truth, _, _ = world
    rng = np.random.default_rng(3)
    plain = {f: [picture(p, camera, rng, textured=False) for camera in cameras] for f, p in enumerate(truth)}
    counts, textured = (tracks_of(world, images=images).counts() for images in (plain, None))
    # Noise looks like a weak texture here and there.
    assert sum(count for count, _ in counts.values()) < 0.1 * sum(count for count, _ in textured.values())


def test_images_without_a_silhouette_have_no_tracks(world):
    body, cameras, start, _, images, masks = world
    empty = [[np.zeros_like(mask) for mask in frame] for frame in masks]
    tracks = tracks_of((body, cameras, start, None, images, empty))
    assert tracks.counts() == {}
    terms = SurfaceTrackTerms(tracks, 0.1)
    assert terms.local(0, PosedBody(body, start[0])) is None
    away = [replace(pose, translation=pose.translation + np.array([0.0, 0.0, 40.0])) for pose in start]
    assert tracks_of(world, away).counts() == {}


@pytest.mark.slow
def test_tracks_end_where_frames_are_missing(world):
    body, cameras, start, _, images, masks = world
    poses = {f: pose for f, pose in enumerate(start) if f not in (6, 7)}
    tracks = track_surface(cameras, reader_of(images), lambda f, c: masks[f][c], poses, body)
    before = {int(t) for f in range(6) for batch in tracks.by_frame[f] for t in batch.tracks}
    after = {int(t) for f in range(8, FRAMES) for batch in tracks.by_frame[f] for t in batch.tracks}
    assert before
    assert after
    assert not before & after


@pytest.mark.slow
@pytest.mark.parametrize("cores", [2, 3, 4])
def test_the_tracks_do_not_depend_on_the_number_of_processes(world, cores):
    with limited_cores(1):
        alone = tracks_of(world)
    with limited_cores(cores):
        shared = tracks_of(world)
    for frame in range(FRAMES):
        np.testing.assert_array_equal(shared.turns[frame], alone.turns[frame])
        for own, other in zip(shared.by_frame[frame], alone.by_frame[frame], strict=True):
            assert own.camera is other.camera
            for name in ("tracks", "segments", "directions", "pixels", "information"):
                np.testing.assert_array_equal(getattr(own, name), getattr(other, name))


def test_tracks_join_other_terms(world):
    body, _, start, _, _, _ = world
    own = SurfaceTrackTerms(tracks_of(world), 0.1)
    assert isinstance(own, LocalTerms)
    joined, posed = JoinedTerms((own, FrameObservations({}))), PosedBody(body, start[3])
    local, expected = joined.local(3, posed), own.local(3, posed)
    assert local is not None
    assert expected is not None
    np.testing.assert_array_equal(local.pose, expected.pose)
    assert joined.local_sd == 0.1
    assert not joined.terms(3, posed)[0].any()
    assert JoinedTerms((FrameObservations({}),)).local(3, posed) is None


@pytest.mark.slow
def test_the_equations_are_those_of_the_observations(world):
    body, _, start, _, _, _ = world
    tracks, posed = tracks_of(world), PosedBody(body, start[5])
    found = SurfaceTrackTerms(tracks, 0.1).local(5, posed)
    white = [batch.linearize(posed) for batch in tracks.by_frame[5]]
    jacobian, residual = (
        np.concatenate(parts) for parts in zip(*((w.jacobian, w.residual) for w in white), strict=True)
    )
    assert found is not None
    np.testing.assert_allclose(found.pose, jacobian.T @ jacobian, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(found.pose_gradient, jacobian.T @ residual, rtol=1e-6, atol=1e-6)
    batch, step = tracks.by_frame[5][0], 1e-6
    slopes = batch.derivatives(posed).by_offset
    along = np.einsum("nij,njk->nik", posed.segment_rotation[batch.segments], batch.directions)
    points = posed.points(batch.where)
    for k in range(3):
        ahead, back = (batch.camera.project(points + sign * step * along[..., k]) for sign in (1, -1))
        np.testing.assert_allclose(slopes[..., k], (ahead - back) / (2 * step), rtol=1e-4, atol=1e-3)


def test_information_of_two_sources_and_along_a_direction():
    information = np.array([[[4.0, 0.0], [0.0, 0.0]]])
    np.testing.assert_allclose(with_more_noise(information, np.array([0.25])), [[[2.0, 0.0], [0.0, 0.0]]])
    np.testing.assert_allclose(information_along(information, np.array([[3.0, 0.0]]), 5.0), [36.0])
    np.testing.assert_allclose(information_along(information, np.array([[0.0, 3.0]]), 5.0), [0.0])
    np.testing.assert_allclose(positive_part(np.diag([2.0, -1.0])[None]), np.diag([2.0, 0.0])[None], atol=1e-12)


def test_segments_and_their_axes():
    body = worlds.person()
    names = body.skeleton.segment_names
    found = tracked_segments(body)
    assert found[names.index("neck")] == names.index("thorax")
    assert found[names.index("left_hand")] == -1
    assert found[names.index("left_thigh")] == names.index("left_thigh")
    axes = segment_axes(body)
    np.testing.assert_allclose(np.linalg.norm(axes, axis=1), 1.0)
    assert axes[names.index("left_thigh"), 2] < -0.95
    np.testing.assert_array_equal(axes[names.index("head")], [0, 0, 1])

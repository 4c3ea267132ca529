"""Jumps of a turn: undone where the silhouettes agree, left alone otherwise."""

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.fit.patches.surface_tracks import SurfaceTracks
from marey.fit.patches.turn_jumps import TURNED_BY, outline_disagreement, without_jumps
from marey.observations.prior import JointLimits

FRAMES, JUMP = 12, 1.2


def head_rotation(pose, body):
    return sum(pose.angles[worlds.column(body.skeleton, name)] for name in TURNED_BY["head"])


@pytest.fixture
def world():
    """Poses whose head is turned wrongly in the second half, and tracks that show it."""
    body = worlds.person()
    column = worlds.column(body.skeleton, "head_rotation")
    poses, changes = {}, {}
    for f, pose in enumerate(worlds.swing(body, FRAMES)):
        angles = np.array(pose.angles)
        angles[column] += JUMP if f >= 7 else 0.0
        poses[f] = type(pose)(pose.translation, pose.rotation, angles)
        change = np.full(len(body.skeleton.segment_names), np.nan)
        change[body.skeleton.segment_names.index("head")] = -JUMP if f == 7 else 0.0
        changes[f] = change
    return body, poses, SurfaceTracks({}, body.skeleton.segment_names, changes)


def test_the_answer_that_agrees_with_the_silhouettes_is_taken(world):
    body, poses, tracks = world

    def disagreement(tried):
        return sum(abs(head_rotation(pose, body)) for pose in tried.values()) + 1.0

    found = without_jumps(tracks, poses, body, disagreement)
    turns = np.array([head_rotation(pose, body) for pose in found.values()])
    # The levels that are tried lie on a grid of 0.25 rad.
    assert np.abs(turns).max() < 0.13
    other = without_jumps(tracks, poses, body, lambda tried: -disagreement(tried) + 100.0)
    assert np.ptp([head_rotation(pose, body) for pose in other.values()]) < 1e-9


def test_poses_stay_where_no_answer_is_better_or_nothing_jumps(world):
    body, poses, tracks = world
    assert without_jumps(tracks, poses, body, lambda tried: 1.0) == poses
    still = SurfaceTracks({}, tracks.segment_names, {f: 0.1 * change for f, change in tracks.turns.items()})
    lost = SurfaceTracks({}, tracks.segment_names, {f: change * np.nan for f, change in tracks.turns.items()})
    for other in (still, lost):
        assert without_jumps(other, poses, body, lambda tried: pytest.fail("nothing is to be compared")) == poses


def test_a_body_without_a_head_has_nothing_to_turn():
    body = worlds.person()
    tracks = SurfaceTracks({}, ("pelvis",), {})
    one = {0: worlds.pose(body)}
    assert without_jumps(tracks, one, body, lambda tried: pytest.fail("nothing is to be compared")) == one


def test_disagreement_is_least_for_the_true_poses():
    body, cameras = worlds.person(), worlds.ring()
    truth = worlds.swing(body, 3)
    levels = worlds.levels([PosedBody(body, pose) for pose in truth], cameras)
    disagreement = outline_disagreement(levels, body, (JointLimits(),))
    away = dict(enumerate(worlds.swing(body, 3, first={"left_shoulder_lift": 120, "head_rotation": 70})))
    right, wrong = disagreement(dict(enumerate(truth))), disagreement(away)
    assert right < 0.5 * wrong

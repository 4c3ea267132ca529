"""Why one camera contradicts the others: the kind, the instant and the size of a change are recovered."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from tests.made_boards import BOARD, MadeSession, made_session

from marey.calibration.adjustment.solve import SolvedSession, solve_session
from marey.calibration.adjustment.state import LENS
from marey.calibration.boards.corners import CornerSet
from marey.calibration.boards.still import join_still
from marey.calibration.quality.causes import LEAST_GAIN, Cause, best_cause, explanations, find_cause
from marey.calibration.quality.reference_views import DELAY, ZOOM, reference_boards
from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.geometry.rigid import RigidTransform

CAMERA, START = 2, 55


@cache
def session() -> MadeSession:
    return made_session(cameras=4, pictures=110, seed=3)


@cache
def solved() -> SolvedSession:
    return solve_session(join_still(session().corners).corners, BOARD, model=False)


def with_changed_camera(change: Callable[[Camera], Camera]) -> CornerSet:
    """The corners if a camera had been another from a picture on."""
    made = session()
    rig = Rig(tuple(change(each) if k == CAMERA else each for k, each in enumerate(made.rig)))
    other = made_session(rig=rig, poses=list(made.world_from_board), seed=77).corners
    rows = [each for each in made.corners.sightings() if each[1] != CAMERA or each[0] < START]
    rows += [each for each in other.sightings() if each[1] == CAMERA and each[0] >= START]
    return CornerSet.gather(made.corners.cameras, made.corners.sizes, made.corners.pictures, rows)


def cause_in(corners: CornerSet) -> Cause:
    """The explanation, given cameras that are right before the change."""
    cameras = range(len(corners.cameras))
    found = best_cause([each for k in cameras for each in explanations(solved(), corners, k, videos=True)])
    assert found is not None
    assert found.camera == CAMERA
    return found


def first_after() -> int:
    """The first picture after the change that another camera shares."""
    corners = session().corners
    own = set(corners.picture[corners.camera == CAMERA].tolist())
    return min(int(each) for each in corners.picture[corners.camera != CAMERA] if each >= START and each in own)


@pytest.mark.slow
def test_a_clean_session_has_no_cause():
    corners = session().corners
    assert find_cause(solved(), corners, videos=True) is None
    found = [each for k in range(4) for each in explanations(solved(), corners, k, videos=True)]
    assert best_cause(found) is None


@pytest.mark.slow
def test_a_camera_that_moved_is_measured():
    step = RigidTransform.from_vector(np.radians([0.6, -0.4, 0.3]), np.array([0.01, 0.0, -0.006]))
    found = cause_in(with_changed_camera(lambda each: replace(each, camera_from_world=step @ each.camera_from_world)))
    assert (found.kind, found.picture) == ("moved", first_after())
    # The corners determine the change to some 0.02 degrees; its square, 1e-4 rad, is neglected.
    np.testing.assert_allclose(found.change[LENS : LENS + 3], step.rotation_vector, atol=1e-3)
    assert np.linalg.norm(found.change[LENS + 3 : LENS + 6]) == pytest.approx(np.hypot(0.01, 0.006), abs=4e-3)


@pytest.mark.slow
def test_a_lens_that_changed_is_measured():
    def zoomed(each: Camera) -> Camera:
        matrix = np.array(each.matrix)
        matrix[:2, :2] *= 1.01
        return replace(each, matrix=matrix)

    found = cause_in(with_changed_camera(zoomed))
    assert (found.kind, found.picture) == ("lens-changed", first_after())
    assert found.change[ZOOM] == pytest.approx(0.01, abs=1e-3)


def turned_from_start() -> CornerSet:
    """The corners if the image of a camera had been upside down from a picture on."""
    corners = session().corners
    late = (corners.camera == CAMERA) & (corners.picture >= START)
    size = np.array(corners.sizes[CAMERA])
    return replace(corners, pixels=np.where(late[:, None], size - 1 - corners.pixels, corners.pixels))


@pytest.mark.slow
def test_pictures_that_are_upside_down_are_named():
    found = cause_in(turned_from_start())
    assert (found.kind, found.picture) == ("turned", first_after())


@pytest.mark.slow
def test_boards_about_which_the_other_cameras_contradict_each_other_accuse_no_camera():
    # Where the turned camera and another one see the board, no camera can be compared with the two.
    turned = turned_from_start()
    other = (CAMERA + 1) % 4
    seen = [set(turned.picture[turned.camera == k].tolist()) for k in range(4)]
    rest = [k for k in range(4) if k not in (CAMERA, other)]
    contradictory = [
        each for each in seen[other] & seen[CAMERA] if each >= START and any(each in seen[k] for k in rest)
    ]
    assert contradictory
    assert not reference_boards(solved(), turned, other).known[contradictory].any()
    assert reference_boards(solved(), session().corners, other).known[contradictory].all()
    assert all(each.gain < LEAST_GAIN for each in explanations(solved(), turned, other, videos=True))


@pytest.mark.slow
def test_lost_pictures_are_counted():
    corners = session().corners
    picture = corners.picture - np.where((corners.camera == CAMERA) & (corners.picture >= START + 2), 2, 0)
    lost = replace(corners, picture=picture)
    # The two pictures before the gap are those that were lost.
    keep = (corners.camera != CAMERA) | (corners.picture < START) | (corners.picture >= START + 2)
    lost = lost.subset(keep)
    found = cause_in(lost.ordered(np.lexsort((lost.corner, lost.camera, lost.picture))))
    assert (found.kind, found.lag) == ("lost", -2)


def test_an_explanation_with_unknowns_for_each_picture_counts_only_alone():
    late = Cause(
        kind="late", camera=0, picture=None, change=0.2 * np.eye(18)[DELAY], lag=0, gain=40 * LEAST_GAIN, share=0.9
    )  # fmt: skip
    free = replace(late, kind="unsteady", gain=50 * LEAST_GAIN, share=0.95)
    assert best_cause([free, late]) is late
    assert best_cause([free]) is free
    assert best_cause([replace(late, share=0.3), replace(free, share=0.6)]) is None
    assert best_cause([replace(late, gain=0.5 * LEAST_GAIN)]) is None

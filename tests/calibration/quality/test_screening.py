"""What is wrong with one camera is found before any common solution."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from tests.made_boards import BOARD, MadeSession, made_session

from marey.arrays import Floats
from marey.calibration.adjustment.start import start_lenses
from marey.calibration.boards.corners import CornerSet
from marey.calibration.quality.reference_views import DELAY, READOUT
from marey.calibration.quality.screening import Screening, screened
from marey.calibration.sights.switches import exchanged_corners
from marey.geometry.rigid import RigidTransform

CAMERA, START, PICTURES = 1, 160, 320


@cache
def session() -> MadeSession:
    return made_session(cameras=3, pictures=PICTURES, seed=3)


def between(poses: tuple[RigidTransform, ...], time: Floats) -> list[RigidTransform]:
    """The poses of the board at other times, in pictures."""
    found = []
    for each in np.clip(time, 0, len(poses) - 1):
        low = min(int(each), len(poses) - 2)
        step = poses[low].inverse() @ poses[low + 1]
        share = each - low
        found.append(poses[low] @ RigidTransform.from_vector(share * step.rotation_vector, share * step.translation))
    return found


def with_clock(time: Floats) -> CornerSet:
    """The corners if the pictures of one camera had been taken at other times, in pictures."""
    made = session()
    other = made_session(rig=made.rig, poses=between(made.world_from_board, time), seed=77).corners
    rows = [each for each in made.corners.sightings() if each[1] != CAMERA]
    rows += [each for each in other.sightings() if each[1] == CAMERA]
    return CornerSet.gather(made.corners.cameras, made.corners.sizes, made.corners.pictures, rows)


def screening_of(corners: CornerSet, *, videos: bool = True) -> Screening:
    return screened(corners, BOARD, start_lenses(corners, BOARD), videos=videos)


def first_common(corners: CornerSet, cameras: tuple[int, ...]) -> int:
    """The first picture from the change on that a changed camera shares with another one."""
    seen = np.unique(np.stack([corners.picture, corners.camera], axis=-1), axis=0)
    several = np.bincount(seen[:, 0]) > 1
    own = seen[np.isin(seen[:, 1], cameras), 0]
    return int(min(each for each in own if each >= START and several[each]))


@pytest.mark.slow
def test_a_clean_session_is_kept():
    found = screening_of(session().corners)
    assert found.cause is None
    assert found.kept(session().corners) is session().corners


@pytest.mark.slow
def test_cameras_that_were_exchanged_are_found_and_left_out_on_one_side():
    corners = session().corners
    late = exchanged_corners(corners, 0, 1).sightings()
    rows = [each for each in corners.sightings() if each[0] < START] + [each for each in late if each[0] >= START]
    mixed = CornerSet.gather(corners.cameras, corners.sizes, corners.pictures, rows)
    found = screening_of(mixed, videos=False)
    assert found.cause is not None
    assert (found.cause.kind, found.cause.camera, found.cause.other) == ("exchanged", 0, 1)
    assert found.cause.picture == first_common(mixed, (0, 1))
    kept = found.kept(mixed)
    own = kept.picture[kept.camera != 2]
    assert own.max() < found.cause.picture if found.later else own.min() >= found.cause.picture
    assert len(found.left_out) + len(kept.view_starts) == len(mixed.view_starts)


@pytest.mark.slow
def test_pictures_that_are_upside_down_are_found():
    corners = session().corners
    late = (corners.camera == CAMERA) & (corners.picture >= START)
    size = np.array(corners.sizes[CAMERA])
    turned = replace(corners, pixels=np.where(late[:, None], size - 1 - corners.pixels, corners.pixels))
    found = screening_of(turned, videos=False)
    assert found.cause is not None
    assert (found.cause.kind, found.cause.camera, found.cameras) == ("turned", CAMERA, (CAMERA,))
    assert found.cause.picture == first_common(turned, (CAMERA,))


@pytest.mark.slow
def test_a_part_of_a_picture_is_measured():
    found = screening_of(with_clock(np.arange(PICTURES) - 0.4))
    assert found.cause is not None
    assert (found.cause.kind, found.cause.camera, found.cameras) == ("late", CAMERA, ())
    # Poses of single views are off by 1 degree or less, the board turns by 10 degrees per picture: 0.1 pictures each.
    assert found.cause.change[DELAY] == pytest.approx(0.4, abs=0.05)


@pytest.mark.slow
def test_a_drift_is_measured():
    corners = with_clock(0.99 * np.arange(PICTURES))
    found = screening_of(corners)
    assert found.cause is not None
    assert (found.cause.kind, found.cause.camera) == ("drift", CAMERA)
    pictures = np.unique(corners.picture[corners.camera == CAMERA])
    assert 0.5 * 0.01 * np.ptp(pictures) < found.cause.change[READOUT] < 1.1 * 0.01 * np.ptp(pictures)


@pytest.mark.slow
def test_lost_pictures_are_counted():
    time = np.arange(float(PICTURES))
    corners = with_clock(np.where(time >= START, time + 3, time))
    found = screening_of(corners)
    assert found.cause is not None
    assert (found.cause.kind, found.cause.camera, found.cause.lag) == ("lost", CAMERA, -3)
    assert found.cause.picture is not None
    assert found.cause.picture >= START
    assert screening_of(found.retimed(corners)).cause is None
    assert screening_of(corners, videos=False).cause is None

"""Of two views that contradict each other, the one that interrupts the motion is at fault."""

import numpy as np
import pytest

from marey.calibration.adjustment.solve import LeftOut
from marey.calibration.boards.corners import BoardSighting, CornerSet
from marey.calibration.quality.image_geometry import repeated_instants
from marey.calibration.sights.own_motion import interruption, without_cleared_views

LATE, SPEED = 5, 20.0
GRID = np.stack(np.meshgrid(np.arange(4.0), np.arange(3.0)), axis=-1).reshape(-1, 2) * 30.0


def moving(instants: dict[int, list[int]]) -> CornerSet:
    """The corners of a board that moves at a constant speed, at the instant that each picture of each camera shows."""
    rows = [
        (picture, camera, BoardSighting(
            corner=np.arange(len(GRID)), pixels=100.0 + GRID + [SPEED * instant, 0.5 * SPEED * instant],
            covariance=np.broadcast_to(0.01 * np.eye(2), (len(GRID), 2, 2)),
        ))
        for camera, shown in instants.items() for picture, instant in enumerate(shown) if instant >= 0
    ]  # fmt: skip
    names = tuple(str(k) for k in range(12))
    return CornerSet.gather(("a", "b"), ((1280, 720), (1280, 720)), names, rows)


def test_a_picture_that_shows_the_next_instant_is_one_shift_away_from_the_motion():
    corners = moving({0: [*range(LATE), LATE + 1, *range(LATE + 1, 12)], 1: list(range(12))})
    seen = {(picture, camera): found for picture, camera, found in corners.sightings()}
    assert interruption(seen, LATE, 0) == pytest.approx(1.0)
    assert interruption(seen, LATE, 1) == pytest.approx(0.0, abs=1e-9)


def test_the_view_that_continues_the_motion_is_cleared():
    corners = moving({0: [*range(LATE), LATE + 1, *range(LATE + 1, 12)], 1: list(range(12))})
    views = [LeftOut(picture=LATE, camera=camera, reason="lies 20 px from its prediction") for camera in (0, 1)]
    assert without_cleared_views(corners, views) == views[:1]
    # Where the motion around the view is unknown, neither is cleared.
    alone = corners.subset((corners.camera == 1) | (corners.picture == LATE))
    assert without_cleared_views(alone, views) == views


def test_repeated_pictures_are_found_with_and_without_another_camera():
    held = [0, 1, 2, 3, 3, 3, 3, 7, 8, 9, 10, 11]
    assert repeated_instants(moving({0: held, 1: list(range(12))}), None, 0) == [4, 5, 6]
    assert repeated_instants(moving({0: held}), None, 0) == [4, 5, 6]
    # A board that rests and moves on from there does not repeat pictures.
    rested = [0, 1, 2, 3, 3, 3, 3, 4, 5, 6, 7, 8]
    assert repeated_instants(moving({0: rested}), None, 0) == []
    assert repeated_instants(moving({0: rested, 1: rested}), None, 0) == []

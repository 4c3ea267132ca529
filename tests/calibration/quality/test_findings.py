"""Planted faults in made sessions: each is named, and nothing is found in a clean session."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from tests.made_boards import BOARD, MadeSession, made_session, seen_corners

from marey.calibration.adjustment.solve import solve_session
from marey.calibration.boards.board import CalibrationBoard
from marey.calibration.boards.corners import BoardSighting, CornerSet
from marey.calibration.boards.still import join_still
from marey.calibration.quality.cause_words import explaining
from marey.calibration.quality.contradictions import late_cameras
from marey.calibration.quality.findings import Examined, Finding, examine
from marey.calibration.quality.image_geometry import repeated_views
from marey.calibration.quality.screening import cause_of_wand
from marey.calibration.quality.settling import settled_session
from marey.calibration.quality.views import camera_quality, coverage_counts, view_quality
from marey.calibration.quality.volume import capture_grid, volume_accuracy
from marey.calibration.quality.world import centres, find_floor, in_floor_world, in_level_world
from marey.calibration.timing.wand_clocks import StatedDelay
from marey.calibration.timing.wand_faults import WandFault
from marey.cameras.rig import Rig
from marey.cameras.triangulate import triangulate
from marey.geometry.rigid import RigidTransform

FEW = 40
"""Pictures of a session that contradicts itself: its adjustment is repeated many times, each time with fewer views."""


@cache
def session(pictures: int = 70) -> MadeSession:
    return made_session(cameras=4, pictures=pictures, seed=3)


def found_in(corners: CornerSet, board: CalibrationBoard = BOARD, **known: object) -> dict[str, Finding]:
    """Return the findings by code; of several with one code, the last."""
    return {each.code: each for each in findings_of(corners, board, **known)}


def findings_of(
    corners: CornerSet, board: CalibrationBoard = BOARD, distances: dict[tuple[str, str], float] | None = None,
    rate: float | None = None,
) -> tuple[Finding, ...]:  # fmt: skip
    still = join_still(corners)
    settled = settled_session(solve_session(still.corners, board), still.corners, videos=True, still=still.first)
    solved = settled.solved
    floor = find_floor(solved, still)
    solved = in_floor_world(solved, floor) if floor is not None else in_level_world(solved)
    views = view_quality(solved)
    examined = Examined(
        solved=solved, corners=still.corners, views=views, cameras=camera_quality(solved, views),
        floor=floor is not None, together=True, distances=distances or {},
        cause=settled.cause, rate=rate, still=still.first,
    )  # fmt: skip
    return examine(examined)


def with_moved_camera(made: MadeSession, camera: int, start: int) -> CornerSet:
    """The corners after a camera was turned by 2 degrees and moved by 30 mm from a picture on."""
    own = made.rig.cameras[camera]
    turned = RigidTransform.from_vector(np.radians([1.2, 1.28, 0.96]), np.array([0.03, 0, 0])) @ own.camera_from_world
    cameras = [replace(c, camera_from_world=turned) if k == camera else c for k, c in enumerate(made.rig)]
    other = made_session(rig=Rig(tuple(cameras)), poses=list(made.world_from_board), seed=77)
    rows = []
    for source, late in ((made.corners, False), (other.corners, True)):
        for view in range(len(source.view_starts)):
            picture, seen, part = int(source.view_picture[view]), int(source.view_camera[view]), source.view_rows(view)
            if (seen == camera and picture >= start) == late:
                sighting = BoardSighting(
                    corner=source.corner[part], pixels=source.pixels[part], covariance=source.covariance[part]
                )
                rows.append((picture, seen, sighting))
    return CornerSet.gather(made.corners.cameras, made.corners.sizes, made.corners.pictures, rows)


def with_exchanged_cameras(corners: CornerSet, first: int, last: int) -> CornerSet:
    inside = (corners.picture >= first) & (corners.picture < last)
    camera = np.where(inside & (corners.camera < 2), 1 - corners.camera, corners.camera)
    return replace(corners, camera=camera).ordered(np.lexsort((corners.corner, camera, corners.picture)))


@pytest.mark.slow
def test_a_clean_session_has_no_problem_and_no_caution():
    assert {code for code, each in found_in(session().corners).items() if each.severity != "note"} == set()


@pytest.mark.slow
def test_the_wrong_square_size_shows_in_a_known_distance():
    known = float(np.linalg.norm(session().rig.centres[0] - session().rig.centres[1]))
    board = replace(BOARD, square=0.103, marker=0.077)
    found = found_in(session().corners, board, distances={("cam01", "cam02"): known})
    assert found["square-size"].severity == "problem"
    stated = float(found["square-size"].advice.split("measure ")[1].split(" mm")[0])
    assert stated == pytest.approx(100.0, abs=0.1)


@pytest.mark.slow
def test_a_mirrored_print_is_named():
    corners = session().corners
    mirrored = replace(corners, corner=corners.corner // 8 * 8 + 7 - corners.corner % 8)
    assert found_in(mirrored)["mirrored-print"].severity == "problem"


@pytest.mark.slow
@pytest.mark.parametrize("start", [40])
def test_a_camera_that_moved_is_named(start: int):
    found = found_in(with_moved_camera(session(), 2, start))
    assert found["camera-moved"].text.startswith("cam03 moved")


@pytest.mark.slow
def test_exchanged_cameras_are_named():
    found = found_in(with_exchanged_cameras(session(FEW).corners, 16, 23))
    assert found["cameras-exchanged"].text.startswith("cam01, cam02")


@pytest.mark.slow
def test_a_picture_out_of_step_is_named():
    corners, rows = session().corners, []
    pictures = np.bincount(corners.view_picture)
    own = [k for k in np.flatnonzero(corners.view_camera == 1) if pictures[corners.view_picture[k]] > 2]
    for view in range(len(corners.view_starts)):
        picture, camera, part = int(corners.view_picture[view]), int(corners.view_camera[view]), corners.view_rows(view)
        sighting = BoardSighting(
            corner=corners.corner[part], pixels=corners.pixels[part], covariance=corners.covariance[part]
        )
        if view == own[0]:
            late = session().world_from_board[picture + 1]
            index, pixels = seen_corners(session().rig.cameras[camera], late, BOARD)
            spread = np.broadcast_to(0.01 * np.eye(2), (len(index), 2, 2))
            sighting = BoardSighting(corner=index, pixels=pixels, covariance=spread)
        rows.append((picture, camera, sighting))
    found = found_in(CornerSet.gather(corners.cameras, corners.sizes, corners.pictures, rows))
    name = corners.pictures[int(corners.view_picture[own[0]])]
    assert f"cam02: {name}" in found["out-of-sync"].text


@pytest.mark.slow
def test_an_unseen_and_an_unconnected_camera_are_named():
    corners = session().corners
    assert "cam04" in found_in(corners.subset(corners.camera != 3))["camera-unseen"].text
    apart = corners.subset(np.where(corners.picture < 29, corners.camera < 2, corners.camera >= 2))
    assert found_in(apart)["not-connected"].severity == "problem"


@pytest.mark.slow
def test_uncovered_corners_are_named_cameras_with_the_same_ones_together():
    corners = session().corners
    low = (corners.camera == 2) & (corners.pixels > 0.75 * np.array(corners.sizes[2])).all(axis=1)
    texts = [[each.text for each in findings_of(every) if each.code == "uncovered-corner"] for every in
             (corners, corners.subset(~low))]  # fmt: skip
    rest, all_four = "top left, top right, bottom left of the image", "four corners of the images"
    end = "; the lens is extrapolated there."
    assert texts[0] == [f"cam01, cam02: no board in the {all_four}{end}", f"cam03, cam04: no board in the {rest}s{end}"]
    assert texts[1] == [
        f"cam01, cam02, cam03: no board in the {all_four}{end}", f"cam04: no board in the {rest}{end}"
    ]  # fmt: skip


@pytest.mark.slow
def test_without_a_floor_heights_and_verticals_limit_the_use():
    found = found_in(made_session(cameras=3, pictures=30, seed=5, floor=0).corners)["no-floor"]
    assert found.severity == "caution"
    assert "Heights, verticals, and angles to the horizontal are not reliable" in found.text
    assert "Lay the board on the floor" in found.advice


@pytest.mark.slow
def test_cameras_that_fit_their_boards_alone_but_not_together_are_named_worst_first():
    corners, rng = session(FEW).corners, np.random.default_rng(8)
    # Each view sees the board elsewhere by a common shift, the third camera by the largest.
    size = np.where(corners.view_camera == 2, 1.5, 0.4)
    shift = rng.normal(0, 1, (len(corners.view_starts), 2)) * size[:, None]
    found = found_in(replace(corners, pixels=corners.pixels + shift[corners.view]))
    assert found["cameras-disagree"].text.startswith("The boards of different cameras disagree: cam03 by")


def test_coverage_counts_every_corner_once():
    rng = np.random.default_rng(0)
    pixels = rng.uniform(0, 1, (500, 2)) * [1279, 719]
    counts = coverage_counts(pixels, (1280, 720))
    assert counts.shape == (6, 8)
    assert counts.sum() == 500
    assert counts[0, 0] == np.sum((pixels[:, 0] < 159.5) & (pixels[:, 1] < 119.5))


@pytest.mark.slow
def test_the_predicted_accuracy_is_that_of_disturbed_cameras():
    solved = solve_session(join_still(session().corners).corners, BOARD, model=False)
    solved = in_level_world(solved)
    points = capture_grid(solved.state, floor=False)[::23]
    sizes = tuple(camera.size for camera in session().rig)
    predicted = volume_accuracy(solved.state, solved.covariance, sizes, points)
    rng = np.random.default_rng(1)
    values, vectors = np.linalg.eigh(solved.covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    true = solved.state.rig(session().rig.names, sizes)
    pixels = np.stack([camera.project(points) for camera in true])
    for k, camera in enumerate(true):
        pixels[k][~camera.sees(pixels[k])] = np.nan
    squares = []
    for _ in range(60):
        step = root @ rng.normal(0, 1, len(values))
        moved = solved.state.stepped(step, np.zeros((solved.state.poses, 6))).rig(session().rig.names, sizes)
        found = triangulate(list(moved), pixels, sigma_px=1.0).points
        squares.append(np.sum((found - points) ** 2, axis=1))
    good = np.isfinite(predicted.sd) & np.isfinite(np.mean(squares, axis=0))
    assert np.count_nonzero(good) > 3
    ratio = np.sqrt(np.mean(squares, axis=0)[good]) / predicted.sd[good]
    # Sixty draws determine a standard deviation to 10 %.
    assert np.median(ratio) == pytest.approx(1.0, abs=0.25)
    assert len(centres(solved.state)) == 4


@pytest.mark.slow
def test_delays_that_a_wand_shows_are_stated_with_their_intervals():
    solved = solve_session(join_still(session().corners).corners, BOARD, model=False)
    views = view_quality(solved)
    delays = (
        StatedDelay(camera=1, pictures=1.5, sd=0.01, used=True, known=True),
        StatedDelay(camera=2, pictures=0.0001, sd=0.001, used=False, known=True),
        StatedDelay(camera=3, pictures=0.2, sd=0.6, used=False, known=False),
    )
    examined = Examined(
        solved=solved, corners=session().corners, views=views, cameras=camera_quality(solved, views), floor=True,
        together=True, distances={}, delays=delays, rate=10.0,
    )  # fmt: skip
    late, unknown = late_cameras(examined)
    assert (late.code, late.severity) == ("camera-late", "caution")
    assert "cam02 shows everything 1.50 +- 0.020 pictures (150.0 ms) later" in late.text
    assert (unknown.code, unknown.severity) == ("clock-unknown", "note")
    assert "cam04" in unknown.text


@pytest.mark.slow
def test_a_clock_that_a_wand_shows_to_drift_is_stated_and_allowed_for():
    solved = solve_session(join_still(session().corners).corners, BOARD, model=False)
    views, late = view_quality(solved), 0.02 * np.arange(110)
    cause = cause_of_wand(WandFault(camera=1, partner=0, late=late, picture=None, before=1.0, after=0.1))
    delay = StatedDelay(camera=1, pictures=1.1, sd=0.01, used=True, known=True, drift=2.18, drift_sd=0.01)
    examined = Examined(
        solved=solved, corners=session().corners, views=views, cameras=camera_quality(solved, views), floor=True,
        together=True, distances={}, delays=(delay,), rate=10.0, cause=cause,
    )  # fmt: skip
    (found,) = explaining(examined)
    assert found.code == "clock-drift"
    assert "cam02: its clock drifts by +2.2 pictures" in found.text
    assert "90 %" in found.text
    assert found.advice.startswith("This was allowed for.")
    (without,) = explaining(replace(examined, delays=()))
    assert "film again" in without.advice


@pytest.mark.slow
def test_every_clock_that_a_wand_shows_to_be_at_fault_is_named():
    solved = solve_session(join_still(session().corners).corners, BOARD, model=False)
    views, number = view_quality(solved), np.arange(110)
    lost = np.where(number < 60, 0.0, np.where(number >= 63, -3.0, np.nan))
    first, second = (
        cause_of_wand(WandFault(camera=camera, partner=0, late=late, picture=since, before=1.0, after=left))
        for camera, late, since, left in ((1, 0.02 * number, None, 0.1), (2, lost, 60, 0.2))
    )
    delay = StatedDelay(camera=1, pictures=1.1, sd=0.01, used=True, known=True, drift=2.18, drift_sd=0.01)
    examined = Examined(
        solved=solved, corners=session().corners, views=views, cameras=camera_quality(solved, views), floor=True,
        together=True, distances={}, delays=(delay,), rate=10.0, cause=first, further=(second,),
    )  # fmt: skip
    drift, loss = explaining(examined)
    assert (drift.code, loss.code) == ("clock-drift", "pictures-lost")
    assert "cam02" in drift.text
    assert "cam03 skipped 3 pictures" in loss.text
    # Of each camera, its own contradictions are explained.
    assert "90 % of its contradictions with the others" in drift.text
    assert "80 % of its contradictions with the others" in loss.text
    assert drift.advice.startswith("This was allowed for.")
    assert loss.advice.startswith("This was allowed for.")


@pytest.mark.slow
def test_repeated_pictures_are_no_pictures_that_were_lost():
    made = made_session(cameras=3, pictures=200, seed=5)
    corners = made.corners
    # The second camera, which sees the board together with another one from 144 to 150, repeats the first six times.
    start, camera = 144, 1
    views = set(zip(corners.picture.tolist(), corners.camera.tolist(), strict=True))
    for picture in range(start, start + 7):
        assert (picture, camera) in views
        assert {(picture, 0), (picture, 2)} & views
    held = dict.fromkeys(range(start + 1, start + 7), start)
    rows = {(picture, seen_by): found for picture, seen_by, found in corners.sightings()}
    rows |= {(picture, camera): rows[first, camera] for picture, first in held.items()}
    frozen = CornerSet.gather(
        corners.cameras, corners.sizes, corners.pictures, [(*key, found) for key, found in rows.items()]
    )
    repeated = repeated_views(frozen, join_still(frozen).first)
    assert repeated <= {(picture, camera) for picture in held}
    # In one of them, the board hardly moves before the other camera.
    assert len(repeated) >= len(held) - 1
    found = [each.code for each in findings_of(frozen, made.board, rate=10.0)]
    assert "pictures-repeated" in found
    assert not {"pictures-lost", "out-of-sync", "camera-moved"} & set(found)

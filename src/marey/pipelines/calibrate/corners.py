"""The corners of a session: found in all pictures, then measured by registration of the print."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from typing import TypeVar

import cv2
import numpy as np

from marey.arrays import Image, Mask
from marey.calibration.adjustment.solve import SolvedSession
from marey.calibration.boards.board import CalibrationBoard
from marey.calibration.boards.corners import BoardSighting, CornerSet
from marey.calibration.boards.detection import find_board, find_mirrored, known_dictionary
from marey.calibration.boards.printed import own_view, visible_corners
from marey.calibration.boards.registration import register_board
from marey.calibration.boards.still import StillGroups
from marey.calibration.quality.delays import CameraDelay, late_pictures
from marey.calibration.quality.screening import Screening
from marey.errors import FileProblem
from marey.geometry.rigid import RigidTransform
from marey.io.calibration.session import SessionClip, SessionFiles
from marey.io.stages import FrameLog
from marey.pipelines.calibrate.checkpoints import StoredPictures, stored_sightings
from marey.pipelines.calibrate.settings import DENSE_RATE, THINNED_RATE
from marey.pipelines.progress import Progress
from marey.pipelines.run_record import StageCache

Found = TypeVar("Found")
Sightings = list[tuple[int, int, BoardSighting]]
"""Index of the instant, index of the camera, and the corners found there."""

_TRIED = 12
"""Number of pictures per camera in which the reason is searched why no board was found; chosen by hand."""


def used_instants(session: SessionFiles, rate: float | None) -> tuple[int, ...]:
    """Choose the instants that are used of a session: all pictures, and of fast videos about ten per second.

    Args:
        session: The session.
        rate: Wanted pictures per second; None for the default.

    Returns:
        Numbers of instants in ascending order.
    """
    every = session.instants
    if session.rate is None or (rate is None and session.rate <= DENSE_RATE):
        return every
    step = max(session.rate / (rate or THINNED_RATE), 1.0)
    wanted = np.unique(np.round(np.arange(0, len(every), step)).astype(int))
    return tuple(every[k] for k in wanted if k < len(every))


def without_late_pictures(
    session: SessionFiles, instants: Sequence[int], delays: Sequence[CameraDelay]
) -> SessionFiles:
    """Assign the pictures of late cameras to the instants that they show.

    Args:
        session: The videos.
        instants: Numbers of the instants in use.
        delays: Cameras that are late, by pictures in use.

    Returns:
        The session; pictures of late cameras that belong to no instant in use have negative numbers.
    """
    late, index = late_pictures(len(session.clips), delays), {number: k for k, number in enumerate(instants)}

    def moved(number: int, by: int) -> int:
        at = index.get(number, -1) - by
        return instants[at] if number in index and 0 <= at < len(instants) else -1 - number

    clips = tuple(
        each if not by else replace(each, instants=tuple(moved(number, by) for number in each.instants))
        for each, by in zip(session.clips, late.tolist(), strict=True)
    )
    return replace(session, clips=clips)


def with_instants_shown(session: SessionFiles, instants: Sequence[int], screening: Screening) -> SessionFiles:
    """Assign the pictures of a camera that lost pictures to the instants that they show.

    Args:
        session: The videos.
        instants: Numbers of the instants in use.
        screening: What is wrong with the camera.

    Returns:
        The session; pictures that show no instant in use have negative numbers.
    """
    if screening.cause is None or not screening.instants:
        return session
    shown = {
        number: instants[at] if at >= 0 else -1 - number
        for number, at in zip(instants, screening.instants, strict=True)
    }
    clips = list(session.clips)
    own = clips[screening.cause.camera]
    clips[screening.cause.camera] = replace(
        own, instants=tuple(shown.get(number, -1 - abs(number)) for number in own.instants)
    )
    return replace(session, clips=tuple(clips))


def find_corners(
    session: SessionFiles, board: CalibrationBoard, instants: Sequence[int], progress: Progress, threads: int,
    cache: StageCache,
) -> CornerSet:  # fmt: skip
    """Find the board in all pictures.

    Args:
        session: The videos or pictures.
        board: The board.
        instants: Numbers of the instants to use.
        progress: Progress reporter.
        threads: Number of cameras at the same time.
        cache: Checkpoints of the run.

    Returns:
        The corners.

    Raises:
        FileProblem: The board is in no picture; the message states what was found instead.
    """

    def work(picture: int, camera: int, grey: Image) -> BoardSighting | None:
        return find_board(grey, board)

    stored = stored_sightings(cache, "board", (board, tuple(instants)))
    rows = over_pictures(session, instants, work, "Board", progress, threads, stored=stored)
    if not rows:
        raise _why_nothing(session, board, instants)
    return gathered(session, instants, rows)


def measure_corners(
    session: SessionFiles, solved: SolvedSession, still: StillGroups, detected: CornerSet, instants: Sequence[int],
    progress: Progress, threads: int, cache: StageCache, *, stage: str, chosen: Mask | None = None,
    searched: bool = True,
) -> CornerSet:  # fmt: skip
    """Measure the corners of all pictures with a known board pose by registration of the print.

    Cameras in which the board was not found are searched as well. Pictures in which it cannot be are not converted.

    Args:
        session: The videos or pictures.
        solved: The calibration so far.
        still: Runs of still pictures, which share a pose.
        detected: The corners found before.
        instants: Numbers of the instants in use.
        progress: Progress reporter.
        threads: Number of cameras at the same time.
        cache: Checkpoints of the run.
        stage: Name of the stage.
        chosen: (F,) first pictures of runs to measure; by default all.
        searched: Whether the board is searched where it was not found before.

    Returns:
        The corners.
    """
    board = solved.adjusted.problem.board
    assert isinstance(board, CalibrationBoard)
    rig = solved.state.rig(detected.cameras, detected.sizes)
    known = set(np.unique(solved.corners.picture).tolist())
    before = _by_view(detected)

    def pose_of(picture: int, camera: int) -> RigidTransform:
        return rig.cameras[camera].camera_from_world @ solved.state.board_pose(int(still.first[picture]))

    def needed(picture: int, camera: int) -> bool:
        first = int(still.first[picture])
        if first not in known or (chosen is not None and not chosen[first]):
            return False
        if (picture, camera) in before:
            return True
        return searched and len(visible_corners(board, own_view(rig.cameras[camera]), pose_of(picture, camera))[0]) > 0

    def work(picture: int, camera: int, grey: Image) -> BoardSighting | None:
        near = before.get((picture, camera))
        found = register_board(grey, board, rig.cameras[camera], pose_of(picture, camera), detected=near)
        return None if found is None else found.sighting

    depends = board, tuple(instants), solved.state, np.sort(list(known)), still.first, chosen, detected, searched
    stored = stored_sightings(cache, stage.lower().replace(", ", "-").replace(" ", "-"), depends)
    rows = over_pictures(session, instants, work, stage, progress, threads, stored=stored, needed=needed)
    return gathered(session, instants, rows)


def _by_view(corners: CornerSet) -> dict[tuple[int, int], BoardSighting]:
    found = {}
    for view in range(len(corners.view_starts)):
        rows = corners.view_rows(view)
        key = int(corners.view_picture[view]), int(corners.view_camera[view])
        found[key] = BoardSighting(
            corner=corners.corner[rows], pixels=corners.pixels[rows], covariance=corners.covariance[rows]
        )
    return found


def over_pictures(
    session: SessionFiles, instants: Sequence[int], work: Callable[[int, int, Image], Found | None], stage: str,
    progress: Progress, threads: int, *, colour: bool = False, stored: StoredPictures[Found] | None = None,
    needed: Callable[[int, int], bool] = lambda picture, camera: True,
) -> list[tuple[int, int, Found]]:  # fmt: skip
    """Do something with every picture of every camera, several cameras at the same time.

    Args:
        session: The videos or pictures.
        instants: Numbers of the instants to use.
        work: Called with the indices of instant and camera and the picture; None for nothing found.
        stage: Name of the stage.
        progress: Progress reporter.
        threads: Number of cameras at the same time.
        colour: Whether the pictures are in colour (H, W, 3), not grey (H, W).
        stored: Where the results are stored, and those of an interrupted run are found; None for nowhere.
        needed: Whether the picture of an instant and a camera, by their indices, is to be shown; by default all are.

    Returns:
        Index of the instant, index of the camera, and what was found there.
    """
    index = {number: k for k, number in enumerate(instants)}
    total = sum(sum(number in index for number in each.instants) for each in session.clips)

    def camera_work(
        camera: int, clip: SessionClip, log: FrameLog | None, step: Callable[[], None]
    ) -> list[Found | None]:
        found: list[Found | None] = [] if stored is None or log is None else stored.read(log)
        frames = [k for k, number in enumerate(clip.instants) if number in index][len(found) :]
        wanted = [needed(index[clip.instants[frame]], camera) for frame in frames]
        images = clip.clip.images([frame for frame, own in zip(frames, wanted, strict=True) if own])
        for frame, own in zip(frames, wanted, strict=True):
            shown = None if not own else next(images) if colour else cv2.cvtColor(next(images), cv2.COLOR_BGR2GRAY)
            at = index[clip.instants[frame]]
            found.append(None if shown is None else work(at, camera, np.asarray(shown, np.uint8)))
            if stored is not None and log is not None:
                stored.append(log, found[-1])
            step()
        return found

    with ExitStack() as stack:
        logs: Sequence[FrameLog | None] = [None] * len(session.clips)
        if stored is not None:
            logs = stored.logs(session.names, stack)
        done = sum(len(log) for log in logs if log is not None)
        with progress.stage(stage, total, done=done) as step, ThreadPoolExecutor(threads) as pool:
            jobs = [
                pool.submit(camera_work, camera, clip, log, step)
                for camera, (clip, log) in enumerate(zip(session.clips, logs, strict=True))
            ]
            try:
                found = [job.result() for job in jobs]
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
    return [
        (index[number], camera, each)
        for camera, clip in enumerate(session.clips)
        for number, each in zip((n for n in clip.instants if n in index), found[camera], strict=True)
        if each is not None
    ]


def gathered(session: SessionFiles, instants: Sequence[int], rows: Sightings) -> CornerSet:
    """Return the sightings of a session as one set.

    Args:
        session: The videos or pictures.
        instants: Numbers of the instants in use.
        rows: The sightings.
    """
    names = tuple(session.picture_name(number) for number in instants)
    return CornerSet.gather(session.names, session.sizes, names, rows)


def _why_nothing(session: SessionFiles, board: CalibrationBoard, instants: Sequence[int]) -> FileProblem:
    """Return the error for a session without any board, with the reason if it can be found."""
    wrong = f"shows no {board.describe()}"
    pictures = _some_pictures(session, instants)
    if any(find_mirrored(grey, board) >= 4 for grey in pictures):
        remedy = "The board is there as its mirror image: print it without mirroring, or unmirror the videos."
        return FileProblem(session.folder, wrong, remedy)
    if board.has_markers:
        other = _other_dictionary(board, pictures)
        if other:
            return FileProblem(
                session.folder, wrong, f"There are markers of {other}: correct the dictionary of the board."
            )
    remedy = "Check columns, rows, markers and `inverted` of the board file, and that the board is in focus."
    return FileProblem(session.folder, wrong, remedy)


def _some_pictures(session: SessionFiles, instants: Sequence[int]) -> list[Image]:
    pictures: list[Image] = []
    wanted = set(instants)
    for each in session.clips:
        frames = [k for k, number in enumerate(each.instants) if number in wanted]
        chosen = [frames[k] for k in np.unique(np.linspace(0, len(frames) - 1, min(len(frames), _TRIED)).astype(int))]
        for image in each.clip.images(chosen):
            pictures.append(np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8))
    return pictures


def _other_dictionary(board: CalibrationBoard, pictures: Sequence[Image]) -> str | None:
    """Return the dictionary of markers that the pictures show instead, or None."""
    best, most = None, 3
    names = ("4X4_1000", "5X5_1000", "6X6_1000", "7X7_1000", "APRILTAG_36H11", "APRILTAG_25H9", "ARUCO_ORIGINAL")
    for name in names:
        detector = cv2.aruco.ArucoDetector(known_dictionary(name))
        shown = [255 - grey if board.inverted else grey for grey in pictures]
        count = sum(len(ids) for grey in shown for ids in [detector.detectMarkers(grey)[1]] if ids is not None)
        if count > most and name.rsplit("_", 1)[0] not in board.dictionary.upper():
            best, most = name.replace("_1000", ""), count
    return best

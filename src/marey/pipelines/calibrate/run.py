"""`marey calibrate`: from the videos or pictures of a board to calibrated cameras."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from marey.arrays import Integers, Mask
from marey.calibration.adjustment.choice import informative_pictures
from marey.calibration.adjustment.landmarks import LandmarkPixels, LandmarkWorld, in_landmark_world, solve_landmarks
from marey.calibration.adjustment.lens_choice import FixedModel
from marey.calibration.adjustment.solve import (
    SolvedSession,
    connected_again,
    recorded_together,
    refined_session,
    solve_session,
)
from marey.calibration.adjustment.start import start_lenses
from marey.calibration.boards.board import CalibrationBoard
from marey.calibration.boards.corners import CornerSet
from marey.calibration.boards.still import StillGroups, join_still
from marey.calibration.boards.wand import CalibrationTarget, CalibrationWand
from marey.calibration.quality.causes import Cause
from marey.calibration.quality.delays import CameraDelay, find_delays, named_delays, without_delays
from marey.calibration.quality.finding import Examined, Finding
from marey.calibration.quality.findings import examine
from marey.calibration.quality.screening import Screening, cause_of_wand, screened
from marey.calibration.quality.settling import settled_session
from marey.calibration.quality.views import CameraQuality, ViewQuality, camera_quality, view_quality
from marey.calibration.quality.volume import VolumeAccuracy, capture_grid, volume_accuracy
from marey.calibration.quality.world import find_floor, in_floor_world, in_level_world
from marey.calibration.timing.wand_clocks import StatedDelay, WandClocks, solve_wand_videos, stated_delays
from marey.errors import FileProblem, SettingProblem
from marey.io.calibration.session import SessionFiles
from marey.io.calibration.target import SessionTarget, read_target
from marey.io.trial.sessions import open_calibration_session, session_target
from marey.pipelines.calibrate.checkpoints import session_fingerprints
from marey.pipelines.calibrate.corners import (
    find_corners,
    measure_corners,
    used_instants,
    with_instants_shown,
    without_late_pictures,
)
from marey.pipelines.calibrate.points import find_wand, landmark_pixels, static_markers, with_ball_centres
from marey.pipelines.calibrate.settings import CalibrationOptions
from marey.pipelines.progress import Progress
from marey.pipelines.run_record import StageCache

_MOST_PICTURES = 600
"""Number of instants, or runs of still ones, that are measured: those that add most to what is known of the cameras.

Of a made session of 8 cameras and 600 pictures, 250 chosen ones determine rotations to 0.0140 degrees, 250 evenly
distributed ones to 0.0166, and all to 0.0112: pictures are left out only where time demands it."""
_PASSES = 2
"""Number of times that all corners are measured by registration, the second time with better cameras.

On the rendered session the error of a camera's rotation fell from 0.276 degrees without to 0.054 after one pass and
0.025
after two."""

FixedModels = tuple[FixedModel, ...]
"""Distortion coefficients of each camera that were given; empty if the corners decide for all."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CalibratedSession:
    """A calibrated session, with everything that its reports show."""

    session: SessionFiles
    board: CalibrationTarget
    board_path: Path
    points_path: Path | None
    """File of points with known coordinates, if it was given."""
    solved: SolvedSession
    corners: CornerSet
    """All measured corners, also those that were left out."""
    views: ViewQuality
    cameras: tuple[CameraQuality, ...]
    volume: VolumeAccuracy
    findings: tuple[Finding, ...]
    floor: tuple[int, ...]
    """Indices of the pictures of the board on the floor; empty where something else sets the world."""
    landmarks: LandmarkWorld | None
    """The world of points with known coordinates; None if there are none."""
    spare: tuple[int, ...]
    """Indices of the pictures that were not measured, because others add more to what is known of the cameras."""
    together: bool
    """Whether the cameras recorded at the same time, so that their relative poses are known."""
    delays: tuple[StatedDelay, ...]
    """Delays of cameras that were estimated with a wand; empty if none were."""
    clock: str | None
    """The camera whose clock counts for them."""
    rate: float | None
    """Pictures per second that were used; None for single pictures."""


@contextmanager
def calibrated_session(
    folder: Path, options: CalibrationOptions, progress: Progress, *, results: Sequence[str] = ()
) -> Iterator[CalibratedSession]:
    """Calibrate the cameras of a folder, resuming an interrupted run.

    Args:
        folder: The folder with videos or pictures and the description of the board.
        options: Settings of the run.
        progress: Progress reporter; it keeps timings and warnings.
        results: Names of files that the block writes; those of the user are not replaced.

    Yields:
        The calibrated session; the checkpoints of the run are kept until the block, which writes the results, ends.

    Raises:
        FileProblem: The folder, a file or the board cannot be used, or the results would be among the inputs.
        SettingProblem: A setting cannot be used.
    """
    session = open_calibration_session(folder)
    if options.board:
        path, target = options.board, read_target(options.board, options.points, static_markers)
    else:
        path, target = session_target(folder, options.points, static_markers)
    distances, fixed = _checked_distances(options, session), _given_lenses(options, session)
    files = [session.folder, path, *([options.points] if options.points else [])]
    files += [file for clip in session.clips for file in clip.clip.paths]
    with StageCache(options.out, session_fingerprints(session), files=files, results=results) as cache:
        yield _calibrated(session, target, path, options, distances, fixed, progress, cache)


def _calibrated(
    session: SessionFiles, target: SessionTarget, path: Path, options: CalibrationOptions,
    distances: Mapping[tuple[str, str], float], fixed: FixedModels, progress: Progress, cache: StageCache,
) -> CalibratedSession:  # fmt: skip
    instants = used_instants(session, options.rate)
    pixels = landmark_pixels(session, target, instants, progress, options.threads) if target.landmarks else {}
    if isinstance(target.moved, CalibrationBoard):
        found = _board_session(session, target.moved, instants, options, fixed, progress, cache)
    elif isinstance(target.moved, CalibrationWand):
        found = _wand_session(session, target.moved, instants, options, fixed, progress, cache)
    else:
        solved = solve_landmarks(session.names, session.sizes, target.landmarks, pixels, fixed=fixed)
        found = _Measured(solved, _apart(solved.corners), together=True)
    with progress.stage("World"):
        found, floor, world = _in_world(found, target, pixels, options, instants)
    with progress.stage("Examination"):
        return _examined(session, target.moved, path, found, floor, world, options, dict(distances))


@dataclass(frozen=True, eq=False)
class _Measured:
    """A solved session and its corners."""

    solved: SolvedSession
    still: StillGroups
    together: bool
    spare: tuple[int, ...] = ()
    """Pictures that were not measured, because others add more."""
    delays: tuple[CameraDelay, ...] = ()
    """Cameras whose pictures were late by a constant number of pictures, which was allowed for."""
    cause: Cause | None = None
    """Why one camera contradicts the others, if that was found."""
    further: tuple[Cause, ...] = ()
    """Why more cameras do, with a wand."""
    clocks: WandClocks | None = None
    """The clocks of cameras that recorded a wand; None if they are taken as in step."""

    @property
    def corners(self) -> CornerSet:
        return self.still.corners


def _in_world(
    found: _Measured, target: SessionTarget, pixels: LandmarkPixels, options: CalibrationOptions,
    instants: tuple[int, ...],
) -> tuple[_Measured, tuple[int, ...], LandmarkWorld | None]:  # fmt: skip
    """Bring a session to the world of points, or of the board on the floor, or level with the cameras.

    Raises:
        SettingProblem: The points do not determine the world.
    """
    if not found.together:
        return found, (), None
    if target.landmarks:
        world = in_landmark_world(found.solved, target.landmarks, pixels)
        if world is None:
            raise SettingProblem(
                "The points with known coordinates do not set the world: at least three that are not on one line must "
                "be seen by two cameras each."
            )
        # The landmarks' own instants follow those of the pictures.
        named = replace(found.corners, pictures=world.solved.corners.pictures)
        still = StillGroups(corners=named, first=np.arange(len(named.pictures)))
        return replace(found, solved=world.solved, still=still), (), world
    board = isinstance(target.moved, CalibrationBoard)
    floor = _floor(found.solved, found.still, options, instants) if board else ()
    solved = in_floor_world(found.solved, floor[0]) if floor else in_level_world(found.solved)
    return replace(found, solved=solved), floor, None


def _wand_session(
    session: SessionFiles, wand: CalibrationWand, instants: tuple[int, ...], options: CalibrationOptions,
    fixed: FixedModels, progress: Progress, cache: StageCache,
) -> _Measured:  # fmt: skip
    """Find a wand in all pictures and calibrate the cameras with it.

    Raises:
        FileProblem: It is seen too rarely.
    """
    corners = find_wand(session, wand, instants, progress, options.threads, cache)
    progress.report(_found_text(corners, "Wand"))
    clocks = None
    with progress.stage("Adjustment"):
        try:
            if session.videos:
                solved, clocks = solve_wand_videos(corners, wand, fixed=fixed)
            else:
                solved = solve_session(corners, wand, fixed=fixed)
        except SettingProblem as problem:
            remedy = "Wave the wand through the places that several cameras see at the same time."
            raise FileProblem(session.folder, "has too few pictures of the wand to calibrate", remedy) from problem
        if wand.diameter and not wand.tags:
            # The ends may have been exchanged; the solved corners have the right order.
            corners = with_ball_centres(solved, solved.corners, wand)
            solved = refined_session(solved, corners)
    causes = () if clocks is None else tuple(cause_of_wand(each) for each in clocks.faults)
    return _Measured(
        solved, _apart(solved.corners), together=True, clocks=clocks, cause=causes[0] if causes else None,
        further=causes[1:],
    )  # fmt: skip


def _board_session(
    session: SessionFiles, board: CalibrationBoard, instants: tuple[int, ...], options: CalibrationOptions,
    fixed: FixedModels, progress: Progress, cache: StageCache,
) -> _Measured:  # fmt: skip
    """Find a board in all pictures, and calibrate the cameras with it.

    Raises:
        FileProblem: It is seen too rarely.
    """
    detected = find_corners(session, board, instants, progress, options.threads, cache)
    progress.report(_found_text(detected))
    with progress.stage("Start values"):
        lenses = start_lenses(detected, board)
        delays = find_delays(detected, board, lenses) if session.videos else ()
        session, detected = without_late_pictures(session, instants, delays), without_delays(detected, delays)
        together = recorded_together(detected, board, lenses)
        screening = screened(detected, board, lenses, videos=session.videos) if together else Screening()
        session, detected = with_instants_shown(session, instants, screening), screening.retimed(detected)
        if screening.cameras:
            detected = screening.kept(detected)
            lenses = start_lenses(detected, board)
        still = (
            join_still(detected)
            if session.videos and together
            else _apart(detected if together else detected.separated())
        )
        try:
            solved = solve_session(still.corners, board, lenses=lenses, model=not together, fixed=fixed)
        except SettingProblem as problem:
            remedy = "Film the board nearer, whole and in focus."
            raise FileProblem(session.folder, "has too few corners to calibrate a camera", remedy) from problem
    corners = still.corners
    spare: tuple[int, ...] = ()
    if together:
        with progress.stage("Choice of pictures"):
            used = np.unique(solved.corners.picture)
            chosen, first_runs = informative_pictures(solved, _MOST_PICTURES), still.first
            spare = tuple(used[~chosen[used]].tolist())
        searched = True
        for number in range(_PASSES):
            stage = f"Print, pass {number + 1}"
            measured = measure_corners(
                session, solved, still, detected, instants, progress, options.threads, cache, stage=stage,
                chosen=_of_runs(chosen, first_runs, still), searched=searched,
            )  # fmt: skip
            measured = screening.kept(measured)
            with progress.stage("Adjustment"):
                first = still.first
                still = join_still(measured) if session.videos else _apart(measured)
                solved, searched = connected_again(
                    refined_session(_renamed(solved, first, still), still.corners), still.corners
                )
                corners, detected = still.corners, measured
    cause = None
    if together:
        with progress.stage("Adjustment"):
            settled = settled_session(solved, corners, videos=session.videos, screening=screening, still=still.first)
            solved, cause = settled.solved, settled.cause
    return _Measured(solved, still, together=together, spare=spare, delays=delays, cause=cause)


def _of_runs(chosen: Mask, before: Integers, still: StillGroups) -> Mask:
    """Return (F,) whether the run of a picture contains the first picture of a run that was chosen."""
    return np.asarray(np.isin(np.arange(len(chosen)), still.first[np.isin(before, np.flatnonzero(chosen))]))


def _apart(corners: CornerSet) -> StillGroups:
    """Return groups without still pictures."""
    return StillGroups(corners=corners, first=np.arange(len(corners.pictures)))


def _renamed(solved: SolvedSession, before: np.ndarray, still: StillGroups) -> SolvedSession:
    """Give every still picture the board pose of its former run, since the runs may have changed."""
    state = solved.state
    moved = replace(
        state, board_rotation=state.board_rotation[before], board_translation=state.board_translation[before]
    )  # fmt: skip
    known = np.isin(before, np.unique(solved.corners.picture))
    used = still.corners.subset(known[still.corners.picture])
    problem = replace(solved.adjusted.problem, corners=used)
    return replace(solved, adjusted=replace(solved.adjusted, state=moved, problem=problem))


def _found_text(corners: CornerSet, what: str = "Board") -> str:
    views = np.bincount(corners.view_camera, minlength=len(corners.cameras))
    each = ", ".join(f"{name} {count}" for name, count in zip(corners.cameras, views, strict=True))
    return f"{what} found in the first search: {each} of {len(corners.pictures)} pictures"


def _checked_distances(options: CalibrationOptions, session: SessionFiles) -> dict[tuple[str, str], float]:
    for first, second, _ in options.distances:
        unknown = [name for name in (first, second) if name not in session.names]
        if unknown or first == second:
            known = ", ".join(session.names)
            raise SettingProblem(f"There is no distance from '{first}' to '{second}'; the cameras are {known}.")
    return {(first, second): metres for first, second, metres in options.distances}


def _given_lenses(options: CalibrationOptions, session: SessionFiles) -> FixedModels:
    """Return the distortion coefficients of each camera that were given; empty if there are none."""
    given = dict(options.lenses)
    unknown = [name for name in given if name and name not in session.names]
    if unknown:
        known = ", ".join(session.names)
        raise SettingProblem(f"lens (--lens) names the camera '{unknown[0]}'; the cameras are {known}.")
    return tuple(given.get(name, given.get("")) for name in session.names) if given else ()


def _floor(
    solved: SolvedSession, still: StillGroups, options: CalibrationOptions, instants: tuple[int, ...]
) -> tuple[int, ...]:
    """Return the pictures of the board on the floor; empty if there are none.

    Raises:
        SettingProblem: The pictures that were given do not show the board.
    """
    if options.floor == "none":
        return ()
    known = np.unique(solved.corners.picture)
    if options.floor == "auto":
        first = find_floor(solved, still)
    elif options.floor in ("first", "last"):
        first = int(known[0] if options.floor == "first" else known[-1])
    else:
        low, high = options.floor_range() or (0, 0)
        inside = [k for k, number in enumerate(instants) if low <= number <= high]
        own = [int(still.first[k]) for k in inside if int(still.first[k]) in set(known.tolist())]
        if not own:
            raise SettingProblem(
                f"No camera shows the board in the pictures {options.floor}, which should show the floor."
            )
        first = max(set(own), key=own.count)
    return () if first is None else tuple(np.flatnonzero(still.first == first).tolist())


def _rate(session: SessionFiles, options: CalibrationOptions) -> float | None:
    """Return how many pictures per second were used; None for single pictures."""
    if session.rate is None:
        return None
    instants = used_instants(session, options.rate)
    return session.rate * (len(instants) - 1) / max(instants[-1] - instants[0], 1)


def _examined(
    session: SessionFiles, board: CalibrationTarget, path: Path, found: _Measured, floor: tuple[int, ...],
    world: LandmarkWorld | None, options: CalibrationOptions, distances: Mapping[tuple[str, str], float],
) -> CalibratedSession:  # fmt: skip
    solved, corners, together = found.solved, found.corners, found.together
    level = bool(floor) or world is not None
    views = view_quality(solved)
    cameras = camera_quality(solved, views)
    grid = capture_grid(solved.state, floor=level) if together else np.zeros((0, 3))
    volume = volume_accuracy(solved.state, solved.covariance, corners.sizes, grid)
    rate = _rate(session, options)
    delays = () if found.clocks is None else stated_delays(found.clocks, solved)
    findings = examine(
        Examined(
            solved=solved, corners=corners, views=views, cameras=cameras, floor=level, together=together,
            distances=distances, landmarks=world, late=named_delays(corners, found.delays),
            delays=delays, rate=rate, cause=found.cause, further=found.further, still=found.still.first,
        )
    )  # fmt: skip
    return CalibratedSession(
        session=session, board=solved.adjusted.problem.board, board_path=path, points_path=options.points,
        solved=solved, corners=corners, views=views, cameras=cameras, volume=volume, findings=findings, floor=floor,
        landmarks=world, spare=found.spare, together=together, delays=delays, rate=rate,
        clock=None if found.clocks is None else corners.cameras[found.clocks.reference],
    )  # fmt: skip

"""The recordings of a board in a folder of marey or of another program, for `marey calibrate`."""

from pathlib import Path

from marey.errors import FileProblem
from marey.io.calibration.board import board_file
from marey.io.calibration.opencap import camera_files
from marey.io.calibration.session import SessionFiles, open_session
from marey.io.calibration.target import MarkerReader, SessionTarget, read_target, target_of_board
from marey.io.trial.program_boards import program_board
from marey.io.trial.settings import read_settings
from marey.io.video.clip_files import videos_in

_BOARD_RECORDINGS = ("calibration", "extrinsics")
"""Names of the recording of the board in an OpenCap session, in lower case."""


def open_calibration_session(folder: Path) -> SessionFiles:
    """Open the recordings of a board.

    Args:
        folder: A folder of marey, in which `[videos]` of trial.toml may name the videos, a project of Pose2Sim or
            Caliscope, or a session of OpenCap.

    Returns:
        The cameras in the order of their names.

    Raises:
        FileProblem: There is no folder, no picture, or a file cannot be read.
    """
    if not folder.is_dir():
        return open_session(folder)
    named = read_settings(folder).videos
    if named:
        return open_session(folder, named={camera: folder / path for camera, path in named.items()})
    return open_session(folder, named=_of_opencap(folder))


def session_target(folder: Path, points: Path | None, markers: MarkerReader) -> tuple[Path, SessionTarget]:
    """Read what is filmed in a session: from board.json or board.toml, or from the description of another program.

    Args:
        folder: As for `open_calibration_session`.
        points: A file with points of known coordinates.
        markers: Reader of static markers.

    Returns:
        The file that describes the board or wand; board or wand, and the points.

    Raises:
        FileProblem: There is no description, or it describes nothing usable.
    """
    try:
        path = board_file(folder)
    except FileProblem:
        found = program_board(folder)
        if found is None:
            raise
        return found[0], target_of_board(found[1], points, markers)
    return path, read_target(path, points, markers)


def _of_opencap(session: Path) -> dict[str, Path]:
    """Return the video of the board of each camera of an OpenCap session, which need not be calibrated yet."""
    cameras = [file.parent for file in camera_files(session).values()]
    cameras = cameras or sorted(path.parent for path in session.glob("Videos/*/InputMedia"))
    found = {}
    for camera in cameras:
        media = camera / "InputMedia"
        places = sorted(media.iterdir()) if media.is_dir() else []
        videos = [video for place in places if place.name.lower() in _BOARD_RECORDINGS for video in videos_in(place)]
        if videos:
            found[camera.name] = videos[0]
    return found

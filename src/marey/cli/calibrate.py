"""The command `marey calibrate`: cameras from a board, a wand, points, or a person."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from marey.cli.options import (
    RESULTS,
    Cameras,
    Frames,
    KeyPointsFolder,
    Quiet,
    Stature,
    Workers,
    camera_names,
    frame_range,
    require_trial,
)
from marey.cli.work import end_with_verdict, working

if TYPE_CHECKING:
    from marey.pipelines.from_person.refined_cameras import PersonCalibration

LONGEST_M = 1000.0
"""Distances of cameras are below this [m]: a larger one was given in another unit. Chosen by hand."""
LONGEST_PX = 1e6
"""Focal lengths are below this [px]; those of lenses with 2000 mm on sensors of 100 Mpx are 5e5."""

Folder = Annotated[
    Path,
    typer.Argument(
        metavar="FOLDER",
        help="Folder with a video, or numbered pictures, of each camera, and board.json or board.toml.",
    ),
]
OutFolder = Annotated[
    Path | None, typer.Option("--out", "-o", metavar="DIR", help="Folder for the results. [default: FOLDER/marey]")
]
BoardFile = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Description of the board, if it is not in FOLDER.")
]
PointsFile = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="JSON or TOML file of points with known coordinates, which set the world: tags, named points or "
        "static markers with their pixels.",
    ),
]
FloorPictures = Annotated[
    str,
    typer.Option(
        metavar="WHEN",
        help="Pictures in which the board lies on the floor and sets the world: auto, first, last, a number, A:B "
        "(up to, but not including, B), or none.",
    ),
]
PictureRate = Annotated[
    float | None,
    typer.Option(
        metavar="HZ", help="Pictures per second that are used of videos. [default: all up to 15, else 10]"
    ),
]
KnownDistances = Annotated[
    list[str] | None,
    typer.Option(
        metavar="A:B=M",
        help="Known distance of two cameras in metres, which checks the size of the squares; repeatable.",
    ),
]
LensModels = Annotated[
    list[str] | None,
    typer.Option(
        metavar="[CAM=]MODEL",
        help="Distortion coefficients of all lenses, or of one camera: none, k1, k1,k2 or k1,k2,k3, each also with "
        "p1,p2; repeatable. [default: the smallest model that describes the corners]",
    ),
]
FromPerson = Annotated[
    bool,
    typer.Option(
        "--from-person",
        help="FOLDER is a trial: refine the poses of its cameras by the person who moves in it, without a board.",
    ),
]
FromKeyPoints = Annotated[
    Path | None,
    typer.Option(
        "--from-keypoints",
        metavar="DIR",
        help="FOLDER is a trial whose cameras have unknown poses: find them by the joints that a detector found in "
        "every image, in this folder, in the forms of --keypoints.",
    ),
]
FocalLengths = Annotated[
    str | None,
    typer.Option(
        metavar="PX",
        help="With --from-keypoints: approximate focal length in pixels, one for all cameras or "
        "cam01=900,cam02=950. [default: the lenses of FOLDER's calibration]",
    ),
]
WorldOnly = Annotated[
    bool,
    typer.Option(
        "--world-only",
        help="With --from-person or --from-keypoints: keep the cameras of FOLDER's calibration, in any axes and unit, "
        "and find only origin, axes and scale by the person.",
    ),
]
KeepScale = Annotated[
    bool,
    typer.Option("--keep-scale", help="With --world-only: the calibration is in metres, and keeps its scale."),
]


def calibrate(
    folder: Folder, out: OutFolder = None, board: BoardFile = None, points: PointsFile = None,
    floor: FloorPictures = "auto", rate: PictureRate = None, distance: KnownDistances = None,
    lens: LensModels = None, from_person: FromPerson = False, from_keypoints: FromKeyPoints = None,
    world_only: WorldOnly = False, keep_scale: KeepScale = False, focal: FocalLengths = None, cameras: Cameras = None,
    frames: Frames = None, stature: Stature = None, keypoints: KeyPointsFolder = None, workers: Workers = None,
    quiet: Quiet = False,
) -> None:  # fmt: skip
    """Calibrate cameras from videos or pictures of a board or wand: lenses, poses and their uncertainty.

    FOLDER holds `cam01.mp4`, ..., synchronous frame by frame, or `cam01_1.jpg`, `cam02_1.jpg`, ... with equal
    numbers for the same instant, and the dimensions of a ChArUco board, chessboard, grid of markers, or wand of two or
    three balls or tags in `board.json`.
    Carry the board slowly through the capture volume and at last lay it on the floor. The cameras are in
    `cameras.toml`, which `marey capture` reads; `calibration.html` shows how good they are. If a problem
    makes them wrong, the verdict is "not usable" (exit code 3).

    With `--from-person`, FOLDER is a trial as `marey capture` takes it. Its cameras, of which one may have been
    knocked, are refined together with the motion of the person; `--cameras`, `--frames`, `--stature` and `--keypoints`
    are those of `marey capture`. The last line before the verdict states whether to use the new cameras.

    With `--from-keypoints`, nothing is known of the cameras but their approximate focal lengths: the joints of a
    person who walks before them place them, silhouettes refine them if FOLDER has images of the empty room, and
    `--stature` sets the scale.

    With `--world-only` as well as one of them, the lenses and relative poses of FOLDER's calibration are kept, whatever
    its axes and unit: the person sets origin, axes and scale, with `--from-person` by silhouettes alone. A person who
    walks also sets the heading. `--keep-scale` keeps the unit of a calibration in metres.

    Examples:
    * `marey calibrate session`
    * `marey calibrate session --floor last --out session/cameras`
    * `marey calibrate wand --points floor.json`
    * `marey calibrate session --distance cam01:cam02=3.254`
    * `marey calibrate walk01 --from-person --out walk01/refined`
    * `marey calibrate walk01 --from-keypoints walk01/keypoints --focal 900 --stature 1.8`
    * `marey calibrate walk01 --from-keypoints walk01/keypoints --world-only --stature 1.8`
    * `marey calibrate walk01 --from-person --world-only --stature 1.8 --out walk01/world`
    """
    of_board = {"--board": board, "--points": points, "--rate": rate, "--distance": distance or None,
                "--lens": lens or None}  # fmt: skip
    of_person = {"--cameras": cameras, "--frames": frames, "--stature": stature, "--keypoints": keypoints}
    if not world_only:
        _require_unused("without --world-only", {"--keep-scale": keep_scale or None})
    if from_keypoints is not None:
        others = of_board | {"--keypoints": keypoints, "--from-person": from_person or None}
        _require_unused("with --from-keypoints", others | ({"--focal": focal} if world_only else {}))
        _from_keypoints(
            folder, from_keypoints, out=out, focal=focal, cameras=cameras, frames=frames, stature=stature,
            workers=workers, quiet=quiet, world_only=world_only, keep_scale=keep_scale,
        )  # fmt: skip
        return
    _require_unused("without --from-keypoints", {"--focal": focal})
    if from_person:
        _require_unused("with --from-person", of_board)
        _from_person(
            folder, out=out, cameras=cameras, frames=frames, stature=stature, keypoints=keypoints,
            workers=workers, quiet=quiet, world_only=world_only, keep_scale=keep_scale,
        )  # fmt: skip
        return
    _require_unused("without --from-keypoints or --from-person", {"--world-only": world_only or None})
    _require_unused("without --from-person", of_person)
    _from_board(
        folder, out=out, board=board, points=points, floor=floor, rate=rate, distance=distance or [], lens=lens or [],
        workers=workers, quiet=quiet,
    )  # fmt: skip


def _from_board(
    folder: Path, *, out: Path | None, board: Path | None, points: Path | None, floor: str, rate: float | None,
    distance: list[str], lens: list[str], workers: int | None, quiet: bool,
) -> None:  # fmt: skip
    from marey.pipelines.calibrate.content import figure_lines
    from marey.pipelines.calibrate.tasks import calibrate as calibrate_folder

    distances = _distances(distance)
    models = {name.strip(): text for name, _, text in (each.rpartition("=") for each in lens)}
    with working(quiet=quiet, parallel_cameras=True, workers=workers) as progress:
        found = calibrate_folder(
            folder, out=out or folder / RESULTS, board=board, points=points, floor=floor, rate=rate,
            distances=distances, lens=models, progress=progress
        )  # fmt: skip
        for line in figure_lines(found.data):
            progress.report(line)
    end_with_verdict(found.verdict, cameras=found.path, report=found.report)


def _require_unused(how: str, given: Mapping[str, object]) -> None:
    """Check that options of the other kind of calibration are not given."""
    from marey.errors import SettingProblem

    used = [name for name, value in given.items() if value is not None]
    if used:
        raise SettingProblem(f"{', '.join(used)} cannot be used {how}: leave out one of them.")


def _from_person(
    trial: Path, *, out: Path | None, cameras: str | None, frames: str | None, stature: float | None,
    keypoints: Path | None, workers: int | None, quiet: bool, world_only: bool, keep_scale: bool,
) -> None:  # fmt: skip
    from marey.pipelines.from_person.refined_cameras import calibrate_from_person
    from marey.pipelines.from_person.silhouette_world import calibrate_person_world

    require_trial(trial)
    out, names, used = out or trial / RESULTS, camera_names(cameras), frame_range(frames)
    with working(quiet=quiet, parallel_cameras=True, workers=workers) as progress:
        if world_only:
            found = calibrate_person_world(
                trial, out=out, cameras=names, frames=used, keypoints=keypoints, stature=stature,
                keep_scale=keep_scale, progress=progress,
            )  # fmt: skip
        else:
            found = calibrate_from_person(
                trial, out=out, cameras=names, frames=used, stature=stature, keypoints=keypoints, progress=progress
            )
        for line in found.lines:
            progress.report(line)
    _finish(found)


def _from_keypoints(
    trial: Path, keypoints: Path, *, out: Path | None, focal: str | None, cameras: str | None, frames: str | None,
    stature: float | None, workers: int | None, quiet: bool, world_only: bool, keep_scale: bool,
) -> None:  # fmt: skip
    from marey.io.calibration.covariance import COVARIANCE_FILE
    from marey.pipelines.from_person.given_cameras import calibrate_world
    from marey.pipelines.from_person.placed_cameras import calibrate_from_keypoints
    from marey.pipelines.from_person.refined_cameras import CAMERAS_FILE
    from marey.pipelines.run_details import writable_folder

    require_trial(trial)
    lengths, names, used = _focal_lengths(focal), camera_names(cameras), frame_range(frames)
    out = out or trial / RESULTS
    written = (CAMERAS_FILE, COVARIANCE_FILE)
    with (
        working(quiet=quiet, parallel_cameras=True, workers=workers) as progress,
        writable_folder(out, [trial], results=written),
    ):
        if world_only:
            found = calibrate_world(
                trial, keypoints, out=out, cameras=names, frames=used, stature=stature, keep_scale=keep_scale,
                progress=progress,
            )  # fmt: skip
        else:
            found = calibrate_from_keypoints(
                trial, keypoints, out=out, focal=lengths, cameras=names, frames=used, stature=stature,
                progress=progress,
            )  # fmt: skip
        for line in found.lines:
            progress.report(line)
    _finish(found)


def _finish(found: "PersonCalibration") -> None:
    """Print the verdict, and where the cameras and their page are if they were written."""
    end_with_verdict(found.verdict, cameras=found.path if found.lines else None, report=found.report)


def _focal_lengths(text: str | None) -> dict[str, float] | float | None:
    """Parse focal lengths: PX, or CAMERA=PX,CAMERA=PX."""
    from marey.errors import SettingProblem

    if text is None:
        return None
    parts = [part.rpartition("=") for part in text.split(",")]
    try:
        found = {name.strip(): float(number) for name, _, number in parts}
    except ValueError:
        found = {}
    known = bool(found) and len(found) == len(parts) and all(0 < value < LONGEST_PX for value in found.values())
    if not known or ("" in found and len(found) > 1):
        raise SettingProblem(f"--focal is '{text}'; it should be like 900 or cam01=900,cam02=950, in pixels.")
    return found.get("", found)


def _distances(given: list[str]) -> dict[tuple[str, str], float]:
    """Parse distances of the form A:B=METRES."""
    from marey.errors import SettingProblem

    found = {}
    for text in given:
        names, _, number = text.rpartition("=")
        first, _, second = names.partition(":")
        try:
            metres = float(number)
        except ValueError:
            metres = float("nan")
        if not (first and second and first != second and 0 < metres < LONGEST_M):
            raise SettingProblem(f"--distance is '{text}'; it should be like cam01:cam02=3.254, in metres.")
        found[first, second] = metres
    return found

"""The commands `marey init`, `calibrate`, `cameras` and `sync`, which determine cameras, videos and clocks."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from marey.cli.options import (
    RESULTS,
    Cameras,
    Frames,
    KeyPointsFolder,
    Quiet,
    Stature,
    camera_names,
    frame_range,
    require_trial,
)
from marey.cli.work import working

_FORMATS = ("pose2sim", "anipose", "caliscope", "opencv", "easymocap")
"""Formats to which calibrations are converted, as `marey.io.calibration.writers` has them."""
NOT_USABLE = 3
"""Exit code if the cameras were written, but a problem was found that makes them wrong."""


def init(
    folder: Annotated[
        Path,
        typer.Argument(metavar="FOLDER", help="Folder with videos: a trial, or a session that is to be calibrated."),
    ],
    calibration: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The calibration, or a folder with it, if it is elsewhere.")
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Draw an image of each camera with its name: PNG or JPEG."),
    ] = None,
    only_print: Annotated[
        bool, typer.Option("--print", metavar="", help="Only print the proposal; write nothing.")
    ] = False,
) -> None:
    """Propose which video belongs to which camera, and write it to trial.toml.

    Videos with the names of the cameras need no proposal: `CAM01.MP4` is the video of `cam01`. Others, such as
    `GX010042.MP4` of a GoPro or `IMG_0815.MOV` of a phone, are paired by parts of their names, by the names of their
    folders, by the size of the image, and at last by their order, which is to be checked. Without a calibration, the
    cameras get the names that `marey calibrate` then uses. A project of Pose2Sim, a session of OpenCap and a recording
    of Caliscope or FreeMoCap need no copying. The proposal is printed; `[videos]` in `trial.toml` can be corrected.

    Examples:
    * `marey init walk01`
    * `marey init walk01 --calibration session/marey/cameras.toml`
    * `marey init walk01 --print --picture check.jpg`
    """
    from marey.pipelines.propose import propose_trial

    proposal = propose_trial(folder, calibration=calibration)
    typer.echo(str(proposal))
    if picture is not None:
        typer.echo(f"Picture: {proposal.draw(picture)}")
    if not only_print:
        typer.echo(f"Written: {proposal.write()}")


def cameras(
    source: Annotated[
        Path, typer.Argument(metavar="SOURCE", help="A calibration, or a folder with one, in any known format.")
    ],
    to: Annotated[
        str | None, typer.Option(metavar="FORMAT", help=f"Convert to {', '.join(_FORMATS)}; with --out.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="PATH", help="File or folder of the converted calibration.")
    ] = None,
    scale: Annotated[
        float,
        typer.Option(metavar="FACTOR", help="Multiply all lengths, for a calibration that is not in metres."),
    ] = 1.0,
) -> None:
    """List the cameras of a calibration, or convert it to the format of another program.

    Without `--to`, the cameras are listed with their image sizes, focal lengths, fields of view, positions and the
    directions in which they look. `pose2sim` and `anipose` are the TOML that marey writes itself, `caliscope` is
    `camera_array.toml`, in which cameras have numbers, and `opencv` and `easymocap` are `intri.yml` and `extri.yml`. A
    file that exists is not replaced.

    Examples:
    * `marey cameras project`
    * `marey cameras lab.xcp --to pose2sim --out cameras.toml`
    * `marey cameras cameras.toml --to opencv --out easymocap`
    """
    from marey.pipelines.convert_cameras import camera_table, convert_cameras, read_scaled

    rig = read_scaled(source, scale)
    typer.echo(camera_table(rig))
    if to is None and out is None:
        return
    for line in convert_cameras(rig, out, to=to):
        typer.echo(line)


def calibrate(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER",
            help="Folder with a video, or numbered pictures, of each camera, and board.json or board.toml.",
        ),
    ],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="DIR", help="Folder for the results. [default: FOLDER/marey]")
    ] = None,
    board: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Description of the board, if it is not in FOLDER.")
    ] = None,
    points: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="JSON or TOML file of points with known coordinates, which set the world: tags, named points or "
            "static markers with their pixels.",
        ),
    ] = None,
    floor: Annotated[
        str,
        typer.Option(
            metavar="WHEN",
            help="Pictures in which the board lies on the floor and sets the world: auto, first, last, a number, A:B "
            "(up to, but not including, B), or none.",
        ),
    ] = "auto",
    rate: Annotated[
        float | None,
        typer.Option(
            metavar="HZ", help="Pictures per second that are used of videos. [default: all up to 15, else 10]"
        ),
    ] = None,
    distance: Annotated[
        list[str] | None,
        typer.Option(
            metavar="A:B=M",
            help="Known distance of two cameras in metres, which checks the size of the squares; repeatable.",
        ),
    ] = None,
    from_person: Annotated[
        bool,
        typer.Option(
            "--from-person",
            help="FOLDER is a trial: refine the poses of its cameras by the person who moves in it, without a board.",
        ),
    ] = False,
    from_keypoints: Annotated[
        Path | None,
        typer.Option(
            "--from-keypoints",
            metavar="DIR",
            help="FOLDER is a trial whose cameras have unknown poses: find them by the joints that a detector found in "
            "every image, in this folder, in the forms of --keypoints.",
        ),
    ] = None,
    focal: Annotated[
        str | None,
        typer.Option(
            metavar="PX",
            help="With --from-keypoints: approximate focal length in pixels, one for all cameras or "
            "cam01=900,cam02=950. [default: the lenses of FOLDER's calibration]",
        ),
    ] = None,
    cameras: Cameras = None,
    frames: Frames = None,
    stature: Stature = None,
    keypoints: KeyPointsFolder = None,
    quiet: Quiet = False,
) -> None:
    """Calibrate cameras from videos or pictures of a board or wand: lenses, poses and their uncertainty.

    FOLDER holds `cam01.mp4`, ..., synchronous frame by frame, or `cam01_1.jpg`, `cam02_1.jpg`, ... with equal
    numbers for the same instant, and the dimensions of a ChArUco board, chessboard, grid of markers, or wand of two or
    three balls or tags in `board.json`.
    Carry the board slowly through the capture volume and at last lay it on the floor. The cameras are in
    `cameras.toml`, which `marey capture` reads; `calibration.html` shows how good they are. The exit code is 3 if a
    problem makes them wrong.

    With `--from-person`, FOLDER is a trial as `marey capture` takes it. Its cameras, of which one may have been
    knocked, are refined together with the motion of the person; `--cameras`, `--frames`, `--stature` and `--keypoints`
    are those of `marey capture`.

    With `--from-keypoints`, nothing is known of the cameras but their approximate focal lengths: the joints of a
    person who walks before them place them, silhouettes refine them if FOLDER has images of the empty room, and
    `--stature` sets the scale.

    Examples:
    * `marey calibrate session`
    * `marey calibrate session --floor last --out session/cameras`
    * `marey calibrate wand --points floor.json`
    * `marey calibrate session --distance cam01:cam02=3.254`
    * `marey calibrate walk01 --from-person --out walk01/refined`
    * `marey calibrate walk01 --from-keypoints walk01/keypoints --focal 900 --stature 1.8`
    """
    if from_keypoints is not None:
        others = {"--board": board, "--points": points, "--rate": rate, "--distance": distance or None}
        others |= {"--keypoints": keypoints, "--from-person": from_person or None}
        _require_unused("with --from-keypoints", others)
        _from_keypoints(
            folder, from_keypoints, out=out, focal=focal, cameras=cameras, frames=frames, stature=stature, quiet=quiet
        )
        return
    _require_unused("without --from-keypoints", {"--focal": focal})
    if from_person:
        _require_unused("with --from-person", {"--board": board, "--rate": rate, "--distance": distance or None})
        _from_person(folder, out=out, cameras=cameras, frames=frames, stature=stature, keypoints=keypoints, quiet=quiet)
        return
    trial_only = {"--cameras": cameras, "--frames": frames, "--stature": stature, "--keypoints": keypoints}
    _require_unused("without --from-person", trial_only)
    from marey.pipelines.calibrate.tasks import calibrate as calibrate_folder

    distances = _distances(distance or [])
    with working(quiet=quiet, parallel_cameras=True) as progress:
        found = calibrate_folder(
            folder, out=out or folder / RESULTS, board=board, points=points, floor=floor, rate=rate,
            distances=distances, progress=progress
        )  # fmt: skip
        for line in found.summary().lines.values():
            progress.report(line)
    typer.echo(f"Cameras: {found.path}")
    typer.echo(f"Report: {found.report}")
    if not found.usable:
        raise typer.Exit(NOT_USABLE)


def _require_unused(how: str, given: Mapping[str, object]) -> None:
    """Check that options of the other kind of calibration are not given."""
    from marey.errors import SettingProblem

    used = [name for name, value in given.items() if value is not None]
    if used:
        raise SettingProblem(f"{', '.join(used)} cannot be used {how}.")


def _from_person(
    trial: Path, *, out: Path | None, cameras: str | None, frames: str | None, stature: float | None,
    keypoints: Path | None, quiet: bool,
) -> None:  # fmt: skip
    from marey.pipelines.from_person.refined_cameras import calibrate_from_person

    require_trial(trial)
    with working(quiet=quiet, parallel_cameras=True) as progress:
        found = calibrate_from_person(
            trial, out=out or trial / RESULTS, cameras=camera_names(cameras), frames=frame_range(frames),
            stature=stature, keypoints=keypoints, progress=progress,
        )  # fmt: skip
        for line in found.lines:
            progress.report(line)
    typer.echo(f"Cameras: {found.path}")
    if not found.usable:
        raise typer.Exit(NOT_USABLE)


def _from_keypoints(
    trial: Path, keypoints: Path, *, out: Path | None, focal: str | None, cameras: str | None, frames: str | None,
    stature: float | None, quiet: bool,
) -> None:  # fmt: skip
    from marey.pipelines.from_person.placed_cameras import calibrate_from_keypoints

    require_trial(trial)
    with working(quiet=quiet, parallel_cameras=True) as progress:
        found = calibrate_from_keypoints(
            trial, keypoints, out=out or trial / RESULTS, focal=_focal_lengths(focal), cameras=camera_names(cameras),
            frames=frame_range(frames), stature=stature, progress=progress,
        )  # fmt: skip
        for line in found.lines:
            progress.report(line)
    if found.lines:
        typer.echo(f"Cameras: {found.path}")
    if not found.usable:
        raise typer.Exit(NOT_USABLE)


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
    known = bool(found) and len(found) == len(parts) and all(0 < value < float("inf") for value in found.values())
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
        if not (first and second and metres > 0):
            raise SettingProblem(f"--distance is '{text}'; it should be like cam01:cam02=3.254, in metres.")
        found[first, second] = metres
    return found


def sync(
    trial: Annotated[Path, typer.Argument(metavar="TRIAL", help="Folder with cameras.toml and one video per camera.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="FILE", help="File for the clocks. [default: TRIAL/sync.json]")
    ] = None,
    cameras: Cameras = None,
    keypoints: KeyPointsFolder = None,
    quiet: Quiet = False,
) -> None:
    """Find out by how much the clocks of the cameras differ, to a small part of a frame.

    The videos may begin at different times, and have different lengths and frame rates. The cameras must be calibrated,
    and a person must move where at least two of them see it. Images of the empty room in `background/` show where
    the person is; without them, give the joints that a detector found by `--keypoints`. The offset and the drift of
    each camera relative to the first are written to `sync.json`, which `marey capture` and `marey surface` then use.

    Examples:
    * `marey sync walk01`
    * `marey sync street --keypoints detections --out clocks.json`
    """
    from marey.io.trial.layout import find_layout
    from marey.pipelines.sync.tasks import synchronise

    require_trial(trial)
    with working(quiet=quiet, parallel_cameras=True) as progress:
        found = synchronise(trial, out=out, cameras=camera_names(cameras), keypoints=keypoints, progress=progress)
    typer.echo(f"{found}\nClocks: {out or find_layout(trial).folder / 'sync.json'}")

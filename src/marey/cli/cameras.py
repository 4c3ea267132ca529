"""The commands `marey init`, `cameras` and `sync`: videos, calibrations and clocks."""

from pathlib import Path
from typing import Annotated

import typer

from marey.cli.options import (
    Cameras,
    KeyPointsFolder,
    Quiet,
    Workers,
    camera_names,
    require_trial,
)
from marey.cli.work import end_with_verdict, working

_FORMATS = ("pose2sim", "anipose", "caliscope", "opencv", "easymocap")
"""Formats to which calibrations are converted, as `marey.io.calibration.writers` has them."""


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


def sync(
    trial: Annotated[Path, typer.Argument(metavar="TRIAL", help="Folder with cameras.toml and one video per camera.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="FILE", help="File for the clocks. [default: TRIAL/sync.json]")
    ] = None,
    cameras: Cameras = None,
    keypoints: KeyPointsFolder = None,
    workers: Workers = None,
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
    with working(quiet=quiet, parallel_cameras=True, workers=workers) as progress:
        found = synchronise(trial, out=out, cameras=camera_names(cameras), keypoints=keypoints, progress=progress)
    typer.echo(str(found))
    end_with_verdict(found.verdict, clocks=out or find_layout(trial).folder / "sync.json")

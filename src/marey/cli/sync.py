"""The command `marey sync`."""

from pathlib import Path
from typing import Annotated

import typer

from marey.cli.options import Cameras, KeyPointsFolder, Quiet, camera_names, require_trial
from marey.cli.work import working


def sync(
    trial: Annotated[
        Path, typer.Argument(metavar="TRIAL", help="Folder with cameras.toml and one video per camera.")
    ],
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
    the person is, or give the joints that a detector found by `--keypoints`. The offset and the drift of each camera
    relative to the first are written to `sync.json`, which `marey capture` and `marey surface` then use.

    Examples:
    * `marey sync walk01`
    * `marey sync street --keypoints detections --out clocks.json`
    """
    from marey.pipelines.sync.tasks import synchronise

    require_trial(trial)
    with working(quiet=quiet, parallel_cameras=True) as progress:
        found = synchronise(trial, out=out, cameras=camera_names(cameras), keypoints=keypoints, progress=progress)
    typer.echo(f"{found}\nClocks: {out or trial / 'sync.json'}")

"""The command `marey surface`."""

from pathlib import Path
from typing import Annotated

import typer

from marey.cli.options import RESULTS, Cameras, Frames, Out, Quiet, Sync, camera_names, frame_range, require_trial
from marey.cli.work import end_with_verdict, working


def surface(
    trial: Annotated[
        Path, typer.Argument(metavar="TRIAL", help="Folder with cameras.toml and a video, or stills, of each camera.")
    ],
    out: Out = None,
    cameras: Cameras = None,
    frames: Frames = None,
    seeds: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Clicked seeds: a CSV with one row per seed, x and y in each camera of cameras.toml."
        ),
    ] = None,
    spacing: Annotated[int, typer.Option(metavar="PX", help="Distance between neighbouring points in the image.")] = 2,
    patch: Annotated[int, typer.Option(metavar="PX", help="Width of the smallest patches, an odd number.")] = 13,
    refine_rig: Annotated[
        bool | None,
        typer.Option(
            "--refine-rig/--keep-rig",
            metavar="",
            help="Correct the camera poses by the matches, or keep them. [default: correct them if there are three "
            "or more cameras and the matches clearly contradict their poses]",
        ),
    ] = None,
    tracks: Annotated[
        bool,
        typer.Option("--tracks/--no-tracks", metavar="", help="Follow points over the frames, if there are several."),
    ] = True,
    max_speed: Annotated[
        float | None,
        typer.Option(metavar="M/S", help="Remove trajectories that are faster than this. [default: estimated]"),
    ] = None,
    max_acceleration: Annotated[
        float | None,
        typer.Option(metavar="M/S2", help="Remove trajectories with a larger acceleration. [default: estimated]"),
    ] = None,
    sync: Sync = None,
    quiet: Quiet = False,
) -> None:
    """Measure the visible surface of a body or an object as 3-D points, and follow it from frame to frame.

    TRIAL holds `cameras.toml` and `cam01.mp4`, ..., or stills `cam01_1.jpg`, ..., or `images/cam01.jpg`, ... of one
    instant. Images of the empty room in `background/`, or masks in `masks/`, exclude the room. The surface must have
    texture, and neighbouring cameras must be 10 to 25 degrees apart. After Ctrl-C, the same command resumes the run.

    Examples:
    * `marey surface face1`
    * `marey surface arm3 --spacing 4 --frames 0:10`
    * `marey surface face1 --seeds clicked.csv --keep-rig`
    """
    from marey.pipelines.surface.tasks import measure_surface

    require_trial(trial)
    with working(quiet=quiet, parallel_cameras=True) as progress:
        found = measure_surface(
            trial, out=out or trial / RESULTS, cameras=camera_names(cameras), frames=frame_range(frames), seeds=seeds,
            sync=sync, spacing=spacing, patch=patch, refine_rig=refine_rig, tracks=tracks, max_speed=max_speed,
            max_acceleration=max_acceleration, progress=progress,
        )  # fmt: skip
    end_with_verdict(found.verdict, surface=found.path, report=found.report)

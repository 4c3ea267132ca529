"""The command `marey nonrigid`."""

from pathlib import Path
from typing import Annotated

import typer

from marey.cli.options import Frames, NoOverlay, Quiet, frame_range, parse_names
from marey.cli.work import end_with_verdict, working

_Inputs = Annotated[
    list[Path],
    typer.Argument(metavar="INPUT...", help="Videos, one per camera; or an NPZ with tracks or points; or a C3D."),
]
_Out = Annotated[
    Path | None,
    typer.Option("--out", "-o", metavar="DIR", help="Folder for the results. [default: INPUT_marey]"),
]
_Points = Annotated[
    list[Path] | None,
    typer.Option(
        metavar="FILE",
        help="NPZ with `points` (P, 2), the pixels to follow, and `frame`, the frame in which they are given: for "
        "the first video, or one file per video.",
    ),
]
_Mask = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Image that is white where points may be selected in the first frame."),
]
_Matrix = Annotated[
    str | None,
    typer.Option(
        metavar="FILE|NUMBERS", help="Known camera matrix of a single camera: a file, fx,fy,cx,cy or nine numbers."
    ),
]
_Scaled = Annotated[
    bool, typer.Option("--scaled", metavar="", help="Estimate the scale of a single camera in each frame.")
]
_Cameras = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Calibration of the cameras, such as cameras.toml.")
]
_Distance = Annotated[
    tuple[int, int, float] | None,
    typer.Option(metavar="I J METRES", help="Two points, counted from 0, and their known distance."),
]
_Only = Annotated[
    str | None,
    typer.Option(metavar="LABEL,...", help="Labels of the points to use, or patterns such as thigh_*."),
]
_BasisShapes = Annotated[
    int | None,
    typer.Option(
        metavar="K", help="Number of basis shapes of points in space or calibrated cameras. [default: estimated]"
    ),
]


def nonrigid(
    inputs: _Inputs,
    out: _Out = None,
    points: _Points = None,
    mask: _Mask = None,
    matrix: _Matrix = None,
    scaled: _Scaled = False,
    cameras: _Cameras = None,
    distance: _Distance = None,
    only: _Only = None,
    basis_shapes: _BasisShapes = None,
    frames: Frames = None,
    no_overlay: NoOverlay = False,
    quiet: Quiet = False,
) -> None:
    """Recover the moving 3-D shape of a deforming surface, without a model of it.

    INPUT is a video in which points are followed, or several videos of one surface at the same time; an NPZ with
    `tracks` (frames, 2, points) or (cameras, frames, 2, points), NaN where a point is missing; or points in space: an
    NPZ with `points` (frames, 3, points), or a C3D with markers. After Ctrl-C, the same command resumes the run.

    Examples:
    * `marey nonrigid face.mp4`
    * `marey nonrigid paper.mp4 --points clicked.npz --matrix 750,750,320,240 --distance 0 89 0.297`
    * `marey nonrigid tracks.npz --out results/tracks`
    * `marey nonrigid walk.c3d --only "thigh_*"`
    * `marey nonrigid left.mp4 right.mp4 --cameras cameras.toml`
    """
    from marey.pipelines.nonrigid.factorise import factorise

    folder = out or inputs[0].with_name(f"{inputs[0].stem}_marey")
    with working(quiet=quiet) as progress:
        shapes = factorise(
            inputs, points=points or (), mask=mask, matrix=matrix, scaled=scaled, cameras=cameras, distance=distance,
            only=None if only is None else parse_names(only, option="--only", example="thigh_*"),
            frames=frame_range(frames), basis_shapes=basis_shapes,
            overlay=not no_overlay, out=folder, progress=progress,
        )  # fmt: skip
        for label, text in shapes.summary().lines.items():
            progress.report(f"{label}: {text}")
    end_with_verdict(shapes.verdict, report=folder / "report.html")

"""The command `marey nonrigid` as it is typed."""

from pathlib import Path
from typing import Annotated

import typer

from marey.cli.options import Frames, NoOverlay, Quiet
from marey.cli.work import working
from marey.pipelines.capture.settings import parse_frames, parse_names


def nonrigid(
    inputs: Annotated[
        list[Path],
        typer.Argument(metavar="INPUT...", help="Videos, one a camera; or an NPZ of tracks or points; or a C3D."),
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="DIR", help="Where the results go. [default: INPUT_marey]"),
    ] = None,
    points: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE",
            help="NPZ: `points` (P, 2) to follow and their `frame`; for the first video, or once for each.",
        ),
    ] = None,
    mask: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Picture of the first frame, white where points may be chosen."),
    ] = None,
    matrix: Annotated[
        str | None,
        typer.Option(
            metavar="FILE|NUMBERS", help="The one camera's known intrinsics: a file, fx,fy,cx,cy or nine numbers."
        ),
    ] = None,
    scaled: Annotated[
        bool, typer.Option("--scaled", help="The one camera shows the thing larger and smaller as it comes and goes.")
    ] = False,
    cameras: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The cameras' calibration, such as cameras.toml.")
    ] = None,
    distance: Annotated[
        tuple[int, int, float] | None,
        typer.Option(metavar="I J METRES", help="Two points, counted from 0, and how far they are apart."),
    ] = None,
    only: Annotated[
        str | None,
        typer.Option(metavar="LABEL,...", help="The points to keep of a file: labels, or patterns such as thigh_*."),
    ] = None,
    basis_shapes: Annotated[
        int | None,
        typer.Option(metavar="K", help="Number of basis shapes, of points in space. [default: the data choose it]"),
    ] = None,
    frames: Frames = None,
    no_overlay: NoOverlay = False,
    quiet: Quiet = False,
) -> None:
    """Recover the moving 3-D shape of a surface that deforms, without a model of it.

    INPUT is a video, in which points are followed, or several videos of one surface at the same time; an NPZ with
    `tracks` (frames, 2, points), or (cameras, frames, 2, points), NaN where a point is missing; or points in space: an
    NPZ with `points` (frames, 3, points), or a C3D with markers. Interrupted with Ctrl-C, the same command goes on.

    Examples:
    * `marey nonrigid face.mp4`
    * `marey nonrigid paper.mp4 --points clicked.npz --matrix 750,750,320,240 --distance 0 89 0.297`
    * `marey nonrigid tracks.npz --out results/tracks`
    * `marey nonrigid walk.c3d --only "thigh_*"`
    * `marey nonrigid left.mp4 right.mp4 --cameras cameras.toml`
    """
    from marey.pipelines.nonrigid.nonrigid import nonrigid as recover
    from marey.pipelines.nonrigid.settings import NonRigidOptions

    options = NonRigidOptions(
        out=out, points=tuple(points or ()), mask=mask, matrix=matrix, scaled=scaled, cameras=cameras,
        distance=distance,
        only=None if only is None else parse_names(only, option="--only", example="thigh_*"),
        frames=None if frames is None else parse_frames(frames), basis_shapes=basis_shapes, overlay=not no_overlay,
    )  # fmt: skip
    with working(quiet=quiet) as progress:
        results = recover(inputs, options, progress)
    typer.echo(f"Report: {results / 'report.html'}")

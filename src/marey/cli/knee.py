"""The commands of `marey knee`: bones and cartilage from MR."""

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(no_args_is_help=True, rich_markup_mode="markdown", help="Bones and cartilage of a knee from MR.")

_Out = Annotated[Path | None, typer.Option("--out", "-o", metavar="DIR", help="Where the results go.")]


@app.command()
def thickness(
    bone: Annotated[Path, typer.Argument(metavar="BONE.ply", help="The bone's surface.")],
    cartilages: Annotated[list[Path], typer.Argument(metavar="CARTILAGE.ply...", help="The cartilage on it.")],
    out: _Out = None,
) -> None:
    """Measure how thick the cartilage is over each vertex of a bone.

    PLY, STL, VTK, GLB, OBJ, OFF, and NPZ with `vertices` and `faces`, in millimetres. Leaves `thickness.npz`
    (`thickness_mm`, one a vertex, 0 where bare) and the coloured bone in `BONE_marey`, or in DIR.

    Examples:
    * `marey knee thickness femur.ply femoral_cartilage.ply`
    * `marey knee thickness tibia.ply medial.ply lateral.ply --out tibia`
    """
    from marey.cli.knee_thickness import measure_thickness

    folder, found = measure_thickness(bone, cartilages, out)
    typer.echo(found)
    typer.echo(f"Thickness: {folder / 'thickness.npz'}")

"""The commands of `marey knee`: bones and cartilage from MR."""

from pathlib import Path
from typing import Annotated

import typer

from marey.cli.options import Quiet

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


@app.command()
def register(
    template: Annotated[Path, typer.Argument(metavar="TEMPLATE.ply", help="A bone of somebody else.")],
    subject: Annotated[Path, typer.Argument(metavar="SUBJECT.ply", help="The same bone of the subject.")],
    mirror: Annotated[bool, typer.Option("--mirror", help="Mirror the template, of the other side, first.")] = False,
    out: _Out = None,
    quiet: Quiet = False,
) -> None:
    """Lay a template's bone on a subject's: by a rigid motion, then bent.

    The template may lie 30 degrees and 30 mm off. Leaves `rigid.json` (`subject_from_template`, 4x4, mm) and
    `registered.ply` (the template's vertices, in their order, on the subject) in `SUBJECT_marey`, or in DIR.

    Examples:
    * `marey knee register atlas_femur.ply femur.ply`
    * `marey knee register left_femur.ply right_femur.ply --mirror --out femur`
    """
    from marey.cli.knee_register import register as register_bones
    from marey.cli.progress import Progress

    folder = register_bones(template, subject, out, mirror=mirror, progress=Progress(quiet=quiet))
    typer.echo(f"Registered: {folder / 'registered.ply'}")

"""The commands of `marey knee`: bones and cartilage from MR."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from marey.cli.options import Quiet
from marey.cli.work import working
from marey.errors import SettingProblem

app = typer.Typer(no_args_is_help=True, rich_markup_mode="markdown", help="Bones and cartilage of a knee from MR.")

INCOMPLETE = 3
"""Exit code: results were written, but a structure that was asked for is not among them."""
_SEED_OPTIONS = ("--seed", "--seed-voxel")
_SEED_WORDS = 4


def with_seeds_joined(arguments: Sequence[str]) -> list[str]:
    """Join the four words of each seed into one: Typer takes options of several words once only."""
    words = list(arguments)
    if words[:2] != ["knee", "segment"]:
        return words
    joined: list[str] = []
    while words:
        joined.append(words.pop(0))
        if joined[-1] in _SEED_OPTIONS and words and " " not in words[0]:
            joined.append(" ".join(words[:_SEED_WORDS]))
            del words[:_SEED_WORDS]
    return joined


def parse_seed(text: str, option: str) -> tuple[str, float, float, float]:
    """Read a bone and three numbers, for example "femur 10 -3.5 20".

    Args:
        text: The value of the option.
        option: Its name, for the error.

    Raises:
        SettingProblem: It is something else.
    """
    words = text.replace(",", " ").split()
    try:
        name, x, y, z = words
        return name, float(x), float(y), float(z)
    except ValueError as error:
        raise SettingProblem(
            f"{option} is '{text}'; it should be a bone and three numbers, for example {option} femur 10 -3.5 20."
        ) from error


_Out = Annotated[Path | None, typer.Option("--out", "-o", metavar="DIR", help="Where the results go.")]


@app.command()
def segment(
    volumes: Annotated[
        list[Path],
        typer.Argument(
            metavar="VOLUME [VOLUME2]",
            help="A folder of DICOM slices, NIfTI, NRRD or MetaImage; a second one of the same knee in the same place.",
        ),
    ],
    template: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Another knee's labels.nii.gz with names.json or labels.json, of either side."
        ),
    ] = None,
    seed: Annotated[
        list[str] | None,
        typer.Option(metavar="BONE X Y Z", help="A place in the bone's marrow, LPS in mm. Several bones are allowed."),
    ] = None,
    seed_voxel: Annotated[
        list[str] | None,
        typer.Option(metavar="BONE I J K", help="The same as the indices of a voxel of VOLUME."),
    ] = None,
    side: Annotated[
        str | None,
        typer.Option(metavar="SIDE", help="left or right, to name medial and lateral parts. [default: by the patella]"),
    ] = None,
    out: _Out = None,
    quiet: Quiet = False,
) -> None:
    """Find femur, tibia and patella in an MR volume, and by a template the cartilage on them.

    Dark marrow (fat suppressed) and bright marrow are told apart; seeds are found, too. Leaves `labels.nii.gz` on the
    image's own grid with `labels.json`, `femur.ply`, `tibia.ply`, `patella.ply` (LPS, mm), `report.html` and `run.json`
    in `VOLUME_marey`, or in DIR; of cartilage its surfaces, `<bone>_thickness.npz`, coloured bones, flat pictures and
    `cartilage.csv` with its parts; `markers.json` where gadolinium markers are on the skin. Ends with exit code 3 where
    a bone, or cartilage that the template has, was not found; the rest is written.

    Examples:
    * `marey knee segment dess.nii.gz --template atlas`
    * `marey knee segment fat_saturated.nii.gz plain.nii.gz --out knee`
    * `marey knee segment series --seed femur 12 -30 40`
    """
    from marey.pipelines.knee.segment import segment_knee, stem

    seeds = [parse_seed(each, "--seed") for each in seed or ()]
    seed_voxels = [parse_seed(each, "--seed-voxel") for each in seed_voxel or ()]
    folder = out or volumes[0].with_name(f"{stem(volumes[0])}_marey")
    with working(quiet=quiet) as progress:
        knee = segment_knee(
            volumes, template=template, seeds=seeds, seed_voxels=seed_voxels, side=side, out=folder, progress=progress
        )
        for name in knee.bones:
            surface = knee.surfaces[name]
            progress.report(f"{name}: {surface.volume_mm3 / 1000:.1f} cm3, {surface.area_mm2 / 100:.0f} cm2")
    typer.echo(f"Labels: {folder / 'labels.nii.gz'}")
    typer.echo(f"Report: {folder / 'report.html'}")
    if knee.missing:
        typer.echo(f"Not found: {', '.join(knee.missing)} (labels.json gives the reasons).", err=True)
        raise typer.Exit(INCOMPLETE)


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
    from marey.pipelines.knee.thickness import measure_thickness

    with working() as progress:
        folder, found = measure_thickness(bone, cartilages, out, progress)
    typer.echo(found)
    typer.echo(f"Thickness: {folder / 'thickness.npz'}")


@app.command()
def register(
    template: Annotated[Path, typer.Argument(metavar="TEMPLATE.ply", help="A bone of somebody else.")],
    subject: Annotated[Path, typer.Argument(metavar="SUBJECT.ply", help="The same bone of the subject.")],
    mirror: Annotated[
        bool | None,
        typer.Option(
            "--mirror/--no-mirror", help="The template is, or is not, of the other side. [default: found out]"
        ),
    ] = None,
    out: _Out = None,
    quiet: Quiet = False,
) -> None:
    """Lay a template's bone on a subject's: by a rigid motion, then bent.

    The template may lie 30 degrees and 30 mm off and be of either side. Leaves `rigid.json` (`subject_from_template`,
    4x4, mm, `sd_deg`, `sd_mm`, `mirrored`) and `registered.ply` (the template's vertices, in their order, on the
    subject) in `SUBJECT_marey`, or in DIR.

    Examples:
    * `marey knee register atlas_femur.ply femur.ply`
    * `marey knee register left_patella.ply right_patella.ply --mirror --out patella`
    """
    from marey.pipelines.knee.register import register as register_bones

    with working(quiet=quiet) as progress:
        folder = register_bones(template, subject, out, mirror=mirror, progress=progress)
    typer.echo(f"Registered: {folder / 'registered.ply'}")


@app.command()
def animate(
    knee: Annotated[Path, typer.Argument(metavar="KNEE_DIR", help="A folder of `marey knee segment`.")],
    motion: Annotated[Path, typer.Argument(metavar="MOTION", help="A folder of `marey markers`.")],
    reference: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="The person standing, with the markers of the scanner and of the activity."),
    ] = None,
    method: Annotated[
        str | None,
        typer.Option(
            metavar="NAME", help="Whose bones, where `marey markers` ran several methods. [default: the first's]"
        ),
    ] = None,
    compare: Annotated[
        str | None,
        typer.Option(metavar="NAME|MOTION2", help="Another method, or folder, to set beside it: rigid, for one."),
    ] = None,
    frame: Annotated[str, typer.Option(help="What is held in video and GLB: tibia, or nothing (room).")] = "tibia",
    view: Annotated[
        str, typer.Option(metavar="NAME,...", help="Views of the video: anterior, posterior, medial, lateral, plateau.")
    ] = "anterior,medial,plateau",
    limit: Annotated[float, typer.Option(metavar="MM", help="Cartilages nearer than this count as near.")] = 5.0,
    noise: Annotated[
        float,
        typer.Option(metavar="MM", help="Standard deviation of a marker's coordinate, and of its place when put back."),
    ] = 0.5,
    landmarks: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Landmarks picked in the scanner's images, for the angles' axes."),
    ] = None,
    side: Annotated[
        str | None,
        typer.Option(metavar="SIDE", help="left or right. [default: by the patella, or the segments' names]"),
    ] = None,
    out: _Out = None,
    quiet: Quiet = False,
) -> None:
    """Move a knee's bones and cartilage by an activity, and measure how near the cartilages come.

    The markers of KNEE_DIR/markers.json and those of the laboratory join the two. Leaves `knee_motion.npz`,
    `proximity.csv`, `correspondence.json`, `knee.glb`, `knee.mp4`, the page `knee.html` and `run.json` in
    `MOTION/knee`, or in DIR. Ends with exit code 3 where femur or tibia cannot be moved; the rest is written.

    Examples:
    * `marey knee animate knee walk_marey --reference standing.c3d`
    * `marey knee animate knee walk_marey --method skin --compare rigid`
    * `marey knee animate knee walk_marey --frame room --view lateral,posterior`
    """
    from marey.io.npz import read_arrays
    from marey.pipelines.knee.animate import AnimateOptions
    from marey.pipelines.knee.animate import animate as animate_knee

    options = AnimateOptions(
        out=out, reference=reference, method=method, compare=compare, landmarks=landmarks, side=side, frame=frame,
        views=tuple(name.strip() for name in view.split(",") if name.strip()), limit_mm=limit, noise_mm=noise,
    )  # fmt: skip
    with working(quiet=quiet) as progress:
        folder = animate_knee(knee, motion, options, progress)
    typer.echo(f"Page: {folder / 'knee.html'}")
    moved = read_arrays(folder / "knee_motion.npz")["bones"].tolist()
    still = [bone for bone in ("femur", "tibia") if bone not in moved]
    if still:
        typer.echo(f"Not moved: {', '.join(still)} (see the notes).", err=True)
        raise typer.Exit(INCOMPLETE)


@app.command()
def template(
    sources: Annotated[
        list[Path],
        typer.Argument(
            metavar="SOURCE...",
            help="Labels with names.json beside them, or contours.json, if wanted with its volume.",
        ),
    ],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="FOLDER", help="The template. [default: SOURCE_template]")
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Make a template of a labelled or outlined knee, for `segment --template` and `register`.

    Leaves `labels.nii.gz`, `labels.json` and a closed surface of each structure (`femur.ply`, ...; LPS, mm). Says what
    is missing or looks wrong: bones, cartilage that does not lie on its bone, pieces, which side it is.

    Examples:
    * `marey knee template atlas/labels.nii.gz --out my_template`
    * `marey knee template contours.json knee.nii.gz --out my_template`
    """
    from marey.pipelines.knee.template import make_template

    folder = out or sources[0].with_name(f"{sources[0].name.split('.')[0]}_template")
    with working(quiet=quiet) as progress:
        made = make_template(sources, folder, progress)
    typer.echo(f"{'A' if made.side is None else f'A {made.side}'} knee with {', '.join(made.surfaces)}: {folder}")


@app.command()
def outline(
    volume: Annotated[
        Path, typer.Argument(metavar="VOLUME", help="A folder of DICOM slices, NIfTI, NRRD or MetaImage.")
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="FILE", help="The outlines. [default: VOLUME_contours.json]"),
    ] = None,
    port: Annotated[
        int, typer.Option(metavar="N", help="Of the page's address. [default: any that is free]", show_default=False)
    ] = 0,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Only print the address.")] = False,
    quiet: Quiet = False,
) -> None:
    """Outline bones and cartilage slice by slice in the browser, with a wire that follows the edges.

    The page is served to this computer alone. Each change is kept at once; the same command goes on with it.
    `marey knee template` makes a template of the outlines. Ctrl-C ends it.

    Examples:
    * `marey knee outline knee.nii.gz`
    * `marey knee outline series --out contours.json --no-browser`
    """
    from marey.pipelines.knee.outline import outline_server, serve

    with working(quiet=quiet) as progress:
        server = outline_server(volume, out, port, progress)
        typer.echo(f"Outlining at {server.address}; kept in {server.session.path}. Ctrl-C ends it.")
        serve(server, browser=not no_browser)

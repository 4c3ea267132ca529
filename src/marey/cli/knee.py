"""The commands of `marey knee`: bones and cartilage from MR."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from marey.cli.options import Quiet
from marey.cli.work import end_with_verdict, working
from marey.errors import SettingProblem

app = typer.Typer(no_args_is_help=True, rich_markup_mode="markdown", help="Bones and cartilage of a knee from MR.")

_SEED_OPTIONS = ("--seed", "--seed-voxel")
"""Options that are followed by several words."""
_SEED_WORDS = 4
"""Number of words of a seed: the name of a bone and three coordinates."""


def with_seeds_joined(arguments: Sequence[str]) -> list[str]:
    """Join the four words of each seed into one, because Typer accepts options of several words only once."""
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
        option: Name of the option, for the error.

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


_Out = Annotated[Path | None, typer.Option("--out", "-o", metavar="DIR", help="Folder for the results.")]
_Reference = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Trial of the person standing, with the markers of both scanner and activity."),
]
_Method = Annotated[
    str | None,
    typer.Option(
        metavar="NAME", help="Method whose bones are used, if `marey markers` ran several. [default: the first]"
    ),
]
_Frame = Annotated[
    str,
    typer.Option(
        metavar="NAME",
        help="Frame of reference of video and GLB: tibia (it is at rest), or room (all bones move).",
    ),
]
_Side = Annotated[
    str | None,
    typer.Option(
        metavar="SIDE",
        help="Side of the knee, left or right. [default: from the patella, or the names of the segments]",
    ),
]


@app.command()
def segment(
    volumes: Annotated[
        list[Path],
        typer.Argument(
            metavar="VOLUME [VOLUME2]",
            help="Folder with a DICOM series, NIfTI, NRRD or MetaImage; a second one of the same knee is allowed.",
        ),
    ],
    template: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Labels of another knee, left or right: labels.nii.gz with labels.json or names.json.",
        ),
    ] = None,
    seed: Annotated[
        list[str] | None,
        typer.Option(
            metavar="BONE X Y Z", help="A point in the marrow of a bone, LPS coordinates in mm; can be repeated."
        ),
    ] = None,
    seed_voxel: Annotated[
        list[str] | None,
        typer.Option(metavar="BONE I J K", help="The same point as voxel indices of the first VOLUME."),
    ] = None,
    side: Annotated[
        str | None,
        typer.Option(
            metavar="SIDE",
            help="Side of the knee, left or right, for its medial and lateral parts. [default: from the patella]",
        ),
    ] = None,
    out: _Out = None,
    quiet: Quiet = False,
) -> None:
    """Segment femur, tibia and patella in an MR volume, and their cartilage if a template is given.

    Marrow can be dark (fat suppressed) or bright; seeds are found automatically. The results, in `VOLUME_marey` or in
    DIR, are `labels.nii.gz` on the grid of the image with `labels.json`, `femur.ply`, `tibia.ply`, `patella.ply` (LPS,
    mm), `report.html` and `run.json`; for cartilage its surfaces, `<bone>_thickness.npz`, coloured bones, flat images
    and `cartilage.csv`; and `markers.json` if there are gadolinium markers on the skin. If femur
    or tibia was not found, the verdict is "not usable" (exit code 3); the other results are written.

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
    end_with_verdict(knee.verdict, labels=folder / "labels.nii.gz", report=folder / "report.html")


@app.command()
def thickness(
    bone: Annotated[Path, typer.Argument(metavar="BONE.ply", help="The bone's surface.")],
    cartilages: Annotated[
        list[Path], typer.Argument(metavar="CARTILAGE.ply...", help="Surfaces of the cartilage on this bone.")
    ],
    out: _Out = None,
) -> None:
    """Measure the thickness of the cartilage over each vertex of a bone.

    Meshes are PLY, STL, VTK, GLB, OBJ, OFF, or NPZ with `vertices` and `faces`, in millimetres. The results, in
    `BONE_marey` or in DIR, are `thickness.npz` (`thickness_mm`, one per vertex, 0 where the bone is bare) and the
    coloured bone.

    Examples:
    * `marey knee thickness femur.ply femoral_cartilage.ply`
    * `marey knee thickness tibia.ply medial.ply lateral.ply --out tibia`
    """
    from marey.pipelines.knee.thickness import measure_thickness
    from marey.pipelines.run_details import writable_folder

    folder = out or bone.with_name(f"{bone.stem}_marey")
    with (
        working() as progress,
        writable_folder(folder, [bone, *cartilages], results=("thickness.npz", "thickness.ply")),
    ):
        measured = measure_thickness(bone, cartilages, progress=progress)
        measured.save(folder)
    for label, text in measured.summary().lines.items():
        typer.echo(f"{label}: {text}")
    end_with_verdict(measured.verdict, thickness=folder / "thickness.npz")


@app.command()
def register(
    template: Annotated[Path, typer.Argument(metavar="TEMPLATE.ply", help="A bone of another person.")],
    subject: Annotated[Path, typer.Argument(metavar="SUBJECT.ply", help="The same bone of the subject.")],
    mirror: Annotated[
        bool | None,
        typer.Option(
            "--mirror/--no-mirror",
            metavar="",
            help="Whether the template is from the other side of the body. [default: both are tried]",
        ),
    ] = None,
    out: _Out = None,
    quiet: Quiet = False,
) -> None:
    """Register a template's bone with a subject's: by a rigid motion, then by an elastic deformation.

    The template may be rotated by up to 30 degrees and displaced by up to 30 mm, and may be from either side. The
    results, in `SUBJECT_marey` or in DIR, are `rigid.json` (`subject_from_template`, 4x4, mm, `sd_deg`, `sd_mm`,
    `mirrored`) and `registered.ply` (the vertices of the template, in their order, on the subject).

    Examples:
    * `marey knee register atlas_femur.ply femur.ply`
    * `marey knee register left_patella.ply right_patella.ply --mirror --out patella`
    """
    from marey.pipelines.knee.register import register_bone
    from marey.pipelines.run_details import writable_folder

    folder = out or subject.with_name(f"{subject.stem}_marey")
    with (
        working(quiet=quiet) as progress,
        writable_folder(folder, [template, subject], results=("rigid.json", "registered.ply")),
    ):
        registered = register_bone(template, subject, mirror=mirror, progress=progress)
        registered.save(folder)
        for label, text in registered.summary().lines.items():
            progress.report(f"{label}: {text}")
    end_with_verdict(registered.verdict, registered=folder / "registered.ply")


@app.command()
def animate(
    knee: Annotated[Path, typer.Argument(metavar="KNEE_DIR", help="Folder with the results of `marey knee segment`.")],
    motion: Annotated[Path, typer.Argument(metavar="MOTION", help="Folder with the results of `marey markers`.")],
    reference: _Reference = None,
    method: _Method = None,
    compare: Annotated[
        str | None,
        typer.Option(metavar="NAME|MOTION2", help="Another method, or another folder, for comparison."),
    ] = None,
    frame: _Frame = "tibia",
    view: Annotated[
        str, typer.Option(metavar="NAME,...", help="Views of the video: anterior, posterior, medial, lateral, plateau.")
    ] = "anterior,medial,plateau",
    limit: Annotated[
        float, typer.Option(metavar="MM", help="Distance below which two cartilages count as near.")
    ] = 5.0,
    noise: Annotated[
        float,
        typer.Option(metavar="MM", help="Standard deviation of a marker's coordinate, including its attachment."),
    ] = 0.5,
    landmarks: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Landmarks picked in the images of the scanner, for the axes of the angles."),
    ] = None,
    side: _Side = None,
    out: _Out = None,
    quiet: Quiet = False,
) -> None:
    """Move a knee's bones and cartilage as in an activity, and measure the distance between the cartilages.

    The markers in KNEE_DIR/markers.json and those of the laboratory relate scanner and laboratory. The results, in
    `MOTION/knee` or in DIR, are `knee_motion.npz`, `proximity.csv`, `correspondence.json`, `knee.glb`, `knee.mp4`, the
    page `knee.html` and `run.json`. If femur or tibia cannot be moved, the verdict is "not usable" (exit code 3); the
    other results are written. If a wrong unit, a mirror image or the other leg explains why scanner and laboratory do
    not correspond, the page with the verdict is written alone.

    Examples:
    * `marey knee animate knee walk_marey --reference standing.c3d`
    * `marey knee animate knee walk_marey --method skin --compare rigid`
    * `marey knee animate knee walk_marey --frame room --view lateral,posterior`
    """
    from marey.pipelines.knee.animate import animate_knee

    folder = out or motion / "knee"
    with working(quiet=quiet) as progress:
        moving = animate_knee(
            knee, motion, reference=reference, method=method, compare=compare, landmarks=landmarks, side=side,
            frame=frame, views=[name.strip() for name in view.split(",") if name.strip()], limit_mm=limit,
            noise_mm=noise, out=folder, progress=progress,
        )  # fmt: skip
        for label, text in moving.summary().lines.items():
            progress.report(f"{label}: {text}")
    end_with_verdict(moving.verdict, page=folder / "knee.html")


@app.command()
def template(
    sources: Annotated[
        list[Path],
        typer.Argument(
            metavar="SOURCE...",
            help="Labels with names.json beside them; or contours.json, optionally with its volume.",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="FOLDER", help="Folder for the template. [default: SOURCE_template]"),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Make a template from a labelled or outlined knee, for `segment --template` and `register`.

    The results are `labels.nii.gz`, `labels.json` and a closed surface of each structure (`femur.ply`, ...; LPS, mm).
    Warnings name what is missing or implausible: bones, cartilage away from its bone, separate pieces, an unknown side.

    Examples:
    * `marey knee template atlas/labels.nii.gz --out my_template`
    * `marey knee template contours.json knee.nii.gz --out my_template`
    """
    from marey.pipelines.knee.template import TEMPLATE_RESULTS, make_template
    from marey.pipelines.run_details import writable_folder

    folder = out or sources[0].with_name(f"{sources[0].name.split('.')[0]}_template")
    with working(quiet=quiet) as progress, writable_folder(folder, sources, results=TEMPLATE_RESULTS):
        made = make_template(sources, progress=progress)
        made.save(folder, progress=progress)
    kind = "A knee" if made.template.side is None else f"A {made.template.side} knee"
    typer.echo(f"{kind} with {', '.join(made.template.surfaces)}")
    end_with_verdict(made.details.verdict, template=folder)


@app.command()
def outline(
    volume: Annotated[
        Path, typer.Argument(metavar="VOLUME", help="Folder with a DICOM series, NIfTI, NRRD or MetaImage.")
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="FILE", help="File for the outlines. [default: VOLUME_contours.json]"),
    ] = None,
    port: Annotated[
        int,
        typer.Option(
            metavar="N",
            min=0,
            max=65535,
            help="Port of the page's address. [default: any free one]",
            show_default=False,
        ),
    ] = 0,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", metavar="", help="Print the address without opening it.")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Outline bones and cartilage slice by slice in the browser, with a live wire that follows the edges.

    The page can be opened only on this computer. Each change is saved at once, and the same command continues with the
    saved outlines. `marey knee template` makes a template from them. Ctrl-C ends the command.

    Examples:
    * `marey knee outline knee.nii.gz`
    * `marey knee outline series --out contours.json --no-browser`
    """
    import webbrowser

    from marey.pipelines.knee.outline import outline_server, serve
    from marey.process import without_collection_pauses

    with working(quiet=quiet) as progress:
        server = outline_server(volume, out, port, progress)
    typer.echo(f"Outlining at {server.address}; the outlines are saved in {server.session.path}. Ctrl-C ends it.")
    if not no_browser:
        webbrowser.open(server.address)
    with without_collection_pauses():
        serve(server)

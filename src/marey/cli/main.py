"""The program `marey`: its commands, and how errors reach the person who typed them."""

import errno
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

import marey
from marey.cli import knee
from marey.cli.markers import markers
from marey.cli.nonrigid import nonrigid
from marey.cli.options import BodyFile, Cameras, FixedSizes, Frames, NoOverlay, Out, Preset, Quiet, Start, Stature
from marey.cli.work import working
from marey.errors import FileProblem, MareyError
from marey.pipelines.capture.settings import parse_frames, parse_names

INTERRUPTED = 130
WRONG_INPUT = 2
RESULTS = "marey"
"""Folder of the results in a trial."""
_PAGES = ("report.html", "surface.html", "knee.html")
_USERS_ERRNO = (errno.EACCES, errno.EPERM, errno.ENOSPC, errno.EROFS, errno.ENOTDIR, errno.EDQUOT, errno.EFBIG)

app = typer.Typer(
    name="marey",
    help="Measure how a body moves and what shape it has, from what is seen at its surface.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.add_typer(knee.app, name="knee")


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"marey {marey.__version__}")
        raise typer.Exit


@app.callback()
def program(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Measure how a body moves and what shape it has, from what is seen at its surface."""


@app.command()
def capture(
    trial: Annotated[Path, typer.Argument(metavar="TRIAL", help="Folder with one video a camera and cameras.toml.")],
    out: Out = None,
    cameras: Cameras = None,
    frames: Frames = None,
    preset: Preset = None,
    stature: Stature = None,
    start: Start = None,
    body: BodyFile = None,
    fixed_sizes: FixedSizes = False,
    no_overlay: NoOverlay = False,
    quiet: Quiet = False,
) -> None:
    """Capture the joint motion of the person in a trial.

    TRIAL holds `cam01.mp4`, ... and `cameras.toml`, if possible `background/cam01.png`, ... of the empty room, and
    perhaps `trial.toml`. Interrupted with Ctrl-C, the same command goes on where it was.

    Examples:
    * `marey capture walk01`
    * `marey capture walk01 --stature 1.80 --frames 100:400 --out results/walk01`
    * `marey capture walk01 --cameras cam01,cam02,cam04 --preset upper --no-overlay`
    """
    _capture(
        trial, out=out, cameras=_names(cameras), frames=_range(frames), preset=preset, stature=stature, start=start,
        body=body, fixed_sizes=fixed_sizes, overlay=not no_overlay, quiet=quiet,
    )  # fmt: skip


@app.command()
def surface(
    trial: Annotated[
        Path, typer.Argument(metavar="TRIAL", help="Folder with cameras.toml and a video, or stills, of each camera.")
    ],
    out: Out = None,
    cameras: Cameras = None,
    frames: Frames = None,
    seeds: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Clicked seeds: CSV, x and y in each camera of cameras.toml a row."),
    ] = None,
    spacing: Annotated[int, typer.Option(metavar="PX", help="Distance from point to point in the picture.")] = 2,
    patch: Annotated[int, typer.Option(metavar="PX", help="Width of the smallest patches, an odd number.")] = 13,
    refine_rig: Annotated[
        bool | None,
        typer.Option(
            "--refine-rig/--keep-rig",
            help="Correct the cameras' poses by the matches, or never. [default: where three or more plainly need it]",
        ),
    ] = None,
    tracks: Annotated[
        bool, typer.Option("--tracks/--no-tracks", help="Follow points from frame to frame, where there are several.")
    ] = True,
    max_speed: Annotated[
        float | None, typer.Option(metavar="M/S", help="Tracks faster than this are false. [default: from the data]")
    ] = None,
    max_acceleration: Annotated[
        float | None, typer.Option(metavar="M/S2", help="Tracks that change faster are false. [default: from the data]")
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Measure the visible surface of what a trial shows, as 3-D points, and follow it from frame to frame.

    TRIAL holds `cameras.toml` and `cam01.mp4`, ..., or stills `cam01_1.jpg`, ..., or `images/cam01.jpg`, ... of one
    instant; pictures of the empty room in `background/`, or known `masks/`, keep the room out. The surface needs
    texture, and cameras 10 to 25 degrees apart.

    Examples:
    * `marey surface face1`
    * `marey surface arm3 --spacing 4 --frames 0:10`
    * `marey surface face1 --seeds clicked.csv --keep-rig`
    """
    from marey.pipelines.surface.tasks import measure_surface

    _require_folder(trial)
    with working(quiet=quiet, parallel_cameras=True) as progress:
        found = measure_surface(
            trial, out=out or trial / RESULTS, cameras=_names(cameras), frames=_range(frames), seeds=seeds,
            spacing=spacing, patch=patch, refine_rig=refine_rig, tracks=tracks, max_speed=max_speed,
            max_acceleration=max_acceleration, progress=progress,
        )  # fmt: skip
    typer.echo(f"Surface: {found.path}")


@app.command()
def shape(
    trial: Annotated[Path, typer.Argument(metavar="TRIAL", help="Folder with one video a camera and cameras.toml.")],
    out: Out = None,
    cameras: Cameras = None,
    frames: Frames = None,
    preset: Preset = None,
    stature: Stature = None,
    start: Start = None,
    body: BodyFile = None,
    no_overlay: NoOverlay = False,
    quiet: Quiet = False,
) -> None:
    """Fit the person's own body: skeleton, metaballs, skin.

    What `marey surface` measured is read from the folder of the results, or measured first. Silhouettes speak, too.
    Beside what `marey capture` leaves there is `segments.csv`: lengths, girths, volumes, masses and inertia.

    Examples:
    * `marey shape arm --preset right_arm`
    * `marey shape walk01 --stature 1.80 --out results/walk01`
    """
    from marey.pipelines.shape.tasks import fit_shape

    _require_folder(trial)
    with working(quiet=quiet, parallel_cameras=True) as progress:
        found = fit_shape(
            trial, out=out or trial / RESULTS, cameras=_names(cameras), frames=_range(frames), preset=preset,
            stature=stature, start=start, body=body, overlay=not no_overlay, progress=progress,
        )  # fmt: skip
    typer.echo(f"Report: {found.report}")


@app.command()
def demo(out: Out = None, quiet: Quiet = False) -> None:
    """Capture the take that comes with the program, and say where its report is."""
    from marey.io.trial.example import example_folder

    example = example_folder()
    if out is None and Path(sys.prefix) in example.parents:
        # Results do not belong into the folder of an installed program.
        out = Path("marey-demo")
    _capture(example, out=out, quiet=quiet)


@app.command()
def retarget(
    motion: Annotated[Path, typer.Argument(metavar="MOTION", help="A folder of results, or a motion.npz.")],
    character: Annotated[Path, typer.Argument(metavar="CHARACTER", help="A GLB or glTF with a skinned mesh.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="FILE", help="The file to write. [default: beside the motion]"),
    ] = None,
    named: Annotated[
        Path | None,
        typer.Option("--map", metavar="FILE", help='A TOML with \\[joints] and left_thigh = "name in the character".'),
    ] = None,
    no_ground: Annotated[
        bool, typer.Option("--no-ground", help="Do not keep the lower foot at the person's height above the floor.")
    ] = False,
    plant_feet: Annotated[
        bool, typer.Option("--plant-feet", help="Keep feet that stand still exactly in their place: legs bend for it.")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Put a recovered motion on another character.

    The character's own names, sizes, rest posture and axes may be what they like; the copy has the motion as one more
    animation and is otherwise unchanged.

    Examples:
    * `marey retarget walk01/marey knight.glb`
    * `marey retarget walk01/marey knight.glb --map knight.toml --out knight_walks.glb`
    """
    from marey.pipelines.retarget import check_copy, copy_beside
    from marey.pipelines.retarget import retarget as transfer

    with working(quiet=quiet):
        path = out or copy_beside(motion, character)
        check_copy(path, character)
        moved = transfer(motion, character, names=named, grounded=not no_ground, planted=plant_feet)
        moved.save(path)
    for note in moved.notes if not quiet else []:
        typer.echo(note)
    typer.echo(f"Written: {path}")


app.command()(markers)
app.command()(nonrigid)


@app.command()
def compare(
    first: Annotated[Path, typer.Argument(metavar="A", help="A folder of results, or a MOT, TRC, STO, C3D or NPZ.")],
    second: Annotated[Path, typer.Argument(metavar="B", help="Another one; differences are A less B.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="DIR", help="Where the results go. [default: A_compared_with_B]"),
    ] = None,
    named: Annotated[
        Path | None,
        typer.Option("--map", metavar="FILE", help='A TOML with \\[angles] "name in A" = "name in B".'),
    ] = None,
    shift: Annotated[
        float | None, typer.Option(metavar="S", help="The second clock less the first, in seconds, where it is known.")
    ] = None,
    same_laboratory: Annotated[
        bool, typer.Option("--same-laboratory", help="Both are in one laboratory: take out no rigid offset.")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Compare two motions: RMS, bias, limits of agreement and correlation of every angle and point.

    The shift of the clocks and the rigid offset of the laboratories are estimated first. What the motions call alike
    is compared; names of OpenSim's models and of Plug-in Gait are known, others are given with `--map`.

    Examples:
    * `marey compare walk01/marey walk01_ik.mot`
    * `marey compare walk01_marey walk02_marey --same-laboratory --shift 0`
    """
    from marey.pipelines.compare import CompareOptions, compare_files, comparison_text

    options = CompareOptions(named=named, shift_s=shift, same_laboratory=same_laboratory)
    with working(quiet=quiet) as progress:
        found = compare_files(first, second, options, progress)
        results = found.save(out or Path(f"{found.labels[0]}_compared_with_{found.labels[1]}"))
        for line in comparison_text(found.data):
            progress.report(line)
    typer.echo(f"Report: {results / 'report.html'}")


@app.command()
def view(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A folder of results, or a page in it.")],
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Only print where the report is.")] = False,
) -> None:
    """Show what was measured, in the browser. Where several commands left pages, the others are named.

    Example: `marey view walk01/marey`
    """
    import webbrowser

    report = _report_in(folder)
    typer.echo(report)
    for other in [report.with_name(name) for name in _PAGES if report.name != name]:
        if other.is_file():
            typer.echo(f"Also there: {other}", err=True)
    if not no_browser:
        webbrowser.open(report.as_uri())


@app.command()
def bench(
    trial: Annotated[
        Path | None, typer.Argument(metavar="[TRIAL]", help="A trial, to time the whole way from video to pose.")
    ] = None,
) -> None:
    """Measure the speeds that matter, each beside a peer's or a limit, in one run.

    Examples: `marey bench`, `marey bench examples/reach`
    """
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from marey.io.trial.example import example_folder
    from marey.pipelines.speed.speeds import machine, measure_speeds

    with working(parallel_cameras=True) as progress:
        speeds = measure_speeds(trial, example=example_folder(), progress=progress)
    title = f"marey bench on {machine()}; times of one core"
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for heading in ("what", "measured", "beside", "remark"):
        table.add_column(heading, overflow="fold")
    for speed in speeds:
        table.add_row(*map(escape, (speed.what, speed.measured, speed.beside, speed.remark)))
    Console(width=None if sys.stdout.isatty() else 200).print(table)


def _capture(trial: Path, *, out: Path | None, quiet: bool, **settings: Any) -> None:
    # Imported here, so that help and errors in the arguments appear at once.
    from marey.pipelines.capture.tasks import capture as capture_motion

    _require_folder(trial)
    with working(quiet=quiet, parallel_cameras=True) as progress:
        found = capture_motion(trial, out=out or trial / RESULTS, progress=progress, **settings)
    typer.echo(f"Report: {found.report}")


def _names(text: str | None) -> tuple[str, ...] | None:
    return None if text is None else parse_names(text)


def _range(text: str | None) -> tuple[int, int] | None:
    return None if text is None else parse_frames(text)


def _require_folder(trial: Path) -> None:
    if not trial.is_dir():
        what = "is a file" if trial.exists() else "does not exist"
        raise FileProblem(trial, what, "Give the folder that holds the videos and cameras.toml.")


def _report_in(folder: Path) -> Path:
    if folder.suffix.lower() == ".html" and folder.is_file():
        return folder.resolve()
    for name in _PAGES:
        for report in (folder / name, folder / "marey" / name, folder / "knee" / name):
            if report.is_file():
                return report.resolve()
    raise FileProblem(
        folder, f"holds no {' or '.join(_PAGES)}", "Give the folder that a command said its results went to."
    )


def run(arguments: Sequence[str] | None = None) -> int:
    """Run the program and turn what a user can mend into one line.

    Args:
        arguments: What was typed after the program's name; the process's own when missing.

    Returns:
        The exit code: 0, 2 for wrong input, 130 when interrupted. Errors of the program itself leave with a traceback.
    """
    try:
        typed = knee.with_seeds_joined(sys.argv[1:] if arguments is None else arguments)
        code = app(args=typed, prog_name="marey", standalone_mode=False)
    except MareyError as problem:
        return _complain(str(problem))
    except typer.TyperException as problem:
        return _complain(_usage_line(problem))
    except OSError as problem:
        if problem.errno not in _USERS_ERRNO:
            raise
        return _complain(f"{problem.filename or 'a file'}: {problem.strerror}. Check the rights and the space there.")
    except KeyboardInterrupt:
        code = INTERRUPTED
    if code == INTERRUPTED:
        print("\nInterrupted. Type the same command again to go on.", file=sys.stderr)
    return code if isinstance(code, int) else 0


def _usage_line(problem: Exception) -> str:
    text = problem.format_message() if hasattr(problem, "format_message") else str(problem)
    context = getattr(problem, "ctx", None)
    return f"{text.rstrip('.')}. See {context.command_path if context else 'marey'} --help."


def _complain(text: str) -> int:
    print("marey: " + " ".join(text.split()), file=sys.stderr)
    return WRONG_INPUT


def main() -> None:
    """Enter from the command line."""
    sys.exit(run())

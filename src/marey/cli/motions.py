"""The commands `compare`, `device`, `export`, `gait` and `retarget`, which read motions that were measured before."""

from pathlib import Path
from typing import Annotated

import typer

from marey.cli.options import Quiet
from marey.cli.work import end_with_verdict, working


def retarget(
    motion: Annotated[Path, typer.Argument(metavar="MOTION", help="A folder of results, or a motion.npz.")],
    character: Annotated[Path, typer.Argument(metavar="CHARACTER", help="A GLB or glTF file with a skinned mesh.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="FILE", help="The file to write. [default: beside the motion]"),
    ] = None,
    named: Annotated[
        Path | None,
        typer.Option("--map", metavar="FILE", help='TOML with \\[joints] and lines such as left_thigh = "its name".'),
    ] = None,
    no_ground: Annotated[
        bool,
        typer.Option(
            "--no-ground", metavar="", help="Do not adjust the character's height so that its feet reach the floor."
        ),
    ] = False,
    plant_feet: Annotated[
        bool,
        typer.Option(
            "--plant-feet", metavar="", help="Keep feet that stand still exactly in place, by bending the legs."
        ),
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Transfer a measured motion to another character.

    The character may have its own names, sizes, rest posture and axes. The copy has the motion as an additional
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
    end_with_verdict(moved.verdict, written=path)


def compare(
    first: Annotated[Path, typer.Argument(metavar="A", help="A folder of results, or a MOT, TRC, STO, C3D or NPZ.")],
    second: Annotated[Path, typer.Argument(metavar="B", help="Another motion; differences are A minus B.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="DIR", help="Folder for the results. [default: A_compared_with_B]"),
    ] = None,
    named: Annotated[
        Path | None,
        typer.Option("--map", metavar="FILE", help='TOML with \\[angles] and lines such as "name in A" = "name in B".'),
    ] = None,
    shift: Annotated[
        float | None,
        typer.Option(metavar="S", help="Time shift in seconds, if known: the clock of B minus that of A."),
    ] = None,
    clock: Annotated[
        str,
        typer.Option(
            metavar="WHAT", help="Estimate the offset of the clock of B alone, or also its rate: offset, rate."
        ),
    ] = "offset",
    same_laboratory: Annotated[
        bool,
        typer.Option(
            "--same-laboratory", metavar="", help="Both motions are in one laboratory: estimate no rigid offset."
        ),
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Compare two motions: RMS, bias, limits of agreement and correlation of every angle and point.

    The shift of the clocks and the rigid offset of the laboratories are estimated first. Quantities of the same name
    are compared. Names of OpenSim's models and of Plug-in Gait are recognised; for other names use `--map`.

    Examples:
    * `marey compare walk01/marey walk01_ik.mot`
    * `marey compare walk01_marey walk02_marey --same-laboratory --shift 0`
    """
    from marey.pipelines.compare import (
        COMPARE_RESULTS,
        CompareOptions,
        compare_files,
        comparison_folder,
        comparison_text,
    )
    from marey.pipelines.run_details import writable_folder

    options = CompareOptions(named=named, shift_s=shift, clock=clock, same_laboratory=same_laboratory)
    folder = out or comparison_folder(first, second)
    inputs = [path for path in (first, second, named) if path is not None]
    with working(quiet=quiet) as progress, writable_folder(folder, inputs, results=COMPARE_RESULTS):
        found = compare_files(first, second, options, progress)
        results = found.save(folder)
        for line in comparison_text(found.data):
            progress.report(line)
    end_with_verdict(found.verdict, report=results / "report.html")


def gait(
    walks: Annotated[
        list[Path],
        typer.Argument(metavar="WALK...", help="Folders with results of `marey capture` or `marey markers`."),
    ],
    references: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Folder with the results of your reference walks, in folders of their own at any depth."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="DIR", help="Folder for the results. [default: gait]"),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Show the gait cycles of walks side by side, and their distances from reference walks.

    The page holds the angles over the cycle over the band of the reference walks, the Gait Profile Score with its parts
    by angle, and a table of the parameters of the steps. Without `--references`, two walks or more are compared.

    Examples:
    * `marey gait walk01/marey --references healthy`
    * `marey gait before/marey after/marey --references healthy --out before_after`
    """
    from marey.pipelines.gait.walks import GAIT_RESULTS, compare_gait
    from marey.pipelines.run_details import writable_folder

    folder = out or Path("gait")
    inputs = [*walks, *([] if references is None else [references])]
    with working(quiet=quiet) as progress, writable_folder(folder, inputs, results=GAIT_RESULTS):
        found = compare_gait(walks, references, progress=progress)
        results = found.save(folder)
        for label, text in found.summary().lines.items():
            progress.report(f"{label}: {text}")
    end_with_verdict(found.verdict, report=results / "report.html")


def device(
    motion: Annotated[Path, typer.Argument(metavar="MOTION", help="A folder of results, or a MOT, TRC, C3D or NPZ.")],
    signals: Annotated[Path, typer.Argument(metavar="FILE", help="The device's C3D, MOT, STO, TRC or CSV.")],
    match: Annotated[
        list[str] | None,
        typer.Option(
            metavar="COLUMNS=QUANTITY",
            help="What is compared: a column, a sum A+B, or a vector X,Y,Z; and force, turning:SEGMENT, "
            "acceleration:POINT, speed:POINT, height:POINT or angle:NAME. Several are possible. [default: the vertical "
            "force of the plates of a C3D]",
        ),
    ] = None,
    events: Annotated[
        Path | None,
        typer.Option(
            metavar="CSV", help="Instants of the same events on both clocks: columns motion_s and device_s, in seconds."
        ),
    ] = None,
    within: Annotated[
        float | None,
        typer.Option(metavar="S", help="Largest difference of both clocks at one instant, if known, in seconds."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="DIR", help="Folder for the results. [default: FILE_at_frames]"),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Estimate the clock of a force plate, EMG, IMU or other device, and resample its signals at a motion's frames.

    Offset and rate are estimated from signals that rise and fall with the motion, or from events.

    Examples:
    * `marey device jump01/marey jump01.c3d`
    * `marey device walk01/marey imu.csv --match gyro_x,gyro_y,gyro_z=turning:left_shank`
    * `marey device walk01/marey emg.csv --events taps.csv`
    """
    from marey.pipelines.device import DEVICE_RESULTS, align_device, clock_text
    from marey.pipelines.run_details import writable_folder

    folder = out or Path(f"{signals.stem}_at_frames")
    inputs = [motion, signals] if events is None else [motion, signals, events]
    with working(quiet=quiet) as progress, writable_folder(folder, inputs, results=DEVICE_RESULTS):
        found = align_device(motion, signals, match=match or (), events=events, within=within, progress=progress)
        results = found.save(folder)
        progress.report(f"{signals.name}: {clock_text(found.clock)}")
    end_with_verdict(found.verdict, signals=results / "signals.csv")


def export(
    results: Annotated[
        Path, typer.Argument(metavar="RESULTS", help="Results of `marey capture`, `marey shape` or `marey markers`.")
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "-o",
            metavar="PATH",
            help="Folder of the dataset (bids), to which recordings are added; folder for the files (opensim); or the "
            "new file (movement, c3d).",
        ),
    ],
    to: Annotated[
        str,
        typer.Option(
            "--to",
            metavar="FORM",
            help="bids: a Motion-BIDS dataset; movement, movement-0.17: a NetCDF for the Python package movement "
            "before and from version 0.17; c3d: points, rotations, joint angles and events; opensim: your own OpenSim "
            "model, scaled to the person.",
        ),
    ] = "bids",
    subject: Annotated[str, typer.Option(metavar="LABEL", help="The person: letters and digits.")] = "01",
    task: Annotated[
        str | None, typer.Option(metavar="LABEL", help="bids: the task. [default: the name of the recording]")
    ] = None,
    session: Annotated[
        str | None, typer.Option(metavar="LABEL", help="bids: the session, if there are several.")
    ] = None,
    run: Annotated[int | None, typer.Option(metavar="N", help="bids: the repetition, if there are several.")] = None,
    model: Annotated[
        Path | None, typer.Option(metavar="FILE", help="opensim: the OpenSim model (.osim) that is scaled.")
    ] = None,
    joints: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help='opensim: TOML with \\[joints] and lines such as left_hip = "hip_l", for joints of the model that are '
            "not recognised by the names of its bodies.",
        ),
    ] = None,
    mass: Annotated[
        float | None,
        typer.Option(
            metavar="KG",
            help="opensim: mass of the person in kilograms. [default: that of the recording, or estimated from the "
            "volume of a captured body]",
        ),
    ] = None,
    forces: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="opensim: C3D with force plates in the laboratory of the results. [default: the C3D of a marker "
            "trial]",
        ),
    ] = None,
    clock: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="opensim: clock.json of marey device for the force plates. [default: the clock of the results]",
        ),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Write results in a form in which laboratories and archives exchange motions.

    Examples:
    * `marey export walk01/marey --out dataset --subject 01 --task walk`
    * `marey export walk01/marey --to movement --out walk01.nc`
    * `marey export walk01/marey --to c3d --out walk01.c3d`
    * `marey export walk01/marey --to opensim --model Rajagopal.osim --mass 71.5 --out walk01_opensim`
    * `marey export walk01/marey --to opensim --model Rajagopal.osim --forces plates.c3d --out walk01_opensim`
    """
    from marey.pipelines.exchange.export import export as write

    with working(quiet=quiet) as progress:
        path = write(
            results, out=out, to=to, subject=subject, task=task, session=session, run=run, model=model, joints=joints,
            mass_kg=mass, forces=forces, clock=clock, progress=progress,
        )  # fmt: skip
    if not quiet:
        typer.echo(f"Written: {path}")

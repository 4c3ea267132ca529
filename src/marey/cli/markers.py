"""The command `marey markers`."""

from pathlib import Path
from typing import Annotated

import typer

from marey.cli.options import Frames, Quiet, frame_range, parse_names, parse_values
from marey.cli.work import end_with_verdict, working

_Trial = Annotated[
    Path, typer.Argument(metavar="TRIAL", help="A C3D, TRC or CSV with the trajectories of skin markers.")
]
_Reference = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="NPZ with the poses of the bones in one frame of the trial, or in several."),
]
_Clusters = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="TOML with the markers on each segment, landmarks, joints, noise, measurements of the person, and trials "
        "of a pointer.",
    ),
]
_Static = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Trial of the person standing, with the landmarks that the TOML names or the marker set has.",
    ),
]
_Functional = Annotated[
    list[Path] | None,
    typer.Option(
        metavar="FILE", help="Trial of a hip or shoulder in motion, which gives the joint centre; can be repeated."
    ),
]
_Exercise = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Trial from which the method `artefact` learns the motion of the skin."),
]
_ExerciseReference = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="NPZ with the poses of the bones in frames of the exercise."),
]
_Method = Annotated[
    str | None,
    typer.Option(
        metavar="NAME,...",
        help="Methods separated by commas, or `all`. The files contain the results of the first. [default: skin]",
    ),
]
_Model = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="OpenSim model that is fitted to the markers by inverse kinematics."),
]
_Weights = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="XML with the weights of the markers and coordinates (inverse kinematics tasks). "
        "[default: equal weight for all markers]",
    ),
]
_Out = Annotated[
    Path | None,
    typer.Option("--out", "-o", metavar="DIR", help="Folder for the results. [default: TRIAL_marey]"),
]
_Fill = Annotated[
    str,
    typer.Option(
        metavar="WAY", help="Fill gaps: spline (over time), cluster (from the segment's other markers), best, none."
    ),
]
_Unit = Annotated[
    str | None, typer.Option(metavar="UNIT", help="Unit of the file (mm, cm or m), if the one it states is wrong.")
]
_Side = Annotated[
    str | None,
    typer.Option(
        metavar="SIDE", help="Side of the body, left or right, if the names of the segments do not contain it."
    ),
]
_MarkerSet = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help="Marker set of the labels: pig-lower, pig-full, cgm2.3-lower, cgm2.3-full, cgm2.4-lower, "
        "cgm2.4-full, ior, cast, opencap or opensim. [default: recognised]",
    ),
]
_Person = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help="Name of the person before the labels (NAME:LASI, NAME_LASI), if the files have the markers of several "
        "people.",
    ),
]
_Measurements = Annotated[
    str | None,
    typer.Option(
        metavar="NAME=MM,...",
        help="Measurements of the person for a known marker set: leg_length_mm, knee_width_mm, ankle_width_mm (also "
        "with left_ or right_), marker_diameter_mm. [default: from the files, otherwise assumed widths]",
    ),
]


def markers(
    trial: _Trial,
    reference: _Reference = None,
    clusters: _Clusters = None,
    static: _Static = None,
    functional: _Functional = None,
    exercise: _Exercise = None,
    exercise_reference: _ExerciseReference = None,
    method: _Method = None,
    model: _Model = None,
    weights: _Weights = None,
    out: _Out = None,
    frames: Frames = None,
    fill: _Fill = "none",
    unit: _Unit = None,
    side: _Side = None,
    marker_set: _MarkerSet = None,
    person: _Person = None,
    measurements: _Measurements = None,
    quiet: Quiet = False,
) -> None:
    """Estimate the motion of bones from skin markers.

    The labels of a known marker set, such as Plug-in Gait, give segments and joints. Otherwise markers with the labels
    `thigh_01`, `thigh_02`, ... are on the segment `thigh`, or a TOML names the markers of each segment. The results are
    the poses of the bones, joint angles and translations with standard deviations, the motion of each marker relative
    to its bone, and a report with the curves of all methods.

    Examples:
    * `marey markers walk.c3d --static static.c3d` (Plug-in Gait or another known marker set)
    * `marey markers walk.c3d --measurements knee_width_mm=99,ankle_width_mm=65`
    * `marey markers two_people.c3d --person Ann`
    * `marey markers walk.c3d --reference walk_frame0.npz`
    * `marey markers walk.c3d --reference walk_frame0.npz --method all --out results/walk`
    * `marey markers walk.c3d --clusters person.toml --static static.c3d --functional left_hip.c3d`
    * `marey markers walk.trc --model scaled.osim --weights tasks.xml`
    """
    from marey.markers.methods.methods import choose_methods
    from marey.pipelines.markers.estimate import estimate_bones, open_markers

    methods = None if method is None else parse_names(method, option="--method", example="rigid,interval")
    choose_methods(methods or ())
    sizes = parse_values(measurements, option="--measurements", example="knee_width_mm=99,ankle_width_mm=65")
    folder = out or trial.with_name(f"{trial.stem}_marey")
    with working(quiet=quiet) as progress:
        opened = open_markers(
            trial, reference=reference, clusters=clusters, static=static, functional=functional or (),
            exercise=exercise, exercise_reference=exercise_reference, model=model, weights=weights,
            frames=frame_range(frames), fill=fill, unit=unit, side=side, marker_set=marker_set,
            person=person, measurements=sizes, out=folder, progress=progress,
        )  # fmt: skip
        bones = estimate_bones(opened, methods, out=folder, progress=progress)
        for label, text in bones.summary().lines.items():
            progress.report(f"{label}: {text}")
    end_with_verdict(bones.verdict, report=folder / "report.html")

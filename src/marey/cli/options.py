"""Options that several commands share, and the conversion of their values."""

import re
from pathlib import Path
from typing import Annotated

import typer

from marey.body.articulation.presets import GENERIC_BODIES, PRESETS
from marey.errors import FileProblem, SettingProblem

RESULTS = "marey"
"""Name of the folder for results in the folder of a trial."""

Out = Annotated[
    Path | None, typer.Option("--out", "-o", metavar="DIR", help="Folder for the results. [default: TRIAL/marey]")
]
Cameras = Annotated[str | None, typer.Option(metavar="A,B,...", help="Names of the cameras to use.")]
Frames = Annotated[
    str | None,
    typer.Option(metavar="A:B", help="Use only the frames from A up to, but not including, B; the first frame is 0."),
]
Preset = Annotated[
    str | None,
    typer.Option(metavar="NAME", help=f"Part of the body to follow: {', '.join(PRESETS)}. [default: full]"),
]
Stature = Annotated[float | None, typer.Option(metavar="M", help="Height of the person in metres, if it is known.")]
LegLength = Annotated[
    float | None,
    typer.Option(
        metavar="M",
        help="Leg length in metres, from the anterior superior iliac spine (ASIS) to the medial malleolus. It places "
        "the hips.",
    ),
]
AsisDistance = Annotated[
    float | None,
    typer.Option(metavar="M", help="Distance between both ASIS in metres. It places the hips."),
]
Start = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Clicked or detected joints of one frame to start from: JSON, or a folder of OpenPose JSON files.",
    ),
]
CameraUncertainty = Annotated[
    bool,
    typer.Option(
        "--camera-uncertainty/--no-camera-uncertainty",
        help="Enlarge the standard deviations by the uncertainty of the cameras, where calibration.json beside "
        "cameras.toml states it, or a camera was found again.",
    ),
]
KeyPointsFolder = Annotated[
    Path | None,
    typer.Option(
        "--keypoints",
        metavar="DIR",
        help="Folder with the joints that a detector found in every image: CAMERA_json/*_NUMBER.json as OpenPose "
        "writes them (BODY_25, COCO, Halpe-26, BlazePose).",
    ),
]
Person = Annotated[
    str | None,
    typer.Option(
        metavar="WHO",
        help="The person to follow if several are present: a number of --list-people, a click CAMERA:X,Y@FRAME, a box "
        "CAMERA:X0,Y0,X1,Y1@FRAME, or a place X,Y,Z@FRAME in metres. [default: the one who is seen best]",
    ),
]
People = Annotated[
    str | None,
    typer.Option(metavar="all", help="Capture everybody, into DIR/person1, DIR/person2, ... and the table people.csv."),
]
ListPeople = Annotated[
    bool,
    typer.Option(
        "--list-people",
        metavar="",
        help="List the people with their numbers, draw them in people_CAMERA.png, and stop.",
    ),
]
PersonNet = Annotated[
    Path | None,
    typer.Option(
        "--person-net",
        metavar="FILE",
        help="Network that segments people, TFLite or ONNX: RGB from 0 to 1 in, probability of a person out. It is "
        "evidence for the silhouettes.",
    ),
]
BodyFile = Annotated[
    str | None,
    typer.Option(
        "--body",
        metavar="FILE|NAME",
        help="The person's body: a body.npz of an earlier run, a skinned GLB, or a TOML that names a mesh; or the name "
        f"of a generic body: {', '.join(GENERIC_BODIES)}.",
    ),
]
FixedSizes = Annotated[
    bool, typer.Option("--fixed-sizes", metavar="", help="Keep the dimensions of the body instead of estimating them.")
]
SurfaceTracks = Annotated[
    bool,
    typer.Option(
        "--surface-tracks/--no-surface-tracks",
        help="Track patches of the surface through the images, which measure turns of limbs about their axes.",
    ),
]
Sync = Annotated[
    str | None,
    typer.Option(
        metavar="off",
        help="off: ignore that the cameras have clocks of their own, which TRIAL/sync.json (see `marey sync`) states, "
        "or the silhouettes show. [default: use them]",
    ),
]
Check = Annotated[
    str | None,
    typer.Option(
        metavar="off",
        help="off: do not check the cameras against each other. [default: exchanged, mirrored, late or moved cameras "
        "are named, and repaired or not used]",
    ),
]
NoOverlay = Annotated[bool, typer.Option("--no-overlay", metavar="", help="Do not draw overlay videos.")]
Workers = Annotated[
    int | None,
    typer.Option(
        metavar="N",
        min=1,
        envvar="MAREY_WORKERS",
        help="Largest number of cores that work at the same time; the results do not depend on it. [default: all that "
        "the process may use]",
    ),
]
Quiet = Annotated[
    bool, typer.Option("--quiet", "-q", metavar="", help="Show only warnings and, at the end, the path of the report.")
]


def parse_frames(text: str) -> tuple[int, int]:
    """Read `A:B`: the frames A to B, without B. A missing A is 0.

    Args:
        text: The argument of `--frames`.

    Returns:
        The first frame and the one after the last.

    Raises:
        SettingProblem: The text has another form, or A is not less than B.
    """
    match = re.fullmatch(r"\s*(\d*)\s*:\s*(\d+)\s*", text)
    if match is None or int(match[1] or 0) >= int(match[2]):
        raise SettingProblem(f"--frames is '{text}'; it should be A:B (frames A to B, without B), for example 10:120.")
    return int(match[1] or 0), int(match[2])


def parse_names(text: str, *, option: str = "--cameras", example: str = "cam01,cam02") -> tuple[str, ...]:
    """Read names separated by commas.

    Args:
        text: The argument of the option.
        option: The option.
        example: An example of a correct argument.

    Returns:
        The names.

    Raises:
        SettingProblem: There is no name.
    """
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    if not names:
        raise SettingProblem(f"{option} is '{text}'; it should be names separated by commas, for example {example}.")
    return names


def parse_values(text: str | None, *, option: str, example: str) -> dict[str, float]:
    """Read names with numbers, `NAME=NUMBER`, separated by commas.

    Args:
        text: The argument of the option, which may be missing.
        option: The option.
        example: An example of a correct argument.

    Returns:
        The numbers by name; none without the option.

    Raises:
        SettingProblem: A part is not a name with a number, or a name occurs twice.
    """
    values: dict[str, float] = {}
    for part in () if text is None else parse_names(text, option=option, example=example):
        name, _, number = (piece.strip() for piece in part.partition("="))
        try:
            value = float(number)
        except ValueError:
            wrong = f"{option} contains '{part}'; it should be a name with a number, for example {example}."
            raise SettingProblem(wrong) from None
        if name in values:
            raise SettingProblem(f"{option} contains {name} twice.")
        values[name] = value
    return values


def wants_everybody(people: str | None, person: str | None) -> bool:
    """Read the argument of `--people`, which may be missing.

    Args:
        people: The argument of `--people`.
        person: The argument of `--person`.

    Raises:
        SettingProblem: It is not "all", or one person is named as well.
    """
    if people is None:
        return False
    if people != "all":
        raise SettingProblem(f"--people is '{people}'; it should be all. --person NUMBER follows one person.")
    if person is not None:
        raise SettingProblem("--people all captures everybody, --person only one: leave out one of them.")
    return True


def frame_range(text: str | None) -> tuple[int, int] | None:
    """Read the argument of `--frames`, which may be missing."""
    return None if text is None else parse_frames(text)


def camera_names(text: str | None) -> tuple[str, ...] | None:
    """Read the argument of `--cameras`, which may be missing."""
    return None if text is None else parse_names(text)


def require_trial(trial: Path) -> None:
    """Check that a trial is a folder, before the modules that read it are loaded.

    Raises:
        FileProblem: It is a file, or does not exist.
    """
    # A recording of an OpenCap session is named SESSION/NAME, which need not exist.
    in_session = not trial.exists() and any((trial.parent / name).is_dir() for name in ("Videos", "VideoData"))
    if not trial.is_dir() and not in_session:
        what = "is a file" if trial.exists() else "does not exist"
        raise FileProblem(trial, what, "Give the folder that holds the videos and cameras.toml.")

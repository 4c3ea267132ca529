"""Options that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

from marey.body.articulation.presets import GENERIC_BODIES, PRESETS

Out = Annotated[
    Path | None, typer.Option("--out", "-o", metavar="DIR", help="Where the results go. [default: TRIAL/marey]")
]
Cameras = Annotated[str | None, typer.Option(metavar="A,B,...", help="Names of the cameras to keep.")]
Frames = Annotated[str | None, typer.Option(metavar="A:B", help="Only frames A to B, without B; they count from 0.")]
Preset = Annotated[
    str | None,
    typer.Option(metavar="NAME", help=f"What to follow: {', '.join(PRESETS)}."),
]
Stature = Annotated[float | None, typer.Option(metavar="M", help="The person's height in metres, where it is known.")]
Start = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Clicked or detected joints to start from: JSON, or a folder of OpenPose JSON."),
]
BodyFile = Annotated[
    str | None,
    typer.Option(
        "--body",
        metavar="FILE|NAME",
        help="A body.npz found before, a skinned GLB, or a TOML that names a mesh; or a generic body by name: "
        f"{', '.join(GENERIC_BODIES)}.",
    ),
]
FixedSizes = Annotated[
    bool, typer.Option("--fixed-sizes", help="Keep the body's sizes as they are instead of learning them.")
]
NoOverlay = Annotated[bool, typer.Option("--no-overlay", help="Draw no overlay videos.")]
Quiet = Annotated[
    bool, typer.Option("--quiet", "-q", help="Show nothing but warnings, and the report's place at the end.")
]

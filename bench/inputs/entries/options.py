"""Words that the option parser refuses, for every command and option."""

from typing import Any

import typer

from bench.inputs.entries.entry import BadInput, bad, each
from marey.cli import main

VALID = {
    "init": "trial",
    "calibrate": "board",
    "cameras": "trial",
    "sync": "trial",
    "capture": "trial",
    "surface": "trial",
    "shape": "trial",
    "demo": "",
    "retarget": "motion knight.glb",
    "export": "motion --out dataset",
    "markers": "walk.c3d --reference frame0.npz",
    "nonrigid": "cluster.npz",
    "study": "study",
    "gait": "walk --references norm",
    "compare": "a.mot b.mot",
    "device": "hips.trc forces.csv",
    "view": "motion",
    "bench": "trial",
    "knee segment": "knee.nii.gz",
    "knee thickness": "bone.ply other.ply",
    "knee register": "bone.ply other.ply",
    "knee animate": "activity/knee activity/motion",
    "knee template": "atlas",
    "knee outline": "knee.nii.gz",
}
"""Arguments with which each command would run in the prepared folder."""


def commands() -> dict[str, Any]:
    """Return all commands of the program by their names."""
    program: Any = typer.main.get_command(main.app)
    found = dict(program.commands)
    knee = found.pop("knee")
    return found | {f"knee {name}": command for name, command in knee.commands.items()}


def _of(name: str, command: Any) -> list[BadInput]:
    start, hint = f"{name} {VALID[name]}".strip(), f"See marey {name} --help."
    entries = [
        bad(f"{start} --no-such-option", "--no-such-option", hint),
        bad(f"{start} a b c d --no-such-option", "--no-such-option", hint, why="and more arguments"),
    ]
    if VALID[name] and name != "bench":
        entries.append(bad(f"{name} --quiet" if name not in QUIETLESS else name, "Missing argument", hint))
    for option in command.params:
        flag = option.opts[0]
        if option.param_type_name != "option" or option.is_flag or flag == "--help":
            continue
        entries.append(bad(f"{start} {flag}", flag, "requires", hint))
        if option.type_descriptor.annotation in (int, float):
            entries.append(bad(f"{start} {flag} much", flag, "valid", hint))
    return entries


QUIETLESS = ("init", "cameras", "view", "knee thickness")
"""Commands without the option `--quiet`."""

GENERATED: tuple[BadInput, ...] = tuple(entry for name, command in commands().items() for entry in _of(name, command))
"""Options that are unknown, lack a value, or have letters for a number, and missing arguments, of every command."""
ENTRIES: tuple[BadInput, ...] = (
    *GENERATED,
    *each("{}", ("captur trial", "captur"), ("Capture trial", "Capture"), ("knee segmnt a.nii", "segmnt")),
    bad("knee", "Missing command", "marey knee --help", kept=("//",)),
    bad("--verson", "--verson"),
    bad("capture trial --frames=", "--frames is ''", "A:B"),
    bad("capture trial --no-overlay=1", "--no-overlay"),
    bad("capture trial other", "unexpected extra argument"),
    bad("capture trial --stature 1.8 --stature", "--stature"),
    bad("capture trial\udcff", "is not valid UTF-8"),
    bad("capture trial --body body\udcff.npz", "is not valid UTF-8"),
    bad("capture trial --cameras", "--cameras", how="started"),
    bad("capture trail", "trail: does not exist", "cameras.toml", how="started"),
    bad("view nowhere --no-browser", "nowhere: does not exist", how="started"),
    bad("view trial --no-browser", "trial: holds no report.html"),
    bad("view note.txt --no-browser", "note.txt: ", "Give the folder"),
    bad("view empty_folder --no-browser", "empty_folder: holds no report.html"),
    bad("bench nowhere", "nowhere: does not exist"),
    bad("bench note.txt", "note.txt: is a file"),
    bad("demo --out note.txt", "note.txt"),
)
"""The entries."""

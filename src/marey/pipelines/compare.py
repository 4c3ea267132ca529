"""`marey compare`: two motions side by side, as numbers and plots."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem, MareyError
from marey.io.markers.recordings import motion_in, read_recording
from marey.io.results.comparison import write_comparison
from marey.motion.comparison import MotionComparison
from marey.motion.comparison import compare as compare_motions
from marey.motion.names import hinge_sign, known_angle, known_point, known_segment, rename_columns
from marey.motion.recording import Recording
from marey.pipelines.progress import Progress
from marey.pipelines.run_record import StageCache, finished_together, write_record
from marey.view.pages.comparison_report import write_comparison_report

_POOR_S = 0.05
"""A standard deviation of the time shift that is told of [s]."""
_TABLES = ("angles", "points", "segments")


@dataclass(frozen=True, kw_only=True)
class CompareOptions:
    """What is asked for."""

    out: Path | None = None
    """Where the results go; `A_compared_with_B` where the command was typed when None."""
    named: Path | None = None
    """A TOML that names quantities which mean the same."""
    shift_s: float | None = None
    """The time shift where it is known."""
    same_laboratory: bool = False
    """Whether both are in one laboratory already."""


def compare(first: Path, second: Path, options: CompareOptions, progress: Progress) -> tuple[Path, MotionComparison]:
    """Compare two motions and write compare.csv and report.html.

    Args:
        first: A file or folder.
        second: Another one.
        options: What is asked for.
        progress: Is told.

    Returns:
        The folder with the results, and what was found.

    Raises:
        FileProblem: A file cannot be read, or the two have nothing in common.
    """
    sources = (motion_in(first), motion_in(second))
    chosen = {} if options.named is None else read_name_map(options.named)
    with progress.stage("Reading"):
        own, other = (read_recording(path) for path in sources)
        own, other = same_names(own, other, chosen, options.named)
    out = options.out or Path(f"{_label(first)}_compared_with_{_label(second)}")
    with progress.stage("Comparing"):
        try:
            result = compare_motions(own, other, shift_s=options.shift_s, same_laboratory=options.same_laboratory)
        except MareyError as problem:
            raise FileProblem(second, _nothing(own, other, str(problem)), "Name what is the same with --map.") from None
    for note in notes_of(result):
        progress.warn(note)
    asked = {"first": first, "second": second, "map": options.named, "shift_s": options.shift_s,
             "same_laboratory": options.same_laboratory}  # fmt: skip
    inputs = [*sources, *([options.named] if options.named else [])]
    with StageCache(out, asked), finished_together(out) as folder:
        write_comparison(folder / "compare.csv", result)
        write_comparison_report(
            folder / "report.html", result, names=(_label(first), _label(second)), notes=progress.warnings,
            settings=asked,
        )  # fmt: skip
        write_record(folder, command="compare", settings=asked, inputs=inputs, root=Path.cwd(), progress=progress)
    for line in told(result):
        progress.say(line)
    return out, result


def _label(path: Path) -> str:
    """Name a motion after its file, or after the folder that its results are in."""
    path = path.resolve()
    if path.name in ("motion.npz", "bones.npz"):
        path = path.parent
    if path.name == "marey":
        path = path.parent
    return path.name if path.is_dir() else path.stem


def _nothing(first: Recording, second: Recording, problem: str) -> str:
    has = " and ".join(
        f"{which} has {', '.join([*r.angle_names, *r.point_names, *r.segment_names][:8])}, ..."
        for which, r in (("the first", first), ("the second", second))
    )
    return f"cannot be compared ({problem.rstrip('.')}); {has}"


def read_name_map(path: Path) -> Mapping[str, Mapping[str, str]]:
    """Read a TOML of names: `[angles] knee_angle_r = "right_knee_flexion"`, and so `[points]` and `[segments]`.

    Raises:
        FileProblem: It is no TOML, or has another table.
    """
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise FileProblem(path, f"cannot be read as TOML ({error})", "See docs/compare.md.") from error
    known = f'Known are {", ".join(f"[{name}]" for name in _TABLES)} with "name in A" = "name in B".'
    unknown = sorted(set(tables) - set(_TABLES))
    if unknown:
        raise FileProblem(path, f"has the unknown key '{unknown[0]}'", known)
    for name, table in tables.items():
        if not isinstance(table, dict) or not all(isinstance(value, str) for value in table.values()):
            raise FileProblem(path, f"has something in [{name}] that is no name", known)
    return tables


def same_names(
    first: Recording, second: Recording, chosen: Mapping[str, Mapping[str, str]], path: Path | None = None
) -> tuple[Recording, Recording]:
    """Give both recordings the same names for the same quantities.

    What a user named comes first, then equal names, then the names by which OpenSim's models, Plug-in Gait and
    others are known.

    Args:
        first: A motion.
        second: Another one, whose names change to the first one's where a user says so.
        chosen: By kind, name in the first to name in the second; `-name` turns the sign.
        path: The file in which the user said it.

    Raises:
        FileProblem: A name that was given is in neither motion.
    """
    for kind, field in (("angles", "angle_names"), ("points", "point_names"), ("segments", "segment_names")):
        given = chosen.get(kind, {})
        for name, names in ((list(given), getattr(first, field)), ([*given.values()], getattr(second, field))):
            missing = [n for n in name if n.removeprefix("-") not in names]
            if missing and path is not None:
                has = f"There are: {', '.join(names) or 'none'}."
                raise FileProblem(path, f"names the {kind} {', '.join(missing)}, which are not in the motion", has)
        back = {other.removeprefix("-"): ("-" if other.startswith("-") else "") + own for own, other in given.items()}
        second = _renamed(second, field, *rename_columns(getattr(second, field), back))
        common = set(getattr(first, field)) & set(getattr(second, field))
        first, second = (_known_names(r, field, common) for r in (first, second))
    return first, second


def _known_names(recording: Recording, field: str, common: set[str]) -> Recording:
    """Rename what is known by another name, unless both recordings call it so."""
    old = getattr(recording, field)
    wanted = [(name, 1.0) if name in common else _known(recording, field, k) for k, name in enumerate(old)]
    own_names = [own for own, _ in wanted]
    # Two names for one thing, or a name that is there already: they stay apart.
    final = [
        (own, sign) if own_names.count(own) == 1 and (own == name or own not in old) else (name, 1.0)
        for (own, sign), name in zip(wanted, old, strict=True)
    ]
    return _renamed(recording, field, [own for own, _ in final], [sign for _, sign in final])


def _known(recording: Recording, field: str, k: int) -> tuple[str, float]:
    name = getattr(recording, field)[k]
    if field == "angle_names":
        own, sign = known_angle(name) or (name, 1.0)
        return own, sign * (hinge_sign(own, recording.angles[:, k]) if own != name else 1.0)
    return (known_point(name) if field == "point_names" else known_segment(name)) or name, 1.0


def _renamed(recording: Recording, field: str, names: Sequence[str], signs: Sequence[float]) -> Recording:
    changes: dict[str, object] = {field: tuple(names)}
    if field == "angle_names":
        changes["angles"] = recording.angles * np.array(signs, float)
    return replace(recording, **changes)  # type: ignore[arg-type]


def notes_of(result: MotionComparison) -> list[str]:
    """Say what a reader of the numbers should know."""
    alignment = result.alignment
    notes = list(alignment.notes)
    if np.isfinite(alignment.rival_s):
        notes.append(
            f"The motion repeats itself: a time shift of {alignment.rival_s:.3f} s fits nearly as well as the "
            f"{alignment.shift_s:.3f} s that were taken. Where you know better, say so with --shift."
        )
    if alignment.shift_sd_s > _POOR_S:
        notes.append(f"The time shift is known to {alignment.shift_sd_s:.2f} s only. Are the two of one trial?")
    for which, names in (("first", result.only_first), ("second", result.only_second)):
        if names:
            more = f" and {len(names) - 12} more" if len(names) > 12 else ""
            notes.append(f"Only in the {which} motion, not compared: {', '.join(names[:12])}{more}.")
    return notes


def told(result: MotionComparison) -> list[str]:
    """Say in a few lines what was found."""
    alignment, lines = result.alignment, []
    lines.append(f"{len(result.time)} frames in common, {result.time[-1] - result.time[0]:.2f} s.")
    lines.append(shift_text(alignment.shift_s, alignment.shift_sd_s))
    lines.extend(offset_text(result))
    for row in result.agreements:
        if row.kind == "angle" and row.frames:
            low, high = np.degrees(row.limits)
            lines.append(
                f"{row.name}: RMS {np.degrees(row.rms):.2f} deg, bias {np.degrees(row.bias):+.2f}, limits of agreement "
                f"{low:+.2f} to {high:+.2f}{_correlation(row.correlation)}"
            )
    apart = [row for row in result.agreements if row.kind == "distance" and row.frames]
    if apart:
        last = max(apart, key=lambda row: row.rms)
        lines.append(f"Farthest apart is {last.name.removesuffix(' distance')}: {1e3 * last.rms:.1f} mm (RMS).")
    return lines


def _correlation(value: float) -> str:
    return f", correlation {value:.3f}" if np.isfinite(value) else ""


def shift_text(shift: float, sd: float) -> str:
    """Say how the clocks lie."""
    return f"Time shift (second clock less first): {1e3 * shift + 0.0:.1f} ms{_spread(1e3 * sd, ' ms')}."


def offset_text(result: MotionComparison) -> list[str]:
    """Say how the laboratories lie."""
    alignment = result.alignment
    if not (result.first.point_names or result.first.segment_names):
        return []
    turn = np.degrees(np.linalg.norm(alignment.first_from_second.rotation_vector))
    text = f"Laboratories: the second is turned by {turn:.2f} degrees{_spread(_deg(alignment.turn_sd), ' degrees')}"
    if not result.first.point_names:
        return [f"{text}."]
    place = ", ".join(f"{v:.1f}" for v in np.round(1e3 * alignment.first_from_second.translation, 1) + 0.0)
    return [
        f"{text}, moved by ({place}) mm{_spread(_mm(alignment.translation_sd), ' mm')} in the first.",
        f"Points in common lie {1e3 * alignment.residual_m:.1f} mm apart (RMS).",
    ]


def _deg(sd: Floats) -> float:
    return float(np.degrees(np.max(sd)))


def _mm(sd: Floats) -> float:
    return float(1e3 * np.max(sd))


def _spread(sd: float, unit: str) -> str:
    return f" (sd {sd:.2g}{unit})" if np.isfinite(sd) else ""

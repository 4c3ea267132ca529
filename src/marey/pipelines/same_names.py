"""The same names for the same quantities of two motions: those of a file, equal ones, and those known of programs."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from marey.errors import FileProblem
from marey.io.documents import read_tables
from marey.motion.names import hinge_sign, known_angle, known_point, known_segment, rename_columns
from marey.motion.recording import Recording

_TABLES = ("angles", "points", "segments")
"""Tables of a file of names."""


def read_name_map(path: Path) -> Mapping[str, Mapping[str, str]]:
    """Read a TOML file with the names of the same quantities in both motions.

    Its tables are `[angles]`, `[points]` and `[segments]`, with entries such as `knee_angle_r = "right_knee_flexion"`.

    Args:
        path: The file.

    Returns:
        By table, the name in the first motion and that in the second one.

    Raises:
        FileProblem: It is not a TOML file, or has another table.
    """
    tables = read_tables(path, "Correct the file.")
    known = f'It may have {", ".join(f"[{name}]" for name in _TABLES)} with "name in A" = "name in B".'
    unknown = sorted(set(tables) - set(_TABLES))
    if unknown:
        raise FileProblem(path, f"has the unknown key '{unknown[0]}'", known)
    for name, table in tables.items():
        if not isinstance(table, dict) or not all(isinstance(value, str) for value in table.values()):
            raise FileProblem(path, f"has a value in [{name}] that is not a name", known)
    return tables


def same_names(
    first: Recording, second: Recording, chosen: Mapping[str, Mapping[str, str]], path: Path | None = None
) -> tuple[Recording, Recording]:
    """Give both recordings the same names for the same quantities.

    Names that the user gave have priority over equal names, and those over the known names of OpenSim's models,
    Plug-in Gait and others.

    Args:
        first: A motion.
        second: Another one; quantities that the user gave get their names in the first motion.
        chosen: For each kind, names in the first motion to names in the second; `-name` inverts the sign.
        path: The file with these names.

    Returns:
        Both motions with the new names.

    Raises:
        FileProblem: A given name is missing from its motion.
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
    """Rename quantities that are known by another name, unless both recordings use that name."""
    old = getattr(recording, field)
    wanted = [(name, 1.0) if name in common else _known(recording, field, k) for k, name in enumerate(old)]
    own_names = [own for own, _ in wanted]
    # Two names for one quantity, or a name that exists already: they are not merged.
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

"""Joint angles in C3D files: points of the list POINT:ANGLES, whose three components are angles of one joint."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import ezc3d
import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.io.markers.c3d import point_labels

_WORD = re.compile(r"(?P<joint>.+?)_(?P<word>axial_rotation|ulnar_deviation|[a-z]+)")
"""Name of an angle: the joint and the word for the motion."""
_END, _SPREAD = "_angles", "_angles_sd"
"""Ends of the labels of angles and of their standard deviations."""

_MOST_TEXTS = 255
"""Largest number of texts in a parameter of a C3D, by the format."""


@dataclass(frozen=True, eq=False, kw_only=True)
class AnglePoint:
    """Up to three angles of a joint, as one point of a C3D."""

    label: str
    description: str
    """The words of the components: `x flexion, y adduction, z rotation`."""
    values: Floats
    """(F, 3) [degrees]; NaN where missing, 0 in components that are not used."""

    def __post_init__(self) -> None:
        freeze_fields(self, "values")


def angle_points(names: Sequence[str], angles: Floats, angle_sds: Floats) -> list[AnglePoint]:
    """Combine the angles of each joint to points, each followed by the point of its standard deviations.

    Args:
        names: A names such as `left_knee_flexion`; those of one joint follow each other.
        angles: (F, A) [degrees]; NaN where missing.
        angle_sds: (F, A) standard deviations [degrees]; NaN where unknown.

    Returns:
        Two points for each joint. A second set of angles of a joint has the word of its first one in the label.
    """
    points: list[AnglePoint] = []
    used: set[str] = set()
    for joint, entries in _joints(names):
        first = entries[0][1]
        name = joint if joint not in used else f"{joint}_{first}"
        used.add(name)
        words = ", ".join(f"{axis} {word}" for axis, (_, word) in zip("xyz", entries, strict=False))
        columns = [index for index, _ in entries]
        points.append(AnglePoint(label=f"{name}{_END}", description=words, values=_three(angles[:, columns])))
        spread = f"standard deviations: {words}"
        points.append(AnglePoint(label=f"{name}{_SPREAD}", description=spread, values=_three(angle_sds[:, columns])))
    return points


def _joints(names: Sequence[str]) -> Iterable[tuple[str, list[tuple[int, str]]]]:
    """Yield each joint with the indices and words of its angles, three at most."""
    joint, entries = "", list[tuple[int, str]]()
    for index, name in enumerate(names):
        match = _WORD.fullmatch(name)
        own, word = (match["joint"], match["word"]) if match else (name, "angle")
        if entries and (own != joint or len(entries) == 3):
            yield joint, entries
            entries = []
        joint = own
        entries.append((index, word))
    if entries:
        yield joint, entries


def _three(values: Floats) -> Floats:
    """Return columns (F, K) as three, the others 0."""
    return np.pad(values, ((0, 0), (0, 3 - values.shape[1])))


def add_angles(c3d: ezc3d.c3d, points: Sequence[AnglePoint]) -> None:
    """Add angles to a C3D as points that POINT:ANGLES lists, in degrees.

    A point with an unknown component is missing in that frame. Points of the same labels in the file are kept, and
    the new ones have a number.

    Args:
        c3d: The content of the file, with its points.
        points: The angles, with one row per frame of the file.
    """
    if not points:
        return
    labels, data = list(point_labels(c3d)), c3d["data"]
    labels += [f"*{n}" for n in range(len(labels), data["points"].shape[1])]
    own = _unused([point.label for point in points], labels)
    values = np.stack([point.values for point in points])
    missing = np.asarray(~np.isfinite(values).all(-1))
    added = np.ones((4, *missing.shape))
    added[:3] = np.moveaxis(np.where(missing[..., None], 0.0, values), -1, 0)
    descriptions = _texts(c3d, "DESCRIPTIONS", len(labels))
    data["points"] = np.concatenate([data["points"], added], 1)
    meta = data["meta_points"]
    meta["residuals"] = np.concatenate([meta["residuals"], np.where(missing, -1.0, 0.0)[None]], 1)
    masks = np.zeros((len(meta["camera_masks"]), *missing.shape), bool)
    meta["camera_masks"] = np.concatenate([meta["camera_masks"], masks], 1)
    listed = _texts(c3d, "ANGLES", 0)
    _set_texts(c3d, "LABELS", labels + own)
    _set_texts(c3d, "DESCRIPTIONS", descriptions + [point.description for point in points])
    _set_texts(c3d, "ANGLES", listed + own)
    if "ANGLE_UNITS" not in c3d["parameters"]["POINT"]:
        c3d.add_parameter("POINT", "ANGLE_UNITS", ["deg"])


def _unused(names: Sequence[str], there: Sequence[str]) -> list[str]:
    """Return the names, those that are in the file already with a number."""
    found = []
    for name in names:
        free, number = name, 2
        while free in there:
            free, number = f"{name}_{number}", number + 1
        found.append(free)
    return found


def _texts(c3d: ezc3d.c3d, key: str, count: int) -> list[str]:
    """Return the texts of a parameter, with those beyond the 255th, and with empty ones up to a number."""
    group = c3d["parameters"]["POINT"]
    found = [text for name in group if re.fullmatch(f"{key}[0-9]*", name) for text in (group[name]["value"] or [])]
    return [*found, *[""] * (count - len(found))]


def _set_texts(c3d: ezc3d.c3d, key: str, texts: Sequence[str]) -> None:
    """Set the texts of a parameter; those beyond the 255th are in KEY2, KEY3, ..., as the format counts by a byte."""
    group = c3d["parameters"]["POINT"]
    for name in [name for name in group if re.fullmatch(f"{key}[0-9]+", name)]:
        del group[name]
    for number, start in enumerate(range(0, len(texts), _MOST_TEXTS), 1):
        name = key if number == 1 else f"{key}{number}"
        c3d.add_parameter("POINT", name, list(texts[start : start + _MOST_TEXTS]))

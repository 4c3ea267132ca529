"""The markers' TOML, and the reference file that says where the bones were."""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from marey.arrays import Floats
from marey.errors import FileProblem
from marey.io.calibration.toml import read_tables
from marey.io.npz import read_arrays
from marey.markers.data.clusters import AnatomicalCalibration
from marey.markers.data.setup import MarkerJoint, MarkerSetup, SkinChoice

_KNOWN = (
    'Known are [segments] NAME = ["label", ...], [landmarks] NAME = "label" or ["label", ...], '
    "[joints.NAME] parent, child, degrees_of_freedom (1 to 6), [noise] mm, and [skin.SEGMENT] "
    'form (constant, time, turn, sinusoid, spline, file), period_s, pieces, file, still = ["label", ...].'
)
_ROTATION_TOLERANCE = 1e-3
Labels = Annotated[tuple[str, ...], Field(min_length=1)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _Joint(_Table):
    parent: str
    child: str
    degrees_of_freedom: Annotated[int, Field(ge=1, le=6)] | None = None


class _Noise(_Table):
    mm: Annotated[float, Field(gt=0, lt=100)]


class _Skin(_Table):
    form: Literal["constant", "time", "turn", "sinusoid", "spline", "file"]
    period_s: Annotated[float, Field(gt=0)] | None = None
    pieces: Annotated[int, Field(ge=1, le=100)] | None = None
    file: str | None = None
    still: tuple[str, ...] = ()


class _Setup(_Table):
    segments: dict[str, Labels] = {}
    landmarks: dict[str, str | Labels] = {}
    joints: dict[str, _Joint] = {}
    noise: _Noise | None = None
    skin: dict[str, _Skin] = {}


def read_marker_setup(path: Path | str) -> MarkerSetup:
    """Read the markers' TOML: `[segments]`, `[landmarks]`, `[joints]`, `[noise]`, `[skin]`; each may be missing.

    Args:
        path: The file.

    Raises:
        FileProblem: It is not TOML, has an unknown key, a value that cannot be used, or a joint of a segment that
            `[segments]` does not name; the message lists all of it and the known keys.
    """
    path = Path(path)
    try:
        said = _Setup.model_validate(read_tables(path))
    except ValidationError as error:
        raise FileProblem(path, _faults(error), _KNOWN) from error
    ends = {end for joint in said.joints.values() for end in (joint.parent, joint.child)}
    unknown = sorted(ends - set(said.segments)) if said.segments else []
    if unknown:
        there = f"[segments] has {', '.join(said.segments)}."
        raise FileProblem(path, f"has joints of the unknown segments {', '.join(unknown)}", there)
    return MarkerSetup(
        segments=said.segments,
        landmarks={name: (at,) if isinstance(at, str) else at for name, at in said.landmarks.items()},
        joints=tuple(MarkerJoint(name=name, **joint.model_dump()) for name, joint in said.joints.items()),
        noise_m=None if said.noise is None else said.noise.mm * 1e-3,
        skin={segment: _skin(path, segment, skin) for segment, skin in said.skin.items()},
    )


def _skin(path: Path, segment: str, said: _Skin) -> SkinChoice:
    """Make one segment's choice, with the functions of time that a file of its own holds, a row a frame."""
    asked = {"sinusoid": ("period_s",), "spline": ("pieces",), "file": ("file",)}.get(said.form, ())
    stray = [key for key in ("period_s", "pieces", "file") if getattr(said, key) is not None and key not in asked]
    if stray:
        raise FileProblem(path, f"has {', '.join(stray)} in [skin.{segment}], which form = '{said.form}' does not take")
    if said.form == "file" and said.file is None:
        raise FileProblem(path, f"has no file in [skin.{segment}]", "Name a CSV of a row a frame, a column a function.")
    functions = None if said.file is None else _functions(path.parent / said.file)
    return SkinChoice(form=said.form, period_s=said.period_s, pieces=said.pieces, functions=functions, still=said.still)


def _functions(path: Path) -> Floats:
    """Read numbers from a CSV without a head."""
    right = "Give a CSV of numbers alone: a row a frame, a column a function, no head."
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of an empty file, which is named below
            values = np.loadtxt(path, delimiter=",", ndmin=2)
    except OSError as error:
        raise FileProblem(path, "cannot be read", right) from error
    except ValueError as error:
        raise FileProblem(path, "is no table of numbers", right) from error
    if not values.size or not np.isfinite(values).all():
        raise FileProblem(path, "has values that are not finite, or none at all", right)
    return values


def _faults(error: ValidationError) -> str:
    """Say in one line what is wrong with the TOML."""
    clauses: dict[str, None] = {}
    for fault in error.errors():
        key = ".".join(str(part) for part in fault["loc"] if isinstance(part, str) and "[" not in part)
        if fault["type"] == "extra_forbidden":
            clauses[f"has the unknown key '{key}'"] = None
        else:
            clauses[f"has {key} = {fault['input']!r}, which cannot be used ({fault['msg'].lower()})"] = None
    return "; ".join(clauses)


def read_reference(
    path: Path | str, segments: tuple[str, ...], *, frames: int
) -> tuple[AnatomicalCalibration, tuple[str, ...]]:
    """Read where the bones were in one frame of the trial, or in several.

    Args:
        path: NPZ with `frame`, counted from 0, and for each segment NAME_rotation (3, 3), laboratory from bone, and
            NAME_origin (3,) in millimetres; or with K postures (K,), (K, 3, 3), (K, 3).
        segments: Those that have markers.
        frames: How many frames the trial has.

    Returns:
        The calibration of the segments that have both, in the order of `segments`, and what was passed over, a
        plain sentence each.

    Raises:
        FileProblem: A key is missing or has another shape, a frame lies outside of the trial, a matrix is no rotation,
            or no segment has markers.
    """
    path = Path(path)
    arrays = read_arrays(path, ("frame",))
    named = sorted(key.removesuffix("_rotation") for key in arrays if key.endswith("_rotation"))
    kept = tuple(name for name in segments if name in named)
    notes = [f"{path.name} has {name}, which has no markers in the trial; passed over." for name in named]
    notes = [note for note, name in zip(notes, named, strict=True) if name not in segments]
    notes += [f"{path.name} does not say where {x} was; passed over." for x in segments if x not in named]
    if not kept:
        have = f"It has {', '.join(named) or 'none'}; the markers ride on {', '.join(segments) or 'none'}."
        raise FileProblem(path, "has no segment that the trial's markers ride on", have)
    at = _frames(path, np.atleast_1d(arrays["frame"]), frames)
    rotation, origin = (
        np.stack([_rows(path, arrays, f"{name}_{what}", len(at), shape) for name in kept], 1)
        for what, shape in (("rotation", (3, 3)), ("origin", (3,)))
    )
    _require_rotations(path, kept, rotation)
    return AnatomicalCalibration(segments=kept, frames=at, rotation=rotation, origin=origin * 1e-3), tuple(notes)


def _frames(path: Path, at: np.ndarray, frames: int) -> np.ndarray:
    """Check the frames of a reference."""
    if at.ndim != 1 or not np.issubdtype(at.dtype, np.number) or not np.all(at == np.round(at)):
        raise FileProblem(path, "has a frame that is no whole number", "Give frame, or K of them, counted from 0.")
    outside = [int(f) for f in at if not 0 <= f < frames]
    if outside:
        raise FileProblem(path, f"has the frame {outside[0]}", f"The trial has the frames 0 to {frames - 1}.")
    twice = sorted({int(f) for f in at if (at == f).sum() > 1})
    if twice:
        raise FileProblem(path, f"has the frame {twice[0]} twice", "Give each posture once.")
    return np.asarray(at, np.int64)


def _rows(path: Path, arrays: Mapping[str, np.ndarray], key: str, count: int, shape: tuple[int, ...]) -> Floats:
    """Give one array of a reference, a row a posture."""
    if key not in arrays:
        raise FileProblem(path, f"lacks {key}", "Each segment has NAME_rotation and NAME_origin.")
    values = np.asarray(arrays[key], float)
    if values.shape == shape and count == 1:
        return values[None]
    if values.shape != (count, *shape):
        right = f"{shape}" if count == 1 else f"{(count, *shape)}"
        raise FileProblem(path, f"has {key} of the shape {values.shape}", f"For {count} frames it should be {right}.")
    return values


def _require_rotations(path: Path, names: tuple[str, ...], rotation: Floats) -> None:
    """Check that matrices (K, S, 3, 3) are rotations."""
    off = np.abs(rotation @ np.swapaxes(rotation, -1, -2) - np.eye(3)).max((-1, -2))
    good = (off <= _ROTATION_TOLERANCE) & (np.linalg.det(np.nan_to_num(rotation)) > 0)
    if not good.all():
        k, s = np.argwhere(~good)[0]
        wrong = f"has a {names[s]}_rotation that is no rotation (posture {k})"
        raise FileProblem(path, wrong, "Its columns are the bone's axes in the laboratory: unit, at right angles.")

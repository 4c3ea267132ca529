"""Reading the settings file of the markers, and the reference file with known poses of the bones."""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from marey.arrays import Floats
from marey.errors import FileProblem, SettingProblem
from marey.io.documents import Number, WholeNumber, read_tables
from marey.io.file_names import require_plain_names
from marey.io.npz import read_arrays
from marey.markers.data.clusters import AnatomicalCalibration
from marey.markers.data.person import DIAMETERS, LENGTHS, PersonMeasurements
from marey.markers.data.setup import MarkerJoint, MarkerSetup, Pointer, SkinChoice
from marey.wording import listed

_KNOWN = (
    'The known keys are [segments] NAME = ["label", ...], [landmarks] NAME = "label" or ["label", ...], '
    "[joints.NAME] parent, child, degrees_of_freedom (1 to 6), [noise] mm, [skin.SEGMENT] "
    'form (constant, time, rotation, sinusoid, spline, file), period_s, pieces, file, still = ["label", ...], and '
    "[person] marker_diameter_mm, leg_length_mm, knee_width_mm, ankle_width_mm, each of the last three also with "
    'left_ or right_, [pointer] markers = ["label", ...], tip_mm or pivot = "FILE", and [pointer.trials] '
    'LANDMARK = "FILE".'
)
"""Remedy for a settings file with an unknown key or an invalid value."""
_MEASURED = (
    "It should be leg_length_mm, knee_width_mm, ankle_width_mm, each also with left_ or right_, and "
    "marker_diameter_mm, in millimetres, such as knee_width_mm=99,ankle_width_mm=65."
)
"""Remedy for wrong measurements of a person in the settings."""
_ROTATION_TOLERANCE = 1e-3
"""Largest deviation of an element of R R^T from the identity, for a matrix R to be accepted as a rotation; by hand."""
Labels = Annotated[tuple[str, ...], Field(min_length=1)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _Joint(_Table):
    parent: str
    child: str
    degrees_of_freedom: Annotated[WholeNumber, Field(ge=1, le=6)] | None = None


class _Noise(_Table):
    mm: Annotated[Number, Field(gt=0, lt=100)]


class _Skin(_Table):
    form: Literal["constant", "time", "rotation", "sinusoid", "spline", "file"]
    period_s: Annotated[Number, Field(gt=0)] | None = None
    pieces: Annotated[WholeNumber, Field(ge=1, le=100)] | None = None
    file: str | None = None
    still: tuple[str, ...] = ()


_Leg = Annotated[Number, Field(ge=1e3 * LENGTHS["leg_length"][0], le=1e3 * LENGTHS["leg_length"][1])] | None
_Knee = Annotated[Number, Field(ge=1e3 * LENGTHS["knee_width"][0], le=1e3 * LENGTHS["knee_width"][1])] | None
_Ankle = Annotated[Number, Field(ge=1e3 * LENGTHS["ankle_width"][0], le=1e3 * LENGTHS["ankle_width"][1])] | None


class _Person(_Table):
    leg_length_mm: _Leg = None
    left_leg_length_mm: _Leg = None
    right_leg_length_mm: _Leg = None
    knee_width_mm: _Knee = None
    left_knee_width_mm: _Knee = None
    right_knee_width_mm: _Knee = None
    ankle_width_mm: _Ankle = None
    left_ankle_width_mm: _Ankle = None
    right_ankle_width_mm: _Ankle = None
    marker_diameter_mm: Annotated[Number, Field(ge=1e3 * DIAMETERS[0], le=1e3 * DIAMETERS[1])] | None = None

    def measurements(self) -> PersonMeasurements:
        """Return the values in metres; those of one side replace those of both."""
        given = {key.removesuffix("_mm"): value * 1e-3 for key, value in vars(self).items() if value is not None}
        both = [what for what in LENGTHS if what in given]
        lengths = {f"{side}_{what}": given[what] for side in ("left", "right") for what in both}
        lengths |= {key: value for key, value in given.items() if key.startswith(("left_", "right_"))}
        return PersonMeasurements(lengths=lengths, diameter_m=given.get("marker_diameter"))


class _Pointer(_Table):
    markers: Annotated[tuple[str, ...], Field(min_length=2)]
    tip_mm: Annotated[Number, Field(ge=0, lt=1000)] | None = None
    pivot: str | None = None
    trials: Annotated[dict[str, str], Field(min_length=1)]

    def pointer(self, folder: Path) -> Pointer:
        """Return the pointer with the paths of its trials."""
        return Pointer(
            markers=self.markers, tip_m=None if self.tip_mm is None else self.tip_mm * 1e-3,
            pivot=None if self.pivot is None else folder / self.pivot,
            trials={name: folder / path for name, path in self.trials.items()},
        )  # fmt: skip


class _Setup(_Table):
    segments: dict[str, Labels] = {}
    landmarks: dict[str, str | Labels] = {}
    joints: dict[str, _Joint] = {}
    noise: _Noise | None = None
    skin: dict[str, _Skin] = {}
    person: _Person = _Person()
    pointer: _Pointer | None = None


def read_marker_setup(path: Path | str) -> MarkerSetup:
    """Read the settings file.

    Its tables are `[segments]`, `[landmarks]`, `[joints]`, `[noise]`, `[skin]`, `[person]` and `[pointer]`.

    Args:
        path: The TOML file.

    Returns:
        The settings.

    Raises:
        FileProblem: The file is not TOML, has an unknown key, an invalid value, or a joint of a segment that is missing
            from `[segments]`; the message lists all problems and the known keys.
    """
    path = Path(path)
    try:
        tables = _Setup.model_validate(read_tables(path))
    except ValidationError as error:
        raise FileProblem(path, _faults(error), _KNOWN) from error
    for kind, names in (("segment", tables.segments), ("landmark", tables.landmarks), ("joint", tables.joints)):
        require_plain_names(path, names, kind=kind)
    ends = {end for joint in tables.joints.values() for end in (joint.parent, joint.child)}
    unknown = sorted(ends - set(tables.segments)) if tables.segments else []
    if unknown:
        remedy = f"[segments] has {', '.join(tables.segments)}."
        raise FileProblem(path, f"has joints of the unknown segments {', '.join(unknown)}", remedy)
    if tables.pointer is not None and (tables.pointer.tip_mm is None) == (tables.pointer.pivot is None):
        wrong = f"has [pointer] with {'neither' if tables.pointer.pivot is None else 'both'} tip_mm and pivot"
        raise FileProblem(path, wrong.replace("neither tip_mm and", "neither tip_mm nor"), "Give one of them.")
    return MarkerSetup(
        segments=tables.segments,
        landmarks={name: (at,) if isinstance(at, str) else at for name, at in tables.landmarks.items()},
        joints=tuple(MarkerJoint(name=name, **joint.model_dump()) for name, joint in tables.joints.items()),
        noise_m=None if tables.noise is None else tables.noise.mm * 1e-3,
        skin={segment: _skin_choice(path, segment, skin) for segment, skin in tables.skin.items()},
        person=tables.person.measurements(),
        pointer=None if tables.pointer is None else tables.pointer.pointer(path.parent),
    )


def given_measurements(values: Mapping[str, float]) -> PersonMeasurements:
    """Return the measurements of a person that settings give by the keys of `[person]`.

    Args:
        values: Maps `knee_width_mm`, `left_leg_length_mm`, ... to a value [mm].

    Raises:
        SettingProblem: A key is unknown, or a value is impossible.
    """
    try:
        return _Person.model_validate(dict(values)).measurements()
    except ValidationError as error:
        raise SettingProblem(f"measurements (--measurements) {_faults(error)}. {_MEASURED}") from error


def _skin_choice(path: Path, segment: str, skin: _Skin) -> SkinChoice:
    """Return the choice for one segment, with the functions of time from the named file."""
    allowed = {"sinusoid": ("period_s",), "spline": ("pieces",), "file": ("file",)}.get(skin.form, ())
    stray = [key for key in ("period_s", "pieces", "file") if getattr(skin, key) is not None and key not in allowed]
    if stray:
        wrong = f"has {', '.join(stray)} in [skin.{segment}], which does not apply to form = '{skin.form}'"
        raise FileProblem(path, wrong, "Remove the key, or choose the form to which it applies.")
    if skin.form == "file" and skin.file is None:
        remedy = "Name a CSV with one row per frame and one column per function."
        raise FileProblem(path, f"has no `file` in [skin.{segment}]", remedy)
    functions = None if skin.file is None else _read_functions(path.parent / skin.file)
    return SkinChoice(form=skin.form, period_s=skin.period_s, pieces=skin.pieces, functions=functions, still=skin.still)


def _read_functions(path: Path) -> Floats:
    """Read numbers from a CSV without a header line."""
    remedy = "Give a CSV of numbers with one row per frame and one column per function, without a header line."
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # about an empty file, which is an error below
            values = np.loadtxt(path, delimiter=",", ndmin=2)
    except OSError as error:
        raise FileProblem(path, "cannot be read", remedy) from error
    except ValueError as error:
        raise FileProblem(path, "is not a table of numbers", remedy) from error
    if not values.size or not np.isfinite(values).all():
        raise FileProblem(path, "is empty, or has values that are not finite", remedy)
    return values


def _faults(error: ValidationError) -> str:
    """Describe in one line what is wrong with the settings file."""
    clauses: dict[str, None] = {}
    for fault in error.errors():
        key = ".".join(str(part) for part in fault["loc"] if isinstance(part, str) and "[" not in part)
        if fault["type"] == "extra_forbidden":
            clauses[f"has the unknown key '{key}'"] = None
        else:
            why = fault["msg"].lower().replace("input should", "it should")
            clauses[f"has {key} = {fault['input']!r}, which is invalid ({why})"] = None
    return "; ".join(clauses)


def read_reference(
    path: Path | str, segments: tuple[str, ...], *, frames: int
) -> tuple[AnatomicalCalibration, tuple[str, ...]]:
    """Read known poses of the bones in one or more frames of the trial.

    Args:
        path: NPZ with `frame`, counted from 0, and for each segment NAME_rotation (3, 3), laboratory from bone, and
            NAME_origin (3,) in millimetres; or with K postures (K,), (K, 3, 3), (K, 3).
        segments: The segments that have markers.
        frames: Number of frames of the trial.

    Returns:
        The calibration of the segments that have markers and poses, in the order of `segments`, and one sentence for
        each segment that is skipped.

    Raises:
        FileProblem: A key is missing or has the wrong shape, a frame lies outside of the trial, a matrix is not a
            rotation, or no segment has markers.
    """
    path = Path(path)
    arrays = read_arrays(path, ("frame",))
    named = sorted(key.removesuffix("_rotation") for key in arrays if key.endswith("_rotation"))
    kept = tuple(name for name in segments if name in named)
    notes = [
        f"{path.name} has the segment {name}, which has no markers in the trial and is skipped."
        for name in named if name not in segments
    ]  # fmt: skip
    notes += [
        f"{path.name} has no pose of the segment {name}, which is skipped." for name in segments if name not in named
    ]
    if not kept:
        has = f"It has {listed(named, none='no segment')}; the trial has markers on {listed(segments)}."
        raise FileProblem(path, "has no segment on which the trial has markers", has)
    at = _frames(path, np.atleast_1d(arrays["frame"]), frames)
    rotation, origin = (
        np.stack([_rows(path, arrays, f"{name}_{what}", len(at), shape) for name in kept], 1)
        for what, shape in (("rotation", (3, 3)), ("origin", (3,)))
    )
    _require_rotations(path, kept, rotation)
    lost = [name for k, name in enumerate(kept) if not np.isfinite(origin[:, k]).all()]
    if lost:
        raise FileProblem(path, f"has a {lost[0]}_origin that is not finite", "Leave out segments that are not known.")
    return AnatomicalCalibration(segments=kept, frames=at, rotation=rotation, origin=origin * 1e-3), tuple(notes)


def _frames(path: Path, at: np.ndarray, frames: int) -> np.ndarray:
    """Check the frames of a reference."""
    if at.ndim != 1 or at.dtype.kind not in "fiu" or not np.all(at == np.round(at)):
        raise FileProblem(path, "has a `frame` that is not an integer", "Give one or K frames, counted from 0.")
    outside = [int(f) for f in at if not 0 <= f < frames]
    if outside:
        raise FileProblem(path, f"has the frame {outside[0]}", f"The trial has the frames 0 to {frames - 1}.")
    twice = sorted({int(f) for f in at if (at == f).sum() > 1})
    if twice:
        raise FileProblem(path, f"has the frame {twice[0]} twice", "Give each posture once.")
    return np.asarray(at, np.int64)


def _rows(path: Path, arrays: Mapping[str, np.ndarray], key: str, count: int, shape: tuple[int, ...]) -> Floats:
    """Return one array of a reference, with one row per posture."""
    if key not in arrays:
        raise FileProblem(path, f"lacks {key}", "Each segment has NAME_rotation and NAME_origin.")
    values = np.asarray(arrays[key])
    if values.dtype.kind not in "fiu":
        raise FileProblem(path, f"has {key} of the type {values.dtype}", "It should hold numbers.")
    values = values.astype(float)
    if values.shape == shape and count == 1:
        return values[None]
    if values.shape != (count, *shape):
        right = f"{shape}" if count == 1 else f"{(count, *shape)}"
        raise FileProblem(path, f"has {key} of shape {values.shape}", f"For {count} frames it should be {right}.")
    return values


def _require_rotations(path: Path, names: tuple[str, ...], rotation: Floats) -> None:
    """Check that matrices (K, S, 3, 3) are rotations."""
    off = np.abs(rotation @ np.swapaxes(rotation, -1, -2) - np.eye(3)).max((-1, -2))
    good = (off <= _ROTATION_TOLERANCE) & (np.linalg.det(np.nan_to_num(rotation)) > 0)
    if not good.all():
        k, s = np.argwhere(~good)[0]
        wrong = f"has a {names[s]}_rotation that is not a rotation (posture {k})"
        remedy = "Its columns should be the axes of the bone in the laboratory: orthogonal unit vectors."
        raise FileProblem(path, wrong, remedy)

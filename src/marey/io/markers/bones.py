"""Reading and writing `bones.npz`: the poses of bones with their covariances."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from marey.arrays import Floats, Integers, freeze_fields
from marey.errors import FileProblem
from marey.io.npz import consistent_arrays, read_arrays, write_arrays
from marey.io.units import MM_PER_M
from marey.markers.data.bone_motion import BoneMotion

RUN_AGAIN = "Run `marey markers` again."
"""Remedy for a result file that is missing, damaged or inconsistent."""
_OF_A_BONE = ("rotation", "origin", "covariance", "rotation_sd", "origin_sd")
"""Arrays of one bone, after its name."""
_IN_MM, _IN_M = (np.diag([1.0] * 3 + [unit] * 3) for unit in (MM_PER_M, 1 / MM_PER_M))
"""Scale of a pose error (rotation [rad], translation), from metres to millimetres and back."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BoneFile:
    """Content of a file of bones."""

    motion: BoneMotion
    time: Floats
    """(F,) [s]."""
    side: str | None = None
    """`left` or `right`, if the file states it and the names of the segments do not."""
    reference_frames: Integers | None = None
    """(K,) frames of the reference postures, in which the bones were known; None if the file does not state them."""

    def __post_init__(self) -> None:
        freeze_fields(self, "time")
        freeze_fields(self, "reference_frames", dtype=np.int64)


def write_bones(path: Path | str, bones: BoneFile) -> None:
    """Write NAME_rotation, NAME_origin, their standard deviations and NAME_covariance in millimetres, by frame.

    The file also contains `time` [s], `rate` [Hz], `segments` and, if known, `side` and `reference_frames`.

    Args:
        path: The file.
        bones: The poses to write.
    """
    motion, time = bones.motion, bones.time
    arrays: dict[str, object] = {"segments": np.array(motion.segments, np.str_), "time": time}
    if len(time) > 1:
        arrays["rate"] = 1 / float(np.median(np.diff(time)))
    if bones.side is not None:
        arrays["side"] = bones.side
    if bones.reference_frames is not None:
        arrays["reference_frames"] = bones.reference_frames
    for s, name in enumerate(motion.segments):
        arrays[f"{name}_rotation"] = motion.rotation[:, s]
        arrays[f"{name}_origin"] = motion.origin[:, s] * MM_PER_M
        arrays[f"{name}_rotation_sd"] = motion.rotation_sd[:, s]
        arrays[f"{name}_origin_sd"] = motion.origin_sd[:, s] * MM_PER_M
        # The covariance of rotation and translation matters far from the origin, for example at the knee of a thigh.
        arrays[f"{name}_covariance"] = _IN_MM @ motion.covariance[:, s] @ _IN_MM
    write_arrays(path, arrays)


def read_bones(path: Path | str) -> BoneFile:
    """Read `bones.npz`, or a file of true bone poses with the same keys.

    If the file has standard deviations but no covariance, the errors of a bone are taken as independent.

    Args:
        path: The file.

    Returns:
        The poses in metres.

    Raises:
        FileProblem: The file has no bones, inconsistent arrays, or neither time nor rate.
    """
    arrays = read_arrays(path)
    with consistent_arrays(path, "Give a bones.npz as `marey markers` writes it."):
        return _bones(path, arrays)


def _bones(path: Path | str, arrays: dict[str, np.ndarray]) -> BoneFile:
    names = [key.removesuffix("_rotation") for key in arrays if key.endswith("_rotation")]
    if not names:
        raise FileProblem(path, "has no array NAME_rotation", "Give a motion.npz or a bones.npz.")
    used = [f"{name}_{what}" for name in names for what in _OF_A_BONE]
    texts = [key for key in used if key in arrays and arrays[key].dtype.kind not in "fiu"]
    if texts:
        raise FileProblem(path, f"has an array {texts[0]} that holds no numbers", "Write it again.")
    frames = len(np.atleast_1d(arrays[f"{names[0]}_rotation"]))
    shapes = {"rotation": (frames, 3, 3), "origin": (frames, 3)}
    for name in names:
        for what, shape in shapes.items():
            found = np.shape(arrays.get(f"{name}_{what}", np.nan))
            if found != shape:
                raise FileProblem(path, f"has {name}_{what} of shape {found}", f"Its shape should be {shape}.")
    covariance = np.stack([_covariance(arrays, name, frames) for name in names], 1)
    motion = BoneMotion(
        segments=tuple(names), rotation=np.stack([arrays[f"{n}_rotation"] for n in names], 1),
        origin=np.stack([arrays[f"{n}_origin"] for n in names], 1) / MM_PER_M, covariance=covariance,
    )  # fmt: skip
    return BoneFile(
        motion=motion, time=_time(path, arrays, frames), side=_side(arrays),
        reference_frames=_reference_frames(path, arrays, frames),
    )  # fmt: skip


def _covariance(arrays: dict[str, np.ndarray], name: str, frames: int) -> Floats:
    whole = arrays.get(f"{name}_covariance")
    if whole is not None and whole.shape == (frames, 6, 6):
        return np.asarray(_IN_M @ whole @ _IN_M)
    unknown = np.full((frames, 3), np.nan)
    turn, place = arrays.get(f"{name}_rotation_sd", unknown), arrays.get(f"{name}_origin_sd", unknown) / MM_PER_M
    return np.concatenate([turn, place], 1)[:, :, None] ** 2 * np.eye(6)


def _time(path: Path | str, arrays: dict[str, np.ndarray], frames: int) -> Floats:
    if np.shape(arrays.get("time", np.nan)) == (frames,):
        return np.asarray(arrays["time"], float)
    rate = arrays.get("rate")
    if rate is None or np.size(rate) != 1 or not float(rate) > 0:
        raise FileProblem(path, "contains neither `time` nor `rate`", "Add `rate` in hertz, or `time` in seconds.")
    return np.arange(frames) / float(rate)


def _reference_frames(path: Path | str, arrays: dict[str, np.ndarray], frames: int) -> Integers | None:
    """Return the frames of the reference postures, or None if the file does not state them.

    Raises:
        FileProblem: A frame lies outside of the file's frames.
    """
    if "reference_frames" not in arrays:
        return None
    known = np.atleast_1d(np.asarray(arrays["reference_frames"], np.int64))
    if not len(known) or known.min() < 0 or known.max() >= frames:
        wrong = f"has no `reference_frames`, or some outside of its {frames} frames"
        raise FileProblem(path, wrong, RUN_AGAIN)
    return known


def _side(arrays: dict[str, np.ndarray]) -> str | None:
    side = str(arrays.get("side", ""))
    return side if side in ("left", "right") else None

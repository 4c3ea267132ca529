"""The folder that `marey markers` leaves, as the knee needs it: bones, markers, and the reference posture."""

import csv
import json
from pathlib import Path

from marey.errors import FileProblem
from marey.io.markers.bones import BoneFile, read_bones
from marey.io.markers.readers import read_markers
from marey.io.markers.results import is_y_up
from marey.knee.markers.reference_posture import Activity

_RUN_AGAIN = "Run `marey markers` again."


def read_activity(folder: Path | str, *, method: str | None = None) -> Activity:
    """Read the results of `marey markers`.

    Args:
        folder: With `bones.npz`, `motion.c3d` and `marker_motion.csv`.
        method: Whose bones: of several that were run at once; None: the first one's.

    Raises:
        FileProblem: A file is missing or does not fit the others, or the method was not run.
    """
    folder = Path(folder)
    if not (folder / "bones.npz").is_file():
        raise FileProblem(folder, "has no bones.npz", "Give a folder that `marey markers` left.")
    methods = _methods(folder)
    path = folder / "bones.npz" if method in (None, *methods[:1]) else folder / f"bones_{method}.npz"
    if not path.is_file():
        remedy = f"It has {', '.join(methods) or 'one method'}. Run `marey markers` with --method {method}, too."
        raise FileProblem(folder, f"has no bones of the method {method}", remedy)
    bones = read_bones(path)
    markers = read_markers(folder / "motion.c3d")
    if len(markers) != len(bones.motion):
        wrong = f"has {len(markers)} frames of markers and {len(bones.motion)} of bones"
        raise FileProblem(folder, wrong, _RUN_AGAIN)
    rigid = _cluster(folder, methods, bones)
    return Activity(
        motion=bones.motion, cluster=None if rigid is None else rigid.motion, markers=markers,
        segment_of_label=_segments(folder / "marker_motion.csv"), reference_frames=bones.reference_frames,
        time=bones.time, side=bones.side,
    )  # fmt: skip


def first_method(folder: Path | str) -> str:
    """Give the method whose bones stand in `bones.npz`; the folder's name where it has no record of it."""
    folder = Path(folder)
    return next(iter(_methods(folder)), folder.resolve().name)


def room_is_y_up(folder: Path | str) -> bool:
    """Tell whether the laboratory has Y up: the trial was a TRC, or its C3D says so."""
    folder = Path(folder)
    inputs = _recorded(folder, "inputs")
    if isinstance(inputs, dict) and any(str(name).lower().endswith(".trc") for name in list(inputs)[:1]):
        return True
    return is_y_up(folder / "motion.c3d")


def _recorded(folder: Path, key: str) -> object:
    """Give what the record of a run says; None where there is none."""
    try:
        return json.loads((folder / "run.json").read_text(encoding="utf-8"))[key]
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _methods(folder: Path) -> list[str]:
    """Give the methods of a run, that of `bones.npz` first; none where the folder has no record of it."""
    settings = _recorded(folder, "settings")
    said = settings.get("methods") if isinstance(settings, dict) else None
    return [str(method) for method in said] if isinstance(said, list) else []


def _cluster(folder: Path, methods: list[str], bones: BoneFile) -> BoneFile | None:
    """Give the bones as rigid clusters move them, where that method was run, too."""
    path = folder / ("bones.npz" if methods[:1] == ["rigid"] else "bones_rigid.npz")
    if not path.is_file():
        return None
    rigid = read_bones(path)
    if rigid.motion.rotation.shape != bones.motion.rotation.shape or rigid.motion.segments != bones.motion.segments:
        return None
    return rigid


def _segments(path: Path) -> dict[str, str]:
    """Read which marker rides on which segment from the columns' names (`thigh:thigh_01_x_mm`)."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            head = next(csv.reader(file), [])
    except OSError as error:
        raise FileProblem(path, "cannot be read", _RUN_AGAIN) from error
    columns = [column.removesuffix("_x_mm").partition(":") for column in head if column.endswith("_x_mm")]
    return {label: segment for segment, _, label in columns}

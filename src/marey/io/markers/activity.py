"""Reading the result folder of `marey markers` for the knee: bones, markers, and the reference posture."""

from pathlib import Path

from marey.errors import FileProblem
from marey.io.documents import read_json_table, read_rows
from marey.io.markers.bones import RUN_AGAIN, BoneFile, read_bones
from marey.io.markers.readers import read_markers
from marey.io.markers.results import is_y_up
from marey.knee.markers.reference_posture import Activity


def read_activity(folder: Path | str, *, method: str | None = None) -> Activity:
    """Read the results of `marey markers`.

    Args:
        folder: The folder with `bones.npz`, `motion.c3d` and `marker_motion.csv`.
        method: Method whose bones are read, if the run estimated bones with several; None for the first one.

    Returns:
        The motion of bones and markers.

    Raises:
        FileProblem: A file is missing or inconsistent with the others, or the method was not run.
    """
    folder = Path(folder)
    if not (folder / "bones.npz").is_file():
        raise FileProblem(folder, "has no bones.npz", "Give a result folder of `marey markers`.")
    methods = _methods(folder)
    path = folder / "bones.npz" if method in (None, *methods[:1]) else folder / f"bones_{method}.npz"
    if not path.is_file():
        available = f"It has results of {', '.join(methods)}. " if methods else "It has results of one method. "
        remedy = f"{available}Repeat `marey markers` with this method as well (--method {method})."
        raise FileProblem(folder, f"has no results of the method {method}", remedy)
    bones = read_bones(path)
    markers = read_markers(folder / "motion.c3d")
    if len(markers) != len(bones.motion):
        wrong = f"has {len(markers)} frames of markers but {len(bones.motion)} of bones"
        raise FileProblem(folder, wrong, RUN_AGAIN)
    rigid = _cluster(folder, methods, bones)
    return Activity(
        motion=bones.motion, cluster=None if rigid is None else rigid.motion, markers=markers,
        segment_of_label=_segments(folder / "marker_motion.csv"), reference_frames=bones.reference_frames,
        time=bones.time, side=bones.side,
    )  # fmt: skip


def first_method(folder: Path | str) -> str:
    """Return the method whose bones are in `bones.npz`, or the folder's name if the run record does not give it."""
    folder = Path(folder)
    return next(iter(_methods(folder)), folder.resolve().name)


def laboratory_is_y_up(folder: Path | str) -> bool:
    """Return whether Y points up in the laboratory: the trial was a TRC, or its C3D states it."""
    folder = Path(folder)
    inputs = _recorded(folder, "inputs")
    if isinstance(inputs, dict) and any(str(name).lower().endswith(".trc") for name in list(inputs)[:1]):
        return True
    return is_y_up(folder / "motion.c3d")


def _recorded(folder: Path, key: str) -> object:
    """Return an entry of the run record; None if it does not exist."""
    path = folder / "run.json"
    return read_json_table(path, RUN_AGAIN).get(key) if path.exists() else None


def _methods(folder: Path) -> list[str]:
    """Return the methods of a run, that of `bones.npz` first; empty if the folder has no record of them."""
    settings = _recorded(folder, "settings")
    methods = settings.get("methods") if isinstance(settings, dict) else None
    return [str(method) for method in methods] if isinstance(methods, list) else []


def _cluster(folder: Path, methods: list[str], bones: BoneFile) -> BoneFile | None:
    """Read the bones of the method `rigid`; None if it was not run or has other frames or segments."""
    path = folder / ("bones.npz" if methods[:1] == ["rigid"] else "bones_rigid.npz")
    if not path.is_file():
        return None
    rigid = read_bones(path)
    if rigid.motion.rotation.shape != bones.motion.rotation.shape or rigid.motion.segments != bones.motion.segments:
        return None
    return rigid


def _segments(path: Path) -> dict[str, str]:
    """Read the segment of each marker from the names of the columns (`thigh:thigh_01_x_mm`)."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            line = file.readline()
    except (OSError, UnicodeDecodeError) as error:
        raise FileProblem(path, f"cannot be read ({error})", RUN_AGAIN) from error
    head = (read_rows(path, [line], RUN_AGAIN) or [[]])[0]
    columns = [column.removesuffix("_x_mm").partition(":") for column in head if column.endswith("_x_mm")]
    return {label: segment for segment, _, label in columns}

"""Types of arguments that the public functions share, and Python warnings."""

import warnings
from collections.abc import Iterable
from pathlib import Path

from marey.errors import MareyWarning, SettingProblem
from marey.pipelines.progress import Progress

PathLike = str | Path
"""A file or folder, as text or as a path."""
Frames = range | tuple[int, int]
"""Successive frames: a range with steps of one, or the first frame and the frame after the last."""


def optional_path(path: PathLike | None) -> Path | None:
    """Return a path, or None."""
    return None if path is None else Path(path)


def path_tuple(paths: PathLike | Iterable[PathLike]) -> tuple[Path, ...]:
    """Return one path or several as a tuple."""
    return (Path(paths),) if isinstance(paths, str | Path) else tuple(Path(each) for each in paths)


def first_and_end(frames: Frames | None) -> tuple[int, int] | None:
    """Return the first frame and the one after the last.

    Raises:
        SettingProblem: The range has gaps, or holds no frame.
    """
    if frames is None:
        return None
    first, end = (frames.start, frames.stop) if isinstance(frames, range) else frames
    if (isinstance(frames, range) and frames.step != 1) or not 0 <= first < end:
        raise SettingProblem(f"The frames are {frames}; they should be consecutive, for example range(40, 100).")
    return first, end


def issue_warnings(progress: Progress, *, stacklevel: int = 3) -> None:
    """Issue the warnings of a run as Python warnings.

    Args:
        progress: Progress reporter of the run.
        stacklevel: Number of calls between this function and the code to which the warnings refer.
    """
    for text in progress.warnings:
        warnings.warn(text, MareyWarning, stacklevel=stacklevel)

"""Values that a caller in Python may give in more than one form."""

from collections.abc import Iterable
from pathlib import Path

from marey.errors import SettingProblem

PathLike = str | Path
"""A file or folder, as text or as a path."""
FrameRange = range | tuple[int, int]
"""Successive frames: a range, or the first frame and the frame after the last."""


def optional_path(path: PathLike | None) -> Path | None:
    """Return a path, or None."""
    return None if path is None else Path(path)


def path_tuple(paths: PathLike | Iterable[PathLike]) -> tuple[Path, ...]:
    """Return one path or several as a tuple."""
    return (Path(paths),) if isinstance(paths, str | Path) else tuple(Path(each) for each in paths)


def frame_limits(frames: FrameRange | None) -> tuple[int, int] | None:
    """Return the first frame and the frame after the last; None stands for all frames.

    Raises:
        SettingProblem: The frames are not successive, or there are none.
    """
    if isinstance(frames, range):
        if frames.step != 1 or not len(frames):
            raise SettingProblem(f"frames is {frames}; it should be successive frames, such as range(40, 100).")
        return frames.start, frames.stop
    return frames

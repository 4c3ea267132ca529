"""Reports of progress from the fit to its caller."""

from collections.abc import Callable

FrameProgress = Callable[[int], None]
"""Called with the number of each frame that is finished."""


def no_progress(frame: int) -> None:
    """Ignore the frame: the default where no progress is reported."""

"""Reading of the sound that a camera recorded with its video."""

from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np

from marey.arrays import Floats, freeze_fields

SOUND_RATE = 8000
"""Rate at which sound is read [Hz]; claps and voices have most of their energy below half of it."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Sound:
    """The sound of a video."""

    samples: Floats
    """(n,) mean of all channels, from -1 to 1, at `SOUND_RATE`."""
    begin_s: float
    """Time of the first sample after the first picture of the video [s]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "samples")


def read_sound(path: Path) -> Sound | None:
    """Read the sound of a video.

    Args:
        path: The video.

    Returns:
        The sound; None if the video has none, or none that can be decoded.
    """
    try:
        with av.open(str(path)) as container:
            if not container.streams.audio:
                return None
            return _decoded(container)
    except (av.FFmpegError, ValueError):
        return None


def _decoded(container: av.container.InputContainer) -> Sound | None:
    stream = container.streams.audio[0]
    resampler = av.AudioResampler(format="flt", layout="mono", rate=SOUND_RATE)
    begin, parts = None, []
    for frame in container.decode(stream):
        if begin is None:
            begin = float(frame.time or 0.0)
        parts += [each.to_ndarray()[0] for each in resampler.resample(frame)]
    parts += [each.to_ndarray()[0] for each in resampler.resample(None)]
    samples = np.concatenate([np.zeros(0, np.float32), *parts])
    if begin is None or not len(samples):
        return None
    return Sound(samples=samples, begin_s=begin - _begin_of_video(container))


def _begin_of_video(container: av.container.InputContainer) -> float:
    """Return the time of the first picture [s]."""
    if not container.streams.video:
        return 0.0
    video = container.streams.video[0]
    if video.start_time is None or video.time_base is None:
        return 0.0
    return float(video.start_time * video.time_base)

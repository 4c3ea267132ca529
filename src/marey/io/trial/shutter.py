"""The rolling shutters of a trial's cameras, from the settings of trial.toml."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from marey.cameras.shutter import RollingShutter, Side
from marey.errors import FileProblem
from marey.io.trial.settings import TrialSettings
from marey.io.video.take import Take
from marey.wording import listed

_Value = TypeVar("_Value", float, Side)


def shutter_of(path: Path, settings: TrialSettings, take: Take, known: Sequence[str]) -> RollingShutter | None:
    """Return how the cameras of a take expose their pictures.

    Args:
        path: The file of the settings, for the messages.
        settings: The settings.
        take: The clips of C cameras.
        known: All cameras of the calibration.

    Returns:
        The shutters; None if all of them are global.

    Raises:
        FileProblem: A camera is unknown, or a readout takes longer than a picture of its camera lasts.
    """
    for key, given in (("readout_s", settings.readout_s), ("readout_from", settings.readout_from)):
        unknown = [repr(name) for name in given if name not in known] if isinstance(given, Mapping) else []
        if unknown:
            wrong = f"has {key} of the unknown camera {', '.join(unknown)}"
            raise FileProblem(path, wrong, f"The cameras of the calibration are {', '.join(known)}.")
    readout = [_of_camera(settings.readout_s, name, 0.0) for name in take.names]
    if not any(readout):
        return None
    rates = [take.rate if clip.rate is None else clip.rate for clip in take.clips]
    slow = [name for name, time, rate in zip(take.names, readout, rates, strict=True) if time * rate > 1]
    if slow:
        wrong = f"has a readout_s of {listed(map(repr, slow))} above the time of one picture"
        raise FileProblem(path, wrong, "It is the time in seconds from the first row of a picture to the last one.")
    sides = tuple(_of_camera(settings.readout_from, name, "top") for name in take.names)
    return RollingShutter(readout_s=np.array(readout), sides=sides)


def _of_camera(given: _Value | Mapping[str, _Value] | None, name: str, default: _Value) -> _Value:
    if given is None:
        return default
    return given.get(name, default) if isinstance(given, Mapping) else given

"""Settings of a calibration."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from marey.calibration.adjustment.lens_choice import DISTORTION_NAMES, LENS_MODELS
from marey.errors import SettingProblem

DENSE_RATE = 15.0
"""Frame rate up to which all frames of a video are used [Hz]; chosen by hand."""
THINNED_RATE = 10.0
"""Pictures per second that are used of faster videos: a board that is carried moves on between them. By hand."""


@dataclass(frozen=True, kw_only=True)
class CalibrationOptions:
    """Settings of a calibration."""

    out: Path
    """Folder for the results."""
    floor: str = "auto"
    """Pictures in which the board lies on the floor: auto, first, last, none, a number, or A:B."""
    rate: float | None = None
    """Pictures per second that are used of each video; None for the default."""
    board: Path | None = None
    """Description of the board; by default board.json or board.toml in the folder."""
    points: Path | None = None
    """File of points with known coordinates."""
    distances: tuple[tuple[str, str, float], ...] = ()
    """Known distances between cameras: two names, and the distance [m]."""
    lenses: tuple[tuple[str, tuple[str, ...]], ...] = ()
    """Distortion coefficients that were given: name of a camera, or an empty one for all others, and coefficients."""
    threads: int = 2
    """Number of cameras whose pictures are searched at the same time."""

    def __post_init__(self) -> None:
        if self.floor not in ("auto", "first", "last", "none") and not _is_range(self.floor):
            raise SettingProblem(
                f"floor (--floor) is '{self.floor}'; it should be auto, first, last, none, the number of a picture, "
                "or A:B with A below B."
            )
        if self.rate is not None and not 0 < self.rate <= 1000:
            wanted = "it should be a positive number of pictures per second"
            raise SettingProblem(f"rate (--rate) is {self.rate:g}; {wanted}.")

    def floor_range(self) -> tuple[int, int] | None:
        """Return the first and the last number of the pictures of the floor; None where they are not numbered."""
        if not self.floor[0].isdigit():
            return None
        first, _, last = self.floor.partition(":")
        # As everywhere, the end of a range is not part of it.
        return int(first), int(last) - 1 if last else int(first)


def given_lens_models(given: str | Mapping[str, str] | None) -> tuple[tuple[str, tuple[str, ...]], ...]:
    """Parse distortion coefficients that are given for all cameras, or by name of the camera.

    Args:
        given: Coefficients separated by commas, such as `k1,k2`, or `none`; of all cameras, or by name, where an empty
            name stands for all others.

    Returns:
        Pairs of a name and its coefficients in the order of their columns.

    Raises:
        SettingProblem: They are no model that can be estimated.
    """
    return tuple(
        (name, _lens_model(text)) for name, text in ({"": given} if isinstance(given, str) else given or {}).items()
    )


def _lens_model(text: str) -> tuple[str, ...]:
    parts = {part.strip() for part in text.split(",")}
    model = tuple(name for name in DISTORTION_NAMES if name in parts)
    if model not in LENS_MODELS or parts != (set(model) or {"none"}):
        raise SettingProblem(
            f"lens (--lens) is '{text}'; it should be none, k1, k1,k2 or k1,k2,k3, each also with p1,p2 as in "
            "k1,k2,p1,p2."
        )
    return model


def _is_range(text: str) -> bool:
    """Return whether a text is a number, or two numbers A:B of which the second one is larger."""
    match = re.fullmatch(r"(\d{1,9})(?::(\d{1,9}))?", text)
    return match is not None and (match[2] is None or int(match[1]) < int(match[2]))

"""Rolling shutters: cameras that expose the rows of a picture one after the other."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from marey.arrays import Floats, freeze_fields

Side = Literal["top", "bottom", "left", "right"]
"""A side of the picture."""


def row_shares(side: Side, pixels: Floats, size: tuple[int, int]) -> Floats:
    """Return when pixels are exposed, as a share of the time from the first row to the last one.

    Args:
        side: The side of the picture that is exposed first.
        pixels: (..., 2) [px].
        size: Width and height of the picture [px].

    Returns:
        (...) from -1/2 at that side to 1/2 at the opposite one; more than that beyond the picture.
    """
    axis = 1 if side in ("top", "bottom") else 0
    share = pixels[..., axis] / max(size[axis] - 1, 1) - 0.5
    return np.asarray(share if side in ("top", "left") else -share)


@dataclass(frozen=True, eq=False, kw_only=True)
class RollingShutter:
    """How each camera of a rig exposes its pictures; the instant of a picture is that of its middle row."""

    readout_s: Floats
    """(C,) time from the first row of a picture to the last one [s]; 0 for a global shutter."""
    sides: tuple[Side, ...]
    """The side of each camera's picture that is exposed first."""

    def __post_init__(self) -> None:
        freeze_fields(self, "readout_s")

    def delays(self, camera: int, pixels: Floats, size: tuple[int, int]) -> Floats:
        """Return the instants of pixels after that of their picture.

        Args:
            camera: Number of the camera.
            pixels: (..., 2) [px].
            size: Width and height of the camera's picture [px].

        Returns:
            (...) [s].
        """
        return np.asarray(self.readout_s[camera] * row_shares(self.sides[camera], pixels, size))

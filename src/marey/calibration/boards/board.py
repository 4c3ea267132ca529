"""Printed calibration boards: kinds, dimensions, and the positions of their corners."""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from marey.arrays import Floats, frozen
from marey.errors import SettingProblem

BoardKind = Literal["charuco", "chessboard", "markers"]
"""A chessboard with markers in its white squares, a plain chessboard, or a grid of separate markers."""

_LEAST_SQUARES = {"charuco": 2, "chessboard": 3, "markers": 1}
"""Least number of squares or markers along either side, by kind of board; with fewer there is no inner corner."""


@dataclass(frozen=True, kw_only=True)
class CalibrationBoard:
    """A printed board.

    Its origin is the outer corner of the first square, x runs along a row and y down the columns as in the printed
    picture; z points into the board, away from the viewer. This is OpenCV's convention.

    Raises:
        SettingProblem: A dimension is impossible; the message lists everything that is wrong.
    """

    kind: BoardKind
    columns: int
    """Number of squares (or markers) along a row."""
    rows: int
    """Number of squares (or markers) along a column."""
    square: float
    """Side of a square, or of a marker in a grid of markers [m]."""
    marker: float = 0.0
    """Side of a marker in a square [m]; unused on a plain chessboard."""
    gap: float = 0.0
    """Distance between neighbouring markers of a grid [m]."""
    dictionary: str = ""
    """OpenCV's name of the dictionary of markers, for example DICT_5X5_250."""
    first_marker: int = 0
    """Number of the first marker in the dictionary."""
    legacy: bool = False
    """Whether a ChArUco board with an even number of rows begins with a white square, as before OpenCV 4.6."""
    inverted: bool = False
    """Whether black and white are exchanged."""
    two_sided: bool = False
    """Whether the back carries the mirror image of the front, corner behind corner."""
    thickness: float = 0.0
    """Distance between the two printed sides [m]."""
    square_assumed: bool = False
    """Whether the side of a square is not known, so that the scale is arbitrary."""

    def __post_init__(self) -> None:
        faults = self._faults()
        if faults:
            raise SettingProblem(f"The board {' and '.join(faults)}.")

    def _faults(self) -> list[str]:
        least, faults = _LEAST_SQUARES[self.kind], []
        if min(self.columns, self.rows) < least or self.columns * self.rows < 2:
            faults.append(f"has {self.columns} x {self.rows} squares; at least {least} x {least} are needed")
        if not 0 < self.square < np.inf:
            faults.append(f"has squares of {self.square:g} m; the side must be positive")
        if self.kind == "charuco" and not 0 < self.marker < self.square:
            faults.append(f"has markers of {self.marker:g} m in squares of {self.square:g} m; they must be smaller")
        if self.kind == "markers" and not self.gap > 0:
            faults.append(f"has a gap of {self.gap:g} m between its markers; it must be positive")
        if self.thickness < 0:
            faults.append(f"is {self.thickness:g} m thick; the thickness must not be negative")
        return faults

    @property
    def has_markers(self) -> bool:
        """Whether corners carry their own numbers, so that a part of the board is enough."""
        return self.kind != "chessboard"

    @cached_property
    def front(self) -> Floats:
        """(P, 3) corners of the front [m]; of a grid of markers the four corners of each, clockwise."""
        if self.kind == "markers":
            return frozen(self._marker_corners())
        x, y = np.meshgrid(np.arange(1, self.columns), np.arange(1, self.rows))
        return frozen(self.square * np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=-1))

    def _marker_corners(self) -> Floats:
        step = self.square + self.gap
        x, y = np.meshgrid(step * np.arange(self.columns), step * np.arange(self.rows))
        start = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=-1)
        around = self.square * np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
        return np.asarray((start[:, None] + around).reshape(-1, 3))

    @cached_property
    def points(self) -> Floats:
        """(P, 3) or, with two sides, (2 P, 3): corners of the front, then those of the back [m]."""
        if not self.two_sided:
            return self.front
        return frozen(np.concatenate([self.front, self.front + [0.0, 0.0, self.thickness]]))

    @cached_property
    def extent(self) -> Floats:
        """(2,) width and height of the printed pattern [m]."""
        count = np.array([self.columns, self.rows])
        if self.kind == "markers":
            return frozen(count * self.square + (count - 1) * self.gap)
        return frozen(count * self.square)

    @property
    def centre(self) -> Floats:
        """(3,) middle of the printed pattern [m]."""
        return np.array([*(0.5 * self.extent), 0.0])

    def describe(self) -> str:
        """Return the board in words, for messages and reports."""
        names = {"charuco": "ChArUco board", "chessboard": "chessboard", "markers": "grid of markers"}
        what = "markers" if self.kind == "markers" else "squares"
        return f"{names[self.kind]} of {self.columns} x {self.rows} {what} of {1e3 * self.square:g} mm"

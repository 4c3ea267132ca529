"""Calibration wands: two or three balls or tags on a stick, and points of the room with known coordinates."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from marey.arrays import Floats, frozen
from marey.calibration.boards.board import CalibrationBoard
from marey.errors import SettingProblem

COLOURS = ("bright", "red", "orange", "yellow", "green", "cyan", "blue", "magenta")
"""Colours by which balls are found; the first stands for balls that are brighter than everything around them."""


@dataclass(frozen=True, kw_only=True)
class CalibrationWand:
    """Two or three balls or tags on a straight stick, at known distances.

    Its origin is the middle of the first ball or tag, and x runs along the stick. The rotation about the stick cannot
    be seen.

    Raises:
        SettingProblem: A dimension is impossible; the message lists everything that is wrong.
    """

    distances: tuple[float, ...]
    """Distances between the centres of neighbouring balls or tags [m], one or two."""
    colours: tuple[str, ...] = ("bright",)
    """Colour of each ball in the order of the stick, or one for all: see `COLOURS`."""
    diameter: float = 0.0
    """Diameter of the balls [m]; 0 where it is not known."""
    tags: tuple[int, ...] = ()
    """Number of each tag in its dictionary; empty for balls."""
    dictionary: str = ""
    """OpenCV's name of the dictionary of tags."""

    def __post_init__(self) -> None:
        faults = self._faults()
        if faults:
            raise SettingProblem(f"The wand {' and '.join(faults)}.")

    def _faults(self) -> list[str]:
        faults, marks = [], len(self.distances) + 1
        if marks not in (2, 3):
            faults.append(f"has {marks} balls or tags; it should have two or three")
        if not all(0 < each < np.inf for each in self.distances):
            faults.append("has a distance that is not positive")
        unknown = [each for each in self.colours if each not in COLOURS]
        if unknown:
            faults.append(f"has the unknown colour '{unknown[0]}'; known are {', '.join(COLOURS)}")
        if not self.tags and len(self.colours) not in (1, marks):
            faults.append(f"has {len(self.colours)} colours for {marks} balls")
        if self.tags and (len(self.tags) != marks or len(set(self.tags)) < marks):
            faults.append(f"has {len(self.tags)} numbers of tags for {marks} different tags")
        return faults

    @cached_property
    def points(self) -> Floats:
        """(P, 3) centres of the balls or tags [m]."""
        along = np.concatenate([[0.0], np.cumsum(self.distances)])
        return frozen(along[:, None] * [1.0, 0.0, 0.0])

    @property
    def extent(self) -> Floats:
        """(2,) length and width [m]."""
        return np.array([sum(self.distances), 0.0])

    @property
    def centre(self) -> Floats:
        """(3,) middle of the stick [m]."""
        return np.array([0.5 * sum(self.distances), 0.0, 0.0])

    @property
    def alike(self) -> bool:
        """Whether the two ends look the same in a picture."""
        distinct = self.tags or self.colours[0] != self.colours[-1]
        lopsided = len(self.distances) == 2 and abs(np.log(self.distances[0] / self.distances[1])) > _LOPSIDED
        return not distinct and not lopsided

    def describe(self) -> str:
        """Return the wand in words, for messages and reports."""
        what = "tags" if self.tags else "balls"
        return f"wand of {len(self.points)} {what}, {1e3 * sum(self.distances):g} mm long"


_LOPSIDED = 0.35
"""Logarithm of the ratio of the two distances from which the ends of a wand differ: perspective changes the ratio in
the
image, by a factor of 1.3 for a wand of 0.6 m that points at a camera 4 m away at 45 degrees. Chosen by hand."""


@dataclass(frozen=True, kw_only=True)
class NoTarget:
    """Nothing that is moved: the session consists of points of the room with known coordinates."""

    @property
    def points(self) -> Floats:
        """(0, 3)."""
        return np.zeros((0, 3))

    @property
    def extent(self) -> Floats:
        """(2,) zeros."""
        return np.zeros(2)

    @property
    def centre(self) -> Floats:
        """(3,) zeros."""
        return np.zeros(3)

    def describe(self) -> str:
        """Return the target in words, for messages and reports."""
        return "points with known coordinates"


CalibrationTarget = CalibrationBoard | CalibrationWand | NoTarget
"""What is moved before the cameras."""


@dataclass(frozen=True, kw_only=True)
class Landmark:
    """A point of the room with known coordinates: the centre of a tag, or a named point that was picked."""

    name: str
    place: tuple[float, float, float]
    """World coordinates [m]."""
    sd: float
    """Standard deviation of each coordinate [m]."""
    tag: int | None = None
    """Number of the tag in its dictionary; None for a point that is picked in the pictures."""

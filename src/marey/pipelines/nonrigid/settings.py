"""What was typed for a run on a deforming surface."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.cameras.camera import matrix_faults
from marey.errors import FileProblem, SettingProblem
from marey.io.calibration.camera_matrix import read_matrix

_MATRIX = "Give a file, fx,fy,cx,cy, or the nine numbers of the matrix row by row, set apart by commas."


@dataclass(frozen=True, kw_only=True)
class NonRigidOptions:
    """What the command line asks for; None leaves it to the program.

    Raises:
        FileProblem: A file that was named is not there.
        SettingProblem: A value is impossible.
    """

    out: Path | None = None
    """Where the results go; `FILE_marey` beside the first input when None."""
    points: tuple[Path, ...] = ()
    """The points to follow, a file a video."""
    mask: Path | None = None
    """A picture that is white where points to follow may lie."""
    matrix: str | None = None
    """Known intrinsics of the one camera: a file, or numbers."""
    scaled: bool = False
    """Whether the one camera's scale may change from frame to frame."""
    cameras: Path | None = None
    """The calibration of the cameras."""
    distance: tuple[int, int, float] | None = None
    """Two points and how far they are apart [m]."""
    frames: tuple[int, int] | None = None
    """First frame and the first one after the last."""
    only: tuple[str, ...] | None = None
    """Labels, or patterns of labels, of the points of a file that are kept."""
    basis_shapes: int | None = None
    """K, of points in space."""
    overlay: bool = True
    """Whether overlay videos are drawn."""

    def __post_init__(self) -> None:
        for option, path in (("--mask", self.mask), ("--cameras", self.cameras)):
            if path is not None and not path.exists():
                raise FileProblem(path, "does not exist", f"Mend {option}.")
        for path in self.points:
            if not path.is_file():
                raise FileProblem(path, "is a folder" if path.is_dir() else "does not exist", "Mend --points.")
        if self.matrix is not None and self.cameras is not None:
            raise SettingProblem("--matrix and --cameras both say how the camera is made: give one of them.")
        if self.scaled and (self.matrix is not None or self.cameras is not None):
            raise SettingProblem(
                "--scaled is for a camera of which nothing is known: leave it out with --matrix or --cameras."
            )
        if self.mask is not None and self.points:
            raise SettingProblem("--mask says where points are chosen, --points which they are: give one of them.")
        if self.basis_shapes is not None and self.basis_shapes < 1:
            raise SettingProblem(f"--basis-shapes is {self.basis_shapes}; it should be 1 (rigid) or more.")
        if self.distance is not None:
            first, second, metres = self.distance
            if not (np.isfinite(metres) and metres > 0) or first == second or min(first, second) < 0:
                raise SettingProblem(
                    f"--distance is {first} {second} {metres:g}; it should be two different points, counted from 0, "
                    "and how many metres they are apart, for example 0 12 0.085."
                )

    @property
    def files(self) -> list[Path]:
        """The files that were named, besides the videos or tracks."""
        matrix = [Path(self.matrix)] if self.matrix is not None and Path(self.matrix).is_file() else []
        return [*self.points, *(path for path in (self.mask, self.cameras) if path is not None), *matrix]


def parse_matrix(text: str) -> Floats:
    """Read known intrinsics (3, 3): the name of a file, `fx,fy,cx,cy`, or nine numbers row by row.

    Raises:
        FileProblem: The file holds no matrix.
        SettingProblem: The text is neither a file nor such numbers, or they are no camera's.
    """
    if Path(text).is_file():
        return read_matrix(Path(text))
    try:
        numbers = [float(part) for part in text.replace(",", " ").replace(";", " ").split()]
    except ValueError as error:
        raise SettingProblem(
            f"--matrix is '{text}', which is no file that is there and no numbers. {_MATRIX}"
        ) from error
    if len(numbers) not in (4, 9):
        raise SettingProblem(f"--matrix has {len(numbers)} numbers. {_MATRIX}")
    if len(numbers) == 4:
        fx, fy, cx, cy = numbers
        numbers = [fx, 0, cx, 0, fy, cy, 0, 0, 1]
    matrix = np.array(numbers).reshape(3, 3)
    faults = matrix_faults(matrix)
    if faults:
        raise SettingProblem(f"--matrix {faults[0]}. {_MATRIX}")
    return matrix

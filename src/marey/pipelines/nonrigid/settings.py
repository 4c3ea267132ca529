"""Settings of a run on a deforming surface."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.cameras.camera import matrix_faults
from marey.errors import FileProblem, SettingProblem
from marey.io.calibration.camera_matrix import read_matrix

_MATRIX = "Give a file, fx,fy,cx,cy, or the nine numbers of the matrix row by row, separated by commas."
"""What a camera matrix on the command line should look like."""


@dataclass(frozen=True, kw_only=True)
class NonRigidSettings:
    """How the shapes of a deforming surface are recovered; None stands for a choice by the program.

    Raises:
        FileProblem: A named file does not exist.
        SettingProblem: A value is impossible, or two settings exclude each other.
    """

    points: tuple[Path, ...] = ()
    """NPZ files with the points to follow: one for the first video, or one per video."""
    mask: Path | None = None
    """Image that is white where points may be selected in the first video."""
    matrix: str | None = None
    """Known intrinsics of a single camera: a file, or numbers."""
    scaled: bool = False
    """Whether the scale of a single camera may change from frame to frame."""
    cameras: Path | None = None
    """Calibration of the cameras."""
    distance: tuple[int, int, float] | None = None
    """Two points, counted from 0, and their distance [m]."""
    frames: tuple[int, int] | None = None
    """First frame, and the frame after the last one; None for all."""
    only: tuple[str, ...] | None = None
    """Labels of the points to be used, or patterns of labels."""
    basis_shapes: int | None = None
    """Number K of basis shapes, for points in space and calibrated cameras."""
    overlay: bool = True
    """Whether overlay videos are drawn."""

    def __post_init__(self) -> None:
        for option, path in (("mask", self.mask), ("cameras", self.cameras)):
            if path is not None and not path.exists():
                raise FileProblem(path, "does not exist", f"Correct {option} (--{option}).")
        for path in self.points:
            if not path.is_file():
                raise FileProblem(
                    path, "is a folder" if path.is_dir() else "does not exist", "Correct points (--points)."
                )
        if self.matrix is not None and self.cameras is not None:
            raise SettingProblem("matrix (--matrix) and cameras (--cameras) both define the camera: give one of them.")
        if self.scaled and (self.matrix is not None or self.cameras is not None):
            raise SettingProblem(
                "scaled (--scaled) is for an uncalibrated camera: leave it out, or leave out matrix (--matrix) "
                "and cameras (--cameras)."
            )
        if self.mask is not None and self.points:
            raise SettingProblem(
                "mask (--mask) limits the selection of points, and points (--points) replaces it: give one of them."
            )
        if self.basis_shapes is not None and self.basis_shapes < 1:
            raise SettingProblem(
                f"basis_shapes (--basis-shapes) is {self.basis_shapes}; it should be 1 (rigid) or more."
            )
        if self.distance is not None:
            first, second, metres = self.distance
            if not (np.isfinite(metres) and metres > 0) or first == second or min(first, second) < 0:
                raise SettingProblem(
                    f"distance (--distance) is {first} {second} {metres:g}; it should be two "
                    "different points, counted from 0, "
                    "and their distance in metres, for example 0 12 0.085."
                )

    @property
    def files(self) -> list[Path]:
        """All files that the settings name, the videos or tracks not among them."""
        matrix = [Path(self.matrix)] if self.matrix is not None and Path(self.matrix).is_file() else []
        return [*self.points, *(path for path in (self.mask, self.cameras) if path is not None), *matrix]


def parse_matrix(text: str) -> Floats:
    """Read a camera matrix (3, 3) from the name of a file, `fx,fy,cx,cy`, or nine numbers row by row.

    Args:
        text: Value of the option.

    Raises:
        FileProblem: The file has no matrix.
        SettingProblem: The text is neither a file nor such numbers, or they are not those of a camera.
    """
    if Path(text).is_file():
        return read_matrix(Path(text))
    try:
        numbers = [float(part) for part in text.replace(",", " ").replace(";", " ").split()]
    except ValueError as error:
        raise SettingProblem(
            f"matrix (--matrix) is '{text}', which is neither an existing file nor numbers. {_MATRIX}"
        ) from error
    if len(numbers) not in (4, 9):
        raise SettingProblem(f"matrix (--matrix) has {len(numbers)} numbers. {_MATRIX}")
    if len(numbers) == 4:
        fx, fy, cx, cy = numbers
        numbers = [fx, 0, cx, 0, fy, cy, 0, 0, 1]
    matrix = np.array(numbers).reshape(3, 3)
    faults = matrix_faults(matrix)
    if faults:
        raise SettingProblem(f"matrix (--matrix) {faults[0]}. {_MATRIX}")
    return matrix

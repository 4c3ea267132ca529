"""The recovered shapes of a deforming surface, as a labelled result."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from marey.arrays import Floats, Mask
from marey.errors import FileProblem
from marey.io.markers.c3d import read_c3d
from marey.io.npz import read_arrays
from marey.io.shapes.shapes import read_shapes
from marey.nonrigid.recovered import RecoveredShapes
from marey.pipelines.nonrigid.input import NonRigidInput
from marey.pipelines.nonrigid.measure import MeasuredPoints
from marey.pipelines.nonrigid.results import write_results
from marey.pipelines.progress import Progress
from marey.pipelines.run_details import RunDetails, copy_results

if TYPE_CHECKING:
    pass

COMMAND = "nonrigid"
"""The command that leaves the same files."""


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Shapes:
    """The shapes of a surface in F frames, described by P points, with the object's motion.

    The shape of a frame is in the object's own axes; `rotation` and `translation` move it to where it is in that frame.

    Example:
        >>> import marey
        >>> shapes = marey.load_shapes("tracks_marey")  # doctest: +SKIP
        >>> shapes.shape.shape  # doctest: +SKIP
        (60, 3, 12)
    """

    found: RecoveredShapes
    """Everything that was recovered, with residuals and basis shapes."""
    labels: tuple[str, ...]
    """Names of the P points."""
    rate: float
    """Sampling rate [Hz]; 30 Hz if the input had none."""
    details: RunDetails
    """Settings, inputs, warnings and times of the run."""
    given: NonRigidInput | None = None
    """The input; None for a result that was read from a folder."""
    measured: MeasuredPoints | None = None
    """The points from which the shapes were recovered; None for a result that was read from a folder."""
    overlay: bool = False
    """Whether overlay videos are drawn when the result is saved."""
    folder: Path | None = None
    """The folder from which the result was read."""

    @property
    def time(self) -> Floats:
        """(F,) time of each frame [s]."""
        return np.asarray(np.arange(len(self.found)) / self.rate)

    @property
    def shape(self) -> Floats:
        """(F, 3, P) points in the object's axes, in `unit`; NaN where there is no result."""
        return self.found.shape

    @property
    def shape_sd(self) -> Floats:
        """(F, 3, P) standard deviations of `shape`, in `unit`."""
        return self.found.shape_sd

    @property
    def rotation(self) -> Floats:
        """(F, 3, 3) rotation from the object's axes to those of the first camera, or of the laboratory."""
        return self.found.rotation

    @property
    def placed(self) -> Floats:
        """(F, 3, P) points in the axes of the first camera, or of the laboratory, in `unit`."""
        return self.found.placed

    @property
    def predicted(self) -> Mask:
        """(F, P) true where a point was not measured but predicted."""
        return self.found.predicted

    @property
    def unit(self) -> str:
        """Unit of lengths: m, px, or "unit of the input"."""
        return self.found.unit

    @property
    def kind(self) -> str:
        """Kind of camera, or that the points are in space."""
        return self.found.kind

    @property
    def warnings(self) -> tuple[str, ...]:
        """Everything that the user should check, one sentence each."""
        return self.details.warnings

    def __len__(self) -> int:
        return len(self.found)

    def __repr__(self) -> str:
        head = f"Shapes of {len(self.labels)} points: {len(self)} frames at {self.rate:g} Hz, lengths in {self.unit}"
        return "\n".join([f"<{head}", *(f"  {line}" for line in self.summary())]) + ">"

    def summary(self) -> list[str]:
        """Return lines with the number of points and basis shapes, the residual, the size, and its uncertainty."""
        found = self.found
        kept = int(np.isfinite(found.basis[0]).all(0).sum())
        many = f"{found.basis_shapes} basis shapes"
        if found.basis_shapes == 1:
            many = f"rigid: one basis shape, rank {found.rank}"
        rms = float(np.sqrt(np.nanmean(found.residuals**2)))
        size = 2 * float(np.sqrt(np.nanmean((found.basis[0] ** 2).sum(0))))
        sd = float(np.nanmedian(np.sqrt((found.shape_sd**2).sum(1))))
        return [
            f"{kept} points in {int(found.answered.sum())} of {len(found)} frames, {found.kind}; {many}.",
            f"Residual {found.residual_text(rms)} (RMS); size of the object {found.length_text(size)}, standard "
            f"deviation of its points {found.length_text(sd)} (median).",
        ]

    def save(self, folder: Path | str, *, progress: Progress | None = None) -> Path:
        """Write the files of `marey nonrigid`: shapes, residuals, point clouds, GLB, C3D, overlays, report, run.json.

        A result that was read from a folder is copied from there.

        Args:
            folder: Where the files are written; it is made if it does not exist.
            progress: Progress reporter.

        Returns:
            The folder.
        """
        folder = Path(folder)
        if self.given is None or self.measured is None:
            copy_results(self.folder or folder, folder, COMMAND)
        else:
            write_results(
                self.given, self.measured, self.found, self.details, folder,
                progress or self.details.resumed_progress(), overlay=self.overlay,
            )  # fmt: skip
        return folder


def load_shapes(folder: Path | str) -> Shapes:
    """Read the results of `marey nonrigid`, or of `Shapes.save`.

    Args:
        folder: A folder with `shapes.npz`.

    Returns:
        The shapes. The sampling rate is that of `shapes.c3d`.

    Raises:
        FileProblem: A file is missing or damaged.

    Example:
        >>> import marey
        >>> shapes = marey.load_shapes("tracks_marey")  # doctest: +SKIP
    """
    folder = Path(folder)
    path = folder / "shapes.npz"
    if not path.is_file():
        raise FileProblem(folder, "has no shapes.npz", "Give a folder with the results of `marey nonrigid`.")
    c3d = folder / "shapes.c3d"
    return Shapes(
        found=read_shapes(path), labels=tuple(map(str, read_arrays(path, ("labels",))["labels"])),
        rate=read_c3d(c3d).rate if c3d.is_file() else float("nan"), details=RunDetails.read(folder, COMMAND),
        folder=folder,
    )  # fmt: skip

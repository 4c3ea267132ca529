"""The recovered shapes of a deforming surface, as a labelled result."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from marey.arrays import Floats, Mask
from marey.errors import FileProblem
from marey.extras import import_optional
from marey.io.markers.c3d import read_c3d
from marey.io.npz import read_arrays
from marey.io.shapes.shapes import read_shapes
from marey.nonrigid.recovered import RecoveredShapes
from marey.pipelines.labelled import Curve, Curves, Described, Summary, plot_curves
from marey.pipelines.nonrigid.input import NonRigidInput
from marey.pipelines.nonrigid.measure import NonRigidPoints
from marey.pipelines.nonrigid.results import write_results
from marey.pipelines.progress import Progress
from marey.pipelines.result_files import ResultFiles
from marey.pipelines.run_details import RunDetails
from marey.pipelines.verdict import Verdict
from marey.wording import count_of

COMMAND = "nonrigid"
"""The command that writes the same files."""
_FILE = "shapes.npz"
"""The file by which a folder of results is recognised."""


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Shapes(Described):
    """The shapes of a surface in F frames, described by P points, with the object's motion.

    The shape of a frame is in the object's own axes; `rotation` and `translation` place it in the axes of the
    camera or the laboratory.

    Example:
        >>> import marey
        >>> shapes = marey.load_shapes("cluster_marey")
        >>> shapes.shape.shape
        (40, 3, 9)
    """

    found: RecoveredShapes
    """The complete result of the factorisation, with residuals and basis shapes."""
    labels: tuple[str, ...]
    """Names of the P points."""
    rate: float
    """Sampling rate [Hz]; 30 Hz if the input had none."""
    details: RunDetails
    """Settings, inputs, warnings and times of the run."""
    given: NonRigidInput | None = None
    """The input; None for a result that was read from a folder."""
    measured: NonRigidPoints | None = None
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
    def verdict(self) -> Verdict | None:
        """How far the result can be used, and what limits it; None for a result of an earlier version."""
        return self.details.verdict

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings of the run, one sentence each."""
        return self.details.warnings

    @property
    def points(self) -> Curves:
        """Position of each point in the object's axes, by label; predicted positions have a flag."""

        def curve(i: int) -> Curve:
            flags = tuple("predicted" if each else "" for each in self.predicted[:, i])
            return Curve(
                name=self.labels[i], time=self.time, values=self.shape[:, :, i], sd=self.shape_sd[:, :, i],
                unit=self.unit, flags=flags, components=("x", "y", "z"),
            )  # fmt: skip

        return Curves("point", self.labels, curve)

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.found)

    def summary(self) -> Summary:
        """Return the number of points and basis shapes, the residual, the size, and its uncertainty."""
        found = self.found
        kept = int(np.isfinite(found.basis[0]).all(0).sum())
        many = f"{found.basis_shapes} basis shapes"
        if found.basis_shapes == 1:
            many = f"rigid: one basis shape, rank {found.rank}"
        rms = float(np.sqrt(np.nanmean(found.residuals**2)))
        size = 2 * float(np.sqrt(np.nanmean((found.basis[0] ** 2).sum(0))))
        sd = float(np.nanmedian(np.sqrt((found.shape_sd**2).sum(1))))
        lines = {
            "points": f"{kept} of {len(self.labels)}, in {int(found.answered.sum())} frames, {found.kind}",
            "shapes": many,
            "residual": f"{found.residual_text(rms)} (RMS)",
            "size": f"{found.length_text(size)}; standard deviation of a point {found.length_text(sd)} (median)",
        }
        if found.undetermined:
            lines["not determined"] = ", ".join(found.undetermined)
        return Summary(f"Shapes of a deforming surface, {count_of(len(self), 'frame')} at {self.rate:g} Hz", lines)

    def to_xarray(self) -> Any:
        """Return shapes, motion and residuals as an `xarray.Dataset`.

        Raises:
            MissingPackage: xarray is not installed.
        """
        xarray = import_optional("xarray", extra="xarray", purpose="Labelled arrays")
        place, length = ("time", "axis", "point"), {"units": self.unit}
        variables = {
            "shape": (place, self.shape, length),
            "shape_sd": (place, self.shape_sd, length),
            "placed": (place, self.placed, length),
            "rotation": (("time", "row", "column"), self.rotation, {"long_name": "laboratory from object"}),
            "basis": (("basis_shape", "axis", "point"), self.found.basis, length),
            "residual": (("camera", "time", "point"), self.found.residuals, {"units": self.found.residual_unit}),
            "predicted": (("time", "point"), self.predicted),
        }
        coordinates = {
            "time": ("time", self.time, {"units": "s"}), "axis": list("xyz"), "point": list(self.labels),
        }  # fmt: skip
        about = {"kind": self.kind, "metres_per_unit": self.found.metres_per_unit}
        return xarray.Dataset(variables, coords=coordinates, attrs=about)

    def plot(self, point: str, *, level: float = 0.95, axes: Any = None) -> Any:
        """Draw the position of a point in the object's axes over time, with the interval of its values as a band.

        Args:
            point: Label of the point.
            level: Probability of the interval.
            axes: Matplotlib's axes to draw on; new ones by default.

        Returns:
            The axes.

        Raises:
            UnknownName: There is no such point.
            MissingPackage: Matplotlib is not installed.
        """
        return plot_curves([self.points[point]], level=level, axes=axes)

    def save(self, folder: Path | str, *, progress: Progress | None = None) -> Path:
        """Write the files of `marey nonrigid`: shapes, residuals, point clouds, GLB, C3D, overlays, report, run.json.

        A result that was read from a folder is copied from there.

        Args:
            folder: Folder for the files; it is created if it does not exist.
            progress: Progress reporter.

        Returns:
            The folder.
        """
        folder = Path(folder)
        if self.given is None or self.measured is None:
            ResultFiles(self.folder or folder).save(folder, file=_FILE)
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
        >>> shapes = marey.load_shapes("cluster_marey")
        >>> shapes.rate
        50.0
    """
    folder = Path(folder)
    path = folder / _FILE
    if not path.is_file():
        raise FileProblem(folder, "has no shapes.npz", "Give a folder with the results of `marey nonrigid`.")
    c3d = folder / "shapes.c3d"
    return Shapes(
        found=read_shapes(path),
        labels=tuple(map(str, read_arrays(path, ("labels",))["labels"])),
        rate=read_c3d(c3d).rate if c3d.is_file() else float("nan"),
        details=RunDetails.read(folder, COMMAND, file=_FILE), folder=folder,
    )  # fmt: skip

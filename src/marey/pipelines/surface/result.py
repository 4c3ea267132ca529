"""The result of a surface measurement: points with standard deviations, and their trajectories."""

from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from marey.arrays import Floats, Image, Integers
from marey.errors import FileProblem
from marey.extras import import_optional
from marey.io.shapes.measured_surface import read_surface, write_ply, write_surface
from marey.io.shapes.trajectories import read_trajectories
from marey.pipelines.labelled import Summary
from marey.pipelines.result_files import ResultFiles, StoredResult
from marey.surface.points.measured import MeasuredPoints
from marey.surface.tracks.trajectories import Trajectories
from marey.wording import count_of

_FILE = "surface.npz"
"""The file from which a surface is read."""
_TRACKS = "trajectories.npz"
"""The file with trajectories beside it."""


class Surface(StoredResult):
    """The measured points of a visible surface, of one frame or of many, with standard deviations.

    Args:
        files: The folder with all files of the run; None for a part of a surface.
        data: The measured points; read from the files when they are first used by default.

    Example:
        >>> import marey
        >>> surface = marey.load_surface("face1")
        >>> surface.points.shape
        (40, 3)
        >>> near = surface.of_frame(1)
        >>> len(near)
        20
    """

    _file, _report = _FILE, "surface.html"

    def __init__(self, files: ResultFiles | None, data: MeasuredPoints | None = None):
        super().__init__(files)
        if data is not None:
            self.__dict__["data"] = data

    @cached_property
    def data(self) -> MeasuredPoints:
        """All arrays, under the names that they have in `surface.npz`."""
        if self._files is None:
            raise FileProblem(_FILE, "is missing", "Give the measured points, or the folder of a run.")
        return read_surface(self._files.folder / _FILE)

    @property
    def points(self) -> Floats:
        """(N, 3) in the world [m]."""
        return self.data.points

    @property
    def sd(self) -> Floats:
        """(N,) standard deviation of each point: the root of the trace of its covariance [m]."""
        return np.asarray(np.sqrt(np.trace(self.data.covariance, axis1=1, axis2=2)))

    @property
    def covariance(self) -> Floats:
        """(N, 3, 3) covariance of each point [m2]."""
        return self.data.covariance

    @property
    def frame(self) -> Integers:
        """(N,) the frame of the video in which each point was measured."""
        return self.data.frame

    @property
    def colour(self) -> Image:
        """(N, 3) red, green and blue of each point, from 0 to 255."""
        return self.data.colour

    @property
    def residual_px(self) -> Floats:
        """(N,) root mean square distance of the matched pixels from the projections of each point [px]."""
        return self.data.residual_px

    @property
    def views(self) -> Integers:
        """(N,) number of cameras in which each point was matched."""
        return self.data.views

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return self.data.camera_names

    @property
    def frames(self) -> Integers:
        """The frames that have points."""
        return self.data.frames

    @cached_property
    def trajectories(self) -> Trajectories | None:
        """Paths of points through the frames with velocity and acceleration; None if none were followed."""
        path = None if self._files is None else self._files.path(_TRACKS)
        return None if path is None else read_trajectories(path)

    @property
    def path(self) -> Path | None:
        """The file with the points; None for a part of a surface."""
        return None if self._files is None else self._files.path(_FILE)

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.data)

    def of_frame(self, frame: int) -> "Surface":
        """Return the points of one frame; none where nothing was measured.

        Args:
            frame: Number of the frame in the video.
        """
        return Surface(None, self.data.of_frame(frame))

    def plot(self, *, axes: Any = None) -> Any:
        """Draw the points in space, in their own colours.

        Args:
            axes: Matplotlib's axes in three dimensions to draw on; new ones by default.

        Returns:
            The axes.

        Raises:
            MissingPackage: Matplotlib is not installed.
        """
        from marey.view.pictures.plots import draw_points

        return draw_points(self.points, colour=self.colour, axes=axes)

    def to_xarray(self) -> Any:
        """Return an `xarray.Dataset` with the dimension `point` and units as attributes.

        Raises:
            MissingPackage: xarray is not installed.
        """
        xarray = import_optional("xarray", extra="xarray", purpose="Labelled arrays")
        data = self.data
        variables = {
            "points": (("point", "space"), data.points, {"units": "m"}),
            "covariance": (("point", "row", "column"), data.covariance, {"units": "m2"}),
            "sd": (("point",), self.sd, {"units": "m"}),
            "frame": (("point",), data.frame),
            "pixels": (("point", "camera", "image"), data.pixels, {"units": "px"}),
            "correlation": (("point", "camera"), data.correlation, {"units": "1"}),
            "residual_px": (("point",), data.residual_px, {"units": "px"}),
            "colour": (("point", "channel"), data.colour),
        }
        coordinates = {
            "camera": list(data.camera_names),
            "space": ["x", "y", "z"],
            "image": ["x", "y"],
            "channel": ["red", "green", "blue"],
        }
        return xarray.Dataset(variables, coords=coordinates, attrs={"world": "Z up, right-handed"})

    def to_pandas(self) -> Any:
        """Return a `pandas.DataFrame` with one row per point: frame, position and sd [m], residual [px], views, colour.

        Raises:
            MissingPackage: pandas is not installed.
        """
        pandas = import_optional("pandas", extra="pandas", purpose="Tables")
        columns: dict[str, Any] = {"frame": np.array(self.frame)}
        columns |= dict(zip("xyz", np.array(self.points).T, strict=True))
        columns |= {"sd": self.sd, "residual_px": np.array(self.residual_px), "views": self.views}
        columns |= dict(zip(("red", "green", "blue"), np.array(self.colour).T, strict=True))
        return pandas.DataFrame(columns)

    def save(self, folder: Path | str) -> Path:
        """Write the surface: the same files as `marey surface --out folder`.

        For a part of a surface, or one that was matched in single images, only `surface.npz` and `surface.ply` are
        written.

        Args:
            folder: Folder for the files; it is created if it does not exist.

        Returns:
            The folder.

        Raises:
            FileProblem: The folder cannot be written to.
        """
        if self._files is not None:
            return self._files.save(folder, file=_FILE)
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        write_surface(folder / _FILE, [self.data], self.cameras)
        write_ply(folder / "surface.ply", self.data)
        return folder

    def summary(self) -> Summary:
        """Return the readable description."""
        lines = {"points": f"{len(self)} in {count_of(len(self.frames), 'frame')}"}
        if len(self):
            lines["standard deviation"] = f"{1e3 * np.median(self.sd):.2f} mm (median)"
            lines["residual"] = f"{np.median(self.residual_px):.2f} px (median)"
            several = np.mean(self.views > 2)
            lines["cameras"] = f"{', '.join(self.cameras)}; {several:.0%} of the points in three or more"
        if self.trajectories is not None:
            lines["trajectories"] = f"{len(self.trajectories.kept)}"
        if self.warnings:
            lines["warnings"] = count_of(len(self.warnings), "warning") + ", see .warnings"
        return Summary("Measured surface", lines)


def load_surface(path: Path | str) -> Surface:
    """Read a surface that `marey surface`, `marey shape` or `Surface.save` wrote.

    Args:
        path: The folder with the results, the trial whose results are in `marey/`, or a surface.npz.

    Returns:
        The surface.

    Raises:
        FileProblem: There is no surface.npz, or it is damaged.

    Example:
        >>> import marey
        >>> marey.load_surface("face1").cameras
        ('left', 'middle', 'right')
    """
    path = Path(path)
    for found in (path, path / _FILE, path / "marey" / _FILE):
        if found.is_file():
            return Surface(ResultFiles(found.parent) if found.name == _FILE else None, read_surface(found))
    what = "holds no surface.npz" if path.is_dir() else "does not exist"
    raise FileProblem(path, what, "Give the folder with the results of `marey surface`.")

"""The result of a capture: a motion with names, units, standard deviations and flags."""

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.body.articulation.surface import Body
from marey.body.people.person import measured_stature
from marey.errors import FileProblem
from marey.extras import import_optional
from marey.io.npz import read_arrays, read_motion, write_motion
from marey.io.results.body import read_body
from marey.io.results.netcdf import write_netcdf
from marey.io.results.results import write_motion_tables, write_results
from marey.motion.events.cycles import GaitEvent
from marey.motion.events.repetitions import Repetitions
from marey.motion.from_fit import joint_centre_sds
from marey.motion.motion import FILLED, LOST, MEASURED, NO_PERSON, BodyMotion
from marey.pipelines.gait.repetitions import repetitions_of_body
from marey.pipelines.gait.walk import Gait, gait_of_body
from marey.pipelines.labelled import Curve, Curves, Summary, plot_curves
from marey.pipelines.result_files import ResultFiles, StoredResult
from marey.pipelines.segment_motion import SegmentMotions
from marey.wording import count_of

STATE_FLAGS = {NO_PERSON: "no person", MEASURED: "", FILLED: "filled", LOST: "lost"}
"""The flag of a frame by its state: nothing for a measured frame."""
UNDETERMINED = "not determined"
"""The flag of a coordinate that the views do not determine: its value comes from typical postures."""
_FILE = "motion.npz"
"""The file from which a motion is read."""
NOT_SELECTED = "not selected"
"""Flag of a frame outside the range that the run used."""


class Motion(StoredResult):
    """The motion of a person, with standard deviations and flags.

    Quantities are found by name, with spaces or underscores: `motion.angles["left knee flexion"]`. Frames without a
    result contain NaN and a flag.

    Args:
        data: The arrays of the motion.
        files: The folder with all files of the run; None for a part of a motion.
        body: The person's body at rest and the name of its preset, where they are not read from the files.

    Example:
        >>> import marey
        >>> motion = marey.load_motion("walk01/marey")
        >>> motion.rate
        30.0
        >>> knee = motion.angles["left knee flexion"]
        >>> low, high = knee.interval(0.95)
        >>> motion.joints["left ankle"].component("z").unit
        'm'
        >>> motion.segments["left thigh"].origin.components
        ('x', 'y', 'z')
    """

    _file, _report = _FILE, "report.html"

    def __init__(self, data: BodyMotion, files: ResultFiles | None = None, body: tuple[Body, str] | None = None):
        super().__init__(files)
        self._data, self._given = data, body

    @property
    def data(self) -> BodyMotion:
        """All arrays, under the names that they have in `motion.npz`."""
        return self._data

    @property
    def time(self) -> Floats:
        """(F,) time of each frame [s]."""
        return self._data.time

    @property
    def rate(self) -> float:
        """Frame rate [Hz]."""
        return self._data.rate

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return self._data.camera_names

    @cached_property
    def flags(self) -> tuple[str, ...]:
        """(F,) for each frame `no person`, `filled`, `lost` or `not selected`; an empty text where it was measured."""
        flags = [STATE_FLAGS[int(state)] for state in self._data.state]
        settings = self.record.get("settings")
        frames = settings.get("frames") if isinstance(settings, dict) else None
        if isinstance(frames, list | tuple) and len(frames) == 2:
            first, end = frames
            flags[:first] = [NOT_SELECTED] * len(flags[:first])
            flags[end:] = [NOT_SELECTED] * len(flags[end:])
        return tuple(flags)

    @property
    def measured(self) -> Mask:
        """(F,) true for frames whose pose was measured."""
        return np.asarray(self._data.state == MEASURED)

    @property
    def angles(self) -> Curves:
        """Anatomical joint angles by name [deg], with standard deviations.

        A value that the views do not determine has the flag `not determined`; in files of earlier versions that is not
        known, and the flag is missing.
        """
        data = self._data

        def curve(i: int) -> Curve:
            known = None if data.angles_determined is None else data.angles_determined[:, i]
            return self._curve(
                data.angle_names[i], data.angles_deg[:, i], data.angles_deg_sd[:, i], unit="deg",
                flags=self._with_undetermined(known),
            )  # fmt: skip

        return Curves("angle", data.angle_names, curve)

    @property
    def joints(self) -> Curves:
        """Joint centres by name, components x, y, z in the world (Z up) [m], with standard deviations."""
        data = self._data

        def curve(i: int) -> Curve:
            return self._curve(
                data.joint_names[i], data.joint_centres[:, i], data.joint_centres_sd[:, i], unit="m", components="xyz"
            )

        return Curves("joint centre", data.joint_names, curve)

    @property
    def coordinates(self) -> Curves:
        """Generalised coordinates of the skeleton by name: the first three [m], all others [rad].

        A value that the views do not determine has the flag `not determined`.
        """
        data = self._data

        def curve(i: int) -> Curve:
            return self._curve(
                data.coordinate_names[i], data.coordinates[:, i], data.coordinates_sd[:, i],
                unit="m" if i < 3 else "rad", flags=self._with_undetermined(data.determined[:, i]),
            )  # fmt: skip

        return Curves("coordinate", data.coordinate_names, curve)

    @property
    def agreement(self) -> Curves:
        """Agreement of surface and silhouette by camera: intersection over union, from 0 to 1."""
        data = self._data

        def curve(i: int) -> Curve:
            return self._curve(data.camera_names[i], data.agreement[:, i], None, unit="")

        return Curves("camera", data.camera_names, curve)

    @property
    def segments(self) -> SegmentMotions:
        """Position and orientation of each segment by name, for example `motion.segments["left thigh"].origin`.

        The standard deviations are not known; those of the joints are in `joints`.
        """
        return SegmentMotions(self._data, self.flags)

    def rotation(self, segment: str) -> Floats:
        """Return the orientation of a segment.

        Args:
            segment: Name of the segment, for example "left thigh".

        Returns:
            (F, 3, 3) world from segment; the identity in the rest posture.

        Raises:
            UnknownName: There is no such segment.
        """
        return self.segments[segment].rotation

    @cached_property
    def _body(self) -> tuple[Body, str] | None:
        if self._given is not None or self._files is None:
            return self._given
        path = self._files.path("body.npz")
        return None if path is None else read_body(path)

    @property
    def body(self) -> Body:
        """The person's body at rest.

        Raises:
            FileProblem: There is no body.npz beside the motion.
        """
        if self._body is None:
            raise FileProblem(self.folder or _FILE, "has no body.npz beside it", "Load the folder of a capture.")
        return self._body[0]

    @cached_property
    def gait(self) -> Gait:
        """Events, cycles and spatio-temporal parameters of a walk; without events if there is no complete cycle.

        Raises:
            FileProblem: There is no body.npz beside the motion.
        """
        return gait_of_body(self._data, self.body) or Gait(events=(), cycles=())

    @property
    def events(self) -> tuple[GaitEvent, ...]:
        """Foot strikes and foot offs of a walk, each with its standard deviation; see `gait`."""
        return self.gait.events

    @cached_property
    def repetitions(self) -> Repetitions:
        """Squats, sitting down and standing up, and jumps; none of a walk.

        Raises:
            FileProblem: There is no body.npz beside the motion.
        """
        return repetitions_of_body(self._data, self.body, self.gait)

    def skin(self) -> tuple[Floats, Integers]:
        """Read the posed skin.

        Returns:
            Vertices (F, V, 3) in the world [m], NaN in frames without a result, and faces (T, 3).

        Raises:
            FileProblem: There is no skin.npz beside the motion.
        """
        path = None if self._files is None else self._files.path("skin.npz")
        if path is None:
            raise FileProblem(self.folder or _FILE, "has no skin.npz beside it", "Load the folder of a capture.")
        stored = read_arrays(path, ("vertices", "faces"))
        return stored["vertices"], stored["faces"]

    def _with_undetermined(self, determined: Mask | None) -> tuple[str, ...]:
        """Return the flags with `not determined` in the measured frames in which a quantity (F,) is not."""
        if determined is None:
            return self.flags
        known = zip(self.flags, determined, strict=True)
        return tuple(UNDETERMINED if flag == "" and not sure else flag for flag, sure in known)

    def _joint_sd_text(self) -> str:
        """Describe the standard deviations of the joint centres, with their constant offset where a body is known."""
        if self._body is None:
            return f"standard deviation {1e3 * np.nanmedian(self._data.joint_centres_sd):.1f} mm (median)"
        own, whole = (1e3 * sd for sd in joint_centre_sds(self._data, self.body))
        return f"standard deviation {whole:.1f} mm (median), {own:.1f} mm of it from frame to frame"

    def _curve(
        self, name: str, values: Floats, sd: Floats | None, *, unit: str, components: Sequence[str] = (),
        flags: tuple[str, ...] | None = None,
    ) -> Curve:  # fmt: skip
        return Curve(
            name=name, time=self.time, values=values, sd=sd, unit=unit, components=tuple(components),
            flags=self.flags if flags is None else flags,
        )  # fmt: skip

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._data)

    def frames(self, chosen: slice | range | Sequence[int] | Mask) -> "Motion":
        """Return a part of the motion.

        Args:
            chosen: A slice, a range, indices of frames, or a mask (F,).

        Returns:
            The motion of these frames, in this order; the files that need the videos are not included.
        """
        index = list(chosen) if isinstance(chosen, range) else chosen
        return Motion(self._data.frames(index), None, self._body)

    def plot(self, names: str | Sequence[str], *, level: float = 0.95, axes: Any = None) -> Any:
        """Draw angles over time, each with its interval as a band.

        Args:
            names: A part of the names, for example "knee", or a list of angles.
            level: Probability of the interval.
            axes: Matplotlib's axes to draw on; new ones by default.

        Returns:
            The axes.

        Raises:
            UnknownName: There is no such angle.
            MissingPackage: Matplotlib is not installed.
        """
        return plot_curves(self.angles.matching(names), level=level, axes=axes)

    def to_xarray(self) -> Any:
        """Return an `xarray.Dataset` with the same variables and dimensions as `motion.nc`, and units as attributes.

        Raises:
            MissingPackage: xarray is not installed.
        """
        xarray = import_optional("xarray", extra="xarray", purpose="Labelled arrays")
        data = self._data
        flags = data.angles_determined
        variables = {
            "joint_centres": (("time", "joint", "space"), data.joint_centres, {"units": "m"}),
            "joint_centres_sd": (("time", "joint", "space"), data.joint_centres_sd, {"units": "m"}),
            "segment_rotation": (("time", "segment", "row", "column"), data.segment_rotation, {"units": "1"}),
            "segment_origin": (("time", "segment", "space"), data.segment_origin, {"units": "m"}),
            "coordinates": (("time", "coordinate"), data.coordinates, {"units": "rad; the first three m"}),
            "coordinates_sd": (("time", "coordinate"), data.coordinates_sd, {"units": "rad; the first three m"}),
            "determined": (("time", "coordinate"), data.determined),
            "angles_deg": (("time", "angle"), data.angles_deg, {"units": "degrees"}),
            "angles_deg_sd": (("time", "angle"), data.angles_deg_sd, {"units": "degrees"}),
            **({} if flags is None else {"angles_determined": (("time", "angle"), flags)}),
            "agreement": (("time", "camera"), data.agreement, {"units": "1"}),
        }
        coordinates = {
            "time": ("time", data.time, {"units": "s"}),
            "state": ("time", list(self.flags)),
            "joint": list(data.joint_names),
            "segment": list(data.segment_names),
            "coordinate": list(data.coordinate_names),
            "angle": list(data.angle_names),
            "camera": list(data.camera_names),
            "space": ["x", "y", "z"],
        }
        attributes = {"rate_hz": data.rate, "world": "Z up, right-handed"}
        return xarray.Dataset(variables, coords=coordinates, attrs=attributes)

    def to_pandas(self, *, sd: bool = False) -> Any:
        """Return the joint angles as a `pandas.DataFrame`: one row per frame, one column per angle [deg].

        Args:
            sd: Whether columns `<angle>_sd` with the standard deviations follow.

        Raises:
            MissingPackage: pandas is not installed.
        """
        pandas = import_optional("pandas", extra="pandas", purpose="Tables")
        data = self._data
        index = pandas.Index(data.time, name="time")
        table = pandas.DataFrame(np.array(data.angles_deg), index=index, columns=list(data.angle_names))
        if sd:
            names = [f"{name}_sd" for name in data.angle_names]
            table = table.join(pandas.DataFrame(np.array(data.angles_deg_sd), index=index, columns=names))
        table.insert(0, "state", list(self.flags))
        return table

    def save(self, folder: Path | str) -> Path:
        """Write the motion: the same files as `marey capture --out folder`.

        For a part of a motion, only the files that need neither videos nor silhouettes are written.

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
        if self._body is not None:
            body, preset = self._body
            write_results(folder, self._data, body, preset=preset)
        else:
            write_motion(folder / _FILE, self._data)
            write_netcdf(folder / "motion.nc", self._data)
            write_motion_tables(folder, self._data)
        return folder

    def summary(self) -> Summary:
        """Return the readable description."""
        data = self._data
        counts = {flag or "measured": self.flags.count(flag) for flag in (*STATE_FLAGS.values(), NOT_SELECTED)}
        states = ", ".join(f"{number} {name}" for name, number in counts.items() if number)
        lines = {"frames": f"{len(self)} at {self.rate:g} Hz ({states})"}
        seen = data.agreement[np.isfinite(data.agreement)]
        lines["cameras"] = ", ".join(self.cameras) + (f"; agreement {np.median(seen):.2f}" if seen.size else "")
        if self.measured.any():
            angles = float(np.nanmedian(data.angles_deg_sd[self.measured]))
            lines["joint centres"] = f"{len(data.joint_names)}, {self._joint_sd_text()}"
            lines["joint angles"] = f"{len(data.angle_names)}, standard deviation {angles:.1f} deg (median)"
        if self._body is not None:
            lines |= _person(self.body)
        if self.warnings:
            lines["warnings"] = count_of(len(self.warnings), "warning") + ", see .warnings"
        return Summary("Motion of a person", lines)


def _person(body: Body) -> dict[str, str]:
    """Return the line of the person's stature; none if the images do not measure it."""
    found = measured_stature(body)
    if found is None:
        return {}
    height, sd = found
    text = f"stature {height:.3f} m" + (f", standard deviation {1e3 * sd:.0f} mm" if np.isfinite(sd) else "")
    return {"person": text}


def motion_file(path: Path | str) -> Path:
    """Return the motion.npz of a folder of results.

    Args:
        path: A motion.npz, the folder with it, or a trial whose results are in `marey/`.

    Raises:
        FileProblem: There is none.
    """
    path = Path(path)
    if path.is_file():
        return path
    for found in (path / _FILE, path / "marey" / _FILE):
        if found.is_file():
            return found
    what = "holds no motion.npz" if path.is_dir() else "does not exist"
    raise FileProblem(path, what, "Give the folder with the results of `marey capture` or `marey shape`.")


def load_motion(path: Path | str) -> Motion:
    """Read a motion that `marey capture`, `marey shape` or `Motion.save` wrote.

    Args:
        path: The folder with the results, the trial whose results are in `marey/`, or a motion.npz.

    Returns:
        The motion.

    Raises:
        FileProblem: There is no motion.npz, or it is damaged.

    Example:
        >>> import marey
        >>> motion = marey.load_motion("walk01")
        >>> len(motion)
        24
    """
    file = motion_file(path)
    return Motion(read_motion(file), ResultFiles(file.parent) if file.name == _FILE else None)


def load_body(path: Path | str) -> Body:
    """Read the body of a person that `marey capture` or `marey shape` wrote.

    Args:
        path: A body.npz, the folder with it, or the trial whose results are in `marey/`.

    Returns:
        The body at rest: skeleton, skin, sizes and, where known, metaballs.

    Raises:
        FileProblem: There is no body.npz, or it is damaged.

    Example:
        >>> import marey
        >>> body = marey.load_body("walk01")
        >>> body.skeleton.segment_names[:2]
        ('pelvis', 'abdomen')
    """
    path = Path(path)
    places = (path, path / "body.npz", path / "marey" / "body.npz")
    for found in places:
        if found.is_file():
            return read_body(found)[0]
    what = "holds no body.npz" if path.is_dir() else "does not exist"
    raise FileProblem(path, what, "Give the folder with the results of `marey capture` or `marey shape`.")

"""The motion of bones beneath skin markers, as a labelled result."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from marey.arrays import Floats, Mask
from marey.errors import FileProblem, SettingProblem
from marey.extras import import_optional
from marey.io.markers.bones import read_bones
from marey.io.markers.given_angles import read_given_angles
from marey.io.markers.reading_results import read_joint_csv, read_landmark_motion, read_marker_motion
from marey.io.markers.results import joint_columns
from marey.io.results.gait import read_event_csv, read_gait_cycles_csv
from marey.io.results.repetitions import read_repetitions
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.marker_motion import MarkerMotion
from marey.markers.kinematics.given_agreement import GivenAgreement
from marey.markers.kinematics.joint_angles import JointKinematics
from marey.markers.kinematics.landmark_motion import LandmarkMotion
from marey.markers.methods.methods import METHODS
from marey.motion.events.cycles import gait_cycles
from marey.motion.events.repetitions import Repetitions
from marey.pipelines.gait.repetitions import REPETITIONS_FILE
from marey.pipelines.gait.walk import Gait
from marey.pipelines.labelled import Curve, Curves, Described, Summary, plot_curves
from marey.pipelines.markers.estimated_bones import EstimatedBones, MethodRun
from marey.pipelines.markers.results import GIVEN_ANGLES, LANDMARK_MOTION, write_results
from marey.pipelines.progress import Progress
from marey.pipelines.result_files import ResultFiles
from marey.pipelines.run_details import RunDetails
from marey.wording import count_of

COMMAND = "markers"
"""The command that writes the same files."""
_FILE = "bones.npz"
"""The file by which a folder of results is recognised."""
_ANATOMICAL = ("reference", "static", "model", "marker_set")
"""Settings in run.json with which the frames of the bones are anatomical."""
_MM = 1e3
"""Millimetres in a metre."""
_NOT_REQUESTED = "not requested"
"""The flag of a frame that was not to be estimated."""


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Bones(EstimatedBones, Described):
    """The motion of the bones beneath the markers of a trial, by one method or several.

    All properties are those of the first method; `method` returns the result of another one.

    Example:
        >>> import marey
        >>> bones = marey.load_bones("walk_marey")
        >>> bones.angles["knee flexion"]
        knee flexion [deg]: 120 frames, 0 to 1.19 s; ...
    """

    def method(self, name: str) -> "Bones":
        """Return the same result with the values of another method.

        Args:
            name: One of `methods`.

        Raises:
            SettingProblem: The method was not run.
        """
        for run in self.runs:
            if run.name == name:
                return replace(self, runs=(run, *(other for other in self.runs if other is not run)))
        raise SettingProblem(f"The method {name!r} was not run. Methods that were run: {', '.join(self.methods)}.")

    @property
    def angles(self) -> Curves:
        """Joint angles by name [deg], with standard deviations."""
        joints = self.joints
        values, spread = np.degrees(joints.angles), np.degrees(joints.angles_sd)
        return self._curves("angle", joints.angle_names, values, spread, "deg")

    @property
    def translations(self) -> Curves:
        """Joint translations by name [mm], with standard deviations."""
        joints = self.joints
        values, spread = _MM * joints.translations, _MM * joints.translations_sd
        return self._curves("translation", joints.translation_names, values, spread, "mm")

    @property
    def origins(self) -> Curves:
        """Origin of each bone by name, components x, y, z in the laboratory [m], with standard deviations."""
        return self._curves("bone", self.segments, self.motion.origin, self.motion.origin_sd, "m", components="xyz")

    @property
    def landmarks(self) -> Curves:
        """Landmarks of the static trial by name, carried by their bones: x, y, z in the laboratory [m], with sd."""
        found = self.runs[0].landmarks
        return self._curves("landmark", found.names, found.points, found.sd, "m", components="xyz")

    def _curves(
        self, kind: str, names: Sequence[str], values: Floats, spread: Floats, unit: str, *, components: str = ""
    ) -> Curves:
        flags = tuple("" if wanted else _NOT_REQUESTED for wanted in self.frames)

        def curve(i: int) -> Curve:
            return Curve(
                name=names[i], time=self.time, values=values[:, i], sd=spread[:, i], unit=unit, flags=flags,
                components=tuple(components),
            )  # fmt: skip

        return Curves(kind, names, curve)

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.time)

    def summary(self) -> Summary:
        """Return a line per bone: frames with a pose, and the motion of its markers relative to it."""
        lines, run, wanted = {}, self.runs[0], int(self.frames.sum())
        for s, name in enumerate(self.segments):
            moved = run.markers.rms[[segment == name for segment in run.markers.segments]]
            moved = moved[np.isfinite(moved)]
            skin = ""
            if len(moved):
                skin = f"; its markers move {_MM * np.sqrt(np.mean(moved**2)):.1f} mm relative to it (RMS)"
            lines[name] = f"{int(run.motion.answered[:, s].sum())} of {wanted} frames{skin}"
        if rows := self.given_agreement:
            lines["angles in the file"] = _agreement_text(rows)
        if run.fit:
            lines = {"model": run.fit}
        if len(self.runs) > 1:
            lines["methods"] = f"{', '.join(self.methods)}; the values are those of {self.methods[0]}"
        return Summary(f"Motion of bones, {count_of(len(self), 'frame')} at {self.rate:g} Hz, method {run.name}", lines)

    def to_pandas(self) -> Any:
        """Return angles [deg] and translations [mm] over time as a `pandas.DataFrame`, with the columns of angles.csv.

        Raises:
            MissingPackage: pandas is not installed.
        """
        pandas = import_optional("pandas", extra="pandas", purpose="Tables")
        columns: dict[str, Floats] = {}
        for name, value, (spread_name, spread) in joint_columns(self.joints, ("_deg", "_mm"), "_sd"):
            columns |= {name: value, spread_name: spread}
        return pandas.DataFrame(columns, index=pandas.Index(self.time, name="time_s"))

    def to_xarray(self) -> Any:
        """Return poses, angles and translations with their standard deviations as an `xarray.Dataset`.

        Raises:
            MissingPackage: xarray is not installed.
        """
        xarray = import_optional("xarray", extra="xarray", purpose="Labelled arrays")
        motion, joints = self.motion, self.joints
        place, angle = ("time", "segment", "axis"), ("time", "angle")
        translation = ("time", "translation")
        variables = {
            "rotation": (("time", "segment", "row", "column"), motion.rotation, {"long_name": "laboratory from bone"}),
            "rotation_sd": (place, motion.rotation_sd, {"units": "rad"}),
            "origin": (place, motion.origin, {"units": "m"}),
            "origin_sd": (place, motion.origin_sd, {"units": "m"}),
            "angles": (angle, np.degrees(joints.angles), {"units": "deg"}),
            "angles_sd": (angle, np.degrees(joints.angles_sd), {"units": "deg"}),
            "translations": (translation, _MM * joints.translations, {"units": "mm"}),
            "translations_sd": (translation, _MM * joints.translations_sd, {"units": "mm"}),
            "requested": ("time", self.frames),
        }
        coordinates = {
            "time": ("time", self.time, {"units": "s"}), "segment": list(self.segments), "axis": list("xyz"),
            "angle": list(joints.angle_names), "translation": list(joints.translation_names),
        }  # fmt: skip
        about = {"method": self.methods[0], "rate_hz": self.rate, "anatomical": int(self.anatomical)}
        return xarray.Dataset(variables, coords=coordinates, attrs=about)

    def plot(self, names: str | Sequence[str] = "", *, level: float = 0.95, axes: Any = None) -> Any:
        """Draw joint angles over time, each with the interval of its values as a band.

        Args:
            names: A part of the names, for example "knee", or a list of angles; all angles by default.
            level: Probability of the interval.
            axes: Matplotlib's axes to draw on; new ones by default.

        Returns:
            The axes.

        Raises:
            UnknownName: There is no such angle.
            MissingPackage: Matplotlib is not installed.
        """
        return plot_curves(self.angles.matching(names), level=level, axes=axes)

    def save(self, folder: Path | str, *, progress: Progress | None = None) -> Path:
        """Write the files of `marey markers`: tables, C3D, report and run.json.

        A result that was read from a folder is copied from there.

        Args:
            folder: Folder for the files; it is created if it does not exist.
            progress: Progress reporter.

        Returns:
            The folder.
        """
        folder = Path(folder)
        if self.folder is not None:
            ResultFiles(self.folder).save(folder, file=_FILE)
        else:
            write_results(self, folder, progress or self.details.resumed_progress())
        return folder


def load_bones(folder: Path | str) -> Bones:
    """Read the results of `marey markers`, or of `Bones.save`.

    Args:
        folder: A folder with `bones.npz`, and the tables beside it.

    Returns:
        The result. Joint angles and the motion of the markers are those of the first method; the files of further
        methods have only the poses of the bones.

    Raises:
        FileProblem: A file is missing or damaged.

    Example:
        >>> import marey
        >>> bones = marey.load_bones("walk_marey")
        >>> bones.segments, bones.methods
        (('thigh', 'shank'), ('rigid',))
    """
    folder = Path(folder)
    if not (folder / _FILE).is_file():
        raise FileProblem(folder, "has no bones.npz", "Give a folder with the results of `marey markers`.")
    held = read_bones(folder / _FILE)
    details = RunDetails.read(folder, COMMAND, file=_FILE)
    listed = details.settings.get("methods", ())
    first, *others = [str(name) for name in listed] if isinstance(listed, Sequence) and listed else ["unknown"]
    tables = [folder / f"{name}.csv" for name in ("angles", "marker_motion", "events", "gait_cycles")]
    joints = read_joint_csv(tables[0]) if tables[0].is_file() else _no_joints(len(held.time))
    markers = read_marker_motion(tables[1]) if tables[1].is_file() else _no_markers(len(held.time))
    events = read_event_csv(tables[2]) if tables[2].is_file() else ()
    measures = read_gait_cycles_csv(tables[3]) if tables[3].is_file() else None
    repeated = folder / REPETITIONS_FILE
    given = read_given_angles(folder / GIVEN_ANGLES) if (folder / GIVEN_ANGLES).is_file() else None
    landmarks = read_landmark_motion(folder / LANDMARK_MOTION) if (folder / LANDMARK_MOTION).is_file() else None
    runs = [_run(first, held.motion, joints, markers, landmarks)]
    for name in others:
        motion = read_bones(folder / f"bones_{name}.npz").motion
        runs.append(_run(name, motion, _no_joints(len(motion)), _no_markers(len(motion))))
    return Bones(
        runs=tuple(runs), time=held.time, frames=_frames(details.settings, len(held.time)),
        gait=Gait(events=events, cycles=gait_cycles(events), measures=measures),
        repetitions=read_repetitions(repeated) if repeated.is_file() else Repetitions(),
        anatomical=any(key in details.settings for key in _ANATOMICAL), side=held.side,
        reference_frames=held.reference_frames, given_angles=given, details=details, folder=folder,
    )  # fmt: skip


def _agreement_text(rows: Sequence[GivenAgreement]) -> str:
    """Describe in one line how joint angles agree with those in the file."""
    known = [row.agreement for row in rows if np.isfinite(row.agreement.sd)]
    number = len({row.agreement.name for row in rows})
    if not known:
        return f"{count_of(number, 'angle')} in one frame"
    worst = max(known, key=lambda one: one.sd)
    middle = float(np.degrees(np.median([one.sd for one in known])))
    return (
        f"{count_of(number, 'angle')} of ours differ from them with a spread of {middle:.1f} degrees (median) about "
        f"the bias; largest {np.degrees(worst.sd):.1f} ({worst.name})"
    )


def _run(
    name: str, motion: BoneMotion, joints: JointKinematics, markers: MarkerMotion,
    landmarks: LandmarkMotion | None = None,
) -> MethodRun:  # fmt: skip
    summary = METHODS[name].summary if name in METHODS else ""
    return MethodRun(
        name=name, summary=summary, motion=motion, joints=joints, markers=markers, seconds=float("nan"),
        landmarks=landmarks or LandmarkMotion(),
    )  # fmt: skip


def _frames(settings: Any, count: int) -> Mask:
    """Return the frames (F,) that the settings in run.json select."""
    frames = np.ones(count, bool)
    limits = settings.get("frames")
    if isinstance(limits, list) and len(limits) == 2:
        frames[: int(limits[0])] = False
        frames[int(limits[1]) :] = False
    return frames


def _no_joints(frames: int) -> JointKinematics:
    none = np.zeros((frames, 0))
    return JointKinematics(
        angle_names=(), angles=none, angles_sd=none, translations=none, translations_sd=none
    )  # fmt: skip


def _no_markers(frames: int) -> MarkerMotion:
    return MarkerMotion(labels=(), segments=(), places=np.zeros((frames, 0, 3)))

"""A knee in motion, as a labelled result."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from marey.arrays import Floats, Mask
from marey.errors import FileProblem, SettingProblem
from marey.extras import import_optional
from marey.io.mr.knee_motion import read_knee_motion
from marey.knee.motion.joint_motion import KneeMotion
from marey.knee.motion.proximity import Proximity
from marey.markers.kinematics.joint_angles import JointKinematics
from marey.pipelines.knee.animation_results import AnimationResults, write_animation
from marey.pipelines.labelled import Curve, Curves, Described, Summary, find_name, plot_curves
from marey.pipelines.progress import Progress
from marey.pipelines.result_files import ResultFiles
from marey.pipelines.run_details import RunDetails
from marey.pipelines.verdict import Verdict
from marey.wording import count_of, listed

COMMAND = "knee animate"
"""The command that writes the same files."""
NO_POSE = "no pose"
"""The flag of a frame in which a bone has no pose."""
WITHIN_SD = "within its standard deviation"
"""The flag of a gap that is smaller than its standard deviation: whether the cartilages touch is not known."""
_FILE = "knee_motion.npz"
"""The file by which a folder of results is recognised."""
_MM = 1e3
"""Millimetres in a metre."""


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class AnimatedKnee(Described):
    """The bones and cartilages of a knee over an activity, and the distances between them.

    Quantities are found by name, with spaces or underscores. All properties are those of the first method; `method`
    returns the result of the one that it was compared with.

    Example:
        >>> import marey
        >>> moving = marey.animate_knee("bend/knee", "bend/motion", reference="bend/standing.c3d")
        >>> moving.gaps["tibiofemoral medial"].unit
        'mm'
    """

    found: KneeMotion
    """Motion, distances and angles by the method that was chosen."""
    compared: KneeMotion | None = None
    """The same by another method, for comparison."""
    details: RunDetails
    """Settings, inputs, warnings and times of the run."""
    results: AnimationResults | None = None
    """Everything that the files contain; None for a result that was read from a folder."""
    folder: Path | None = None
    """The folder from which the result was read."""

    @property
    def time(self) -> Floats:
        """(F,) time of each frame [s]."""
        return self.found.motion.time

    @property
    def moved(self) -> tuple[str, ...]:
        """Names of the B bones that are moved."""
        return self.found.motion.bones

    @property
    def side(self) -> str | None:
        """`left` or `right`; None if it is not known."""
        left = self.found.motion.left
        return None if left is None else "left" if left else "right"

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of the methods: the first one, and the one that it was compared with."""
        return tuple(each.method for each in self._motions())

    def method(self, name: str) -> "AnimatedKnee":
        """Return the same result with the values of another method.

        Args:
            name: One of `methods`.

        Raises:
            SettingProblem: The method was not run.
        """
        if name == self.found.method:
            return self
        if self.compared is None or name != self.compared.method:
            raise SettingProblem(f"The method {name!r} was not run. Methods that were run: {listed(self.methods)}.")
        return replace(self, found=self.compared, compared=self.found)

    @property
    def verdict(self) -> Verdict | None:
        """How far the result can be used, and what limits it; None for a result of an earlier version."""
        return self.details.verdict

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings of the run, one sentence each."""
        return self.details.warnings

    @property
    def gaps(self) -> Curves:
        """Least distance between the cartilages [mm] by joint and compartment, with standard deviations.

        A gap that is smaller than its standard deviation has the flag `within its standard deviation`.
        """

        def curve(name: str, joint: Proximity, c: int) -> Curve:
            flags = np.where(joint.unsure[:, c], WITHIN_SD, self._flags(joint.gap_mm[:, c]))
            return self._curve(name, joint.gap_mm[:, c], joint.gap_sd_mm[:, c], unit="mm", flags=flags)

        return self._compartments("gap", curve)

    @property
    def near_areas(self) -> Curves:
        """Area of the cartilage nearer than the limit [mm2] by joint and compartment, without standard deviations."""
        return self._compartments(
            "area", lambda name, joint, c: self._curve(name, joint.near_mm2[:, c], None, unit="mm2")
        )  # fmt: skip

    @property
    def centres(self) -> Curves:
        """Centre of proximity by joint and compartment, components x, y, z in the scanner [mm].

        The centre is that on the tibia or the patella. It is NaN where nothing is near.
        """
        return self._compartments(
            "centre",
            lambda name, joint, c: self._curve(
                name, joint.centre_mm[:, c], joint.centre_sd_mm[:, c], unit="mm", components="xyz"
            ),
        )

    @property
    def angles(self) -> Curves:
        """Joint angles by name [deg], with standard deviations; empty if the bones have no anatomical axes."""

        def curve(joints: JointKinematics, i: int) -> Curve:
            values, sd = np.degrees(joints.angles[:, i]), np.degrees(joints.angles_sd[:, i])
            return self._curve(joints.angle_names[i], values, sd, unit="deg")

        joints = self.found.angles
        return _of_joints("angle", () if joints is None else joints.angle_names, joints, curve)

    @property
    def translations(self) -> Curves:
        """Joint translations by name [mm], with standard deviations; empty if the bones have no anatomical axes."""

        def curve(joints: JointKinematics, i: int) -> Curve:
            values, sd = _MM * joints.translations[:, i], _MM * joints.translations_sd[:, i]
            return self._curve(joints.translation_names[i], values, sd, unit="mm")

        joints = self.found.angles
        return _of_joints("translation", () if joints is None else joints.translation_names, joints, curve)

    def pose(self, bone: str) -> Floats:
        """Return the pose of a bone in the laboratory.

        Args:
            bone: One of `moved`.

        Returns:
            (F, 4, 4) laboratory from scanner [mm]; NaN in frames without a pose.

        Raises:
            UnknownName: The bone is not moved.
        """
        return self.found.motion.poses[self.moved[find_name(bone, self.moved, kind="moved bone")]].matrix()

    def answered(self, bone: str) -> Mask:
        """Return the frames in which a bone has a pose.

        Args:
            bone: One of `moved`.

        Returns:
            (F,) true where it has one.

        Raises:
            UnknownName: The bone is not moved.
        """
        return self.found.motion.answered(self.moved[find_name(bone, self.moved, kind="moved bone")])

    def _motions(self) -> tuple[KneeMotion, ...]:
        return (self.found,) if self.compared is None else (self.found, self.compared)

    def _compartments(self, kind: str, curve: Callable[[str, Proximity, int], Curve]) -> Curves:
        """Return one curve per joint and compartment."""
        each = [(joint, c) for joint in self.found.joints for c in range(len(joint.compartments))]
        names = [f"{joint.name}_{joint.compartments[c]}" for joint, c in each]
        return Curves(kind, names, lambda i: curve(names[i], *each[i]))

    def _flags(self, values: Floats) -> np.ndarray:
        """Return the flag of each value (F,): `no pose` where a moved bone that it depends on has none."""
        posed = np.all([self.found.motion.answered(bone) for bone in self.moved], axis=0)
        unknown = np.isnan(values).reshape(len(self), -1).all(axis=1)
        return np.where(unknown & ~posed, NO_POSE, "")

    def _curve(
        self, name: str, values: Floats, sd: Floats | None, *, unit: str, components: Sequence[str] = (),
        flags: np.ndarray | None = None,
    ) -> Curve:  # fmt: skip
        return Curve(
            name=name, time=self.time, values=values, sd=sd, unit=unit, components=tuple(components),
            flags=tuple(map(str, self._flags(values) if flags is None else flags)),
        )  # fmt: skip

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.time)

    def summary(self) -> Summary:
        """Return a line per joint and compartment with the gap between its cartilages."""
        lines = {}
        for each in self._motions():
            for joint in each.joints:
                for c, name in enumerate(joint.compartments):
                    known = np.isfinite(joint.gap_mm[:, c])
                    if known.any():
                        gap, sd = joint.gap_mm[known, c], joint.gap_sd_mm[known, c]
                        spread = f", standard deviation {np.median(sd):.1f}" if np.isfinite(sd).all() else ""
                        lines[f"{each.method}: {joint.name}, {name}"] = (
                            f"gap {np.median(gap):.1f} mm (median{spread}), from {gap.min():.1f} to {gap.max():.1f} mm"
                        )
        return Summary(f"Moving knee, {count_of(len(self), 'frame')}: {', '.join(self.moved)}", lines)

    def to_xarray(self) -> Any:
        """Return the curves and the poses of the bones as an `xarray.Dataset`.

        Raises:
            MissingPackage: xarray is not installed.
        """
        xarray = import_optional("xarray", extra="xarray", purpose="Labelled arrays")
        variables: dict[str, Any] = {
            "laboratory_from_scanner": (
                ("time", "bone", "row", "column"), np.stack([self.pose(bone) for bone in self.moved], 1),
                {"units": "mm"},
            )
        }  # fmt: skip
        kinds = {
            "gap": self.gaps, "near_area": self.near_areas, "centre": self.centres, "angle": self.angles,
            "translation": self.translations,
        }  # fmt: skip
        for kind, curves in kinds.items():
            for curve in curves.values():
                dimensions = ("time", "space") if curve.components else ("time",)
                variables[f"{kind}_{curve.name}"] = (dimensions, curve.values, {"units": curve.unit})
                if curve.sd is not None:
                    variables[f"{kind}_{curve.name}_sd"] = (dimensions, curve.sd, {"units": curve.unit})
        coordinates = {"time": ("time", self.time, {"units": "s"}), "bone": list(self.moved), "space": list("xyz")}
        about = {"method": self.found.method, "side": self.side or "unknown"}
        return xarray.Dataset(variables, coords=coordinates, attrs=about)

    def plot(self, names: str | Sequence[str] = "", *, level: float = 0.95, axes: Any = None) -> Any:
        """Draw the gaps between the cartilages over time, each with the interval of its values as a band.

        Args:
            names: A part of the names, for example "medial", or a list of gaps; all gaps by default.
            level: Probability of the interval.
            axes: Matplotlib's axes to draw on; new ones by default.

        Returns:
            The axes.

        Raises:
            UnknownName: There is no such gap.
            MissingPackage: Matplotlib is not installed.
        """
        return plot_curves(self.gaps.matching(names), level=level, axes=axes)

    def save(self, folder: Path | str, *, progress: Progress | None = None) -> Path:
        """Write the files of `marey knee animate`: numbers, tables, GLB, video, page and run.json.

        A result that was read from a folder is copied from there. The files are those of the run, with its first method
        first.

        Args:
            folder: Folder for the files; it is created if it does not exist.
            progress: Progress reporter.

        Returns:
            The folder.
        """
        folder = Path(folder)
        if self.results is None:
            ResultFiles(self.folder or folder).save(folder, file=_FILE)
        else:
            write_animation(self.results, self.details, folder, progress or self.details.resumed_progress())
        return folder


def _of_joints(
    kind: str, names: Sequence[str], joints: JointKinematics | None, curve: Callable[[JointKinematics, int], Curve]
) -> Curves:
    def make(i: int) -> Curve:
        assert joints is not None
        return curve(joints, i)

    return Curves(kind, names, make)


def load_animated_knee(folder: Path | str) -> AnimatedKnee:
    """Read the results of `marey knee animate`, or of `AnimatedKnee.save`.

    Args:
        folder: A folder with `knee_motion.npz`.

    Returns:
        The moving knee. Distances between the cartilages are rounded to 0.001 mm, as in the file.

    Raises:
        FileProblem: The file is missing or damaged.

    Example:
        >>> import marey
        >>> moving = marey.load_animated_knee("bend/motion/knee")
        >>> moving.moved, moving.side
        (('femur', 'tibia'), 'right')
    """
    folder = Path(folder)
    if not (folder / _FILE).is_file():
        raise FileProblem(folder, f"has no {_FILE}", "Give a folder with the results of `marey knee animate`.")
    found, compared = read_knee_motion(folder / _FILE)
    details = RunDetails.read(folder, COMMAND, file=_FILE)
    return AnimatedKnee(found=found, compared=compared, details=details, folder=folder)

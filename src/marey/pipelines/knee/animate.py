"""A knee's bones and cartilage from MR, moved by an activity in the laboratory."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem, MareyError, SettingProblem
from marey.extras import import_optional
from marey.io.markers.activity import first_method, laboratory_is_y_up, read_activity
from marey.io.markers.readers import read_markers
from marey.io.mr.meshes import read_mesh
from marey.io.mr.scanner_markers import read_landmarks, read_scanner_markers
from marey.knee.markers.anatomical_frames import Landmarks
from marey.knee.markers.correspondence import KneeCorrespondence, bone_chain, correspond
from marey.knee.markers.marker_naming import ScannerMarkers
from marey.knee.markers.reference_posture import NOISE_MM, Activity, reference_posture
from marey.knee.motion.joint_motion import (
    BASE,
    JointMotion,
    KneeMotion,
    joint_proximities,
    joint_sides,
    knee_angles,
    motion_of_chains,
    packed_joints,
    unpacked_joints,
)
from marey.knee.motion.joint_surface import JointSurface
from marey.knee.motion.proximity import LIMIT_MM
from marey.knee.space.sides import is_left
from marey.knee.space.structures import BONE_OF_CARTILAGE, BONES, LABELS
from marey.knee.space.surface import TriangleSurface
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.kinematics.joint_angles import JointKinematics
from marey.pipelines.knee.animation_results import AnimationResults, write_animation
from marey.pipelines.knee.knee import Knee
from marey.pipelines.labelled import Curve, Curves, Described, Summary, count_of, plot_curves
from marey.pipelines.markers.bones import Bones
from marey.pipelines.progress import Progress, RecordingProgress
from marey.pipelines.run_details import RunDetails, checkpoints
from marey.pipelines.run_record import StageCache, fingerprint
from marey.pipelines.values import PathLike, issue_warnings, optional_path
from marey.view.pictures.knee_picture import DEFAULT_VIEWS, VIEWS

FRAMES = ("tibia", "room")
"""Names of what is held in place in video and GLB: the tibia, or nothing."""
COMMAND = "knee animate"
"""The command that writes the same files."""


@dataclass(frozen=True, eq=False, kw_only=True)
class AnimateSettings:
    """Settings of the motion and the drawing of a knee.

    Raises:
        SettingProblem: A value is impossible.
    """

    reference: Path | None = None
    """Trial of the person standing, with the markers of the scanner and of the activity."""
    method: str | None = None
    """Method whose bones are used, if `marey markers` ran several; None for the first."""
    compare: str | None = None
    """Another method, or another folder of `marey markers`, for comparison."""
    landmarks: Path | None = None
    """Landmarks picked in the images of the scanner, for the axes of the angles."""
    side: str | None = None
    """`left` or `right`; None if the patella, or the names of the segments, decide."""
    frame: str = "tibia"
    """What is held in place in video and GLB; one of `FRAMES`."""
    views: tuple[str, ...] = DEFAULT_VIEWS
    """Views of the video."""
    limit_mm: float = LIMIT_MM
    """Distance below which two cartilages count as near [mm]."""
    noise_mm: float = NOISE_MM
    """Standard deviation of a marker's coordinate in the laboratory, including its attachment [mm]."""

    def __post_init__(self) -> None:
        if self.side not in (None, "left", "right"):
            raise SettingProblem(f"side (--side) is '{self.side}'; it should be left or right.")
        if self.frame not in FRAMES:
            raise SettingProblem(f"frame (--frame) is '{self.frame}'; it should be tibia or room.")
        unknown = [view for view in self.views if view not in VIEWS]
        if unknown or not self.views:
            raise SettingProblem(f"view (--view) is '{','.join(unknown)}'; it should be some of {', '.join(VIEWS)}.")
        if not self.limit_mm > 0:
            raise SettingProblem(f"limit (--limit) is {self.limit_mm:g}; it should be a length above 0 mm.")
        if not 0 < self.noise_mm < 100:
            raise SettingProblem(
                f"noise (--noise) is {self.noise_mm:g}; it should be a length above 0 and below 100 mm."
            )


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class AnimatedKnee(AnimationResults, Described):
    """The bones and cartilages of a knee over an activity, and the distances between them.

    Example:
        >>> import marey
        >>> moving = marey.animate_knee("bend/knee", "bend/motion", reference="bend/standing.c3d")
        >>> moving.gaps["tibiofemoral medial"].unit
        'mm'
    """

    @property
    def time(self) -> Floats:
        """(F,) time of each frame [s]."""
        return self.found.motion.time

    @property
    def moved(self) -> tuple[str, ...]:
        """Names of the bones that are moved."""
        return self.found.motion.bones

    @property
    def gaps(self) -> Curves:
        """Least distance between the cartilages [mm] by joint and compartment, with standard deviations."""
        each = [(joint, c) for joint in self.found.joints for c in range(len(joint.compartments))]

        def curve(i: int) -> Curve:
            joint, c = each[i]
            return Curve(
                name=names[i], time=self.time, values=joint.gap_mm[:, c], sd=joint.gap_sd_mm[:, c], unit="mm"
            )  # fmt: skip

        names = [f"{joint.name}_{joint.compartments[c]}" for joint, c in each]
        return Curves("gap", names, curve)

    @property
    def angles(self) -> Curves:
        """Joint angles by name [deg], with standard deviations; empty if the bones have no anatomical axes."""
        joints = self.found.angles
        names = () if joints is None else joints.angle_names

        def curve(i: int) -> Curve:
            assert joints is not None
            return Curve(
                name=names[i], time=self.time, values=np.degrees(joints.angles[:, i]),
                sd=np.degrees(joints.angles_sd[:, i]), unit="deg",
            )  # fmt: skip

        return Curves("angle", names, curve)

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.time)

    def summary(self) -> Summary:
        """Return a line per joint and compartment with the gap between its cartilages."""
        lines = {}
        for each in _both(self.found, self.compared):
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
        """Return gaps, angles and the poses of the bones as an `xarray.Dataset`.

        Raises:
            MissingPackage: xarray is not installed.
        """
        xarray = import_optional("xarray", extra="xarray", purpose="Labelled arrays")
        variables: dict[str, Any] = {
            "laboratory_from_scanner": (
                ("time", "bone", "row", "column"),
                np.stack([pose.matrix() for pose in self.found.motion.poses.values()], 1), {"units": "mm"},
            )
        }  # fmt: skip
        for kind, curves in (("gap", self.gaps), ("angle", self.angles)):
            for curve in curves.values():
                variables[f"{kind}_{curve.name}"] = ("time", curve.values, {"units": curve.unit})
                variables[f"{kind}_{curve.name}_sd"] = ("time", curve.sd, {"units": curve.unit})
        coordinates = {"time": ("time", self.time, {"units": "s"}), "bone": list(self.moved)}
        return xarray.Dataset(variables, coords=coordinates, attrs={"method": self.found.method})

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

        Args:
            folder: Folder for the files; it is created if it does not exist.
            progress: Progress reporter.

        Returns:
            The folder.
        """
        write_animation(self, Path(folder), progress or self.details.resumed_progress())
        return Path(folder)


@dataclass(frozen=True, eq=False, kw_only=True)
class _ScannedKnee:
    """Structures and markers of a knee in the scanner."""

    folder: Path
    parts: Mapping[str, TriangleSurface]
    markers: ScannerMarkers
    landmarks: Landmarks | None
    left: bool | None

    @property
    def bones(self) -> dict[str, TriangleSurface]:
        return {name: part for name, part in self.parts.items() if name in BONES}


@dataclass(frozen=True, eq=False, kw_only=True)
class _Joining:
    """Everything to which the motion of each method is related."""

    knee: _ScannedKnee
    sides: Mapping[str, JointSurface]
    standing: MarkerTrajectories | None
    limit_mm: float
    noise_mm: float


def animate_knee(
    knee: PathLike | Knee,
    motion: PathLike | Bones,
    *,
    reference: PathLike | None = None,
    method: str | None = None,
    compare: str | None = None,
    landmarks: PathLike | None = None,
    side: str | None = None,
    frame: str = "tibia",
    views: Sequence[str] = DEFAULT_VIEWS,
    limit_mm: float = LIMIT_MM,
    noise_mm: float = NOISE_MM,
    out: PathLike | None = None,
    progress: Progress | None = None,
) -> AnimatedKnee:
    """Move a knee's bones and cartilage as in an activity, and measure the distance between the cartilages.

    The gadolinium markers of the knee and the markers of the laboratory relate scanner and laboratory.

    Args:
        knee: The segmented knee with its markers, or its folder.
        motion: The motion of the bones beneath skin markers, or its folder.
        reference: Trial of the person standing, with the markers of the scanner and of the activity.
        method: Method whose bones are used, if several were run; the first by default.
        compare: Another method, or another folder of `marey markers`, for comparison.
        landmarks: Landmarks picked in the images of the scanner, for the axes of the angles.
        side: `left` or `right`; by default the patella, or the names of the segments, decide.
        frame: Frame of reference of video and GLB: `tibia`, or `room` (all bones move).
        views: Views of the video: anterior, posterior, medial, lateral, plateau.
        limit_mm: Distance below which two cartilages count as near [mm].
        noise_mm: Standard deviation of a marker's coordinate in the laboratory, including its attachment [mm].
        out: Folder for the results. If it is given, the files of `marey knee animate` are written there, and an
            interrupted run can be resumed by the same call; otherwise nothing is written.
        progress: Progress reporter; by default nothing is shown, and the warnings of the run are issued as Python
            warnings of the category `marey.MareyWarning`.

    Returns:
        The moving knee.

    Raises:
        FileProblem: A file cannot be used.
        SettingProblem: A value is impossible.
        MareyError: Scanner and laboratory cannot be related.

    Example:
        >>> import marey
        >>> moving = marey.animate_knee("bend/knee", "bend/motion", reference="bend/standing.c3d")
        >>> moving.moved
        ('femur', 'tibia')
    """
    settings = AnimateSettings(
        reference=optional_path(reference), method=method, compare=compare, landmarks=optional_path(landmarks),
        side=side, frame=frame, views=tuple(views), limit_mm=limit_mm, noise_mm=noise_mm,
    )  # fmt: skip
    folder = None if out is None else Path(out)
    reporter = RecordingProgress() if progress is None else progress
    with _in_folder(knee) as knee_folder, _in_folder(motion) as motion_folder:
        moving = _animated(knee_folder, motion_folder, settings, folder, reporter)
    if progress is None:
        issue_warnings(reporter)
    return moving


@contextmanager
def _in_folder(result: PathLike | Knee | Bones) -> Iterator[Path]:
    """Yield the folder of a result; one that was not saved is written to a temporary folder."""
    if isinstance(result, str | Path):
        yield Path(result)
    elif result.folder is not None:
        yield result.folder
    else:
        with TemporaryDirectory(prefix="marey-") as folder:
            yield result.save(Path(folder) / type(result).__name__.lower())


def _animated(
    knee_folder: Path, motion_folder: Path, settings: AnimateSettings, out: Path | None, progress: Progress
) -> AnimatedKnee:
    with progress.stage("Reading"):
        activity = read_activity(motion_folder, method=settings.method)
        other = _compared(motion_folder, settings)
        knee = _read_knee(knee_folder, activity, motion_folder, settings)
        standing = None if settings.reference is None else read_markers(settings.reference)
    if other is not None and len(other.time) != len(activity.time):
        wrong = f"has {len(other.time)} frames, and the activity {len(activity.time)}"
        raise FileProblem(Path(str(settings.compare)), wrong, "Compare results of the same trial.")
    files = _files(knee, motion_folder, settings)
    with checkpoints(out, files) as cache:
        sides, notes = joint_sides(knee.parts, tuple(knee.bones), left=knee.left)
        for note in notes:
            progress.warn(note)
        joining = _Joining(
            knee=knee, sides=sides, standing=standing, limit_mm=settings.limit_mm, noise_mm=settings.noise_mm
        )  # fmt: skip
        reference = settings.reference or motion_folder
        joined = _joined(joining, activity, reference)
        _report_joined(joined, progress)
        found = _moved(joining, joined, activity, settings.method or first_method(motion_folder), progress, cache)
        compared = None
        if other is not None:
            with_other = _joined(joining, other, reference)
            compared = _moved(joining, with_other, other, _name_of(settings), progress, cache)
        _warn_of_limits(found, compared, joined, knee, progress)
        moving = AnimatedKnee(
            title=f"{knee_folder.resolve().name} by {motion_folder.resolve().name}", parts=knee.parts, found=found,
            compared=compared, joined=joined, in_room=settings.frame == "room" or BASE not in found.motion.poses,
            y_up=laboratory_is_y_up(motion_folder), views=settings.views, limit_mm=settings.limit_mm,
            details=RunDetails.of(COMMAND, _about(settings, found, knee), files, knee_folder.parent, progress),
        )  # fmt: skip
        if out is not None:
            moving.save(out, progress=progress)
    return moving


def _read_knee(folder: Path, activity: Activity, motion_folder: Path, settings: AnimateSettings) -> _ScannedKnee:
    """Read the structures and markers of the scanned knee, and find its side."""
    if not folder.is_dir():
        raise FileProblem(folder, "is not a folder", "Give a folder with the results of `marey knee segment`.")
    parts = {name: read_mesh(folder / f"{name}.ply") for name in LABELS if (folder / f"{name}.ply").is_file()}
    parts = {name: part for name, part in parts.items() if BONE_OF_CARTILAGE.get(name, name) in parts}
    missing = [bone for bone in ("femur", "tibia") if bone not in parts]
    if missing:
        wrong = f"has no {' and no '.join(f'{bone}.ply' for bone in missing)}"
        raise FileProblem(folder, wrong, "Give a folder with the results of `marey knee segment`.")
    own = is_left({name: part for name, part in parts.items() if name in BONES})
    return _ScannedKnee(
        folder=folder, parts=parts, markers=read_scanner_markers(folder / "markers.json"),
        landmarks=None if settings.landmarks is None else read_landmarks(settings.landmarks),
        left=_side(own, activity, motion_folder, settings),
    )  # fmt: skip


def _side(own: bool | None, activity: Activity, motion_folder: Path, settings: AnimateSettings) -> bool | None:
    """Return whether it is a left knee: as given, by the place of the patella, or by the names of the segments."""
    if settings.side is not None:
        return settings.side == "left"
    named = {True for name in activity.motion.segments if name.startswith("left_")}
    named |= {False for name in activity.motion.segments if name.startswith("right_")}
    if activity.side is not None:
        named.add(activity.side == "left")
    if own is not None and named and own not in named:
        words = {True: "left", False: "right"}
        raise FileProblem(
            motion_folder, f"has the bones of the {words[not own]} leg, but the scanned knee is a {words[own]} one",
            "Give the motion of that leg, or side (--side) if the position of the patella is misleading.",
        )  # fmt: skip
    if own is not None:
        return own
    return next(iter(named)) if len(named) == 1 else None


def _compared(folder: Path, settings: AnimateSettings) -> Activity | None:
    """Read the motion to compare with: another method of the same run, or the folder of another run."""
    if settings.compare is None:
        return None
    path = Path(settings.compare)
    if path.is_dir():
        return read_activity(path)
    return read_activity(folder, method=settings.compare)


def _name_of(settings: AnimateSettings) -> str:
    path = Path(str(settings.compare))
    return first_method(path) if path.is_dir() else str(settings.compare)


def _joined(joining: _Joining, activity: Activity, reference: Path) -> KneeCorrespondence:
    """Relate scanner and laboratory by their common markers."""
    knee = joining.knee
    posture = reference_posture(activity, joining.standing, noise_mm=joining.noise_mm)
    try:
        return correspond(
            knee.markers, posture, knee.bones,
            segment_of_label=activity.segment_of_label, left=knee.left, landmarks=knee.landmarks,
        )  # fmt: skip
    except MareyError as problem:
        raise FileProblem(knee.folder / "markers.json", f"cannot be related to {reference}", str(problem)) from problem


def _report_joined(joined: KneeCorrespondence, progress: Progress) -> None:
    for note in joined.notes:
        progress.warn(note)
    for bone, each in joined.bones.items():
        for note in each.notes:
            progress.warn(f"{bone}: {note}")
    for bone, why in joined.missing.items():
        if bone != "patella":  # a later warning has the consequences
            progress.warn(f"The {bone} is not moved: {why}.")


def _moved(
    joining: _Joining, joined: KneeCorrespondence, activity: Activity, name: str, progress: Progress, cache: StageCache
) -> KneeMotion:
    """Measure the motion of one method, or read the checkpoint of an interrupted run."""
    chains = {bone: bone_chain(each, activity.motion, activity.cluster) for bone, each in joined.bones.items()}
    motion = motion_of_chains(chains, activity.time, left=joining.knee.left)
    if not any(motion.answered(bone).any() for bone in motion.bones):
        raise MareyError(f"No frame of the activity has a pose of the {' or the '.join(motion.bones)}.")
    with progress.stage_of_shares(f"Distances ({name})") as done:

        def compute() -> dict[str, np.ndarray]:
            return packed_joints(joint_proximities(motion, joining.sides, limit_mm=joining.limit_mm, done=done))

        poses = [(pose.rotation, pose.translation, pose.covariance) for pose in motion.poses.values()]
        arrays = cache.arrays(
            f"nearness-{fingerprint(name)}", compute, depends=(joining.limit_mm, motion.bones, poses)
        )  # fmt: skip
    joints = unpacked_joints(arrays, joining.sides)
    return KneeMotion(method=name, motion=motion, joints=joints, angles=_angles(joined, motion, progress))


def _angles(joined: KneeCorrespondence, motion: JointMotion, progress: Progress) -> JointKinematics | None:
    """Return the knee's angles if the bones' frames are anatomical; warn if they are not."""
    plain = [bone for bone, each in joined.bones.items() if each.frame_source.startswith("the markers")]
    if set(plain) & {"femur", "tibia"}:
        listed = " and the ".join(plain)
        text = f"No joint angles: the {listed} has only a frame from its markers. Add landmarks (--landmarks)."
        if text not in progress.warnings:
            progress.warn(text)
        return None
    return knee_angles(motion)


def _warn_of_limits(
    found: KneeMotion, compared: KneeMotion | None, joined: KneeCorrespondence, knee: _ScannedKnee, progress: Progress
) -> None:
    """Warn of everything that limits the meaning of the numbers."""
    motion = found.motion
    if knee.left is None:
        progress.warn(
            "The side of the knee is not known: only distances of the whole joint are measured. Give side (--side)."
        )
    for bone in motion.bones:
        lacking = int((~motion.answered(bone)).sum())
        if lacking:
            progress.warn(f"The {bone} has no pose in {lacking} of {len(motion)} frames; the results have gaps there.")
    if "patella" in knee.parts and "patella" not in motion.poses:
        why = joined.missing.get("patella", "it was not measured")
        progress.warn(
            f"The patella is not moved: {why}. It is missing from all numbers, the video and the GLB. The page "
            "can show it at its position relative to the femur in the scanner."
        )
    if not found.joints:
        progress.warn("No two bones of a joint were measured: there are no distances.")
    for joint in found.joints:
        for c, name in enumerate(joint.compartments):
            if np.isfinite(joint.base_distance_mm).any() and not np.isfinite(joint.gap_mm[:, c]).any():
                what = joint.base.name.replace("_", " ")
                progress.warn(f"There is no {what} on the {name} side, and therefore no gap.")
    for each in _both(found, compared):
        for joint in each.joints:
            for c, name in enumerate(joint.compartments):
                share = joint.unsure[:, c].sum() / max(np.isfinite(joint.gap_mm[:, c]).sum(), 1)
                if share > 0:
                    progress.warn(
                        f"{each.method}: the {joint.name} gap, {name}, is smaller than its standard deviation in "
                        f"{100 * share:.0f} % of the frames."
                    )


def _both(found: KneeMotion, compared: KneeMotion | None) -> list[KneeMotion]:
    return [found] if compared is None else [found, compared]


def _files(knee: _ScannedKnee, motion_folder: Path, settings: AnimateSettings) -> list[Path]:
    """List the files that were read."""
    files = [knee.folder / f"{name}.ply" for name in knee.parts]
    files.append(knee.folder / "markers.json")
    folders = [motion_folder]
    if settings.compare is not None and Path(settings.compare).is_dir():
        folders.append(Path(settings.compare))
    for folder in folders:
        files += [*sorted(folder.glob("bones*.npz")), folder / "motion.c3d", folder / "marker_motion.csv"]
    return [*files, *(path for path in (settings.reference, settings.landmarks) if path is not None)]


def _about(settings: AnimateSettings, found: KneeMotion, knee: _ScannedKnee) -> dict[str, object]:
    given = {key: value for key, value in vars(settings).items() if value is not None}
    side = {None: "unknown", True: "left", False: "right"}[knee.left]
    return {**given, "views": list(settings.views), "method": found.method, "side": side}

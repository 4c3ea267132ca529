"""Motion of a knee's bones and cartilage from MR in an activity of the laboratory."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from marey.errors import FileProblem, MareyError, SettingProblem, naming
from marey.io.markers.activity import first_method, laboratory_is_y_up, read_activity
from marey.io.markers.readers import read_markers
from marey.knee.markers.bend_checks import bends_of
from marey.knee.markers.correspondence import KneeCorrespondence, bone_chain, correspond
from marey.knee.markers.marker_repairs import Correspondents
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
from marey.knee.motion.proximity import LIMIT_MM, Proximity
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.kinematics.joint_angles import JointKinematics
from marey.pipelines.causes.knee_markers import (
    explained,
    other_leg_reasons,
    reference_reasons,
    repaired_reasons,
    unexplained_reasons,
)
from marey.pipelines.consistency.unusable import UnusableRun, with_unusable_page
from marey.pipelines.knee.animated_knee import COMMAND, AnimatedKnee
from marey.pipelines.knee.animation_results import RESULTS, AnimationResults
from marey.pipelines.knee.found_knee import LONG_BONES, UNKNOWN_SIDE
from marey.pipelines.knee.knee import Knee
from marey.pipelines.knee.scanned_knee import ScannedKnee, read_scanned_knee
from marey.pipelines.markers.bones import Bones
from marey.pipelines.progress import Progress, RecordingProgress
from marey.pipelines.run_details import RunDetails, checkpoints
from marey.pipelines.run_record import StageCache, fingerprint
from marey.pipelines.values import PathLike, issue_warnings, optional_path
from marey.pipelines.verdict import NotUsable, Verdict, VerdictReason, without_result
from marey.view.pictures.knee_picture import DEFAULT_VIEWS, VIEWS

FRAMES = ("tibia", "room")
"""Names of what is held in place in video and GLB: the tibia, or nothing."""
_NOT_MOVED = (
    "Nothing was moved: the verdict states why the balls of the scanner and the markers of the laboratory do not give "
    "the motion of the bones. After the cause is removed, run the same command again."
)
"""What the page of an unusable run explains."""
_NO_POSES = "Give a motion in which femur or tibia have poses: look at the gaps in the report of `marey markers`."
"""What to do where the activity gives no pose of the bones."""


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
        if not 0 < self.limit_mm < 100:
            raise SettingProblem(
                f"limit (--limit) is {self.limit_mm:g}; it should be a length above 0 and below 100 mm."
            )
        if not 0 < self.noise_mm < 100:
            raise SettingProblem(
                f"noise (--noise) is {self.noise_mm:g}; it should be a length above 0 and below 100 mm."
            )


@dataclass(frozen=True, eq=False, kw_only=True)
class _Joining:
    """Everything to which the motion of each method is related."""

    knee: ScannedKnee
    sides: Mapping[str, JointSurface]
    standing: MarkerTrajectories | None
    reference: Path | None
    """The file of the standing trial."""
    motion_folder: Path
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
        NotUsable: A cause explains why they cannot, such as a wrong unit or a mirror image.

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
        knee = read_scanned_knee(knee_folder, activity, landmarks=settings.landmarks, side=settings.side)
        standing = None if settings.reference is None else read_markers(settings.reference)
    if settings.compare is not None and settings.compare == (settings.method or first_method(motion_folder)):
        wrong = f"compare (--compare) is '{settings.compare}', the method that is shown already"
        raise SettingProblem(f"{wrong}; it should be another method, or another folder.")
    if other is not None and len(other.time) != len(activity.time):
        wrong = f"has {len(other.time)} frames, and the activity {len(activity.time)}"
        raise FileProblem(Path(str(settings.compare)), wrong, "Compare results of the same trial.")
    files = _files(knee, motion_folder, settings)
    title = f"{knee_folder.resolve().name} by {motion_folder.resolve().name}"
    with checkpoints(out, files, results=RESULTS) as cache:
        sides, notes = joint_sides(knee.parts, tuple(knee.bones), left=knee.left)
        for note in notes:
            progress.warn(note)
        joining = _Joining(
            knee=knee, sides=sides, standing=standing, reference=settings.reference, motion_folder=motion_folder,
            limit_mm=settings.limit_mm, noise_mm=settings.noise_mm,
        )  # fmt: skip
        compared = None
        with with_unusable_page(out, partial(_unusable, title, settings, knee, files), progress):
            joined, reasons = _joined(joining, activity)
            with_other = None if other is None else _joined(joining, other)
            _report_joined(joined, progress)
            found = _moved(joining, joined, activity, settings.method or first_method(motion_folder), progress, cache)
        if other is not None and with_other is not None:
            reasons += with_other[1]
            compared = _moved(joining, with_other[0], other, _name_of(settings), progress, cache)
        _warn_of_limits(found, compared, joined, knee, progress)
        results = AnimationResults(
            title=title, parts=knee.parts, found=found, compared=compared, joined=joined,
            in_room=settings.frame == "room" or BASE not in found.motion.poses, y_up=laboratory_is_y_up(motion_folder),
            views=settings.views, limit_mm=settings.limit_mm,
        )  # fmt: skip
        details = RunDetails.of(
            COMMAND, _about(settings, found.method, knee), files, knee_folder.parent, progress,
            verdict=animation_verdict(found, joined, knee.parts, reasons),
        )  # fmt: skip
        moving = AnimatedKnee(found=found, compared=compared, details=details, results=results)
        if out is not None:
            moving.save(out, progress=progress)
    return moving


def _unusable(
    title: str, settings: AnimateSettings, knee: ScannedKnee, files: Sequence[Path], verdict: Verdict
) -> UnusableRun:
    """Describe a run whose markers do not relate scanner and laboratory."""
    return UnusableRun(
        command=COMMAND, kind="A scanned knee in motion", title=title, page="knee.html", happened=_NOT_MOVED,
        settings=_about(settings, settings.method, knee), inputs=files, root=knee.folder.parent, verdict=verdict,
    )  # fmt: skip


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


def _joined(joining: _Joining, activity: Activity) -> tuple[KneeCorrespondence, tuple[VerdictReason, ...]]:
    """Relate scanner and laboratory by their common markers, and name what contradicts the relation.

    Raises:
        FileProblem: They cannot be related.
        NotUsable: A cause explains why balls and markers do not correspond.
    """
    knee, reference = joining.knee, joining.reference or joining.motion_folder
    reasons = () if joining.standing is None else reference_reasons(reference.name, joining.standing, activity)
    if explained(reasons):
        raise NotUsable(Verdict.of(reasons))
    with naming(reference):
        posture = reference_posture(activity, joining.standing, noise_mm=joining.noise_mm)
    side = not knee.left if knee.other_leg else knee.left
    given = Correspondents(
        scanner=knee.markers, posture=posture, bones=knee.bones, segment_of_label=activity.segment_of_label,
        left=side, bends=bends_of(activity, posture, left=side),
    )  # fmt: skip
    if knee.other_leg:
        causes = other_leg_reasons(given, joining.motion_folder.name, scanned_left=bool(knee.left))
    else:
        causes = repaired_reasons(given)
    if not Verdict.of(causes).usable:
        raise NotUsable(Verdict.of(causes))
    try:
        found = correspond(
            knee.markers, posture, knee.bones,
            segment_of_label=activity.segment_of_label, left=knee.left, landmarks=knee.landmarks,
        )  # fmt: skip
    except MareyError as problem:
        raise FileProblem(knee.folder / "markers.json", f"cannot be related to {reference}", str(problem)) from problem
    return found, (*reasons, *causes, *unexplained_reasons(given))


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
        what = f"No frame of the activity has a pose of the {' or the '.join(motion.bones)}."
        raise NotUsable(Verdict.of([VerdictReason.failure(what, _NO_POSES, cause="no poses")]))
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
    found: KneeMotion, compared: KneeMotion | None, joined: KneeCorrespondence, knee: ScannedKnee, progress: Progress
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
    for each in (found,) if compared is None else (found, compared):
        for joint in each.joints:
            for c, name in enumerate(joint.compartments):
                share = joint.unsure[:, c].sum() / max(np.isfinite(joint.gap_mm[:, c]).sum(), 1)
                if share > 0:
                    progress.warn(
                        f"{each.method}: the {joint.name} gap, {name}, is smaller than its standard deviation in "
                        f"{100 * share:.0f} % of the frames."
                    )


def animation_verdict(
    found: KneeMotion, joined: KneeCorrespondence, wanted: Mapping[str, object],
    contradictions: Sequence[VerdictReason] = (),
) -> Verdict:  # fmt: skip
    """Return the verdict on a knee in motion.

    Args:
        found: Motion and distances.
        joined: The relation between scanner and laboratory.
        wanted: The surfaces of the scanned knee by name.
        contradictions: What contradicts the relation between scanner and laboratory.
    """
    motion = found.motion
    still = [bone for bone in (*LONG_BONES, "patella") if bone in wanted and bone not in motion.poses]
    still += [bone for bone in LONG_BONES if bone not in wanted]
    reasons = [*contradictions, *(_still(bone, joined) for bone in still)]
    for bone in motion.bones:
        lacking = int((~motion.answered(bone)).sum())
        reasons += without_result(lacking, len(motion), f"have no pose of the {bone}", "Fill the gaps of the markers.")
    for bone, each in joined.bones.items():
        reasons += [VerdictReason.limit(f"The {bone}: {note}.") for note in each.fit.notes]
    if motion.left is None:
        reasons.append(VerdictReason.limit(UNKNOWN_SIDE, "Give side (--side)."))
    if found.angles is None and set(LONG_BONES) <= set(motion.poses):
        what = "There are no joint angles: a bone has only a frame from its markers."
        reasons.append(VerdictReason.limit(what, "Add landmarks (--landmarks)."))
    return Verdict.of([*reasons, *(reason for joint in found.joints for reason in _gaps(joint))])


def _still(bone: str, joined: KneeCorrespondence) -> VerdictReason:
    why = joined.missing.get(bone, "it was not measured").rstrip(".")
    make = VerdictReason.failure if bone in LONG_BONES else VerdictReason.limit
    return make(f"The {bone} is not moved: {why}.")


def _gaps(joint: Proximity) -> Iterator[VerdictReason]:
    """Name the gaps that are smaller than their standard deviations in some frames."""
    for c, name in enumerate(joint.compartments):
        share = joint.unsure[:, c].sum() / max(np.isfinite(joint.gap_mm[:, c]).sum(), 1)
        if share > 0:
            what = f"The {joint.name} gap, {name}, is smaller than its standard deviation in {share:.0%} of the frames."
            yield VerdictReason.limit(what)


def _files(knee: ScannedKnee, motion_folder: Path, settings: AnimateSettings) -> list[Path]:
    """List the files that were read."""
    files = [knee.folder / f"{name}.ply" for name in knee.parts]
    files.append(knee.folder / "markers.json")
    folders = [motion_folder]
    if settings.compare is not None and Path(settings.compare).is_dir():
        folders.append(Path(settings.compare))
    for folder in folders:
        files += [*sorted(folder.glob("bones*.npz")), folder / "motion.c3d", folder / "marker_motion.csv"]
    return [*files, *(path for path in (settings.reference, settings.landmarks) if path is not None)]


def _about(settings: AnimateSettings, method: str | None, knee: ScannedKnee) -> dict[str, object]:
    given = {key: value for key, value in vars(settings).items() if value is not None}
    side = {None: "unknown", True: "left", False: "right"}[knee.left]
    return {**given, "views": list(settings.views), "method": method, "side": side}

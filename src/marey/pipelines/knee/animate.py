"""`marey knee animate`: a knee's bones and cartilage from MR, moved by an activity in the laboratory."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from marey.errors import FileProblem, MareyError, SettingProblem
from marey.io.markers.activity import first_method, read_activity, room_is_y_up
from marey.io.markers.readers import read_markers
from marey.io.mr.meshes import read_mesh
from marey.io.mr.scanner_markers import read_landmarks, read_scanner_markers
from marey.io.stages import file_fingerprint
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
from marey.knee.space.surface import Surface
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.kinematics.joint_angles import JointKinematics
from marey.pipelines.knee.animation_results import AnimationResults, write_animation
from marey.pipelines.progress import Progress
from marey.pipelines.run_record import StageCache, fingerprint
from marey.view.pictures.knee_picture import DEFAULT_VIEWS, VIEWS

FRAMES = ("tibia", "room")


@dataclass(frozen=True, eq=False, kw_only=True)
class AnimateOptions:
    """What `marey knee animate` is asked for."""

    out: Path | None = None
    reference: Path | None = None
    """A trial of the person standing, with the scanner's markers."""
    method: str | None = None
    """Whose bones, of several that `marey markers` ran at once."""
    compare: str | None = None
    """Another method, or another folder of `marey markers`."""
    landmarks: Path | None = None
    side: str | None = None
    frame: str = "tibia"
    views: tuple[str, ...] = DEFAULT_VIEWS
    limit_mm: float = LIMIT_MM
    noise_mm: float = NOISE_MM
    """Standard deviation of a marker's coordinate in the laboratory, its putting back with it."""

    def __post_init__(self) -> None:
        if self.side not in (None, "left", "right"):
            raise SettingProblem(f"--side is left or right, not '{self.side}'.")
        if self.frame not in FRAMES:
            raise SettingProblem(f"--frame is tibia or room, not '{self.frame}'.")
        strange = [view for view in self.views if view not in VIEWS]
        if strange or not self.views:
            raise SettingProblem(f"--view {','.join(strange)} is none of {', '.join(VIEWS)}.")
        if not self.limit_mm > 0:
            raise SettingProblem(f"--limit is a length above 0 mm, not {self.limit_mm:g}.")
        if not 0 < self.noise_mm < 100:
            raise SettingProblem(f"--noise is a length above 0 and below 100 mm, not {self.noise_mm:g}.")


@dataclass(frozen=True, eq=False, kw_only=True)
class _Knee:
    """What the scanner saw."""

    folder: Path
    parts: Mapping[str, Surface]
    markers: ScannerMarkers
    landmarks: Landmarks | None
    left: bool | None

    @property
    def bones(self) -> dict[str, Surface]:
        return {name: part for name, part in self.parts.items() if name in BONES}


@dataclass(frozen=True, eq=False, kw_only=True)
class _Joining:
    """What every correction of the skin's motion is joined to."""

    knee: _Knee
    sides: Mapping[str, JointSurface]
    standing: MarkerTrajectories | None
    limit_mm: float
    noise_mm: float


def animate(knee_folder: Path, motion_folder: Path, options: AnimateOptions, progress: Progress) -> Path:
    """Move a knee by an activity, measure its cartilages' nearness, and write and draw it.

    Args:
        knee_folder: What `marey knee segment` left.
        motion_folder: What `marey markers` left.
        options: What is asked for.
        progress: Is told.

    Returns:
        The folder with the results.

    Raises:
        MareyError: A file or setting cannot be used, or scanner and laboratory cannot be joined.
    """
    out = options.out or motion_folder / "knee"
    with progress.stage("Reading"):
        activity = read_activity(motion_folder, method=options.method)
        other = _compared(motion_folder, options)
        knee = _read_knee(knee_folder, activity, motion_folder, options)
        standing = None if options.reference is None else read_markers(options.reference)
    if other is not None and len(other.time) != len(activity.time):
        wrong = f"has {len(other.time)} frames, and the activity {len(activity.time)}"
        raise FileProblem(Path(str(options.compare)), wrong, "Compare results of the same trial.")
    files = _files(knee, motion_folder, options)
    with threadpool_limits(1), StageCache(out, [file_fingerprint(path) for path in files]) as cache:
        sides, notes = joint_sides(knee.parts, tuple(knee.bones), left=knee.left)
        for note in notes:
            progress.warn(note)
        joining = _Joining(
            knee=knee, sides=sides, standing=standing, limit_mm=options.limit_mm, noise_mm=options.noise_mm
        )  # fmt: skip
        joined = _joined(joining, activity, options.reference or motion_folder)
        _say_joined(joined, progress)
        found = _moved(joining, joined, activity, options.method or first_method(motion_folder), progress, cache)
        compared = None
        if other is not None:
            compared = _moved(
                joining,
                _joined(joining, other, options.reference or motion_folder),
                other,
                _name_of(options),
                progress,
                cache,
            )
        _say_doubts(found, compared, joined, knee, progress)
        results = AnimationResults(
            title=f"{knee_folder.resolve().name} by {motion_folder.resolve().name}", parts=knee.parts, found=found,
            compared=compared, joined=joined, in_room=options.frame == "room" or BASE not in found.motion.poses,
            y_up=room_is_y_up(motion_folder), views=options.views, limit_mm=options.limit_mm,
            settings=_settings(options, found, knee), inputs=files, root=knee_folder.parent,
        )  # fmt: skip
        write_animation(results, out, progress)
    for line in told(found, compared):
        progress.report(line)
    return out


def _read_knee(folder: Path, activity: Activity, motion_folder: Path, options: AnimateOptions) -> _Knee:
    """Read what the scanner saw, and which knee it is."""
    if not folder.is_dir():
        raise FileProblem(folder, "is no folder", "Give one that `marey knee segment` left.")
    parts = {name: read_mesh(folder / f"{name}.ply") for name in LABELS if (folder / f"{name}.ply").is_file()}
    parts = {name: part for name, part in parts.items() if BONE_OF_CARTILAGE.get(name, name) in parts}
    missing = [bone for bone in ("femur", "tibia") if bone not in parts]
    if missing:
        wrong = f"has no {' and no '.join(f'{bone}.ply' for bone in missing)}"
        raise FileProblem(folder, wrong, "Give a folder that `marey knee segment` left.")
    own = is_left({name: part for name, part in parts.items() if name in BONES})
    return _Knee(
        folder=folder, parts=parts, markers=read_scanner_markers(folder / "markers.json"),
        landmarks=None if options.landmarks is None else read_landmarks(options.landmarks),
        left=_side(own, activity, motion_folder, options),
    )  # fmt: skip


def _side(own: bool | None, activity: Activity, motion_folder: Path, options: AnimateOptions) -> bool | None:
    """Tell which knee it is: as said, as the patella lies, or as the laboratory names its segments."""
    if options.side is not None:
        return options.side == "left"
    named = {True for name in activity.motion.segments if name.startswith("left_")}
    named |= {False for name in activity.motion.segments if name.startswith("right_")}
    if activity.side is not None:
        named.add(activity.side == "left")
    if own is not None and named and own not in named:
        words = {True: "left", False: "right"}
        raise FileProblem(
            motion_folder, f"has the {words[not own]} leg's bones, and the scanned knee is a {words[own]} one",
            "Give the motion of that leg, or the side with --side where the patella misleads.",
        )  # fmt: skip
    if own is not None:
        return own
    return next(iter(named)) if len(named) == 1 else None


def _compared(folder: Path, options: AnimateOptions) -> Activity | None:
    """Read what is to be compared: another method of the same run, or another run's folder."""
    if options.compare is None:
        return None
    path = Path(options.compare)
    if path.is_dir():
        return read_activity(path)
    return read_activity(folder, method=options.compare)


def _name_of(options: AnimateOptions) -> str:
    path = Path(str(options.compare))
    return first_method(path) if path.is_dir() else str(options.compare)


def _joined(joining: _Joining, activity: Activity, reference: Path) -> KneeCorrespondence:
    """Join scanner and laboratory."""
    knee = joining.knee
    posture = reference_posture(activity, joining.standing, noise_mm=joining.noise_mm)
    try:
        return correspond(
            knee.markers, posture, knee.bones,
            segment_of_label=activity.segment_of_label, left=knee.left, landmarks=knee.landmarks,
        )  # fmt: skip
    except MareyError as problem:
        raise FileProblem(knee.folder / "markers.json", f"cannot be joined with {reference}", str(problem)) from problem


def _say_joined(joined: KneeCorrespondence, progress: Progress) -> None:
    for note in joined.notes:
        progress.warn(note)
    for bone, each in joined.bones.items():
        for note in each.notes:
            progress.warn(f"{bone}: {note}")
    for bone, why in joined.missing.items():
        if bone != "patella":  # of which more is said when the motion is there
            progress.warn(f"The {bone} is not moved: {why}.")


def _moved(
    joining: _Joining, joined: KneeCorrespondence, activity: Activity, name: str, progress: Progress, cache: StageCache
) -> KneeMotion:
    """Measure the motion by one correction of the skin's motion, or find what an interrupted run left of it."""
    chains = {bone: bone_chain(each, activity.motion, activity.cluster) for bone, each in joined.bones.items()}
    motion = motion_of_chains(chains, activity.time, left=joining.knee.left)
    if not any(motion.answered(bone).any() for bone in motion.bones):
        raise MareyError(f"No frame of the activity has a pose of the {' or the '.join(motion.bones)}.")
    with progress.stage_of_shares(f"Nearness ({name})") as done:

        def compute() -> dict[str, np.ndarray]:
            return packed_joints(joint_proximities(motion, joining.sides, limit_mm=joining.limit_mm, done=done))

        poses = [(pose.rotation, pose.translation, pose.covariance) for pose in motion.poses.values()]
        arrays = cache.arrays(
            f"nearness-{fingerprint(name)}", compute, depends=(joining.limit_mm, motion.bones, poses)
        )  # fmt: skip
    joints = unpacked_joints(arrays, joining.sides)
    return KneeMotion(method=name, motion=motion, joints=joints, angles=_angles(joined, motion, progress))


def _angles(joined: KneeCorrespondence, motion: JointMotion, progress: Progress) -> JointKinematics | None:
    """Give the knee's angles where the bones' frames are anatomical ones; say so where they are not."""
    plain = [bone for bone, each in joined.bones.items() if each.frame_source.startswith("the markers")]
    if set(plain) & {"femur", "tibia"}:
        text = f"No angles: the frame of the {' and the '.join(plain)} is only that of its markers. Give --landmarks."
        if text not in progress.warnings:
            progress.warn(text)
        return None
    return knee_angles(motion)


def _say_doubts(
    found: KneeMotion, compared: KneeMotion | None, joined: KneeCorrespondence, knee: _Knee, progress: Progress
) -> None:
    """Say what a reader should know before the numbers."""
    motion = found.motion
    if knee.left is None:
        progress.warn("The knee's side is not known: nearness is that of the whole joint. Give --side.")
    for bone in motion.bones:
        lacking = int((~motion.answered(bone)).sum())
        if lacking:
            progress.warn(f"The {bone} has no pose in {lacking} of {len(motion)} frames: gaps, and shown as such.")
    if "patella" in knee.parts and "patella" not in motion.poses:
        why = joined.missing.get("patella", "it was not measured")
        progress.warn(
            f"The patella is not moved: {why}. It is left out of all numbers, of the video and of the GLB; the page "
            "can draw it with the femur, which it does not follow."
        )
    if not found.joints:
        progress.warn("No two bones that meet were measured: there is no nearness.")
    for joint in found.joints:
        for c, name in enumerate(joint.compartments):
            if np.isfinite(joint.base_distance_mm).any() and not np.isfinite(joint.gap_mm[:, c]).any():
                what = joint.base.name.replace("_", " ")
                progress.warn(f"There is no {what} on the {name} side: it has no gap.")
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


def _files(knee: _Knee, motion_folder: Path, options: AnimateOptions) -> list[Path]:
    """List the files that were read."""
    files = [knee.folder / f"{name}.ply" for name in knee.parts]
    files.append(knee.folder / "markers.json")
    folders = [motion_folder]
    if options.compare is not None and Path(options.compare).is_dir():
        folders.append(Path(options.compare))
    for folder in folders:
        files += [*sorted(folder.glob("bones*.npz")), folder / "motion.c3d", folder / "marker_motion.csv"]
    return [*files, *(path for path in (options.reference, options.landmarks) if path is not None)]


def _settings(options: AnimateOptions, found: KneeMotion, knee: _Knee) -> dict[str, object]:
    given = {key: value for key, value in vars(options).items() if value is not None and key != "out"}
    side = {None: "unknown", True: "left", False: "right"}[knee.left]
    return {**given, "views": list(options.views), "method": found.method, "side": side}


def told(found: KneeMotion, compared: KneeMotion | None) -> list[str]:
    """Say in a few lines how near the cartilages came."""
    lines = []
    for each in _both(found, compared):
        for joint in each.joints:
            for c, name in enumerate(joint.compartments):
                known = np.isfinite(joint.gap_mm[:, c])
                if known.any():
                    gap, sd = joint.gap_mm[known, c], joint.gap_sd_mm[known, c]
                    spread = f"; sd {np.median(sd):.1f}" if np.isfinite(sd).all() else ""
                    lines.append(
                        f"{each.method}: {joint.name}, {name}: gap {np.median(gap):.1f} mm (median{spread}), from "
                        f"{gap.min():.1f} to {gap.max():.1f}."
                    )
    return lines

"""Poses of the bones in some frames of a trial: from a reference, a static trial, or the markers alone."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from marey.arrays import Floats
from marey.errors import FileProblem, MareyError
from marey.io.markers.setup import read_reference
from marey.io.markers.trial_file import MarkerFile
from marey.io.npz import read_arrays
from marey.markers.data.clusters import MINIMUM_MARKERS, AnatomicalCalibration, Cluster
from marey.markers.data.setup import MarkerSetup
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.kinematics.calibration_offsets import CalibrationOffsets
from marey.markers.kinematics.joint_angles import usual_joints
from marey.markers.kinematics.landmark_motion import HeldLandmarks
from marey.markers.preprocessing.faults import find_faults, find_wrong_units
from marey.markers.preprocessing.own_frames import calibration_from_cluster_axes
from marey.pipelines.marker_sets.posture import LandmarkPosture
from marey.pipelines.markers.selection import SelectedTrajectories
from marey.pipelines.markers.settings import SIDES, MarkerSettings
from marey.pipelines.markers.static import from_posture, from_static
from marey.pipelines.verdict import VerdictReason

_WITHOUT_SIDE = ("pelvis", "thorax", "head")
"""Segments in the middle of the body."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Calibrated:
    """The poses of the bones in some frames, and quantities derived from them."""

    calibration: AnatomicalCalibration
    trajectories: MarkerTrajectories
    """Those of the requested frames, and of the frames in which the bones are known."""
    anatomical: bool
    """Whether the bones' frames are anatomical; otherwise they are the clusters' principal axes."""
    joints: tuple[tuple[str, str], ...]
    """Pairs (parent, child) of segments that a joint connects."""
    side: str | None
    """`left` or `right`, if it is known and the names of the segments do not contain it."""
    notes: tuple[str, ...]
    """One sentence each."""
    faults: tuple[str, ...]
    """Faults of the markers, one sentence each; they are among the notes."""
    wrong_units: tuple[str, ...]
    """Those of the faults that make every result wrong."""
    reasons: tuple[VerdictReason, ...]
    """What contradicts the static trial, with its most likely cause."""
    landmarks: Mapping[str, Floats]
    """Positions (3,) of the landmarks in the static trial [m]; empty without one."""
    held: HeldLandmarks
    """The landmarks in the frames of their bones; none without a static trial."""
    offsets: CalibrationOffsets | None
    """How assumed measurements of the person displace the bones; None without any."""
    side_notes: tuple[str, ...]
    """Whether the side is unknown; that matters only where there are joint angles."""


def calibrated(
    file: MarkerFile, selection: SelectedTrajectories, clusters: Sequence[Cluster], setup: MarkerSetup,
    settings: MarkerSettings, posture: LandmarkPosture | None = None,
) -> Calibrated:  # fmt: skip
    """Find the poses of the bones in some frames, and check the markers against them.

    Args:
        file: The trial.
        selection: Requested frames of the trial.
        clusters: Segments of the trial.
        setup: The content of the TOML.
        settings: Name the reference or the static trial.
        posture: The posture in which the landmarks of a known marker set were found; None without such a set.

    Raises:
        FileProblem: A file cannot be used, or no segment has enough markers.
        NotUsable: The static trial does not fit, and the cause is known.
    """
    measured, used = file.trajectories, selection.used
    # A segment without a frame in which enough of its markers are seen has no pose anywhere.
    seen = tuple(c for c in clusters if (used.select(c.labels).present.sum(1) >= MINIMUM_MARKERS).any())
    segments = tuple(cluster.segment for cluster in seen)
    if not segments:
        wrong = "has no frame in which three markers of a segment are visible"
        raise FileProblem(file.path, wrong, "Fill the gaps of the trial, or choose other frames.")
    reasons: tuple[VerdictReason, ...] = ()
    landmarks: Mapping[str, Floats] = {}
    held, offsets = HeldLandmarks(), None
    if posture is not None:
        standing = from_posture(posture, used, seen, side=settings.side)
        calibration, notes, reasons = standing.calibration, standing.notes, standing.reasons
        landmarks, held, offsets = standing.landmarks, standing.held, standing.offsets
    elif settings.static is not None:
        standing = from_static(used, seen, setup, settings)
        calibration, notes, reasons = standing.calibration, standing.notes, standing.reasons
        landmarks, held = standing.landmarks, standing.held
    elif settings.reference is not None:
        calibration, notes = read_reference(settings.reference, segments, frames=len(measured))
    else:
        calibration, notes = _from_markers(file, used, seen)
    side, side_notes = _side(calibration.segments, settings)
    joints = _joints(setup, calibration.segments)
    anatomical = not (posture is None and settings.static is None and settings.reference is None)
    used = used.with_frames_of(measured, calibration.frames)
    # Frames that were not requested are empty in `used`; that is not a fault of the markers.
    judged = used if selection.frames.all() else measured
    chosen, known = judged.select([label for c in clusters for label in c.labels]), calibration if anatomical else None
    faults = find_faults(chosen, clusters, known)
    return Calibrated(
        calibration=calibration, trajectories=used, anatomical=anatomical, joints=joints,
        side=side, notes=(*notes, *map(str, reasons), *faults), faults=faults, reasons=reasons, landmarks=landmarks,
        wrong_units=find_wrong_units(chosen, clusters, known), held=held, offsets=offsets,
        side_notes=side_notes if anatomical else (),
    )  # fmt: skip


def _from_markers(
    file: MarkerFile, used: MarkerTrajectories, clusters: Sequence[Cluster]
) -> tuple[AnatomicalCalibration, tuple[str, ...]]:
    """Use the principal axes of each cluster in the frame with the most markers."""
    try:
        own = calibration_from_cluster_axes(used, clusters)
    except MareyError as problem:
        remedy = "Add reference (--reference), or name other segments."
        raise FileProblem(file.path, str(problem).rstrip("."), remedy) from problem
    note = (
        "The poses of the bones beneath the markers are not known. Each segment has the principal axes of its markers "
        f"in frame {int(own.frames[0])}, and joint angles are rotations since that frame, not anatomical angles. For "
        "anatomical angles add reference (--reference), or static (--static) with landmarks."
    )
    return own, (note,)


def _joints(setup: MarkerSetup, segments: Sequence[str]) -> tuple[tuple[str, str], ...]:
    """Return the joints of the TOML, or those that the names of the segments indicate."""
    if setup.joints:
        return tuple((j.parent, j.child) for j in setup.joints if j.parent in segments and j.child in segments)
    return usual_joints(segments)


def _side(segments: Sequence[str], settings: MarkerSettings) -> tuple[str | None, tuple[str, ...]]:
    """Return the side of segments whose names do not contain it: from the settings, or from the reference."""
    if all(name.startswith(("left_", "right_")) or name in _WITHOUT_SIDE for name in segments):
        return None, ()
    if settings.side is not None:
        return settings.side, ()
    if settings.reference is not None:
        stated = str(read_arrays(settings.reference).get("side", ""))
        if stated in SIDES:
            return stated, ()
        if stated:
            wrong = f"has the side {stated[:20]!r}"
            raise FileProblem(settings.reference, wrong, f"It should be {' or '.join(SIDES)}.")
    return None, ("The side of the segments is not known: angles have the signs of a right leg. Give side (--side).",)

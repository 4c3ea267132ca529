"""Positions of the laboratory's markers on the bones, from the activity's reference posture or a standing trial."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.special import gammaincc

from marey.arrays import Floats, Integers, freeze_fields
from marey.errors import MareyError
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from marey.knee.markers.marker_bones import BONE_OF_SEGMENT, bone_of_segment
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.clusters import MINIMUM_MARKERS
from marey.markers.data.rigid_fit import RigidFit, fit_rigid
from marey.markers.data.trajectories import MarkerTrajectories

NOISE_MM = 0.5
"""Default standard deviation [mm] of a marker's coordinate; chosen by hand."""
_MM = 1e3
"""Millimetres per metre, the factor of unit conversion."""
_NO_CHANCE = 0.05
"""Probability of a cluster's residuals below which its standard deviation is raised; chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Activity:
    """Results of `marey markers` for a trial that the knee needs."""

    motion: BoneMotion
    """The bones as the method estimates them [m]."""
    cluster: BoneMotion | None = None
    """The bones as their clusters move, without correction of the skin's motion; None if not computed."""
    markers: MarkerTrajectories
    """All markers of the trial [m]."""
    segment_of_label: Mapping[str, str]
    """Label to the segment that the marker is attached to."""
    reference_frames: Integers | None
    """(K,) frames of the trial in which the bones were known; None where they are unknown (a model's bones)."""
    time: Floats
    """(F,) [s]."""
    side: str | None = None
    """`left` or `right`, where it is known but not part of the segments' names."""

    def __post_init__(self) -> None:
        freeze_fields(self, "time")
        if self.reference_frames is not None:
            freeze_fields(self, "reference_frames", dtype=np.int64)

    def places(self, segment: str, labels: tuple[str, ...]) -> Floats:
        """Return the positions (M, 3) of markers in a bone's frame in the reference posture [m]; NaN if never visible.

        They are means over the frames of the reference posture, or over all frames if these are unknown.
        """
        rotation, origin = self.motion.bone(segment)
        points = self.markers.select(labels).points
        if self.reference_frames is not None:
            rotation, origin, points = (each[self.reference_frames] for each in (rotation, origin, points))
        return _mean(np.einsum("fba,fmb->fma", rotation, points - origin[:, None]))[0]


@dataclass(frozen=True, eq=False, kw_only=True)
class BonePlaces:
    """Positions of N markers in one bone's frame in the reference posture."""

    segment: str
    places_mm: Floats
    """(N, 3) in the capture anatomic frame; NaN for a marker that is never visible."""
    sd_mm: Floats
    """(N, 3)."""
    laboratory_from_bone: RigidTransform
    """In one frame of the posture [mm]."""
    cluster: tuple[int, ...] = ()
    """Indices of the markers by which the bone was located; empty where it is known otherwise."""
    cluster_gain: Floats = field(default_factory=lambda: np.zeros((6, 0, 3)))
    """(6, cluster, 3) derivatives of the bone's rotation [rad] and shift [mm], both along its own axes, with respect to
    the position of each marker of the cluster [mm], along the same axes."""
    cluster_sd_mm: float = 0.0
    """Standard deviation of a coordinate of the cluster's markers."""
    residual_mm: float | None = None
    """Root mean square deviation of the cluster from its shape in the activity's reference posture; None if it is the
    same."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ReferencePosture:
    """The posture that relates the scanner's markers to the activity's."""

    labels: tuple[str, ...]
    """N markers."""
    bones: Mapping[str, BonePlaces]
    """By segment."""
    notes: tuple[str, ...] = ()


def reference_posture(
    activity: Activity, standing: MarkerTrajectories | None = None, *, noise_mm: float = NOISE_MM
) -> ReferencePosture:
    """Find the positions of the markers on the bones.

    Without a standing trial the activity's own reference posture is used, which must then contain the scanner's
    markers. With one, each bone's cluster is fitted to every frame of it, and the markers' positions in the bone's
    frame are averaged, so that sway has no influence. It may be the static trial of `marey markers`.

    Args:
        activity: Results of `marey markers`.
        standing: A trial with the markers of the activity and those of the scanner.
        noise_mm: Standard deviation of a marker's coordinate that averaging does not reduce: by replacing the marker,
            and by the laboratory's calibration.

    Raises:
        MareyError: The activity has no segment of a knee, or no bone can be found in the standing trial.
    """
    segments = [segment for segment in activity.motion.segments if bone_of_segment(segment) is not None]
    if not segments:
        there = ", ".join(activity.motion.segments)
        raise MareyError(f"The activity has no segment of a knee ({', '.join(BONE_OF_SEGMENT)}); it has {there}.")
    if standing is None:
        return _own_posture(activity, segments, noise_mm)
    bones, notes = {}, []
    for segment in segments:
        try:
            bones[segment], more = _standing_bone(activity, segment, standing, noise_mm)
            notes += more
        except MareyError as problem:
            notes.append(f"{segment}: {problem}")
    if not bones:
        raise MareyError(" ".join(notes))
    return ReferencePosture(labels=standing.labels, bones=bones, notes=tuple(notes))


def _own_posture(activity: Activity, segments: Sequence[str], noise_mm: float) -> ReferencePosture:
    labels = activity.markers.labels
    frames = np.arange(len(activity.motion)) if activity.reference_frames is None else activity.reference_frames
    bones, notes = {}, []
    for segment in segments:
        rotation, origin = (each[frames] for each in activity.motion.bone(segment))
        answered = np.flatnonzero(np.isfinite(rotation).all((1, 2)))
        if not len(answered):
            notes.append(f"{segment}: no pose in the reference posture")
            continue
        at = RigidTransform(rotation[answered[0]], origin[answered[0]] * _MM)
        places = activity.places(segment, labels) * _MM
        bones[segment] = BonePlaces(
            segment=segment, places_mm=places, sd_mm=np.full_like(places, noise_mm), laboratory_from_bone=at
        )
    return ReferencePosture(labels=labels, bones=bones, notes=tuple(notes))


def _standing_bone(
    activity: Activity, segment: str, standing: MarkerTrajectories, noise_mm: float
) -> tuple[BonePlaces, list[str]]:
    """Fit one bone's cluster to the standing trial."""
    attached = [label for label, name in activity.segment_of_label.items() if name == segment]
    shared = tuple(label for label in attached if label in standing.labels)
    if len(shared) < MINIMUM_MARKERS:
        raise MareyError(
            f"the standing trial has {len(shared)} of the activity's markers on this segment ({', '.join(attached)}), "
            f"but at least {MINIMUM_MARKERS} are needed."
        )
    shape = activity.places(segment, shared)
    fit = fit_rigid(shape, standing.select(shared).points, noise_mm / _MM)
    answered = np.flatnonzero(np.isfinite(fit.rotation).all((1, 2)))
    if not len(answered):
        raise MareyError(f"no frame of the standing trial shows three of {', '.join(shared)} that are not on one line.")
    inside = np.einsum("fba,fmb->fma", fit.rotation, standing.points - fit.translation[:, None])[answered] * _MM
    places, spread = _mean(inside)
    residual = _MM * float(np.sqrt(np.nanmean((fit.residuals[answered] ** 2).sum(-1))))
    gain, raised = _cluster_gain(fit, shape * _MM, answered)
    middle = answered[len(answered) // 2]
    found = BonePlaces(
        segment=segment, places_mm=places, sd_mm=np.sqrt(noise_mm**2 + spread**2),
        laboratory_from_bone=RigidTransform(fit.rotation[middle], fit.translation[middle] * _MM),
        cluster=tuple(standing.labels.index(label) for label in shared), cluster_gain=gain,
        cluster_sd_mm=noise_mm * np.sqrt(raised), residual_mm=residual,
    )  # fmt: skip
    note = f"{segment}: its markers in the standing trial lie {residual:.1f} mm (RMS) from those in the activity."
    missing = [label for label in attached if label not in shared]
    more = [f"{segment}: the standing trial lacks {', '.join(missing)}."] if missing else []
    return found, [note, *more]


def _cluster_gain(fit: RigidFit, shape_mm: Floats, answered: Integers) -> tuple[Floats, float]:
    """Return the derivatives of a bone's pose with respect to its markers, and the variance ratio of their residuals.

    Only the markers visible in at least half of the frames are used. Their deviations are assumed to be the same in all
    frames, as those of displaced skin are.
    """
    there = np.isfinite(fit.residuals[answered]).all(-1).mean(0) >= 0.5
    weight = np.where(there, 1.0, 0.0)
    held = np.where(there[:, None], shape_mm, 0.0)
    jacobian = np.concatenate([-rotations.hat(held), np.broadcast_to(np.eye(3), (len(held), 3, 3))], -1)
    information = np.einsum("m,mia,mib->ab", weight, jacobian, jacobian)
    gain = np.einsum("ab,m,mib->ami", np.linalg.inv(information), weight, jacobian)
    ratio, freedom = float(np.median(fit.variance_ratio[answered])), 3 * int(there.sum()) - 6
    no_chance = freedom > 0 and gammaincc(freedom / 2, ratio * freedom / 2) < _NO_CHANCE
    return gain, ratio if no_chance else 1.0


def _mean(values: Floats) -> tuple[Floats, Floats]:
    """Return the mean (M, 3) over the frames with a position (F, M, 3), and the standard deviation of the mean."""
    known = np.isfinite(values)
    count = known.sum(0)
    mean = np.where(count > 0, np.where(known, values, 0.0).sum(0) / np.maximum(count, 1), np.nan)
    squares = np.where(known, (values - mean) ** 2, 0.0).sum(0)
    return mean, np.sqrt(squares / np.maximum(count - 1, 1) / np.maximum(count, 1))

"""Correspondence of scanner and laboratory: transforms of bones from MR into the motion of an activity.

All lengths are in millimetres, also in the chains.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, Mask
from marey.errors import MareyError
from marey.geometry import rotations
from marey.knee.markers.anatomical_frames import (
    BONE_FRAME_DEFAULTS,
    BoneFrame,
    BoneFrameSettings,
    Landmarks,
    bone_frame,
)
from marey.knee.markers.marker_bones import in_order
from marey.knee.markers.marker_fit import (
    FEWEST,
    MARKER_FIT_DEFAULTS,
    CommonMarkers,
    MarkerFit,
    MarkerFitSettings,
    fit_markers,
)
from marey.knee.markers.marker_naming import (
    MARKER_NAMING_DEFAULTS,
    MarkerNamingSettings,
    NamedBalls,
    ScannerMarkers,
    named_balls,
    segment_of_bone,
)
from marey.knee.markers.reference_posture import BonePlaces, ReferencePosture
from marey.knee.space.surface import TriangleSurface
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.kinematics.transform_chain import (
    CAPTURE_ANATOMIC,
    MR_ANATOMIC,
    NamedTransform,
    TransformChain,
    bone_steps,
)

_MM = 1e3
"""Millimetres per metre, the factor of unit conversion."""


@dataclass(frozen=True, kw_only=True)
class CorrespondenceSettings:
    """Settings of the stages of `correspond`."""

    naming: MarkerNamingSettings = MARKER_NAMING_DEFAULTS
    """Settings for finding the laboratory's marker of each ball."""
    frames: BoneFrameSettings = BONE_FRAME_DEFAULTS
    """Settings of the bones' frames in the scanner."""
    fit: MarkerFitSettings = MARKER_FIT_DEFAULTS
    """Settings of the rigid fit of the common markers."""


CORRESPONDENCE_DEFAULTS = CorrespondenceSettings()
"""Default settings of the correspondence of scanner and laboratory."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BoneCorrespondence:
    """One bone: its frame in the scanner, and that frame in the bone's frame in the laboratory."""

    bone: str
    """`femur`, `tibia` or `patella`."""
    segment: str
    """Its name in the laboratory: `thigh`, `left_shank`, ..."""
    mr_anatomic_from_mr_global: NamedTransform
    """Direct [mm]."""
    capture_anatomic_from_mr_anatomic: NamedTransform
    """Optimised [mm], with covariance [rad, mm]."""
    fit: MarkerFit
    """Fit of the common markers, with their residuals and which of them were used, by label."""
    balls: tuple[int, ...]
    """Indices of the scanner's markers in the order of `fit.names`."""
    frame_source: str
    """From what the bone's frame in the scanner was constructed."""
    posture_residual_mm: float | None
    """Root mean square deviation of the activity's cluster between the reference posture and the standing trial."""
    notes: tuple[str, ...] = ()

    @property
    def capture_anatomic_from_mr_global(self) -> NamedTransform:
        """From the scanner to the bone's frame in the laboratory [mm]."""
        return self.capture_anatomic_from_mr_anatomic @ self.mr_anatomic_from_mr_global


@dataclass(frozen=True, eq=False, kw_only=True)
class KneeCorrespondence:
    """The relation of a scanned knee to an activity."""

    bones: Mapping[str, BoneCorrespondence]
    """By bone; only bones with at least three common markers."""
    missing: Mapping[str, str]
    """Bones that have no correspondence, and why."""
    naming: NamedBalls
    """The marker of the laboratory and the bone of each ball."""
    notes: tuple[str, ...] = ()


def correspond(
    scanner: ScannerMarkers, posture: ReferencePosture, bones: Mapping[str, TriangleSurface], *,
    segment_of_label: Mapping[str, str], left: bool | None = None, landmarks: Landmarks | None = None,
    settings: CorrespondenceSettings = CORRESPONDENCE_DEFAULTS,
) -> KneeCorrespondence:  # fmt: skip
    """Find the transform of each bone from its frame in the scanner to its frame in the laboratory.

    [Alexander2003] section 2.2 and the second row of table 1. Each bone has its own, because the knee may be bent
    differently in the scanner and in the reference posture.

    Args:
        scanner: The balls found in the volume.
        posture: Positions of the laboratory's markers on the bones.
        bones: Surfaces of the bones in the scanner, by name.
        segment_of_label: Label of the activity to the segment that the marker is attached to.
        left: Whether it is a left knee; None where it is not known.
        landmarks: Picked in the scanner's images, if any.
        settings: Of all stages.

    Raises:
        MareyError: No bone has a correspondence, or the markers cannot be identified.
    """
    naming = named_balls(
        scanner, posture, bones, segment_of_label=segment_of_label, left=left, settings=settings.naming
    )
    found: dict[str, BoneCorrespondence] = {}
    missing: dict[str, str] = {}
    for bone in in_order(dict.fromkeys([*bones, *naming.bones])):
        segment = segment_of_bone(bone, posture.bones, left=left)
        if segment is None:
            there = ", ".join(posture.bones) or "no bones of a knee"
            missing[bone] = f"no segment of the activity contains this bone (the activity has {there})"
            continue
        try:
            balls = _seen(naming, bone, posture, posture.bones[segment])
            markers = scanner.centres_mm[list(balls)]
            frame = bone_frame(bone, bones.get(bone), markers, left=left, landmarks=landmarks, settings=settings.frames)
            found[bone] = _bone(bone, scanner, balls, posture, posture.bones[segment], naming, frame, settings.fit)
        except MareyError as problem:
            missing[bone] = str(problem).rstrip(".")
    if not found:
        raise MareyError(_nothing(missing, naming))
    return KneeCorrespondence(bones=found, missing=missing, naming=naming, notes=(*posture.notes, *naming.notes))


def _nothing(missing: Mapping[str, str], naming: NamedBalls) -> str:
    """Return why no bone has a correspondence."""
    if all(label is None for label in naming.labels):
        return (
            "No three of the scanner's markers have the same distances from each other as markers of the reference. "
            "Check that the reference shows them, give another trial as reference, or write marker_names into "
            "markers.json."
        )
    why = "; ".join(f"{bone}: {reason}" for bone, reason in missing.items())
    notes = " ".join(naming.notes)
    return f"No bone can be transformed from the scanner to the laboratory ({why}). {notes}".rstrip()


def _seen(naming: NamedBalls, bone: str, posture: ReferencePosture, places: BonePlaces) -> tuple[int, ...]:
    """Return a bone's balls whose markers are visible in the reference.

    Raises:
        MareyError: There are too few; the message names those that are in no frame.
    """
    balls = naming.of(bone)
    there: Mask = np.asarray(np.isfinite(places.places_mm).all(1))
    seen = tuple(ball for ball in balls if there[posture.labels.index(naming.labels[ball])])
    if len(seen) >= FEWEST:
        return seen
    unseen = ", ".join(str(naming.labels[ball]) for ball in balls if ball not in seen)
    why = f" ({unseen}: not visible in any frame of the reference)" if unseen else ""
    raise MareyError(f"it has {len(seen)} markers in common with the reference{why}, but needs {FEWEST}")


def _bone(
    bone: str, scanner: ScannerMarkers, balls: Sequence[int], posture: ReferencePosture, places: BonePlaces,
    naming: NamedBalls, frame: BoneFrame, settings: MarkerFitSettings,
) -> BoneCorrespondence:  # fmt: skip
    """Fit one bone's common markers, and add the uncertainty of the bone in the reference posture."""
    chosen = [posture.labels.index(naming.labels[ball]) for ball in balls]
    inverse = frame.scanner_from_bone.inverse()
    # The detector's standard deviations are along the scanner's axes; those along rotated axes combine them.
    sd = np.sqrt(scanner.sd_mm[list(balls)] ** 2 @ (inverse.rotation.T**2))
    common = CommonMarkers(
        names=tuple(posture.labels[m] for m in chosen), from_mm=inverse.apply(scanner.centres_mm[list(balls)]),
        from_sd_mm=sd, to_mm=places.places_mm[chosen], to_sd_mm=places.sd_mm[chosen],
    )  # fmt: skip
    unseen = [naming.labels[ball] for ball in naming.of(bone) if ball not in balls]
    lost = (f"not visible in any frame of the reference, and not used: {', '.join(map(str, unseen))}",)
    fit = fit_markers(common, settings=settings)
    fit = replace(fit, covariance=_with_posture(fit, chosen, places))
    return BoneCorrespondence(
        bone=bone, segment=places.segment, mr_anatomic_from_mr_global=frame.step, balls=tuple(balls), fit=fit,
        capture_anatomic_from_mr_anatomic=NamedTransform(
            to=CAPTURE_ANATOMIC, from_=MR_ANATOMIC, rotation=fit.rotation, translation=fit.translation_mm,
            covariance=fit.covariance,
        ),
        frame_source=frame.source, posture_residual_mm=places.residual_mm,
        notes=(*frame.notes, *(lost if unseen else ()), *fit.notes),
    )  # fmt: skip


def _with_posture(fit: MarkerFit, chosen: Sequence[int], places: BonePlaces) -> Floats:
    """Add to the fit's covariance that of the bone in the reference posture, as located by its cluster's markers.

    A marker of both the fit and the cluster has the same error in both. An error of the cluster's shape itself is the
    same in the activity, and cancels: it belongs to the activity's motion.
    """
    if not places.cluster:
        return fit.covariance
    posture = _derivatives_by_posture(fit)
    of_cluster = np.einsum("ab,bmi->ami", posture, places.cluster_gain)
    both = np.zeros((6, 6))
    for row, marker in enumerate(chosen):
        if marker in places.cluster:
            other = of_cluster[:, places.cluster.index(marker)] * places.cluster_sd_mm
            own = fit.gain[:, row] * np.sqrt(fit.raised) * places.sd_mm[marker]
            both += own @ other.T + other @ own.T
    spread = np.einsum("ami,bmi->ab", of_cluster, of_cluster) * places.cluster_sd_mm**2
    return np.asarray(fit.covariance + spread + both)


def _derivatives_by_posture(fit: MarkerFit) -> Floats:
    """Return the derivatives (6, 6) of rotation and translation by a motion of the bone along its own axes."""
    matrix = np.zeros((6, 6))
    matrix[:3, :3] = -fit.rotation.T
    matrix[3:, :3] = rotations.hat(fit.translation_mm)
    matrix[3:, 3:] = -np.eye(3)
    return matrix


def bone_chain(
    found: BoneCorrespondence, corrected: BoneMotion, cluster: BoneMotion | None = None
) -> TransformChain:  # fmt: skip
    """Return the five steps of [Alexander2003] table 1 for one bone, in millimetres.

    `chain.between(CAPTURE_GLOBAL, MR_GLOBAL).apply(surface.vertices_mm)` is the bone in the laboratory in every frame.

    Args:
        found: The bone's correspondence.
        corrected: The activity's bones as the method estimates them [m].
        cluster: The bones as their clusters move, without correction [m]; without it the fourth step is the identity,
            with the covariance only.

    Raises:
        MareyError: The motion does not have the bone's segment.
    """
    moved = _in_mm(corrected)
    rigid = moved if cluster is None or found.segment not in cluster.segments else _in_mm(cluster)
    deformed, bone, motion = bone_steps(rigid, moved, found.segment)
    return TransformChain(
        mr_anatomic_from_mr_global=found.mr_anatomic_from_mr_global,
        capture_anatomic_from_mr_anatomic=found.capture_anatomic_from_mr_anatomic,
        deformed_from_capture_anatomic=deformed, bone_from_deformed=bone, capture_global_from_bone=motion,
    )  # fmt: skip


def _in_mm(motion: BoneMotion) -> BoneMotion:
    scale = np.diag([1.0, 1.0, 1.0, _MM, _MM, _MM])
    return replace(motion, origin=motion.origin * _MM, covariance=scale @ motion.covariance @ scale)


def mean_error_quantile(
    transform: NamedTransform, vertices_mm: Floats, *, share: float = 0.95, draws: int = 1000
) -> float:
    """Return a quantile [mm] of the mean distance of a surface from its true position.

    It is found from draws of the transform's covariance, which are always the same.

    Args:
        transform: Constant transform with translations in millimetres.
        vertices_mm: (V, 3) in the frame that it comes from; some hundred are enough.
        share: Probability of the quantile.
        draws: Number of draws.
    """
    if transform.covariance is None:
        return 0.0
    normal = np.random.default_rng(0).normal(size=(draws, 6))
    values, vectors = np.linalg.eigh(transform.covariance)
    off = normal @ (vectors * np.sqrt(np.maximum(values, 0.0))).T
    shifts = np.cross(off[:, None, :3], vertices_mm) @ transform.rotation.T + off[:, None, 3:]
    return float(np.quantile(np.linalg.norm(shifts, axis=-1).mean(1), share))

"""Checks of a trial's markers, reported as sentences for the user."""

from collections.abc import Sequence

import numpy as np

from marey.arrays import Floats, Mask
from marey.markers.data.clusters import MINIMUM_MARKERS, AnatomicalCalibration, Cluster
from marey.markers.data.rigid_fit import in_cluster_frame, mean_shape
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.preprocessing.exchanges import LabelExchange, find_exchanges, ranges, undo_exchanges

_SMALLEST_CLUSTER_M = 0.01
"""Smallest plausible extent of a cluster on one segment [m]; a smaller one suggests a wrong unit. Chosen by hand."""
_LARGEST_CLUSTER_M = 1.2
"""Largest plausible extent of a cluster on one segment [m]; a larger one suggests a wrong unit. Chosen by hand."""
_FARTHEST_ORIGIN_M = 1.5
"""Largest plausible distance between a bone's origin and its markers [m]. Chosen by hand."""
_MINIMUM_WIDTH_RATIO = 0.02
"""A cluster whose spread across its main line is below this ratio of its spread along it counts as a line. Chosen by
hand."""


def find_faults(
    trajectories: MarkerTrajectories,
    clusters: Sequence[Cluster],
    calibration: AnatomicalCalibration | None = None,
    *,
    known: Floats | None = None,
) -> tuple[str, ...]:
    """List faults of the markers: implausible sizes, collinear clusters, gaps without an estimate, exchanged labels.

    Nothing is corrected, and no fault stops a method: frames with fewer than three markers have no result. See
    `marey.markers.preprocessing.exchanges.undo_exchanges` for the correction of exchanged labels.

    Args:
        trajectories: Marker trajectories of the trial.
        clusters: Clusters of its markers.
        calibration: Known poses of the bones, to be compared with the markers.
        known: (M, 3) positions of the trial's markers in a posture with correct labels [m], to detect labels that are
            exchanged over the whole trial.

    Returns:
        One sentence per fault, the most severe kinds first.
    """
    faults = list(find_wrong_units(trajectories, clusters, calibration))
    faults += [fault for cluster in clusters for fault in _cluster_faults(trajectories, cluster)]
    if calibration is not None:
        faults += _calibration_faults(trajectories, clusters, calibration)
    faults += [
        _exchange_fault(trajectories, clusters, exchange) for exchange in find_exchanges(trajectories, clusters, known)
    ]
    return tuple(faults)


def _exchange_fault(trajectories: MarkerTrajectories, clusters: Sequence[Cluster], exchange: LabelExchange) -> str:
    """Describe an exchange of two labels, with what it achieves to undo it."""
    own = [cluster for cluster in clusters if set(exchange.labels) & set(cluster.labels)]
    before, after = (
        1e3 * _deformation(each, own, exchange.frames)
        for each in (trajectories, undo_exchanges(trajectories, [exchange]))
    )
    if not after < before:
        return exchange.note
    return f"{exchange.note} Exchanged back, their segments deform by {after:.1f} mm instead of {before:.1f} mm (RMS)."


def _deformation(trajectories: MarkerTrajectories, clusters: Sequence[Cluster], frames: Mask) -> float:
    """Return the distance of the markers from the mean shapes of their clusters in some frames, RMS [m]."""
    squares = []
    for cluster in clusters:
        local = in_cluster_frame(trajectories.select(cluster.labels).points)[0]
        squares.append(((local - mean_shape(local))[frames] ** 2).sum(-1).ravel())
    every = np.concatenate(squares)
    known = every[np.isfinite(every)]
    return float(np.sqrt(known.mean())) if len(known) else float("nan")


def find_wrong_units(
    trajectories: MarkerTrajectories, clusters: Sequence[Cluster], calibration: AnatomicalCalibration | None = None
) -> tuple[str, ...]:
    """List sizes and distances that no body has, which a wrong unit explains; everything that follows is wrong.

    Args:
        trajectories: Marker trajectories of the trial.
        clusters: Clusters of its markers.
        calibration: Known poses of the bones, to be compared with the markers.

    Returns:
        One sentence per fault.
    """
    faults = []
    for cluster in clusters:
        shape = _fullest_frame(trajectories, cluster)
        size = float(np.linalg.norm(shape.max(0) - shape.min(0))) if len(shape) >= MINIMUM_MARKERS else np.nan
        if size < _SMALLEST_CLUSTER_M or size > _LARGEST_CLUSTER_M:
            faults.append(f"{cluster.segment}: its markers spread over {1e3 * size:.3g} mm. Is the file's unit right?")
    return (*faults, *(() if calibration is None else _far_bones(trajectories, clusters, calibration)))


def _fullest_frame(trajectories: MarkerTrajectories, cluster: Cluster) -> Floats:
    """Return the visible markers (M, 3) of a cluster in the frame that shows most of them."""
    chosen = trajectories.select(cluster.labels)
    shape = chosen.points[int(np.argmax(chosen.present.sum(1)))]
    return np.asarray(shape[np.isfinite(shape).all(-1)])


def _far_bones(
    trajectories: MarkerTrajectories, clusters: Sequence[Cluster], calibration: AnatomicalCalibration
) -> list[str]:
    """List the bones that the calibration places far from their markers."""
    faults = []
    for cluster in (each for each in clusters if each.segment in calibration.segments):
        origins = calibration.origin[:, calibration.segments.index(cluster.segment)]
        points = trajectories.select(cluster.labels).points[calibration.frames]
        for frame, origin, markers in zip(calibration.frames, origins, points, strict=True):
            seen = markers[np.isfinite(markers).all(-1)]
            far = float(np.linalg.norm(origin - seen.mean(0))) if len(seen) >= MINIMUM_MARKERS else 0.0
            if far > _FARTHEST_ORIGIN_M:
                faults.append(
                    f"{cluster.segment}: in frame {frame} the reference places the bone {far:.3g} m from its markers. "
                    "Are its origins in millimetres, and in the axes of the trial?"
                )
    return faults


def _cluster_faults(trajectories: MarkerTrajectories, cluster: Cluster) -> list[str]:
    """Check one cluster."""
    chosen = trajectories.select(cluster.labels)
    name, present = cluster.segment, chosen.present
    never = [label for label, there in zip(chosen.labels, np.asarray(present.any(0)), strict=True) if not there]
    faults = [f"{name}: {', '.join(never)} is not visible in any frame."] if never else []
    few: Mask = np.asarray(present.sum(1) < MINIMUM_MARKERS)
    if few.all():
        return [f"{name}: no frame shows {MINIMUM_MARKERS} of its markers; the bone cannot be estimated.", *faults]
    if few.any():
        faults.append(
            f"{name}: {int(few.sum())} of {len(few)} frames have fewer than {MINIMUM_MARKERS} markers and no result: "
            f"{ranges(few)}."
        )
    shape = _fullest_frame(trajectories, cluster)
    spread = np.linalg.svd(shape - shape.mean(0), compute_uv=False)
    if spread[1] < _MINIMUM_WIDTH_RATIO * spread[0]:
        faults.append(f"{name}: its markers are collinear; the rotation about their line is not determined.")
    return faults


def _calibration_faults(
    trajectories: MarkerTrajectories, clusters: Sequence[Cluster], calibration: AnatomicalCalibration
) -> list[str]:
    """Compare the known positions of the bones with the markers on them."""
    faults = []
    for cluster in clusters:
        if cluster.segment not in calibration.segments:
            faults.append(f"{cluster.segment}: no reference pose is given for this bone; it cannot be estimated.")
            continue
        points = trajectories.select(cluster.labels).points[calibration.frames]
        for k, frame in enumerate(calibration.frames):
            seen = points[k][np.isfinite(points[k]).all(-1)]
            if len(seen) < MINIMUM_MARKERS:
                faults.append(f"{cluster.segment}: frame {frame} of the reference shows {len(seen)} of its markers.")
    return faults

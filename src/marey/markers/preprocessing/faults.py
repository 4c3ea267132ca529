"""What is wrong with a trial's markers, in plain sentences."""

from collections.abc import Sequence

import numpy as np

from marey.arrays import Floats, Mask
from marey.markers.data.clusters import AnatomicalCalibration, Cluster
from marey.markers.data.labels import NEEDED
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.preprocessing.exchanges import find_exchanges, ranges

_SMALLEST_M, _LARGEST_M = 0.01, 1.2  # a cluster on one segment
_FARTHEST_M = 1.5  # a bone's origin from its markers
_SIDEWAYS = 0.02  # of a cluster's length: flatter is a line


def find_faults(
    trajectories: MarkerTrajectories,
    clusters: Sequence[Cluster],
    calibration: AnatomicalCalibration | None = None,
    *,
    known: Floats | None = None,
) -> tuple[str, ...]:
    """List what is wrong with the markers: sizes, lines, gaps that leave a bone without an answer, exchanged labels.

    Nothing is mended here, and nothing of it stops a method: frames without three markers have no answer. To give
    exchanged labels their paths again, see `marey.markers.preprocessing.exchanges.exchange_back`.

    Args:
        trajectories: Of the trial.
        clusters: Of its markers.
        calibration: Where the bones were, to be held against the markers.
        known: (M, 3) where the trial's markers are in a posture whose labels are right [m], to find labels that are
            exchanged all along.

    Returns:
        A sentence a fault, the worst kinds first.
    """
    faults = [fault for cluster in clusters for fault in _of_cluster(trajectories, cluster)]
    if calibration is not None:
        faults += _of_calibration(trajectories, clusters, calibration)
    faults += [exchange.note for exchange in find_exchanges(trajectories, clusters, known)]
    return tuple(faults)


def _of_cluster(trajectories: MarkerTrajectories, cluster: Cluster) -> list[str]:
    """Hold one cluster against what it should be."""
    chosen = trajectories.select(cluster.labels)
    name, present = cluster.segment, chosen.present
    never = [label for label, there in zip(chosen.labels, np.asarray(present.any(0)), strict=True) if not there]
    faults = [f"{name}: {', '.join(never)} is in no frame."] if never else []
    few: Mask = np.asarray(present.sum(1) < NEEDED)
    if few.all():
        return [f"{name}: no frame has {NEEDED} of its markers; it has no answer.", *faults]
    if few.any():
        faults.append(
            f"{name}: {int(few.sum())} of {len(few)} frames have fewer than {NEEDED} markers and no answer: "
            f"{ranges(few)}."
        )
    shape = chosen.points[int(np.argmax(present.sum(1)))]
    shape = shape[np.isfinite(shape).all(-1)]
    size = float(np.linalg.norm(shape.max(0) - shape.min(0)))
    spread = np.linalg.svd(shape - shape.mean(0), compute_uv=False)
    if not _SMALLEST_M <= size <= _LARGEST_M:
        faults.append(f"{name}: its markers spread over {1e3 * size:.3g} mm. Is the file's unit right?")
    if spread[1] < _SIDEWAYS * spread[0]:
        faults.append(f"{name}: its markers lie in a line, so that the turn about it is not told.")
    return faults


def _of_calibration(
    trajectories: MarkerTrajectories, clusters: Sequence[Cluster], calibration: AnatomicalCalibration
) -> list[str]:
    """Hold the known places of the bones against the markers on them."""
    faults = []
    for cluster in clusters:
        if cluster.segment not in calibration.segments:
            faults.append(f"{cluster.segment}: nothing says where this bone was, so it has no answer.")
            continue
        s = calibration.segments.index(cluster.segment)
        points = trajectories.select(cluster.labels).points[calibration.frames]
        for k, frame in enumerate(calibration.frames):
            seen = points[k][np.isfinite(points[k]).all(-1)]
            if len(seen) < NEEDED:
                faults.append(f"{cluster.segment}: frame {frame} of the reference has {len(seen)} of its markers.")
                continue
            far = float(np.linalg.norm(calibration.origin[k, s] - seen.mean(0)))
            if far > _FARTHEST_M:
                faults.append(
                    f"{cluster.segment}: in frame {frame} the reference puts the bone {far:.3g} m from its markers. "
                    "Are its origins in millimetres, and in the trial's own axes?"
                )
    return faults

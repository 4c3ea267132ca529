"""Repairs of a trial whose markers do not have the shape that they have in another trial of the same person."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats
from marey.markers.data.clusters import MINIMUM_MARKERS, Cluster
from marey.markers.data.rigid_fit import EQUAL_SD_M, fit_rigid, in_cluster_frame, mean_shape
from marey.markers.data.trajectories import MarkerTrajectories

Places = Mapping[str, Floats]
"""Maps the label of a marker to its position (3,) in a posture [m]."""
_SIDES = re.compile(r"left|right|[lr]", re.IGNORECASE)
"""Parts of a label that may name its side."""
_OTHER_SIDE = {"left": "right", "right": "left", "l": "r", "r": "l"}
"""Maps a side to the other one."""


@dataclass(frozen=True, kw_only=True)
class PostureRepairSettings:
    """Thresholds at which a repair counts as the cause of a misfit between the markers of two trials.

    Chosen on the trials `functional` (standing, against walking and against a moved hip), `gait`, and `ntu` and
    `ottawa` of `sta`, with faults planted: there, the clusters of one person differ by at most 4 mm (RMS) from trial to
    trial, and a marker by at most 18 mm from the place that the others indicate. Held out were `csuohio`, `foroit`,
    `lmam` and `unibo`, whose first frame was the static posture: at most 7 mm and 14 mm.
    """

    largest_error_ratio: float = 0.5
    """With the repair, the distance of the markers is below this ratio of that without it."""
    least_gain_m: float = 0.004
    """And smaller by at least this much (RMS) [m]."""
    unit_tolerance: float = 0.15
    """Largest difference between the decimal logarithm of a ratio of sizes and that of two units."""
    least_moved_m: float = 0.025
    """Least distance of a moved marker from the place that the others indicate [m]."""
    largest_rest_ratio: float = 0.25
    """Largest distance (RMS) of the other markers, as a ratio to that of the moved one."""
    largest_rival_ratio: float = 1.5
    """Markers without which the rest fits nearly as well, up to this ratio, may have moved as well."""
    unlike_m: float = 0.015
    """Distance (RMS) above which two shapes are not those of the same markers [m]. One person has 7 mm at most; pairs
    of different people in `sta`, with labels of the same names, have 40 mm and more."""


POSTURE_REPAIR_DEFAULTS = PostureRepairSettings()
"""Default thresholds of the repairs."""


@dataclass(frozen=True, kw_only=True)
class PostureRepair:
    """What explains that markers have another shape than in another trial."""

    kind: str
    """`unit`, `mirrored`, `sides`, `moved` (a marker) or `unlike` (other markers, or another person)."""
    before_m: float
    """Distance (RMS) between the markers of the two trials, each cluster aligned with itself [m]; NaN for a unit."""
    after_m: float
    """The same with the repair [m]; NaN if there is none."""
    names: tuple[str, ...] = ()
    """Markers that may have moved, the most likely first, or clusters that are unlike."""
    segment: str = ""
    """The segment of a moved marker."""
    value: float = float("nan")
    """The factor between the units, or the distance of a moved marker [m]."""


def posture_repairs(
    trajectories: MarkerTrajectories, clusters: Sequence[Cluster], known: Places,
    settings: PostureRepairSettings = POSTURE_REPAIR_DEFAULTS,
) -> tuple[PostureRepair, ...]:  # fmt: skip
    """Find what explains that the clusters of a trial do not have the shape of the same markers in another trial.

    Every repair is tried: another unit, a mirror image, left and right labels exchanged, a marker that is not used.
    Exchanged labels of one cluster are a matter of `marey.markers.preprocessing.exchanges`, and should be undone first.

    Args:
        trajectories: Marker trajectories of the trial.
        clusters: Its clusters.
        known: Positions of the markers in a posture of the other trial [m].
        settings: Thresholds.

    Returns:
        The repairs; empty if the shapes agree.
    """
    factor = _unit_factor(trajectories, clusters, known, settings)
    shapes = _shapes(replace(trajectories, points=trajectories.points / factor), clusters, known)
    before = pooled_distance(shapes, known)
    if factor != 1:
        return (PostureRepair(kind="unit", before_m=float("nan"), after_m=before, value=factor),)
    if not shapes:
        return ()
    candidates = {"mirrored": mirrored_places(known), "sides": exchanged_sides(known)}
    errors = {kind: pooled_distance(shapes, places) for kind, places in candidates.items()}
    best = min(errors, key=lambda kind: errors[kind] if np.isfinite(errors[kind]) else np.inf)
    if errors[best] < settings.largest_error_ratio * before and before - errors[best] > settings.least_gain_m:
        return (PostureRepair(kind=best, before_m=before, after_m=errors[best]),)
    return _by_cluster(shapes, known, settings)


def _by_cluster(
    shapes: Mapping[str, Places], known: Places, settings: PostureRepairSettings
) -> tuple[PostureRepair, ...]:
    """Name markers that have moved on their segments, and clusters that nothing explains."""
    found = [_moved_marker(segment, shape, known, settings) for segment, shape in shapes.items()]
    moved = [each for each in found if each is not None]
    wide = [name for name, shape in shapes.items() if pooled_distance({name: shape}, known) > settings.unlike_m]
    unlike = [name for name in wide if name not in [each.segment for each in moved]]
    if unlike:
        # Beside clusters that nothing explains, a marker that explains another one does so by chance.
        unlike = wide
        those = {segment: shapes[segment] for segment in unlike}
        before = pooled_distance(those, known)
        moved = [each for each in moved if each.segment not in unlike]
        moved.append(PostureRepair(kind="unlike", before_m=before, after_m=float("nan"), names=tuple(unlike)))
    return tuple(moved)


def mirrored_places(known: Places) -> dict[str, Floats]:
    """Return the mirror image of a posture."""
    return {label: place * np.array([-1.0, 1.0, 1.0]) for label, place in known.items()}


def exchanged_sides(known: Mapping[str, Floats]) -> dict[str, Floats]:
    """Return a posture in which left and right labels are exchanged; labels without a counterpart are left out."""
    partner = side_pairs(tuple(known))
    return {label: known[partner[label]] for label in known if label in partner}


def side_pairs(labels: Sequence[str]) -> dict[str, str]:
    """Map each label to that of the other side: the one in which left and right, or L and R, are exchanged once.

    Args:
        labels: Labels of markers.

    Returns:
        The pairs, in both directions; labels without exactly one counterpart are missing.
    """
    there, pairs = set(labels), {}
    for label in labels:
        others = {_with_other_side(label, match) for match in _SIDES.finditer(label)} & there
        # The first letter is that of the side, if several letters would do: LLTHI is the partner of RLTHI.
        if others:
            pairs[label] = next(
                other for match in _SIDES.finditer(label) if (other := _with_other_side(label, match)) in others
            )
    return {label: other for label, other in pairs.items() if pairs.get(other) == label}


def _with_other_side(label: str, match: re.Match[str]) -> str:
    side = match.group()
    other = _OTHER_SIDE[side.lower()]
    other = other.upper() if side.isupper() else other.capitalize() if side[0].isupper() else other
    return label[: match.start()] + other + label[match.end() :]


def _shapes(
    trajectories: MarkerTrajectories, clusters: Sequence[Cluster], known: Places
) -> dict[str, dict[str, Floats]]:
    """Return the mean shape of each cluster in the trial: the places of its markers in a frame of its own [m]."""
    shapes = {}
    for cluster in clusters:
        labels = [label for label in cluster.labels if label in known]
        if len(labels) < MINIMUM_MARKERS:
            continue
        shape = mean_shape(in_cluster_frame(trajectories.select(labels).points)[0])
        found = {label: place for label, place in zip(labels, shape, strict=True) if np.isfinite(place).all()}
        if len(found) >= MINIMUM_MARKERS:
            shapes[cluster.segment] = found
    return shapes


def posture_distance(trajectories: MarkerTrajectories, clusters: Sequence[Cluster], known: Places) -> float:
    """Return how far the shapes of clusters in a trial are from those in a posture of another trial.

    Args:
        trajectories: Marker trajectories of the trial.
        clusters: Clusters of its markers.
        known: Positions of the markers in the posture [m].

    Returns:
        Root mean square distance of the markers, each cluster aligned [m]; NaN without three common markers.
    """
    return pooled_distance(_shapes(trajectories, clusters, known), known)


def pooled_distance(shapes: Mapping[str, Places], known: Places) -> float:
    """Return the root mean square distance of the markers of several clusters from a posture, each cluster aligned.

    Args:
        shapes: The markers of each cluster.
        known: Their positions in the posture [m].

    Returns:
        The distance [m]; NaN without three common markers in a cluster.
    """
    squares = [(_residuals(shape, known) ** 2).sum(-1) for shape in shapes.values()]
    every = np.concatenate([values[np.isfinite(values)] for values in squares]) if squares else np.zeros(0)
    return float(np.sqrt(every.mean())) if len(every) else float("nan")


def _residuals(shape: Places, known: Places) -> Floats:
    """Return the residuals (M, 3) of a rigid fit of the common markers [m]; NaN without a fit."""
    common = [label for label in shape if label in known]
    if len(common) < MINIMUM_MARKERS:
        return np.full((1, 3), np.nan)
    there, here = (np.array([places[label] for label in common]) for places in (known, shape))
    return np.asarray(fit_rigid(there, here[None], EQUAL_SD_M).residuals[0])


def _unit_factor(
    trajectories: MarkerTrajectories, clusters: Sequence[Cluster], known: Places, settings: PostureRepairSettings
) -> float:
    """Return the power of ten by which the trial is larger than the posture; 1 if no unit explains the ratio."""
    ratios = []
    for cluster in clusters:
        labels = [label for label in cluster.labels if label in known]
        points = trajectories.select(labels).points
        whole = np.isfinite(points).all((1, 2))
        if len(labels) >= 2 and whole.any():
            here = np.median(np.linalg.norm(points[whole] - points[whole].mean(1, keepdims=True), axis=(1, 2)))
            there = np.array([known[label] for label in labels])
            ratios.append(here / np.linalg.norm(there - there.mean(0)))
    if not ratios:
        return 1.0
    logarithm = float(np.log10(np.median(ratios)))
    return 10.0 ** round(logarithm) if abs(logarithm - round(logarithm)) < settings.unit_tolerance else 1.0


def _moved_marker(segment: str, shape: Places, known: Places, settings: PostureRepairSettings) -> PostureRepair | None:
    """Find the marker without which the rest of a cluster fits the posture."""
    before = pooled_distance({segment: shape}, known)
    if len(shape) <= MINIMUM_MARKERS:
        return None
    errors, apart = {}, {}
    for label in shape:
        rest = {other: place for other, place in shape.items() if other != label}
        errors[label], apart[label] = pooled_distance({segment: rest}, known), _displacement(label, rest, shape, known)
    usual = {label: error for label, error in errors.items() if np.isfinite(error)}
    if not usual:
        return None
    best = min(usual, key=lambda label: usual[label])
    explained = usual[best] < min(settings.unlike_m, settings.largest_rest_ratio * apart[best])
    if not explained or apart[best] < settings.least_moved_m:
        return None
    # Without the best one, three markers of four fit nearly always: then several may have moved.
    rivals = sorted(usual, key=lambda label: usual[label])
    limit = max(settings.largest_rival_ratio * usual[best], usual[best] + settings.least_gain_m / 2)
    names = tuple(label for label in rivals if usual[label] <= limit)
    return PostureRepair(
        kind="moved", before_m=before, after_m=usual[best], names=names, segment=segment, value=apart[best]
    )


def _displacement(label: str, rest: Places, shape: Places, known: Places) -> float:
    """Return the distance of a marker from the place that the others indicate [m]; NaN if they do not."""
    there, here = (np.array([places[other] for other in rest]) for places in (known, shape))
    fit = fit_rigid(there, here[None], EQUAL_SD_M)
    return float(np.linalg.norm(shape[label] - fit.rotation[0] @ known[label] - fit.translation[0]))

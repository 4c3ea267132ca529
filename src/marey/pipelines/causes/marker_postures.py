"""Causes of a misfit between a trial and its static trial, each tested by trying its repair."""

from collections.abc import Iterator, Sequence

import numpy as np

from marey.arrays import Floats
from marey.markers.data.clusters import Cluster
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.preprocessing.exchanges import LabelExchange, exchanges_against_posture, undo_exchanges
from marey.markers.preprocessing.own_frames import BonesAndMarkers
from marey.markers.preprocessing.posture_repairs import (
    Places,
    PostureRepair,
    posture_distance,
    posture_repairs,
)
from marey.pipelines.verdict import VerdictReason
from marey.wording import listed

LARGEST_LEAN_DEG = 60.0
"""Angle between a person who stands and the vertical axis above which another axis is vertical [deg]. The nearest other
axis is 90 degrees away; the legs of the standing person of `functional` are 8 degrees from it. Chosen by hand."""
_UPRIGHT = ("thigh", "femur", "shank", "tibia")
"""Segments, without their side, whose Y axis points up in a person who stands, and does not follow from their sides."""
_MM = 1e3
"""Millimetres in a metre."""


def posture_reasons(
    name: str, trajectories: MarkerTrajectories, clusters: Sequence[Cluster], bones: BonesAndMarkers
) -> tuple[VerdictReason, ...]:
    """Explain a misfit between the markers of a trial and those of its static trial.

    Args:
        name: Name of the static trial's file.
        trajectories: Markers of the trial.
        clusters: Segments of the trial.
        bones: Bones and markers in the static trial.

    Returns:
        The causes whose repair explains the misfit; empty if there is no misfit.
    """
    known = {
        label: place
        for label, place in zip(bones.labels, bones.points, strict=True)
        if label in trajectories.labels and np.isfinite(place).all()
    }
    exchanges = exchanges_against_posture(trajectories, clusters, bones.labels, bones.points)
    found = posture_repairs(trajectories, clusters, known)
    if any(each.kind in ("unit", "mirrored", "sides") for each in found):
        return tuple(posture_repair_reason(name, each) for each in found)
    corrected = undo_exchanges(trajectories, exchanges)
    return (
        *(_exchange_reason(name, exchange, trajectories, clusters, known) for exchange in exchanges),
        *(posture_repair_reason(name, each) for each in posture_repairs(corrected, clusters, known)),
    )


def _exchange_reason(
    name: str, exchange: LabelExchange, trajectories: MarkerTrajectories, clusters: Sequence[Cluster], known: Places
) -> VerdictReason:
    own = [cluster for cluster in clusters if set(exchange.labels) & set(cluster.labels)]
    before, after = (
        posture_distance(each, own, known) for each in (trajectories, undo_exchanges(trajectories, [exchange]))
    )
    what = (
        f"Compared with {name}, {exchange.note.rstrip('.')}: exchanged back, the markers of {own[0].segment} differ by "
        f"{_mm(after)} instead of {_mm(before)} (RMS)."
    )
    remedy = "Exchange the two labels, in the trial or in the static trial."
    return VerdictReason.failure(what, remedy, cause="exchanged")


def posture_repair_reason(
    name: str, repair: PostureRepair, *, trial: str = "", posture: str = "static trial"
) -> VerdictReason:
    """Describe what explains that markers have another shape than in another trial, with what its repair achieves.

    Args:
        name: Name of the other trial.
        repair: What explains it.
        trial: Name of the file with the markers; empty if it is the trial of the run.
        posture: What one of the two is, for the remedies: `static trial` or `reference`.
    """
    achieved = f"the markers differ from {name} by {_mm(repair.after_m)} instead of {_mm(repair.before_m)} (RMS)"
    if repair.kind == "unit":
        what = (
            f"The markers{f' of {trial}' if trial else ''} are {repair.value:g} times as far apart as in {name}; "
            f"divided by this, they differ by {_mm(repair.after_m)} (RMS). One of the two files states a wrong unit."
        )
        remedy = "Correct the unit in that file; unit (--unit) applies to both."
        return VerdictReason.failure(what, "Correct the unit in that file." if trial else remedy, cause="unit")
    if repair.kind == "mirrored":
        what = f"{trial or 'The trial'} is a mirror image of {name}: mirrored back, {achieved}."
        remedy = "Correct the sign of one axis in the program that exported the file."
        return VerdictReason.failure(what, remedy, cause="mirrored")
    if repair.kind == "sides":
        what = f"Left and right labels{f' of {trial}' if trial else ''} are exchanged: exchanged back, {achieved}."
        remedy = f"Exchange the labels of the two sides, in the trial or in the {posture}."
        return VerdictReason.failure(what, remedy, cause="sides")
    if repair.kind == "moved":
        markers = " or ".join(repair.names)
        what = (
            f"{repair.segment}: {markers} is {_mm(repair.value)} from its place in {name}; without it, {achieved}. "
            "It moved on the segment, or was fixed anew."
        )
        remedy = f"Leave this marker out of [segments], or record another {posture}."
        return VerdictReason.limit(what, remedy, cause="moved")
    what = (
        f"{listed(repair.names)}: the markers differ from {name} by {_mm(repair.before_m)} (RMS), and no unit, mirror "
        f"image or exchange explains it; one person has 7 mm at most. The {posture} is of another person, or of "
        "markers that were fixed anew."
    )
    return VerdictReason.failure(what, f"Give the {posture} of the same person and session.", cause="unexplained")


def _mm(metres: float) -> str:
    return f"{_MM * metres:.0f} mm"


def standing_reasons(name: str, bones: BonesAndMarkers, *, y_up: bool) -> Iterator[VerdictReason]:
    """Check the bones of a standing person: which side is which, and which axis is vertical.

    Args:
        name: Name of the static trial's file.
        bones: Bones in the static trial.
        y_up: Whether the file states, or implies, that Y is the vertical axis; otherwise Z is.

    Yields:
        The contradictions.
    """
    up = _upward(bones)
    yield from _sides(name, bones, up)
    if up is None:
        return
    vertical = np.eye(3)[1 if y_up else 2]
    lean = float(np.degrees(np.arccos(np.clip(up @ vertical, -1, 1))))
    if lean > LARGEST_LEAN_DEG:
        axis = int(np.argmax(np.abs(up)))
        sign = "-" if up[axis] < 0 else ""
        what = (
            f"The person in {name} stands along {sign}{'XYZ'[axis]} of the laboratory, {lean:.0f} degrees from "
            f"{'Y' if y_up else 'Z'}, which the file has as vertical: gait events and exported motions are wrong."
        )
        yield VerdictReason.limit(what, "Export the trials with the vertical axis that the file format has.")


def _upward(bones: BonesAndMarkers) -> Floats | None:
    """Return the direction (3,) in which the bones of the legs point upwards; None if there are none."""
    axes = [
        bones.rotation[s, :, 1]
        for s, segment in enumerate(bones.segments)
        if segment.removeprefix("left_").removeprefix("right_") in _UPRIGHT
    ]
    if not axes:
        return None
    total = np.sum(axes, axis=0)
    return np.asarray(total / np.linalg.norm(total))


def _sides(name: str, bones: BonesAndMarkers, up: Floats | None) -> Iterator[VerdictReason]:
    """Compare the sides of pelvis and thighs, whose left and right follow from their labels."""
    if "pelvis" not in bones.segments:
        return
    pelvis = bones.rotation[bones.segments.index("pelvis")]
    if up is not None and pelvis[:, 1] @ up < 0:
        what = (
            f"The pelvis in {name} is upside down: the landmarks of its left and right are exchanged, or the file is "
            "a mirror image."
        )
        remedy = "Correct RASIS, LASIS, RPSIS and LPSIS in [landmarks], or the axes of the file."
        yield VerdictReason.failure(what, remedy)
        return
    legs = [f"{side}_thigh" for side in ("left", "right")]
    if not set(legs) <= set(bones.segments):
        return
    left, right = (bones.origin[bones.segments.index(leg)] for leg in legs)
    if (right - left) @ pelvis[:, 2] < 0:
        what = f"In {name} the left thigh is on the right of the pelvis: left and right are exchanged."
        yield VerdictReason.failure(what, "Exchange the labels of the legs, or the landmarks of the pelvis.")

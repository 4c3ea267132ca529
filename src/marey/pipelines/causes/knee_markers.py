"""Causes of balls in the scanner that do not correspond to markers of the laboratory, each tested by its repair."""

import numpy as np

from marey.arrays import Floats
from marey.knee.markers.marker_bones import bone_of_segment
from marey.knee.markers.marker_repairs import (
    MARKER_REPAIR_DEFAULTS,
    Correspondents,
    MarkerMisfit,
    MarkerRepair,
    best_repair,
    marker_misfit,
    mirrored_scan,
)
from marey.knee.markers.reference_posture import Activity
from marey.markers.data.clusters import MINIMUM_MARKERS, Cluster
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.preprocessing.posture_repairs import posture_repairs
from marey.pipelines.causes.marker_postures import posture_repair_reason
from marey.pipelines.verdict import VerdictReason

_EXPLAINED = ("unit", "mirrored", "sides")
"""Kinds of contradictions between two trials that a repair explains."""
_SIDES = {True: "left", False: "right"}
"""Names of the sides by whether it is the left one."""


def reference_reasons(reference: str, standing: MarkerTrajectories, activity: Activity) -> tuple[VerdictReason, ...]:
    """Explain why the markers of the reference do not have the shape that they have in the activity.

    Args:
        reference: Name of the reference's file.
        standing: The reference, in which the person stands.
        activity: The motion of the bones, with its markers.

    Returns:
        What was found; empty if the shapes agree.
    """
    known: dict[str, Floats] = {}
    clusters = []
    for segment in activity.motion.segments:
        attached = [label for label, name in activity.segment_of_label.items() if name == segment]
        labels = tuple(label for label in attached if label in standing.labels)
        if bone_of_segment(segment) is None or len(labels) < MINIMUM_MARKERS:
            continue
        places = dict(zip(labels, activity.places(segment, labels), strict=True))
        known |= {label: place for label, place in places.items() if np.isfinite(place).all()}
        clusters.append(Cluster(segment=segment, labels=labels))
    return tuple(
        posture_repair_reason("the activity", repair, trial=reference, posture="reference")
        for repair in posture_repairs(standing, clusters, known)
    )


def explained(reasons: tuple[VerdictReason, ...]) -> bool:
    """Return whether a repair of the whole trial explains what was found.

    Args:
        reasons: What was found in the reference.
    """
    return any(reason.cause in _EXPLAINED for reason in reasons)


def repaired_reasons(given: Correspondents) -> tuple[VerdictReason, ...]:
    """Name the repair with which balls and markers correspond.

    Args:
        given: Scanner and laboratory.

    Returns:
        At most one reason, with the cause; empty if they correspond, or if nothing explains that they do not.
    """
    own = marker_misfit(given)
    found = best_repair(given, own)
    return () if found is None else (_repair_reason(found[0], own, found[1]),)


def unexplained_reasons(given: Correspondents) -> tuple[VerdictReason, ...]:
    """Name what does not fit between balls and markers, if no repair explains it.

    Args:
        given: Scanner and laboratory.

    Returns:
        The reasons; empty if balls and markers correspond.
    """
    own = marker_misfit(given)
    if own is None:
        return ()
    limits, reasons = MARKER_REPAIR_DEFAULTS, []
    if own.residual_mm > limits.most_residual_mm:
        what = (
            f"Balls and markers of the same names lie {_mm(own.residual_mm)} from each other (RMS, each bone aligned), "
            "and no unit, mirror image, side or exchange of two names explains it; put back with care, they differ by "
            "a few millimetres. The names are wrong, or the reference is of another person or session."
        )
        remedy = "Check marker_names in markers.json, and give the reference of the same person and session."
        reasons.append(VerdictReason.failure(what, remedy, cause="unexplained"))
    if own.apart_mm > limits.most_apart_mm or own.turned > limits.most_turned:
        what = (
            f"In the reference, the femur is {_mm(own.apart_mm)} from the place of the scan that the tibia predicts, "
            f"and the knee is turned by {np.degrees(own.turned):.0f} degrees: the balls do not determine both poses."
        )
        make = VerdictReason.failure if own.apart_mm > 2 * limits.most_apart_mm else VerdictReason.limit
        reasons.append(make(what, "Check the names of the balls and their bones (marker_segment).", cause="apart"))
    if own.turned_round():
        what = f"{_turned_text(own)}: the balls, or the bones, are probably not in LPS."
        remedy = "Check that markers.json and the surfaces are in LPS (x to the left, y to the back, z up)."
        reasons.append(VerdictReason.limit(what, remedy, cause="apart"))
    if own.from_bones_mm > limits.most_from_bones_mm:
        what = f"The balls are {_mm(own.from_bones_mm)} from femur and tibia (median)."
        remedy = "Check that markers.json and the surfaces of the bones are of one volume (LPS, mm)."
        reasons.append(VerdictReason.limit(what, remedy, cause="apart"))
    return tuple(reasons)


def other_leg_reasons(given: Correspondents, motion: str, *, scanned_left: bool) -> tuple[VerdictReason, ...]:
    """Explain why the activity has the bones of the other leg: it is the other leg, or a mirror image.

    Args:
        given: Scanner and laboratory, with the side of the activity.
        motion: Name of the folder of the activity.
        scanned_left: Whether the scanned knee is a left one.
    """
    own = marker_misfit(given)
    turned = marker_misfit(mirrored_scan(given))
    other, scanned = _SIDES[not scanned_left], _SIDES[scanned_left]
    contradiction = (
        f"the activity in {motion} has the bones of the {other} leg, but the scanned knee is a {scanned} one"
    )
    if turned is not None and _mirror_image(own, turned):
        what = (
            f"Scanner and laboratory are mirror images of each other: {contradiction}, and with the scan mirrored, "
            f"{_achieved(own, turned)}."
        )
        return (VerdictReason.failure(what, _MIRROR_REMEDY, cause="mirrored"),)
    evidence = "" if own is None or turned is None else (
        f": the balls lie {_mm(own.residual_mm)} from the markers of the laboratory (RMS) as they are, and "
        f"{_mm(turned.residual_mm)} as a mirror image"
    )  # fmt: skip
    remedy = (
        f"Give the motion of the {scanned} leg, or side (--side {other}) if the position of the patella is misleading."
    )
    return (VerdictReason.failure(f"{contradiction[0].upper()}{contradiction[1:]}{evidence}.", remedy, cause="sides"),)


_MIRROR_REMEDY = (
    "Correct the sign of one axis: in markers.json and the volume (LPS), or in the program that exported the trials."
)
"""What to do about a mirror image."""


def _mirror_image(own: MarkerMisfit | None, turned: MarkerMisfit) -> bool:
    """Return whether balls and markers correspond as a mirror image only."""
    limits = MARKER_REPAIR_DEFAULTS
    if not turned.plausible() or turned.residual_mm > limits.explained_mm:
        return False
    if own is None:
        return True
    fits = own.residual_mm > limits.least_residual_mm and turned.residual_mm < limits.largest_ratio * own.residual_mm
    return fits or not own.plausible()


def _repair_reason(repair: MarkerRepair, own: MarkerMisfit | None, after: MarkerMisfit) -> VerdictReason:
    """Describe one repair, with what it achieves; names that the fit leaves out on both bones are a limit only."""
    make = VerdictReason.failure
    if repair.kind == "unit":
        what, remedy = _unit_texts(repair)
    elif repair.kind == "mirrored":
        what, remedy = "Scanner and laboratory are mirror images of each other: with one mirrored", _MIRROR_REMEDY
    elif repair.kind == "axes":
        axes = " and ".join(repair.names)
        what = f"The axes of markers.json are not those of the bones: with the signs of {axes} changed"
        remedy = "Write the balls in LPS (x to the left, y to the back, z up); RAS has other signs of x and y."
    elif repair.kind == "names":
        what = f"The names {' and '.join(repair.names)} are exchanged: exchanged back"
        remedy = "Exchange the two names in markers.json, or the labels in the reference."
        if own is not None and own.residual_mm < MARKER_REPAIR_DEFAULTS.least_residual_mm:
            make = VerdictReason.limit
            what = f"The names {' and '.join(repair.names)} are exchanged, and these balls are ignored: exchanged back"
    else:
        what = "The names in markers.json are those of the other leg: with left and right exchanged"
        remedy = "Correct marker_names in markers.json, or the labels of the reference."
    cause = "exchanged" if repair.kind == "names" else repair.kind
    return make(f"{what}, {_achieved(own, after)}.", remedy, cause=cause)


def _unit_texts(repair: MarkerRepair) -> tuple[str, str]:
    by = f"with coordinates multiplied by {repair.factor:g}"
    if repair.of == "laboratory":
        remedy = "Correct the unit of the activity (`marey markers --unit`) and of the reference."
        return f"The unit of the laboratory's markers is wrong: {by}", remedy
    if repair.of == "scan":
        return f"The unit of bones and balls is wrong: {by}", "Correct the unit of the volume, and segment it again."
    return f"The unit of markers.json is wrong: {by}", "Write marker_centres_lps_mm in millimetres."


def _achieved(own: MarkerMisfit | None, after: MarkerMisfit) -> str:
    """State what a repair improves most."""
    if own is None:
        return (
            f"the balls lie {_mm(after.residual_mm)} from the markers of the laboratory (RMS), and without this they "
            "cannot be identified"
        )
    for now, before in ((after.residual_mm, own.residual_mm), (after.every_mm, own.every_mm)):
        if now < MARKER_REPAIR_DEFAULTS.largest_ratio * before:
            return f"the balls lie {_mm(now)} from the markers of the laboratory instead of {_mm(before)} (RMS)"
    if own.turned_round():
        text = _turned_text(own)
        return f"this is no longer so: {text[0].lower()}{text[1:]}"
    if not own.apart_mm < 2 * after.apart_mm:
        return f"femur and tibia are {_mm(after.apart_mm)} apart in the reference instead of {_mm(own.apart_mm)}"
    return f"the balls are {_mm(after.from_bones_mm)} from the bones instead of {_mm(own.from_bones_mm)} (median)"


def _turned_text(own: MarkerMisfit) -> str:
    """State what shows that the bones are turned round in the laboratory."""
    if own.forward > MARKER_REPAIR_DEFAULTS.most_forward:
        return f"The knee bends forwards by {np.degrees(own.forward):.0f} degrees in the activity"
    return f"The markers of thigh and shank lie {_mm(-own.beyond_mm)} on the other side of the knee than their bones"


def _mm(length: float) -> str:
    """Return a length [mm] with its unit, in metres if it is long."""
    if length >= 1e4:
        return f"{length / 1e3:.0f} m"
    return f"{length:.1f} mm" if length < 10 else f"{length:.0f} mm"

"""Causes of a template's bone that does not fit a subject's, each tested by trying its repair."""

import numpy as np

from marey.errors import MareyError
from marey.knee.registration.sided import SidedRegistration, register_on_either_side
from marey.knee.space.surface import TriangleSurface
from marey.pipelines.verdict import VerdictReason

_UNIT_TOLERANCE = 0.25
"""Largest difference between the decimal logarithm of the ratio of two bones' lengths and that of two units: an image
may show 1.8 times as much of a bone as another one. Chosen by hand."""
_FITTING_MM = 5.0
"""Mean distance after a repair and the rigid registration below which bones fit [mm]. The patella of `phantom_a` is
2.5 mm from that of `phantom_spl`; a tibia lies 16 mm from it, and cannot be registered. Chosen by hand."""


def unit_reasons(
    template: TriangleSurface, subject: TriangleSurface, found: SidedRegistration | None
) -> tuple[VerdictReason, ...]:
    """Explain by a wrong unit why a template's bone does not fit a subject's.

    Args:
        template: The template, joined.
        subject: The subject's bone, joined.
        found: The registration that does not fit; None if there is none.

    Returns:
        At most one reason, with the cause; empty if no unit explains it.
    """
    before = np.inf if found is None else found.rigid.surface_distance_mm
    factor = _unit_factor(template, subject)
    if factor == 1:
        return ()
    scaled = TriangleSurface(vertices_mm=template.vertices_mm * factor, faces=template.faces)
    after = _distance(scaled, subject)
    if after > min(_FITTING_MM, before):
        return ()
    what = (
        f"The unit of one bone is wrong: with the coordinates of the template multiplied by {factor:g}, the bones are "
        f"{after:.1f} mm from each other (mean, rigid){_instead(before)}."
    )
    return (VerdictReason.failure(what, "Correct the unit of that mesh (millimetres).", cause="unit"),)


def side_reasons(
    template: TriangleSurface, subject: TriangleSurface, mirror: bool | None, *, fits: bool
) -> tuple[VerdictReason, ...]:
    """Name a side of the template that was given, and that the shapes of the bones contradict.

    Args:
        template: The template, joined.
        subject: The subject's bone, joined.
        mirror: Whether the template was given as one of the other side; None if both sides were tried.
        fits: Whether the bones fit each other after an elastic registration.

    Returns:
        At most one reason; empty if no side was given, or if the shapes do not contradict it. A side that fits better,
        but not clearly so, is a limit.
    """
    if mirror is None:
        return ()
    try:
        sided = register_on_either_side(template, subject)
    except MareyError:
        return ()
    if sided.mirrored == mirror:
        return ()
    wrong, right = sorted((sided.same_side_mm, sided.other_side_mm), reverse=True)
    if not sided.clear:
        what = (
            f"The template may be of the {'other' if sided.mirrored else 'same'} side, and not as given: its distance, "
            f"scaled to the bone, is then {right:.2f} mm instead of {wrong:.2f} mm, which is not clear."
        )
        return (VerdictReason.limit(what, "Check of which side both bones are.", cause="sides"),)
    what = (
        f"The template is of the {'other' if sided.mirrored else 'same'} side, and not as given: its distance, scaled "
        f"to the bone, is {right:.2f} mm instead of {_millimetres(wrong)}."
    )
    remedy = f"Leave out mirror={mirror} ({'--mirror' if mirror else '--no-mirror'}), or give the other one."
    make = VerdictReason.limit if fits else VerdictReason.failure
    return (make(what, remedy, cause="sides"),)


def tried_text(found: SidedRegistration) -> str:
    """Return what was tried without success, with its figures, as a sentence.

    Args:
        found: The registration that does not fit.
    """
    rigid = f"Moved rigidly, the bones are {found.rigid.surface_distance_mm:.2f} mm from each other"
    sides = (found.same_side_mm, found.other_side_mm)
    if not np.isfinite(sides).all():
        return f"{rigid}; no unit or other side explains it."
    scaled = f"scaled to one size {sides[0]:.2f} mm on the same side and {sides[1]:.2f} mm on the other one"
    return f"{rigid}, and {scaled}; no unit explains it."


def _unit_factor(template: TriangleSurface, subject: TriangleSurface) -> float:
    """Return the power of ten by which the subject is larger than the template; 1 if no unit explains the ratio."""
    lengths = [float(np.linalg.norm(np.ptp(each.vertices_mm, axis=0))) for each in (template, subject)]
    logarithm = float(np.log10(lengths[1] / lengths[0]))
    return 10.0 ** round(logarithm) if abs(logarithm - round(logarithm)) < _UNIT_TOLERANCE else 1.0


def _distance(template: TriangleSurface, subject: TriangleSurface) -> float:
    """Return the mean distance after a rigid registration on the better side [mm]; infinite if there is none."""
    try:
        return register_on_either_side(template, subject).rigid.surface_distance_mm
    except MareyError:
        return float("inf")


def _instead(before: float) -> str:
    return f" instead of {before:.1f} mm" if np.isfinite(before) else "; without this they cannot be registered"


def _millimetres(distance: float) -> str:
    return f"{distance:.2f} mm" if np.isfinite(distance) else "not to be registered"

"""The record of a segmented knee, and the verdict on it."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from marey.io.mr.gadolinium import MarkersInScanner
from marey.knee.bones.bones import BoneSegmentation
from marey.knee.cartilage.knee_cartilage import KneeCartilage
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.volume import Volume
from marey.pipelines.knee.cartilage import CartilageMaps, known_side
from marey.pipelines.verdict import Verdict, VerdictReason
from marey.view.pages.problems import readable

LONG_BONES = ("femur", "tibia")
"""Bones without which nothing can be measured of the joint."""
UNKNOWN_SIDE = "The side of the knee is not known: medial and lateral parts are not measured."
"""What follows from an unknown side."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FoundKnee:
    """Everything that was found in the images of a knee."""

    title: str
    """Name of the images, for the report."""
    volume: Volume
    """The first image."""
    bones: BoneSegmentation
    surfaces: Mapping[str, TriangleSurface]
    """Surfaces of the bones by name."""
    cartilage: KneeCartilage | None = None
    """The cartilage; None if there is none, or no template was given."""
    maps: CartilageMaps = field(default_factory=CartilageMaps)
    """Parts of the cartilages."""
    markers: MarkersInScanner | None = None
    """Gadolinium markers; None if there are none."""
    missing: Mapping[str, str] = field(default_factory=dict)
    """Structures that were not found, with the reason."""
    side: str | None = None
    """`left` or `right`, if it was given."""


def knee_verdict(found: FoundKnee) -> Verdict:
    """Return the verdict on a segmented knee.

    Args:
        found: Everything that was found in the images.
    """
    reasons = [_missing(name, why) for name, why in found.missing.items()]
    reasons += map(VerdictReason.limit, found.bones.limits)
    if found.cartilage is not None:
        reasons += map(VerdictReason.limit, found.cartilage.notes)
        if known_side(found.surfaces, found.side) is None:
            reasons.append(VerdictReason.limit(UNKNOWN_SIDE, "Give side (--side)."))
    return Verdict.of(reasons)


def _missing(name: str, why: str) -> VerdictReason:
    make = VerdictReason.failure if name in LONG_BONES else VerdictReason.limit
    return make(f"The {readable(name)} was not found. {why}")

"""The record of a segmented knee."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from marey.io.mr.gadolinium import MarkersInScanner
from marey.knee.bones.bones import BoneSegmentation
from marey.knee.cartilage.knee_cartilage import KneeCartilage
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.volume import Volume
from marey.pipelines.knee.cartilage import CartilageMaps


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

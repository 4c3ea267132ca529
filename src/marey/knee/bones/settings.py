"""Settings of the bone segmentation."""

from dataclasses import dataclass

from marey.knee.bones.bone_edges import BONE_EDGE_DEFAULTS, BoneEdgeSettings
from marey.knee.bones.bright_marrow import BRIGHT_MARROW_DEFAULTS, BrightMarrowSettings
from marey.knee.bones.marrow import MARROW_DEFAULTS, MarrowSettings
from marey.knee.bones.partial_view import PARTIAL_VIEW_DEFAULTS, PartialViewSettings
from marey.knee.bones.region_growing import GROWING_DEFAULTS, GrowingSettings
from marey.knee.bones.seeds import SEED_DEFAULTS, SeedSettings
from marey.knee.bones.template_fit import TEMPLATE_FIT_DEFAULTS, TemplateFitSettings


@dataclass(frozen=True, kw_only=True)
class BoneSettings:
    """Settings of the stages of `segment_bones`, and of the algorithms they use.

    Values without a stated source were chosen by hand.
    """

    marrow: MarrowSettings = MARROW_DEFAULTS
    seeds: SeedSettings = SEED_DEFAULTS
    growing: GrowingSettings = GROWING_DEFAULTS
    partial_view: PartialViewSettings = PARTIAL_VIEW_DEFAULTS
    template_fit: TemplateFitSettings = TEMPLATE_FIT_DEFAULTS
    bright_marrow: BrightMarrowSettings = BRIGHT_MARROW_DEFAULTS
    edges: BoneEdgeSettings = BONE_EDGE_DEFAULTS

    least_shared_body: float = 0.8
    """Two volumes show one knee when at least this share of the smaller body lies in the other."""
    disc_mm: float = 4.0
    """Radius [mm] of the discs of voxels that are examined along the line between two seeds."""
    gap_mm: float = 3.0
    """Two seeds are in different bones when a gap of this width [mm] lies between them: two cortices and the cartilage
    between them are thicker, the scar of a growth plate is thinner."""
    wider: float = 1.25
    """A long bone's thick end has at least this many times the cross-section of its other end."""
    template_margin_mm: float = 6.0
    """Farthest [mm] that a single long bone may grow beyond the placed template."""
    dim_marrow_margin_mm: float = 24.0
    """Margin [mm] about a bone in which it may be extended into dimmer marrow."""
    patella_cm3: tuple[float, float] = (4.0, 45.0)
    """Least and largest volume [cm3] of a patella."""
    largest_bright_patella: float = 1.6
    """Largest volume of a patella with bright marrow, as a multiple of the template's."""
    largest_patella: float = 1.4
    """Largest volume of a patella beside a single long bone, as a multiple of the template's."""
    outside_template_mm: float = 4.0
    """Voxels farther [mm] than this outside the template's bone are removed from the grown bone."""
    inside_template_mm: float = 2.0
    """Voxels deeper [mm] than this inside the template's bone are added to the grown bone."""
    prior_from_mm: float = 2.0
    """Distance [mm] outside the template's surface at which the prior begins to count against bone."""
    prior_nats: float = 4.0
    """Largest absolute value of the prior's log odds."""
    margin_mm: float = 8.0
    """Margin [mm] about a grown bone in which its edge is refined."""
    bright_margin_mm: float = 16.0
    """The same margin [mm] about bones with bright marrow that are cut along the dark line."""
    least_marrow: float = 0.5
    """A refined bone is rejected when less than this share of it resembles the marrow at its seed."""
    outgrowth_cm3: float = 1.0
    """Outgrowths of at least this volume [cm3] are reported."""
    largest_thin_share: float = 0.045
    """A bone is reported as leaked when a larger share of its volume lies in thin parts: 0.7 to 2.3 % of the
    references' femora and tibiae, up to 2.7 % of those found by a template, and 6 % of the femur of `dess`, which leaks
    without one (measured when it was chosen)."""


BONE_DEFAULTS = BoneSettings()
"""Default settings of the bone segmentation."""

"""Measurements of a person that marker sets need: leg lengths, widths of knees and ankles, diameter of the markers."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

LENGTHS: Mapping[str, tuple[float, float]] = MappingProxyType(
    {"leg_length": (0.3, 1.4), "knee_width": (0.04, 0.25), "ankle_width": (0.03, 0.2)}
)
"""Measurements of each side, and the range in which they are accepted [m]: from a small child to the largest adult.
Chosen by hand."""
DIAMETERS = (0.002, 0.05)
"""Range in which the diameter of the markers is accepted [m]. Chosen by hand."""
USUAL_DIAMETER_M = 0.014
"""Diameter of the markers if nothing states it [m]: the value in the settings of pyCGM2."""


@dataclass(frozen=True, kw_only=True)
class PersonMeasurements:
    """Lengths of a person's body that were measured by hand, and the diameter of the markers."""

    lengths: Mapping[str, float] = field(default_factory=dict)
    """Maps `left_knee_width`, `right_leg_length`, ... to a length [m]."""
    diameter_m: float | None = None
    """Diameter of the markers [m]; None if it is not stated."""

    def length(self, side: str, what: str) -> float | None:
        """Return a measurement of one side [m]; None if it is unknown.

        Args:
            side: `left` or `right`.
            what: A name of `LENGTHS`.
        """
        return self.lengths.get(f"{side}_{what}")

    def completed_by(self, other: "PersonMeasurements") -> "PersonMeasurements":
        """Return these measurements with those of another source where they are missing here.

        Args:
            other: The other source.
        """
        return PersonMeasurements(
            lengths={**other.lengths, **self.lengths},
            diameter_m=other.diameter_m if self.diameter_m is None else self.diameter_m,
        )

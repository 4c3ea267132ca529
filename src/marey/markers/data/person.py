"""Measurements of a person that marker sets need: leg lengths, widths of knees and ankles, diameter of the markers."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
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
DIAMETER_SD_M = 0.003
"""Standard deviation of that diameter [m]: that of a uniform distribution over 9.5 to 19 mm, the usual diameters."""
DIAMETER = "marker_diameter"
"""Name of the diameter among the measurements."""
ASSUMED_WIDTHS: Mapping[str, tuple[float, float]] = MappingProxyType(
    {"knee_width": (0.1, 0.009), "ankle_width": (0.07, 0.006)}
)
"""Widths of joints that nothing states, and their standard deviations [m]: mean of ten people in public recordings of
gait, and root mean square error for a person who is left out. A width in proportion to the leg length, or linear in it,
predicts the left-out person worse (`python -m bench run markers/assumed_widths`)."""
OTHER_SIDE_SD_M = 0.0025
"""Standard deviation of a width from that of the other side [m]: root mean square difference between the sides of the
same people (`python -m bench run markers/assumed_widths`)."""


@dataclass(frozen=True, kw_only=True)
class AssumedMeasurement:
    """A measurement of the person that nothing states."""

    name: str
    """`left_knee_width`, ... or `marker_diameter`."""
    value_m: float
    """The value that is used [m]."""
    sd_m: float
    """Its standard deviation [m]."""
    source: str
    """Where the value is from, as part of a sentence: `the mean of other people`."""
    of_others: bool = False
    """Whether it is the width of a joint that nothing on this person shows."""


def assumed_text(assumed: Iterable[AssumedMeasurement]) -> str:
    """Return assumed measurements with their standard deviations and sources, equal ones together.

    Args:
        assumed: The measurements.
    """
    groups: dict[str, list[str]] = {}
    for one in assumed:
        value = f"{1e3 * one.value_m:.0f} mm, standard deviation {1e3 * one.sd_m:.1f} mm ({one.source})"
        groups.setdefault(value, []).append(one.name.replace("_", " "))
    return "; ".join(f"{' and '.join(names)} {value}" for value, names in groups.items())


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

    def width(self, side: str, what: str) -> float | AssumedMeasurement:
        """Return the width of a joint [m]; an assumed one if it is unknown on this side.

        Args:
            side: `left` or `right`.
            what: `knee_width` or `ankle_width`.
        """
        known = self.length(side, what)
        if known is not None:
            return known
        name, other = f"{side}_{what}", "right" if side == "left" else "left"
        measured = self.length(other, what)
        if measured is not None:
            source = f"that of the {other} side"
            return AssumedMeasurement(name=name, value_m=measured, sd_m=OTHER_SIDE_SD_M, source=source)
        value, sd = ASSUMED_WIDTHS[what]
        return AssumedMeasurement(name=name, value_m=value, sd_m=sd, source="the mean of other people", of_others=True)

    def diameter(self) -> float | AssumedMeasurement:
        """Return the diameter of the markers [m]; an assumed one if it is unknown."""
        if self.diameter_m is not None:
            return self.diameter_m
        return AssumedMeasurement(
            name=DIAMETER, value_m=USUAL_DIAMETER_M, sd_m=DIAMETER_SD_M, source="the usual diameter"
        )

    def with_value(self, name: str, value_m: float) -> "PersonMeasurements":
        """Return these measurements with another value of one of them.

        Args:
            name: `left_knee_width`, ... or `marker_diameter`.
            value_m: The value [m].
        """
        if name == DIAMETER:
            return replace(self, diameter_m=value_m)
        return replace(self, lengths={**self.lengths, name: value_m})

    def with_assumed(self, assumed: Iterable[AssumedMeasurement]) -> "PersonMeasurements":
        """Return these measurements with assumed values.

        Args:
            assumed: The assumed measurements.
        """
        person = self
        for one in assumed:
            person = person.with_value(one.name, one.value_m)
        return person

    def completed_by(self, other: "PersonMeasurements") -> "PersonMeasurements":
        """Return these measurements with those of another source where they are missing here.

        Args:
            other: The other source.
        """
        return PersonMeasurements(
            lengths={**other.lengths, **self.lengths},
            diameter_m=other.diameter_m if self.diameter_m is None else self.diameter_m,
        )

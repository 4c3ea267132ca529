"""Angles that another program wrote into the file of a trial."""

from dataclasses import dataclass

from marey.arrays import Floats, freeze_fields


@dataclass(frozen=True, eq=False, kw_only=True)
class GivenAngles:
    """Three angles for each of A labels, such as `LHipAngles`, over F frames, as another program computed them."""

    labels: tuple[str, ...]
    """A labels."""
    values: Floats
    """(F, A, 3) angles [rad]; NaN where missing."""

    def __post_init__(self) -> None:
        freeze_fields(self, "values")

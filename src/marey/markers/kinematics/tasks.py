"""Tasks of inverse kinematics as in OpenSim: markers and coordinates to follow, each with its weight."""

from dataclasses import dataclass

from marey.errors import MareyError


@dataclass(frozen=True, eq=False, kw_only=True)
class MarkerTask:
    """A marker to follow."""

    label: str
    weight: float
    """Weight of the squared distance relative to the other markers: an inverse variance in an arbitrary common unit,
    which is estimated from the trial's residuals."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CoordinateTask:
    """A coordinate with a target value."""

    coordinate: str
    weight: float
    """Weight of the squared difference [1/rad^2 or 1/m^2] against the markers' weighted mean squared distance [m^2]."""
    value: float | None = None
    """Target value [rad or m]; None for the model's default."""
    from_file: bool = False
    """Whether the target value of each frame comes from a table."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TaskSet:
    """All tasks of a trial."""

    markers: tuple[MarkerTask, ...]
    coordinates: tuple[CoordinateTask, ...] = ()

    def __post_init__(self) -> None:
        for kind, names in (
            ("marker", [t.label for t in self.markers]),
            ("coordinate", [t.coordinate for t in self.coordinates]),
        ):
            twice = sorted({name for name in names if names.count(name) > 1})
            if twice:
                raise MareyError(f"Two tasks follow the {kind} {', '.join(twice)}.")
        for weight in [t.weight for t in self.markers] + [t.weight for t in self.coordinates]:
            if not 0 <= weight < float("inf"):
                raise MareyError(f"A task has the weight {weight}; it should be 0 or more.")

"""What a user says of the markers: which ride on which segment, where landmarks are, which joints there are."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from marey.arrays import Floats


@dataclass(frozen=True, eq=False, kw_only=True)
class MarkerJoint:
    """A joint between two segments."""

    name: str
    parent: str
    child: str
    degrees_of_freedom: int | None = None
    """1 a hinge, 3 a ball joint, 6 a joint that holds nothing; None: not said."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SkinChoice:
    """How the markers of one segment move over the bone, as interval deformation should take it."""

    form: str
    """`constant`, `time`, `turn`, `sinusoid`, `spline`, or `file`."""
    period_s: float | None = None
    """Of a sinusoid [s]; None: found from the joint's motion."""
    pieces: int | None = None
    """Of a spline."""
    functions: Floats | None = None
    """(F, Q) the user's own functions of time, for `file`."""
    still: tuple[str, ...] = ()
    """Markers that do not move over the bone."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MarkerSetup:
    """What the markers' TOML says; everything may be left out."""

    segments: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Segment to the labels of its markers (or patterns such as `LF*`); empty: found from the labels."""
    landmarks: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Anatomical landmark (`left_LE`) to the marker that was put on it, or to several whose middle it is."""
    joints: tuple[MarkerJoint, ...] = ()
    noise_m: float | None = None
    """Standard deviation of a marker's measured coordinate [m]; None: not said."""
    skin: Mapping[str, SkinChoice] = field(default_factory=dict)
    """Segment to how its markers move over the bone; a segment that is not here: chosen by a criterion."""

"""Position and orientation of a body's segments over time, by the names of the segments."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.geometry import rotations
from marey.motion.motion import BodyMotion
from marey.pipelines.labelled import Curve, find_name
from marey.view.pages.problems import readable
from marey.wording import count_of


@dataclass(frozen=True, eq=False, kw_only=True)
class SegmentMotion:
    """The position and orientation of one segment over F frames."""

    name: str
    """Its name, as in the files."""
    origin: Curve
    """Its proximal joint centre, components x, y, z in the world (Z up) [m]."""
    rotation: Floats
    """(F, 3, 3) world from segment; the identity in the rest posture, NaN in frames without a result."""

    def __post_init__(self) -> None:
        freeze_fields(self, "rotation")

    @property
    def orientation(self) -> Curve:
        """The rotation as a unit quaternion, components w, x, y, z; the signs of successive frames agree."""
        known = np.isfinite(self.rotation).all((1, 2))
        values = np.full((len(self.rotation), 4), np.nan)
        values[known] = rotations.continuous(rotations.to_quaternion(self.rotation[known]))
        return Curve(
            name=f"{self.name}_orientation", time=self.origin.time, values=values, components=tuple("wxyz"),
            flags=self.origin.flags,
        )  # fmt: skip

    def __repr__(self) -> str:
        return f"<Motion of the {readable(self.name)}: {count_of(len(self.rotation), 'frame')}>"


class SegmentMotions(Mapping[str, SegmentMotion]):
    """The motion of all segments of a body, by name, with spaces or underscores.

    Args:
        data: The motion of the body.
        flags: (F,) flag of each frame.
    """

    def __init__(self, data: BodyMotion, flags: tuple[str, ...]):
        self._data, self._flags = data, flags

    @property
    def names(self) -> tuple[str, ...]:
        """The names, as in the files."""
        return self._data.segment_names

    def __getitem__(self, name: str) -> SegmentMotion:
        data, s = self._data, find_name(name, self.names, kind="segment")
        origin = Curve(
            name=f"{self.names[s]}_origin", time=data.time, values=data.segment_origin[:, s], unit="m",
            components=tuple("xyz"), flags=self._flags,
        )  # fmt: skip
        return SegmentMotion(name=self.names[s], origin=origin, rotation=data.segment_rotation[:, s])

    def __iter__(self) -> Iterator[Any]:
        return iter(self.names)

    def __len__(self) -> int:
        """Return the number of segments."""
        return len(self.names)

    def __repr__(self) -> str:
        return f"{count_of(len(self), 'segment')}: {', '.join(map(readable, self.names))}"

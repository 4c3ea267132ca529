"""Clocks of free-running cameras, relative to the clock of the first camera."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.errors import SettingProblem


@dataclass(frozen=True, eq=False, kw_only=True)
class Clocks:
    """Offset and drift of each camera's clock relative to the first camera's.

    What a camera shows at the time t of its own video happened at the instant t + offset + drift t on the clock of the
    first camera. All cameras of one system with a common trigger have offsets and drifts of zero.
    """

    names: tuple[str, ...]
    """C cameras, the first of which defines the clock."""
    offset_s: Floats
    """(C,) instant of the beginning of each camera's video [s]; 0 for the first camera."""
    drift: Floats
    """(C,) gain of each camera's instants over its own time [s/s]; 0 for the first camera."""
    offset_sd_s: Floats
    """(C,) standard deviation of the offset [s]."""
    drift_sd: Floats
    """(C,) standard deviation of the drift [s/s]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "offset_s", "drift", "offset_sd_s", "drift_sd")

    def instants(self, camera: int, times: Floats) -> Floats:
        """Return the instants of times of a camera's video.

        Args:
            camera: Number of the camera.
            times: (...) [s].

        Returns:
            (...) on the clock of the first camera [s].
        """
        return np.asarray(times + self.offset_s[camera] + self.drift[camera] * times)

    def times(self, camera: int, instants: Floats) -> Floats:
        """Return the times of a camera's video at instants; the inverse of `instants`.

        Args:
            camera: Number of the camera.
            instants: (...) on the clock of the first camera [s].

        Returns:
            (...) [s].
        """
        return np.asarray((instants - self.offset_s[camera]) / (1 + self.drift[camera]))

    def subset(self, names: Sequence[str]) -> "Clocks":
        """Keep some of the cameras; the first of them defines the clock.

        The standard deviations are those of the differences, as if the cameras' errors were independent.

        Args:
            names: The cameras to keep, in the order of the result.

        Returns:
            The clocks of these cameras.

        Raises:
            SettingProblem: A name is unknown.
        """
        unknown = [name for name in names if name not in self.names]
        if unknown:
            raise SettingProblem(f"There is no clock of '{unknown[0]}'. The clocks are of: {', '.join(self.names)}.")
        kept = np.array([self.names.index(name) for name in names])
        first, others = kept[0], kept != kept[0]
        rate = 1 + self.drift[first]
        return Clocks(
            names=tuple(names),
            offset_s=(self.offset_s[kept] - self.offset_s[first]) / rate,
            drift=(self.drift[kept] - self.drift[first]) / rate,
            offset_sd_s=others * np.hypot(self.offset_sd_s[kept], self.offset_sd_s[first]),
            drift_sd=others * np.hypot(self.drift_sd[kept], self.drift_sd[first]),
        )

"""A horizontal axis of numbers in a drawing that is part of a page, as SVG."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

_TICKS = 5
"""Number of labelled places on an axis, about. Chosen by eye."""
_LABEL_BELOW = 15
"""Distance of the baseline of a label below the end of its line [px]. Chosen by eye."""


@dataclass(frozen=True, kw_only=True)
class SvgAxis:
    """A horizontal axis from a lowest to a highest number."""

    low: float
    high: float
    left: float
    """Horizontal place of the lowest number [px]."""
    right: float
    """Horizontal place of the highest number [px]."""

    def place(self, value: float) -> float:
        """Return the horizontal place of a number [px]; a number beyond an end is drawn there."""
        inside = min(max(value, self.low), self.high)
        return self.left + (self.right - self.left) * (inside - self.low) / (self.high - self.low)

    def grid(self, top: float, bottom: float) -> Sequence[str]:
        """Return vertical lines at round numbers, with the numbers below them.

        Args:
            top: Upper end of the lines [px].
            bottom: Lower end of the lines [px].
        """
        step = _round_step((self.high - self.low) / _TICKS)
        digits = max(0, -math.floor(math.log10(step) + 1e-9))
        parts = []
        for k in range(math.ceil(self.low / step), math.floor(self.high / step) + 1):
            x = self.place(k * step)
            parts.append(f'<line class="grid" x1="{x:.1f}" x2="{x:.1f}" y1="{top}" y2="{bottom}"/>')
            text = f"{k * step + 0.0:.{digits}f}".replace("-", "−")
            parts.append(f'<text class="tick" x="{x:.1f}" y="{bottom + _LABEL_BELOW}">{text}</text>')
        return parts


def _round_step(rough: float) -> float:
    """Return 1, 2 or 5 times a power of ten that is at least a number."""
    power = 10.0 ** math.floor(math.log10(rough))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= rough * (1 - 1e-9))

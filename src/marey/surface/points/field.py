"""Grid of patches of a template, and the field of their matches in one search image."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from marey.arrays import Floats, Integers, Mask, freeze_fields
from marey.surface.points.views import SurfaceView

AROUND = np.array([[0, -1], [0, 1], [-1, 0], [1, 0], [-1, -1], [-1, 1], [1, -1], [1, 1]])
"""Row and column offsets of the eight neighbours."""


@dataclass(frozen=True, kw_only=True)
class Grid:
    """Regular grid of nodes in the template at which points are measured."""

    left: int
    """x of the first column [px]."""
    top: int
    """y of the first row [px]."""
    spacing: int
    """Distance of neighbouring nodes [px]."""
    rows: int
    columns: int

    @staticmethod
    def over(view: SurfaceView, *, spacing: int, half: int) -> "Grid":
        """Cover an image with nodes, as far as patches fit into it."""
        edge = half + 2
        width, height = view.camera.size
        rows, columns = (max(0, (side - 2 * edge - 1) // spacing + 1) for side in (height, width))
        left, top = ((side - 1 - (count - 1) * spacing) // 2 for side, count in ((width, columns), (height, rows)))
        return Grid(left=left, top=top, spacing=spacing, rows=rows, columns=columns)

    def __len__(self) -> int:
        """Count the nodes."""
        return self.rows * self.columns

    @cached_property
    def pixels(self) -> Floats:
        """(n, 2) the nodes, row by row [px]."""
        row, column = np.divmod(np.arange(len(self)), max(self.columns, 1))
        return np.stack([self.left + self.spacing * column, self.top + self.spacing * row], axis=-1).astype(float)

    def nearest(self, pixels: Floats) -> Integers:
        """Return the node nearest to each pixel (n, 2)."""
        place = np.round((pixels - [self.left, self.top]) / self.spacing).astype(int)
        column, row = np.clip(place, 0, [self.columns - 1, self.rows - 1]).T
        return np.asarray(row * self.columns + column)


@dataclass(frozen=True, eq=False, kw_only=True)
class Field:
    """Matches of a template's nodes in one search image; NaN without a match."""

    there: Floats
    """(n, 2) positions in the search image [px]."""
    maps: Floats
    """(n, 2, 2) linear parts of the affine maps."""
    covariance: Floats
    """(n, 2, 2) covariance of the positions [px2]."""
    correlation: Floats
    """(n,) correlation with the template."""
    size: Integers
    """(n,) size of the patch [px]; 0 without a match."""

    def __post_init__(self) -> None:
        freeze_fields(self, "there", "maps", "covariance", "correlation")
        freeze_fields(self, "size", dtype=np.int64)

    @property
    def found(self) -> Mask:
        """(n,) true for nodes with a match."""
        return self.size > 0

"""Reference patches: small parts of earlier images, stored for the comparison of points in later ones."""

from dataclasses import dataclass, field

import numpy as np

from marey.arrays import Floats, Integers
from marey.images.matching import patch_equations
from marey.images.matching.matching import Matches, MatchSettings, match
from marey.images.matching.splines import SplinePicture

_MARGIN = 5
"""Margin of a window about its patch [px]: two for the spline, the rest for displacements. Chosen by hand."""


@dataclass(eq=False, kw_only=True)
class ReferencePatches:
    """Growing collection of spline windows about points, each with its frame and point."""

    half: int
    """Pixels from a patch's centre to its edge."""
    windows: Floats = field(default_factory=lambda: np.empty((0, 0, 0), np.float32))
    """(R, S, S) float32 coefficients; NaN beyond the image."""
    corners: Floats = field(default_factory=lambda: np.empty((0, 2)))
    """(R, 2) pixel of each window's first coefficient."""
    frames: Integers = field(default_factory=lambda: np.empty(0, np.int64))
    """(R,)."""
    points: Integers = field(default_factory=lambda: np.empty(0, np.int64))
    """(R,)."""

    def add(self, picture: SplinePicture, pixels: Floats, *, frame: int, points: Integers) -> Integers:
        """Cut windows out of an image.

        Args:
            picture: The image.
            pixels: (n, 2) centres of the patches [px].
            frame: Frame of the image.
            points: (n,) points that the patches show.

        Returns:
            (n,) indices of the new patches.
        """
        reach = self.half + _MARGIN
        side = 2 * reach + 1
        padded = np.pad(picture.coefficients, side, constant_values=np.nan)
        middle = np.floor(np.nan_to_num(pixels, nan=-1.0) + 0.5).astype(np.int64)
        height, width = picture.coefficients.shape
        start = np.clip(middle - reach, -side, (width, height))
        around = np.arange(side)
        rows, columns = start[:, 1, None] + side + around, start[:, 0, None] + side + around
        new = padded[rows[:, :, None], columns[:, None, :]]
        first = len(self.frames)
        self.windows = np.concatenate([self.windows.reshape(first, side, side), new])
        self.corners = np.concatenate([self.corners, start])
        self.frames = np.concatenate([self.frames, np.full(len(pixels), frame)])
        self.points = np.concatenate([self.points, points])
        return np.arange(first, first + len(pixels))

    def match(
        self,
        search: SplinePicture,
        chosen: Integers,
        pixels: Floats,
        starts: Floats,
        maps: Floats,
        settings: MatchSettings,
    ) -> Matches:
        """Match patches in an image; see `marey.images.matching.matching.match`.

        Args:
            search: The image.
            chosen: (n,) indices of the patches.
            pixels: (n, 2) centres of the patches in their own images [px].
            starts: (n, 2) initial positions [px].
            maps: (n, 2, 2) linear parts of the initial maps.
            settings: Limits; the size must be that of the patches.

        Returns:
            One match per patch.
        """
        side = 2 * (self.half + _MARGIN) + 1
        stacked = SplinePicture(coefficients=self.windows[chosen].reshape(-1, side))
        within = pixels - self.corners[chosen]
        # In the stack, a patch beyond its own window would extend into the next one.
        within[~self._holds(within)] = np.nan
        within[:, 1] += side * np.arange(len(chosen))
        return match(stacked, search, within, starts, maps=maps, settings=settings)

    def equations(
        self, search: SplinePicture, chosen: Integers, pixels: Floats, places: Floats, maps: Floats, noise: float
    ) -> tuple[Floats, Floats, Floats]:
        """Compute normal equations of the patches' positions; see `patch_equations.write_equations`.

        Args:
            search: The image.
            chosen: (n,) indices of the patches; negative ones contribute nothing.
            pixels: (n, 2) centres of the patches in their own images [px].
            places: (n, 2) predicted positions [px].
            maps: (n, 2, 2) linear parts of the maps from the template to the image.
            noise: Least standard deviation of a pixel's noise [grey levels].

        Returns:
            Information (n, 2, 2) [1/px2], information times position (n, 2) [1/px], and the correlation (n,) at the
            predicted positions; zero, zero and NaN where unknown.
        """
        count = len(chosen)
        information, right, correlation = np.zeros((count, 2, 2)), np.zeros((count, 2)), np.full(count, np.nan)
        within = pixels - self.corners[chosen]
        within[(chosen < 0) | ~self._holds(within)] = np.nan
        carried = np.concatenate([places, maps.reshape(count, 4)], axis=1)
        patch_equations.write_equations(
            self.windows, chosen, within, search.coefficients, carried, self.half, noise**2,
            information, right, correlation,
        )  # fmt: skip
        return information, right, correlation

    def _holds(self, within: Floats) -> np.ndarray:
        side = 2 * (self.half + _MARGIN) + 1
        return np.asarray(np.all((within - self.half >= 1) & (within + self.half < side - 2), axis=1))

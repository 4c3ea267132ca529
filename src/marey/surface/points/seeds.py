"""Seeds: the first matches, from which all others grow; found automatically, or clicked."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.cameras.triangulate import triangulate
from marey.images.matching.matching import MatchSettings, match
from marey.surface.points.acceptance import MatchLimits, accepted
from marey.surface.points.settings import SURFACE_SEED_DEFAULTS, SurfaceSeedSettings, SurfaceSettings
from marey.surface.points.sweep import correlations, hypotheses
from marey.surface.points.views import SurfaceView

_BLOCK = 7
"""Width and height of a corner's neighbourhood [px], for which `_STRENGTH` holds. Chosen by hand."""
_STRENGTH = 4.0
"""OpenCV's corner strength for a mean square gradient of 1 [grey2/px2] in a block of seven pixels."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Seeds:
    """Matches of one template in one search image, from which further matches grow."""

    pixels: Floats
    """(n, 2) positions in the template [px]."""
    there: Floats
    """(n, 2) positions in the search image [px]."""
    maps: Floats
    """(n, 2, 2) linear parts of the affine maps."""

    def __post_init__(self) -> None:
        freeze_fields(self, "pixels", "there", "maps")

    def __len__(self) -> int:
        """Count the seeds."""
        return len(self.pixels)

    def __getitem__(self, which: Mask) -> "Seeds":
        return Seeds(pixels=self.pixels[which], there=self.there[which], maps=self.maps[which])

    @property
    def known(self) -> Mask:
        """(n,) which have a position in the search image."""
        return np.isfinite(self.there[:, 0])

    def joined_with(self, other: "Seeds") -> "Seeds":
        """Append other seeds."""
        pairs = {name: (getattr(self, name), getattr(other, name)) for name in ("pixels", "there", "maps")}
        return Seeds(**{name: np.concatenate(pair) for name, pair in pairs.items()})


def corners(view: SurfaceView, *, most: int, settings: SurfaceSeedSettings = SURFACE_SEED_DEFAULTS) -> Floats:
    """Detect corners distributed over the whole image.

    The image is divided into equal cells, and the strongest corner of each cell is selected: the strongest corners of
    the whole image would be concentrated where the texture is best.

    Args:
        view: View whose image is searched.
        most: Largest number of corners.
        settings: Least strength of a corner, and how the corners are distributed.

    Returns:
        (n, 2) pixels of corners above the noise [px].
    """
    strength = cv2.cornerMinEigenVal(view.grey.astype(np.float32), _BLOCK) / _STRENGTH
    edge = settings.border_px
    strength[:edge], strength[-edge:], strength[:, :edge], strength[:, -edge:] = 0, 0, 0, 0
    if view.mask is not None:
        strength[~view.mask] = 0
    height, width = strength.shape
    cell = max(settings.cell_px, int(np.ceil(np.sqrt(height * width / most))))
    rows, columns = -(-height // cell), -(-width // cell)
    padded = np.zeros((rows * cell, columns * cell), np.float32)
    padded[:height, :width] = strength
    cells = padded.reshape(rows, cell, columns, cell).swapaxes(1, 2).reshape(rows * columns, cell * cell)
    best = cells.argmax(axis=1)
    least = settings.noise_ratio * max(view.noise, settings.least_noise) ** 2
    strong = np.flatnonzero(cells[np.arange(len(cells)), best] > least)
    x = strong % columns * cell + best[strong] % cell
    y = strong // columns * cell + best[strong] // cell
    return np.stack([x, y], axis=-1).astype(float)


def find_seeds(
    template: SurfaceView, searched: Sequence[SurfaceView], settings: SurfaceSettings, *, threads: int = 1
) -> tuple[Seeds, ...]:
    """Find seeds automatically: corners of the template, searched along their epipolar lines.

    A corner is accepted if one position of the other image is more similar to it than any other, if the backward search
    returns to the corner, if least-squares matching confirms it, and if the rays of all views that show it intersect.

    Args:
        template: The view of the corners.
        searched: The views in which they are searched, each by itself.
        settings: Number of corners, how they are searched, and thresholds for matches.
        threads: Number of views that are searched in parallel.

    Returns:
        Seeds of each searched view, possibly none.
    """
    sweep = settings.seed_search
    factor = min(1.0, sweep.largest_side_px / max(max(view.camera.size) for view in (template, *searched)))
    pixels = corners(template, most=settings.seeds, settings=sweep)

    least, of_sweep = sweep.refined_reach_px

    def work(search: SurfaceView) -> Seeds:
        there, maps = _search_lines(template, search, pixels, factor=factor, settings=sweep)
        return refine_seeds(template, search, pixels, there, maps, settings, reach=max(least, of_sweep / factor))

    with ThreadPoolExecutor(max(1, min(threads, len(searched)))) as pool:
        seeds = list(pool.map(work, searched))
    meeting = _meeting(template, searched, seeds, sweep.intersection_px)
    return tuple(found[meeting & found.known] for found in seeds)


def refine_seeds(
    template: SurfaceView,
    search: SurfaceView,
    pixels: Floats,
    there: Floats,
    maps: Floats,
    settings: SurfaceSettings,
    *,
    reach: float,
) -> Seeds:
    """Refine approximate seeds by least-squares matching, the largest patches first; NaN where no match is accepted."""
    exact_there, exact_maps = np.full_like(pixels, np.nan), np.full((len(pixels), 2, 2), np.nan)
    for way in reversed(settings.passes):
        rules = MatchSettings(size=way.size, noise=template.noise, reach=reach)
        limits = MatchLimits(correlation=way.correlation, sd_px=way.sd_px, epipolar_px=settings.epipolar_px)
        found = match(template.spline, search.spline, pixels, there, maps=maps, settings=rules)
        fine = accepted(template, search, pixels, found, limits)
        exact_there[fine], exact_maps[fine] = found.pixels[fine], found.search_from_template[fine]
        there = np.where(np.isnan(exact_there), there, exact_there)
        maps = np.where(np.isnan(exact_maps), maps, exact_maps)
    return Seeds(pixels=pixels, there=exact_there, maps=exact_maps)


def _search_lines(
    template: SurfaceView, search: SurfaceView, pixels: Floats, *, factor: float, settings: SurfaceSeedSettings
) -> tuple[Floats, Floats]:
    """Search pixels (n, 2) along epipolar lines of reduced images, forward and backward; NaN if not found."""
    small, other = template.scaled(factor), search.scaled(factor)
    here = (pixels + 0.5) * factor - 0.5
    there, maps = _most_like(small, other, here, settings)
    found = np.isfinite(there[:, 0])
    back, _ = _most_like(other, small, there[found], settings)
    found[found] = np.linalg.norm(back - here[found], axis=1) <= settings.backward_px
    there = np.where(found[:, None], (there + 0.5) / factor - 0.5, np.nan)
    return there, maps


def _most_like(
    template: SurfaceView, search: SurfaceView, pixels: Floats, settings: SurfaceSeedSettings
) -> tuple[Floats, Floats]:
    """Return the position (n, 2) most similar to each pixel and its map (n, 2, 2); NaN if another is as similar."""
    tried = hypotheses(
        template.camera, search.camera, pixels, step=settings.step_px, margin=settings.half_px, settings=settings
    )
    tried = tried.only(search.shows(tried.places))
    scores = correlations(
        template.grey.astype(np.float32), search.grey.astype(np.float32), pixels, tried, half=settings.half_px
    )  # fmt: skip
    places, maps = np.full((len(pixels), 2), np.nan), np.full((len(pixels), 2, 2), np.nan)
    for i, (a, b) in enumerate(pairwise(tried.first)):
        if a == b:
            continue
        best = a + int(scores[a:b].argmax())
        away = np.linalg.norm(tried.places[a:b] - tried.places[best], axis=1) > settings.distant_px
        second = scores[a:b][away].max(initial=-1.0)
        if scores[best] >= settings.correlation and scores[best] - second >= settings.clear_difference:
            places[i], maps[i] = tried.places[best], tried.maps[best]
    return places, maps


def _meeting(template: SurfaceView, searched: Sequence[SurfaceView], seeds: Sequence[Seeds], most_px: float) -> Mask:
    """Return for which seeds (n,) the rays of all views that show them intersect."""
    cameras = [template.camera, *(view.camera for view in searched)]
    pixels = np.stack([seeds[0].pixels, *(found.there for found in seeds)])
    solved = triangulate(cameras, pixels, sigma_px=0.1)
    return np.asarray(solved.residual_px <= most_px)

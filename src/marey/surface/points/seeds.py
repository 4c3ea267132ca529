"""Seeds: the first few matches, from which all others grow; found by the program, or clicked."""

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
from marey.surface.points.settings import SurfaceSettings
from marey.surface.points.sweep import correlations, hypotheses
from marey.surface.points.views import SurfaceView

_SIDE = 720
"""Pictures are made this long for the sweep, if they are longer [px]."""
_HALF = 8
"""Pixels from the centre to the edge of what the sweep compares."""
_LIKE = 0.75
"""Least correlation in the sweep."""
_BETTER = 0.04
"""By how much the best hypothesis must beat any that lies elsewhere, and ..."""
_ELSEWHERE = 4.0
"""... how far away that is [px of the sweep]."""
_BACK = 2.0
"""How near the way back must come to where it began [px of the sweep]."""
_ROUND = 2.5
"""How well rays of three views must meet [px]."""
_STEP = 1.5
"""From one hypothesis to the next [px of the sweep]; patches still look alike there."""
_BLOCK = 7
"""Width and height of a corner's surroundings [px]."""
_STRENGTH = 4.0
"""What OpenCV's strength of a corner is for a mean square gradient of 1 [grey2/px2] in a block of seven pixels."""
_NOISE_SHARE = 1.0
"""Least mean square gradient in a corner's weakest direction, as a multiple of the noise's variance [1/px2]; noise
itself has 0.2."""
_LEAST_NOISE = 1.0
"""Compression hides noise: no camera is believed to have less [grey levels]."""
_CELL = 16
"""Corners come from cells at least so wide: matches grow from one to the next anyway [px]."""
_EDGE = 8
"""Pixels along the picture's border in which no corner is sought."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Seeds:
    """Matches of one template in one search picture."""

    pixels: Floats
    """(n, 2) in the template [px]."""
    there: Floats
    """(n, 2) in the search picture [px]."""
    maps: Floats
    """(n, 2, 2) affine maps of the surroundings."""

    def __post_init__(self) -> None:
        freeze_fields(self, "pixels", "there", "maps")

    def __len__(self) -> int:
        """Count the seeds."""
        return len(self.pixels)

    def __getitem__(self, which: Mask) -> "Seeds":
        return Seeds(pixels=self.pixels[which], there=self.there[which], maps=self.maps[which])

    @property
    def known(self) -> Mask:
        """(n,) which have a place in the search picture."""
        return np.isfinite(self.there[:, 0])

    def joined_with(self, other: "Seeds") -> "Seeds":
        """Put others behind these."""
        pairs = {name: (getattr(self, name), getattr(other, name)) for name in ("pixels", "there", "maps")}
        return Seeds(**{name: np.concatenate(pair) for name, pair in pairs.items()})


def corners(view: SurfaceView, *, most: int) -> Floats:
    """Find places of a view that their surroundings tell apart from those nearby, all over the picture.

    The picture is cut into equal cells, and each cell gives its best place: the strongest corners of all would crowd
    where the texture is best, and leave the rest to grow from afar.

    Args:
        view: Whose picture.
        most: At most so many.

    Returns:
        (n, 2) [px]; those that are no more than noise are left out.
    """
    strength = cv2.cornerMinEigenVal(view.grey.astype(np.float32), _BLOCK) / _STRENGTH
    strength[:_EDGE], strength[-_EDGE:], strength[:, :_EDGE], strength[:, -_EDGE:] = 0, 0, 0, 0
    if view.mask is not None:
        strength[~view.mask] = 0
    height, width = strength.shape
    cell = max(_CELL, int(np.ceil(np.sqrt(height * width / most))))
    rows, columns = -(-height // cell), -(-width // cell)
    padded = np.zeros((rows * cell, columns * cell), np.float32)
    padded[:height, :width] = strength
    cells = padded.reshape(rows, cell, columns, cell).swapaxes(1, 2).reshape(rows * columns, cell * cell)
    best = cells.argmax(axis=1)
    strong = np.flatnonzero(cells[np.arange(len(cells)), best] > _NOISE_SHARE * max(view.noise, _LEAST_NOISE) ** 2)
    x = strong % columns * cell + best[strong] % cell
    y = strong // columns * cell + best[strong] // cell
    return np.stack([x, y], axis=-1).astype(float)


def find_seeds(
    template: SurfaceView, searched: Sequence[SurfaceView], settings: SurfaceSettings, *, threads: int = 1
) -> tuple[Seeds, ...]:
    """Find seeds without help: corners of the template, looked for along their epipolar lines.

    A corner counts where one place of the other picture is more like it than any other, where the way back leads to
    the corner again, where least-squares matching confirms it, and where the rays of all views that show it meet.

    Args:
        template: The view of the corners.
        searched: The views in which they are looked for, each for itself.
        settings: How many are tried.
        threads: Searched views that are worked on at once.

    Returns:
        Seeds of each searched view; perhaps none.
    """
    factor = min(1.0, _SIDE / max(max(view.camera.size) for view in (template, *searched)))
    pixels = corners(template, most=settings.seeds)

    def work(search: SurfaceView) -> Seeds:
        there, maps = _search_lines(template, search, pixels, factor=factor)
        return refine_seeds(template, search, pixels, there, maps, settings, reach=max(4.0, 2.5 / factor))

    with ThreadPoolExecutor(max(1, min(threads, len(searched)))) as pool:
        seeds = list(pool.map(work, searched))
    meeting = _meeting(template, searched, seeds)
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
    """Match rough seeds exactly, with a large patch first; NaN where they are not found or not good."""
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
    template: SurfaceView, search: SurfaceView, pixels: Floats, *, factor: float
) -> tuple[Floats, Floats]:
    """Look for pixels (n, 2) along their epipolar lines, there and back, in pictures made smaller; NaN if not found."""
    small, other = template.scaled(factor), search.scaled(factor)
    here = (pixels + 0.5) * factor - 0.5
    there, maps = _most_like(small, other, here)
    found = np.isfinite(there[:, 0])
    back, _ = _most_like(other, small, there[found])
    found[found] = np.linalg.norm(back - here[found], axis=1) <= _BACK
    there = np.where(found[:, None], (there + 0.5) / factor - 0.5, np.nan)
    return there, maps


def _most_like(template: SurfaceView, search: SurfaceView, pixels: Floats) -> tuple[Floats, Floats]:
    """Give the place (n, 2) most like each pixel's surroundings, and its map (n, 2, 2); NaN if another is as good."""
    tried = hypotheses(template.camera, search.camera, pixels, step=_STEP, margin=_HALF)
    scores = correlations(
        template.grey.astype(np.float32), search.grey.astype(np.float32), pixels, tried, half=_HALF
    )  # fmt: skip
    places, maps = np.full((len(pixels), 2), np.nan), np.full((len(pixels), 2, 2), np.nan)
    for i, (a, b) in enumerate(pairwise(tried.first)):
        if a == b:
            continue
        best = a + int(scores[a:b].argmax())
        away = np.linalg.norm(tried.places[a:b] - tried.places[best], axis=1) > _ELSEWHERE
        second = scores[a:b][away].max(initial=-1.0)
        if scores[best] >= _LIKE and scores[best] - second >= _BETTER:
            places[i], maps[i] = tried.places[best], tried.maps[best]
    return places, maps


def _meeting(template: SurfaceView, searched: Sequence[SurfaceView], seeds: Sequence[Seeds]) -> Mask:
    """Tell for which seeds (n,) the rays of all views that show them meet."""
    cameras = [template.camera, *(view.camera for view in searched)]
    pixels = np.stack([seeds[0].pixels, *(found.there for found in seeds)])
    solved = triangulate(cameras, pixels, sigma_px=0.1)
    return np.asarray(solved.residual_px <= _ROUND)

"""Search of points of one image in another from a different viewpoint, by similarity of patches."""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.errors import SettingProblem
from marey.images.matching.feature_tracks import extrapolated
from marey.images.matching.features import good_features
from marey.images.matching.matching import Matches, MatchSettings, match
from marey.images.matching.splines import spline_of

_AT_ONCE = 256
"""Number of points compared at once, which bounds the memory."""


@dataclass(frozen=True, kw_only=True)
class PatchSearchSettings:
    """Settings of the search for similar patches.

    The defaults were chosen by hand; results were not measured against other values.
    """

    stretches: tuple[float, ...] = (0.8, 1.0, 1.25)
    """Horizontal scale factors of the patches that are compared."""
    shears: tuple[float, ...] = (-0.25, 0.0, 0.25)
    """Horizontal shears of the patches that are compared."""
    blur_px: float = 1.0
    """Standard deviation of the blur before the first comparison, so that corners may lie a pixel apart [px]."""
    reach_px: float = 6.0
    """Largest distance of a match from its start [px]."""
    rounds: int = 4
    """Largest number of passes in which neighbours of known points are searched."""


PATCH_SEARCH_DEFAULTS = PatchSearchSettings()
"""Default settings of the search for similar patches."""


class Candidates(NamedTuple):
    """Candidate positions of points in another image."""

    points: Integers
    """(n,) index of the point."""
    pixels: Floats
    """(n, 2) position [px]."""
    correlation: Floats
    """(n,) correlation of the grey values after an affine match."""


def find_candidates(
    template: np.ndarray,
    search: np.ndarray,
    points: Floats,
    *,
    size: int = 21,
    alike: float = 0.75,
    each: int = 5,
    corners: int = 2000,
    within: Mask | None = None,
    settings: PatchSearchSettings = PATCH_SEARCH_DEFAULTS,
) -> Candidates:
    """Search points in the whole of another image.

    Corners of the image are compared with the points' patches, stretched and sheared as in another view; the most
    similar are refined by affine least-squares matching, so that a candidate is the point itself, not the nearest
    corner.

    Args:
        template: (H, W) grey image with the points.
        search: (h, w) grey image that is searched.
        points: (P, 2) positions in the template [px].
        size: Width and height of the patches [px], odd.
        alike: Least correlation.
        each: Number of corners tried per point.
        corners: Largest number of corners of the image.
        within: (h, w) true where candidates may lie; everywhere if None.
        settings: How the patches are compared.

    Returns:
        Candidates, none or several per point.

    Raises:
        SettingProblem: An image is not grey, or a number is impossible.
    """
    if not 0 < alike < 1 or each < 1:
        raise SettingProblem(
            f"Points cannot be found with alike = {alike:g} and each = {each}: alike must lie between 0 and 1, and "
            "each must be at least 1."
        )
    found = good_features(search, count=corners, spacing=5.0, within=within)
    if not len(found) or not len(points):
        return Candidates(np.empty(0, np.int64), np.empty((0, 2)), np.empty(0))
    maps = np.array([[[stretch, shear], [0, 1]] for stretch in settings.stretches for shear in settings.shears])
    likeness, which = _likeness(template, search, points, found, maps, size, settings.blur_px)
    each = min(each, len(found))
    columns = np.argsort(-likeness, axis=1)[:, :each].ravel()
    rows = np.repeat(np.arange(len(points)), each)
    rules = MatchSettings(size=size, noise=1.5, reach=settings.reach_px)
    result = match(
        spline_of(template), spline_of(search), points[rows], found[columns],
        maps=np.linalg.inv(maps)[which[rows, columns]], settings=rules,
    )  # fmt: skip
    good = np.flatnonzero(result.converged & (result.correlation >= alike))
    return without_duplicates(Candidates(rows[good], result.pixels[good], result.correlation[good]))


def _likeness(
    template: np.ndarray,
    search: np.ndarray,
    points: Floats,
    corners: Floats,
    maps: Floats,
    size: int,
    blur_px: float,
) -> tuple[Floats, Integers]:
    """Return the best correlation (P, Q) of points and corners over the maps, and the index of this map."""
    there = _patches(search, corners, np.eye(2), size, blur_px)
    best, which = np.full((len(points), len(corners)), -1.0), np.zeros((len(points), len(corners)), np.int64)
    for k, linear in enumerate(maps):
        here = _patches(template, points, linear, size, blur_px)
        for start in range(0, len(points), _AT_ONCE):
            rows = slice(start, start + _AT_ONCE)
            alike = here[rows] @ there.T
            better = alike > best[rows]
            best[rows] = np.where(better, alike, best[rows])
            which[rows] = np.where(better, k, which[rows])
    return best, which


def _patches(picture: np.ndarray, points: Floats, linear: Floats, size: int, blur_px: float) -> Floats:
    """Cut out patches (n, size * size) with mean 0 and norm 1; flat ones are 0."""
    grey = cv2.GaussianBlur(np.asarray(picture, np.float32), (0, 0), blur_px)
    side = np.arange(size) - size // 2
    around = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2) @ np.asarray(linear).T
    places = np.asarray(points[:, None] + around, np.float32)
    values = [
        cv2.remap(grey, part[..., 0], part[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for part in np.array_split(places, max(1, len(places) // 1000))
    ]
    patches = np.concatenate(values).astype(float)
    patches -= patches.mean(axis=1, keepdims=True)
    return np.asarray(patches / np.maximum(np.linalg.norm(patches, axis=1, keepdims=True), 1e-6))


def without_duplicates(candidates: Candidates) -> Candidates:
    """Keep the most similar of a point's candidates at the same position."""
    kept: list[int] = []
    for i in np.argsort(-candidates.correlation, kind="stable"):
        beside = [j for j in kept if candidates.points[j] == candidates.points[i]]
        if all(np.linalg.norm(candidates.pixels[j] - candidates.pixels[i]) >= 1 for j in beside):
            kept.append(int(i))
    order = np.sort(np.array(kept, np.int64))
    return Candidates(candidates.points[order], candidates.pixels[order], candidates.correlation[order])


def find_beside(
    template: np.ndarray,
    search: np.ndarray,
    points: Floats,
    places: Floats,
    *,
    size: int = 21,
    alike: float = 0.85,
    settings: PatchSearchSettings = PATCH_SEARCH_DEFAULTS,
) -> tuple[Floats, Floats]:
    """Search points near those already found, starting from their neighbours' affine motion.

    Args:
        template: (H, W) grey image with the points.
        search: (h, w) grey image that is searched.
        points: (P, 2) positions in the template [px].
        places: (P, 2) positions in the other image, NaN where unknown [px].
        size: Width and height of the patches [px], odd.
        alike: Least correlation.
        settings: Number of passes, and largest distance of a match from its start.

    Returns:
        The positions (P, 2), of which more are known, and the correlations (P,) of the new ones; NaN for the others.
    """
    places, correlation = np.array(places, float), np.full(len(points), np.nan)
    here, there = spline_of(template), spline_of(search)
    rules = MatchSettings(size=size, noise=1.5, reach=settings.reach_px)
    for _ in range(settings.rounds):
        left = np.flatnonzero(~np.isfinite(places).all(axis=1))
        if not len(left) or len(points) - len(left) < 3:
            break
        starts, maps = extrapolated(points, places, points)
        result: Matches = match(here, there, points[left], starts[left], maps=maps[left], settings=rules)
        good = result.converged & (result.correlation >= alike)
        if not good.any():
            break
        places[left[good]], correlation[left[good]] = result.pixels[good], result.correlation[good]
    return places, correlation

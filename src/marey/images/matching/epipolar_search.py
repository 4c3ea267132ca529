"""Search for points of one calibrated image along their epipolar lines in another, by similarity of patches."""

from dataclasses import dataclass

import cv2
import numpy as np

from marey.arrays import Floats, Integers
from marey.cameras.camera import Camera
from marey.cameras.epipolar import epipolar_lines
from marey.errors import SettingProblem
from marey.images.matching.matching import MatchSettings, match
from marey.images.matching.patch_search import Candidates, PatchSearchSettings, without_duplicates
from marey.images.matching.splines import spline_of


@dataclass(frozen=True, kw_only=True)
class EpipolarSearchSettings:
    """Settings of the search along epipolar lines.

    The defaults were chosen by hand; results were not measured against other values.
    """

    nearest: float = 4.0
    """Ratio of the baseline to the least depth from the first camera at which points are searched."""
    depths: int = 3000
    """Number of depths between the least depth and infinity, equally spaced in inverse depth."""
    step_px: float = 2.0
    """Distance between compared positions on a line [px]."""
    least_correlation: float = 0.5
    """Least correlation of a position from which a match is started."""
    blur_px: float = PatchSearchSettings.blur_px
    """Standard deviation of the blur of the images before this first comparison [px]."""
    reach_px: float = PatchSearchSettings.reach_px
    """Largest distance of a match from its start [px]."""
    on_line_px: float = 2.0
    """Largest distance of a match from its epipolar line [px]."""


EPIPOLAR_SEARCH_DEFAULTS = EpipolarSearchSettings()
"""Default settings of the search along epipolar lines."""


def find_on_lines(
    template: np.ndarray,
    search: np.ndarray,
    points: Floats,
    cameras: tuple[Camera, Camera],
    *,
    size: int = 21,
    alike: float = 0.75,
    each: int = 4,
    settings: EpipolarSearchSettings = EPIPOLAR_SEARCH_DEFAULTS,
) -> Candidates:
    """Search points along their epipolar lines in another image.

    At each depth a patch is mapped as a surface that faces the first camera; the most similar positions are refined by
    affine least-squares matching.

    Args:
        template: (H, W) grey image of the first camera.
        search: (h, w) grey image of the second camera at the same instant.
        points: (P, 2) points in the template [px].
        cameras: The two cameras, with their lenses.
        size: Width and height of the patches [px], odd.
        alike: Least correlation of a match.
        each: Largest number of positions that are refined per point.
        settings: Positions that are compared, and limits.

    Returns:
        Candidates, none or several per point.

    Raises:
        SettingProblem: A number is impossible, or the cameras have the same position.
    """
    if not 0 < alike < 1 or each < 1 or size < 3 or size % 2 == 0:
        raise SettingProblem(
            f"Points cannot be found with alike = {alike:g}, each = {each} and size = {size}: alike must lie between 0 "
            "and 1, each must be at least 1, and size an odd number of pixels from 3 up."
        )
    here, there = _smooth(template, settings.blur_px), _smooth(search, settings.blur_px)
    rows, starts, maps = [], [], []
    for number, point in enumerate(np.asarray(points, float)):
        places, linear = _on_line(point, cameras, settings)
        best = _most_alike(here, there, point, places, linear, size, settings.least_correlation)[:each]
        rows.append(np.full(len(best), number))
        starts.append(places[best])
        maps.append(linear[best])
    owner = np.concatenate([np.empty(0, np.int64), *rows]).astype(np.int64)
    if not len(owner):
        return Candidates(owner, np.empty((0, 2)), np.empty(0))
    found = match(
        spline_of(template), spline_of(search), points[owner], np.concatenate(starts), maps=np.concatenate(maps),
        settings=MatchSettings(size=size, noise=1.5, reach=settings.reach_px),
    )  # fmt: skip
    good = np.flatnonzero(found.converged & (found.correlation >= alike))
    good = good[_beside_line(points[owner[good]], found.pixels[good], cameras) <= settings.on_line_px]
    return without_duplicates(Candidates(owner[good], found.pixels[good], found.correlation[good]))


def _smooth(image: np.ndarray, blur_px: float) -> Floats:
    return np.asarray(cv2.GaussianBlur(np.asarray(image, np.float32), (0, 0), blur_px), np.float32)


def _on_line(point: Floats, cameras: tuple[Camera, Camera], settings: EpipolarSearchSettings) -> tuple[Floats, Floats]:
    """Return positions (S, 2) along a point's line in the second image, and the affine maps (S, 2, 2) to them."""
    one, other = cameras
    baseline = float(np.linalg.norm(other.centre - one.centre))
    if baseline == 0:
        raise SettingProblem(f"Cameras '{one.name}' and '{other.name}' have the same position and no epipolar lines.")
    nearness = np.linspace(1e-4, settings.nearest, settings.depths) / baseline
    corners = point + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    straight = np.concatenate([one.undistort(corners), np.ones((3, 1))], 1) @ one.camera_from_world.rotation
    seen = other.project(one.centre + straight[:, None] / nearness[:, None])
    inside = np.flatnonzero(other.sees(seen[0]) & np.isfinite(seen).all((0, 2)))
    if not len(inside):
        return np.empty((0, 2)), np.empty((0, 2, 2))
    steps = np.linalg.norm(np.diff(seen[0, inside], axis=0), axis=1)
    mark = np.floor(np.concatenate([[0.0], np.cumsum(steps)]) / settings.step_px)
    kept = inside[np.flatnonzero(np.diff(mark, prepend=-1.0) > 0)]
    return seen[0, kept], np.stack([seen[1, kept] - seen[0, kept], seen[2, kept] - seen[0, kept]], -1)


def _most_alike(
    here: Floats, there: Floats, point: Floats, places: Floats, linear: Floats, size: int, least: float
) -> Integers:
    """Return the indices of the positions at peaks of the correlation, the highest first."""
    if not len(places):
        return np.empty(0, np.int64)
    side = np.arange(size) - size // 2
    around = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
    own = _normal(_sampled(here, point + around)[None])
    likeness = _normal(_sampled(there, places[:, None] + np.swapaxes(linear @ around.T, 1, 2))) @ own[0]
    beside = np.pad(likeness, 1, constant_values=-1.0)
    peak = (likeness >= beside[:-2]) & (likeness >= beside[2:]) & (likeness > least)
    peaks = np.flatnonzero(peak)
    return peaks[np.argsort(-likeness[peaks])]


def _sampled(image: Floats, places: Floats) -> Floats:
    """Return the grey values at positions (..., 2)."""
    flat = np.asarray(places, np.float32).reshape(len(places), -1, 2)
    values = [
        cv2.remap(image, part[..., 0], part[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for part in np.array_split(flat, max(1, len(flat) // 1000))
    ]
    return np.concatenate(values).reshape(places.shape[:-1]).astype(float)


def _normal(patches: Floats) -> Floats:
    patches = patches - patches.mean(-1, keepdims=True)
    return np.asarray(patches / np.maximum(np.linalg.norm(patches, axis=-1, keepdims=True), 1e-6))


def _beside_line(points: Floats, pixels: Floats, cameras: tuple[Camera, Camera]) -> Floats:
    """Return the distances (n,) of pixels from the epipolar lines [px]; infinite if there is none."""
    on_line, along = epipolar_lines(*cameras, points, pixels)
    away = pixels - on_line
    return np.nan_to_num(np.abs(away[:, 0] * along[:, 1] - away[:, 1] * along[:, 0]), nan=np.inf)

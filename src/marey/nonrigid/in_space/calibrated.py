"""Shape and absolute motion of a deforming object from its tracks in calibrated cameras ([Alexander2003] section 2.6).

Unlike the paper, which reconstructs points first and factorises them, the model is fitted to the pixels: a point that
only one camera sees is constrained by its ray and by the low rank, and each point is weighted by the information of its
rays.
"""

from dataclasses import dataclass, field

import numpy as np

from marey.arrays import Floats, Integers, Mask, freeze_fields
from marey.cameras.rig import Rig
from marey.cameras.triangulate import triangulate
from marey.errors import MareyError
from marey.nonrigid.in_space.factorisation import FactorisationSettings, HomogeneousShapes, solved_shapes
from marey.nonrigid.in_space.pixel_places import PixelPlaces, PixelPlacesSettings


@dataclass(frozen=True, kw_only=True)
class CalibratedSettings:
    """Settings of the factorisation in calibrated cameras.

    Where nothing else is stated, defaults were chosen by hand, and results were not measured against other values.
    """

    least_sd_px: float = 0.01
    """Least standard deviation of a pixel's coordinate [px]; keeps exact data solvable."""
    most_miss: float = 0.005
    """Largest distance by which rays may miss each other, as a fraction of the image width, before the tracks count as
    not belonging to the cameras."""
    fewest_met: int = 10
    """Least number of points on which rays meet, from which the noise is estimated."""
    factorisation: FactorisationSettings = field(default_factory=FactorisationSettings)
    """Settings of the factorisation."""
    places: PixelPlacesSettings = field(default_factory=PixelPlacesSettings)
    """Settings of initial positions and poses."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CalibratedShapes(HomogeneousShapes):
    """Shapes and motions in the laboratory of the cameras, in metres.

    `residuals` are the distances of the model from the points on which the rays of two or more cameras meet.
    `noise_sd` is the standard deviation of the points about the model, without the noise of the pixels [m].
    """

    camera_names: tuple[str, ...]
    """Names of the C cameras, in the order of the tracks."""
    noise_px: float
    """Standard deviation of a pixel's coordinate, from the distances between rays of the same point [px]; the median
    where standard deviations were given."""
    sd_factor: float
    """Factor by which the given standard deviations were multiplied; `noise_px` where none were given."""
    residuals_px: Floats
    """(C, F, P) distance of each pixel from the model [px]; NaN where not seen."""
    views: Integers
    """(F, P) number of cameras that saw the point."""

    def __post_init__(self) -> None:
        super().__post_init__()
        freeze_fields(self, "residuals_px")
        freeze_fields(self, "views", dtype=np.int64)


def factorise_calibrated(
    tracks: Floats,
    rig: Rig,
    *,
    tracks_sd: Floats | None = None,
    rank: int | None = None,
    reference: int | None = None,
    settings: CalibratedSettings = CalibratedSettings(),
) -> CalibratedShapes:
    """Estimate basis shapes, weights and rigid motions in the laboratory from synchronised, calibrated cameras.

    Args:
        tracks: (C, F, 2, P) [px], the same point in the same column; NaN where not seen.
        rig: The C cameras, with their lenses, in the order of the tracks.
        tracks_sd: (C, F, 2, P) relative standard deviations; their common factor is estimated from the distances
            between rays. All pixels have the same standard deviation if None.
        rank: Number of basis shapes K, including the mean; chosen by cross-validation if None.
        reference: Frame in which the object's axes are those of the laboratory; by default the first with a pose.
        settings: Tuned constants of the algorithm.

    Returns:
        The shapes; NaN in frames and for points with too few measurements.

    Raises:
        MareyError: The tracks do not match the cameras, no two cameras see the same points from two sides, or there are
            too few measurements for the rank, as in `factorise_points`.
    """
    tracks = np.asarray(tracks, float)
    _check(tracks, rig)
    pixels = np.moveaxis(tracks, 2, 3)
    given = np.ones(pixels.shape[:3]) if tracks_sd is None else _mean_sd(tracks_sd, tracks, settings)
    factor = _noise_factor(rig, pixels, given, settings)
    places = PixelPlaces(rig.cameras, pixels, np.maximum(factor * given, settings.least_sd_px), settings.places)
    _, fields = solved_shapes(places, rank, reference, settings.factorisation)
    model = np.einsum("fij,fjp->fpi", fields["rotation"], fields["shape"]) + fields["translation"][:, None]
    seen = np.isfinite(pixels).all(-1)
    return CalibratedShapes(
        **fields, camera_names=rig.names, noise_px=float(np.median(places.sigma[seen])), sd_factor=factor,
        residuals_px=np.linalg.norm(places.pixels - places.projected(model), axis=-1), views=seen.sum(0),
    )  # fmt: skip


def _check(tracks: Floats, rig: Rig) -> None:
    if tracks.ndim != 4 or tracks.shape[2] != 2:
        raise MareyError(f"Tracks have shape {tracks.shape}; expected (cameras, frames, 2, points).")
    if len(tracks) != len(rig):
        raise MareyError(f"There are tracks of {len(tracks)} cameras, but the calibration has {len(rig)}.")
    if len(tracks) < 2:
        raise MareyError("Tracks of one camera alone do not determine the object's position; give two or more cameras.")


def _mean_sd(tracks_sd: Floats, tracks: Floats, settings: CalibratedSettings) -> Floats:
    """Compute one standard deviation per pixel, (C, F, P); zeros, of manually given points, become the least value."""
    tracks_sd = np.asarray(tracks_sd, float)
    if tracks_sd.shape != tracks.shape:
        raise MareyError(f"The tracks have shape {tracks.shape}, but their standard deviations {tracks_sd.shape}.")
    sd = np.sqrt((tracks_sd**2).mean(2))
    return np.asarray(np.maximum(sd, settings.least_sd_px))


def _noise_factor(rig: Rig, pixels: Floats, sd: Floats, settings: CalibratedSettings) -> float:
    """Estimate the ratio of actual to given standard deviations from the distances between rays of the same point.

    The median over all points is compared with that of the chi-square distribution (Wilson and Hilferty's formula), so
    that outliers have no influence.
    """
    flat = pixels.reshape(len(pixels), -1, 2)
    found = triangulate(rig.cameras, flat, sigma_px=sd.reshape(len(sd), -1)).points
    met: Mask = np.asarray(np.isfinite(found[:, 0]))
    if met.sum() < settings.fewest_met:
        raise MareyError(
            "No two cameras see the same points from two sides: either no point is seen by two cameras at once, or "
            "the cameras are in one place, or they are not in the order of the tracks."
        )
    away = (flat - np.stack([camera.project(found) for camera in rig]))[:, met] ** 2
    stated = sd.reshape(len(sd), -1)[:, met]
    there = np.isfinite(away).all(-1)
    squares = np.where(there, away.sum(-1) / stated**2, 0).sum(0)
    free = 2 * there.sum(0) - 3
    factor = float(np.sqrt(np.median(squares / (free * (1 - 2 / (9 * free)) ** 3))))
    width = float(np.median([camera.width for camera in rig]))
    off = factor * float(np.median(stated[there]))
    if off > settings.most_miss * width:
        raise MareyError(
            f"Rays of the same points miss each other by about {off:.0f} px: the cameras are not in the order of the "
            "tracks, the calibration belongs to other videos, or the tracks show different points."
        )
    return factor

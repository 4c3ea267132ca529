"""Shape and absolute motion of a deforming object from its tracks in calibrated cameras ([Alexander2003] section 2.6).

Unlike the paper, which reconstructs points first and factorises them, the model is fitted to the pixels: a point that
one camera alone sees is held by its ray and by the low rank, and a place counts by what its rays know of it.
"""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, Mask, freeze_fields
from marey.cameras.rig import Rig
from marey.cameras.triangulate import triangulate
from marey.errors import MareyError
from marey.nonrigid.in_space.factorisation import HomogeneousShapes, solved_shapes
from marey.nonrigid.in_space.pixel_places import PixelPlaces

LEAST_PX = 0.01
"""No pixel is trusted more than this."""
MOST_OFF = 0.005
"""Where rays miss each other by more than this share of the picture's width, they are not rays to the same points."""
FEWEST_MET = 10
"""Places on which rays meet, at least, to know how well they do."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CalibratedShapes(HomogeneousShapes):
    """Shapes and motions in the laboratory of the cameras, in metres.

    `residuals` are the distances of the model from the points on which the rays of two or more cameras meet.
    `noise_sd` is the points' own spread about the model, without the pixels' noise [m].
    """

    camera_names: tuple[str, ...]
    """C names, in the order of the tracks."""
    noise_px: float
    """Standard deviation of a pixel's coordinate, as rays of the same point show it; where standard deviations were
    given, of a usual pixel."""
    sd_factor: float
    """What the given standard deviations had to be multiplied by; `noise_px` itself where none were given."""
    residuals_px: Floats
    """(C, F, P) distance of each pixel from the model's [px]; NaN where not seen."""
    views: Integers
    """(F, P) number of cameras that saw the point."""

    def __post_init__(self) -> None:
        super().__post_init__()
        freeze_fields(self, "residuals_px")
        freeze_fields(self, "views", dtype=np.int64)


def factorise_calibrated(
    tracks: Floats, rig: Rig, *, tracks_sd: Floats | None = None, rank: int | None = None, reference: int | None = None
) -> CalibratedShapes:
    """Find basis shapes, weights and rigid motions in the laboratory from tracks in synchronised, calibrated cameras.

    Args:
        tracks: (C, F, 2, P) [px], the same point in the same column; NaN where not seen.
        rig: The C cameras, with their lenses, in the order of the tracks.
        tracks_sd: (C, F, 2, P) standard deviations, which count against each other; the factor common to all is
            found from how rays miss each other. None takes all pixels for equally good.
        rank: K, the number of basis shapes with the mean; None chooses it by points held back.
        reference: the frame in which the object's axes are those of the laboratory; by default the first with a pose.

    Returns:
        The shapes; NaN in frames and for points of which too little is seen.

    Raises:
        MareyError: The tracks do not suit the cameras, no two cameras see the same points from two sides, or there is
            too little for the rank, as in `factorise_points`.
    """
    tracks = np.asarray(tracks, float)
    _check(tracks, rig)
    pixels = np.moveaxis(tracks, 2, 3)
    given = np.ones(pixels.shape[:3]) if tracks_sd is None else _mean_sd(np.asarray(tracks_sd, float), tracks)
    factor = _noise_factor(rig, pixels, given)
    places = PixelPlaces(rig.cameras, pixels, np.maximum(factor * given, LEAST_PX))
    _, fields = solved_shapes(places, rank, reference)
    model = np.einsum("fij,fjp->fpi", fields["rotation"], fields["shape"]) + fields["translation"][:, None]
    seen = np.isfinite(pixels).all(-1)
    return CalibratedShapes(
        **fields, camera_names=rig.names, noise_px=float(np.median(places.sigma[seen])), sd_factor=factor,
        residuals_px=np.linalg.norm(places.pixels - places.projected(model), axis=-1), views=seen.sum(0),
    )  # fmt: skip


def _check(tracks: Floats, rig: Rig) -> None:
    if tracks.ndim != 4 or tracks.shape[2] != 2:
        raise MareyError(f"Tracks have the shape {tracks.shape} and should have (cameras, frames, 2, points).")
    if len(tracks) != len(rig):
        raise MareyError(f"There are tracks of {len(tracks)} cameras, and the calibration has {len(rig)}.")
    if len(tracks) < 2:
        raise MareyError("Tracks of one camera alone do not tell where the object is; two or more cameras are needed.")


def _mean_sd(tracks_sd: Floats, tracks: Floats) -> Floats:
    """Give one standard deviation (C, F, P) a pixel; one that is 0, of a point given by hand, as the least that is."""
    if tracks_sd.shape != tracks.shape:
        raise MareyError(f"The tracks have the shape {tracks.shape}, and their standard deviations {tracks_sd.shape}.")
    sd = np.sqrt((tracks_sd**2).mean(2))
    return np.maximum(sd, LEAST_PX)


def _noise_factor(rig: Rig, pixels: Floats, sd: Floats) -> float:
    """Find how many times worse than stated pixels are, from how rays of the same point miss each other.

    The median over all places is compared with that of chi square (Wilson and Hilferty's formula), so that slipped
    tracks do not count.
    """
    flat = pixels.reshape(len(pixels), -1, 2)
    found = triangulate(rig.cameras, flat, sigma_px=sd.reshape(len(sd), -1)).points
    met: Mask = np.asarray(np.isfinite(found[:, 0]))
    if met.sum() < FEWEST_MET:
        raise MareyError(
            "No two cameras see the same points from two sides: either no point is seen by two cameras at once, or "
            "the cameras stand in one place, or they are not in the order of the tracks."
        )
    away = (flat - np.stack([camera.project(found) for camera in rig]))[:, met] ** 2
    stated = sd.reshape(len(sd), -1)[:, met]
    there = np.isfinite(away).all(-1)
    squares = np.where(there, away.sum(-1) / stated**2, 0).sum(0)
    free = 2 * there.sum(0) - 3
    factor = float(np.sqrt(np.median(squares / (free * (1 - 2 / (9 * free)) ** 3))))
    width = float(np.median([camera.width for camera in rig]))
    off = factor * float(np.median(stated[there]))
    if off > MOST_OFF * width:
        raise MareyError(
            f"Rays of the same points miss each other by some {off:.0f} px: the cameras are not in the order of the "
            "tracks, the calibration is of other pictures, or the tracks are not of the same points."
        )
    return factor

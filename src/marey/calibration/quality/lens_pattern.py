"""Patterns of a camera's residuals over its image: what its lens model does not describe."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers
from marey.calibration.quality.finding import Examined, Finding
from marey.calibration.quality.views import COVERAGE

_BENT_PX = 0.05
"""Mean residual of a cell of the image from which the lens model is called insufficient [px]; chosen by hand."""
_BENT_SD = 5.0
"""The same in standard deviations; chosen by hand."""
_LEAST_CORNERS = 100
"""Least number of corners of a camera whose residuals are searched for a pattern; chosen by hand."""
_LEAST_VIEWS = 5
"""Least number of pictures that must show corners in a cell; chosen by hand."""
_LEAST_CELLS = 4
"""Least number of such cells; chosen by hand."""
_DOMINANT = 0.6
"""Share of the pattern's square from which it is called radial or tangential; chosen by hand."""
_RADIAL = 4
"""Number of coefficients of the radial pattern: odd powers of the radius up to the seventh."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LensPattern:
    """The mean residuals of the cells of an image, beyond what noise explains."""

    amplitude_px: float
    """Root mean square of the cells' mean residuals without that of noise [px]."""
    significance: float
    """Excess of their squares over that of noise, in standard deviations."""
    kind: str
    """radial, tangential, or place: what describes most of the pattern."""
    worst: str
    """Where the mean residual is largest, for example "top left"."""
    worst_px: float


def lens_patterns(session: Examined) -> Iterator[Finding]:
    """Name cameras whose residuals have a pattern over the image that the lens model does not describe."""
    corners, residual = session.solved.corners, session.solved.adjusted.residual
    for camera, size in enumerate(corners.sizes):
        own = (corners.camera == camera) & np.isfinite(residual).all(axis=1)
        if np.count_nonzero(own) < _LEAST_CORNERS:
            continue
        centre = session.solved.state.lens[camera, 2:4]
        found = lens_pattern(corners.pixels[own], residual[own], corners.view[own], size, centre)
        if found is None or not (found.amplitude_px > _BENT_PX and found.significance > _BENT_SD):
            continue
        what, advice = _WORDS[found.kind]
        yield Finding(
            code="lens-model", severity="caution",
            text=f"{corners.cameras[camera]}: the residuals have {what} over the image ({found.amplitude_px:.2f} px; "
                f"{found.worst_px:.2f} px in the {found.worst}) that the lens model does not describe.",
            advice=advice,
        )  # fmt: skip


_WORDS = {
    "radial": (
        "a radial pattern",
        "Its lens bends more than this model can: set a narrower field of view, or calibrate it as a fisheye with "
        "another program; marey capture reads such cameras. Check that zoom and focus were fixed.",
    ),
    "tangential": (
        "a tangential pattern",
        "Check that the lens sits straight and tight, that nothing oblique (a window, a cover) is before it, and that "
        "stabilisation is off.",
    ),
    "place": (
        "a pattern",
        "Film the board in all parts of its image, there above all; check that stabilisation is off, that the shutter "
        "does not roll, and that neither the camera nor its focus moved.",
    ),
}
"""What a kind of pattern is called, and what to do."""


def lens_pattern(
    pixels: Floats, residual: Floats, view: Integers, size: tuple[int, int], centre: Floats
) -> LensPattern | None:
    """Find the pattern of the residuals of one camera.

    Args:
        pixels: (n, 2) corners [px].
        residual: (n, 2) their residuals [px].
        view: (n,) picture of each.
        size: Width and height of the image [px].
        centre: (2,) principal point [px].

    Returns:
        The pattern; None if too few cells were seen often enough.
    """
    place, mean, variance = _cell_means(pixels, residual, view, size)
    if len(place) < _LEAST_CELLS:
        return None
    square = np.square(mean).sum(axis=1)
    excess, sd = float(np.sum(square - variance)), float(np.sqrt(np.sum(variance**2)))
    worst = int(np.argmax(square))
    return LensPattern(
        amplitude_px=float(np.sqrt(max(excess, 0.0) / len(square))), significance=excess / max(sd, 1e-12),
        kind=_kind(place - centre, mean, variance, max(size)), worst=_part_name(place[worst], size),
        worst_px=float(np.sqrt(square[worst])),
    )  # fmt: skip


def _cell_means(
    pixels: Floats, residual: Floats, view: Integers, size: tuple[int, int]
) -> tuple[Floats, Floats, Floats]:
    """Return mean place (m, 2), mean residual (m, 2) and its variance (m,) of the cells that were seen often."""
    rows, columns = COVERAGE
    cell = np.clip((pixels[:, 1] + 0.5) * rows // size[1], 0, rows - 1) * columns
    cell = (cell + np.clip((pixels[:, 0] + 0.5) * columns // size[0], 0, columns - 1)).astype(int)
    # Corners of one picture in one cell share errors: the pictures' means count, not the corners.
    key, inverse = np.unique(np.stack([cell, view], axis=-1), axis=0, return_inverse=True)
    inverse = np.ravel(inverse)
    count = np.bincount(inverse)
    both = np.concatenate([pixels, residual], axis=1)
    mean = np.stack([np.bincount(inverse, both[:, k]) / count for k in range(4)], axis=-1)
    own = np.ravel(np.unique(key[:, 0], return_inverse=True)[1])
    number = np.bincount(own)
    average = np.stack([np.bincount(own, mean[:, k]) / number for k in range(4)], axis=-1)
    scatter = np.square(mean[:, 2:] - average[own, 2:]).sum(axis=1)
    variance = np.bincount(own, scatter) / np.maximum(number - 1, 1) / number
    good = number >= _LEAST_VIEWS
    return average[good, :2], average[good, 2:], variance[good]


def _kind(place: Floats, mean: Floats, variance: Floats, width: int) -> str:
    """Return whether a radial or a tangential pattern explains most of the mean residuals (m, 2)."""
    x, y = 2.0 * place.T / width
    s, zero = x * x + y * y, np.zeros_like(x)
    radial = [np.stack([x * s**k, y * s**k], axis=-1) for k in range(_RADIAL)]
    tangential = [np.stack([2 * x * y, s + 2 * y * y], -1), np.stack([s + 2 * x * x, 2 * x * y], -1),
                  np.stack([-y, x], -1) + zero[:, None]]  # fmt: skip
    whole = float(np.sum(np.square(mean)) - np.sum(variance))
    for name, columns in (("radial", radial), ("tangential", tangential)):
        if 2 * len(mean) <= 2 * len(columns):
            continue
        table = np.stack([each.ravel() for each in columns], axis=-1)
        fitted = table @ np.linalg.lstsq(table, mean.ravel(), rcond=None)[0]
        # Of noise alone, each coefficient explains as much as one coordinate.
        explained = float(fitted @ fitted) - len(columns) * 0.5 * float(np.mean(variance))
        if explained > _DOMINANT * whole:
            return name
    return "place"


def _part_name(place: Floats, size: tuple[int, int]) -> str:
    """Return the part of an image, of nine, in which a place lies."""
    across = ("left", "", "right")[min(int(3 * (place[0] + 0.5) / size[0]), 2)]
    down = ("top", "", "bottom")[min(int(3 * (place[1] + 0.5) / size[1]), 2)]
    return f"{down} {across}".strip() or "middle"

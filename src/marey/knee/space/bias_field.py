"""Estimation and removal of the bias field of the coil, from the image alone."""

from dataclasses import dataclass
from itertools import product
from weakref import WeakKeyDictionary

import numpy as np
from numpy.polynomial import legendre

from marey.arrays import Floats
from marey.errors import MareyError
from marey.knee.space.resampling import on_grid, reach, resampled, smoothed, upright_grid
from marey.knee.space.volume import Volume, VoxelGrid

_WORK_MM = 3.0
"""Spacing [mm] of the grid on which the field is estimated; chosen by hand."""
_ORDER = 3
"""Highest total degree of the polynomials; chosen by hand."""
_ROUNDS = 50
"""Largest number of rounds, the default of N4 in ITK."""
_BINS = 200
"""Number of bins of the histogram, the default of N4 in ITK."""
_BLUR = 0.15
"""Full width at half maximum [natural logarithm] of the Gaussian by which the bias blurs the histogram, the default of
N4 in ITK."""
_WIENER_NOISE = 0.01
"""Noise term of the Wiener filter that deconvolves the histogram, the default of N4 in ITK."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BiasField:
    """Factor by which each voxel of an image is too bright; its median within the body is 1."""

    factor: Floats
    """(k, j, i) on its own, coarse grid."""
    grid: VoxelGrid

    def on(self, grid: VoxelGrid) -> np.ndarray:
        """(k, j, i) the factor on another grid; 1 outside its own."""
        return resampled(self.factor.astype(np.float32), self.grid, grid, outside=1.0)


_FOUND: WeakKeyDictionary[Volume, BiasField] = WeakKeyDictionary()
"""The bias field of each volume for which it was estimated with default settings."""


def bias_field(volume: Volume) -> BiasField:
    """Find the field whose removal sharpens the histogram of the logarithmic intensities most, as N3 and N4 do.

    Unlike [Tustison2010], with Legendre polynomials of the third order instead of B-splines, which takes at most 10 %
    of the time of N4 in SimpleITK. The field of each volume is estimated once.

    Args:
        volume: The image as it came from the scanner.
    """
    if volume not in _FOUND:
        _FOUND[volume] = _bias_field(volume)
    return _FOUND[volume]


def corrected_intensity(volume: Volume, bias: BiasField, grid: VoxelGrid) -> np.ndarray:
    """Return an image without bias on another grid; not smoothed where that grid is a part of its own.

    Args:
        volume: The image as it came from the scanner.
        bias: Its bias field.
        grid: Of the result.

    Returns:
        (k, j, i) intensity on `grid`.
    """
    factor = bias.on(grid)
    if np.allclose(volume.grid.lps_from_voxel[:3, :3], grid.lps_from_voxel[:3, :3]):
        values = volume.intensity
    else:
        values = smoothed(volume.intensity, volume.grid, 0.3 * float(grid.spacing_mm.min()))
    return np.asarray(resampled(values, volume.grid, grid) / factor)


def _bias_field(volume: Volume) -> BiasField:
    grid = upright_grid(volume.grid, _WORK_MM)
    values = np.maximum(on_grid(volume, grid, _WORK_MM / 2), 1e-3)
    within_image = reach(volume.grid, grid)
    tissue = within_image & (values > 0.25 * between_two_classes(values[within_image]))
    logarithm = np.log(values[tissue])
    basis = _polynomials(grid.shape)
    within = basis[tissue]
    try:
        solve = np.linalg.solve(within.T @ within, within.T)
    except np.linalg.LinAlgError as error:
        raise MareyError("The image is too small, or shows too little tissue, for a knee.") from error
    coefficients = np.zeros(within.shape[1])
    for _ in range(_ROUNDS):
        corrected = logarithm - within @ coefficients
        step = solve @ (corrected - _sharpened(corrected))
        coefficients += step
        if np.abs(within @ step).max() < 1e-3:
            break
    field = basis @ coefficients
    low, middle, high = np.percentile(field[tissue], [1, 50, 99])
    return BiasField(factor=np.exp(np.clip(field, low, high) - middle), grid=grid)


def between_two_classes(values: np.ndarray) -> float:
    """Return Otsu's threshold: the value that divides a histogram into two classes of least variance."""
    counts, edges = np.histogram(values, bins=256)
    centres = (edges[:-1] + edges[1:]) / 2
    below = np.cumsum(counts)[:-1]
    above = counts.sum() - below
    sums = np.cumsum(counts * centres)[:-1]
    total = float((counts * centres).sum())
    with np.errstate(divide="ignore", invalid="ignore"):
        between = below * above * (sums / below - (total - sums) / above) ** 2
    return float(edges[1:-1][int(np.nanargmax(between))])


def _polynomials(shape: tuple[int, ...]) -> Floats:
    """(k, j, i, terms) products of Legendre polynomials up to the order, without the constant."""
    axes = [[legendre.legval(np.linspace(-1, 1, n), np.eye(_ORDER + 1)[d]) for d in range(_ORDER + 1)] for n in shape]
    terms = [degrees for degrees in product(range(_ORDER + 1), repeat=3) if 0 < sum(degrees) <= _ORDER]
    return np.stack([np.einsum("k,j,i->kji", axes[0][a], axes[1][b], axes[2][c]) for a, b, c in terms], axis=-1)


def _sharpened(values: Floats) -> Floats:
    """(n,) expectation of each value without the blur, under the deconvolved histogram."""
    low, width = values.min(), np.ptp(values) / (_BINS - 1) + 1e-12
    place = (values - low) / width
    bins = np.minimum(place.astype(int), _BINS - 2)
    share = place - bins
    size = 1 << int(np.ceil(np.log2(2 * _BINS)))
    pad = (size - _BINS) // 2
    histogram = np.zeros(size)
    histogram[pad : pad + _BINS] = np.bincount(bins, 1 - share, _BINS) + np.bincount(bins + 1, share, _BINS)
    offsets = np.fft.fftfreq(size) * size
    gaussian = np.exp(-0.5 * (offsets * width * 2.3548 / _BLUR) ** 2)
    blur = np.fft.fft(gaussian / gaussian.sum())
    wiener = np.conj(blur) / (np.abs(blur) ** 2 + _WIENER_NOISE)
    sharp = np.maximum(np.real(np.fft.ifft(np.fft.fft(histogram) * wiener)), 0)
    centres = low + (np.arange(size) - pad) * width
    weight = np.real(np.fft.ifft(np.fft.fft(sharp) * blur))
    first = np.real(np.fft.ifft(np.fft.fft(sharp * centres) * blur))
    known = weight > 1e-10 * weight.max()
    expected = np.where(known, first / np.where(known, weight, 1), centres)
    return np.interp(values, centres, expected)

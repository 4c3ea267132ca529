"""Reference implementations of the matching kernels, in NumPy: splines, a step of a match, the effects of noise."""

import numpy as np

from marey.arrays import Floats
from marey.images.matching.splines import POLE, SplinePicture, slopes, weights


def sample(picture: SplinePicture, positions: Floats) -> tuple[Floats, Floats]:
    """Evaluate a spline and its gradient; reference implementation for the kernels.

    Args:
        picture: The spline.
        positions: (..., 2) x, y [px].

    Returns:
        Values (...) and gradients (..., 2) in grey levels per pixel; NaN less than a pixel from the image border,
        beyond it, and near missing pixels.
    """
    coefficients = picture.coefficients
    whole = np.floor(positions)
    column, row = np.moveaxis(np.nan_to_num(whole, nan=-9.0).astype(np.int64), -1, 0)
    height, width = coefficients.shape
    inside = (column >= 1) & (row >= 1) & (column <= width - 3) & (row <= height - 3)
    column, row = np.where(inside, column, 1), np.where(inside, row, 1)
    x, y = np.moveaxis(positions - whole, -1, 0)
    taps = np.arange(-1, 3)
    around = np.full((*row.shape, 4, 4), np.nan)
    if min(height, width) >= 4:
        around = coefficients[(row[..., None] + taps)[..., :, None], (column[..., None] + taps)[..., None, :]]
    around = np.where(inside[..., None, None], around.astype(float), np.nan)
    value = np.einsum("...i,...ij,...j->...", weights(y), around, weights(x))
    along = np.einsum("...i,...ij,...j->...", weights(y), around, slopes(x))
    down = np.einsum("...i,...ij,...j->...", slopes(y), around, weights(x))
    return value, np.stack([along, down], axis=-1)


def offsets(half: int) -> Floats:
    """Return a patch's pixels (N, 2) relative to its centre, row by row [px]."""
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    return np.stack([x.ravel(), y.ravel()], axis=-1).astype(float)


def grey_values(template: SplinePicture, pixel: Floats, change: Floats, *, half: int) -> tuple[Floats, Floats]:
    """Predict a patch's grey values from the template, and differentiate them by the parameters.

    Args:
        template: The template image.
        pixel: (2,) centre of the patch [px].
        change: (8,) shift x and y, the linear part less the identity (row by row), gain, and offset.
        half: Pixels from the centre to the edge.

    Returns:
        Values (N,) and their derivatives (N, 8).
    """
    around = offsets(half)
    moved = pixel + change[:2] + around + around @ change[2:6].reshape(2, 2).T
    value, gradient = sample(template, moved)
    by_map = np.concatenate([gradient, gradient[:, :1] * around, gradient[:, 1:] * around], axis=-1)
    columns = [change[6] * by_map, value[:, None], np.ones_like(value)[:, None]]
    return change[6] * value + change[7], np.concatenate(columns, axis=-1)


def one_step(
    template: SplinePicture, search: SplinePicture, pixel: Floats, to_search: Floats, *, half: int
) -> tuple[Floats, Floats, Floats]:
    """Do one step of `match` for one free patch with all parameters; reference implementation for the kernel.

    Args:
        template: The template image.
        search: The search image.
        pixel: (2,) centre of the patch in the template [px].
        to_search: (6,) the map: position of the centre in the search image [px], and the linear part row by row.
        half: Pixels from the centre to the edge.

    Returns:
        The next map (6,), the corresponding change of the template (8,), and the residuals of the search patch's grey
        values (N,).
    """
    unchanged = np.array([0.0, 0, 0, 0, 0, 0, 1, 0])
    _, derivative = grey_values(template, pixel, unchanged, half=half)
    linear = to_search[2:].reshape(2, 2)
    found, _ = sample(search, to_search[:2] + offsets(half) @ linear.T)
    change = np.linalg.lstsq(derivative, found, rcond=None)[0]
    left = found - derivative @ change
    change[:6] /= change[6]
    return changed(to_search, change[:6]), change, left


def changed(to_search: Floats, change: Floats) -> Floats:
    """Compose a map (6,) into the search image with the inverse of a change (6,) of the template."""
    linear = to_search[2:].reshape(2, 2) @ np.linalg.inv(np.eye(2) + change[2:].reshape(2, 2))
    return np.concatenate([to_search[:2] - linear @ change[:2], linear.ravel()])


def noise_effects(
    derivative: Floats, pixel: Floats, to_search: Floats, *, residual: float, stated: float, gain: float, half: int
) -> tuple[float, Floats, Floats]:
    """Compute the effects of both images' noise on a free match; reference implementation for a kernel.

    Ours. Interpolated values have less noise than pixels, so that the residuals underestimate it. The template's
    gradients are noisy, so that their normal matrix is larger than that of the texture itself. Between the pixels this
    noise is correlated with that of the grey values, and with their share in the gradients, which biases the matches.
    Residuals beyond the stated noise are not noise of pixels but real differences of the images (gloss, a curved
    surface): they increase the covariance and do not affect the gradients.

    Args:
        derivative: (N, 8) of `grey_values` at no change and gain 1.
        pixel: (2,) the patch's centre in the template [px].
        to_search: (6,) the map found.
        residual: standard deviation of what the match leaves of the search patch [grey levels].
        stated: the pixels' noise, as far as it is known beforehand [grey levels].
        gain: of the grey values.
        half: pixels from the centre to the edge.

    Returns:
        The noise estimated from the residual [grey levels]; the change (6,) by which `changed` corrects the bias; and
        the covariance (2, 2) of the position in the search image [px2].
    """
    around, size = offsets(half), len(derivative)
    (kept_x, kept_y), (slope_x, slope_y), (both_x, both_y) = _noise_shares_at(pixel)
    kept = np.prod(_noise_shares_at(to_search[:2] + around @ to_search[2:].reshape(2, 2).T)[0], axis=-1).mean()
    noise = residual / np.sqrt(gain**2 * kept_x * kept_y + kept)
    grey = derivative[:, 6:]
    share = np.linalg.lstsq(grey, derivative[:, :6], rcond=None)[0]
    columns = derivative[:, :6] - grey @ share
    normal, spread = columns.T @ columns, np.mean(around[:, 0] ** 2)
    slopes = np.array([slope_x * kept_y, slope_y * kept_x])
    white = size * min(noise, stated) ** 2
    inverse = np.linalg.inv(normal - white * np.diag(np.concatenate([slopes, np.repeat(spread * slopes, 2)])))
    together = np.array([both_x * kept_y, both_y * kept_x, 0, 0, 0, 0]) - share[0] * kept_x * kept_y
    linear = to_search[2:].reshape(2, 2)
    covariance = noise**2 * (inverse + inverse @ normal @ inverse / gain**2)[:2, :2]
    return noise, white * inverse @ together, linear @ covariance @ linear.T


def noise_shares(count: int) -> tuple[Floats, Floats, Floats]:
    """Compute the share of the pixels' white-noise variance that remains between them, along one axis.

    Args:
        count: Number of fractions of a pixel, from 0 to 1.

    Returns:
        Shares (count,) of the variance in the spline's values, 1 at the pixel centres and 0.76 half-way; in its slopes
        [1/px2]; and of the covariance of both [1/px], zero at the centres and half-way.
    """
    reach = np.arange(-16, 17)
    pulse = -6 * POLE / (1 - POLE**2) * POLE ** np.abs(reach)
    fraction = np.linspace(0, 1, count)
    values, gradients = (
        np.stack([np.convolve(pulse, taps) for taps in table]) for table in (weights(fraction), slopes(fraction))
    )
    return np.sum(values**2, axis=-1), np.sum(gradients**2, axis=-1), np.sum(values * gradients, axis=-1)


def _noise_shares_at(positions: Floats) -> Floats:
    """Return `noise_shares` (3, ..., 2) at positions (..., 2) [px], for each axis."""
    fractions = np.linspace(0, 1, 1001)
    return np.stack([np.interp(positions % 1, fractions, share) for share in noise_shares(len(fractions))])

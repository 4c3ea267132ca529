"""Normal equations of a patch's position from its grey values: structure matrix and right-hand side."""

import math

import numpy as np

from marey.compiled.kernels import kernel
from marey.images.matching import patch_kernels as kernels


@kernel
def write_equations(windows, chosen, pixels, search, carried, half, least, information, right, correlation):
    """Linearise the squared difference of a patch and an image about the predicted position.

    Gain and offset of the grey values are fitted first; the gradients are the template's, transformed by the affine map
    ([Irani1999] with the gradients of [Baker2004]). The residual after the shift is the estimate of the noise.

    Args:
        windows: (R, S, S) float32 coefficients of the references' splines.
        chosen: (n,) which of them.
        pixels: (n, 2) the patches' centres in their windows; NaN where there is none.
        search: (H, W) coefficients of the image.
        carried: (n, 6) the maps: place of the centre [px], and the linear part row by row.
        half: pixels from a patch's centre to its edge.
        least: least variance of a pixel's noise [grey2].
        information: (n, 2, 2) for the inverse covariance of the places [1/px2]; left as it is where nothing is known.
        right: (n, 2) for the information times the place that the patch points to [1/px].
        correlation: (n,) for that of the grey values at the given place.
    """
    size = (2 * half + 1) ** 2
    work, patch = kernels.patch_work(half), kernels.template_patch(half, 2)
    found, projected, normal = np.empty(kernels.padded_size(half), np.float32), np.empty(2), patch.normal
    height, width = search.shape
    for i in range(pixels.shape[0]):
        x, y = pixels[i]
        u, v, a, b, c, d = carried[i]
        area, wide, high = a * d - b * c, half * (abs(a) + abs(b)), half * (abs(c) + abs(d))
        inside = u - wide >= 1 and v - high >= 1 and u + wide < width - 2 and v + high < height - 2
        if not (math.isfinite(x + y) and inside and area > 0.05 and area < 20):
            continue
        _, energy = kernels.take_template(windows[chosen[i]], x, y, work, patch)
        kernels.take_search(search, carried[i], work, found)
        along, power = kernels.compare(patch, work, found, projected)
        if not (math.isfinite(energy + power) and energy > 1e-9 * size and power > 1e-9 * size):
            continue
        correlation[i] = along / math.sqrt(energy * power)
        gain = along / energy
        if gain <= 0:
            continue
        determinant = normal[0, 0] * normal[1, 1] - normal[0, 1] * normal[1, 0]
        explained = 0.0
        if determinant > 1e-6 * normal[0, 0] * normal[1, 1]:
            explained = (
                normal[1, 1] * projected[0] ** 2 - 2 * normal[0, 1] * projected[0] * projected[1]
                + normal[0, 0] * projected[1] ** 2
            ) / determinant  # fmt: skip
        noise = max(max(power - along * along / energy - explained, 0.0) / (size - 4), least)
        # Template from search: the inverse of the linear part.
        p, q, r, s = d / area, -b / area, -c / area, a / area
        xx, xy, yy = normal[0, 0] * gain**2 / noise, normal[0, 1] * gain**2 / noise, normal[1, 1] * gain**2 / noise
        information[i, 0, 0] = p * p * xx + 2 * p * r * xy + r * r * yy
        information[i, 0, 1] = information[i, 1, 0] = p * q * xx + (p * s + q * r) * xy + r * s * yy
        information[i, 1, 1] = q * q * xx + 2 * q * s * xy + s * s * yy
        e, f = projected[0] * gain / noise, projected[1] * gain / noise
        right[i, 0] = information[i, 0, 0] * u + information[i, 0, 1] * v - (p * e + r * f)
        right[i, 1] = information[i, 1, 0] * u + information[i, 1, 1] * v - (q * e + s * f)

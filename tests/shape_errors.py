"""How far recovered shapes lie from the true ones where scale and mirror image are free."""

import numpy as np

from marey.arrays import Floats


def shape_error(found: Floats, truth: Floats) -> float:
    """Give the relative error of shapes (F, 3, P) before the camera, of the better mirror image in depth."""
    own, true = (shape - shape.mean(2, keepdims=True) for shape in (found, truth))
    errors = []
    for sign in (1, -1):
        mirrored = own * np.array([1, 1, sign])[:, None]
        scale = (mirrored * true).sum() / (mirrored**2).sum()
        errors.append(float(np.sqrt(((scale * mirrored - true) ** 2).sum() / (true**2).sum())))
    return min(errors)

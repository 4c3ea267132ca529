"""What a user should know of bones that were found: how well the template lies, and where a bone may have leaked."""

import numpy as np
from scipy import ndimage

from marey.arrays import Mask
from marey.knee.bones.marrow import WORK_MM
from marey.knee.bones.partial_view import LONG_BONES
from marey.knee.bones.region_growing import outgrowth, thin_share
from marey.knee.bones.template_fit import TemplateFit
from marey.knee.space.volume import Grid

_OUTGROWTH_CM3 = 1.0
_MOST_THIN = 0.045


def fit_note(fit: TemplateFit) -> str:
    """Say of which side the template is, and how well it lies."""
    side = "mirrored, as it is of the other side" if fit.mirrored else "of the same side"
    return f"The template is {side}; {100 * fit.fit:.0f} % of its edges lie on edges of bone."


def outgrowth_note(name: str, inside: Mask, grid: Grid) -> list[str]:
    """Say where a femur or tibia has a part that none has: it may have leaked there.

    Args:
        name: Of the bone.
        inside: (k, j, i) the bone.
        grid: The upright grid of both.

    Returns:
        One sentence, or none.
    """
    if name not in LONG_BONES:
        return []
    part = outgrowth(inside)
    pieces, count = ndimage.label(part)
    if not count:
        return []
    sizes = np.bincount(pieces.ravel())[1:]
    cm3 = float(sizes.max()) * WORK_MM**3 / 1000
    if cm3 < _OUTGROWTH_CM3:
        return []
    x, y, z = grid.lps(np.argwhere(pieces == 1 + int(sizes.argmax())).mean(axis=0)[::-1])
    return [
        f"The {name} has an outgrowth of {cm3:.1f} cm3 about LPS {x:.0f} {y:.0f} {z:.0f} mm that may be a leak:"
        " look there; a template, or another seed, may keep it out."
    ]


def thin_note(name: str, inside: Mask) -> list[str]:
    """Say of a femur or tibia that grew without a template that it is not as round as whole ones are.

    Args:
        name: Of the bone.
        inside: (k, j, i) the bone, on an upright grid.

    Returns:
        One sentence, or none.
    """
    if name not in LONG_BONES:
        return []
    share = thin_share(inside)
    if share < _MOST_THIN:
        return []
    return [
        f"The {name} has {100 * share:.0f} % of its volume in thin parts, where whole ones have 1 to 2 %: it has"
        " probably leaked. Look at its surface; a template would keep leaks out."
    ]

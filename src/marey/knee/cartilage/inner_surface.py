"""The inner surface of cartilage, fitted anew: how far along its normals a bone's surface lies beside the edge."""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from marey.arrays import Floats, Mask, freeze_fields
from marey.knee.bones.marrow import Kind
from marey.knee.cartilage.evidence import DEPTHS_MM, OVER_MM, STEP_MM, STRAY, Profiles, Tissues
from marey.knee.space.mesh_graph import MeshGraph

OFFSETS_MM = np.arange(-7, 8) * 0.2
"""How far the edge may lie outward of the bone's surface as it was found."""
BONE_SD_MM = {"dark": 0.5, "bright": 0.8}
"""How well the bone's surface was found, as a standard deviation, by the marrow: a bone with dark marrow was cut along
the very edge at which cartilage begins; bright marrow ends at the cortex, and fades into cartilage."""
SLOPE_SD = {"dark": 0.15, "bright": 0.3}
"""How fast its error changes over the bone [mm/mm]."""
_TEAR = 12.0
"""No pair of neighbours costs more."""
_LEAST_CONTRAST = 0.1
"""Where marrow and cartilage differ by less of the cartilage's brightness, the edge between them is not seen."""

_LINE_MM, _DARKER = 1.5, 0.25
"""A dark line is looked for so near, and is so much darker than marrow and cartilage, as a share of the latter."""


@dataclass(frozen=True, eq=False, kw_only=True)
class InnerEdge:
    """Where cartilage begins, beside the bone's surface as it was found."""

    offset_mm: Floats
    """(V,) outward along the normal."""
    sd_mm: Floats
    """(V,) by each vertex's own profile and `BONE_SD_MM`."""

    def __post_init__(self) -> None:
        freeze_fields(self, "offset_mm", "sd_mm")


def inner_edge(costs: Floats, graph: MeshGraph, marrow: Kind) -> InnerEdge:
    """Choose the place of the edge at each vertex, as a smooth sheet.

    Args:
        costs: (V, S) of each of `OFFSETS_MM` by the image, from `inner_costs`, summed over the images.
        graph: Of the bone.
        marrow: Whether it is dark beside cartilage, in any of the images, or bright.
    """
    own = costs + 0.5 * (OFFSETS_MM / BONE_SD_MM[marrow]) ** 2
    beliefs = graph.choose(own, OFFSETS_MM, SLOPE_SD[marrow], _TEAR)
    chance = np.exp(own.min(1, keepdims=True) - own)
    chance /= chance.sum(1, keepdims=True)
    mean = chance @ OFFSETS_MM
    sd = np.sqrt((chance * (OFFSETS_MM - mean[:, None]) ** 2).sum(1))
    return InnerEdge(offset_mm=_between(beliefs), sd_mm=sd)


def inner_costs(
    profiles: Profiles, seen: Tissues, thickness_mm: Floats, present: Mask, offset_mm: Floats
) -> Floats:  # fmt: skip
    """Return what each place of the edge between bone and cartilage costs (V, S), at `OFFSETS_MM`.

    The outer surface stays where it is, and what lies beyond it is left out of account.

    Args:
        profiles: Grey values from the bone's surface moved by `offset_mm`.
        seen: The tissues.
        thickness_mm: (V,) from there to the outer surface.
        present: (V,) where cartilage is; elsewhere nothing is told.
        offset_mm: (V,) how far outward of the bone's first surface 0 of the profile lies.
    """
    costs = np.zeros((len(offset_mm), len(OFFSETS_MM)))
    used = np.flatnonzero(present & _seen(seen, thickness_mm - profiles.blur_mm))
    values, marrow = seen.relative[used], seen.marrow[used, None]
    blur, thick = profiles.blur_mm[used, None], thickness_mm[used, None]
    beyond = (thick + 1.5 * blur < DEPTHS_MM) & (thick + 1.5 * blur + OVER_MM > DEPTHS_MM)
    over = (values * beyond).sum(1, keepdims=True) / np.maximum(beyond.sum(1, keepdims=True), 1)
    outer = (np.where(beyond.any(1, keepdims=True), over, 1.0) - 1) * ndtr((DEPTHS_MM - thick) / blur)
    share = np.where(thick >= DEPTHS_MM, STEP_MM / profiles.alike_mm[used, None], 0.0)
    for n, offset in enumerate(OFFSETS_MM):
        inner = ndtr((DEPTHS_MM - (offset - offset_mm[used, None])) / blur)
        off = (values - (marrow + (1 - marrow) * inner + outer)) / seen.spread
        costs[used, n] = -(share * np.log((1 - STRAY) * np.exp(-0.5 * off**2) + STRAY)).sum(1)
    return costs


def _seen(seen: Tissues, until_mm: Floats) -> Mask:
    """(V,) true where marrow and cartilage differ and no dark line of cortex lies between them, which is the bone's."""
    within = np.minimum(until_mm, _LINE_MM)[:, None] >= DEPTHS_MM
    above = np.where(within, seen.relative, -np.inf)
    # A line, not an edge to something dark: farther out it is brighter again.
    after = np.maximum.accumulate(above[:, ::-1], axis=1)[:, ::-1]
    dip = np.minimum(after, seen.marrow[:, None]) - seen.relative
    line = np.where(within & (DEPTHS_MM > -_LINE_MM), dip, 0.0).max(1) > max(_DARKER, 4 * seen.spread)
    return (np.abs(1 - seen.marrow) > _LEAST_CONTRAST) & ~line


def _between(beliefs: Floats) -> Floats:
    """Return the least of the costs (V, S), between the places: there they are a parabola."""
    rows, best = np.arange(len(beliefs)), np.clip(np.argmin(beliefs, 1), 1, len(OFFSETS_MM) - 2)
    before, least, after = (beliefs[rows, best + step] for step in (-1, 0, 1))
    beside = np.clip(0.5 * (before - after) / np.maximum(before - 2 * least + after, 1e-6), -1, 1)
    return np.asarray(OFFSETS_MM[best] + beside * (OFFSETS_MM[1] - OFFSETS_MM[0]))

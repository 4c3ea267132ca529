"""Subregions of a knee's cartilage: medial and lateral, and from front to back, by the bone's own geometry."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask
from marey.errors import MareyError
from marey.knee.cartilage.outer_surface import CartilageSheet

PARTS = ("anterior", "central", "posterior")
"""Names of the parts from front to back."""
TROCHLEA_DEG, POSTERIOR_DEG = -20.0, 50.0
"""Angles about the axis of the condyles, from straight down, negative forward: the lower end of the trochlea, and the
beginning of the posterior part of the condyles; chosen by hand."""
_TRIMMED = 0.01
"""Share of the covered vertices that is ignored at each end when extents are measured; chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FlatMap:
    """Position of each vertex of a bone in a flat image of its cartilage."""

    across: Floats
    """(V,) mm from the middle, towards lateral."""
    along: Floats
    """(V,) mm: for a femur along the arc from the front over the bottom to the back, for a tibia from front to back,
    and for a patella from the head to the foot."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Subregion:
    """Measures of one part of a cartilage."""

    name: str
    area_mm2: float
    """Area of the covered bone."""
    volume_mm3: float
    """Area times thickness."""
    mean_mm: float
    """Area-weighted mean thickness over the covered bone; NaN where none is covered."""
    thickest_mm: float
    """99th percentile of the thickness at the covered vertices."""
    covered: float
    """Share of the part's vertices that are not bare; NaN for the whole bone."""


def flat_map(bone: str, sheet: CartilageSheet, *, left: bool) -> FlatMap:
    """Unroll a femur about the axis of its condyles, or project another bone's joint surface along its axis.

    Args:
        bone: Name of the bone.
        sheet: Cartilage of the bone; the covered part gives the middle and, of a femur, the axis.
        left: Whether it is of a left knee: LPS x increases to the left.

    Raises:
        MareyError: It has no cartilage.
    """
    covered = sheet.thickness_mm > 0
    if not covered.any():
        raise MareyError(f"The {bone} has no cartilage.")
    places = sheet.bone.vertices_mm
    low, high = np.quantile(places[covered], (_TRIMMED, 1 - _TRIMMED), axis=0)
    middle = 0.5 * (low + high)
    lateral = 1.0 if left else -1.0
    across = lateral * (places[:, 0] - middle[0])
    if bone == "patella":
        return FlatMap(across=across, along=middle[2] - places[:, 2])
    if bone == "tibia":
        return FlatMap(across=across, along=places[:, 1] - middle[1])
    angle, radius = _about_condyles(sheet)
    return FlatMap(across=across, along=angle * radius)


def subregion_names(bone: str, sheet: CartilageSheet, *, left: bool) -> list[str]:
    """Name the part of each vertex (V,), such as "medial central"."""
    flat = flat_map(bone, sheet, left=left)
    side = np.where(flat.across > 0, "lateral", "medial")
    if bone == "patella":
        return [str(name) for name in side]
    if bone == "femur":
        angle = np.degrees(_about_condyles(sheet)[0])
        part = np.select([angle < TROCHLEA_DEG, angle < POSTERIOR_DEG], PARTS[:2], PARTS[2])
    else:
        covered = sheet.thickness_mm > 0
        part = np.empty(len(side), dtype=object)
        for one in ("medial", "lateral"):
            here = side == one
            place = flat.along[here & covered] if (here & covered).any() else flat.along[here]
            low, high = np.quantile(place, (_TRIMMED, 1 - _TRIMMED))
            third = (flat.along - low) / max(high - low, 1e-9)
            part[here] = np.select([third < 1 / 3, third < 2 / 3], PARTS[:2], PARTS[2])[here]
    return [f"{one} {other}" for one, other in zip(side, part, strict=True)]


def subregions(bone: str, sheet: CartilageSheet, *, left: bool) -> list[Subregion]:
    """Measure each part, and the whole cartilage as the last."""
    names = np.array(subregion_names(bone, sheet, left=left))
    covered = sheet.thickness_mm > 0
    found = [_measured(name, names == name, covered, sheet) for name in sorted(set(names[covered]))]
    return [*found, whole(sheet)]


def whole(sheet: CartilageSheet) -> Subregion:
    """Measure the whole cartilage of a bone, whose side need not be known."""
    covered = sheet.thickness_mm > 0
    return _measured("all", np.ones(len(covered), bool), covered, sheet)


def _measured(name: str, here: Mask, covered: Mask, sheet: CartilageSheet) -> Subregion:
    part = here & covered
    thickness, weight = sheet.thickness_mm[part], sheet.bone.vertex_areas_mm2[part]
    return Subregion(
        name=name,
        area_mm2=float(weight.sum()),
        volume_mm3=float(weight @ thickness),
        mean_mm=float(weight @ thickness / weight.sum()) if part.any() else np.nan,
        thickest_mm=float(np.quantile(thickness, 0.99)) if part.any() else np.nan,
        covered=float(part.sum() / max(np.count_nonzero(here), 1)) if name != "all" else np.nan,
    )


def _about_condyles(sheet: CartilageSheet) -> tuple[Floats, float]:
    """Return the angle (V,) about the condyles' axis, 0 straight down and positive to the back, and the radius [mm].

    The axis runs from side to side through the centre of the circle that fits the lower and posterior cartilage best.
    """
    places = sheet.bone.vertices_mm
    covered = sheet.thickness_mm > 0
    low, high = np.quantile(places[covered], (_TRIMMED, 1 - _TRIMMED), axis=0)
    posterior = covered & (places[:, 1] > 0.5 * (low + high)[1])
    y, z = places[posterior if posterior.sum() > 20 else covered][:, 1:].T
    # The circle's equation is linear in its centre, and in its squared radius minus the centre's ([Kasa1976]).
    matrix = np.stack([2 * y, 2 * z, np.ones_like(y)], 1)
    centre_y, centre_z, rest = np.linalg.lstsq(matrix, y**2 + z**2, rcond=None)[0]
    radius = float(np.sqrt(max(rest + centre_y**2 + centre_z**2, 1.0)))
    return np.arctan2(places[:, 1] - centre_y, centre_z - places[:, 2]), radius

"""The outer surface of cartilage, found along the bone's normals ([Alexander2003] section 2.1).

From each vertex of the bone the image is read along the normal. A Gaussian about the foretold thickness, a third of it
wide, weighs what the image says of each thickness. Unlike the paper, the normal is the subject's own, smoothed: the
template's, carried along, lies 12 degrees off it in the median. And where the paper takes the strongest edge of the
weighted gradient, a layer between two blurred edges is laid over the whole profile, since the gradient's maxima of a
thin layer lie too far apart; the answers are chosen together as one sheet whose thickness changes slowly; and what the
template foretells is scaled, region by region, to the person's cartilage wherever the image shows its edge, so that the
Gaussian stands where that person's cartilage should end and draws nothing to the template's thickness.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import erf

from marey.arrays import Floats, Integers, Mask, frozen
from marey.errors import MareyError
from marey.knee.cartilage.contact import contact_with
from marey.knee.cartilage.evidence import (
    LEVELS_MM,
    STEP_MM,
    THICKEST_MM,
    THINNEST_MM,
    layer_costs,
    measured_blur,
    read_profiles,
    tissues,
)
from marey.knee.cartilage.inner_surface import inner_costs, inner_edge
from marey.knee.cartilage.prediction import RIM_MM, TOLD_SHARE, CartilagePrediction
from marey.knee.space.mesh_graph import MeshGraph
from marey.knee.space.surface import Surface
from marey.knee.space.volume import Volume

SLOPE_SD = 0.4
"""How fast the thickness changes over the bone [mm/mm]."""
LEAST_PRESENCE = 0.02
"""No template is so sure that there is none, or some."""
RIM_COST = 3.0
"""What a rim costs at most, at each edge of the mesh that crosses it."""
NORMALS_MM = 1.0
"""Normals are smoothed over so much of the bone: they shall not follow its roughness."""
REGION_MM = 8.0
"""Over such a way a person's cartilage keeps its ratio to the template's."""
NEAR_MM = 2.5
"""So far from the answer other thicknesses count in its standard deviation."""
MODEL_SD_MM = 0.15
"""What the model of a profile, a bone's surface and its normal are worth, as a standard deviation of the thickness."""
_FEW = 0.02
"""So little edge nearby, as a share of all vertices about, tells as much of the ratio as the whole cartilage does."""
_SURE_MM = 0.5
"""An edge known so well takes part in the scaling."""
SPECK_MM2, HOLE_MM2 = 40.0, 6.0
"""Smaller pieces of cartilage, and smaller holes in it, are none."""
_ROUNDS = 3
_HAIR = 1e-3
_TOLD = 0.8
"""The template has cartilage where it is so probable."""
_SOME = 0.5
"""Cartilage is so probable by the template that its inner edge is looked for though none was found."""
_COVERED = 0.84
"""Of a mask spread over `RIM_MM`, so much is left that far from its rim."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CartilageSheet:
    """The cartilage on one bone, at each of the bone's vertices."""

    bone: Surface
    """Its vertices moved to where the cartilage begins."""
    normals: Floats
    """(V, 3) along which it was looked for."""
    thickness_mm: Floats
    """(V,) 0 where the bone is bare."""
    thickness_sd_mm: Floats
    """(V,) by the costs of other thicknesses; NaN where the bone is bare."""
    confidence: Floats
    """(V,) how probable the answer is, bare or within half a millimetre, from 0 to 1."""
    foretold_mm: Floats | None = None
    """(V,) the template's thickness after it was scaled to this person's, 0 where the bone is bare."""
    by_image: Floats | None = None
    """(V,) share of what is known of the thickness that the image tells, not the template: 1 less the ratio of the
    variances with the image and without; NaN where the bone is bare."""
    scale: Floats | None = None
    """(V,) this person's cartilage is foretold so many times as thick as the template's."""
    moved_mm: Floats | None = None
    """(V,) how far `bone` lies outward of the surface that was given."""
    blur_mm: Floats | None = None
    """(V,) standard deviation of an edge's blur along the normal, in the sharpest image; NaN where the bone is bare."""

    def __post_init__(self) -> None:
        for name in (
            "normals", "thickness_mm", "thickness_sd_mm", "confidence", "foretold_mm", "by_image", "scale",
            "moved_mm", "blur_mm",
        ):  # fmt: skip
            if getattr(self, name) is not None:
                object.__setattr__(self, name, frozen(getattr(self, name)))

    @property
    def outer(self) -> Surface:
        """The closed surface of the cartilage: the bone where it is covered, the outer sheet, and walls at the rim.

        Raises:
            MareyError: There is no cartilage.
        """
        used, faces = self._closed()
        sheet = self.bone.vertices_mm + self.thickness_mm[:, None] * self.normals
        return Surface(vertices_mm=np.concatenate([self.bone.vertices_mm, sheet])[used], faces=faces)

    @property
    def outer_thickness_mm(self) -> Floats:
        """Return the thickness at each vertex of `outer`.

        Raises:
            MareyError: There is no cartilage.
        """
        return self.thickness_mm[self._closed()[0] % len(self.thickness_mm)]

    def _closed(self) -> tuple[Integers, Integers]:
        """Return the vertices of `outer`, numbered through the bone's and then the outer sheet's, and its faces."""
        covered = self.thickness_mm > 0
        faces = self.bone.faces[covered[self.bone.faces].all(1)]
        if not len(faces):
            raise MareyError("No cartilage was found on the bone.")
        edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        _, place, count = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
        rim = edges[count[place.reshape(-1)] == 1]
        total = len(covered)
        walls = np.concatenate([np.c_[rim[:, 0], rim[:, 1], rim[:, 1] + total],
                                np.c_[rim[:, 0], rim[:, 1] + total, rim[:, 0] + total]])  # fmt: skip
        every = np.concatenate([faces[:, ::-1], faces + total, walls])
        used, renumbered = np.unique(every, return_inverse=True)
        return used, renumbered.reshape(-1, 3)


def find_cartilage(
    volumes: Sequence[Volume], bone: Surface, prediction: CartilagePrediction,
    others: Sequence[tuple[Surface, Floats]] = (), before: CartilageSheet | None = None,
) -> CartilageSheet:  # fmt: skip
    """Find the cartilage on a bone.

    Args:
        volumes: One image or several in the same place, of any contrasts in which cartilage differs from what lies
            over it. What several say is added up.
        bone: The inner surface of the cartilage, about.
        prediction: From the template.
        others: The other bones, and how thick the cartilage on each is foretold to be at its vertices, 0 where bare:
            where two cartilages touch, the space between the bones is shared.
        before: An earlier answer on this bone, from which to go on.

    Raises:
        MareyError: The template foretells no cartilage on this bone.
    """
    looked = np.isfinite(prediction.thickness_mm)
    if np.count_nonzero(looked & (prediction.presence > _TOLD)) < 20:
        raise MareyError("The template foretells no cartilage on this bone: does it fit?")
    normals = _steady_normals(bone)
    part, told, presence = _part(bone, looked), prediction.thickness_mm[looked], prediction.presence[looked]
    moved: Floats = np.zeros(len(told))
    scale: Floats = np.ones(len(told))
    if before is not None and before.moved_mm is not None and before.scale is not None:
        moved, scale = before.moved_mm[looked], before.scale[looked]
    found = _settled(volumes, part, normals[looked], told, presence, others, moved, scale)
    thickness, there = found.thickness_mm, found.thickness_mm > 0

    def whole(values: Floats, elsewhere: float) -> Floats:
        out = np.full(len(looked), elsewhere)
        out[looked] = values
        return out

    outward = whole(found.moved_mm, 0.0)
    inner = Surface(vertices_mm=bone.vertices_mm + outward[:, None] * normals, faces=bone.faces)
    return CartilageSheet(
        bone=inner, normals=normals, moved_mm=outward, scale=whole(found.scale, 1.0),
        thickness_mm=whole(thickness, 0.0),
        thickness_sd_mm=whole(found.thickness_sd_mm, np.nan), confidence=whole(found.confidence, 1.0),
        foretold_mm=whole(np.where(there, found.foretold_mm, 0.0), 0.0),
        by_image=whole(np.where(there, found.by_image, np.nan), np.nan),
        blur_mm=whole(np.where(there, found.blur_mm, np.nan), np.nan),
    )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class _Settled:
    """As in `CartilageSheet`, at the vertices that were looked at."""

    thickness_mm: Floats
    thickness_sd_mm: Floats
    confidence: Floats
    foretold_mm: Floats
    by_image: Floats
    moved_mm: Floats
    blur_mm: Floats
    scale: Floats


def _settled(
    volumes: Sequence[Volume], part: Surface, normals: Floats, told: Floats, presence: Floats,
    others: Sequence[tuple[Surface, Floats]], moved: Floats, scale: Floats,
) -> _Settled:  # fmt: skip
    """Return the answers when they, the inner surface, and the foretold thickness, scaled to the person's, agree."""
    graph, across = MeshGraph.of(part), contact_with(part.vertices_mm, normals, others)
    scaled: Floats = np.clip(scale * told, THINNEST_MM, THICKEST_MM)
    estimate, present, blurred = scaled, presence > _TOLD, [1.0] * len(volumes)
    for turn in range(_ROUNDS):
        places, contact = part.vertices_mm + moved[:, None] * normals, across.from_above(moved)
        profiles = [read_profiles(each, places, normals, blur) for each, blur in zip(volumes, blurred, strict=True)]
        known = [tissues(each, estimate, present, contact.theirs, graph) for each in profiles]
        prior = contact.costs(LEVELS_MM) + _prior_costs(scaled, presence)
        costs = prior.copy()
        for each, seen in zip(profiles, known, strict=True):
            costs += layer_costs(each, seen, contact.begins_mm, contact.begins_sd_mm, contact.ends_mm)
        beliefs = _in_one_piece(graph.choose(costs, LEVELS_MM, SLOPE_SD, RIM_COST), part, graph)
        thickness, sd, confidence = _answers(beliefs, costs)
        # Where two cartilages may touch, the template itself has placed the edge: it tells nothing of the person. Nor
        # is it asked whether the answer touches alone: those too thin by chance would be left, and thin all the others.
        touching = contact.reached(np.maximum(thickness, scaled))
        sure = (thickness > 0) & (np.nan_to_num(sd) < _SURE_MM) & (confidence > 0.6) & ~touching
        scaled = _scaled(told, thickness, sure & _within(thickness > 0, presence, graph), graph)
        estimate, present = np.where(thickness > 0, thickness, scaled), thickness > 0
        if turn + 1 == _ROUNDS:
            break
        looked = present | (presence > _SOME)
        told_by = [
            inner_costs(each, seen, thickness, looked, moved) for each, seen in zip(profiles, known, strict=True)
        ]
        dark = any(np.median(seen.marrow) < 1 for seen in known)
        inner = inner_edge(np.sum(told_by, axis=0), graph, "dark" if dark else "bright")
        moved = np.asarray(inner.offset_mm)
        more = [measured_blur(*both, thickness, sure) for both in zip(profiles, known, strict=True)]
        blurred = [blur * each for blur, each in zip(blurred, more, strict=True)]
    by_image = 1 - (_spread(costs) ** 2 + MODEL_SD_MM**2) / _spread(prior) ** 2
    return _Settled(
        thickness_mm=thickness, thickness_sd_mm=np.hypot(sd, inner.sd_mm), confidence=confidence, foretold_mm=scaled,
        by_image=by_image, moved_mm=moved, blur_mm=np.min([each.blur_mm for each in profiles], axis=0),
        scale=scaled / told,
    )  # fmt: skip


def _within(present: Mask, presence: Floats, graph: MeshGraph) -> Mask:
    """(V,) true where both the template and the person have cartilage, and no rim of it is near.

    At its rim cartilage is thin wherever the rim lies: that tells nothing of how thick it is elsewhere.
    """
    return (presence > _TOLD) & (graph.smoothed(present.astype(float), RIM_MM) > _COVERED)


def _spread(costs: Floats) -> Floats:
    """Return the standard deviation (V,) of the thickness where it is not 0, by what each costs (V, L)."""
    there, levels = costs[:, 1:], LEVELS_MM[1:]
    chance = np.exp(there.min(1, keepdims=True) - there)
    chance /= chance.sum(1, keepdims=True)
    mean = chance @ levels
    return np.sqrt((chance * (levels - mean[:, None]) ** 2).sum(1) + (STEP_MM**2) / 12)


def _scaled(told: Floats, thickness: Floats, sure: Mask, graph: MeshGraph) -> Floats:
    """Scale the foretold thickness (V,) to the person's, by the ratios seen nearby, or else by that of the whole."""
    if not sure.any():
        return told
    ratio = np.log(np.where(sure, thickness, 1.0) / np.where(sure, told, 1.0))
    usual = float(np.median(ratio[sure]))
    weight = sure.astype(float)
    more, near = graph.smoothed(np.stack([weight * (ratio - usual), weight], 1), REGION_MM).T
    return np.clip(told * np.exp(usual + more / (near + _FEW)), THINNEST_MM, THICKEST_MM)


def _steady_normals(bone: Surface) -> Floats:
    smooth = MeshGraph.of(bone).smoothed(bone.vertex_normals, NORMALS_MM)
    return smooth / np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-12)


def _part(bone: Surface, kept: Mask) -> Surface:
    """Return the faces all of whose corners are kept, on just these vertices."""
    number: Integers = np.cumsum(kept) - 1
    return Surface(vertices_mm=bone.vertices_mm[kept], faces=number[bone.faces[kept[bone.faces].all(1)]])


def _prior_costs(told: Floats, presence: Floats) -> Floats:
    """Return what each thickness costs (V, L) by the template: minus the logarithm of its probability."""
    there = np.clip(presence, LEAST_PRESENCE, 1 - LEAST_PRESENCE)[:, None]
    sd = TOLD_SHARE * told[:, None]
    off = (LEVELS_MM[None] - told[:, None]) / sd
    costs = 0.5 * off**2 - np.log(there) + np.log(np.sqrt(2 * np.pi) * sd / STEP_MM)
    costs[:, :1] = -np.log(1 - there)
    return np.asarray(costs)


def _in_one_piece(beliefs: Floats, part: Surface, graph: MeshGraph) -> Floats:
    """Return the costs (V, L) such that specks are bare and pinholes covered, by a hair: nobody is sure there."""
    beliefs = beliefs.copy()
    bare = np.argmin(beliefs, axis=1) == 0
    speck = _small(~bare, SPECK_MM2, part, graph)
    beliefs[speck, 0] = beliefs[speck].min(1) - _HAIR
    hole = _small(bare, HOLE_MM2, part, graph)
    beliefs[hole, 1:] += (beliefs[hole, 0] - beliefs[hole, 1:].min(1) - _HAIR)[:, None]
    return beliefs


def _small(mask: Mask, least_mm2: float, part: Surface, graph: MeshGraph) -> Mask:
    """(V,) true in those pieces of a mask that are smaller than so much."""
    piece = graph.pieces(mask)
    areas = np.bincount(piece[mask], part.vertex_areas_mm2[mask])
    small: Mask = mask.copy()
    small[mask] = areas[piece[mask]] < least_mm2
    return small


def _answers(beliefs: Floats, costs: Floats) -> tuple[Floats, Floats, Floats]:
    """Give thickness, standard deviation and confidence (V,) from the sheet's costs (V, L) and each vertex's own.

    The deviation is by the vertex's own costs: neighbours are wrong together, so that their agreement proves little.
    """
    best = np.argmin(beliefs, axis=1)
    bare = best == 0
    # Between the levels the costs are a parabola.
    rows, middle = np.arange(len(beliefs)), np.clip(best, 2, len(LEVELS_MM) - 2)
    before, least, after = (beliefs[rows, middle + step] for step in (-1, 0, 1))
    beside = np.clip(0.5 * (before - after) / np.maximum(before - 2 * least + after, 1e-6), -0.5, 0.5)
    thickness = np.where(best == middle, LEVELS_MM[middle] + beside * STEP_MM, LEVELS_MM[best])
    off = LEVELS_MM[None] - thickness[:, None]
    own = np.where((np.abs(off) < NEAR_MM) & (LEVELS_MM > 0), costs, np.inf)
    chance = np.exp(own.min(1, keepdims=True) - own)
    sd = np.sqrt((chance * off**2).sum(1) / chance.sum(1) + MODEL_SD_MM**2)
    bareness = np.exp(beliefs.min(1) - beliefs[:, 0]) / np.exp(beliefs.min(1, keepdims=True) - beliefs).sum(1)
    confidence = np.where(bare, bareness, (1 - bareness) * erf(0.5 / (np.sqrt(2) * sd)))
    return np.where(bare, 0.0, thickness), np.where(bare, np.nan, sd), confidence

"""The outer surface of cartilage, found along the bone's normals ([Alexander2003] section 2.1).

From each vertex of the bone the image is read along the normal. The image's evidence for each thickness is weighted
by a Gaussian about the predicted thickness, whose standard deviation is a third of it.

Unlike the paper, the normal is the subject's own, smoothed: the mapped normal of the template differs from it by 12
degrees in the median. Where the paper takes the strongest edge of the weighted gradient, a layer between two blurred
edges is fitted to the whole profile, because the maxima of the gradient of a thin layer lie too far apart. The
thicknesses are chosen together, as one sheet whose thickness changes slowly. And the prediction is scaled, region by
region, to the subject's cartilage wherever the image shows its edge, so that the Gaussian lies where that subject's
cartilage should end and does not bias the result towards the template's thickness.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import erf

from marey.arrays import Floats, Integers, Mask, freeze_fields
from marey.errors import MareyError
from marey.geometry.vectors import unit_or_zero
from marey.knee.cartilage.contact import Contact, contact_with
from marey.knee.cartilage.evidence import (
    EVIDENCE_DEFAULTS,
    LEVELS_MM,
    STEP_MM,
    THICKEST_MM,
    THINNEST_MM,
    EvidenceSettings,
    Profiles,
    Tissues,
    layer_costs,
    measured_blur,
    read_profiles,
    tissues,
)
from marey.knee.cartilage.inner_surface import (
    INNER_SURFACE_DEFAULTS,
    InnerEdge,
    InnerSurfaceSettings,
    inner_costs,
    inner_edge,
)
from marey.knee.cartilage.prediction import PREDICTED_SD_SHARE, RIM_MM, CartilagePrediction
from marey.knee.space.mesh_graph import MeshGraph
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.volume import Volume


@dataclass(frozen=True, kw_only=True)
class OuterSurfaceSettings:
    """Settings for finding the outer surface of cartilage.

    Values without a stated source were chosen by hand.
    """

    evidence: EvidenceSettings = EVIDENCE_DEFAULTS
    inner_surface: InnerSurfaceSettings = INNER_SURFACE_DEFAULTS
    slope_sd: float = 0.4
    """Standard deviation [mm/mm] of the slope of the thickness over the bone."""
    least_presence: float = 0.02
    """Least probability, by the template, of cartilage and of bare bone at any vertex."""
    rim_cost: float = 3.0
    """Largest cost of a rim at each edge of the mesh that crosses it."""
    normals_mm: float = 1.0
    """Standard deviation [mm] of the smoothing of the normals, which should not follow the bone's roughness."""
    region_mm: float = 8.0
    """Standard deviation [mm] of the regions over which the ratio of the subject's thickness to the template's is
    averaged."""
    near_mm: float = 2.5
    """Largest difference [mm] from the result of thicknesses that enter its standard deviation."""
    model_sd_mm: float = 0.15
    """Standard deviation [mm] of the thickness due to errors of the model of a profile, of the bone's surface and
    of its normal."""
    ratio_floor: float = 0.02
    """Share of vertices nearby with a known edge at which the local ratio and that of the whole cartilage have
    equal weight."""
    sure_mm: float = 0.5
    """Largest standard deviation [mm] of a thickness that enters the ratio."""
    visible_edge: float = 2.0
    """Least difference of the costs of touching another cartilage and of none from which the edge counts as
    visible."""
    shared_weight: float = 0.25
    """Weight of a ratio that comes from the sum of two touching cartilages, relative to that of a visible edge."""
    speck_mm2: float = 40.0
    """Smaller pieces [mm2] of cartilage are removed."""
    hole_mm2: float = 6.0
    """Smaller holes [mm2] in cartilage are filled."""
    rounds: int = 3
    """Number of rounds in which thickness, inner surface and prediction are updated."""
    hair: float = 1e-3
    """Difference of costs by which specks and holes are decided: their confidence is that of an undecided
    vertex."""
    likely: float = 0.8
    """Probability from which the template has cartilage."""
    possible: float = 0.5
    """Probability by the template from which the inner edge is searched even where no cartilage was found."""
    covered: float = 0.84
    """Value of a mask smoothed by the rim's standard deviation at that distance inside its rim."""


_LEAST_LENGTH = 0.6
"""Least length of a mean of unit normals that counts: their spread is then one radian. Chosen by hand."""
OUTER_SURFACE_DEFAULTS = OuterSurfaceSettings()
"""Default settings for finding the outer surface of cartilage."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CartilageSheet:
    """The cartilage on one bone, at each of the bone's vertices."""

    bone: TriangleSurface
    """The bone, with its vertices moved to where the cartilage begins."""
    normals: Floats
    """(V, 3) normals along which the cartilage was searched."""
    thickness_mm: Floats
    """(V,) 0 where the bone is bare."""
    thickness_sd_mm: Floats
    """(V,) standard deviation by the costs of other thicknesses; NaN where the bone is bare."""
    confidence: Floats
    """(V,) probability, from 0 to 1, that the result is right: bare, or within half a millimetre."""
    predicted_mm: Floats | None = None
    """(V,) the template's thickness after scaling to the subject's, 0 where the bone is bare."""
    by_image: Floats | None = None
    """(V,) share of the information on the thickness that comes from the image, not the template: 1 minus the ratio of
    the variances with and without the image; NaN where the bone is bare."""
    scale: Floats | None = None
    """(V,) predicted ratio of the subject's thickness to the template's."""
    moved_mm: Floats | None = None
    """(V,) distance of `bone` outward of the given surface."""
    blur_mm: Floats | None = None
    """(V,) standard deviation of an edge's blur along the normal, in the sharpest image; NaN where the bone is bare."""
    shared_mm: Floats | None = None
    """(V,) distance to the other bone where its cartilage touches this one without a visible edge: the sum of both
    thicknesses, which is known better than each; NaN elsewhere."""

    def __post_init__(self) -> None:
        freeze_fields(self, "normals", "thickness_mm", "thickness_sd_mm", "confidence")
        freeze_fields(self, "predicted_mm", "by_image", "scale", "moved_mm", "blur_mm", "shared_mm")

    @property
    def outer(self) -> TriangleSurface:
        """Closed surface of the cartilage: the covered bone, the outer sheet, and walls at the rim.

        Raises:
            MareyError: There is no cartilage.
        """
        used, faces = self._closed()
        sheet = self.bone.vertices_mm + self.thickness_mm[:, None] * self.normals
        return TriangleSurface(vertices_mm=np.concatenate([self.bone.vertices_mm, sheet])[used], faces=faces)

    @property
    def outer_thickness_mm(self) -> Floats:
        """Return the thickness at each vertex of `outer`.

        Raises:
            MareyError: There is no cartilage.
        """
        return self.thickness_mm[self._closed()[0] % len(self.thickness_mm)]

    def _closed(self) -> tuple[Integers, Integers]:
        """Return the vertices of `outer`, as indices into those of the bone and then the outer sheet, and its faces."""
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
    volumes: Sequence[Volume],
    bone: TriangleSurface,
    prediction: CartilagePrediction,
    others: Sequence[tuple[TriangleSurface, Floats]] = (),
    before: CartilageSheet | None = None,
    *,
    settings: OuterSurfaceSettings = OUTER_SURFACE_DEFAULTS,
) -> CartilageSheet:
    """Find the cartilage on a bone.

    Args:
        volumes: One image or several in the same place, of any contrasts in which cartilage differs from what lies
            over it. The evidence of several images is added.
        bone: Approximate inner surface of the cartilage.
        prediction: Prediction by the template.
        others: The other bones, and the predicted thickness of the cartilage at the vertices of each, 0 where bare:
            where two cartilages touch, the space between the bones is shared.
        before: An earlier result on this bone, from which to continue.
        settings: Tuned constants of the algorithm.

    Raises:
        MareyError: The template predicts no cartilage on this bone.
    """
    looked = np.isfinite(prediction.thickness_mm)
    if np.count_nonzero(looked & (prediction.presence > settings.likely)) < 20:
        raise MareyError("The template predicts no cartilage on this bone: check that it fits.")
    normals = _steady_normals(bone, settings=settings)
    part, predicted, presence = _part(bone, looked), prediction.thickness_mm[looked], prediction.presence[looked]
    moved: Floats = np.zeros(len(predicted))
    scale: Floats = np.ones(len(predicted))
    if before is not None and before.moved_mm is not None and before.scale is not None:
        moved, scale = before.moved_mm[looked], before.scale[looked]
    found = _iterated(volumes, part, normals[looked], predicted, presence, others, moved, scale, settings=settings)
    thickness, there = found.thickness_mm, found.thickness_mm > 0

    def whole(values: Floats, elsewhere: float) -> Floats:
        out = np.full(len(looked), elsewhere)
        out[looked] = values
        return out

    outward = whole(found.moved_mm, 0.0)
    slanted = _sd_of_direction(bone, whole(thickness, 0.0), settings=settings)
    inner = TriangleSurface(vertices_mm=bone.vertices_mm + outward[:, None] * normals, faces=bone.faces)
    return CartilageSheet(
        bone=inner, normals=normals, moved_mm=outward, scale=whole(found.scale, 1.0),
        thickness_mm=whole(thickness, 0.0),
        thickness_sd_mm=np.hypot(whole(found.thickness_sd_mm, np.nan), slanted),
        confidence=whole(found.confidence, 1.0),
        predicted_mm=whole(np.where(there, found.predicted_mm, 0.0), 0.0),
        by_image=whole(np.where(there, found.by_image, np.nan), np.nan),
        blur_mm=whole(np.where(there, found.blur_mm, np.nan), np.nan),
        shared_mm=whole(np.where(there, found.shared_mm, np.nan), np.nan),
    )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class _SheetValues:
    """Fields of `CartilageSheet`, at the vertices at which cartilage is searched."""

    thickness_mm: Floats
    thickness_sd_mm: Floats
    confidence: Floats
    predicted_mm: Floats
    by_image: Floats
    moved_mm: Floats
    blur_mm: Floats
    scale: Floats
    shared_mm: Floats


def _iterated(
    volumes: Sequence[Volume], part: TriangleSurface, normals: Floats, predicted: Floats, presence: Floats,
    others: Sequence[tuple[TriangleSurface, Floats]], moved: Floats, scale: Floats, *, settings: OuterSurfaceSettings
) -> _SheetValues:  # fmt: skip
    """Alternate between thickness, inner surface, and the scaling of the prediction to the subject."""
    graph, across = MeshGraph.of(part), contact_with(part.vertices_mm, normals, others)
    scaled: Floats = np.clip(scale * predicted, THINNEST_MM, THICKEST_MM)
    estimate, present, blurred = scaled, presence > settings.likely, [1.0] * len(volumes)
    for turn in range(settings.rounds):
        places, contact = part.vertices_mm + moved[:, None] * normals, across.from_above(moved)
        profiles = [
            read_profiles(each, places, normals, blur, settings=settings.evidence)
            for each, blur in zip(volumes, blurred, strict=True)
        ]
        known = [
            tissues(each, estimate, present, contact.theirs, graph, settings=settings.evidence) for each in profiles
        ]
        prior = contact.costs(LEVELS_MM) + _prior_costs(scaled, presence, settings=settings)
        apart, touching = _layers(profiles, known, contact)
        costs = prior + np.minimum(apart, touching)
        # Where two cartilages may touch, the edge comes from the template and is no evidence of the subject's own.
        edge = (prior + touching).min(1) - (prior + apart).min(1)
        beliefs = _without_specks(
            graph.choose(costs, LEVELS_MM, settings.slope_sd, settings.rim_cost), part, graph, settings=settings
        )
        thickness, sd, confidence = _answers(beliefs, costs, settings=settings)
        sure = (thickness > 0) & (np.nan_to_num(sd) < settings.sure_mm) & (confidence > 0.6)
        sure &= edge > settings.visible_edge
        inside = _within(thickness > 0, presence, graph, settings=settings)
        divided = np.where((thickness > 0) & (edge < 0), contact.divided_mm(scaled), np.nan)
        scaled = _scaled(predicted, np.where(sure, thickness, np.nan), divided, inside, graph, settings=settings)
        estimate, present = np.where(thickness > 0, thickness, scaled), thickness > 0
        if turn + 1 == settings.rounds:
            break
        looked = present | (presence > settings.possible)
        inner = _inner(profiles, known, thickness, looked, moved, graph, settings=settings)
        moved = np.asarray(inner.offset_mm)
        more = [
            measured_blur(*both, thickness, sure, settings=settings.evidence)
            for both in zip(profiles, known, strict=True)
        ]
        blurred = [blur * each for blur, each in zip(blurred, more, strict=True)]
    by_image = 1 - (_spread(costs) ** 2 + settings.model_sd_mm**2) / _spread(prior) ** 2
    return _SheetValues(
        thickness_mm=thickness, thickness_sd_mm=np.hypot(sd, inner.sd_mm), confidence=confidence, predicted_mm=scaled,
        by_image=by_image, moved_mm=moved, blur_mm=np.min([each.blur_mm for each in profiles], axis=0),
        scale=scaled / predicted, shared_mm=np.where(edge < settings.visible_edge, contact.away_mm, np.nan),
    )  # fmt: skip


def _layers(profiles: Sequence[Profiles], known: Sequence[Tissues], contact: Contact) -> tuple[Floats, Floats]:
    """Return the costs (V, L) of all images, apart from another cartilage and touching it."""
    layers = [
        layer_costs(each, seen, contact.begins_mm, contact.begins_sd_mm, contact.ends_mm)
        for each, seen in zip(profiles, known, strict=True)
    ]
    return np.sum([each.apart for each in layers], axis=0), np.sum([each.touching for each in layers], axis=0)


def _inner(
    profiles: Sequence[Profiles], known: Sequence[Tissues], thickness: Floats, looked: Mask, moved: Floats,
    graph: MeshGraph, *, settings: OuterSurfaceSettings
) -> InnerEdge:  # fmt: skip
    """Return where the cartilage begins by all images, relative to the given bone."""
    evidence = [
        inner_costs(each, seen, thickness, looked, moved, settings=settings.inner_surface)
        for each, seen in zip(profiles, known, strict=True)
    ]
    dark = any(np.median(seen.marrow) < 1 for seen in known)
    return inner_edge(np.sum(evidence, axis=0), graph, "dark" if dark else "bright", settings=settings.inner_surface)


def _sd_of_direction(bone: TriangleSurface, thickness: Floats, *, settings: OuterSurfaceSettings) -> Floats:
    """Return the standard deviation (V,) of the thickness because the direction across the cartilage is uncertain.

    The lines along the normals within the width of their smoothing end at different places of the outer surface,
    between which the thickness changes by its slope. The spread of these normals follows from the length of their mean.
    """
    graph = MeshGraph.of(bone)
    length = np.linalg.norm(graph.smoothed(bone.vertex_normals, settings.normals_mm), axis=1)
    spread = np.sqrt(-2 * np.log(np.clip(length, _LEAST_LENGTH, 1.0)))
    return np.asarray(thickness * spread * graph.slopes(thickness, thickness > 0))


def _within(present: Mask, presence: Floats, graph: MeshGraph, *, settings: OuterSurfaceSettings) -> Mask:
    """(V,) true where both the template and the subject have cartilage, far from its rim.

    At its rim cartilage is always thin, which is no evidence of its thickness elsewhere.
    """
    return (presence > settings.likely) & (graph.smoothed(present.astype(float), RIM_MM) > settings.covered)


def _spread(costs: Floats) -> Floats:
    """Return the standard deviation (V,) of the thickness where it is not 0, by the costs (V, L)."""
    there, levels = costs[:, 1:], LEVELS_MM[1:]
    chance = np.exp(there.min(1, keepdims=True) - there)
    chance /= chance.sum(1, keepdims=True)
    mean = chance @ levels
    return np.asarray(np.sqrt((chance * (levels - mean[:, None]) ** 2).sum(1) + (STEP_MM**2) / 12))


def _scaled(
    predicted: Floats, measured: Floats, divided: Floats, inside: Mask, graph: MeshGraph, *,
    settings: OuterSurfaceSettings
) -> Floats:  # fmt: skip
    """Scale the predicted thickness (V,) to the subject's, by nearby ratios, or else by that of the whole cartilage.

    Args:
        predicted: (V,) thickness of the template.
        measured: (V,) thickness up to a visible edge; NaN elsewhere.
        divided: (V,) thickness where two touching cartilages divide a known sum; NaN elsewhere.
        inside: (V,) where both the template and the subject have cartilage, far from its rim.
        graph: Mesh graph of the bone.
        settings: Tuned constants of the algorithm.
    """
    sure = inside & np.isfinite(measured)
    if not sure.any():
        return predicted
    shared = inside & np.isfinite(divided) & ~sure
    weight = sure + settings.shared_weight * shared
    ratio = np.log(np.select([sure, shared], [measured, divided], predicted) / predicted)
    usual = float(np.median(ratio[sure]))
    more, near = graph.smoothed(np.stack([weight * (ratio - usual), weight], 1), settings.region_mm).T
    return np.asarray(
        np.clip(predicted * np.exp(usual + more / (near + settings.ratio_floor)), THINNEST_MM, THICKEST_MM)
    )


def _steady_normals(bone: TriangleSurface, *, settings: OuterSurfaceSettings) -> Floats:
    smooth = MeshGraph.of(bone).smoothed(bone.vertex_normals, settings.normals_mm)
    return unit_or_zero(smooth)


def _part(bone: TriangleSurface, kept: Mask) -> TriangleSurface:
    """Return the part of a surface whose vertices are kept."""
    number: Integers = np.cumsum(kept) - 1
    return TriangleSurface(vertices_mm=bone.vertices_mm[kept], faces=number[bone.faces[kept[bone.faces].all(1)]])


def _prior_costs(predicted: Floats, presence: Floats, *, settings: OuterSurfaceSettings) -> Floats:
    """Return the cost (V, L) of each thickness by the template: minus the logarithm of its probability."""
    there = np.clip(presence, settings.least_presence, 1 - settings.least_presence)[:, None]
    sd = PREDICTED_SD_SHARE * predicted[:, None]
    off = (LEVELS_MM[None] - predicted[:, None]) / sd
    costs = 0.5 * off**2 - np.log(there) + np.log(np.sqrt(2 * np.pi) * sd / STEP_MM)
    costs[:, :1] = -np.log(1 - there)
    return np.asarray(costs)


def _without_specks(
    beliefs: Floats, part: TriangleSurface, graph: MeshGraph, *, settings: OuterSurfaceSettings
) -> Floats:
    """Return the costs (V, L), changed so that specks are bare and small holes covered, with low confidence."""
    beliefs = beliefs.copy()
    bare = np.argmin(beliefs, axis=1) == 0
    speck = _small(~bare, settings.speck_mm2, part, graph)
    beliefs[speck, 0] = beliefs[speck].min(1) - settings.hair
    hole = _small(bare, settings.hole_mm2, part, graph)
    beliefs[hole, 1:] += (beliefs[hole, 0] - beliefs[hole, 1:].min(1) - settings.hair)[:, None]
    return beliefs


def _small(mask: Mask, least_mm2: float, part: TriangleSurface, graph: MeshGraph) -> Mask:
    """(V,) true in the pieces of a mask that are smaller than an area."""
    piece = graph.pieces(mask)
    areas = np.bincount(piece[mask], part.vertex_areas_mm2[mask])
    small: Mask = mask.copy()
    small[mask] = areas[piece[mask]] < least_mm2
    return small


def _answers(beliefs: Floats, costs: Floats, *, settings: OuterSurfaceSettings) -> tuple[Floats, Floats, Floats]:
    """Return thickness, standard deviation and confidence (V,) from the sheet's costs (V, L) and each vertex' own.

    The standard deviation is by the vertex' own costs, because the errors of neighbours are correlated.
    """
    best = np.argmin(beliefs, axis=1)
    bare = best == 0
    # The costs are interpolated by a parabola between the candidates.
    rows, middle = np.arange(len(beliefs)), np.clip(best, 2, len(LEVELS_MM) - 2)
    before, least, after = (beliefs[rows, middle + step] for step in (-1, 0, 1))
    beside = np.clip(0.5 * (before - after) / np.maximum(before - 2 * least + after, 1e-6), -0.5, 0.5)
    thickness = np.where(best == middle, LEVELS_MM[middle] + beside * STEP_MM, LEVELS_MM[best])
    off = LEVELS_MM[None] - thickness[:, None]
    own = np.where((np.abs(off) < settings.near_mm) & (LEVELS_MM > 0), costs, np.inf)
    chance = np.exp(own.min(1, keepdims=True) - own)
    sd = np.sqrt((chance * off**2).sum(1) / chance.sum(1) + settings.model_sd_mm**2)
    bareness = np.exp(beliefs.min(1) - beliefs[:, 0]) / np.exp(beliefs.min(1, keepdims=True) - beliefs).sum(1)
    confidence = np.where(bare, bareness, (1 - bareness) * erf(0.5 / (np.sqrt(2) * sd)))
    return np.where(bare, 0.0, thickness), np.where(bare, np.nan, sd), confidence

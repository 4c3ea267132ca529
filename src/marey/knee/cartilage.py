"""The outer surface of cartilage, found along the bone's normals ([Alexander2003] section 2.1).

From each vertex of the bone the image is read along the template's normal, carried along by the deformation. A Gaussian
about the foretold thickness, a third of it wide, weighs the edges of the profile as in Canny's detector. Unlike the
paper, what lies between the bone and the edge has to look like cartilage, too, by the image's own grey values under and
over the foretold surface; and the edges are not taken one by one but as one sheet, whose thickness changes slowly.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from marey.arrays import Floats, Mask, frozen
from marey.errors import MareyError
from marey.knee.cartilage_prediction import CartilagePrediction
from marey.knee.mesh_graph import MeshGraph
from marey.knee.surface import Surface
from marey.knee.triangle_tree import TriangleTree
from marey.knee.volume import Volume

STEP_MM = 0.2
THINNEST_MM, THICKEST_MM = 0.4, 7.0
_LEVELS = np.concatenate([[0.0], np.arange(THINNEST_MM, THICKEST_MM + 1e-9, STEP_MM)])
_DEPTHS = np.arange(-1.0, THICKEST_MM + 4.0, STEP_MM)
EDGE_SD_MM = 0.4
"""Width of the smoothing along the normal before the slope is taken."""
TOLD_SHARE = 1 / 3
"""Standard deviation of the foretold thickness, as a share of it."""
CORRELATED_MM = 0.5
"""Grey values nearer than this along a profile tell the same."""
CLEAREST = 2.0
"""No single grey value says more than exp(2) to one."""
SLOPE_SD = 0.4
"""How fast the thickness changes over the bone [mm/mm]."""
RIM_COST = 3.0
"""What a rim costs at most, at each edge of the mesh that crosses it."""
BIAS_MM = 12.0
"""Over such a way the brightness of cartilage may change."""
_ROUNDS = 3
_NEVER = 1e3


@dataclass(frozen=True, eq=False, kw_only=True)
class CartilageSheet:
    """The cartilage on one bone, at each of the bone's vertices."""

    bone: Surface
    normals: Floats
    """(V, 3) along which it was looked for."""
    thickness_mm: Floats
    """(V,) 0 where the bone is bare."""
    thickness_sd_mm: Floats
    """(V,) by the costs of other thicknesses; NaN where the bone is bare."""
    confidence: Floats
    """(V,) how probable the answer is, bare or within half a millimetre, from 0 to 1."""

    def __post_init__(self) -> None:
        for name in ("normals", "thickness_mm", "thickness_sd_mm", "confidence"):
            object.__setattr__(self, name, frozen(getattr(self, name)))

    @property
    def outer(self) -> Surface:
        """The closed surface of the cartilage: the bone where it is covered, the outer sheet, and walls at the rim.

        Raises:
            MareyError: There is no cartilage.
        """
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
        sheet = self.bone.vertices_mm + self.thickness_mm[:, None] * self.normals
        vertices = np.concatenate([self.bone.vertices_mm, sheet])
        every = np.concatenate([faces[:, ::-1], faces + total, walls])
        used, renumbered = np.unique(every, return_inverse=True)
        return Surface(vertices_mm=vertices[used], faces=renumbered.reshape(-1, 3))


def find_cartilage(
    volumes: Sequence[Volume], bone: Surface, prediction: CartilagePrediction,
    others: Sequence[tuple[Surface, Floats]] = (),
) -> CartilageSheet:  # fmt: skip
    """Find the cartilage on a bone.

    Args:
        volumes: One image or several in the same place, of any contrasts in which cartilage differs from what lies
            over it. What several say is added up.
        bone: The inner surface of the cartilage.
        prediction: From the template.
        others: The other bones, and how thick the cartilage on each is foretold to be at its vertices, 0 where bare:
            where two cartilages touch, the space between the bones is shared.

    Raises:
        MareyError: The template foretells no cartilage on this bone.
    """
    looked = np.isfinite(prediction.thickness_mm) & (prediction.presence > 1e-3)
    if np.count_nonzero(looked & (prediction.presence > 0.8)) < 20:
        raise MareyError("The template foretells no cartilage on this bone: does it fit?")
    graph = MeshGraph.of(bone)
    told = np.where(looked, prediction.thickness_mm, THINNEST_MM)
    profiles = [_profiles(volume, bone, prediction.normals) for volume in volumes]
    estimate, present = told, prediction.presence > 0.8
    for _ in range(_ROUNDS):
        share = _shared_space(bone, prediction, estimate, others)
        costs = _prior_costs(told, prediction.presence)
        for part in profiles:
            relative = part / _brightness(part, estimate, present, graph)[:, None]
            costs += _image_costs(relative, _likeness(relative, estimate, present, share), share)
        costs[~looked, 1:] = _NEVER
        beliefs = graph.choose(costs, _LEVELS, SLOPE_SD, RIM_COST)
        thickness, sd, confidence = _answers(beliefs)
        # A subject's cartilage may be thicker or thinner than the template's as a whole.
        sure = (thickness > 0) & (confidence > 0.5)
        told = told * (float(np.median(thickness[sure] / told[sure])) if sure.any() else 1.0)
        estimate, present = np.where(thickness > 0, thickness, told), thickness > 0
    return CartilageSheet(
        bone=bone, normals=prediction.normals, thickness_mm=thickness, thickness_sd_mm=sd, confidence=confidence
    )


def _profiles(volume: Volume, bone: Surface, normals: Floats) -> Floats:
    """Read the image (V, D) along the normals, at `_DEPTHS`."""
    places = bone.vertices_mm[:, None] + _DEPTHS[:, None] * normals[:, None]
    voxels = volume.grid.voxels(places)[..., ::-1]
    return ndimage.map_coordinates(volume.intensity, np.moveaxis(voxels, -1, 0), order=1, mode="nearest", output=float)


def _shared_space(
    bone: Surface, prediction: CartilagePrediction, told: Floats, others: Sequence[tuple[Surface, Floats]]
) -> Floats:
    """Give how far out (V,) the space is this bone's cartilage's: up to where another one's is foretold to begin."""
    share = np.full(len(told), np.inf)
    for other, thickness in others:
        crossed = TriangleTree.of(other).crossings(bone.vertices_mm, prediction.normals, 2 * THICKEST_MM)
        away = crossed.distance_mm[:, 0]
        meets = np.isfinite(away)
        if not meets.any():
            continue
        places = bone.vertices_mm[meets] + away[meets, None] * prediction.normals[meets]
        near = TriangleTree.of(other).nearest(places)
        theirs = thickness[other.faces[near.face]].max(1)
        own = told[meets]
        # Space that is left over belongs to neither.
        free = np.maximum(away[meets] - own - theirs, 0.0)
        limit = (away[meets] - free) * own / np.maximum(own + theirs, 1e-9) + 0.5 * free
        share[meets] = np.minimum(share[meets], np.where(theirs > 0, limit, away[meets]))
    return share


def _brightness(profiles: Floats, thickness: Floats, present: Mask, graph: MeshGraph) -> Floats:
    """Give the brightness (V,) of cartilage about each vertex, from the middle of the layer."""
    column = np.clip(np.round((0.5 * thickness - _DEPTHS[0]) / STEP_MM).astype(int), 0, len(_DEPTHS) - 1)
    middle = profiles[np.arange(len(profiles)), column]
    sure = present & (thickness > 1.2)
    usual = float(np.median(middle[sure if sure.any() else present]))
    spread = 1.4826 * float(np.median(np.abs(middle[sure if sure.any() else present] - usual)))
    weights = (sure & (np.abs(middle - usual) < max(3 * spread, 0.2 * abs(usual)))).astype(float)
    about = graph.filled(middle, weights, BIAS_MM)
    return np.maximum(np.where(np.isfinite(about), about, usual), 1e-3 * max(abs(usual), 1e-6))


_BINS = np.arange(0.0, 3.0001, 0.04)


def _likeness(relative: Floats, thickness: Floats, present: Mask, share: Floats) -> Floats:
    """Give the logarithm (V, D) of how much likelier each grey value is in cartilage than over it."""
    depth = _DEPTHS[None] / thickness[:, None]
    over = _DEPTHS[None] - thickness[:, None]
    within = present[:, None] & (depth > 0.25) & (depth < 0.75)
    outside = present[:, None] & (over > 0.8) & (over < 4.0) & (_DEPTHS[None] < share[:, None])
    known = [_density(relative[where]) for where in (within, outside)]
    ratio = np.log(known[0] / known[1])
    middles = 0.5 * (_BINS[1:] + _BINS[:-1])
    return np.clip(np.interp(relative, middles, ratio), -CLEAREST, CLEAREST)


def _density(values: Floats) -> Floats:
    """Give a smooth histogram with a floor: nothing is impossible."""
    counts = np.histogram(np.clip(values, _BINS[0], _BINS[-1] - 1e-9), _BINS)[0].astype(float)
    smooth = ndimage.gaussian_filter1d(counts, 1.5, mode="nearest")
    return np.asarray(smooth / max(smooth.sum(), 1.0) + 0.02 / len(counts))


def _prior_costs(told: Floats, presence: Floats) -> Floats:
    """Give what each thickness of `_LEVELS` costs (V, L) by the template: minus the logarithm of its probability."""
    there = np.clip(presence, 0.02, 0.98)[:, None]
    off = (_LEVELS[None] - told[:, None]) / (TOLD_SHARE * told[:, None])
    costs = 0.5 * off**2 - np.log(there)
    costs[:, :1] = -np.log(1 - there)
    return np.asarray(costs)


def _image_costs(relative: Floats, likeness: Floats, share: Floats) -> Floats:
    """Give what each thickness costs (V, L) by an image: edges as in Canny's detector, and grey values below them."""
    # Beyond the shared space lies the other bone's cartilage; the first of the way is dimmed by the bone.
    below = np.where(_DEPTHS[None] < share[:, None], likeness, np.minimum(likeness, 0.0) - 1.0)
    gained = np.cumsum(np.where(_DEPTHS[None] < 0.3, 0.0, below), axis=1) * STEP_MM / CORRELATED_MM
    slopes = np.abs(ndimage.gaussian_filter1d(relative, EDGE_SD_MM / STEP_MM, axis=1, order=1) / STEP_MM)
    columns = np.round((_LEVELS - _DEPTHS[0]) / STEP_MM).astype(int)
    costs = -gained[:, columns] - np.log(0.1 + slopes[:, columns])
    # A bare bone has no edge there, and none is missed.
    costs[:, 0] = -np.log(0.1 + np.median(slopes, axis=1))
    return np.asarray(costs)


def _answers(beliefs: Floats) -> tuple[Floats, Floats, Floats]:
    """Give thickness, standard deviation and confidence (V,) from the costs (V, L)."""
    chance = np.exp(-beliefs)
    chance /= chance.sum(1, keepdims=True)
    best = np.argmin(beliefs, axis=1)
    bare = best == 0
    near = (np.abs(_LEVELS[None] - _LEVELS[best][:, None]) < 0.5 + 1e-9) & (_LEVELS[None] > 0)
    weights = np.where(near, chance, 0.0)
    weights /= np.maximum(weights.sum(1, keepdims=True), 1e-300)
    mean = weights @ _LEVELS
    there = np.where(_LEVELS > 0, chance, 0.0)
    there /= np.maximum(there.sum(1, keepdims=True), 1e-300)
    sd = np.sqrt(np.maximum(there @ _LEVELS**2 - (there @ _LEVELS) ** 2, 0.0))
    confidence = np.where(bare, chance[:, 0], np.where(near, chance, 0.0).sum(1))
    return np.where(bare, 0.0, mean), np.where(bare, np.nan, sd), confidence

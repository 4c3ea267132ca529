"""Evidence of an image for the thickness of cartilage along each normal: a layer between two blurred edges, or none."""

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.special import ndtr

from marey.arrays import Floats, Mask
from marey.compiled.kernels import kernel
from marey.knee.cartilage.joint_space import EDGE_SLOPES, joint_space_costs
from marey.knee.space.mesh_graph import MeshGraph
from marey.knee.space.volume import Volume

STEP_MM = 0.2
"""Spacing [mm] of the candidate thicknesses, and of the samples of a profile; chosen by hand."""
THINNEST_MM, THICKEST_MM = 0.4, 7.0
"""Least and largest candidate thickness [mm] of cartilage; chosen by hand."""
LEVELS_MM = np.concatenate([[0.0], np.arange(THINNEST_MM, THICKEST_MM + 1e-9, STEP_MM)])
"""(L,) the candidate thicknesses [mm]; 0 is bare bone."""
DEPTHS_MM = np.arange(-3.0, THICKEST_MM + 4.0, STEP_MM)
"""(D,) where along a normal the image is read [mm]; 0 is the bone's surface."""
FIRST_MM = -0.6
"""Depth [mm] from which the grey values enter the costs; chosen by hand."""
STRAY = 0.03
"""Share of outliers among the grey values; chosen by hand."""
OVER_MM = 0.6
"""Length [mm] of the profile beyond the outer edge where the tissue over the cartilage is measured; chosen by hand."""


@dataclass(frozen=True, kw_only=True)
class EvidenceSettings:
    """Settings for the evidence of an image for the thickness of cartilage.

    Values without a stated source were chosen by hand.
    """

    edge_sd_mm: float = 0.3
    """Standard deviation [mm] of an edge's blur in addition to that of the voxels: surfaces are curved and
    rough."""
    correlated_mm: float = 0.5
    """Least distance [mm] between independent grey values along a profile; the extent of a voxel if it is
    larger."""
    least_spread: float = 0.04
    """Least standard deviation of the grey values of cartilage, as a share of their level."""
    bias_mm: float = 12.0
    """Distance [mm] over which the level of cartilage may change."""
    blur_factors: tuple[float, float, float] = (0.5, 1.8, 0.05)
    """First, last and step of the multiples of the expected blur that are tried."""
    least_contrast: float = 0.3
    """Least contrast at an outer edge, as a share of the level of cartilage, for measuring its blur."""
    fewest_edges: int = 50
    """Fewest such edges from which the blur is measured."""
    edge_mm: float = 1.2
    """Distance [mm] from an edge within which its blur is measured."""


EVIDENCE_DEFAULTS = EvidenceSettings()
"""Default settings for the evidence of an image for the thickness of cartilage."""
_BINS = np.arange(-0.5, 3.5001, 0.04)
"""Edges of the bins of relative grey values; chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Profiles:
    """Grey values along the normals of a bone."""

    values: Floats
    """(V, D) at `DEPTHS_MM`."""
    blur_mm: Floats
    """(V,) standard deviation of an edge's blur along the normal."""
    correlation_mm: Floats
    """(V,) distance along the normal over which grey values are not independent."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Tissues:
    """Grey values relative to the local level of cartilage."""

    relative: Floats
    """(V, D) the profiles."""
    marrow: Floats
    """(V,) level of the marrow below the cartilage."""
    spread: float
    """Standard deviation within cartilage."""
    over: Floats
    """Probability density of the tissue over cartilage, in the bins of relative grey values."""


def read_profiles(
    volume: Volume,
    places_mm: Floats,
    normals: Floats,
    blurred: float = 1.0,
    *,
    settings: EvidenceSettings = EVIDENCE_DEFAULTS,
) -> Profiles:
    """Read an image along normals.

    Args:
        volume: The image.
        places_mm: (V, 3) on the bone.
        normals: (V, 3) unit vectors.
        blurred: Blur of the image as a multiple of that expected from its voxels and `edge_sd_mm`.
        settings: Tuned constants of the algorithm.
    """
    along = places_mm[:, None] + DEPTHS_MM[:, None] * normals[:, None]
    voxels = np.moveaxis(volume.grid.voxels(along)[..., ::-1], -1, 0)
    values = ndimage.map_coordinates(volume.intensity, voxels, order=1, mode="nearest", output=float)
    axes = volume.grid.lps_from_voxel[:3, :3]
    extents = np.abs(normals @ axes)  # (V, 3) extent of a voxel's edges along the normal
    # A voxel is the mean over its box, and interpolation is a mean over two boxes.
    blur = blurred * np.sqrt((extents**2).sum(1) * (1 / 12 + 1 / 6) + settings.edge_sd_mm**2)
    return Profiles(
        values=values, blur_mm=blur, correlation_mm=np.maximum(np.sqrt((extents**2).sum(1)), settings.correlated_mm)
    )


def tissues(
    profiles: Profiles,
    thickness_mm: Floats,
    present: Mask,
    theirs: Floats,
    graph: MeshGraph,
    *,
    settings: EvidenceSettings = EVIDENCE_DEFAULTS,
) -> Tissues:
    """Measure the levels of cartilage, marrow, and what lies over cartilage, from an estimate of its thickness.

    Args:
        profiles: Grey values.
        thickness_mm: (V,) the estimate.
        present: (V,) where cartilage is.
        theirs: (V, D) probability that another bone, or its cartilage, is there.
        graph: Mesh graph of the bone.
        settings: Tuned constants of the algorithm.
    """
    values = profiles.values
    column = np.clip(np.round((0.5 * thickness_mm - DEPTHS_MM[0]) / STEP_MM).astype(int), 0, len(DEPTHS_MM) - 1)
    middle = values[np.arange(len(values)), column]
    sure = present & (thickness_mm > 3.5 * profiles.blur_mm)
    if np.count_nonzero(sure) < 0.1 * np.count_nonzero(present):
        sure = present
    usual = float(np.median(middle[sure]))
    rough = 1.4826 * float(np.median(np.abs(middle[sure] - usual)))
    weights = (sure & (np.abs(middle - usual) < max(3 * rough, 0.2 * abs(usual)))).astype(float)
    about = graph.filled(middle, weights, settings.bias_mm)
    here = np.maximum(np.where(np.isfinite(about), about, usual), 1e-3 * max(abs(usual), 1e-6))
    relative = values / here[:, None]
    spread = 1.4826 * float(np.median(np.abs(middle[sure] / here[sure] - 1)))
    below = relative[:, (DEPTHS_MM > -2.1) & (DEPTHS_MM < -0.9)]
    marrow = graph.filled(np.median(below, axis=1), np.ones(len(below)), 1.5)
    beyond = DEPTHS_MM[None] - thickness_mm[:, None]
    outside = (beyond > 2.5 * profiles.blur_mm[:, None]) & (beyond < 4.0) & (theirs < 0.3) & np.isfinite(here)[:, None]
    outside &= present[:, None]
    return Tissues(
        relative=relative, marrow=marrow, spread=max(spread, settings.least_spread), over=_density(relative[outside])
    )


def _density(values: Floats) -> Floats:
    """Return a smoothed histogram with a floor, so that no value is impossible."""
    counts = np.histogram(np.clip(values, _BINS[0], _BINS[-1] - 1e-9), _BINS)[0].astype(float)
    smooth = ndimage.gaussian_filter1d(counts, 1.5, mode="nearest")
    wide = _BINS[1] - _BINS[0]
    return np.asarray((0.97 * smooth / max(smooth.sum(), 1.0) + 0.03 / len(counts)) / wide)


@dataclass(frozen=True, eq=False, kw_only=True)
class LayerCosts:
    """Cost of each thickness of `LEVELS_MM`: minus the logarithm of the profile's probability."""

    apart: Floats
    """(V, L) where something lies over the cartilage, be it a narrow gap before another bone's cartilage."""
    touching: Floats
    """(V, L) where the cartilage of another bone touches it without an edge; infinite where there is no other bone."""


def layer_costs(
    profiles: Profiles, seen: Tissues, begins_mm: Floats, begins_sd_mm: Floats, ends_mm: Floats
) -> LayerCosts:
    """Return the cost of each thickness, apart from another bone's cartilage and touching it.

    Bone, cartilage and what lies over it are three grey values with blurred edges between them. Farther out follows the
    usual tissue, up to where another bone's cartilage begins. That depth is predicted, not known: the likeliest depth
    is used, and where it is the outer surface itself, the cartilages touch without an edge.

    Args:
        profiles: Grey values.
        seen: The tissues.
        begins_mm: (V,) where another bone's cartilage is predicted to begin; infinite where there is none.
        begins_sd_mm: (V,) its standard deviation.
        ends_mm: (V,) depth up to which a profile is used: another bone may lie beyond it.
    """
    values = np.clip(seen.relative, _BINS[0], _BINS[-1] - 1e-9)
    wide = _BINS[1] - _BINS[0]
    bins = ((values - _BINS[0]) / wide).astype(int).clip(0, len(seen.over) - 1)
    peak = 1 / (seen.spread * math.sqrt(2 * math.pi))
    cartilage = (1 - STRAY) * peak * np.exp(-0.5 * ((values - 1) / seen.spread) ** 2) + STRAY / (_BINS[-1] - _BINS[0])
    over, theirs, share = -np.log(seen.over), -np.log(cartilage), STEP_MM / profiles.correlation_mm
    apart, touching = _layer_costs(
        values, over[bins], theirs, over, seen.marrow, profiles.blur_mm, share, begins_mm, begins_sd_mm, ends_mm,
        seen.spread, LEVELS_MM, DEPTHS_MM, (STRAY, _BINS[0], wide),
    )  # fmt: skip
    if (near := np.isfinite(begins_mm)).any():
        narrow = joint_space_costs(
            values[near], theirs[near], over, seen.marrow[near], profiles.blur_mm[near], share[near], begins_mm[near],
            begins_sd_mm[near], ends_mm[near], seen.spread, LEVELS_MM, DEPTHS_MM, (FIRST_MM, STRAY, _BINS[0], wide),
        )  # fmt: skip
        apart[near] = np.minimum(apart[near], narrow)
    return LayerCosts(apart=apart, touching=touching)


def measured_blur(
    profiles: Profiles,
    seen: Tissues,
    thickness_mm: Floats,
    sure: Mask,
    *,
    settings: EvidenceSettings = EVIDENCE_DEFAULTS,
) -> float:
    """Return the blur measured at the outer edges of thick cartilage, as a multiple of the assumed blur.

    Args:
        profiles: Grey values.
        seen: The tissues.
        thickness_mm: (V,) of the cartilage.
        sure: (V,) where it is known, and no other cartilage is near.
        settings: Tuned constants of the algorithm.
    """
    used = np.flatnonzero(sure & (thickness_mm > 4 * profiles.blur_mm))
    off = DEPTHS_MM[None] - thickness_mm[used, None]
    blur = profiles.blur_mm[used, None]
    beyond = (off > 2.5 * blur) & (off < 2.5 * blur + OVER_MM)
    outside = (seen.relative[used] * beyond).sum(1) / np.maximum(beyond.sum(1), 1)
    clear = (np.abs(1 - outside) > settings.least_contrast) & beyond.any(1)
    if np.count_nonzero(clear) < settings.fewest_edges:
        return 1.0
    near = clear[:, None] & (np.abs(off) < settings.edge_mm)
    part = ((1 - seen.relative[used]) / (1 - np.where(clear, outside, 0.0))[:, None])[near]
    at = (off / blur)[near]
    factors = np.arange(*settings.blur_factors)
    misfit = [np.minimum((part - ndtr(at / factor)) ** 2, 0.05).sum() for factor in factors]
    return float(factors[int(np.argmin(misfit))])


@kernel
def _layer_costs(  # pragma: no cover - compiled
    values, over, cartilage, over_bins, marrow, blur, share, begins, begins_sd, ends, spread, levels, depths, constants
):
    stray, low, wide = constants
    count, number = values.shape
    costs, closed = np.zeros((count, len(levels))), np.full((count, len(levels)), np.inf)
    step = depths[1] - depths[0]
    usual = math.log(spread * math.sqrt(2 * math.pi))
    farther, theirs = np.empty(number + 1), np.empty(number + 1)
    for v in range(count):
        _farther(over[v], cartilage[v], depths, begins[v], begins_sd[v], ends[v], share[v], farther, theirs)
        for n in range(len(levels)):
            thick = levels[n]
            # In thick voxels the blur reaches beyond the end of the profile.
            first = min(int((thick + 1.5 * blur[v] - depths[0]) / step + 0.5), number - 1)
            last = min(first + int(OVER_MM / step + 0.5), number - 1)
            outside = 0.0
            for d in range(first, last + 1):
                outside += values[v, d]
            outside /= last - first + 1
            # The tissue over the cartilage enters the cost as if it were not blurred.
            paid = over_bins[min(max(int((outside - low) / wide), 0), len(over_bins) - 1)]
            apart = touching = 0.0
            edge = rim = number
            for d in range(number):
                depth = depths[d]
                if depth < FIRST_MM or depth > ends[v]:
                    continue
                if depth > thick:
                    edge = min(edge, d)
                if depth > thick + 2 * blur[v]:
                    rim = d
                    break
                inner = 0.5 * math.erfc(-depth / (blur[v] * math.sqrt(2.0)))
                at = (depth - thick) / blur[v]
                outer = 0.5 * math.erfc(-at / math.sqrt(2.0))
                model = marrow[v] + (1 - marrow[v]) * inner
                # Deviation of an edge from its mean position and shape.
                inner_slope = EDGE_SLOPES[0] * (1 - marrow[v]) * math.exp(-0.5 * (depth / blur[v]) ** 2)
                outer_slope = EDGE_SLOPES[1] * (outside - 1) * math.exp(-0.5 * at * at)
                variance = spread**2 + inner_slope**2
                if depth <= thick:
                    touching += usual - math.log(
                        (1 - stray) * math.exp(-0.5 * (values[v, d] - model) ** 2 / variance) + stray
                    )
                off = (values[v, d] - model - (outside - 1) * outer) ** 2 / (variance + outer_slope**2)
                apart += (usual if depth <= thick else paid) - math.log((1 - stray) * math.exp(-0.5 * off) + stray)
            costs[v, n] = apart * share[v] + farther[rim]
            if begins[v] < np.inf:
                # The other cartilage begins at this depth.
                there = 0.5 * ((thick - begins[v]) / begins_sd[v]) ** 2
                closed[v, n] = touching * share[v] + theirs[edge] + there
    return costs, closed


@kernel
def _farther(  # pragma: no cover - compiled
    over, cartilage, depths, begins, begins_sd, ends, share, farther, theirs
):
    """Write the cost of the profile from each depth: of other tissue then another cartilage, and of that alone."""
    number = len(depths)
    farther[number] = theirs[number] = 0.0
    if begins < np.inf:
        farther[number] = 0.5 * (max(min(ends, depths[-1]) - begins, 0.0) / begins_sd) ** 2
    for d in range(number - 1, -1, -1):
        within = depths[d] >= FIRST_MM and depths[d] <= ends
        theirs[d] = theirs[d + 1] + (cartilage[d] * share if within else 0.0)
        farther[d] = farther[d + 1] + (over[d] * share if within else 0.0)
        if begins < np.inf and within:
            farther[d] = min(farther[d], theirs[d] + 0.5 * ((depths[d] - begins) / begins_sd) ** 2)

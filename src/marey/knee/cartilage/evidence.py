"""What an image says of how thick the cartilage is along each normal: a layer between two blurred edges, or none."""

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.special import ndtr

from marey.arrays import Floats, Mask
from marey.kernels import kernel
from marey.knee.space.mesh_graph import MeshGraph
from marey.knee.space.volume import Volume

STEP_MM = 0.2
THINNEST_MM, THICKEST_MM = 0.4, 7.0
LEVELS_MM = np.concatenate([[0.0], np.arange(THINNEST_MM, THICKEST_MM + 1e-9, STEP_MM)])
"""The thicknesses among which is chosen; 0 is bare."""
DEPTHS_MM = np.arange(-3.0, THICKEST_MM + 4.0, STEP_MM)
"""Where along a normal the image is read; 0 is the bone's surface."""
FIRST_MM = -0.6
"""From here on the grey values have to be explained."""
EDGE_SD_MM = 0.3
"""How blurred an edge is besides what the voxels do: surfaces are curved and rough."""
CORRELATED_MM = 0.5
"""Grey values nearer than this along a profile tell the same, or nearer than voxels are."""
LEAST_SPREAD = 0.04
"""Grey values of cartilage differ by at least this share of their brightness."""
STRAY = 0.03
"""This share of grey values is something else than it should be."""
BIAS_MM = 12.0
"""Over such a way the brightness of cartilage may change."""
OVER_MM = 0.6
"""What lies over the cartilage is seen in so much of the profile beyond the edge."""
_FACTORS = np.arange(0.5, 1.8, 0.05)
_CLEAR, _ENOUGH, _EDGE_MM = 0.3, 50, 1.2
_BINS = np.arange(-0.5, 3.5001, 0.04)


@dataclass(frozen=True, eq=False, kw_only=True)
class Profiles:
    """Grey values along the normals of a bone."""

    values: Floats
    """(V, D) at `DEPTHS_MM`."""
    blur_mm: Floats
    """(V,) standard deviation of an edge's blur along the normal."""
    alike_mm: Floats
    """(V,) over such a way along the normal grey values tell the same."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Tissues:
    """Grey values as shares of cartilage's at that place."""

    relative: Floats
    """(V, D) the profiles."""
    marrow: Floats
    """(V,) below the cartilage."""
    spread: float
    """Standard deviation within cartilage."""
    over: Floats
    """Density of what lies over cartilage, in `_BINS`."""


def read_profiles(volume: Volume, places_mm: Floats, normals: Floats, blurred: float = 1.0) -> Profiles:
    """Read an image along normals (V, 3) from places (V, 3).

    Args:
        volume: The image.
        places_mm: On the bone.
        normals: Unit.
        blurred: The image is so many times as blurred as its voxels and `EDGE_SD_MM` let expect.
    """
    along = places_mm[:, None] + DEPTHS_MM[:, None] * normals[:, None]
    voxels = np.moveaxis(volume.grid.voxels(along)[..., ::-1], -1, 0)
    values = ndimage.map_coordinates(volume.intensity, voxels, order=1, mode="nearest", output=float)
    axes = volume.grid.lps_from_voxel[:3, :3]
    extents = np.abs(normals @ axes)  # (V, 3) of a voxel's edges, along the normal
    # A voxel is the mean over its box, and reading between voxels is a mean over two boxes.
    blur = blurred * np.sqrt((extents**2).sum(1) * (1 / 12 + 1 / 6) + EDGE_SD_MM**2)
    return Profiles(values=values, blur_mm=blur, alike_mm=np.maximum(np.sqrt((extents**2).sum(1)), CORRELATED_MM))


def tissues(profiles: Profiles, thickness_mm: Floats, present: Mask, theirs: Floats, graph: MeshGraph) -> Tissues:
    """Learn how bright cartilage, marrow, and what lies over cartilage are, from a first idea of its thickness.

    Args:
        profiles: Grey values.
        thickness_mm: (V,) the idea.
        present: (V,) where cartilage is.
        theirs: (V, D) how probable it is that another bone's cartilage is there, or that bone.
        graph: Of the bone.
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
    about = graph.filled(middle, weights, BIAS_MM)
    here = np.maximum(np.where(np.isfinite(about), about, usual), 1e-3 * max(abs(usual), 1e-6))
    relative = values / here[:, None]
    spread = 1.4826 * float(np.median(np.abs(middle[sure] / here[sure] - 1)))
    below = relative[:, (DEPTHS_MM > -2.1) & (DEPTHS_MM < -0.9)]
    marrow = graph.filled(np.median(below, axis=1), np.ones(len(below)), 1.5)
    beyond = DEPTHS_MM[None] - thickness_mm[:, None]
    outside = (beyond > 2.5 * profiles.blur_mm[:, None]) & (beyond < 4.0) & (theirs < 0.3) & np.isfinite(here)[:, None]
    outside &= present[:, None]
    return Tissues(relative=relative, marrow=marrow, spread=max(spread, LEAST_SPREAD), over=_density(relative[outside]))


def _density(values: Floats) -> Floats:
    """Return a smooth histogram with a floor: nothing is impossible."""
    counts = np.histogram(np.clip(values, _BINS[0], _BINS[-1] - 1e-9), _BINS)[0].astype(float)
    smooth = ndimage.gaussian_filter1d(counts, 1.5, mode="nearest")
    wide = _BINS[1] - _BINS[0]
    return np.asarray((0.97 * smooth / max(smooth.sum(), 1.0) + 0.03 / len(counts)) / wide)


def layer_costs(profiles: Profiles, seen: Tissues, begins_mm: Floats, begins_sd_mm: Floats, ends_mm: Floats) -> Floats:
    """Return what each thickness of `LEVELS_MM` costs (V, L): minus the logarithm of the profile's probability.

    Bone, cartilage and what lies over it are three grey values with a blurred edge between each two. Farther out lies
    whatever usually lies there, up to where another bone's cartilage begins. Where that begins is not known, only
    foretold: of all places the likeliest is taken, and where it is the outer surface itself, the two touch, edgeless.

    Args:
        profiles: Grey values.
        seen: The tissues.
        begins_mm: (V,) where another bone's cartilage is foretold to begin; infinite where there is none.
        begins_sd_mm: (V,) standard deviation of that.
        ends_mm: (V,) how far out a profile tells something: another bone may be in the way.
    """
    values = np.clip(seen.relative, _BINS[0], _BINS[-1] - 1e-9)
    wide = _BINS[1] - _BINS[0]
    bins = ((values - _BINS[0]) / wide).astype(int).clip(0, len(seen.over) - 1)
    peak = 1 / (seen.spread * math.sqrt(2 * math.pi))
    cartilage = (1 - STRAY) * peak * np.exp(-0.5 * ((values - 1) / seen.spread) ** 2) + STRAY / (_BINS[-1] - _BINS[0])
    return _layer_costs(
        values, -np.log(seen.over)[bins], -np.log(cartilage), -np.log(seen.over), seen.marrow, profiles.blur_mm,
        STEP_MM / profiles.alike_mm, begins_mm, begins_sd_mm, ends_mm, seen.spread, LEVELS_MM, DEPTHS_MM,
        (STRAY, _BINS[0], wide),
    )  # fmt: skip


def measured_blur(profiles: Profiles, seen: Tissues, thickness_mm: Floats, sure: Mask) -> float:
    """Return the blur that the image shows at the outer edges of thick cartilage, as a multiple of what is assumed.

    Args:
        profiles: Grey values.
        seen: The tissues.
        thickness_mm: (V,) as found.
        sure: (V,) where it is known, and free of other cartilage.
    """
    used = np.flatnonzero(sure & (thickness_mm > 4 * profiles.blur_mm))
    off = DEPTHS_MM[None] - thickness_mm[used, None]
    blur = profiles.blur_mm[used, None]
    beyond = (off > 2.5 * blur) & (off < 2.5 * blur + OVER_MM)
    outside = (seen.relative[used] * beyond).sum(1) / np.maximum(beyond.sum(1), 1)
    clear = (np.abs(1 - outside) > _CLEAR) & beyond.any(1)
    if np.count_nonzero(clear) < _ENOUGH:
        return 1.0
    near = clear[:, None] & (np.abs(off) < _EDGE_MM)
    part = ((1 - seen.relative[used]) / (1 - np.where(clear, outside, 0.0))[:, None])[near]
    at = (off / blur)[near]
    misfit = [np.minimum((part - ndtr(at / factor)) ** 2, 0.05).sum() for factor in _FACTORS]
    return float(_FACTORS[int(np.argmin(misfit))])


@kernel
def _layer_costs(  # pragma: no cover - compiled
    values, over, cartilage, over_bins, marrow, blur, share, begins, begins_sd, ends, spread, levels, depths, constants
):
    stray, low, wide = constants
    count, number = values.shape
    costs = np.zeros((count, len(levels)))
    step = depths[1] - depths[0]
    usual = math.log(spread * math.sqrt(2 * math.pi))
    farther, theirs = np.empty(number + 1), np.empty(number + 1)
    for v in range(count):
        _farther(over[v], cartilage[v], depths, begins[v], begins_sd[v], ends[v], share[v], farther, theirs)
        for n in range(len(levels)):
            thick = levels[n]
            # Where voxels are thick the blur reaches beyond the profile's end.
            first = min(int((thick + 1.5 * blur[v] - depths[0]) / step + 0.5), number - 1)
            last = min(first + int(OVER_MM / step + 0.5), number - 1)
            outside = 0.0
            for d in range(first, last + 1):
                outside += values[v, d]
            outside /= last - first + 1
            # As if nothing were blurred: what lies over is paid for all along.
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
                # What an edge may be off its mean place and form.
                inner_slope = 0.3 * (1 - marrow[v]) * math.exp(-0.5 * (depth / blur[v]) ** 2)
                outer_slope = 0.15 * (outside - 1) * math.exp(-0.5 * at * at)
                variance = spread**2 + inner_slope**2
                if depth <= thick:
                    touching += usual - math.log(
                        (1 - stray) * math.exp(-0.5 * (values[v, d] - model) ** 2 / variance) + stray
                    )
                off = (values[v, d] - model - (outside - 1) * outer) ** 2 / (variance + outer_slope**2)
                apart += (usual if depth <= thick else paid) - math.log((1 - stray) * math.exp(-0.5 * off) + stray)
            costs[v, n] = apart * share[v] + farther[rim]
            if begins[v] < np.inf:
                # The other cartilage begins right here.
                there = 0.5 * ((thick - begins[v]) / begins_sd[v]) ** 2
                costs[v, n] = min(costs[v, n], touching * share[v] + theirs[edge] + there)
    return costs


@kernel
def _farther(  # pragma: no cover - compiled
    over, cartilage, depths, begins, begins_sd, ends, share, farther, theirs
):
    """Fill in what the profile from each depth on costs: what lies over, then another cartilage; and that alone."""
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

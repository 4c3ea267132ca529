"""Evidence of a profile for a narrow gap between the cartilages of two bones.

Across a gap that is about as narrow as the blur, neither the grey value of what fills it nor the depth of either edge
is visible alone: the profile has a dip, whose depth is the product of the gap's width and contrast. Each width is
therefore tried with the likeliest grey value, which has the distribution of what lies over cartilage elsewhere.
"""

import math

import numpy as np

from marey.compiled.kernels import kernel

WIDEST_BLURS = 4.0
"""Width of the widest narrow gap, as a multiple of the blur (standard deviation): the blurred edges of a wider gap do
not overlap."""
EDGE_SLOPES = (0.3, 0.15)
"""Standard deviation of the position of an inner and an outer edge, as a share of its blur times the square root of
two pi; chosen by hand."""
_EVERY = 2
"""Every so many grey values of the distribution are tried; chosen by hand: they are then 0.08 of cartilage apart."""


@kernel
def joint_space_costs(  # pragma: no cover - compiled
    values, theirs, over_bins, marrow, blur, share, begins, begins_sd, ends, spread, levels, depths, constants
):
    """Return the cost (V, L) of each thickness beside another cartilage, across the likeliest narrow gap.

    Args:
        values: (V, D) grey values relative to cartilage.
        theirs: (V, D) cost of a grey value in the other cartilage.
        over_bins: (B,) minus the logarithm of the density of grey values over cartilage.
        marrow: (V,) grey value below the cartilage.
        blur: (V,) standard deviation of the blur of an edge.
        share: (V,) number of independent grey values per sample.
        begins: (V,) depth at which the other cartilage is predicted to begin.
        begins_sd: (V,) its standard deviation.
        ends: (V,) depth up to which the profile is used.
        spread: Standard deviation of grey values in cartilage.
        levels: (L,) the thicknesses, multiples of the distance of the depths.
        depths: (D,) at which the grey values are known.
        constants: First depth that enters, share of outliers, first and width of the bins of grey values.
    """
    from_depth, stray, low, wide = constants
    count, number = values.shape
    step = depths[1] - depths[0]
    costs = np.full((count, len(levels)), np.inf)
    usual = math.log(spread * math.sqrt(2 * math.pi))
    start = math.ceil((from_depth - depths[0]) / step - 1e-6)
    zero = round(-depths[0] / step)
    edge, bump = np.empty(2 * number + 1), np.empty(2 * number + 1)
    off, variance = np.empty(number), np.empty(number)
    own, suffix = np.empty(number + 1), np.empty(number + 1)
    for v in range(count):
        stop = number  # the first sample that is not used
        while stop > start and depths[stop - 1] > ends[v]:
            stop -= 1
        _tabulate_edges(step / blur[v], edge, bump)
        own[start] = suffix[stop] = 0.0
        for d in range(start, stop):
            off[d] = values[v, d] - marrow[v] - (1 - marrow[v]) * edge[d - zero + number]
            variance[d] = spread**2 + (EDGE_SLOPES[0] * (1 - marrow[v]) * bump[d - zero + number]) ** 2
            own[d + 1] = own[d] + usual - math.log((1 - stray) * math.exp(-0.5 * off[d] ** 2 / variance[d]) + stray)
        for d in range(stop - 1, start - 1, -1):
            suffix[d] = suffix[d + 1] + theirs[v, d]
        reach = math.ceil(2 * blur[v] / step)
        for n in range(len(levels)):
            mine = round((levels[n] - depths[0]) / step)
            for k in range(1, int(WIDEST_BLURS * blur[v] / step + 0.5) + 1):
                first, last = max(mine - reach, start), min(mine + k + reach + 1, stop)
                if mine + k > stop or last <= first:
                    break
                times = max(share[v] * k, 1.0)
                gap, bins = (mine - number, k, first, last), (low + 0.5 * wide, wide)
                contrast, paid = _likeliest(off, variance, edge, gap, over_bins, bins, share[v], times)
                within = _misfit(off, variance, edge, bump, gap, contrast, stray) + usual * (last - first)
                there = 0.5 * ((levels[n] + k * step - begins[v]) / begins_sd[v]) ** 2
                cost = share[v] * (own[first] + within + suffix[last]) + times * (paid - usual) + there
                costs[v, n] = min(costs[v, n], cost)
    return costs


@kernel
def _tabulate_edges(step, edge, bump):  # pragma: no cover - compiled
    """Write a blurred edge and its slope at each number of samples from it; the edge is in the middle of the tables."""
    middle = len(edge) // 2
    for k in range(len(edge)):
        at = (k - middle) * step
        edge[k] = 0.5 * math.erfc(-at / math.sqrt(2.0))
        bump[k] = math.exp(-0.5 * at * at)


@kernel
def _likeliest(off, variance, edge, gap, over_bins, bins, share, times):  # pragma: no cover - compiled
    """Return the likeliest grey value in a gap, less that of cartilage, and the cost of its density.

    The gap is given by the sample at its first edge less the middle of the table, its width, and the samples from the
    first to the last (exclusive) that enter.
    """
    (origin, k, first, last), (first_value, wide) = gap, bins
    square = product = 0.0
    for d in range(first, last):
        part = edge[d - origin] - edge[d - origin - k]
        square += part * part / variance[d]
        product += part * off[d] / variance[d]
    least, contrast, paid = np.inf, 0.0, 0.0
    for m in range(0, len(over_bins), _EVERY):
        here = first_value + m * wide - 1
        cost = share * (0.5 * here * square - product) * here + times * over_bins[m]
        if cost < least:
            least, contrast, paid = cost, here, over_bins[m]
    return contrast, paid


@kernel
def _misfit(off, variance, edge, bump, gap, contrast, stray):  # pragma: no cover - compiled
    """Return the cost of the samples about a gap (see `_likeliest`) of known contrast, with outliers."""
    origin, k, first, last = gap
    total = 0.0
    for d in range(first, last):
        part = edge[d - origin] - edge[d - origin - k]
        slopes = bump[d - origin] ** 2 + bump[d - origin - k] ** 2
        squared = (off[d] - contrast * part) ** 2 / (variance[d] + (EDGE_SLOPES[1] * contrast) ** 2 * slopes)
        total -= math.log((1 - stray) * math.exp(-0.5 * squared) + stray)
    return total

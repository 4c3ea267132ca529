"""Edges inside a silhouette: the visible borders of a limb in front of another part of the person."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.compiled.kernel_order import insert, middle
from marey.compiled.kernels import kernel
from marey.images.silhouettes.nearest import Cells, sort_into_cells

# Constants rather than a settings record: the kernels are compiled with them.
EDGE_REACH = 0.025
"""Half-width of the search about an edge's expected position, as a share of the silhouette's height. Chosen by
hand."""
CLEAR = 6.0
"""Least contrast of an edge, in standard deviations of the image's noise. Chosen by hand."""
PARTED = 4.0
"""Least difference between the mean colours of the two sides, in standard deviations of the colours about them, which
excludes gradients and texture. Chosen by hand."""
SIDE_WIDTH = 5
"""Number of pixels on each side of an edge whose colours are compared. Chosen by hand."""
RIVAL_STRENGTH = 0.6
"""Largest strength of any other edge within reach, as a share of the strongest edge's. Chosen by hand."""
APART = 3
"""Edges nearer to each other than this are one [px]. Chosen by hand."""
NEAR, COMPANY, LIKE = 8.0, 0.6, 1.5
"""An edge is accepted if, among the expected positions within `NEAR` [px] on the same rim, the share `COMPANY` has an
edge and their median offset differs by at most `LIKE` [px]. Chosen by hand."""
INSIDE = 4.0
"""Least distance of an edge from the silhouette's outline, which a nearer edge may be itself [px]. Chosen by hand."""
_ALONG = 2
"""Number of pixels along the edge, to each side, over which the image is averaged. Chosen by hand."""
_WIDE = 2
"""Number of pixels on each side of an edge whose difference is its strength. Chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class InteriorEdges:
    """Points on edges of limbs inside the silhouette, or positions where such edges are expected."""

    pixels: Floats
    """(n, 2) x, y."""
    inward: Floats
    """(n, 2) unit normals towards the limb in front."""
    limb: Integers
    """(n,) number of that limb."""

    @staticmethod
    def none() -> "InteriorEdges":
        """Return an empty set of edges."""
        return InteriorEdges(pixels=np.zeros((0, 2)), inward=np.zeros((0, 2)), limb=np.zeros(0, np.int64))

    @cached_property
    def cells(self) -> Cells:
        """The points, sorted into cells for a fast search of the nearest one."""
        cells: Cells = sort_into_cells(self.pixels)
        return cells

    def __len__(self) -> int:
        """Count the points."""
        return len(self.pixels)

    def scaled(self, factor: float) -> "InteriorEdges":
        """Return the edges in an image resized by a factor; pixel centres are at whole numbers in both."""
        return InteriorEdges(pixels=(self.pixels + 0.5) * factor - 0.5, inward=self.inward, limb=self.limb)


def edge_reach(mask: Mask) -> int:
    """Return the half-width of the search about an edge's expected position in a silhouette (H, W) [px]."""
    rows = np.flatnonzero(mask.any(1))
    return round(max(4.0, EDGE_REACH * (rows[-1] - rows[0] + 1)))


def find_edges(
    image: np.ndarray, mask: Mask, expected: InteriorEdges, noise: np.ndarray, *, borders: Floats | None = None
) -> InteriorEdges:
    """Search for edges of limbs near positions predicted by a posed surface; ambiguous ones are omitted.

    Along the normal of each expected position the step of the image between both sides is evaluated, averaged along
    the edge. The strongest step is an edge if it exceeds the noise and the texture about it, if no other step within
    reach has a similar strength, and if its neighbours along the rim agree. Ours; [Rosenhahn2006] uses the silhouette
    alone.

    Args:
        image: (H, W, C) uint8.
        mask: (H, W) silhouette, within which edges are searched.
        expected: Rims of the predicted surface.
        noise: (C,) standard deviation of the image's noise [grey levels].
        borders: (n,) offsets of borders found otherwise, used where there is no clear step [px]; NaN for none.

    Returns:
        The positions with an edge, moved along their normals to the edge [px].
    """
    if len(expected) == 0 or not mask.any():
        return InteriorEdges.none()
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    top, left = max(rows[0] - 1, 0), max(columns[0] - 1, 0)
    part = np.ascontiguousarray(mask[top : rows[-1] + 2, left : columns[-1] + 2])
    depth = cv2.distanceTransform(part.view(np.uint8), cv2.DIST_L2, 5)
    offset = strongest_steps(
        image, depth, left, top, expected.pixels, expected.inward, np.asarray(1.0 / noise, np.float64), edge_reach(mask)
    )  # fmt: skip
    if borders is not None:
        offset = np.where(np.isnan(offset), borders, offset)
    keep = in_company(expected.pixels, expected.inward, expected.limb, offset)
    moved = expected.pixels + offset[:, None] * expected.inward
    return InteriorEdges(pixels=moved[keep], inward=expected.inward[keep], limb=expected.limb[keep])


@kernel
def strongest_steps(image, depth, left, top, pixels, inward, weight, reach):
    """Find the offset (n,) of the unique clear edge along each position's normal [px]; NaN where there is none.

    Args:
        image: (H, W, C) uint8.
        depth: (h, w) distance from the silhouette's outline [px], for the part of the image that contains it.
        left: x of that part's first pixel.
        top: y of that part's first pixel.
        pixels: (n, 2) positions.
        inward: (n, 2) unit normals.
        weight: (C,) reciprocal of the noise's standard deviation.
        reach: Number of pixels searched to each side.

    Returns:
        (n,) offsets [px].
    """
    count, length = pixels.shape[0], 2 * (reach + SIDE_WIDTH) + 1
    found = np.full(count, np.nan)
    profile = np.empty((length + 2 * _WIDE, image.shape[2]))
    strength, parts, across = np.empty(length), np.empty(length, np.bool_), np.empty(image.shape[2])
    for i in range(count):
        first, last = free_way(depth, pixels[i, 0] - left, pixels[i, 1] - top, inward[i], reach + SIDE_WIDTH)
        if last - first < 2 * SIDE_WIDTH:
            continue
        _take_profile(image, pixels[i], inward[i], first - _WIDE, last + _WIDE, profile)
        steps = strength[: last - first + 1]
        _take_steps(profile, weight, steps)
        parts[:] = False
        for s in range(max(-reach - first, 1), min(reach - first, len(steps) - 2) + 1):
            # Nothing else can be the clear peak or its rival.
            if _is_peak(steps, s) and steps[s] > RIVAL_STRENGTH * CLEAR:
                parts[s] = _parts(profile[: len(steps) + 2 * _WIDE], s + _WIDE, weight, across)
        place = _one_clear_peak(steps, parts, -reach - first, reach - first)
        if place >= 0:
            found[i] = first + _sharpest(profile, weight, place + _WIDE) - _WIDE
    return found


@kernel
def free_way(depth, x0, y0, normal, reach):
    """Return the first and the last step along the normal that are well inside the silhouette."""
    height, width = depth.shape
    ends = (0, 0)
    for side in (-1, 1):
        step = 0
        while step < reach:
            x = int(np.rint(x0 + side * (step + 1) * normal[0]))
            y = int(np.rint(y0 + side * (step + 1) * normal[1]))
            if x < 0 or y < 0 or x >= width or y >= height or depth[y, x] < INSIDE:
                break
            step += 1
        ends = (-step, ends[1]) if side < 0 else (ends[0], step)
    return ends


@kernel
def _take_profile(image, pixel, normal, first, last, profile):
    """Write the image (steps, C) along a normal from the first to the last step, averaged along the edge."""
    height, width, channels = image.shape
    for s in range(first, last + 1):
        row = profile[s - first]
        row[:] = 0.0
        for t in range(-_ALONG, _ALONG + 1):
            x = min(max(pixel[0] + s * normal[0] - t * normal[1], 0.0), width - 1.001)
            y = min(max(pixel[1] + s * normal[1] + t * normal[0], 0.0), height - 1.001)
            x0, y0 = int(x), int(y)
            u, v = x - x0, y - y0
            for c in range(channels):
                above = (1.0 - u) * image[y0, x0, c] + u * image[y0, x0 + 1, c]
                below = (1.0 - u) * image[y0 + 1, x0, c] + u * image[y0 + 1, x0 + 1, c]
                row[c] += ((1.0 - v) * above + v * below) / (2 * _ALONG + 1)


@kernel
def _take_steps(profile, weight, strength):
    """Write the difference of hue between the two sides of each step, in standard deviations of the noise."""
    across = np.empty(profile.shape[1])
    for s in range(len(strength)):
        centre = s + _WIDE
        _chroma_step(profile[centre - _WIDE : centre], profile[centre + 1 : centre + 1 + _WIDE], across)
        strength[s] = _length(across, weight)


@kernel
def _chroma_step(before, after, across):
    """Write the change of the mean colour (C,) between two sets (n, C) without brightness; return its length.

    A surface that is lit less, or lies in a shadow, keeps the ratio of its channels: such a change is not a border.
    """
    along = square = 0.0
    for c in range(len(across)):
        first, second = before[:, c].mean(), after[:, c].mean()
        across[c] = second - first
        along += (second - first) * (second + first)
        square += (second + first) ** 2
    length = 0.0
    for c in range(len(across)):
        across[c] -= along / max(square, 1e-9) * (before[:, c].mean() + after[:, c].mean())
        length += across[c] ** 2
    return np.sqrt(length)


@kernel
def _length(step, weight):
    total = 0.0
    for c in range(len(step)):
        total += (weight[c] * step[c]) ** 2
    return np.sqrt(total)


@kernel
def _one_clear_peak(strength, parts, first, last):
    """Return the unique peak from the first to the last step that exceeds the noise and all others; -1 without one."""
    best = -1
    for s in range(max(first, 1), min(last, len(strength) - 2) + 1):
        if parts[s] and _is_peak(strength, s) and (best < 0 or strength[s] > strength[best]):
            best = s
    if best < 0 or strength[best] < CLEAR:
        return -1
    for s in range(max(first, 1), min(last, len(strength) - 2) + 1):
        if (
            abs(s - best) >= APART
            and parts[s]
            and _is_peak(strength, s)
            and strength[s] > RIVAL_STRENGTH * strength[best]
        ):
            return -1
    return best


@kernel
def _sharpest(profile, weight, place):
    """Return the position, to fractions of a step, of the steepest change of colour and brightness near a step.

    Recordings store hue at half the resolution; brightness localises an edge more precisely.
    """
    step, steps = np.empty(profile.shape[1]), np.empty(3)
    for k in range(3):
        steps[k] = _contrast(profile, weight, place + k - 1, step)
    best = place
    for k in (0, 2):
        if steps[k] > steps[best - place + 1]:
            best = place + k - 1
    before, after = _contrast(profile, weight, best - 1, step), _contrast(profile, weight, best + 1, step)
    here = _contrast(profile, weight, best, step)
    bend = before - 2.0 * here + after
    return best + (min(max(0.5 * (before - after) / bend, -1.0), 1.0) if bend < 0.0 else 0.0)


@kernel
def _contrast(profile, weight, place, step):
    for c in range(len(step)):
        step[c] = profile[place + 1, c] - profile[place - 1, c]
    return _length(step, weight)


@kernel
def _parts(profile, place, weight, across):
    """Return whether the colours (n, C) of both sides of a step differ by much more than their standard deviations."""
    # The pixels next to the edge are excluded, because the optics mix both sides there.
    before, after = (
        profile[max(place - 1 - SIDE_WIDTH, 0) : max(place - 1, 0)],
        profile[place + 2 : place + 2 + SIDE_WIDTH],
    )
    if len(before) < 3 or len(after) < 3:
        return False
    apart = _chroma_step(before, after, across)
    if apart <= 0.0:
        return False
    across /= apart
    noise = 1.0 / _length(across, weight)
    return apart >= PARTED * np.sqrt(noise**2 + _spread(before, across) + _spread(after, across))


@kernel
def _spread(colours, along):
    """Return the variance of colours (n, C) along a direction (C,)."""
    total = square = 0.0
    for k in range(len(colours)):
        value = 0.0
        for c in range(len(along)):
            value += colours[k, c] * along[c]
        total += value
        square += value * value
    mean = total / len(colours)
    return max(square / len(colours) - mean * mean, 0.0)


@kernel
def _is_peak(strength, s):
    return strength[s] >= strength[s - 1] and strength[s] > strength[s + 1]


@kernel
def in_company(pixels, inward, limb, offset):
    """Return which positions (n,) have an edge that most of their neighbours along the rim confirm.

    Args:
        pixels: (n, 2) expected positions.
        inward: (n, 2) unit normals.
        limb: (n,) numbers of the limbs.
        offset: (n,) offsets of the edges from `strongest_steps` [px].

    Returns:
        (n,) true where the edge is confirmed.
    """
    keep = np.zeros(len(offset), np.bool_)
    near = np.empty(len(offset))
    for i in range(len(offset)):
        if np.isnan(offset[i]):
            continue
        around = shown = 0
        for j in range(len(offset)):
            dx, dy = pixels[j, 0] - pixels[i, 0], pixels[j, 1] - pixels[i, 1]
            along = inward[i, 0] * inward[j, 0] + inward[i, 1] * inward[j, 1]
            if limb[j] != limb[i] or dx * dx + dy * dy > NEAR**2 or along < 0.7:
                continue
            around += 1
            if not np.isnan(offset[j]):
                insert(near, shown, offset[j])
                shown += 1
        if shown == 0:
            continue
        keep[i] = shown >= COMPANY * around and abs(offset[i] - middle(near, shown)) <= LIKE
    return keep

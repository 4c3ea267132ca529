"""Edges inside a silhouette: the visible borders of a limb in front of another part of the person."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.images.silhouettes.nearest import Cells, sort_into_cells
from marey.kernels import kernel

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
    """Points of edges that limbs show inside of the silhouette, or places where such edges are expected."""

    pixels: Floats
    """(n, 2) x, y."""
    inward: Floats
    """(n, 2) unit normals, towards the limb that lies in front."""
    limb: Integers
    """(n,) number of that limb."""

    @staticmethod
    def none() -> "InteriorEdges":
        """Give no edge at all."""
        return InteriorEdges(pixels=np.zeros((0, 2)), inward=np.zeros((0, 2)), limb=np.zeros(0, np.int64))

    @cached_property
    def cells(self) -> Cells:
        """The points, sorted so that the nearest one is found quickly."""
        cells: Cells = sort_into_cells(self.pixels)
        return cells

    def __len__(self) -> int:
        """Count the points."""
        return len(self.pixels)

    def scaled(self, factor: float) -> "InteriorEdges":
        """Give the same edges in a picture that is resized by a factor; pixel centres stay at whole numbers."""
        return InteriorEdges(pixels=(self.pixels + 0.5) * factor - 0.5, inward=self.inward, limb=self.limb)


def find_edges(image: np.ndarray, mask: Mask, expected: InteriorEdges, noise: np.ndarray) -> InteriorEdges:
    """Look for edges of limbs where a posed surface expects them; where the picture shows no clear one, give none.

    Along the normal of each expected place the picture's step between both sides is taken, averaged along the edge.
    An edge is the strongest such step when it stands clear of the noise and of the texture about it, when no other
    one within reach comes near its strength, and when its neighbours along the rim agree. Ours; [Rosenhahn2006] uses
    the silhouette alone.

    Args:
        image: (H, W, C) uint8.
        mask: (H, W) the silhouette; the search stays within it.
        expected: where the surface's rims are.
        noise: (C,) standard deviation of the picture [grey levels].

    Returns:
        Those of the places that show an edge, moved along their normals to it [px].
    """
    if len(expected) == 0 or not mask.any():
        return InteriorEdges.none()
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    reach = max(4.0, EDGE_REACH * (rows[-1] - rows[0] + 1))
    top, left = max(rows[0] - 1, 0), max(columns[0] - 1, 0)
    part = np.ascontiguousarray(mask[top : rows[-1] + 2, left : columns[-1] + 2])
    depth = cv2.distanceTransform(part.view(np.uint8), cv2.DIST_L2, 5)
    offset = strongest_steps(
        image, depth, left, top, expected.pixels, expected.inward, np.asarray(1.0 / noise, np.float64), round(reach)
    )  # fmt: skip
    keep = in_company(expected.pixels, expected.inward, expected.limb, offset)
    moved = expected.pixels + offset[:, None] * expected.inward
    return InteriorEdges(pixels=moved[keep], inward=expected.inward[keep], limb=expected.limb[keep])


@kernel
def strongest_steps(image, depth, left, top, pixels, inward, weight, reach):
    """Find how far (n,) along its normal each place has the one clear edge; NaN where there is none.

    Args:
        image: (H, W, C) uint8.
        depth: (h, w) distance from the silhouette's outline [px], for the part of the picture that holds it.
        left: x of that part's first pixel.
        top: its y.
        pixels: (n, 2).
        inward: (n, 2).
        weight: (C,) one over the noise's standard deviation.
        reach: pixels to either side that are searched.
    """
    count, length = pixels.shape[0], 2 * (reach + SIDE_WIDTH) + 1
    found = np.full(count, np.nan)
    profile = np.empty((length + 2 * _WIDE, image.shape[2]))
    strength, parts, across = np.empty(length), np.empty(length, np.bool_), np.empty(image.shape[2])
    for i in range(count):
        first, last = _free_way(depth, pixels[i, 0] - left, pixels[i, 1] - top, inward[i], reach + SIDE_WIDTH)
        if last - first < 2 * SIDE_WIDTH:
            continue
        _take_profile(image, pixels[i], inward[i], first - _WIDE, last + _WIDE, profile)
        steps = strength[: last - first + 1]
        _take_steps(profile, weight, steps)
        for s in range(len(steps)):
            parts[s] = _parts(profile[: len(steps) + 2 * _WIDE], s + _WIDE, weight, across)
        place = _one_clear_peak(steps, parts, -reach - first, reach - first)
        if place >= 0:
            found[i] = first + _sharpest(profile, weight, place + _WIDE) - _WIDE
    return found


@kernel
def _free_way(depth, x0, y0, normal, reach):
    """Give the first and the last step along the normal between which one stays well inside of the silhouette."""
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
    """Write the picture (steps, C) along a normal from the first to the last step, averaged along the edge."""
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
    """Write how much the hue differs between the two sides of each step, in standard deviations of the noise."""
    across = np.empty(profile.shape[1])
    for s in range(len(strength)):
        centre = s + _WIDE
        _chroma_step(profile[centre - _WIDE : centre], profile[centre + 1 : centre + 1 + _WIDE], across)
        strength[s] = _length(across, weight)


@kernel
def _chroma_step(before, after, across):
    """Write how the mean colour (C,) changes between two sets (n, C), but for brightness; give the change's length.

    What is lit less, or lies in a shadow, keeps the ratio of its channels: such a change is no border.
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
    """Give the one peak from the first to the last place that stands clear of noise and of rivals, -1 without one."""
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
    """Give the place, to parts of a step, of the steepest change of colour and brightness beside a place.

    Recordings keep hue at half the resolution; where an edge is, brightness tells better.
    """
    step, steps = np.empty(profile.shape[1]), np.empty(3)
    best = place
    for k in range(-1, 2):
        steps[k + 1] = _contrast(profile, weight, place + k, step)
        if steps[k + 1] > steps[best - place + 1]:
            best = place + k
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
    """Tell whether the colours (n, C) of both sides of a place differ by far more than they spread."""
    # Next to the edge the optics mix both sides.
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
    """Give the variance of colours (n, C) along a direction (C,)."""
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
    """Tell (n,) which places show an edge where most of their neighbours along the rim show it too.

    Args:
        pixels: (n, 2) expected places.
        inward: (n, 2).
        limb: (n,).
        offset: (n,) from `strongest_steps`.
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
                near[shown] = offset[j]
                shown += 1
        keep[i] = shown >= COMPANY * around and abs(offset[i] - np.median(near[:shown])) <= LIKE
    return keep

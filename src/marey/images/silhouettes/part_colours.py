"""Colours of the parts of the body, and the regions of an image in which something hides them."""

from dataclasses import dataclass

import cv2
import numpy as np

from marey.arrays import Floats, Image, Integers, Mask, freeze_fields
from marey.images.boxes import box_about
from marey.images.silhouettes.densities import COLOUR_SHIFT, COMMON, colour_density

LEAST_PIXELS = 20
"""Least number of pixels of a part in an image from which its colours are learned. Chosen by hand."""
DOUBTFUL_OVERLAP, SURE_OVERLAP = 0.6, 0.9
"""Overlap of a part's colours in one camera with those in the others, relative to the camera's best part, below which
only the others' colours count, and above which only its own do. Chosen by hand on three takes: parts that another
person hides have 0.1 to 0.5, visible parts 0.64 to 1."""
WHOLE_SHARE, UNIFORM_SHARE = 0.08, 0.02
"""Shares of the colours of the whole body and of unknown colours in the density of a part. Chosen by hand."""
RING = (6, 60)
"""Distances from the body between which the colours of its surroundings are learned, at 640 x 480 [px]. Chosen by
hand."""
RING_SCALE = 554.0
"""Square root of the number of pixels of the images to which `RING` belongs [px]."""
HIDDEN_BELOW = -0.5
"""Mean log-likelihood ratio of part and surroundings below which the part is hidden. With it, three quarters of what
another person hides in a camera of `office` are found, but only 6 to 27 % of it in `market`, where the clothes of the
two people have similar colours; at most 2 % of what is visible is lost."""
SMOOTHING = 140.0
"""Square root of the image's area over the standard deviation of the mean above: 4 px at 640 x 480."""
LARGEST_RATIO = 4.0
"""Limit of a pixel's log-likelihood ratio. Chosen by hand."""


@dataclass(frozen=True, eq=False)
class PartColours:
    """Densities of the colours of P parts in one camera."""

    density: Floats
    """(P, ...) one density of `colour_density` per part."""
    texture: Floats | None = None
    """(P, K) densities of K texture cells; None if no textures were added."""

    def __post_init__(self) -> None:
        freeze_fields(self, "density", *(() if self.texture is None else ("texture",)), dtype=np.float32)


class PartColourCounts:
    """Colours of the parts in all cameras, collected from images of posed bodies.

    Args:
        cameras: Number of cameras C.
        parts: Number of parts P.
        channels: Number of channels of the images: 1 or 3.
        textures: Number of texture cells K; 0 if no textures are added.
    """

    def __init__(self, cameras: int, parts: int, channels: int, textures: int = 0):
        shape = (256 >> COLOUR_SHIFT,) * 3 if channels == 3 else (256,)
        self._uniform = COMMON[channels] * 256.0**-channels
        self._volume = float(1 << 3 * COLOUR_SHIFT) if channels == 3 else 1.0
        self._sums = np.zeros((cameras, parts, *shape), np.float32)
        self._textures = np.zeros((cameras, parts, textures), np.float32)
        self._areas, self._textured = np.zeros((cameras, parts)), np.zeros((cameras, parts))

    def add(self, camera: int, image: Image, parts: Integers, area: float, cells: Integers | None = None) -> None:
        """Add an image.

        Args:
            camera: Number of the camera.
            image: (H, W, C) uint8.
            parts: (H, W) part at each pixel well inside the body; -1 elsewhere.
            area: Area that a pixel covers at the body [m2].
            cells: (H, W) texture cell of each pixel, -1 where it is not to be used; None if no textures are added.
        """
        for part in range(self._sums.shape[1]):
            region = parts == part
            pixels = int(np.count_nonzero(region))
            if pixels >= LEAST_PIXELS:
                self._sums[camera, part] += colour_density(image, region) * np.float32(pixels * area)
                self._areas[camera, part] += pixels * area
                if cells is not None:
                    own = cells[region & (cells >= 0)]
                    seen = np.bincount(own, minlength=self._textures.shape[2]).astype(np.float32)
                    self._textures[camera, part] += seen * np.float32(area)
                    self._textured[camera, part] += len(own) * area

    def learned(self) -> list[PartColours]:
        """Return the colours in each camera: its own as far as they agree with those in the other cameras."""
        axes = tuple(range(2, self._sums.ndim))
        grown = self._areas.reshape(*self._areas.shape, *(1,) * len(axes))
        own = self._sums / np.maximum(grown, 1e-12)
        elsewhere = self._areas.sum(0) - self._areas
        others = (self._sums.sum(0) - self._sums) / np.maximum(elsewhere.reshape(grown.shape), 1e-12)
        overlap = np.sqrt(own * others).sum(axis=axes) * self._volume
        known = (self._areas > 0) & (elsewhere > 0)
        best = np.max(np.where(known, overlap, 0.0), axis=1, keepdims=True)
        trust = (overlap / np.maximum(best, 1e-6) - DOUBTFUL_OVERLAP) / (SURE_OVERLAP - DOUBTFUL_OVERLAP)
        trust = np.where(elsewhere > 0, np.where(self._areas > 0, np.clip(trust, 0.0, 1.0), 0.0), 1.0)
        density = self._mixed(self._sums, self._areas, trust, np.float32(self._uniform))
        if self._textures.shape[2] == 0:
            return [PartColours(each) for each in density]
        texture = self._mixed(self._textures, self._textured, trust, np.float32(1 / self._textures.shape[2]))
        return [PartColours(*each) for each in zip(density, texture, strict=True)]

    def _mixed(self, sums: Floats, areas: Floats, trust: Floats, uniform: np.float32) -> Floats:
        """Return each camera's densities, mixed with the others' by trust (C, P), the whole body's and unknown ones."""
        shape = (*areas.shape, *(1,) * (sums.ndim - 2))
        own = sums / np.maximum(areas.reshape(shape), 1e-12)
        elsewhere = (areas.sum(0) - areas).reshape(shape)
        others = (sums.sum(0) - sums) / np.maximum(elsewhere, 1e-12)
        mixed = trust.reshape(shape) * own + (1 - trust.reshape(shape)) * others
        whole = mixed.mean(axis=1, keepdims=True)
        return np.asarray((1 - WHOLE_SHARE - UNIFORM_SHARE) * mixed + WHOLE_SHARE * whole + UNIFORM_SHARE * uniform)


def hidden_region(image: Image, parts: Integers, colours: PartColours) -> Mask:
    """Return the pixels of a drawn body whose colours are those of the surroundings rather than of their part.

    Args:
        image: (H, W, C) uint8.
        parts: (H, W) part at each pixel of the drawn body; -1 elsewhere.
        colours: Colours of the parts in this camera.

    Returns:
        (H, W) true where something hides the body.
    """
    drawn = parts >= 0
    hidden = np.zeros_like(drawn)
    if not drawn.any():
        return hidden
    scale = float(np.sqrt(drawn.size))
    # Farther than the ring and twice the blur reach, nothing changes the result.
    box = box_about(drawn, max(RING[1] * scale / RING_SCALE, 10 * scale / SMOOTHING) + 2)
    image, parts, inside = image[box], parts[box], np.ascontiguousarray(drawn[box])
    away = cv2.distanceTransform((~inside).view(np.uint8), cv2.DIST_L2, 3) * (RING_SCALE / scale)
    around = colour_density(image, (away > RING[0]) & (away < RING[1]))
    uniform = COMMON[image.shape[2]] * 256.0 ** -image.shape[2]
    around = (1 - UNIFORM_SHARE) * around + UNIFORM_SHARE * uniform
    cells = _cells(image[inside])
    likely = np.log(np.maximum(colours.density[(parts[inside], *cells)], 1e-30)) - np.log(around[cells])
    ratio = np.zeros(inside.shape, np.float32)
    ratio[inside] = np.clip(likely, -LARGEST_RATIO, LARGEST_RATIO)
    sd = scale / SMOOTHING
    total = cv2.GaussianBlur(inside.astype(np.float32), (0, 0), sd)
    mean = cv2.GaussianBlur(ratio, (0, 0), sd) / np.maximum(total, 1e-3)
    hidden[box] = inside & (mean < HIDDEN_BELOW)
    return hidden


def _cells(pixels: np.ndarray) -> tuple[Integers, ...]:
    """Return the indices of the colours of pixels (n, C) in a density."""
    if pixels.shape[1] == 1:
        return (pixels[:, 0].astype(np.int64),)
    return tuple((pixels[:, c] >> COLOUR_SHIFT).astype(np.int64) for c in range(3))


def joined_hidden(hidden: Mask, drawn: Mask, found: Mask, slack: float) -> Mask:
    """Return what is hidden by its colours, because the silhouette lacks it deep inside the body, or beside these.

    A silhouette often includes a narrow strip of the thing that hides the body, outside the drawn body.

    Args:
        hidden: (H, W) from `hidden_region`.
        drawn: (H, W) the drawn body; not empty.
        found: (H, W) the silhouette.
        slack: Depth inside the drawn body from which on a missing pixel is hidden [px].
    """
    joined = np.zeros_like(drawn)
    box = box_about(drawn | found | hidden, 2)
    hidden, drawn, found = (np.ascontiguousarray(mask[box]) for mask in (hidden, drawn, found))
    depth = cv2.distanceTransform(drawn.view(np.uint8), cv2.DIST_L2, 3)
    inside = hidden | ((depth > slack) & ~found)
    outside = np.ascontiguousarray(~drawn).view(np.uint8)
    _, nearest = cv2.distanceTransformWithLabels(outside, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    hidden_at = np.zeros(int(nearest.max()) + 1, bool)
    hidden_at[nearest[drawn]] = inside[drawn]
    joined[box] = inside | (found & ~drawn & hidden_at[nearest])
    return joined

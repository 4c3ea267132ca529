"""Evidence of colours and textures that depends on the place: of the nearest part of the body, and of the surroundings.

[Rosenhahn2006] section 2.1 knows one density for the person and one for everything else. Clothes, skin and hair differ,
and so do the regions of a room: a colour that is frequent in the trousers is none of the head's, and one that is
frequent on the far side of the room says little about a pixel here.
"""

import cv2
import numpy as np

from marey.arrays import Floats, Image, Integers, Mask
from marey.compiled.kernels import kernel
from marey.images.boxes import Box, box_about
from marey.images.features.texture import CELLS, halved_texture_cells, smoothed_counts
from marey.images.silhouettes.densities import COLOUR_SHIFT, LocalDensities
from marey.images.silhouettes.part_colours import PartColours

PART_SHARE = 0.8
"""Weight of the densities of the parts beside that of the whole person in this camera's last images. The latter follows
changes of the light; with 0.5 to 1, the overlap with the true silhouettes of three takes differs by at most 0.0007."""
TILE = 24
"""Side of the tiles in which the surroundings are learned [px at 640 x 480]. From the preliminary study of rooms
without a plate."""
TILE_PIXELS = 100.0
"""Weight of the density of all surroundings beside those near a pixel, as a number of pixels. Chosen by hand."""
TEXTURE_WEIGHT = 0.25
"""Weight of the log-likelihood ratio of the textures, below one because neighbouring pixels share their texture. With
0.25 to 1, the overlap with the true silhouettes of three takes differs by at most 0.001; 0.5 moves the border outwards
by more than 0.25."""
TEXTURE_LIMIT = 2.0
"""Largest weighted log-likelihood ratio of a pixel's texture. Chosen by hand."""
EDGE = 4.0
"""Distance from an outline within which no textures are learned, because the outline itself looks like one [px]."""
RARE = np.float32(1e-3)
"""Probability that is added to that of each texture cell: of rarer ones the ratio says little. Chosen by hand."""
REACH = 0.06
"""Distance beyond the slack within which evidence is computed, as a share of the image's longer side: a little more
than the level set may move."""
_COARSE_SHIFT = 4
"""Binary logarithm of the side of a colour cell of a tile [grey levels]: fewer pixels need larger cells."""


def part_evidence(image: Image, parts: Integers, colours: PartColours, slack: float) -> LocalDensities:
    """Evaluate colours and textures of an image near a drawn body.

    Args:
        image: (H, W, C) uint8.
        parts: (H, W) part at each pixel of the drawn body; -1 outside. The body must not be empty.
        colours: Densities of the parts in this camera.
        slack: Distance from the body up to which a pixel may be the person's [px].

    Returns:
        The evidence.

    Raises:
        ValueError: The body is empty, or has another size than the image.
    """
    if parts.shape != image.shape[:2]:
        raise ValueError(f"the drawn body has the shape {parts.shape}, but the image {image.shape[:2]}")
    if not (parts >= 0).any():
        raise ValueError("the drawn body is empty")
    reach = REACH * max(parts.shape) + slack
    box = box_about(parts >= 0, reach)
    picture, drawn = np.ascontiguousarray(image[box]), np.ascontiguousarray(parts[box])
    nearest, away = nearest_part(drawn)
    outside, used = away > slack, away < reach
    tile = max(8, round(TILE * float(np.sqrt(parts.size)) / 554.0))
    colour = colour_cells(picture, COLOUR_SHIFT)
    density = colours.density.reshape(len(colours.density), -1)
    coarse, count, volume = _coarse(picture)
    around, share = _near_density(coarse, outside, used, tile, count, np.float32(TILE_PIXELS))
    texture = (
        None
        if colours.texture is None
        else _texture_ratio(picture, nearest, away > slack + EDGE, used, tile, colours.texture)
    )
    return LocalDensities(
        person=_placed(density[nearest, colour], box, parts.shape),
        person_share=_placed(np.full(drawn.shape, PART_SHARE, np.float32), box, parts.shape),
        surroundings=_placed(around / np.float32(volume), box, parts.shape),
        surroundings_share=_placed(share, box, parts.shape),
        texture=None if texture is None else _placed(texture, box, parts.shape),
    )


def _texture_ratio(picture: Image, nearest: Integers, outside: Mask, used: Mask, tile: int, textures: Floats) -> Floats:
    """Return the weighted log-likelihood ratio of the textures of the nearest part and of the surroundings."""
    cells = halved_texture_cells(picture)
    nearest, outside, used = nearest[::2, ::2], outside[::2, ::2], used[::2, ::2]
    ratio = np.log(smoothed_counts(textures) + RARE)[nearest, cells]
    ratio -= np.log(_texture_around(cells, outside, used, tile // 2) + RARE)
    ratio = np.where(used, np.clip(np.float32(TEXTURE_WEIGHT) * ratio, -TEXTURE_LIMIT, TEXTURE_LIMIT), np.float32(0))
    return np.asarray(cv2.resize(ratio, picture.shape[1::-1], interpolation=cv2.INTER_NEAREST))


def nearest_part(parts: Integers) -> tuple[Integers, Floats]:
    """Return the part nearest to each pixel (H, W), and the distance from the body (H, W) [px]."""
    inside = parts >= 0
    outside = np.ascontiguousarray(~inside).view(np.uint8)
    away, label = cv2.distanceTransformWithLabels(outside, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    part_of = np.zeros(int(label.max()) + 1, np.int16)
    part_of[label[inside]] = parts[inside]
    return part_of[label], np.asarray(away)


def colour_cells(image: Image, shift: int) -> Integers:
    """Return the index of each pixel's colour cell (H, W) in a flattened density, with cells of side 2^shift."""
    if image.shape[2] == 1:
        return np.asarray(image[..., 0] if shift == COLOUR_SHIFT else image[..., 0] >> shift, np.int32)
    bits = 8 - shift
    blue, green, red = (np.asarray(image[..., c] >> shift, np.int32) for c in range(3))
    return np.asarray((blue << 2 * bits) + (green << bits) + red)


def _coarse(image: Image) -> tuple[Integers, int, float]:
    """Return coarse colour cells (H, W), their number, and the number of colours in one."""
    channels = image.shape[2]
    return colour_cells(image, _COARSE_SHIFT), (256 >> _COARSE_SHIFT) ** channels, float(1 << channels * _COARSE_SHIFT)


def _texture_around(cells: Integers, outside: Mask, used: Mask, tile: int) -> Floats:
    counts = np.bincount(cells[outside], minlength=CELLS).astype(np.float32)
    whole = smoothed_counts(counts + np.float32(1.0)) / (counts.sum() + CELLS)
    density, share = _near_density(cells, outside, used, tile, CELLS, np.float32(TILE_PIXELS / 4))
    return np.asarray(share * density + (1 - share) * whole[cells])


def _placed(part: Floats, box: Box, shape: tuple[int, ...]) -> Floats:
    whole = np.zeros(shape, np.float32)
    whole[box] = part
    return whole


@kernel
def _near_density(cells, outside, used, tile, count, prior):
    """Return the density of each used pixel's cell in the 3 x 3 tiles about it, and its share beside a prior."""
    height, width = cells.shape
    rows, columns = (height + tile - 1) // tile, (width + tile - 1) // tile
    tile_of = np.arange(max(height, width)) // tile
    # Small numbers keep the table in the cache; a margin of empty tiles replaces the limits.
    counts, totals = np.zeros((rows + 2, columns + 2, count), np.uint16), np.zeros((rows + 2, columns + 2), np.int32)
    for y in range(height):
        i = tile_of[y] + 1
        for x in range(width):
            if outside[y, x]:
                counts[i, tile_of[x] + 1, cells[y, x]] += 1
                totals[i, tile_of[x] + 1] += 1
    density, share = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    around = np.zeros(columns, np.int32)
    for y in range(height):
        i = tile_of[y]
        if y % tile == 0:
            for j in range(columns):
                around[j] = totals[i : i + 3, j : j + 3].sum()
        for x in range(width):
            if not used[y, x]:
                continue
            j, cell, found = tile_of[x], cells[y, x], 0
            for k in range(3):
                for m in range(3):
                    found += counts[i + k, j + m, cell]
            density[y, x] = np.float32(found) / np.float32(max(around[j], 1))
            share[y, x] = np.float32(around[j]) / (np.float32(around[j]) + prior)
    return density, share

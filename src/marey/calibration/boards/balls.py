"""Finding of bright or coloured balls in pictures, and of the wand among them."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from scipy.spatial import cKDTree

from marey.arrays import Floats, Image, Integers, Mask, freeze_fields
from marey.calibration.boards.corner_errors import image_noise
from marey.calibration.boards.corners import BoardSighting
from marey.calibration.boards.wand import CalibrationWand

_HUES = {"red": 0, "orange": 12, "yellow": 28, "green": 60, "cyan": 90, "blue": 118, "magenta": 150}
"""Hues of the colours, in OpenCV's half degrees."""
_HUE_WIDTH = 11
"""Difference of a hue from that of its colour up to which a pixel belongs to it, in half degrees; chosen by hand."""
_SURROUNDINGS = 0.03
"""Half width of the surroundings from which a ball stands out, in longer sides of the image; chosen by hand."""
_REDUCED = 4
"""Factor by which the image is reduced to find the level of the surroundings; chosen by hand."""
_LEAST_RESPONSE = 30.0
"""Least difference of a ball from its surroundings [grey levels]; chosen by hand."""
_SHARE = 0.45
"""Share of the greatest difference of the picture from which a pixel belongs to a ball; chosen by hand."""
_AREA = (5, 0.004)
"""Smallest area of a ball [px], and largest as a share of the image; chosen by hand."""
_FILL = (0.75, 1.25)
"""Range of the ratio of a ball's area to that of the ellipse with its moments; chosen by hand."""
_LONGEST = 2.0
"""Largest ratio of the axes of a ball's image, which motion lengthens; chosen by hand."""
_MOST_BLOBS = 12
"""Number of spots of a picture in which the wand is searched, the strongest; chosen by hand."""
_STATIC_PX = 1.5
"""Distance up to which spots of several pictures are at the same place [px]; chosen by hand."""
_STATIC_SHARE = 0.4
"""Share of a camera's pictures from which spots at one place are lamps or reflections; chosen by hand."""
_ASIDE = 0.04
"""Distance of the middle ball from the line of the others, as a share of their distance; chosen by hand."""
_RATIO = 0.15
"""Difference of the middle ball's place from that on the stick, as a share of its length: perspective moves it. By
hand."""
_SIZES = 3.0
"""Largest ratio of the areas of two balls of a wand; chosen by hand."""
_LEAST_SD = 0.05
"""Smallest standard deviation of the centre of a ball [px]; chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Spots:
    """Round spots of one colour in one picture, the strongest first."""

    pixels: Floats
    """(n, 2) centres [px]."""
    variance: Floats
    """(n,) of each coordinate [px2]."""
    area: Floats
    """(n,) [px]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "pixels", "variance", "area")

    def __len__(self) -> int:
        return len(self.pixels)

    def subset(self, keep: Mask) -> "Spots":
        """Return some of the spots.

        Args:
            keep: (n,) true for those to keep.
        """
        return Spots(pixels=self.pixels[keep], variance=self.variance[keep], area=self.area[keep])


def find_spots(image: Image, colour: str) -> Spots:
    """Find round spots that are brighter than their surroundings, or of a colour.

    Args:
        image: (H, W, 3) blue, green, red.
        colour: One of `marey.calibration.boards.wand.COLOURS`.

    Returns:
        The spots.
    """
    response = _response(image, colour)
    greatest = float(response.max(initial=0.0))
    if greatest < _LEAST_RESPONSE:
        return _no_spots()
    mask = (response > _SHARE * greatest).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    noise = image_noise(np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8))
    limit = _AREA[1] * mask.size
    found = []
    for k in range(1, count):
        x, y, width, height, area = (int(each) for each in stats[k])
        inside = x > 0 and y > 0 and x + width < mask.shape[1] and y + height < mask.shape[0]
        if _AREA[0] <= area <= limit and inside and max(width, height) <= 3 * min(width, height) + 2:
            box = slice(max(y - 2, 0), y + height + 2), slice(max(x - 2, 0), x + width + 2)
            spot = _measured(response[box].astype(float), np.asarray(labels[box], np.int64), k, noise)
            if spot is not None:
                found.append((spot[0] + [box[1].start, box[0].start], spot[1], float(area), spot[2]))
    found = sorted(found, key=lambda each: -each[3])[:_MOST_BLOBS]
    if not found:
        return _no_spots()
    return Spots(
        pixels=np.array([each[0] for each in found]), variance=np.array([each[1] for each in found]),
        area=np.array([each[2] for each in found]),
    )  # fmt: skip


def _no_spots() -> Spots:
    return Spots(pixels=np.zeros((0, 2)), variance=np.zeros(0), area=np.zeros(0))


def _response(image: Image, colour: str) -> Image:
    """Return how much each pixel (H, W) stands out [grey levels]."""
    if colour == "bright":
        blue, green, red = cv2.split(image)
        grey = cv2.min(cv2.min(blue, green), red)
    else:
        hsv = cv2.cvtColor(image, cv2.COLOR_BGR2HSV).astype(np.float32)
        apart = np.abs((hsv[..., 0] - _HUES[colour] + 90) % 180 - 90)
        grey = np.where(apart <= _HUE_WIDTH, hsv[..., 1] * hsv[..., 2] / 255.0, 0.0).astype(np.uint8)
    # The level of the surroundings, not of the ball: the lowest one near, found in a reduced image.
    small = cv2.resize(grey, None, fx=1 / _REDUCED, fy=1 / _REDUCED, interpolation=cv2.INTER_AREA)
    half = max(int(_SURROUNDINGS * max(small.shape)), 3)
    around = cv2.blur(cv2.erode(small, np.ones((half, half))), (half, half))
    return np.asarray(cv2.subtract(grey, cv2.resize(around, grey.shape[::-1])), np.uint8)


def _measured(response: Floats, labels: Integers, number: int, noise: float) -> tuple[Floats, float, float] | None:
    """Return centre (2,), variance and strength of a spot; None if it is not round."""
    own = labels == number
    y, x = np.nonzero(own)
    spread = np.cov(np.stack([x, y]).astype(float)) + np.eye(2) / 12
    values = np.linalg.eigvalsh(spread)
    fill = len(x) / (4 * np.pi * np.sqrt(values[0] * values[1]))
    if not (_FILL[0] < fill < _FILL[1] and values[1] < _LONGEST**2 * values[0]):
        return None
    grown = cv2.dilate(own.astype(np.uint8), np.ones((5, 5))).astype(bool) & ((labels == 0) | own)
    level = float(np.min(response[grown]))
    weight = np.where(grown, response - level, 0.0)
    total = float(weight.sum())
    rows, columns = np.mgrid[: response.shape[0], : response.shape[1]]
    centre = np.array([(weight * columns).sum(), (weight * rows).sum()]) / total
    apart = np.square(columns - centre[0])[grown].sum() + np.square(rows - centre[1])[grown].sum()
    variance = noise**2 * 0.5 * float(apart) / total**2 + _LEAST_SD**2
    return centre, variance, float(response[own].mean())


def moving_spots(spots: Sequence[Spots]) -> list[Spots]:
    """Remove spots that are at the same place in many pictures of a camera: lamps, windows and reflections.

    Args:
        spots: The spots of all pictures of one camera.

    Returns:
        The others.
    """
    every = np.concatenate([each.pixels for each in spots]) if spots else np.zeros((0, 2))
    if len(spots) < 4 or not len(every):
        return list(spots)
    tree = cKDTree(every)
    limit = max(4.0, _STATIC_SHARE * len(spots))
    kept = []
    for each in spots:
        near = np.array(tree.query_ball_point(each.pixels, _STATIC_PX, return_length=True), float)
        kept.append(each.subset(np.reshape(near, len(each)) < limit))
    return kept


def wand_among(spots: Sequence[Spots], wand: CalibrationWand) -> BoardSighting | None:
    """Find the wand among the spots of one picture.

    Args:
        spots: The spots of each colour of the wand, see `CalibrationWand.colours`.
        wand: The wand.

    Returns:
        The centres of its balls; None if it is not there, or several groups of spots could be it.
    """
    marks = len(wand.points)
    of_mark = [spots[k if len(spots) > 1 else 0] for k in range(marks)]
    found = [chosen for chosen in _choices(of_mark) if _is_wand(chosen, of_mark, wand)]
    found = _without_reversed(found, of_mark, wand)
    if len(found) != 1:
        return None
    pixels = np.array([of_mark[k].pixels[j] for k, j in enumerate(found[0])])
    variance = np.array([of_mark[k].variance[j] for k, j in enumerate(found[0])])
    return BoardSighting(corner=np.arange(marks), pixels=pixels, covariance=variance[:, None, None] * np.eye(2))


def _choices(of_mark: Sequence[Spots]) -> list[tuple[int, ...]]:
    """List the choices of one spot for each ball; of balls of one colour, each spot once."""
    same = all(each is of_mark[0] for each in of_mark)
    if same:
        groups = combinations(range(len(of_mark[0])), len(of_mark))
        return [order for group in groups for order in _orders(group)]
    choices: list[tuple[int, ...]] = [()]
    for mark, each in enumerate(of_mark):
        choices = [
            (*chosen, j) for chosen in choices for j in range(len(each))
            if not any(of_mark[k] is each and chosen[k] == j for k in range(mark))
        ]  # fmt: skip
    return choices


def _orders(group: tuple[int, ...]) -> list[tuple[int, ...]]:
    """Return the orders of spots: of two just one, of three each in the middle, both ways round."""
    if len(group) == 2:
        return [group]
    a, b, c = group
    return [(a, b, c), (c, b, a), (b, a, c), (c, a, b), (a, c, b), (b, c, a)]


def _is_wand(chosen: tuple[int, ...], of_mark: Sequence[Spots], wand: CalibrationWand) -> bool:
    area = [of_mark[k].area[j] for k, j in enumerate(chosen)]
    if max(area) > _SIZES * min(area):
        return False
    if len(chosen) == 2:
        return True
    aside, place = _middle(chosen, of_mark)
    return aside < _ASIDE and abs(place - wand.distances[0] / sum(wand.distances)) < _RATIO


def _middle(chosen: tuple[int, ...], of_mark: Sequence[Spots]) -> tuple[float, float]:
    """Return the distance of the middle ball from the line of the others, and its place between them."""
    first, middle, last = (of_mark[k].pixels[j] for k, j in enumerate(chosen))
    along = last - first
    square = max(float(along @ along), 1e-9)
    across = along[0] * (middle - first)[1] - along[1] * (middle - first)[0]
    return abs(float(across)) / square, float((middle - first) @ along) / square


def _without_reversed(
    found: list[tuple[int, ...]], of_mark: Sequence[Spots], wand: CalibrationWand
) -> list[tuple[int, ...]]:
    """Of two choices that differ in their direction only, keep that whose middle ball is nearer to its place."""
    best: dict[tuple[int, ...], tuple[float, tuple[int, ...]]] = {}
    for chosen in found:
        key = tuple(sorted(chosen))
        ratio = wand.distances[0] / sum(wand.distances)
        off = abs(_middle(chosen, of_mark)[1] - ratio) if len(chosen) == 3 else 0.0
        if key not in best or off < best[key][0]:
            best[key] = off, chosen
    return [chosen for _, chosen in best.values()]


def without_ball_size(pixels: Floats, seen: Floats, focal: Floats, radius: float) -> Floats:
    """Return the projections of the centres of balls, from the centres of their images.

    The image of a ball of radius r is an ellipse, whose centre lies at (x / z) z^2 / (z^2 - r^2).

    Args:
        pixels: (n, 2) centres of the images [px].
        seen: (n, 3) centres of the balls in camera axes [m].
        focal: (n, 2) focal lengths [px].
        radius: Of the balls [m].

    Returns:
        (n, 2) [px].
    """
    excess = radius**2 / np.maximum(seen[:, 2:] ** 2 - radius**2, radius**2)
    return np.asarray(pixels - focal * seen[:, :2] / seen[:, 2:] * excess)

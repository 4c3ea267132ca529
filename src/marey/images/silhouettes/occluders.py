"""Things that stand in front of the person through a whole take, recognised from what they hide.

A pixel that a body covers again and again and that never shows it is hidden by something nearer to the camera. The
distance of the body decides too: what hides a person who is far away stands behind one who is near.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from marey.arrays import Floats, Integers, Mask, freeze_fields


@dataclass(frozen=True, kw_only=True)
class OccluderSettings:
    """What counts as a thing that hides the person."""

    least_covered: int = 5
    """Least number of images in which the body covers a pixel. Chosen by hand."""
    most_seen: float = 0.1
    """Largest share of these images in which the pixel shows the person. Chosen by hand; other values were not
    measured."""
    miss: float = 2.0
    """Log-likelihood ratio of something in front from an image that does not show the person at the pixel [nat]: the
    body covers 10 to 15 % of the pixels near its border wrongly. Chosen by hand."""
    least_area: float = 0.01
    """Least area of a thing relative to the person's usual area. Chosen by hand: with it and the other values, nothing
    is found in `walk`, `jacks` and `stealth` as they are, and 97 to 99 % of what made things hide in them."""


@dataclass(frozen=True, eq=False)
class StaticOccluder:
    """What stands in front of the person in one camera through the whole take."""

    nearest_m: Floats
    """(H, W) distance from the camera from which on a body is hidden [m]; infinite where nothing hides it."""

    def __post_init__(self) -> None:
        freeze_fields(self, "nearest_m", dtype=np.float32)

    def hides(self, distance_m: Floats | float) -> Mask:
        """Return the pixels (H, W) at which a body at a distance, or at one for each pixel (H, W), is hidden [m]."""
        return np.asarray(distance_m >= self.nearest_m)

    @property
    def share(self) -> float:
        """Share of the image in which something hides the person, at some distance at least."""
        return float(np.isfinite(self.nearest_m).mean())

    def resized(self, size: tuple[int, int]) -> "StaticOccluder":
        """Return the same thing in an image of another width and height."""
        if size == self.nearest_m.shape[::-1]:
            return self
        return StaticOccluder(np.asarray(cv2.resize(self.nearest_m, size, interpolation=cv2.INTER_NEAREST)))


LEAST_BEFORE = 5
"""Least width of a part of the person that is seen before a thing [px]: narrower ones are errors of the silhouette at
its border. Chosen by hand."""


def divided(silhouette: Mask, behind: Mask) -> tuple[Mask, Mask]:
    """Divide a region in which a thing may hide the person by what the image shows.

    Args:
        silhouette: (H, W) the silhouette, found from the image without the thing.
        behind: (H, W) where the thing stands in front of the body.

    Returns:
        The silhouette without narrow parts in the region, and the rest of the region, in which the person is hidden.
    """
    window = np.ones((LEAST_BEFORE, LEAST_BEFORE), np.uint8)
    before = cv2.morphologyEx((silhouette & behind).view(np.uint8), cv2.MORPH_OPEN, window) > 0
    hidden = behind & ~before
    return silhouette & ~hidden, hidden


class CoverCounts:
    """In how many images a body at some distance covers each pixel of a camera, and in how many of them it is seen.

    Args:
        size: Width and height of the images.
        edges_m: (B + 1,) limits of the B classes of distance, ascending [m].
    """

    def __init__(self, size: tuple[int, int], edges_m: Floats):
        self._edges_m = np.asarray(edges_m, float)
        # For each class and pixel: images in which the body covers it for certain, in which it is seen there, in which
        # it may cover the pixel, and in which it is seen then.
        self._counts: Integers = np.zeros((4, len(edges_m) - 1, size[1], size[0]), np.int16)
        self._areas: list[int] = []

    def add(self, distance_m: Floats, certain: Mask, seen: Mask) -> None:
        """Add an image.

        Args:
            distance_m: (H, W) distance of the body from the camera; infinite where it does not cover the pixel [m].
            certain: (H, W) true where the body covers the pixel for certain.
            seen: (H, W) the silhouette.
        """
        rows, columns = np.nonzero(np.isfinite(distance_m))
        place = np.searchsorted(self._edges_m, distance_m[rows, columns], side="right") - 1
        place = np.clip(place, 0, len(self._edges_m) - 2)
        sure, shown = certain[rows, columns], seen[rows, columns]
        for count, added in zip(self._counts, (sure, sure & shown, True, shown), strict=True):
            count[place, rows, columns] += added
        self._areas.append(int(np.count_nonzero(seen)))

    def occluder(self, settings: OccluderSettings) -> StaticOccluder:
        """Return what hides the person.

        For each pixel the distance is chosen beyond which the body is most probably hidden. The core of a thing is
        where a body covers enough images for certain. Connected with it are the pixels that the body may cover and that
        never show it.

        Args:
            settings: What counts as a thing.
        """
        certain, shown, possible, seen = np.cumsum(self._counts[:, ::-1], axis=1, dtype=np.int16)[:, ::-1]
        hit = settings.miss * (1 - settings.most_seen) / settings.most_seen
        gain = np.float32(settings.miss) * (certain - shown) - np.float32(hit) * shown
        gain = np.where((certain >= settings.least_covered) & (gain > 0), gain, 0)
        best = np.argmax(gain, axis=0)
        core = self._large(gain.max(axis=0) > 0, settings)
        nearest_m = np.full(core.shape, np.inf, np.float32)
        if core.any():
            outside = np.ascontiguousarray(~core).view(np.uint8)
            _, label = cv2.distanceTransformWithLabels(outside, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
            class_of = np.zeros(int(label.max()) + 1, np.int64)
            class_of[label[core]] = best[core]
            first = class_of[label]
            never = _of_class(possible, first) > _of_class(seen, first) / settings.most_seen
            region = _connected(never | core, core)
            nearest_m[region] = np.where(first == 0, 0.0, self._edges_m[first])[region]
        return StaticOccluder(nearest_m)

    def _large(self, candidates: Mask, settings: OccluderSettings) -> Mask:
        """Return the candidates without specks and small parts."""
        least = settings.least_area * float(np.median([area for area in self._areas if area] or [0]))
        opened = cv2.morphologyEx(candidates.view(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
        _, labels, stats, _ = cv2.connectedComponentsWithStats(opened)
        large = stats[:, cv2.CC_STAT_AREA] >= max(least, 1.0)
        large[0] = False
        return np.asarray(large[labels])


def _of_class(counts: Integers, chosen: Integers) -> Integers:
    """Return the counts (B, H, W) of the chosen class of each pixel (H, W)."""
    return np.asarray(np.take_along_axis(counts, chosen[None], 0)[0])


def _connected(region: Mask, core: Mask) -> Mask:
    """Return the part of a region (H, W) that is connected with a core inside it, without narrow parts."""
    window = np.ones((LEAST_BEFORE, LEAST_BEFORE), np.uint8)
    wide = cv2.morphologyEx(region.view(np.uint8), cv2.MORPH_OPEN, window) | core.view(np.uint8)
    _, labels = cv2.connectedComponents(wide)
    kept = np.zeros(int(labels.max()) + 1, bool)
    kept[np.unique(labels[core])] = True
    return np.asarray(kept[labels] & (wide > 0))

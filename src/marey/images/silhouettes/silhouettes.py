"""Level-set segmentation of a person against a background model, from coarse to fine."""

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import cv2
import numpy as np

from marey.arrays import Mask
from marey.compiled.kernels import kernel
from marey.images.silhouettes.background import (
    BACKGROUND_DEFAULTS,
    Background,
    BackgroundSettings,
    Exposure,
    exposed,
    exposure,
    part,
)
from marey.images.silhouettes.densities import (
    Appearance,
    LocalDensities,
    blended,
    colour_density,
    shadow_density,
    unknown,
)
from marey.images.silhouettes.edges import edge_evidence
from marey.images.silhouettes.evidence import LIMIT, evidence
from marey.images.silhouettes.level_sets import evolve, evolve_coarse_to_fine, region_energy

TEXTURE_WIDTH = 4
"""Distance from the border within which texture does not place it: a texture is measured over several pixels, and the
border itself looks like one [px]."""


@dataclass(frozen=True, kw_only=True)
class SilhouetteSettings:
    """Settings of the segmentation of a person.

    The defaults were chosen by hand unless a field says otherwise; results were not measured against other values.
    """

    length: float = 4.0
    """Weight of the border's length: the evidence (a log-ratio) that a single pixel needs to differ from all its
    neighbours."""
    edge_length: float = 2.0
    """Weight of the border's length in the last step, which only places the border between known sides. Without that
    step `walk` is 11.7 instead of 6.6 mm (docs/accuracy/rejected.md); other weights were not measured."""
    halvings: int = 2
    """Number of halvings of the image for the coarsest evolution: by default it has 1/4 of the width and height."""
    rounds: int = 4
    """Number of alternations between densities and regions if the person's colours are unknown."""
    reduction: int = 4
    """Factor by which the image is reduced for the first search of a person if no start is given."""
    least_reduced: int = 60
    """Least number of rows and columns of a reduced image for this search."""
    learning: float = 0.2
    """Weight of a new image in the densities that are passed on to the next image."""
    sure: float = 2.0
    """Least evidence for the person of the pixels from which the person's colours are estimated."""
    gap_share: float = 0.025
    """Largest gap between regions that count as one, as a share of the square root of the image area: in front of
    background of its own colour a limb is split into pieces. Without such joining the worst 95th percentile of the
    joints of `jacks` was 105 instead of 31 mm; the script was not kept."""
    least_person_share: float = 0.0015
    """Regions below this fraction of the image area are discarded."""
    fragment_share: float = 0.02
    """Least area of a separate region of the person, as a share of the largest region's."""
    background: BackgroundSettings = BACKGROUND_DEFAULTS
    """Settings of the exposure of an image relative to the background."""


SILHOUETTE_DEFAULTS = SilhouetteSettings()
"""Default settings of the segmentation of a person."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Silhouette:
    """Silhouette of the person in one image, and the state for the camera's next image.

    Args:
        mask: (H, W) true where the person is; all false if no person was detected.
        appearance: Densities of the colours in both regions.
        exposure: Exposure of this image relative to the background.
        energy: The energy of the region, [Rosenhahn2006] eq. (3), relative to that of no person [nat]: the image's
            evidence, the prior, and the border's length.
    """

    mask: Mask
    appearance: Appearance
    exposure: Exposure
    energy: float = 0.0


def segment(
    image: np.ndarray,
    background: Background,
    *,
    start: Mask | None = None,
    before: Silhouette | None = None,
    prior: np.ndarray | None = None,
    ignored: Mask | None = None,
    local: LocalDensities | None = None,
    settings: SilhouetteSettings = SILHOUETTE_DEFAULTS,
) -> Silhouette:
    """Segment the person in an image by level sets, [Rosenhahn2006] eq. (1)-(2).

    The energy is that of the paper: minus the log of both regions' densities, plus the border's length. The densities
    are smoothed histograms of colour, estimated alternately with the regions. Unlike the paper, the density outside is
    that of the background model at the pixel (see `evidence`), and a pixel on the border is compared with the colours
    on both sides of it (see `edge_evidence`). Without a start the background's evidence alone decides.

    Args:
        image: (H, W, C) uint8, blue first, or (H, W, 1) with a grey background.
        background: The background model.
        start: (H, W) expected region of the person, wrong by at most 5 % of the image's longer side; nothing is found
            farther away.
        before: Result of an earlier image of this camera, whose densities are used and updated.
        prior: (H, W) prior evidence that is added to the image's: the shape term of [Rosenhahn2006] eq. (3)-(4), a
            weight times the signed distance from the expected surface (inside positive).
        ignored: (H, W) true where the image gives no evidence, because it may show another person: there the prior and
            the neighbours decide.
        local: Densities that depend on the place in the image, used where a start is given; None if there are none.
        settings: Weights of the border's length, and limits.

    Returns:
        The silhouette.

    Raises:
        ValueError: The image, the start, the prior or `ignored` is not of the background's size.
    """
    _check_sizes(image, start=start, prior=prior, ignored=ignored)
    earlier = None if before is None else before.exposure
    shown = exposure(image, background, person=start, before=earlier, settings=settings.background)
    look = unknown(image.shape[2]) if before is None else before.appearance
    roi = _neighbourhood(start, visible_part(image, background, shown, settings.background.black))
    rounds = settings.rounds if before is None else 0
    begin = None if start is None or not start.any() else start[roi]
    large = min(image.shape[:2]) >= settings.reduction * settings.least_reduced
    if begin is None and prior is None and large:
        seen = _person_region(image, background, roi, shown, look, rounds, settings)
        if seen is None:
            return Silhouette(mask=np.zeros(image.shape[:2], bool), appearance=look, exposure=shown)
        (roi, look), rounds = seen, min(rounds, 1)
    scene = _scene(image, background, roi, shown, ignored, None if begin is None else local)
    known, near = _prior_evidence(scene, begin, None if prior is None else prior[roi], _margin(image.shape))
    least = settings.least_person_share * image.shape[0] * image.shape[1]
    found = _in_turn(
        scene, look, begin, known, near, length=settings.length, least=least, rounds=rounds, settings=settings
    )
    region = _placed_border(scene, found, known, settings.edge_length) if found.region.any() else found.region
    mask = np.zeros(image.shape[:2], bool)
    mask[roi] = region
    return Silhouette(
        mask=mask, appearance=blended(found.look, found.learned, settings.learning), exposure=shown,
        energy=region_energy(found.joined, region, length=settings.length),
    )  # fmt: skip


def _check_sizes(image: np.ndarray, *, start: Mask | None, prior: np.ndarray | None, ignored: Mask | None) -> None:
    for name, given in (("start", start), ("prior", prior), ("region without evidence", ignored)):
        if given is not None and given.shape != image.shape[:2]:
            raise ValueError(f"the {name} has the shape {given.shape}, but the image {image.shape[:2]}")


@dataclass(frozen=True, eq=False)
class _Scene:
    """A part of an image, the background behind it, and the background with the image's exposure."""

    picture: np.ndarray
    background: Background
    light: np.ndarray
    shown: Exposure
    ignored: Mask | None = None
    """Where the image gives no evidence; None if it does everywhere."""
    local: LocalDensities | None = None
    """Densities that depend on the place; None if there are none."""

    def known(self, votes: np.ndarray) -> np.ndarray:
        """Return the evidence without that of the pixels that give none."""
        return votes if self.ignored is None else np.where(self.ignored, np.float32(0), votes)

    def texture(self, region: Mask | None = None) -> np.ndarray | None:
        """Return the evidence of the texture, without that near the border of a region; None if there is none."""
        if self.local is None or self.local.texture is None:
            return None
        texture = self.known(self.local.texture)
        if region is None:
            return texture
        window = np.ones((2 * TEXTURE_WIDTH + 1, 2 * TEXTURE_WIDTH + 1), np.uint8)
        border = cv2.morphologyEx(region.view(np.uint8), cv2.MORPH_GRADIENT, window, borderType=cv2.BORDER_REPLICATE)
        return np.where(border > 0, np.float32(0), texture)


@dataclass(frozen=True, eq=False)
class _Turned:
    """Result of `_in_turn`: the region, its evidence, the densities used last and those estimated from it."""

    region: Mask
    votes: np.ndarray
    """The evidence of the colours."""
    joined: np.ndarray
    """The evidence of colours, texture and prior."""
    look: Appearance
    learned: Appearance


def _scene(
    image: np.ndarray, background: Background, roi: tuple[slice, slice], shown: Exposure, ignored: Mask | None,
    local: LocalDensities | None,
) -> _Scene:  # fmt: skip
    behind = part(background, roi)
    unknown_there = None if ignored is None else ignored[roi]
    there = None if local is None else local.within(roi)
    return _Scene(np.ascontiguousarray(image[roi]), behind, exposed(behind, shown), shown, unknown_there, there)


def _prior_evidence(
    scene: _Scene, begin: Mask | None, prior: np.ndarray | None, margin: int
) -> tuple[np.ndarray | np.float32, Mask | None]:
    """Return the evidence that is known besides the image's, and the pixels near the start; None without a start."""
    known, near = (np.float32(0), None) if begin is None else _too_far(begin, margin)
    if begin is not None and (scene.background.confidence < 1).any():
        known = known + (1 - scene.background.confidence) * shape_term(begin, 2 * LIMIT / margin, margin)
    if prior is not None:
        known = known + prior.astype(np.float32)
    return known, near


def _placed_border(scene: _Scene, found: _Turned, known: np.ndarray | np.float32, length: float) -> Mask:
    """Place the border of a region between its known sides."""
    region = found.region
    edges = scene.known(edge_evidence(scene.picture, scene.light, scene.shown.noise, found.votes, region))
    texture = scene.texture(region)
    edges = edges if texture is None else edges + texture
    return evolve(edges + known, region, length=length)


def _in_turn(
    scene: _Scene,
    look: Appearance,
    begin: Mask | None,
    known: np.ndarray | np.float32,
    near: Mask | None,
    *,
    length: float,
    least: float,
    rounds: int,
    settings: SilhouetteSettings,
) -> _Turned:
    """Estimate the region and the densities alternately."""
    for k in range(rounds + 1):
        votes, shade = evidence(
            scene.picture, scene.light, scene.background, scene.shown, look, near=near, local=scene.local
        )
        votes = scene.known(votes)
        texture = scene.texture()
        joined = votes + known if texture is None else votes + texture + known
        fine = evolve_coarse_to_fine(joined, begin, length=length, halvings=settings.halvings)
        region = begin = _fragments(fine, least, settings)
        new = _estimated_appearance(scene.picture, region, votes, shade, scene.background.confidence, settings.sure)
        if k < rounds:
            look = new
    return _Turned(region, votes, joined, look, new)


def _person_region(
    image: np.ndarray,
    background: Background,
    shown_part: tuple[slice, slice],
    shown: Exposure,
    look: Appearance,
    rounds: int,
    settings: SilhouetteSettings,
) -> tuple[tuple[slice, slice], Appearance] | None:
    """Return rows and columns about the person in the reduced image, and its appearance; None without a person."""
    factor = settings.reduction
    scene = _reduced(image, background, shown_part, shown, factor)
    # A person of just the least size may be smaller in the reduced image.
    least = settings.least_person_share * image.shape[0] * image.shape[1] / factor**2 / 2
    size = settings.length / factor
    found = _in_turn(scene, look, None, np.float32(0), None, length=size, least=least, rounds=rounds, settings=settings)
    if not found.region.any():
        return None
    roi, margin = [], _margin(image.shape)
    for axis, whole in enumerate(shown_part):
        lines = whole.start + factor * np.flatnonzero(found.region.any(axis=1 - axis))
        roi.append(slice(max(whole.start, lines[0] - margin), min(whole.stop, lines[-1] + factor + margin)))
    return (roi[0], roi[1]), found.look


def _reduced(
    image: np.ndarray, background: Background, roi: tuple[slice, slice], shown: Exposure, factor: int
) -> _Scene:
    """Reduce width and height of a part of an image by a factor; remaining rows and columns are dropped."""
    rows, columns = roi
    behind = _reduced_background(background, rows.start, rows.stop, columns.start, columns.stop, factor)
    return _Scene(_smaller(image[roi], factor), behind, exposed(behind, shown), shown)


KEPT_PARTS = 4
"""Number of reduced parts of each background that are kept. The part of the images without black bars is the same in
nearly all frames. Chosen by hand."""
_REDUCED_PARTS: WeakKeyDictionary[Background, dict[tuple[int, ...], Background]] = WeakKeyDictionary()
"""Reduced parts of each background, by rows, columns and factor; they are released with the background."""


def _reduced_background(
    background: Background, top: int, bottom: int, left: int, right: int, factor: int
) -> Background:
    """Reduce a part of the background in the same way; the result is kept for the next images."""
    parts, key = _REDUCED_PARTS.setdefault(background, {}), (top, bottom, left, right, factor)
    if key not in parts:
        roi = slice(top, bottom), slice(left, right)
        reduced = Background(
            mean=_smaller(background.mean[roi], factor),
            steepness=_smaller(background.steepness[roi], factor),
            confidence=_smaller(background.confidence[roi], factor),
            size=(background.size[0] // factor, background.size[1] // factor),
        )
        while len(parts) >= KEPT_PARTS:
            del parts[next(iter(parts))]
        parts[key] = reduced
    return parts[key]


def _smaller(image: np.ndarray, factor: int) -> np.ndarray:
    height, width = (n // factor for n in image.shape[:2])
    whole = image[: height * factor, : width * factor]
    return cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA).reshape(height, width, *image.shape[2:])


def shape_term(expected: Mask, weight: float, reach: float) -> np.ndarray:
    """Compute the shape term of [Rosenhahn2006] eq. (4), for the prior of `segment`: weight times signed distance.

    Args:
        expected: (H, W) expected region, for instance the projection of the predicted surface.
        weight: Evidence per pixel of distance [1/px].
        reach: Distance from which on the term is constant [px].

    Returns:
        (H, W) float32 evidence, positive inside.
    """
    inside, outside = (np.ascontiguousarray(side).view(np.uint8) for side in (expected, ~expected))
    distance: np.ndarray = cv2.distanceTransform(inside, cv2.DIST_L2, 3)
    distance -= cv2.distanceTransform(outside, cv2.DIST_L2, 3)
    np.clip(distance, -reach, reach, out=distance)
    distance *= weight
    return distance


def _margin(shape: tuple[int, ...]) -> int:
    """Return the largest distance of the person from its expected region [px]."""
    return max(8, max(shape[:2]) // 20)


def _too_far(start: Mask, margin: int) -> tuple[np.ndarray, Mask]:
    """Return evidence against pixels farther from the start than half the margin, and the pixels within the margin."""
    # Half the resolution suffices for a slope of this width.
    distance = cv2.distanceTransform((~start[::2, ::2]).view(np.uint8), cv2.DIST_L2, 3)
    found: tuple[np.ndarray, Mask] = _against(
        distance, *start.shape, np.float32(margin), np.float32(4 * LIMIT / margin)
    )
    return found


@kernel
def _against(distance, height, width, margin, slope):
    against, near = np.empty((height, width), np.float32), np.empty((height, width), np.bool_)
    for y in range(height):
        for x in range(width):
            far = np.float32(2) * distance[y >> 1, x >> 1]
            against[y, x] = -slope * max(far - np.float32(0.5) * margin, np.float32(0))
            near[y, x] = far < margin
    return against, near


def _neighbourhood(start: Mask | None, shown: tuple[slice, slice]) -> tuple[slice, slice]:
    """Return the visible rows and columns about the start; all visible ones without a start."""
    if start is None or not start.any():
        return shown
    rows, columns = np.flatnonzero(start.any(axis=1)), np.flatnonzero(start.any(axis=0))
    margin = _margin(start.shape)
    return (
        slice(max(shown[0].start, rows[0] - margin), min(shown[0].stop, rows[-1] + margin + 1)),
        slice(max(shown[1].start, columns[0] - margin), min(shown[1].stop, columns[-1] + margin + 1)),
    )


def visible_part(
    image: np.ndarray, background: Background, exposure: Exposure, black: int = BACKGROUND_DEFAULTS.black
) -> tuple[slice, slice]:
    """Return the rows and columns without black bars along the borders of either the image or the background.

    A bar begins with a black line, whose brightness is at most `black` [grey levels], and its lines differ from the
    other image over nearly their whole length.
    """
    limits = []
    for axis in (0, 1):
        count = image.shape[axis]
        first = _bar(image, background, exposure, axis, range(count // 8), black)
        last = _bar(image, background, exposure, axis, range(count - 1, count - 1 - count // 8, -1), black)
        limits.append(slice(first, count - last))
    return limits[0], limits[1]


def _bar(image: np.ndarray, background: Background, exposure: Exposure, axis: int, lines: range, black: int) -> int:
    """Count the lines of a bar among these lines, which begin at a border."""
    for width, line in enumerate(lines):
        seen, mean = np.take(image, line, axis), np.take(background.mean, line, axis)
        if width == 0 and _is_bright(seen, black) and _is_bright(mean, black):
            return 0
        rest = np.abs(seen - mean * exposure.gain - exposure.offset) / exposure.noise
        if np.mean(rest.max(axis=1) > 4) < 0.9:
            return width
    return len(lines)


@kernel
def _is_bright(line, level):
    """Return whether the median over a line (n, C) of the brightest channel is above a level."""
    count = 0
    for x in range(line.shape[0]):
        above = False
        for c in range(line.shape[1]):
            above |= line[x, c] > level
        count += above
    return 2 * count > line.shape[0]


def _fragments(region: Mask, least: float, settings: SilhouetteSettings) -> Mask:
    """Return the largest region and others of comparable size; nothing if the largest is smaller than `least`."""
    reach = 2 * round(float(np.sqrt(region.size)) * settings.gap_share / 2) + 1
    joined = cv2.morphologyEx(region.view(np.uint8), cv2.MORPH_CLOSE, np.ones((reach, reach), np.uint8))
    count, labels = cv2.connectedComponents(joined, connectivity=8)
    return np.asarray(region & _large(labels, count, settings.fragment_share, least))


@kernel
def _large(labels, count, share, least):
    """Return the pixels of regions with at least a share of the largest one's area, if that has at least `least`."""
    height, width = labels.shape
    areas = np.zeros(count, np.int64)
    for y in range(height):
        for x in range(width):
            areas[labels[y, x]] += 1
    areas[0] = 0
    largest = areas.max()
    kept = (areas >= share * largest) & (areas > 0) & (largest >= least)
    result = np.empty((height, width), np.bool_)
    for y in range(height):
        for x in range(width):
            result[y, x] = kept[labels[y, x]]
    return result


def _estimated_appearance(
    picture: np.ndarray, region: Mask, votes: np.ndarray, shade: np.ndarray, confidence: np.ndarray,
    least: float,
) -> Appearance:  # fmt: skip
    """Estimate densities from a region; pixels on uncertain background are used only if there are few others."""
    sure, dark = _training_pixels(region, votes, shade, confidence, np.float32(least))
    return Appearance(
        person=colour_density(picture, sure if 4 * np.count_nonzero(sure) > np.count_nonzero(region) else region),
        surroundings=colour_density(picture[::2], ~region[::2]),
        shadow=shadow_density(dark),
    )


@kernel
def _training_pixels(region, votes, shade, confidence, least):
    """Return the pixels from which the person's colours are estimated, and the light ratios of shadow pixels."""
    height, width = region.shape
    sure, dark = np.zeros((height, width), np.bool_), np.empty(height * width, np.float32)
    count = 0
    for y in range(height):
        for x in range(width):
            if region[y, x]:
                sure[y, x] = votes[y, x] > least and confidence[y, x] > np.float32(0.5)
            elif np.float32(0) < shade[y, x] < np.float32(0.97):
                dark[count] = shade[y, x]
                count += 1
    return sure, dark[:count].copy()

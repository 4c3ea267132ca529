"""Level-set segmentation of a person against a background model, from coarse to fine."""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from marey.arrays import Mask
from marey.images.silhouettes.background import Background, Exposure, exposed, exposure, part, shown_lines
from marey.images.silhouettes.densities import Appearance, blended, colour_density, shadow_density, unknown
from marey.images.silhouettes.edges import edge_evidence
from marey.images.silhouettes.evidence import LIMIT, evidence
from marey.images.silhouettes.level_sets import evolve
from marey.kernels import kernel

LENGTH = 4.0
"""Weight of the border's length: the evidence (a log-ratio) that a single pixel needs to differ from all its
neighbours. Chosen by hand."""

EDGE_LENGTH = 2.0
"""Weight of the border's length in the last step, which only places the border between known sides. Chosen by hand."""

COARSER = 2
"""Number of halvings of the image for the coarsest evolution: it has 1/4 of the width and height."""

ROUNDS = 4
"""Number of alternations between densities and regions if the person's colours are unknown. Chosen by hand."""

REDUCED = 4
"""Factor by which the image is reduced for the first search of a person if no start is given."""

LEAST_REDUCED = 60
"""Least number of rows and columns of a reduced image for this search. Chosen by hand."""

LEARNING = 0.2
"""Weight of a new image in the densities that are passed on to the next image. Chosen by hand."""

SURE = 2.0
"""Least evidence for the person of the pixels from which the person's colours are estimated. Chosen by hand."""

GAP = 0.025
"""Largest gap between regions that count as one, as a share of the square root of the image area: in front of
background of its own colour a limb is split into pieces. Chosen by hand."""

LEAST_PERSON_SHARE = 0.0015
"""Regions below this fraction of the image area are discarded. Chosen by hand."""

FRAGMENT_SHARE = 0.02
"""Least area of a separate region of the person, as a share of the largest region's. Chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Silhouette:
    """The person in one picture, and what the next picture of the camera starts from.

    Args:
        mask: (H, W) true where the person is; nowhere where nobody is there.
        appearance: Densities of the colours in both regions.
        exposure: How this picture exposes the background.
    """

    mask: Mask
    appearance: Appearance
    exposure: Exposure


def segment(
    image: np.ndarray,
    background: Background,
    *,
    start: Mask | None = None,
    before: Silhouette | None = None,
    prior: np.ndarray | None = None,
    length: float = LENGTH,
) -> Silhouette:
    """Find the person in a picture by level sets, [Rosenhahn2006] eq. (1)-(2).

    The energy is that of the paper: minus the log of both regions' densities, plus the border's length. The densities
    are smoothed histograms of colour, estimated in turn with the regions; unlike the paper, the density outside is
    that of the background's model at the pixel (see `evidence`), and a pixel on the border compares with the colours
    on both sides of it (see `edge_evidence`). Without a start the background's evidence alone decides.

    Args:
        image: (H, W, C) uint8, blue first, or (H, W, 1) with a grey background.
        background: The empty picture.
        start: (H, W) where the person is expected, up to a twentieth of the picture's longer side off: farther away
            nothing is found.
        before: Result of an earlier picture of this camera; its densities are used and carried on.
        prior: (H, W) what is known beforehand, added to the evidence: the place of the shape term,
            [Rosenhahn2006] eq. (3)-(4), whose pull at a pixel is a weight times the expected surface's
            signed distance (inside positive).
        length: Weight of the border's length.

    Raises:
        ValueError: The picture, the start or the prior is not of the background's size.
    """
    for name, given in (("start", start), ("prior", prior)):
        if given is not None and given.shape != image.shape[:2]:
            raise ValueError(f"the {name} is {given.shape}, the picture {image.shape[:2]}")
    shown = exposure(image, background, person=start, before=None if before is None else before.exposure)
    look = unknown(image.shape[2]) if before is None else before.appearance
    roi = _neighbourhood(start, shown_lines(image, background, shown))
    rounds = ROUNDS if before is None else 0
    begin = None if start is None or not start.any() else start[roi]
    if begin is None and prior is None and min(image.shape[:2]) >= REDUCED * LEAST_REDUCED:
        seen = _where_somebody_is(image, background, roi, shown, look, length, rounds)
        if seen is None:
            return Silhouette(mask=np.zeros(image.shape[:2], bool), appearance=look, exposure=shown)
        (roi, look), rounds = seen, min(rounds, 1)
    scene = _scene(image, background, roi, shown)
    known, near = (np.float32(0), None) if begin is None else _too_far(begin, _margin(image.shape))
    if begin is not None and (scene.background.trust < 1).any():
        far = _margin(image.shape)
        known = known + (1 - scene.background.trust) * shape_term(begin, 2 * LIMIT / far, far)
    if prior is not None:
        known = known + prior[roi].astype(np.float32)
    least = LEAST_PERSON_SHARE * image.shape[0] * image.shape[1]
    found = _in_turn(scene, look, begin, known, near, length=length, least=least, rounds=rounds)
    region = found.region
    if region.any():
        edges = edge_evidence(scene.picture, scene.light, shown.noise, found.votes, region)
        region = evolve(edges + known, region, length=EDGE_LENGTH)
    mask = np.zeros(image.shape[:2], bool)
    mask[roi] = region
    return Silhouette(mask=mask, appearance=blended(found.look, found.learned, LEARNING), exposure=shown)


@dataclass(frozen=True, eq=False)
class _Scene:
    """A part of a picture, the empty picture behind it, and that as the picture exposes it."""

    picture: np.ndarray
    background: Background
    light: np.ndarray
    shown: Exposure


@dataclass(frozen=True, eq=False)
class _Turned:
    """What `_in_turn` finds: the region, its evidence, the densities used last and those learned from it."""

    region: Mask
    votes: np.ndarray
    look: Appearance
    learned: Appearance


def _scene(image: np.ndarray, background: Background, roi: tuple[slice, slice], shown: Exposure) -> _Scene:
    behind = part(background, roi)
    return _Scene(np.ascontiguousarray(image[roi]), behind, exposed(behind, shown), shown)


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
) -> _Turned:
    """Estimate the region and the densities in turn."""
    for k in range(rounds + 1):
        votes, shade = evidence(scene.picture, scene.light, scene.background, scene.shown, look, near=near)
        region = begin = _fragments(_coarse_to_fine(votes + known, begin, length), least)
        new = _learned(scene.picture, region, votes, shade, scene.background.trust)
        if k < rounds:
            look = new
    return _Turned(region, votes, look, new)


def _where_somebody_is(
    image: np.ndarray,
    background: Background,
    shown_part: tuple[slice, slice],
    shown: Exposure,
    look: Appearance,
    length: float,
    rounds: int,
) -> tuple[tuple[slice, slice], Appearance] | None:
    """Rows and columns about whoever the reduced picture shows, and the looks learned there; None for nobody."""
    scene = _reduced(image, background, shown_part, shown)
    # Somebody just large enough may be smaller here.
    least = LEAST_PERSON_SHARE * image.shape[0] * image.shape[1] / REDUCED**2 / 2
    size = length / REDUCED
    found = _in_turn(scene, look, None, np.float32(0), None, length=size, least=least, rounds=rounds)
    if not found.region.any():
        return None
    roi, margin = [], _margin(image.shape)
    for axis, whole in enumerate(shown_part):
        lines = whole.start + REDUCED * np.flatnonzero(found.region.any(axis=1 - axis))
        roi.append(slice(max(whole.start, lines[0] - margin), min(whole.stop, lines[-1] + REDUCED + margin)))
    return (roi[0], roi[1]), found.look


def _reduced(image: np.ndarray, background: Background, roi: tuple[slice, slice], shown: Exposure) -> _Scene:
    """A part in a picture of a quarter of the width and height; what does not fill a pixel is left out."""
    rows, columns = roi
    behind = _reduced_background(background, rows.start, rows.stop, columns.start, columns.stop)
    return _Scene(_smaller(image[roi]), behind, exposed(behind, shown), shown)


@lru_cache(maxsize=16)
def _reduced_background(background: Background, top: int, bottom: int, left: int, right: int) -> Background:
    """The same of the empty picture, which serves many pictures."""
    roi = slice(top, bottom), slice(left, right)
    return Background(
        mean=_smaller(background.mean[roi]),
        steepness=_smaller(background.steepness[roi]),
        trust=_smaller(background.trust[roi]),
        size=(background.size[0] // REDUCED, background.size[1] // REDUCED),
    )


def _smaller(image: np.ndarray) -> np.ndarray:
    height, width = (n // REDUCED for n in image.shape[:2])
    whole = image[: height * REDUCED, : width * REDUCED]
    return cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA).reshape(height, width, *image.shape[2:])


def shape_term(expected: Mask, weight: float, reach: float) -> np.ndarray:
    """Pull to an expected region, for the prior of `segment`, [Rosenhahn2006] eq. (4): weight times signed distance.

    Args:
        expected: (H, W) for instance where the predicted surface shows.
        weight: Evidence a pixel of distance.
        reach: The pull stays the same from this distance on, pixels.
    """
    inside, outside = (np.ascontiguousarray(side).view(np.uint8) for side in (expected, ~expected))
    distance: np.ndarray = cv2.distanceTransform(inside, cv2.DIST_L2, 3)
    distance -= cv2.distanceTransform(outside, cv2.DIST_L2, 3)
    np.clip(distance, -reach, reach, out=distance)
    distance *= weight
    return distance


def _margin(shape: tuple[int, ...]) -> int:
    """How far from its expected place a part of the person may be, pixels."""
    return max(8, max(shape[:2]) // 20)


def _too_far(start: Mask, margin: int) -> tuple[np.ndarray, Mask]:
    """Evidence against what is far from the start, from half the margin on; the pixels within the margin."""
    # Half the resolution is enough for a slope that is so wide.
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
    """Rows and columns about the start, of those that show anything; all of them without a start."""
    if start is None or not start.any():
        return shown
    rows, columns = np.flatnonzero(start.any(axis=1)), np.flatnonzero(start.any(axis=0))
    margin = _margin(start.shape)
    return (
        slice(max(shown[0].start, rows[0] - margin), min(shown[0].stop, rows[-1] + margin + 1)),
        slice(max(shown[1].start, columns[0] - margin), min(shown[1].stop, columns[-1] + margin + 1)),
    )


def _coarse_to_fine(votes: np.ndarray, start: Mask | None, length: float) -> Mask:
    """Evolve the region in ever finer pictures; strong evidence about a pixel counts more than the start.

    A coarse pixel's evidence is the mean of those it holds and its sides are longer: the length weighs less by its
    size.
    """
    pyramid = [votes]
    for _ in range(COARSER):
        height, width = pyramid[-1].shape
        pyramid.append(cv2.resize(pyramid[-1], ((width + 1) // 2, (height + 1) // 2), interpolation=cv2.INTER_AREA))
    region = np.zeros_like(votes, bool) if start is None else start
    for level in range(COARSER, -1, -1):
        height, width = pyramid[level].shape
        blurred = cv2.GaussianBlur(pyramid[level], (0, 0), 1.0)
        weight = length / 2**level
        if start is None and level == COARSER:
            region = blurred > 0
        else:
            scaled = cv2.resize(region.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
            region = (scaled & (blurred > -weight)) | (blurred > weight)
        region = evolve(pyramid[level], region, length=weight)
    return region


def _fragments(region: Mask, least: float) -> Mask:
    """The largest region and those not too small beside it; nothing where the largest is below least."""
    reach = 2 * round(float(np.sqrt(region.size)) * GAP / 2) + 1
    joined = cv2.morphologyEx(region.view(np.uint8), cv2.MORPH_CLOSE, np.ones((reach, reach), np.uint8))
    count, labels = cv2.connectedComponents(joined, connectivity=8)
    return np.asarray(region & _large(labels, count, FRAGMENT_SHARE, least))


@kernel
def _large(labels, count, share, least):
    """Pixels of the regions with at least a share of the largest one's pixels, if that has no less than least."""
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


def _learned(picture: np.ndarray, region: Mask, votes: np.ndarray, shade: np.ndarray, trust: np.ndarray) -> Appearance:
    """Densities from the region as it is; where the background is doubtful it teaches only if there is nothing else."""
    sure, dark = _lessons(region, votes, shade, trust)
    return Appearance(
        person=colour_density(picture, sure if 4 * np.count_nonzero(sure) > np.count_nonzero(region) else region),
        surroundings=colour_density(picture[::2], ~region[::2]),
        shadow=shadow_density(dark),
    )


@kernel
def _lessons(region, votes, shade, trust):
    """Pixels that teach the person's colours; the darkening of the pixels that teach what shadows are like."""
    height, width = region.shape
    sure, dark = np.zeros((height, width), np.bool_), np.empty(height * width, np.float32)
    count = 0
    for y in range(height):
        for x in range(width):
            if region[y, x]:
                sure[y, x] = votes[y, x] > np.float32(SURE) and trust[y, x] > np.float32(0.5)
            elif np.float32(0) < shade[y, x] < np.float32(0.97):
                dark[count] = shade[y, x]
                count += 1
    return sure, dark[:count].copy()

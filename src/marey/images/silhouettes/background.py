"""Background model of a camera: mean image, gradient and noise, and the exposure of an image relative to it."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from marey.arrays import Mask, freeze_fields
from marey.compiled.kernels import kernel

_DISPLACEMENTS = tuple((down, right) for down in (-24, 0, 24) for right in (-24, 0, 24) if down or right)
"""Displacements of an outline to places where the image has no step across it: farther than the rings of `_step`, which
are up to 8 pixels away, are wide [px]. Chosen by hand."""
_MEDIAN_TO_DEVIATION = 1 / 0.6745
"""Ratio of a normal distribution's standard deviation to its median absolute deviation."""


@dataclass(frozen=True, kw_only=True)
class BackgroundSettings:
    """Settings of the background model and of an image's exposure.

    The defaults were chosen by hand; results were not measured against other values.
    """

    least_noise: float = 1.0
    """Lower limit of the noise's standard deviation in recordings of eight bits per channel [grey levels]."""
    black: int = 24
    """Upper limit of the brightness of a black bar [grey levels]."""
    ghost_ratio: float = 3.0
    """Ratio of the step across an outline in the background image to that in the video, above which the region is a
    ghost: something that the background image shows and the video does not."""
    unexplained_sd: float = 3.0
    """Difference between image and background, in standard deviations averaged over 5 x 5 pixels, above which the
    background does not explain the image."""
    samples: int = 5000
    """Approximate number of pixels from which the exposure of an image is estimated."""


BACKGROUND_DEFAULTS = BackgroundSettings()
"""Default settings of the background model."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Background:
    """Background model of one camera: the image without a person.

    Args:
        mean: (H, W, C) mean image [grey levels], with C = 1 or 3.
        steepness: (H, W) squared gradient [squared grey levels per squared pixel], the sensitivity to a small shift.
        confidence: (H, W) probability that the mean is correct, from 0 to 1.
        size: Rows and columns of the full image, of which this may be a part.
    """

    mean: np.ndarray
    steepness: np.ndarray
    confidence: np.ndarray
    size: tuple[int, int]

    def __post_init__(self):
        freeze_fields(self, "mean", "steepness", "confidence", dtype=np.float32)


@dataclass(frozen=True, eq=False, kw_only=True)
class Exposure:
    """Photometric relation of an image to the background: image = gain * mean + offset, with a standard deviation.

    Args:
        gain: (C,) gain per channel.
        offset: (C,) offset per channel [grey levels].
        noise: (C,) standard deviation in homogeneous parts of the background [grey levels].
        jitter: Standard deviation of small shifts (camera shake, resampling, compression), which add noise at edges
            [px].
    """

    gain: np.ndarray
    offset: np.ndarray
    noise: np.ndarray
    jitter: float

    def __post_init__(self):
        freeze_fields(self, "gain", "offset", "noise", dtype=np.float32)


def part(background: Background, roi: tuple[slice, slice]) -> Background:
    """Return a rectangular part of a background."""
    return Background(
        mean=background.mean[roi],
        steepness=background.steepness[roi],
        confidence=background.confidence[roi],
        size=background.size,
    )


def with_reduced_weight(
    background: Background, pictures: Sequence[np.ndarray], settings: BackgroundSettings = BACKGROUND_DEFAULTS, *,
    limb: bool = False,
) -> Background:  # fmt: skip
    """Reduce a background's confidence where it explains no image of the video, and replace ghosts.

    In such a region either the person is present all the time, or the background image is wrong: it shows a ghost (a
    person, or an object that was moved). The region's outline decides: a person's outline is an edge in the video
    only, and the background image remains as it is; a ghost's outline is an edge in the background image, and if the
    surroundings are explained, the ghost is replaced by the most frequent colours of the video. Elsewhere the
    confidence is reduced to 0.5, so that colours and predictions decide.

    Args:
        background: Background from an image or a clip of the empty room.
        pictures: Images (H, W, C) uint8, distributed over the video; twelve suffice.
        settings: What counts as unexplained, and as a ghost.
        limb: Only a limb is followed. The confidence is then reduced behind a person, too, because otherwise the
            silhouettes contain more of the other limbs: the joints of the arm of `arm3` were 8.4 instead of 5.7 mm off
            (the script was not kept).

    Returns:
        The changed background.

    Raises:
        ValueError: An image is not of the background's size.
    """
    least, changed = np.full(background.size, np.inf, np.float32), np.zeros(background.size, np.float32)
    average = np.zeros(background.mean.shape, np.float32)
    for picture in pictures:
        shown = exposure(picture, background, settings=settings)
        light = exposed(background, shown)
        misfit = _mean_misfit(picture, light, background.steepness, shown.noise**2, np.float32(shown.jitter**2))
        misfit = cv2.blur(misfit, (5, 5))
        least = np.minimum(least, misfit)
        changed += (misfit > settings.unexplained_sd**2) / np.float32(len(pictures))
        average += picture / np.float32(len(pictures))
    unexplained = (least > settings.unexplained_sd**2).astype(np.uint8)
    wrong = cv2.morphologyEx(unexplained, cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
    confidence, ghost = _outlines(wrong, changed, background.mean, average, settings.ghost_ratio, limb=limb)
    mean = background.mean
    if ghost.any():
        rows, columns = np.flatnonzero(ghost.any(axis=1)), np.flatnonzero(ghost.any(axis=0))
        box = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
        frequent, _ = _most_frequent(np.stack([picture[box] for picture in pictures]), np.float32(6.0))
        mean = mean.copy()
        mean[box][ghost[box]] = frequent[ghost[box]]
    return background_of(mean, confidence=np.minimum(confidence, background.confidence))


@kernel(error_model="numpy")
def _mean_misfit(picture, light, steepness, noise, jitter):
    """Return the mean over the channels (H, W) of the squared differences in units of their variances."""
    height, width, channels = picture.shape
    out = np.empty((height, width), np.float32)
    for y in range(height):
        for x in range(width):
            edge, total = np.float64(jitter * steepness[y, x]), np.float32(0.0)
            for c in range(channels):
                difference = np.float32(picture[y, x, c]) - light[y, x, c]
                total += np.float32(np.float64(difference * difference) / (noise[c] + edge))
            out[y, x] = total / np.float32(channels)
    return out


def _outlines(
    wrong: np.ndarray, changed: np.ndarray, plate: np.ndarray, average: np.ndarray, ghost_ratio: float, *, limb: bool
) -> tuple[np.ndarray, Mask]:
    """Return the confidence of the background image and its ghosts, from the steps across outlines of wrong regions."""
    confidence, ghost = np.ones(wrong.shape, np.float32), np.zeros(wrong.shape, bool)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(wrong)
    square, wide = np.ones((7, 7), np.uint8), np.ones((15, 15), np.uint8)
    for k in range(1, count):
        x, y, width, height, area = stats[k]
        if area < 50:
            continue
        box = (slice(max(y - 8, 0), y + height + 8), slice(max(x - 8, 0), x + width + 8))
        part = (labels[box] == k).astype(np.uint8)
        place = cv2.dilate(part, square) > 0
        steps = _step(plate[box], part), _step(average[box], part)
        alone = changed[box][(cv2.dilate(part, wide) > 0) & ~place].mean() < 0.5
        if alone and steps[0] > ghost_ratio * max(steps[1], 1e-3):
            ghost[box] |= place
        elif not alone and (limb or not _is_new(steps, _usual_step(plate, part, box), ghost_ratio)):
            confidence[box][place] = 0.5
    return confidence, ghost


def _is_new(steps: tuple[float, float], usual: float, ghost_ratio: float) -> bool:
    """Return whether a region's outline is an edge in the video only: something stands before a correct background.

    Args:
        steps: Steps across the outline in the background image and in the video.
        usual: The step in the background image without an outline.
        ghost_ratio: Ratio of the edges, see `BackgroundSettings`.
    """
    before, after = (max(step - usual, 0.0) for step in steps)
    return after > max(ghost_ratio * before, usual / ghost_ratio)


def _usual_step(plate: np.ndarray, part: np.ndarray, box: tuple[slice, slice]) -> float:
    """Return the step that the texture of a background image causes: the median across displaced outlines."""
    steps = []
    for down, right in _DISPLACEMENTS:
        top, left = box[0].start + down, box[1].start + right
        cut = slice(max(-top, 0), None), slice(max(-left, 0), None)
        shown = plate[max(top, 0) : max(top + part.shape[0], 0), max(left, 0) : max(left + part.shape[1], 0)]
        own = part[cut][: shown.shape[0], : shown.shape[1]]
        steps += [_step(shown, np.ascontiguousarray(own))] if own.any() else []
    return float(np.median(steps)) if steps else 0.0


def _step(picture: np.ndarray, part: np.ndarray) -> float:
    """Return the mean step across a region's outline, between rings up to eight pixels inside and outside [levels]."""
    near, far = np.ones((5, 5), np.uint8), np.ones((15, 15), np.uint8)
    outside = (cv2.dilate(part, far) - cv2.dilate(part, near)).astype(np.float32)
    # The region was found with a window of 5 x 5 and is two pixels too large.
    inside = (cv2.erode(part, near) - cv2.erode(part, far)).astype(np.float32)
    sides = []
    for ring in (inside, outside):
        weight = cv2.blur(ring, (17, 17))
        total = cv2.blur(picture * ring[..., None], (17, 17)).reshape(picture.shape)
        sides.append((total / np.maximum(weight, 1e-6)[..., None], weight > 0.01))
    both = (inside > 0) & sides[0][1] & sides[1][1]
    difference = np.linalg.norm(sides[0][0] - sides[1][0], axis=2)[both]
    return float(difference.mean()) if difference.size else 0.0


def updated_from_frame(
    background: Background, picture: np.ndarray, shown: Exposure, person: Mask, *, share: float = 0.5
) -> Background:
    """Update a background of low confidence from an image, outside the region where the person may be.

    Args:
        background: Background from `with_reduced_weight`; pixels of full confidence are unchanged.
        picture: (H, W, C) uint8 image.
        shown: Exposure of the image.
        person: (H, W) region where the person may be: a fitted surface, dilated by its uncertainty.
        share: Weight of the image in the new mean and confidence.

    Returns:
        The updated background.
    """
    learn = (background.confidence < 1) & ~person
    if not learn.any():
        return background
    mean, confidence = background.mean.copy(), background.confidence.copy()
    mean[learn] += share * ((picture[learn] - shown.offset) / shown.gain - mean[learn])
    confidence[learn] += share * (1 - confidence[learn])
    return background_of(mean, confidence=confidence)


def exposed(background: Background, shown: Exposure) -> np.ndarray:
    """Return the background's mean with the exposure of an image, (H, W, C) float32, at least one grey level."""
    return np.asarray(_exposed(background.mean, shown.gain, shown.offset))


@kernel(fastmath=True)
def _exposed(mean, gain, offset):
    height, width, channels = mean.shape
    light = np.empty((height, width, channels), np.float32)
    # The channels are interleaved along a row, so that one loop runs over the whole row.
    gains, offsets = np.empty(width * channels, np.float32), np.empty(width * channels, np.float32)
    for c in range(channels):
        gains[c::channels], offsets[c::channels] = gain[c], offset[c]
    for y in range(height):
        row, out = mean[y].ravel(), light[y].ravel()
        for e in range(width * channels):
            out[e] = max(gains[e] * row[e] + offsets[e], np.float32(1.0))
    return light


def grey(image: np.ndarray) -> np.ndarray:
    """Convert a colour image (H, W, 3) uint8, blue first, to a grey image (H, W, 1)."""
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)[..., None]


def from_pictures(pictures: Sequence[np.ndarray]) -> Background:
    """Estimate a background from images of the empty room: the median of each pixel.

    Args:
        pictures: Images (H, W, C) uint8 of one size and exposure; 24 images of a clip suffice.

    Returns:
        The background, with full confidence.

    Raises:
        ValueError: There is no image, or their sizes differ.
    """
    _check(pictures)
    mean = pictures[0].astype(np.float32) if len(pictures) == 1 else np.median(np.stack(pictures), axis=0)
    return background_of(mean)


def from_take(
    pictures: Sequence[np.ndarray], *, tolerance: float = 3.0, settings: BackgroundSettings = BACKGROUND_DEFAULTS
) -> Background:
    """Estimate a background from the video itself, in which each pixel shows the background at some time.

    The estimate begins with the most frequent colour of each pixel. Where a person stays for most of the video this is
    the person's colour; if the first image has no step across the outline of such a region, its pixels replace it (see
    `with_reduced_weight`). The confidence is 1 for a colour in at least half of the images and falls to 0.5 for a rare
    one.

    Args:
        pictures: Images (H, W, C) uint8 of one size, of the frames that `background_frames` selects.
        tolerance: Colours that differ by less in every channel are equal [grey levels].
        settings: What counts as a ghost.

    Returns:
        The background.

    Raises:
        ValueError: There is no image, or their sizes differ.
    """
    _check(pictures)
    mean, share = _most_frequent(np.stack(pictures), np.float32(tolerance))
    if len(pictures) > 1:
        first, second = (picture.astype(np.float32) for picture in pictures[:2])
        mean = _without_outlines(mean, first, second, 4 * tolerance, settings.ghost_ratio)
    return background_of(mean, confidence=np.clip(2 * share, 0.5, 1.0))


def background_frames(count: int, *, ends: int = 10, between: int = 20) -> np.ndarray:
    """Select frames for the background of a video of `count` frames: many at its beginning, some of all the rest."""
    return np.unique(np.concatenate([np.arange(min(ends, count)), np.linspace(0, count - 1, between).astype(int)]))


def _differs(one: np.ndarray, other: np.ndarray, tolerance: float) -> Mask:
    return np.asarray(
        np.abs(cv2.blur(one, (5, 5)) - cv2.blur(other, (5, 5))).reshape(one.shape).max(axis=2) > tolerance
    )


def _without_outlines(
    mean: np.ndarray, picture: np.ndarray, beside: np.ndarray, tolerance: float, ghost_ratio: float
) -> np.ndarray:
    """Replace regions of the mean by an image's pixels where only the mean has a step across the region's outline.

    Regions that move between the image and the next one are not background and stay.
    """
    differs, moves = _differs(mean, picture, tolerance), _differs(picture, beside, tolerance)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(
        cv2.morphologyEx(differs.astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
    )
    repaired = mean.copy()
    for k in range(1, count):
        x, y, width, height, area = stats[k]
        if area < 50:
            continue
        box = (slice(max(y - 8, 0), y + height + 8), slice(max(x - 8, 0), x + width + 8))
        part = (labels[box] == k).astype(np.uint8)
        still = moves[box][part > 0].mean() < 0.1
        if still and _step(mean[box], part) > ghost_ratio * _step(picture[box], part):
            place = cv2.dilate(part, np.ones((7, 7), np.uint8)) > 0
            repaired[box][place] = picture[box][place]
    return repaired


def _check(pictures: Sequence[np.ndarray]) -> None:
    if len(pictures) == 0:
        raise ValueError("a background needs at least one image")
    if any(picture.ndim != 3 or picture.shape != pictures[0].shape for picture in pictures):
        raise ValueError("the images of a background must have the shape (H, W, C) and one size")


def shrunk(background: Background, size: tuple[int, int]) -> Background:
    """Resize a background to a smaller width and height."""
    if (background.size[1], background.size[0]) == size:
        return background
    mean = cv2.resize(background.mean, size, interpolation=cv2.INTER_AREA)
    confidence = cv2.resize(background.confidence, size, interpolation=cv2.INTER_AREA)
    return background_of(mean.reshape(size[1], size[0], -1), confidence=confidence)


def background_of(mean: np.ndarray, confidence: np.ndarray | None = None) -> Background:
    """Return the background of a mean image (H, W, C), with full confidence unless another one (H, W) is given."""
    mean = mean.astype(np.float32)
    confidence = np.ones(mean.shape[:2]) if confidence is None else confidence
    return Background(mean=mean, steepness=_steepness(mean), confidence=confidence, size=mean.shape[:2])


def _steepness(picture: np.ndarray) -> np.ndarray:
    smooth = cv2.GaussianBlur(picture, (0, 0), 0.7).reshape(picture.shape)
    across = cv2.Scharr(smooth, cv2.CV_32F, 1, 0).reshape(picture.shape) / 32
    down = cv2.Scharr(smooth, cv2.CV_32F, 0, 1).reshape(picture.shape) / 32
    return np.asarray(np.mean(across**2 + down**2, axis=2))


@kernel
def _most_frequent(pictures, tolerance):
    """Return the mean of the largest group of similar colours at each pixel, and the group's share."""
    count, height, width, channels = pictures.shape
    mean = np.empty((height, width, channels), np.float32)
    share = np.empty((height, width), np.float32)
    for y in range(height):
        for x in range(width):
            best, most = 0, 0
            for i in range(count):
                alike = 0
                for j in range(count):
                    alike += _alike(pictures[i, y, x], pictures[j, y, x], tolerance)
                if alike > most:
                    best, most = i, alike
            for c in range(channels):
                total = 0.0
                for j in range(count):
                    if _alike(pictures[best, y, x], pictures[j, y, x], tolerance):
                        total += pictures[j, y, x, c]
                mean[y, x, c] = total / most
            share[y, x] = most / count
    return mean, share


@kernel
def _alike(one, other, tolerance):
    for c in range(one.size):  # noqa: SIM110
        if abs(np.float32(one[c]) - np.float32(other[c])) > tolerance:
            return False
    return True


def exposure(
    image: np.ndarray,
    background: Background,
    *,
    person: Mask | None = None,
    before: Exposure | None = None,
    settings: BackgroundSettings = BACKGROUND_DEFAULTS,
) -> Exposure:
    """Estimate the exposure of an image relative to the background, robust to objects in front of it.

    Gain and offset of each channel are fitted to a sample of the pixels by reweighted least squares (Cauchy's
    weights). The noise is the standard deviation of the residuals where the background is homogeneous; the jitter
    explains the larger residuals at edges.

    Args:
        image: (H, W, C) uint8, of the background's size.
        background: The background model.
        person: (H, W) expected region of the person, which is excluded.
        before: Exposure of an earlier image of the camera, of which noise and jitter are kept.
        settings: Number of samples, and least noise.

    Returns:
        The exposure.

    Raises:
        ValueError: The image is not of the background's size.
    """
    if image.shape != background.mean.shape:
        raise ValueError(f"the image has the shape {image.shape}, but its background {background.mean.shape}")
    samples, least = settings.samples if before is None else settings.samples // 3, settings.least_noise
    step = max(1, int(np.sqrt(image.shape[0] * image.shape[1] / samples)))
    grid = (slice(step // 2, None, step), slice(step // 2, None, step))
    keep = background.confidence[grid] > 0.5
    if person is not None:
        keep &= ~person[grid]
    if keep.sum() < 20:
        keep = np.ones_like(keep)
    seen = image[grid][keep].astype(np.float32)
    mean, steepness = background.mean[grid][keep], background.steepness[grid][keep]
    if before is not None:
        gain, offset = _gain_and_offset(seen, mean, before.gain, before.offset, rounds=2, least=least)
        return Exposure(gain=gain, offset=offset, noise=before.noise, jitter=before.jitter)
    start = np.ones(mean.shape[1]), np.median(seen - mean, axis=0)
    gain, offset = _gain_and_offset(seen, mean, *start, rounds=8, least=least)
    noise, jitter = _noise(seen - gain * mean - offset, steepness, least)
    return Exposure(gain=gain, offset=offset, noise=noise, jitter=jitter)


def _median_size(rest: np.ndarray) -> np.ndarray:
    """Return the median of the absolute values in each column; for even numbers the larger of the two middle values."""
    middle = len(rest) // 2
    return np.partition(np.abs(np.ascontiguousarray(rest.T)), middle, axis=1)[:, middle]


def _gain_and_offset(
    seen: np.ndarray, mean: np.ndarray, gain: np.ndarray, offset: np.ndarray, *, rounds: int, least: float
) -> tuple[np.ndarray, np.ndarray]:
    """Fit seen = gain * mean + offset per channel, (n, C) each; if the mean hardly varies, the gain stays near one."""
    gain, offset = np.array(gain, np.float64), np.array(offset, np.float64)
    for _ in range(rounds):
        rest = seen - gain.astype(np.float32) * mean - offset.astype(np.float32)
        spread = np.maximum(_median_size(rest) * _MEDIAN_TO_DEVIATION, least)
        gain, offset = _weighted_line(seen, mean, rest, spread)
    return gain, offset


@kernel(error_model="numpy")
def _weighted_line(seen, mean, rest, spread):
    """Do one iteration of `_gain_and_offset`: gain and offset (C,) by least squares with Cauchy's weights."""
    count, channels = seen.shape
    total = 0.0
    sums = np.zeros((4, channels))
    for i in range(count):
        far = 1.0
        for c in range(channels):
            far += (rest[i, c] / (2 * spread[c])) ** 2
        weight = 1 / far
        total += weight
        for c in range(channels):
            x, y = np.float64(mean[i, c]), np.float64(seen[i, c])
            sums[0, c] += weight * x
            sums[1, c] += weight * y
            sums[2, c] += weight * x * x
            sums[3, c] += weight * x * y
    gain, offset = np.empty(channels), np.empty(channels)
    for c in range(channels):
        centre, middle = sums[0, c] / total, sums[1, c] / total
        # A prior measurement: the gain is 1 with a standard deviation of 0.2.
        prior = spread[c] ** 2 / 0.2**2
        gain[c] = (sums[3, c] - total * centre * middle + prior) / (sums[2, c] - total * centre**2 + prior)
        offset[c] = middle - gain[c] * centre
    return gain, offset


def _noise(rest: np.ndarray, steepness: np.ndarray, least: float) -> tuple[np.ndarray, float]:
    # Objects in front of the background are no noise: large residuals are excluded, twice.
    for _ in range(2):
        spread = np.maximum(np.median(np.abs(rest), axis=0) * _MEDIAN_TO_DEVIATION, least)
        near = (np.abs(rest) < 4 * spread).all(axis=1)
        rest, steepness = rest[near], steepness[near]
    even = steepness <= np.median(steepness)
    steep = steepness >= np.quantile(steepness, 0.9)
    noise = np.maximum(np.median(np.abs(rest[even]), axis=0) * _MEDIAN_TO_DEVIATION, least)
    at_edges = np.mean((np.median(np.abs(rest[steep]), axis=0) * _MEDIAN_TO_DEVIATION) ** 2 - noise**2)
    jitter = np.sqrt(max(float(at_edges), 0.0) / max(float(np.median(steepness[steep])), 1e-6))
    return noise, float(np.clip(jitter, 0.05, 1.0))

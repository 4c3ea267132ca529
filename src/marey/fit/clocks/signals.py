"""Signals that two cameras share at equal instants: the epipolar planes of the same point of a moving body.

The rays of two cameras to one point lie in one plane through both centres, at the same instant. The angle of that plane
about the baseline is therefore a function of time that both cameras measure, each on its own clock. Two kinds of points
are used: those at which an epipolar plane touches the body, its frontier points, where the outermost such planes are
tangent to both silhouettes ([Sinha2010]), and joints that a detector found.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.cameras.camera import Camera
from marey.cameras.epipolar import EpipolarPlanes
from marey.cameras.shutter import RollingShutter
from marey.fit.solver.threads import map_in_two_threads
from marey.geometry.continuity import continuous_angles

LEAST_OF_LARGEST = 0.25
"""Regions of a silhouette below this share of its largest region are ignored. Chosen by hand."""
SMALLEST_PX2 = 60
"""Silhouettes with fewer pixels show nothing [px2]. Chosen by hand."""
BORDER_PX = 2
"""Pixels of an outline nearer to the border of the image belong to the border [px]. Chosen by hand; the tracing of
contours excludes the same ones."""
CLEAR_PX = 12.0
"""A tangent plane is not used if the border cuts the silhouette nearer to it than this [px]. Chosen by hand."""
WIDEST = 2.5
"""Largest range of the planes that meet a silhouette [rad]; with a larger one, the epipole is in or near the
silhouette, which then has no outermost planes. Chosen by hand."""
TANGENT_BIAS_PX = 1.0
"""Standard deviation of the constant difference of the tangents of two silhouettes, from errors of the calibration and
of the silhouettes [px]. The estimated differences were 0.5 px (root mean square) on five rendered takes."""
TANGENT_SD_PX = 0.3
"""Least standard deviation of the differences of the tangents of two silhouettes of whole pixels [px]. That of uniform
rounding of both tangents is 0.4 px; the smoothing over time reduces it."""
JOINT_SD_PX = 2.0
"""The same for a detected joint, whose errors are alike in neighbouring pictures [px]. Chosen by hand."""
JOINT_BIAS_PX = 6.0
"""The same for a detected joint, which a detector sees at another place of the body from each side [px]. Chosen by
hand."""
JOINT_CHANGE = 0.77
"""Difference that all joints of one camera share, and that changes with posture and heading, as a share of the usual
constant difference. The most probable value for the offsets of six takes whose cameras are synchronous, each also
in two halves; 0.50 to 0.84 without one of them. Of the errors of that one, 67, 81 and 89 % are then within the central
intervals of 50, 80 and 95 %. Without it, 78 % of those of the whole takes and 61 % of those of the halves are within
the intervals of 95 %."""


@dataclass(frozen=True, eq=False)
class EpipolarSignal:
    """The epipolar plane of one point over time, as two cameras measure it."""

    cameras: tuple[int, int]
    """The two cameras."""
    angles: tuple[Floats, Floats]
    """(F,) of each camera's pictures, continuous over time [rad]; NaN where the point was not measured. Full turns
    between the two cameras have no meaning."""
    radians_per_pixel: tuple[Floats, Floats]
    """(F,) change of the angle per pixel of the point's image across the plane [rad/px]."""
    bias_px: float
    """Standard deviation of a constant difference between both cameras [px]."""
    least_sd_px: float
    """Least standard deviation of the other differences [px]."""
    source: str
    """Kind of the measurement."""
    change: float = 0.0
    """Difference that all signals of one camera share and that changes slowly, as a share of their usual constant
    differences; none for silhouettes, which touch the same points of the body."""
    delays: tuple[Floats, Floats] | None = None
    """(F,) instant of each camera's samples after that of the picture, with rolling shutters [s]; None without any."""


def camera_pairs(cameras: Sequence[Camera]) -> list[tuple[int, int, EpipolarPlanes]]:
    """List the pairs of cameras that have epipolar planes."""
    pairs = ((i, j, EpipolarPlanes.between(cameras[i], cameras[j])) for i, j in combinations(range(len(cameras)), 2))
    return [(i, j, planes) for i, j, planes in pairs if planes is not None]


def tangent_signals(
    cameras: Sequence[Camera], masks: Sequence[Iterable[Mask]], shutter: RollingShutter | None = None
) -> list[EpipolarSignal]:
    """Measure the outermost epipolar planes that touch the silhouettes of each pair of cameras.

    Args:
        cameras: C cameras.
        masks: The silhouettes (height, width) of each camera, one per picture.
        shutter: The cameras' rolling shutters; None without any.

    Returns:
        Two signals per pair of cameras, of the least and of the greatest angle.
    """
    pairs = camera_pairs(cameras)
    # One camera's pictures are independent of the others': each is processed in its own thread.
    tasks = [(c, camera, [pair for pair in pairs if c in pair[:2]], masks[c]) for c, camera in enumerate(cameras)]
    found = map_in_two_threads(lambda task: _tangents(*task, shutter), tasks)
    signals = []
    for i, j, _ in pairs:
        first, second = found[i][i, j], found[j][i, j]
        for side in range(2):
            signal = _tangent_signal((i, j), (first[:, side], second[:, side]))
            delays = None if shutter is None else (first[:, side, 2], second[:, side, 2])
            signals.append(replace(signal, delays=delays))
    return signals


def joint_signals(
    cameras: Sequence[Camera], pixels: Sequence[Floats], shutter: RollingShutter | None = None
) -> list[EpipolarSignal]:
    """Measure the epipolar planes of detected joints.

    Args:
        cameras: C cameras.
        pixels: (F, J, 2) of each camera's pictures [px]; NaN where a joint was not found.
        shutter: The cameras' rolling shutters; None without any.

    Returns:
        One signal per pair of cameras and joint.
    """
    signals = []
    for i, j, planes in camera_pairs(cameras):
        first, second = (_planes_of(cameras[c], planes, pixels[c]) for c in (i, j))
        late = None if shutter is None else [shutter.delays(c, pixels[c], cameras[c].size) for c in (i, j)]
        for joint in range(pixels[i].shape[1]):
            own, other = first[:, joint], second[:, joint]
            angles = continuous_angles(own[:, 0]), continuous_angles(other[:, 0])
            signal = EpipolarSignal(
                (i, j), angles, (own[:, 1], other[:, 1]), JOINT_BIAS_PX, JOINT_SD_PX, "keypoints", JOINT_CHANGE
            )  # fmt: skip
            delays = None if late is None else (late[0][:, joint], late[1][:, joint])
            signals.append(replace(signal, delays=delays))
    return signals


def _tangent_signal(pair: tuple[int, int], measured: tuple[Floats, Floats]) -> EpipolarSignal:
    """Return a signal from the angle and its change per pixel (F, 2 or 3) in both cameras."""
    first, second = measured
    angles = continuous_angles(first[:, 0]), continuous_angles(second[:, 0])
    return EpipolarSignal(pair, angles, (first[:, 1], second[:, 1]), TANGENT_BIAS_PX, TANGENT_SD_PX, "silhouettes")


def _planes_of(camera: Camera, planes: EpipolarPlanes, pixels: Floats) -> Floats:
    """Return the plane of each pixel (..., 2) and its change per pixel: (..., 2); NaN for NaN."""
    flat = pixels.reshape(-1, 2)
    known = np.isfinite(flat[:, 0])
    out = np.full(flat.shape, np.nan)
    angle, lever = planes.angles(camera.rays(flat[known]).directions)
    out[known] = np.stack([angle, _turn_per_pixel(camera) / lever], 1)
    return out.reshape(pixels.shape)


def _turn_per_pixel(camera: Camera) -> float:
    """Return the angle by which a ray turns per pixel near the centre of the image [rad/px]."""
    return float(2 / (camera.matrix[0, 0] + camera.matrix[1, 1]))


def _tangents(
    number: int, camera: Camera, pairs: Sequence[tuple[int, int, EpipolarPlanes]], masks: Iterable[Mask],
    shutter: RollingShutter | None,
) -> dict[tuple[int, int], Floats]:  # fmt: skip
    """Return for each pair the tangent planes (F, 2, 3) by side, their change per pixel, and their delay [s]."""
    rows: dict[tuple[int, int], list[Floats]] = {(i, j): [] for i, j, _ in pairs}
    for mask in masks:
        pixels = outline_pixels(mask)
        directions, border = camera.rays(pixels).directions, ~camera.sees(pixels, margin=BORDER_PX)
        delays = np.zeros(len(pixels)) if shutter is None else shutter.delays(number, pixels, camera.size)
        for i, j, planes in pairs:
            rows[i, j].append(_outermost(directions, border, delays, planes, _turn_per_pixel(camera)))
    return {pair: np.array(found).reshape(-1, 2, 3) for pair, found in rows.items()}


def outline_pixels(mask: Mask) -> Floats:
    """Return the pixels (n, 2) on the outer outlines of the large regions of a silhouette; none if it is empty."""
    found, _ = cv2.findContours(np.ascontiguousarray(mask).view(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    areas = [cv2.contourArea(outline) for outline in found]
    if not areas or max(areas) < SMALLEST_PX2:
        return np.zeros((0, 2))
    large = [outline[:, 0] for outline, area in zip(found, areas, strict=True) if area >= LEAST_OF_LARGEST * max(areas)]
    return np.concatenate(large).astype(float)


def _outermost(
    directions: Floats, border: Mask, delays: Floats, planes: EpipolarPlanes, per_pixel: float
) -> Floats:  # fmt: skip
    """Return the least and greatest plane that meets an outline, as (2, 3); NaN if unknown."""
    if len(directions) == 0:
        return np.full((2, 3), np.nan)
    first = np.zeros(1, np.int64)
    found = outermost_planes(*planes.angles(directions), border, delays, first, per_pixel=per_pixel)
    return np.asarray(found[0])


def outermost_planes(
    angle: Floats, lever: Floats, border: Mask, delays: Floats, starts: Integers, *, per_pixel: float
) -> Floats:  # fmt: skip
    """Return the least and greatest of the planes that meet each of several outlines.

    Args:
        angle: (N,) angles of the planes about the line through two camera centres [rad], outline by outline.
        lever: (N,) distance of each direction from that line, on the unit sphere.
        border: (N,) true for pixels at the border of the image.
        delays: (N,) instants of the pixels after that of the picture [s].
        starts: (F,) index of the first pixel of each outline; none is empty.
        per_pixel: Angle of a pixel [rad].

    Returns:
        (F, 2, 3) angle, its change per pixel [rad] and delay [s] of both; NaN if the outline may continue beyond the
        border.
    """
    out = np.full((len(starts), 2, 3), np.nan)
    own = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(angle)))
    sides = [np.add.reduceat(lever * value, starts) for value in (np.sin(angle), np.cos(angle))]
    middle = np.arctan2(*sides)
    beside = np.remainder(angle - middle[own] + np.pi, 2 * np.pi) - np.pi
    least, greatest = np.minimum.reduceat(beside, starts), np.maximum.reduceat(beside, starts)
    for side, end in enumerate((least, greatest)):
        at_end = np.flatnonzero((beside == end[own]) | np.isnan(end[own]))
        k = at_end[np.unique(own[at_end], return_index=True)[1]]
        near = np.abs(beside - end[own]) * lever[k][own] < CLEAR_PX * per_pixel
        good = (greatest - least < WIDEST) & ~np.logical_or.reduceat(border & near, starts)
        out[good, side] = np.stack([end + middle, per_pixel / lever[k], delays[k]], -1)[good]
    return out

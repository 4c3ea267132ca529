"""Signals of a motion that devices measure, too: vertical force, turning, acceleration, angles."""

import numpy as np

from marey.arrays import Floats
from marey.errors import MareyError
from marey.geometry import rotations
from marey.motion.filters import MINIMUM_RATE_RATIO, low_pass
from marey.motion.recording import Recording

GRAVITY = 9.80665
"""Standard acceleration of gravity [m/s2], as in OpenSim's models."""
SMOOTH_HZ = 6.0
"""Cut-off of the low-pass filter of positions before they are differentiated [Hz]. In a real walk over force plates,
the acceleration of the pelvis and the vertical force correlate by 0.95 with 6 Hz and by 0.92 with 10 Hz."""
HIPS = ("left_hip", "right_hip")
"""Joint centres whose middle stands for the centre of mass: it moves up and down with the pelvis."""
KINDS = {
    "force": "the vertical force under both feet, as the acceleration of the pelvis; it has no name",
    "turning": "the angular speed of a segment, as a gyroscope on it measures [rad/s]",
    "acceleration": "the size of the acceleration of a point with gravity, as an accelerometer measures [m/s2]",
    "speed": "the speed of a point [m/s]",
    "height": "the height of a point [m]",
    "angle": "an angle [rad]",
}
"""Kinds of quantities of a motion, and what they are."""


def driving_signal(motion: Recording, kind: str, name: str = "") -> Floats:
    """Return a quantity of a motion over its frames.

    Args:
        motion: The motion, Z up.
        kind: One of `KINDS`.
        name: Name of the point, segment or angle; none for `force`.

    Returns:
        (F,) the quantity; NaN where unknown.

    Raises:
        MareyError: The kind is unknown, or the motion lacks the name.
    """
    if kind not in KINDS:
        raise MareyError(f"There is no quantity '{kind}'. There are: {', '.join(KINDS)}.")
    if kind == "force":
        middle = np.mean([_of(motion, "point", hip) for hip in HIPS], axis=0)
        return _twice_differentiated(motion.time, middle[:, 2:])[:, 0]
    if kind == "turning":
        return np.asarray(np.linalg.norm(angular_velocity(motion, name), axis=1))
    if kind == "angle":
        return _of(motion, "angle", name)
    path = _of(motion, "point", name)
    if kind == "height":
        return np.asarray(path[:, 2])
    if kind == "speed":
        return np.asarray(np.linalg.norm(np.gradient(_smooth(motion.time, path), motion.time, axis=0), axis=1))
    return np.asarray(np.linalg.norm(_twice_differentiated(motion.time, path) + [0.0, 0.0, GRAVITY], axis=1))


def angular_velocity(motion: Recording, name: str) -> Floats:
    """Return the angular velocity of a segment in its own axes, from the frames before and after.

    Args:
        motion: The motion.
        name: Name of the segment.

    Returns:
        (F, 3) [rad/s]; NaN where unknown, and at the ends.

    Raises:
        MareyError: The motion lacks the segment.
    """
    rotation = _of(motion, "segment", name)
    out = np.full((len(rotation), 3), np.nan)
    if len(rotation) > 2:
        span = motion.time[2:] - motion.time[:-2]
        change = np.swapaxes(rotation[:-2], 1, 2) @ rotation[2:]
        known = np.isfinite(change).all(axis=(1, 2))
        out[1:-1][known] = rotations.log(change[known]) / span[known, None]
    return out


def _of(motion: Recording, kind: str, name: str) -> Floats:
    """Return the values of an angle, point or segment."""
    names, values = {
        "angle": (motion.angle_names, motion.angles), "point": (motion.point_names, motion.points),
        "segment": (motion.segment_names, motion.rotation),
    }[kind]  # fmt: skip
    if name not in names:
        raise MareyError(f"The motion has no {kind} '{name}'. It has: {', '.join(names) or 'none'}.")
    return np.asarray(values[:, names.index(name)])


def _smooth(time: Floats, values: Floats) -> Floats:
    rate = 1 / float(np.median(np.diff(time)))
    return low_pass(values, rate=rate, cutoff_hz=SMOOTH_HZ) if rate > MINIMUM_RATE_RATIO * SMOOTH_HZ else values


def _twice_differentiated(time: Floats, path: Floats) -> Floats:
    """Return the acceleration (F, n) of a path; NaN at its ends, where differences are one-sided."""
    out = np.full(path.shape, np.nan)
    smooth, step = _smooth(time, path), np.diff(time)[:, None]
    speed = np.diff(smooth, axis=0) / step
    out[1:-1] = np.diff(speed, axis=0) / (0.5 * (step[1:] + step[:-1]))
    return out

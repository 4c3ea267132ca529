"""Drawing of a moving surface over an image: displacements of tracked points, coloured by speed."""

import cv2
import numpy as np

from marey.arrays import Floats, Image
from marey.cameras.camera import Camera
from marey.view.pictures.drawing import FRACTION_BITS

_BRIGHTNESS = 0.55
"""Fraction of the image's brightness under the lines. Chosen by eye."""
_LEGEND = (16, 12, 180)
"""Left edge, height and width of the legend [px]."""


def vector_field(image: Image, camera: Camera, position: Floats, velocity: Floats, *, seconds: float) -> Image:
    """Draw the displacements of points over an image.

    Args:
        image: (H, W, 3) the camera's image, in blue, green, red.
        camera: The camera that took the image.
        position: (n, 3) positions in the world [m]; NaN is omitted.
        velocity: (n, 3) velocities [m/s]; NaN is omitted.
        seconds: Duration of the drawn displacement at constant velocity [s].

    Returns:
        (H, W, 3) the darkened image with the lines, coloured from violet (slow) to yellow (fast).
    """
    drawn = np.asarray(image * _BRIGHTNESS, np.uint8)
    speed = np.linalg.norm(velocity, axis=1)
    start, end = camera.project(position), camera.project(position + seconds * velocity)
    known = np.isfinite(start).all(axis=1) & np.isfinite(end).all(axis=1) & camera.sees(start)
    if not known.any():
        return drawn
    fastest = max(float(np.percentile(speed[known], 99)), 1e-9)
    colours = speed_colours(np.where(known, np.minimum(speed / fastest, 1.0), 0.0))
    # Fast points are drawn last, on top.
    for i in np.flatnonzero(known)[np.argsort(speed[known])]:
        colour = tuple(int(c) for c in colours[i])
        first, last = (tuple(int(c) for c in np.round(place * 2**FRACTION_BITS)) for place in (start[i], end[i]))
        cv2.line(drawn, first, last, colour, 1, cv2.LINE_AA, FRACTION_BITS)
        cv2.circle(drawn, first, 20, colour, -1, cv2.LINE_AA, FRACTION_BITS)
    _write_legend(drawn, fastest)
    return drawn


def speed_colours(share: Floats) -> Image:
    """Return the colours (n, 3) in blue, green, red of relative speeds (n,) from 0 to 1."""
    grey = np.asarray(np.round(255 * np.asarray(share)), np.uint8)[:, None]
    return np.asarray(cv2.applyColorMap(grey, cv2.COLORMAP_PLASMA), np.uint8).reshape(-1, 3)


def _write_legend(drawn: Image, fastest: float) -> None:
    left, high, wide = _LEGEND
    top = drawn.shape[0] - 2 * high
    wide = min(wide, drawn.shape[1] - 2 * left)
    if wide < 20 or top < high:
        return
    drawn[top : top + high, left : left + wide] = speed_colours(np.linspace(0, 1, wide))[None]
    text = f"0 to {fastest:.2f} m/s"
    cv2.putText(drawn, text, (left, top - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)

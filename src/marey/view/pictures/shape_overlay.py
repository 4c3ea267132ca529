"""Drawing of recovered shapes over their video, with lines between neighbouring points."""

from dataclasses import dataclass

import cv2
import numpy as np

from marey.arrays import Floats, Image, Integers, Mask
from marey.view.pictures.drawing import FARTHEST, FRACTION_BITS, LONGEST_SIDE

_BALL_MARGIN = 1e-9
"""Relative margin by which a point must be inside a ball, against rounding errors."""


def near_lines(shape: Floats) -> Integers:
    """Join the points of the Gabriel graph: no other point is in the ball about their midpoint [Gabriel1969].

    Args:
        shape: (3, P) positions, for example the mean shape; NaN where unknown.

    Returns:
        (E, 2) index pairs of points, without repetition; the graph is connected.
    """
    known = np.flatnonzero(np.isfinite(shape).all(0))
    points = shape[:, known].T
    square = ((points[:, None] - points) ** 2).sum(-1)
    pairs = []
    for a in range(len(known)):
        later = np.arange(a + 1, len(known))
        # A point c lies in the ball over a and b where ac2 + bc2 < ab2; a and b themselves lie on it.
        blocked = (square[a] + square[later] < square[a, later][:, None] * (1 - _BALL_MARGIN)).any(1)
        pairs += [(known[a], known[b]) for b in later[~blocked]]
    return np.array(pairs, np.int64).reshape(-1, 2)


MEASURED, OUTLINE, LINE = (255, 255, 255), (40, 40, 40), (200, 200, 200)
"""Colours of rings at measured points, of rims of observed points, and of lines: blue, green, red. Chosen by eye."""
_PREDICTED = (74, 111, 220)
"""Colour of rims of predicted points, orange: blue, green, red. Chosen by eye."""
_SIDE_ANGLE = np.radians(75)
"""Angle of the side view about the vertical axis [rad]. Chosen by eye."""
_ELEVATION = np.radians(15)
"""Elevation of the side view [rad]. Chosen by eye."""
_PANEL_WIDTH = 0.7
"""Width of the side view as a fraction of the image's height. Chosen by eye."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ShapeScene:
    """The measured and recovered points of one view in all frames."""

    name: str
    measured: Floats
    """(F, 2, P) observed positions [px]; NaN where missing."""
    modelled: Floats
    """(F, 2, P) positions of the model [px]."""
    placed: Floats
    """(F, 3, P) recovered shapes in the camera's axes: x right, y down, z ahead."""
    lines: Integers
    """(E, 2) index pairs of points that are joined by a line."""

    def depths(self) -> tuple[float, float]:
        """Return the range of depth (1st to 99th percentile) relative to the mean of each frame."""
        depth = self.placed[np.isfinite(self.placed).any((1, 2)), 2]
        depth = depth - np.nanmean(depth, axis=1, keepdims=True)
        low, high = np.nanpercentile(depth, [1, 99])
        return float(low), float(max(high, low + 1e-9))


class ShapeOverlay:
    """Draw one view frame by frame.

    Args:
        scene: The points of the view.
        size: Width and height of the video's images [px].
    """

    def __init__(self, scene: ShapeScene, size: tuple[int, int]):
        self._scene, self._scale = scene, 1.0
        while max(size) * self._scale > LONGEST_SIDE:
            self._scale /= 2
        self.picture = (round(size[0] * self._scale), round(size[1] * self._scale))
        self._panel = round(_PANEL_WIDTH * self.picture[1])
        answered = np.isfinite(scene.placed).any((1, 2))
        self._depths = scene.depths() if answered.any() else (0.0, 1.0)
        self._reach = _reach(scene.placed[answered]) if answered.any() else 1.0

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the drawn images [px]."""
        return self.picture[0] + self._panel, self.picture[1]

    def draw(self, image: Image, frame: int) -> Image:
        """Draw a frame: the points over the image, with a side view of the shape next to it.

        Args:
            image: (H, W, 3) the video's image, in blue, green, red.
            frame: Number of the frame.
        """
        scene = self._scene
        drawn = np.array(image)
        if self._scale < 1:
            drawn = np.asarray(cv2.resize(image, self.picture, interpolation=cv2.INTER_AREA), np.uint8)
        colours = self._colours(frame)
        places = (scene.modelled[frame].T + 0.5) * self._scale - 0.5
        seen = (scene.measured[frame].T + 0.5) * self._scale - 0.5
        radius = max(2, round(max(self.picture) / 300))
        _draw_lines(drawn, places, scene.lines)
        _draw_points(drawn, places, colours, radius, np.isfinite(seen).all(1))
        for place in seen[np.isfinite(seen).all(1)]:
            cv2.circle(
                drawn, _fixed_point(place), (radius + 3) << FRACTION_BITS, MEASURED, 1, cv2.LINE_AA, FRACTION_BITS
            )
        count = int(np.isfinite(seen).all(1).sum())
        known = int(np.isfinite(places).all(1).sum())
        words = f"{count} seen" + (f", {known} in the model" if known else ", no result")
        _write_caption(drawn, f"{scene.name}   frame {frame}   {words}")
        return np.concatenate([drawn, self._side_view(frame, colours, radius)], axis=1)

    def _colours(self, frame: int) -> Image:
        """Return the colour (P, 3) of each point by its depth: yellow is near, violet far."""
        depth = self._scene.placed[frame, 2]
        if not np.isfinite(depth).any():
            return np.zeros((len(depth), 3), np.uint8)
        low, high = self._depths
        share = 1 - np.clip((depth - np.nanmean(depth) - low) / (high - low), 0, 1)
        grey = np.round(255 * np.where(np.isfinite(share), share, 0)).astype(np.uint8)
        return np.asarray(cv2.applyColorMap(grey[:, None], cv2.COLORMAP_PLASMA)[:, 0], np.uint8)

    def _side_view(self, frame: int, colours: Image, radius: int) -> Image:
        panel = np.full((self.picture[1], self._panel, 3), 244, np.uint8)
        shape = self._scene.placed[frame]
        _write_caption(panel, "from the side", light=True)
        if not np.isfinite(shape).any():
            return panel
        centred = shape - np.nanmean(shape, axis=1, keepdims=True)
        half = 0.46 * min(self._panel, self.picture[1])
        middle = np.array([self._panel / 2, self.picture[1] / 2])
        places = middle + half / self._reach * turned(centred)[:2].T
        _draw_lines(panel, places, self._scene.lines, colour=(150, 150, 150))
        seen: Mask = np.asarray(np.isfinite(self._scene.measured[frame]).all(0))
        _draw_points(panel, places, colours, radius, seen)
        return panel


def turned(points: Floats) -> Floats:
    """Rotate points (3, P) in a camera's axes to a view from its right and slightly from above."""
    c, s = np.cos(_SIDE_ANGLE), np.sin(_SIDE_ANGLE)
    side = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    c, s = np.cos(_ELEVATION), np.sin(_ELEVATION)
    return np.asarray(np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ side @ points)


def _reach(placed: Floats) -> float:
    """Return the largest distance of a point from the mean of its frame."""
    centred = placed - np.nanmean(placed, axis=2, keepdims=True)
    return float(max(np.nanmax(np.linalg.norm(centred, axis=1)), 1e-9))


def _fixed_point(place: Floats) -> tuple[int, int]:
    return round(float(place[0]) * (1 << FRACTION_BITS)), round(float(place[1]) * (1 << FRACTION_BITS))


def _is_drawable(places: Floats) -> Mask:
    return np.asarray((np.abs(places) < FARTHEST).all(1))


def _draw_lines(drawn: Image, places: Floats, lines: Integers, colour: tuple[int, int, int] = LINE) -> None:
    there = _is_drawable(places)
    for a, b in lines:
        if there[a] and there[b]:
            cv2.line(drawn, _fixed_point(places[a]), _fixed_point(places[b]), colour, 1, cv2.LINE_AA, FRACTION_BITS)


def _draw_points(drawn: Image, places: Floats, colours: Image, radius: int, seen: Mask) -> None:
    """Draw dots in the colours of their depth; points that were not observed have an orange rim."""
    for p in np.flatnonzero(_is_drawable(places)):
        rim = OUTLINE if seen[p] else _PREDICTED
        cv2.circle(drawn, _fixed_point(places[p]), (radius + 1) << FRACTION_BITS, rim, -1, cv2.LINE_AA, FRACTION_BITS)
        cv2.circle(
            drawn, _fixed_point(places[p]), radius << FRACTION_BITS, colours[p].tolist(), -1, cv2.LINE_AA, FRACTION_BITS
        )


def _write_caption(drawn: Image, text: str, *, light: bool = False) -> None:
    scale = max(0.42, drawn.shape[0] / 1100)
    (width, height), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
    strip = drawn[: height + below + 10, : width + 20]
    if not light:
        strip[:] = (strip * 0.35).astype(np.uint8)
    colour = (90, 90, 90) if light else (245, 245, 245)
    cv2.putText(drawn, text, (10, height + 6), cv2.FONT_HERSHEY_SIMPLEX, scale, colour, 1, cv2.LINE_AA)

"""Drawing of a moving knee from several views: transparent bones, and cartilage coloured by distance."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from marey.arrays import Floats, Image, Integers, Mask
from marey.cameras.visibility import View, see
from marey.compiled.kernels import kernel
from marey.knee.space.surface import TriangleSurface
from marey.view.pictures.knee_maps import BONE, proximity_colours

VIEWS = ("anterior", "posterior", "medial", "lateral", "plateau")
"""Names of the views; `plateau` shows the tibia from above, without femur and patella."""
DEFAULT_VIEWS = ("anterior", "medial", "plateau")
"""Views that are drawn by default."""
PANEL = 400
"""Width and height of one view [px]."""
_SUPERSAMPLING = 2
"""Factor by which a view is drawn larger and then reduced, against aliasing. Chosen by eye."""
_CAMERA_DISTANCE = 4.0
"""Distance of the camera in multiples of the size of the knee. Chosen by eye."""
_OPACITY = 0.42
"""Opacity of bones, from 0 to 1. Chosen by eye."""
_DARKEST_FACE = 0.42
"""Brightness of faces that are turned away from the camera, from 0 to 1. Chosen by eye."""
_BACKGROUND = 247
"""Grey value of the background. Chosen by eye."""
_CAPTION_COLOUR, _TEXT_COLOUR, _PATH_COLOUR = (40, 32, 28), (120, 110, 100), (25, 25, 25)
"""Colours of the caption, of further texts, and of paths: blue, green, red. Chosen by eye."""
_LEFT, _BACK, _UP = np.eye(3)
"""Unit vectors of the LPS axes: left, posterior, superior."""
_STRIP = 30
"""Height of the strips above and below the views [px]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class DrawnPart:
    """A structure that moves with a bone."""

    bone: str
    surface: TriangleSurface
    cartilage: bool


@dataclass(frozen=True, eq=False, kw_only=True)
class KneeInstant:
    """One frame of the motion."""

    caption: str
    poses: Mapping[str, Floats]
    """(4, 4) pose of each bone [mm]; a bone without a pose is not drawn."""
    distance_mm: Mapping[str, Floats]
    """(V,) distance from each vertex of a cartilage to the opposite cartilage [mm]; NaN where unknown."""
    paths_mm: Sequence[Floats] = ()
    """Paths (n, 3) of the centres of proximity up to this frame, in the frame of the poses [mm]."""


def axes_of_view(view: str, *, left: bool | None) -> Floats:
    """Return the axes right, down and ahead (3, 3) of a view in the scanner's axes.

    Args:
        view: One of `VIEWS`.
        left: Whether it is a left knee; a knee of unknown side is drawn as a right one.
    """
    lateral = _LEFT if left else -_LEFT
    ahead = {"anterior": _BACK, "posterior": -_BACK, "medial": lateral, "lateral": -lateral, "plateau": -_UP}[view]
    down = _BACK if view == "plateau" else -_UP
    return np.stack([np.cross(down, ahead), down, ahead])


class KneeCamera:
    """A fixed camera for all frames of a moving knee.

    Args:
        axes: (3, 3) unit vectors right, down and ahead.
        corners_mm: (N, 3) points of all frames that must be in the image [mm].
    """

    def __init__(self, axes: Floats, corners_mm: Floats):
        self._axes = axes
        seen = corners_mm[np.isfinite(corners_mm).all(1)] @ axes.T
        low, high = (seen.min(0), seen.max(0)) if len(seen) else (np.full(3, -1.0), np.full(3, 1.0))
        self._middle = 0.5 * (low + high)
        reach = max(float((high - low)[:2].max()) / 2, 1.0)
        self._depth = _CAMERA_DISTANCE * max(reach, float(high[2] - low[2]))
        # The nearest points are magnified most.
        nearest = self._depth - 0.5 * float(high[2] - low[2])
        self._scale = 0.46 * nearest / reach

    def project(self, points_mm: Floats, size: int) -> Floats:
        """Return x, y [px] and inverse depth [1/mm] (N, 3) in a square image of the given size [px]."""
        seen = points_mm @ self._axes.T - self._middle
        inverse = 1 / (seen[:, 2] + self._depth)
        place = 0.5 * (size - 1) + self._scale * size * seen[:, :2] * inverse[:, None]
        return np.concatenate([place, inverse[:, None]], 1)

    @property
    def ahead(self) -> Floats:
        """(3,) unit vector of the viewing direction."""
        return np.asarray(self._axes[2])


class KneePicture:
    """Draw a knee frame by frame.

    Args:
        parts: Structures by name.
        cameras: Cameras by the name of the view.
        limit_mm: Distance at the end of the colour scale [mm].
        note: Text below the images.
    """

    def __init__(
        self, parts: Mapping[str, DrawnPart], cameras: Mapping[str, KneeCamera], *, limit_mm: float, note: str = ""
    ):  # fmt: skip
        self._cameras, self._limit, self._note = cameras, limit_mm, note
        self._parts = {name: _DrawnStructure.of(part) for name, part in parts.items()}

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the drawn images [px]."""
        return PANEL * len(self._cameras), PANEL + 2 * _STRIP

    def draw(self, instant: KneeInstant) -> Image:
        """Draw all views of one frame side by side: (height, width, 3) blue, green, red."""
        tints = {name: _tint(name, part, instant, self._limit) for name, part in self._parts.items()}
        panels = [self._panel(view, camera, instant, tints) for view, camera in self._cameras.items()]
        drawn = np.full((self.size[1], self.size[0], 3), _BACKGROUND, np.uint8)
        drawn[_STRIP : _STRIP + PANEL] = np.concatenate(panels, 1)
        _write(drawn, instant.caption, (10, 20), _CAPTION_COLOUR)
        self._legend(drawn)
        return drawn

    def _panel(self, view: str, camera: KneeCamera, instant: KneeInstant, tints: Mapping[str, Floats]) -> Image:
        size = PANEL * _SUPERSAMPLING
        picture, depth = np.full((size, size, 3), _BACKGROUND, np.uint8), np.zeros((size, size))
        shown = {
            name: part for name, part in self._parts.items()
            if part.bone in instant.poses and (view != "plateau" or part.bone == "tibia")
        }  # fmt: skip
        # The transparent bones are drawn after the opaque cartilage.
        for cartilage, opacity in ((True, 1.0), (False, 1.0 if view == "plateau" else _OPACITY)):
            layer = {name: part for name, part in shown.items() if part.cartilage is cartilage}
            if layer:
                seen = _draw(layer, camera, instant, tints, opacity, picture, depth)
                if not cartilage:
                    _outline(picture, seen)
        small = np.asarray(cv2.resize(picture, (PANEL, PANEL), interpolation=cv2.INTER_AREA), np.uint8)
        if not shown:
            _write(small, "no result", (PANEL // 2 - 36, PANEL // 2), _TEXT_COLOUR)
        if view == "plateau":
            for path in instant.paths_mm:
                _draw_path(small, camera, path)
        _write(small, view, (10, PANEL - 10), _TEXT_COLOUR)
        return small

    def _legend(self, drawn: Image) -> None:
        top, left, width = _STRIP + PANEL + 10, 10, 160
        scale = proximity_colours(np.linspace(0, 0.999 * self._limit, width), self._limit)[None, :, ::-1]
        drawn[top : top + 10, left : left + width] = scale
        drawn[top : top + 10, left - 8 : left] = proximity_colours(np.array([-1.0]), self._limit)[0, ::-1]
        words = f"0 to {self._limit:g} mm between cartilages; violet: overlap.  {self._note}"
        _write(drawn, words, (left + width + 10, top + 9), _TEXT_COLOUR)


@dataclass(frozen=True, eq=False)
class _DrawnStructure:
    """A structure with the quantities that are the same in all frames."""

    bone: str
    vertices: Floats
    faces: Integers
    normals: Floats
    """(T, 3) normals of the faces, smoothed over their corners."""
    cartilage: bool

    @staticmethod
    def of(part: DrawnPart) -> "_DrawnStructure":
        surface = part.surface
        normals = surface.vertex_normals[surface.faces].mean(1)
        return _DrawnStructure(part.bone, surface.vertices_mm, surface.faces, normals, part.cartilage)


def _draw(
    parts: Mapping[str, _DrawnStructure], camera: KneeCamera, instant: KneeInstant, tints: Mapping[str, Floats],
    opacity: float, picture: Image, depth: Floats,
) -> View:  # fmt: skip
    """Draw structures as one solid over an image, where they are nearer than its contents.

    Args:
        parts: The structures by name, at least one.
        camera: The camera of the view.
        instant: The frame with the poses of the bones.
        tints: Red, green and blue of each face, by structure.
        opacity: Opacity of the solid, from 0 to 1.
        picture: (h, w, 3) the image; changed in place.
        depth: (h, w) inverse depth of the opaque contents [1/mm]; changed in place.
    """
    size = len(picture)
    places, faces, colours, count = [], [], [], 0
    for name, part in parts.items():
        pose = instant.poses[part.bone]
        places.append(camera.project(part.vertices @ pose[:3, :3].T + pose[:3, 3], size))
        light = _DARKEST_FACE + (1.02 - _DARKEST_FACE) * np.maximum(part.normals @ (-camera.ahead @ pose[:3, :3]), 0.0)
        colours.append(np.minimum(tints[name] * light[:, None], 255.0))
        faces.append(part.faces + count)
        count += len(part.vertices)
    triangles: Integers = np.ascontiguousarray(np.concatenate(faces))
    seen = see(np.ascontiguousarray(np.concatenate(places)), triangles, (size, size), margin=0)
    tint = np.ascontiguousarray(np.concatenate(colours)[:, ::-1])
    _blend_faces(picture, depth, seen.face, seen.inverse_depth, seen.corner[0], seen.corner[1], tint, opacity)
    return seen


@kernel
def _blend_faces(picture, depth, face, inverse, left, top, tint, opacity):  # pragma: no cover - compiled
    """Blend faces over an image where they are nearer; opaque faces update the depth."""
    for y in range(face.shape[0]):
        for x in range(face.shape[1]):
            f = face[y, x]
            if f < 0 or inverse[y, x] <= depth[top + y, left + x]:
                continue
            for c in range(3):
                below = float(picture[top + y, left + x, c])
                picture[top + y, left + x, c] = np.uint8(opacity * tint[f, c] + (1.0 - opacity) * below)
            if opacity >= 1.0:
                depth[top + y, left + x] = inverse[y, x]


def _tint(name: str, part: _DrawnStructure, instant: KneeInstant, limit_mm: float) -> Floats:
    """Return red, green and blue of each face, (T, 3) or (1, 3)."""
    if not part.cartilage:
        return np.array([BONE], float)
    distance = instant.distance_mm.get(name, np.full(len(part.vertices), np.nan))
    corners = proximity_colours(distance, limit_mm)[part.faces].astype(float)
    return np.asarray((corners[:, 0] + corners[:, 1] + corners[:, 2]) / 3)


def _outline(picture: Image, seen: View) -> None:
    """Draw the outline of a solid."""
    x, y = seen.corner
    outlines, _ = cv2.findContours(seen.covered.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE, offset=(x, y))
    cv2.drawContours(picture, outlines, -1, (150, 140, 128), 2, cv2.LINE_AA)


def _draw_path(picture: Image, camera: KneeCamera, path_mm: Floats) -> None:
    """Draw the path of a centre; gaps are not bridged."""
    places = camera.project(path_mm, PANEL)[:, :2]
    known: Mask = np.asarray(np.isfinite(places).all(1))
    joined = known[:-1] & known[1:]
    for first, second in zip(places[:-1][joined], places[1:][joined], strict=True):
        cv2.line(picture, _pixel(first), _pixel(second), _PATH_COLOUR, 1, cv2.LINE_AA)
    if len(known) and known[-1]:
        cv2.circle(picture, _pixel(places[-1]), 4, (255, 255, 255), -1, cv2.LINE_AA)
        cv2.circle(picture, _pixel(places[-1]), 3, _PATH_COLOUR, -1, cv2.LINE_AA)


def _pixel(place: Floats) -> tuple[int, int]:
    return round(float(place[0])), round(float(place[1]))


def _write(picture: Image, text: str, at: tuple[int, int], colour: tuple[int, int, int]) -> None:
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, 1, cv2.LINE_AA)

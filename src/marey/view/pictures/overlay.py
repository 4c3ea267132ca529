"""Drawing of the fitted body over a camera's images: surface, silhouette, joints and their agreement."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np

from marey.arrays import Floats, Image, Integers, Mask
from marey.cameras import lens
from marey.cameras.camera import Camera
from marey.cameras.visibility import View, see
from marey.io.video.video_writer import VideoWriter
from marey.view.pictures.drawing import FARTHEST, FRACTION_BITS, LONGEST_SIDE
from marey.view.pictures.palette import bone_pairs, segment_colours, side_colour

OPACITY = 0.5
"""Opacity of the surface, from 0 to 1. Chosen by eye."""
SURFACE_LINE = (255, 255, 255)
"""Colour of the outline of the surface: blue, green, red."""
SILHOUETTE_LINE = (60, 230, 255)
"""Colour of the outline of the silhouette: blue, green, red. A yellow that is rare in skin and rooms."""
HIDDEN_LINE = (255, 80, 220)
"""Colour of the outline of what hides the person: blue, green, red. A violet that is rare in skin and rooms."""
_STATES = ("no person", "measured", "filled", "lost")
"""Caption of each state of a frame, see `BodyScene.state`."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyAppearance:
    """The properties of a drawn body that are the same in all frames: its faces, and the names for their colours."""

    faces: Integers
    """(T, 3) vertex indices of each face."""
    face_segment: Integers
    """(T,) index of the segment of each face."""
    segment_names: tuple[str, ...]
    joint_names: tuple[str, ...]

    @cached_property
    def face_colour(self) -> Floats:
        """(T, 3) colour of each face: blue, green, red."""
        return segment_colours(self.segment_names)[self.face_segment][:, ::-1].astype(float)

    @cached_property
    def bones(self) -> Integers:
        """(n, 2) indices of the joints that are joined by a line."""
        return bone_pairs(self.joint_names)


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyScene:
    """The result of one frame, for all cameras; None where there is none."""

    frame: int
    vertices: Floats | None = None
    """(V, 3) the posed surface [m, world]."""
    joints: Floats | None = None
    """(J, 3) joint centres [m, world]."""
    state: int = 0
    """0 no person, 1 measured, 2 filled, 3 lost."""


class OverlayVideo:
    """Writes the overlay video of one camera image by image; used as a context manager.

    Args:
        path: The video to write, see `marey.io.video.video_writer`.
        camera: The camera that took the images.
        appearance: Appearance of the body.
        rate: Frame rate [Hz].
    """

    def __init__(self, path: Path, camera: Camera, appearance: BodyAppearance, *, rate: float):
        self._camera, self._appearance = fitting_camera(camera), appearance
        self._writer = VideoWriter(path, self._camera.size, rate=rate)

    def add(
        self, image: Image, scene: BodyScene, *, mask: Mask | None = None, hidden: Mask | None = None,
        agreement: float = float("nan"),
    ) -> Image:  # fmt: skip
        """Draw one image, write it, and return it.

        Args:
            image: (height, width, 3) the camera's image, in blue, green, red.
            scene: The result of the frame.
            mask: (height, width) the silhouette.
            hidden: (height, width) where something hides the person.
            agreement: Intersection over union of surface and silhouette.
        """
        camera, appearance = self._camera, self._appearance
        drawn = draw_overlay(image, camera, appearance, scene, mask=mask, hidden=hidden, agreement=agreement)
        self._writer.add(drawn)
        return drawn

    def __enter__(self) -> "OverlayVideo":
        return self

    def __exit__(
        self, error: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.__exit__(error, value, trace)


def fitting_camera(camera: Camera) -> Camera:
    """Return the camera with its image halved until the longest side is at most `LONGEST_SIDE`."""
    factor = 1.0
    while max(camera.size) * factor > LONGEST_SIDE:
        factor /= 2
    return camera if factor == 1.0 else camera.scaled(factor)


def draw_overlay(
    image: Image,
    camera: Camera,
    appearance: BodyAppearance,
    scene: BodyScene,
    *,
    mask: Mask | None = None,
    hidden: Mask | None = None,
    agreement: float = float("nan"),
) -> Image:
    """Draw surface, outlines, joints and a line of text over an image.

    Args:
        image: (height, width, 3) blue, green, red; resized to the camera's image where it differs.
        camera: The camera of the drawing.
        appearance: Appearance of the body.
        scene: The result of the frame.
        mask: (height, width) the silhouette, of the image's size.
        hidden: (height, width) where something hides the person.
        agreement: Intersection over union of surface and silhouette.

    Returns:
        A new image of the camera's size.
    """
    drawn = _resized(image, camera.size, cv2.INTER_AREA)
    if scene.vertices is not None:
        shade_surface(drawn, camera, appearance, scene.vertices)
    for region, colour in ((hidden, HIDDEN_LINE), (mask, SILHOUETTE_LINE)):
        if region is not None:
            _draw_outline(drawn, _resized(region.astype(np.uint8), camera.size, cv2.INTER_NEAREST), colour)
    if scene.joints is not None:
        _draw_joints(drawn, camera, appearance, scene.joints)
    _write_caption(drawn, camera.name, scene, agreement)
    return drawn


def shade_surface(drawn: Image, camera: Camera, appearance: BodyAppearance, vertices: Floats) -> View:
    """Draw the half-transparent surface over an image, lit from the camera, with its outline.

    Args:
        drawn: (height, width, 3) the image; changed in place.
        camera: The camera that took the image.
        appearance: Appearance of the body.
        vertices: (V, 3) posed vertices [m, world].

    Returns:
        The visible part of the surface.
    """
    vertices = np.ascontiguousarray(vertices, float)
    projected = np.empty_like(vertices)
    lens.project_points(camera.packed, vertices, projected)
    view = see(projected, appearance.faces, camera.size)
    if view.covered.any():
        x, y = view.corner
        part = drawn[y : y + view.face.shape[0], x : x + view.face.shape[1]]
        colour = appearance.face_colour * _light(vertices, appearance.faces, camera.centre)[:, None]
        inside = view.covered
        part[inside] = (OPACITY * colour[view.face[inside]] + (1 - OPACITY) * part[inside]).astype(np.uint8)
        _draw_outline(drawn, view.mask().astype(np.uint8), SURFACE_LINE)
    return view


def _light(vertices: Floats, faces: Integers, centre: Floats) -> Floats:
    """Return the brightness (T,) of each face by its angle to the camera, smoothed over its neighbours."""
    corners = vertices[faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for i in range(3):
        np.add.at(normals, faces[:, i], area)
    smooth = normals[faces].sum(1)
    towards = centre - corners.mean(1)
    scale = np.linalg.norm(smooth, axis=1) * np.linalg.norm(towards, axis=1)
    cosine = np.einsum("ta,ta->t", smooth, towards) / np.maximum(scale, 1e-12)
    return np.asarray(0.45 + 0.6 * np.clip(cosine, 0, 1))


def _resized(image: np.ndarray, size: tuple[int, int], how: int) -> np.ndarray:
    if image.shape[:2] == (size[1], size[0]):
        return image.copy()
    return cv2.resize(image, size, interpolation=how)


def _draw_outline(drawn: Image, mask: Image, colour: tuple[int, int, int]) -> None:
    outlines, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(drawn, outlines, -1, colour, 1, cv2.LINE_AA)


def _draw_joints(drawn: Image, camera: Camera, appearance: BodyAppearance, joints: Floats) -> None:
    pixels = camera.project(joints)
    size = max(2, round(max(camera.size) / 320))
    there = np.array([bool(np.all(np.abs(pixel) < FARTHEST)) for pixel in pixels])
    points = np.zeros(pixels.shape, np.int64)
    points[there] = np.round(pixels[there] * (1 << FRACTION_BITS)).astype(np.int64)
    for thickness, colour in ((size + 2, (30, 30, 30)), (size, (255, 255, 255))):
        for a, b in appearance.bones:
            if there[a] and there[b]:
                ends = tuple(map(int, points[a])), tuple(map(int, points[b]))
                cv2.line(drawn, *ends, colour, thickness, cv2.LINE_AA, FRACTION_BITS)
    for i in np.flatnonzero(there):
        where = tuple(map(int, points[i]))
        cv2.circle(drawn, where, (size + 2) << FRACTION_BITS, (255, 255, 255), -1, cv2.LINE_AA, FRACTION_BITS)
        cv2.circle(
            drawn,
            where,
            (size + 1) << FRACTION_BITS,
            _bgr(side_colour(appearance.joint_names[i])),
            -1,
            cv2.LINE_AA,
            FRACTION_BITS,
        )


def _bgr(text: str) -> tuple[int, int, int]:
    return int(text[5:7], 16), int(text[3:5], 16), int(text[1:3], 16)


def _write_caption(drawn: Image, name: str, scene: BodyScene, agreement: float) -> None:
    """Write camera, frame, state and agreement on a dark strip."""
    text = f"{name}   frame {scene.frame}   {_STATES[scene.state]}"
    if np.isfinite(agreement):
        text += f"   agreement {agreement:.2f}"
    scale = max(0.45, drawn.shape[1] / 1600)
    (width, height), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
    strip = drawn[: height + below + 10, : width + 20]
    strip[:] = (strip * 0.35).astype(np.uint8)
    cv2.putText(drawn, text, (10, height + 6), cv2.FONT_HERSHEY_SIMPLEX, scale, (245, 245, 245), 1, cv2.LINE_AA)

"""Regions of the images in which people other than the followed one are."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from marey.arrays import Floats, Image, Integers, Mask
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.cameras import lens
from marey.cameras.camera import Camera
from marey.cameras.visibility import see
from marey.fit.recipes.other_people import FiguresByImage
from marey.fit.recipes.person_figures import draw_figures
from marey.images.silhouettes.densities import colour_density
from marey.images.silhouettes.other_person import TwoColours, other_region
from marey.images.silhouettes.part_colours import LEAST_PIXELS, RING_SCALE, PartColours

FIGURE_SD_M = 0.04
"""Standard deviation of the outline of a figure [m]. Chosen by hand."""
OUTLINE_SD_PX = 1.5
"""Standard deviation of the outline of another person that was segmented, at 640 x 480 [px]. Chosen by hand."""
CAPTURED_SD_M = 0.015
"""Standard deviation of the outline of a captured person: clothes [m]. Chosen by hand."""
NEAR_SDS = 1.5
"""Distance from another person up to which a pixel may still show that person, in standard deviations of the outline.
Chosen by hand."""


@dataclass(frozen=True, eq=False)
class OtherRegions:
    """Where other people are in one image."""

    front: Mask
    """(height, width) true where they are in front of the followed person."""
    behind: Mask
    """(height, width) true where they are behind the followed person."""
    sd_px: float
    """Standard deviation of the outlines [px]."""

    @property
    def near(self) -> Mask:
        """(height, width) true where they may be: such a pixel is no evidence for the followed person."""
        return widened(self.front | self.behind, NEAR_SDS * self.sd_px)

    def refined(self, image: Image, colours: TwoColours, followed: Mask) -> "OtherRegions":
        """Segment the other people in an image.

        Args:
            image: (height, width, C) uint8.
            colours: Colours of the followed person and of other people.
            followed: (height, width) where the followed person is predicted.
        """
        near = widened(followed, NEAR_SDS * self.sd_px)
        front, behind = (
            other_region(image, figure, self.sd_px, colours, near) if figure.any() else figure
            for figure in (self.front, self.behind)
        )
        return OtherRegions(front, behind, OUTLINE_SD_PX * float(np.sqrt(front.size)) / RING_SCALE)


def widened(region: Mask, distance: float) -> Mask:
    """Return the pixels up to a distance from a region [px]."""
    if not region.any():
        return region
    away = cv2.distanceTransform(np.ascontiguousarray(~region).view(np.uint8), cv2.DIST_L2, 3)
    return np.asarray(away <= distance)


class OtherPeople(Protocol):
    """Other people of a take, from whatever source."""

    def regions(self, frame: int, number: int, camera: Camera, place: Floats) -> OtherRegions | None:
        """Return where other people are in an image; None if there is nobody else."""


@dataclass(frozen=True, eq=False)
class OtherFigures:
    """Other people of a take as figures from detected joints."""

    joint_names: Sequence[str]
    """Names of the joints of the figures."""
    figures: FiguresByImage
    widths: Sequence[int] = ()
    """Width of the full image of each camera, in which the figures' joints are measured [px]; empty without figures."""

    def regions(self, frame: int, number: int, camera: Camera, place: Floats) -> OtherRegions | None:
        """Return where other people are in an image.

        Args:
            frame: The frame.
            number: Number of the camera.
            camera: The camera.
            place: (3,) place of the followed person in the world [m].

        Returns:
            The regions; None if there is nobody else.
        """
        full = self.figures.get((frame, number), ())
        if not full:
            return None
        others = [figure.scaled(camera.width / self.widths[number]) for figure in full]
        away = float(np.linalg.norm(place - camera.centre))
        front = [figure for figure in others if figure.distance_m < away]
        behind = [figure for figure in others if figure.distance_m >= away]
        scale = float(camera.matrix[0, 0]) / min(figure.distance_m for figure in others)
        return OtherRegions(
            draw_figures(camera, self.joint_names, front),
            draw_figures(camera, self.joint_names, behind),
            FIGURE_SD_M * scale,
        )


@dataclass(frozen=True, eq=False)
class CapturedPerson:
    """Another person of a take whose motion was captured before: its posed skin."""

    vertices: Floats
    """(F, V, 3) in the world [m]; NaN in frames without a pose."""
    faces: Integers
    """(T, 3) the vertices of each face."""

    def regions(self, frame: int, number: int, camera: Camera, place: Floats) -> OtherRegions | None:
        """Return where the person is in an image.

        Args:
            frame: The frame.
            number: Number of the camera.
            camera: The camera.
            place: (3,) place of the followed person in the world [m].

        Returns:
            The regions; None without a pose.
        """
        skin = self.vertices[frame]
        return _regions_of_skin(skin, self.faces, camera, place, CAPTURED_SD_M) if np.isfinite(skin).all() else None


@dataclass(frozen=True, eq=False)
class PosedPerson:
    """Another person of a take as a body with poses."""

    body: Body
    poses: Mapping[int, Pose]
    outline_sd_m: float
    """Standard deviation of the outline [m]."""

    def regions(self, frame: int, number: int, camera: Camera, place: Floats) -> OtherRegions | None:
        """Return where the person is in an image; see `CapturedPerson.regions`."""
        if frame not in self.poses:
            return None
        skin = PosedBody(self.body, self.poses[frame]).vertices
        return _regions_of_skin(skin, self.body.faces, camera, place, self.outline_sd_m)


def _regions_of_skin(
    skin: Floats, faces: Integers, camera: Camera, place: Floats, outline_sd_m: float
) -> OtherRegions:  # fmt: skip
    """Return where a posed skin (V, 3) is in an image, before or behind a place (3,)."""
    projected = np.empty_like(skin)
    lens.project_points(camera.packed, skin, projected)
    drawn, nothing = see(projected, faces, camera.size).mask(), np.zeros((camera.height, camera.width), bool)
    away = float(np.linalg.norm(skin.mean(axis=0) - camera.centre))
    nearer = away < float(np.linalg.norm(place - camera.centre))
    sd_px = outline_sd_m * float(camera.matrix[0, 0]) / away
    return OtherRegions(drawn, nothing, sd_px) if nearer else OtherRegions(nothing, drawn, sd_px)


@dataclass(frozen=True, eq=False)
class JoinedPeople:
    """Other people of a take from several sources."""

    parts: Sequence[OtherPeople]

    def regions(self, frame: int, number: int, camera: Camera, place: Floats) -> OtherRegions | None:
        """Return where other people are in an image; see `OtherPeople`."""
        seen = [part.regions(frame, number, camera, place) for part in self.parts]
        known = [regions for regions in seen if regions is not None]
        if not known:
            return None
        front, behind = (np.any([getattr(each, side) for each in known], axis=0) for side in ("front", "behind"))
        return OtherRegions(front, behind, max(each.sd_px for each in known))


class OtherColourSums:
    """Colours of other people in all cameras, collected from images.

    Args:
        cameras: Number of cameras.
    """

    def __init__(self, cameras: int):
        self._sums: list[Floats | None] = [None] * cameras

    def add(self, camera: int, image: Image, others: OtherRegions, followed: Mask) -> None:
        """Add an image.

        Args:
            camera: Number of the camera.
            image: (height, width, C) uint8.
            others: Where other people are.
            followed: (height, width) where the followed person is, in front of those behind.
        """
        figures = np.ascontiguousarray(others.front | (others.behind & ~followed)).view(np.uint8)
        core = cv2.distanceTransform(figures, cv2.DIST_L2, 3) > others.sd_px
        pixels = int(np.count_nonzero(core))
        if pixels >= LEAST_PIXELS:
            more = colour_density(image, core) * np.float32(pixels)
            own = self._sums[camera]
            self._sums[camera] = more if own is None else own + more

    def learned(self, followed: Sequence[PartColours]) -> list[TwoColours | None]:
        """Return the colours of the followed person and of other people in each camera; None where nobody was seen.

        Args:
            followed: Colours of the parts of the followed person in each camera.
        """
        return [
            None if own is None else TwoColours(parts.density.mean(axis=0), own / (own.sum() * _cell_volume(own)))
            for own, parts in zip(self._sums, followed, strict=True)
        ]


def _cell_volume(density: Floats) -> float:
    """Return the volume of a cell of a density, in grey levels of all channels."""
    return float((256 / density.shape[0]) ** density.ndim)

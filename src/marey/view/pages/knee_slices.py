"""Slices of an MR volume with the outlines of the segmented structures, upright and in true proportions."""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from marey.arrays import Floats, Image, Integers
from marey.knee.outlines.contours import AXES, slice_count, slice_of, slice_shape
from marey.knee.space.structures import LABELS
from marey.knee.space.volume import Labels, Volume, VoxelGrid
from marey.view.pages.html import STILL_WIDTH, Still
from marey.view.pictures.knee_maps import STRUCTURE_COLOURS
from marey.view.pictures.slice_display import displayed

SLICES = 12
"""Number of slices on a page at most; chosen by hand."""
LETTERS = {"right": "R", "left": "L", "front": "A", "back": "P", "feet": "F", "head": "H"}
"""Letters of the directions of the patient, as on scanners."""
WINDOW = (1.0, 99.5)
"""Percentiles of the volume shown black and white [%]; chosen by eye."""
_ALIKE = 1.2
"""Ratio of the largest to the smallest voxel spacing below which a volume counts as isotropic; chosen by hand."""
_MARGIN_PX, _LINE_PX = 16, 2
"""Distance of the letters from the border, and width of outlines [px]; chosen by eye."""
_WHITE, _BLACK = (255, 255, 255), (0, 0, 0)
"""Colours of the letters and of their rims."""


def slices_with_outlines(volume: Volume, labels: Labels, *, most: int = SLICES) -> list[Still]:
    """Draw slices at even distances through the structures, along the slice axis of the volume.

    Args:
        volume: The image.
        labels: Labels on the same grid, not all empty.
        most: Number of slices at most.

    Returns:
        Images with the head or the anterior side at the top, and the anterior side or the right of the patient at the
        left.
    """
    grid = volume.grid
    axis = main_axis(grid)
    screen = _Screen.of(grid, axis)
    window = np.percentile(volume.intensity, WINDOW)
    return [
        Still(
            caption=f"slice {axis} = {index} · {_place(grid, axis, index)}",
            image=_drawn(
                slice_of(volume.intensity, axis, index), slice_of(labels.labels, axis, index), screen, window
            ),
        )
        for index in _chosen(labels, axis, most).tolist()
    ]  # fmt: skip


def main_axis(grid: VoxelGrid) -> str:
    """Return the voxel axis along which slices are stacked: that of the largest spacing.

    If the spacings are similar, it is the medial-lateral axis, because knees are usually viewed in sagittal slices.
    """
    spacing = grid.spacing_mm
    if spacing.max() < _ALIKE * spacing.min():
        return AXES[int(np.argmax(np.abs(grid.lps_from_voxel[0, :3]) / spacing))]
    return AXES[int(np.argmax(spacing))]


def _chosen(labels: Labels, axis: str, most: int) -> Integers:
    """Return evenly spaced slices between the first and the last that contain a structure, without these two."""
    every = slice_count(labels.grid, axis)
    held = np.flatnonzero([slice_of(labels.labels, axis, index).any() for index in range(every)])
    return np.unique(np.round(np.linspace(held[0], held[-1], most + 2)[1:-1]).astype(int))


def _place(grid: VoxelGrid, axis: str, index: int) -> str:
    """Format the position of the centre of a slice as scanners do: L 12.3 mm."""
    along = AXES.index(axis)
    k, j, i = ((count - 1) / 2 for count in grid.shape)
    voxel = np.array([i, j, k])
    voxel[along] = index
    main = int(np.argmax(np.abs(grid.lps_from_voxel[:3, along])))
    place = float(grid.lps(voxel)[main])
    return f"{('RL', 'AP', 'FH')[main][place > 0]} {abs(place):.1f} mm"


@dataclass(frozen=True, eq=False)
class _Screen:
    """Placement of a slice in its image."""

    size: tuple[int, int]
    """Width and height [px]."""
    screen_from_pixel: Floats
    """(2, 3) from columns and rows of the slice, with integer centres, to x and y of the image."""
    letters: tuple[str, ...]
    """Letters at the left, right, top and bottom."""

    @staticmethod
    def of(grid: VoxelGrid, axis: str) -> "_Screen":
        """Place the slices along an axis; the longer side has the width of the images of the page."""
        shown, (rows, columns) = displayed(grid, axis), slice_shape(grid, axis)
        matrix = np.reshape(np.array(shown["screen_mm"], float), (2, 2))
        corners = np.array([[x, y] for x in (-0.5, columns - 0.5) for y in (-0.5, rows - 0.5)]) @ matrix.T
        reach = corners.max(0) - corners.min(0)
        scale = STILL_WIDTH / float(reach.max())
        width, height = np.maximum(np.round(scale * reach), 1).astype(int).tolist()
        # The first pixel of the image has its centre at 0 and its border at -0.5.
        shift = -scale * corners.min(0) - 0.5
        letters = tuple(LETTERS[word] for word in shown["sides"])  # type: ignore[attr-defined]
        return _Screen((width, height), np.concatenate([scale * matrix, shift[:, None]], 1), letters)

    def warped(self, part: Floats, *, beyond: int) -> np.ndarray:
        """Warp a slice (rows, columns) into the image; `beyond` is the border type of `cv2`."""
        warped: np.ndarray = cv2.warpAffine(
            np.ascontiguousarray(part, np.float32), self.screen_from_pixel, self.size, flags=cv2.INTER_LINEAR,
            borderMode=beyond,
        )  # fmt: skip
        return warped


def _drawn(part: np.ndarray, labels: np.ndarray, screen: _Screen, window: Floats) -> Image:
    low, high = window
    grey = 255 * np.clip((screen.warped(part, beyond=cv2.BORDER_REPLICATE) - low) / max(high - low, 1e-6), 0, 1)
    picture: Image = np.repeat(np.round(grey).astype(np.uint8)[..., None], 3, axis=2)
    for name, colour in STRUCTURE_COLOURS.items():
        here = labels == LABELS[name]
        if not here.any():
            continue
        # Between voxel centres the edge is where the interpolated label is one half.
        inside = screen.warped(here, beyond=cv2.BORDER_REPLICATE) >= 0.5
        outlines, _ = cv2.findContours(inside.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(picture, outlines, -1, _bgr(colour), _LINE_PX, cv2.LINE_AA)
    _write_letters(picture, screen)
    return picture


def _write_letters(picture: Image, screen: _Screen) -> None:
    width, height = screen.size
    middle, beside = (width // 2, height // 2), (_MARGIN_PX, width - _MARGIN_PX)
    places = [*((x, middle[1]) for x in beside), (middle[0], _MARGIN_PX), (middle[0], height - _MARGIN_PX)]
    for letter, (x, y) in zip(screen.letters, places, strict=True):
        (wide, tall), _ = cv2.getTextSize(letter, cv2.FONT_HERSHEY_SIMPLEX, 0.7, 2)
        start = x - wide // 2, y + tall // 2
        cv2.putText(picture, letter, start, cv2.FONT_HERSHEY_SIMPLEX, 0.7, _BLACK, 5, cv2.LINE_AA)
        cv2.putText(picture, letter, start, cv2.FONT_HERSHEY_SIMPLEX, 0.7, _WHITE, 2, cv2.LINE_AA)


def _bgr(colour: str) -> tuple[int, ...]:
    return tuple(int(colour[i : i + 2], 16) for i in (5, 3, 1))


def keys_of(labels: Labels) -> Mapping[str, str]:
    """Return the structures in the labels with the colours of their outlines."""
    return {name: colour for name, colour in STRUCTURE_COLOURS.items() if (labels.labels == LABELS[name]).any()}

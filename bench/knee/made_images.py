"""Made MR volumes of other knees: the shared knees' tissues deformed and imaged again, with exact truth.

A made person is a label map of the recordings under a smooth random change of place: size, shear, bumps of
centimetres. The image resembles those of data/knee: one level per tissue, measured there, a dark line of cortex where
no cartilage is, texture, a bias of the coil, Rician noise.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from scipy import ndimage

from marey.geometry import rotations
from marey.io.mr.volumes import read_volume
from marey.knee.space.distances import signed_distance
from marey.knee.space.resampling import on_grid, resampled, upright_grid
from marey.knee.space.structures import BONES, CARTILAGE_OF_BONE, LABELS
from marey.knee.space.volume import Labels, Volume, VoxelGrid

SOURCE_MM = 0.6
CORTEX_MM = 1.0
KINDS = ("dark", "bright")
LEVELS = {
    "dark": {"marrow": 15.0, "cortex": 4.0, "fat": 25.0, "muscle": 50.0, "cartilage": 140.0},
    "bright": {"marrow": 120.0, "cortex": 14.0, "fat": 138.0, "muscle": 52.0, "cartilage": 78.0},
}
"""Of fat-suppressed SPGR and of T1, medians in the shared images."""
TEXTURE = 0.065
NOISE = 4.5
BUMPS = ((60.0, 4.0), (28.0, 1.2))
"""Width and standard deviation [mm] of the changes of place."""
SIZE_SD, SHEAR_SD = 0.07, 0.03
NODE_MM = 3.0
FALL_OFF_MM = 70.0
ORIENTATIONS = {"axial": (0, 1, 2), "sagittal": (1, 2, 0), "coronal": (0, 2, 1)}
"""Which of left, back and head each of the image's axes i, j, k runs along."""


@dataclass(frozen=True, kw_only=True)
class Make:
    """What a made person and their image are like."""

    source: str = "phantom_spl"
    """Whose label map is bent: `phantom_spl`, all tissues of the atlas, or `phantom_a`."""
    kind: str = "dark"
    seed: int = 0
    """Of the person; the same for two images of one knee. 0 is the source itself."""
    mirror: bool = False
    noise: float = 1.0
    """As a multiple of that of the shared images."""
    bias: float = 0.3
    fall_off: float = 0.0
    """Share of the signal that is lost 70 mm above and below the image's middle, as where a coil ends."""
    spacing_mm: tuple[float, float, float] = (0.55, 0.55, 1.0)
    """In plane twice, and of the slices."""
    orientation: str = "axial"
    turn_deg: float = 0.0
    """Of the image's axes against the body's, about (1, 1, 1)."""
    cut_mm: tuple[float, float] = (4.0, 4.0)
    """How much of the limb is not in the image, above and below."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Tissues:
    """A label map with what a scanner would see of it, on an upright grid."""

    labels: np.ndarray
    """(k, j, i) numbers of `LABELS`."""
    levels: dict[str, np.ndarray]
    """Kind of marrow to (k, j, i) signal."""
    grid: VoxelGrid


@cache
def tissues(shared: Path, source: str) -> Tissues:
    """Take a shared knee apart."""
    folder = shared / "data" / "knee"
    fine = read_volume(folder / source / "truth_labels_fine.nii.gz")
    image = read_volume(folder / source / "image.nii.gz")
    grid = upright_grid(image.grid, SOURCE_MM)
    labels = np.zeros(grid.shape, dtype=np.uint8)
    for number in LABELS.values():
        labels[resampled((fine.intensity == number).astype(np.float32), fine.grid, grid) > 0.5] = number
    seen = on_grid(image, grid, 0.9)
    body = ndimage.binary_opening(seen > 12, iterations=2) | (labels > 0)
    body = np.stack([ndimage.binary_fill_holes(each) for each in body])
    # A ball of gadolinium is no tissue; what is half cartilage is no muscle.
    muscle = ndimage.binary_opening((seen > 36) & (labels == 0), iterations=2)
    levels = {}
    for kind in KINDS:
        level = np.where(body, np.where(muscle, LEVELS[kind]["muscle"], LEVELS[kind]["fat"]), 0.0)
        if source == "phantom_spl":
            level = _with_atlas(folder, kind, grid, level)
        for bone in BONES:
            level = _with_bone(level, labels, bone, kind)
        levels[kind] = level.astype(np.float32)
    return Tissues(labels=labels, levels=levels, grid=grid)


def _with_atlas(folder: Path, kind: str, grid: VoxelGrid, level: np.ndarray) -> np.ndarray:
    """(k, j, i) with the atlas' muscles, tendons and vessels: their medians in the shared images."""
    atlas = read_volume(folder / "atlas" / "labels.nii.gz")
    image = read_volume(folder / ("phantom_spl" if kind == "dark" else "phantom_spl_t1") / "image.nii.gz")
    there = resampled(atlas.intensity, atlas.grid, image.grid, order=0).astype(int)
    here = resampled(atlas.intensity, atlas.grid, grid, order=0).astype(int)
    level = np.where((level > 0) & (here == 0), LEVELS[kind]["fat"], level)
    for value in np.unique(there[there > 0]):
        where = there == value
        inner = ndimage.binary_erosion(where)
        level[here == value] = np.median(image.intensity[inner if inner.sum() > 50 else where])
    # The fibula is a bone, too.
    fibula = here == 97
    return _bone_level(level, fibula, np.ones_like(fibula), kind)


def _with_bone(level: np.ndarray, labels: np.ndarray, bone: str, kind: str) -> np.ndarray:
    cartilage = labels == LABELS[CARTILAGE_OF_BONE[bone]]
    bare = ndimage.distance_transform_edt(~cartilage) * SOURCE_MM > 1.2
    level = np.where(cartilage, LEVELS[kind]["cartilage"], level)
    return _bone_level(level, labels == LABELS[bone], bare, kind)


def _bone_level(level: np.ndarray, inside: np.ndarray, bare: np.ndarray, kind: str) -> np.ndarray:
    depth = signed_distance(inside, (SOURCE_MM, SOURCE_MM, SOURCE_MM))
    line = (depth < CORTEX_MM) & bare
    return np.where(inside, np.where(line, LEVELS[kind]["cortex"], LEVELS[kind]["marrow"]), level)


def made_knee(shared: Path, make: Make) -> tuple[Volume, Labels]:
    """Make the image and the labels of a person."""
    source = tissues(shared, make.source)
    grid = _image_grid(source.grid, make)
    level = source.levels[make.kind]
    draw = np.random.default_rng([make.seed, KINDS.index(make.kind), 77])
    texture = _patches(source.grid.shape, 1.0 / SOURCE_MM, draw)
    texture *= np.float32(TEXTURE)
    bend = _Bend(source.grid, make)
    masks = {number: (source.labels == number).astype(np.uint8) for number in LABELS.values()}
    labels, signal = np.zeros(grid.shape, dtype=np.uint8), np.zeros(grid.shape, dtype=np.float32)
    for index in range(grid.shape[0]):
        for offset in (-0.33, 0.33, 0.0):  # A slice is thick.
            at = bend.source_voxels(_slice_places(grid, index + offset))
            signal[index] += ndimage.map_coordinates(level, at, order=1, mode="nearest") / 3
        labels[index] = _labels_at(masks, at)
        signal[index] *= 1 + ndimage.map_coordinates(texture, at, order=1)
    return Volume(intensity=_scanned(signal, grid, make, draw), grid=grid), Labels(labels=labels, grid=grid)


def _labels_at(masks: dict[int, np.ndarray], at: np.ndarray) -> np.ndarray:
    """Numbers of the tissues that fill most of each place, as smooth as the image: the nearest are stairs of 0.6 mm."""
    found = np.zeros(at.shape[1:], dtype=np.uint8)
    most = np.full(at.shape[1:], 0.5, dtype=np.float32)
    for number, mask in masks.items():
        share = ndimage.map_coordinates(mask, at, output=np.float32, order=1, mode="nearest")
        found[share > most] = number
        most = np.maximum(most, share)
    return found


class _Bend:
    """Where in the source each place of the made person lies."""

    def __init__(self, grid: VoxelGrid, make: Make) -> None:
        self._grid, self._mirror = grid, make.mirror
        self._middle = grid.lps((np.array(grid.shape[::-1]) - 1) / 2)
        draw = np.random.default_rng([make.seed, 5])
        amount = 1.0 if make.seed else 0.0
        size = 1 + amount * SIZE_SD * np.clip(draw.normal(size=3), -1.5, 1.5)
        shear = amount * SHEAR_SD * np.triu(draw.normal(size=(3, 3)), 1)
        self._matrix = np.diag(size) + shear
        counts = [int(1.3 * n * SOURCE_MM / NODE_MM) + 2 for n in grid.shape]
        self._moves = amount * sum(
            deviation * np.stack([_patches(counts, width / 2 / NODE_MM, draw) for _ in range(3)])
            for width, deviation in BUMPS
        )

    def source_voxels(self, lps_mm: np.ndarray) -> np.ndarray:
        """(3, ...) k, j, i of places (..., 3)."""
        away = (lps_mm - self._middle) * ([-1.0, 1.0, 1.0] if self._mirror else 1.0)
        half = np.array(self._moves.shape[1:]) / 2
        node = np.moveaxis(away[..., ::-1] / NODE_MM + half, -1, 0)
        moved = away @ self._matrix.T
        for axis, moves in enumerate(self._moves):
            moved[..., axis] += ndimage.map_coordinates(moves, node, order=1, mode="nearest")
        return np.moveaxis(self._grid.voxels(moved + self._middle)[..., ::-1], -1, 0)


def _patches(shape: tuple[int, ...] | list[int], sigma: float, draw: np.random.Generator) -> np.ndarray:
    """Smooth noise of standard deviation 1."""
    rough = ndimage.gaussian_filter(draw.normal(size=shape).astype(np.float32), sigma, mode="wrap", truncate=3)
    return np.asarray(rough / rough.std())


def _slice_places(grid: VoxelGrid, slice_: float) -> np.ndarray:
    j, i = np.meshgrid(np.arange(grid.shape[1]), np.arange(grid.shape[2]), indexing="ij")
    return grid.lps(np.stack([i, j, np.full(i.shape, slice_)], axis=-1).astype(float))


def _image_grid(source: VoxelGrid, make: Make) -> VoxelGrid:
    """The image's grid about the source's extent, less what is cut."""
    extent = (np.array(source.shape[::-1]) - 1.0) * source.spacing_mm
    low = source.lps(np.zeros(3))
    extent[2] -= sum(make.cut_mm)
    low[2] += make.cut_mm[1]
    middle = low + extent / 2
    turn = rotations.exp(np.radians(make.turn_deg) * np.ones(3) / np.sqrt(3))
    axes = turn @ np.eye(3)[:, ORIENTATIONS[make.orientation]]
    counts = (extent[list(ORIENTATIONS[make.orientation])] / make.spacing_mm).astype(int) + 1
    lps_from_voxel = np.eye(4)
    lps_from_voxel[:3, :3] = axes * make.spacing_mm
    lps_from_voxel[:3, 3] = middle - lps_from_voxel[:3, :3] @ ((counts - 1) / 2)
    i, j, k = counts.tolist()
    return VoxelGrid(shape=(k, j, i), lps_from_voxel=lps_from_voxel)


def _scanned(signal: np.ndarray, grid: VoxelGrid, make: Make, draw: np.random.Generator) -> np.ndarray:
    coarse = _patches([6, 6, 6], 1.2, draw)
    places = np.stack(np.meshgrid(*[np.linspace(1, 4, n) for n in grid.shape], indexing="ij"))
    bias = 1 + make.bias * np.clip(ndimage.map_coordinates(coarse, places, order=3) / 2, -1, 1)
    bias *= _sensitivity(grid, make)
    noise = NOISE * make.noise
    real, imaginary = (draw.normal(0, noise, grid.shape) for _ in range(2))
    return np.hypot(signal * bias + real, imaginary).astype(np.float32)


def _sensitivity(grid: VoxelGrid, make: Make) -> np.ndarray:
    """(k, j, i) of a coil about the middle: a Gaussian along the body."""
    k, j, i = np.meshgrid(*[np.arange(n) for n in grid.shape], indexing="ij")
    height = grid.lps(np.stack([i, j, k], axis=-1).astype(float))[..., 2]
    away = (height - (height.min() + height.max()) / 2) / FALL_OFF_MM
    return np.exp(np.log(1 - make.fall_off) * away**2)

"""Cartilage measured on made subjects: knees warped to another anatomy, with cartilage of another thickness.

A label map of the recordings is warped smoothly; its cartilage is made thicker or thinner by a smooth field, its rims
are moved over the bone, and a round lesion is cut into the femur's and the tibia's. The image has the grey values,
partial volume, bias and noise of the simulated volumes of data/knee; the template is another person's. The true bones
are given.
"""

import argparse
import time
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from bench.declaration import Bench
from bench.knee.cartilage import begin, fill, surfaces_of
from bench.recording import Run
from marey.io.mr.volumes import read_template
from marey.knee.cartilage.knee_cartilage import find_knee_cartilage, knee_template
from marey.knee.cartilage.labels import with_cartilage
from marey.knee.cartilage.thickness import cartilage_thickness
from marey.knee.space.distances import signed_distance
from marey.knee.space.resampling import part_of, read_at, resampled, smoothed, upright_grid
from marey.knee.space.structures import BONES, CARTILAGE_OF_BONE, LABELS
from marey.knee.space.surfacing import surface_of_labels
from marey.knee.space.volume import Labels, Volume, VoxelGrid

BENCH = Bench(
    measures="Cartilage and its thickness of made knees, against exact truth.",
    sources=("src/marey/knee/space", "src/marey/knee/bones", "src/marey/knee/cartilage", "src/marey/knee/registration"),
    minutes=6,
)

LEVELS = {
    "dark": {"marrow": 14, "cortex": 14, "cartilage": 120, "fat": 26, "muscle": 62, "meniscus": 40},
    "bright": {"marrow": 120, "cortex": 12, "cartilage": 80, "fat": 130, "muscle": 62, "meniscus": 15},
}
CORTEX_MM = 1.2
FINE_MM = 0.45


@dataclass(frozen=True, kw_only=True)
class Anatomy:
    """How a made knee differs from the one whose labels are warped."""

    warp_mm: float = 2.5
    """Standard deviation of the displacement along each axis."""
    warp_length_mm: float = 18.0
    """Standard deviation of the Gaussian by which it is smooth."""
    thickness: float = 1.0
    """The cartilage is so many times as thick in the middle (geometric mean)."""
    varied: float = 0.2
    """Standard deviation of the logarithm of the thickness's factor over the bone."""
    varied_mm: float = 8.0
    shift_mm: float = 2.0
    """Standard deviation of how far the cartilage's rims are moved over the bone, along each axis."""
    lesions: int = 1
    """Round places, 4 mm in radius, at which the cartilage is gone, on femur and tibia each."""
    margin_mm: float | None = 14.0
    """Only so much about the cartilage is kept; None keeps everything."""


@dataclass(frozen=True, kw_only=True)
class Scan:
    """How the image was taken."""

    kind: str = "dark"
    spacing_mm: tuple[float, float, float] = (0.37, 0.37, 1.4)
    """In the slice, in the slice, and from slice to slice."""
    slices: str = "sagittal"
    noise: float = 5.0
    bias: float = 0.3


CASES = {
    "thick": ("template_a", "atlas", 11, Anatomy(thickness=1.3),
              (Scan(), Scan(noise=10.0), Scan(kind="bright", spacing_mm=(0.55, 0.55, 1.0), slices="axial"))),
    "varied": ("atlas", "template_a", 13, Anatomy(varied=0.25),
               (Scan(spacing_mm=(0.47, 0.47, 1.3)), Scan(noise=10.0, spacing_mm=(0.31, 0.31, 1.5)),
                Scan(kind="bright", spacing_mm=(0.55, 0.55, 1.0), slices="axial"))),
}  # fmt: skip
"""Whose labels, whose template, the seed, what is changed, and the images."""


def made_anatomy(labels: Labels, random: np.random.Generator, anatomy: Anatomy) -> Labels:
    """The made knee's labels on cubes of `FINE_MM`."""
    cubes = upright_grid(_kept(labels, anatomy.margin_mm), FINE_MM)
    places = _places(cubes)
    for axis in range(3):
        places[..., axis] += anatomy.warp_mm * _smooth_noise(random, cubes, anatomy.warp_length_mm)
    fields = {
        name: read_at(
            signed_distance(labels.mask(name), labels.grid.array_spacing_mm), labels.grid, places, outside=-9.0
        )
        for name in LABELS
        if labels.mask(name).any()
    }
    made = np.zeros(cubes.shape, np.uint8)
    inside = np.zeros(cubes.shape)
    for bone in BONES:
        made[(fields[bone] > 0) & (fields[bone] > inside)] = LABELS[bone]
        inside = np.maximum(inside, fields[bone])
    bones = made.copy()
    share = np.full(cubes.shape, np.inf)
    for bone in BONES:
        cartilage = CARTILAGE_OF_BONE[bone]
        before = np.where((fields[cartilage] > 0) & (bones == 0), LABELS[cartilage], bones)
        _lay(Labels(labels=before, grid=cubes), bone, random, anatomy, made, share)
    return Labels(labels=made, grid=cubes)


def _lay(
    before: Labels, bone: str, random: np.random.Generator, anatomy: Anatomy, made: np.ndarray, share: np.ndarray
) -> None:
    """Lay cartilage of the made thickness on a bone; where two meet, each has its share."""
    surface = surface_of_labels(before, bone)
    vertices = surface.vertices_mm
    thickness = cartilage_thickness(surface, [surface_of_labels(before, CARTILAGE_OF_BONE[bone])])
    grid = before.grid
    tree = cKDTree(vertices)
    moved = np.stack([_read_noise(random, grid, 10.0, vertices) for _ in range(3)], axis=-1)
    thickness = thickness[tree.query(vertices + anatomy.shift_mm * moved)[1]]
    factor = anatomy.thickness * np.exp(anatomy.varied * _read_noise(random, grid, anatomy.varied_mm, vertices))
    thickness = thickness * factor
    if bone != "patella":
        for _ in range(anatomy.lesions):
            middle = vertices[random.choice(np.flatnonzero(thickness > 1.5))]
            thickness[np.linalg.norm(vertices - middle, axis=1) < 4.0] = 0.0
    height = -signed_distance(before.mask(bone), grid.array_spacing_mm)
    shell = np.argwhere((height > 0) & (height < thickness.max() + 1) & (before.labels != LABELS[bone]))
    shell = shell[np.isin(made[tuple(shell.T)], [LABELS[each] for each in BONES], invert=True)]
    far, near = tree.query(grid.lps(shell[:, ::-1]), k=3, distance_upper_bound=12.0)
    weights = 1 / np.maximum(far, 0.3)
    here = (np.append(thickness, 0.0)[near] * weights).sum(1) / np.maximum(weights.sum(1), 1e-9)
    at = tuple(shell.T)
    ratio = np.where(here > 0.3, height[at] / np.maximum(here, 1e-9), np.inf)
    won = (ratio <= 1) & (ratio < share[at])
    spots = tuple(axis[won] for axis in at)
    share[spots] = ratio[won]
    made[spots] = LABELS[CARTILAGE_OF_BONE[bone]]


def made_image(fine: Labels, random: np.random.Generator, scan: Scan) -> tuple[Volume, Labels]:
    """The image of a made knee and its labels on the image's grid."""
    grid = _image_grid(fine.grid, scan)
    levels = _tissue_levels(fine, random, scan.kind)
    image, votes = np.zeros(grid.shape), np.zeros((max(LABELS.values()) + 1, *grid.shape), np.float32)
    parts = [max(round(edge / FINE_MM), 2) for edge in scan.spacing_mm]
    for step in np.ndindex(*parts):
        offset = np.array([(n + 0.5) / count - 0.5 for n, count in zip(step, parts, strict=True)])
        moved = grid.lps_from_voxel.copy()
        moved[:3, 3] = grid.lps(offset)
        here = VoxelGrid(shape=grid.shape, lps_from_voxel=moved)
        image += resampled(levels, fine.grid, here, order=0) / np.prod(parts)
        label = resampled(fine.labels, fine.grid, here, order=0)
        for value in range(len(votes)):
            votes[value] += label == value
    image *= np.exp(scan.bias * 0.5 * _slow(random, grid))
    noisy = np.hypot(image + random.normal(0, scan.noise, grid.shape), random.normal(0, scan.noise, grid.shape))
    return Volume(intensity=noisy, grid=grid), Labels(labels=votes.argmax(0).astype(np.uint8), grid=grid)


def _tissue_levels(fine: Labels, random: np.random.Generator, kind: str) -> np.ndarray:
    level = LEVELS[kind]
    about = _smooth_noise(random, fine.grid, 4.0)
    image = np.where(about > 0.9, level["muscle"], np.where(about < -1.2, level["meniscus"], level["fat"])).astype(
        float
    )
    cartilages = np.isin(fine.labels, [LABELS[each] for each in CARTILAGE_OF_BONE.values()])
    near = ndimage.distance_transform_edt(~cartilages, sampling=fine.grid.array_spacing_mm)
    for bone in BONES:
        depth = signed_distance(fine.mask(bone), fine.grid.array_spacing_mm)
        image[depth > 0] = level["marrow"]
        image[(depth > 0) & (depth < CORTEX_MM) & (near > CORTEX_MM + 1)] = level["cortex"]
    image[cartilages] = level["cartilage"]
    return np.asarray(image * (1 + 0.05 * _smooth_noise(random, fine.grid, 0.6)), np.float32)


def _kept(labels: Labels, margin_mm: float | None) -> VoxelGrid:
    if margin_mm is None:
        return labels.grid
    wanted = np.argwhere(np.isin(labels.labels, [LABELS[each] for each in CARTILAGE_OF_BONE.values()]))
    margin = margin_mm / np.array(labels.grid.array_spacing_mm)
    low = np.maximum(wanted.min(0) - margin, 0).astype(int)
    high = np.minimum(wanted.max(0) + margin + 1, labels.grid.shape).astype(int)
    return part_of(labels.grid, tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True)))


def _image_grid(fine: VoxelGrid, scan: Scan) -> VoxelGrid:
    """Lay slices over the cubes: sagittal from right to left, or axial from foot to head."""
    a, b, c = scan.spacing_mm
    columns = {"sagittal": ((0, b, 0), (0, 0, -a), (c, 0, 0)), "axial": ((a, 0, 0), (0, b, 0), (0, 0, c))}[scan.slices]
    axes = np.array(columns, dtype=float).T
    size = FINE_MM * (np.array(fine.shape[::-1]) - 1)
    counts = [int(size[np.argmax(np.abs(axes[:, n]))] / np.abs(axes[:, n]).max()) for n in range(3)]
    lps_from_voxel = np.eye(4)
    lps_from_voxel[:3, :3] = axes
    lps_from_voxel[:3, 3] = fine.lps(np.zeros(3)) + np.where(axes.sum(1) < 0, size, 0.0)
    return VoxelGrid(shape=(counts[2], counts[1], counts[0]), lps_from_voxel=lps_from_voxel)


def _places(grid: VoxelGrid) -> np.ndarray:
    k, j, i = np.meshgrid(*(np.arange(n, dtype=float) for n in grid.shape), indexing="ij")
    return grid.lps(np.stack([i, j, k], axis=-1))


def _smooth_noise(random: np.random.Generator, grid: VoxelGrid, sigma_mm: float) -> np.ndarray:
    """Draw (k, j, i) of standard deviation 1, smooth by a Gaussian."""
    coarse = upright_grid(grid, max(sigma_mm / 2, FINE_MM))
    coarse = VoxelGrid(shape=tuple(n + 2 for n in coarse.shape), lps_from_voxel=coarse.lps_from_voxel)
    noise = smoothed(random.normal(size=coarse.shape), coarse, sigma_mm)
    return resampled(noise / noise.std(), coarse, grid)


def _read_noise(random: np.random.Generator, grid: VoxelGrid, sigma_mm: float, places: np.ndarray) -> np.ndarray:
    coarse = upright_grid(grid, sigma_mm / 3)
    noise = smoothed(random.normal(size=coarse.shape), coarse, sigma_mm)
    return read_at(noise / noise.std(), coarse, places)


def _slow(random: np.random.Generator, grid: VoxelGrid) -> np.ndarray:
    """Draw a field of low order, between about -1 and 1."""
    k, j, i = np.meshgrid(*(np.linspace(-1, 1, n) for n in grid.shape), indexing="ij")
    a, b, c, d, e = random.uniform(-0.6, 0.6, 5)
    return np.asarray(a * k + b * j + c * i + d * k * j + e * i * j)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("case", nargs="?", choices=tuple(CASES), help="all without one")


def run(run: Run) -> None:
    """Make knees, find their cartilage, and score it."""
    table, folder = begin(run, "Cartilage of made knees, on the true bones"), run.shared / "data" / "knee"
    for name in [run.arguments.case] if run.arguments.case else CASES:
        source, template, seed, anatomy, scans = CASES[name]
        random = np.random.default_rng(seed)
        fine = made_anatomy(read_template(folder / source), random, anatomy)
        true = surfaces_of(fine)
        bones = {bone: true[bone] for bone in BONES}
        model = knee_template(surfaces_of(read_template(folder / template)), mirror=True)
        for scan in scans:
            volume, truth = made_image(fine, random, scan)
            began = time.process_time()
            found = find_knee_cartilage([volume], bones, model)
            spent = time.process_time() - began
            answers = {
                bone: (each.thickness_mm, each.thickness_sd_mm, each.confidence) for bone, each in found.sheets.items()
            }
            case = f"{name}, {scan.kind}, {scan.slices} {scan.spacing_mm}, noise {scan.noise:g}"
            fill(table, case, truth, true, with_cartilage(truth, found.sheets), answers, spent)

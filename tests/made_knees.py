"""Made MR volumes of a knee: bones of simple shapes in muscle, fat and skin, marrow dark or bright, noise and bias."""

import numpy as np

from marey.knee.space.structures import BONES, CARTILAGE_OF_BONE, LABELS
from marey.knee.space.volume import Labels, Volume, VoxelGrid

LEVELS = {
    "dark": {"air": 2.0, "fat": 30.0, "muscle": 70.0, "cartilage": 110.0, "marrow": 13.0, "cortex": 10.0},
    "bright": {"air": 2.0, "fat": 130.0, "muscle": 50.0, "cartilage": 80.0, "marrow": 118.0, "cortex": 10.0},
}


def made_grid(spacing: tuple[float, float, float] = (1.0, 1.0, 2.0), *, flip: bool = False) -> VoxelGrid:
    """110 x 110 x 150 mm about the joint; the first axis (i) goes to the left, or to the right when flipped."""
    extent = np.array([110.0, 110.0, 150.0])
    lps_from_voxel = np.diag([*spacing, 1.0])
    lps_from_voxel[:3, 3] = [-50.0, -60.0, -70.0]
    if flip:
        lps_from_voxel[0, 0], lps_from_voxel[0, 3] = -spacing[0], 60.0
    i, j, k = (extent / spacing).astype(int).tolist()
    return VoxelGrid(shape=(k, j, i), lps_from_voxel=lps_from_voxel)


def _smooth_union(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.maximum(first, second)


def signed_shapes(
    grid: VoxelGrid, *, mirror: bool = False, size: float = 1.0, bend_mm: float = 0.0
) -> dict[str, np.ndarray]:
    """Structure to (k, j, i) distance [mm] inside its surface, about; the knee is unlike its mirror image."""
    k, j, i = np.meshgrid(*[np.arange(n) for n in grid.shape], indexing="ij")
    place = grid.lps(np.stack([i, j, k], axis=-1).astype(float)) / size
    x, y, z = np.moveaxis(place, -1, 0)
    x = -x if mirror else x
    x, y = x + bend_mm * np.sin(z / 15), y + bend_mm * np.cos(x / 12)

    def ball(cx: float, cy: float, cz: float, rx: float, ry: float, rz: float) -> np.ndarray:
        radius = np.sqrt(((x - cx) / rx) ** 2 + ((y - cy) / ry) ** 2 + ((z - cz) / rz) ** 2)
        return (1 - radius) * min(rx, ry, rz)

    shaft = 13 - np.hypot(x, y + 4)
    femur = _smooth_union(ball(17, 2, 23, 18, 24, 21), ball(-19, 4, 22, 17, 26, 20))
    femur = _smooth_union(femur, np.minimum(shaft, z - 20))
    top = np.minimum(ball(0, 2, -30, 40, 27, 34), -2.0 - z)
    tibia = _smooth_union(top, np.minimum(15 - np.hypot(x + 3, y + 3), -30.0 - z))
    return {
        "femur": femur * size,
        "tibia": tibia * size,
        "patella": ball(3, -38, 36, 18, 9, 20) * size,
        "limb": (52 - np.hypot(x, y)) * size,
    }


def made_labels(grid: VoxelGrid, *, mirror: bool = False, size: float = 1.0) -> Labels:
    """The bones as labels."""
    labels = np.zeros(grid.shape, dtype=np.uint8)
    shapes = signed_shapes(grid, mirror=mirror, size=size)
    for bone in ("femur", "tibia", "patella"):
        labels[shapes[bone] > 0] = LABELS[bone]
    return Labels(labels=labels, grid=grid)


def made_volume(grid: VoxelGrid, kind: str, *, seed: int = 3, noise: float = 3.0, mirror: bool = False) -> Volume:
    """An image of the knee; about bright marrow lies a black line of cortex, 1.5 mm thick, that is of the bone."""
    level, shapes = LEVELS[kind], signed_shapes(grid, mirror=mirror)
    image = np.full(grid.shape, level["air"])
    image[shapes["limb"] > 0] = level["fat"]
    k, j, i = np.meshgrid(*[np.arange(n) for n in grid.shape], indexing="ij")
    place = grid.lps(np.stack([i, j, k], axis=-1).astype(float))
    image[(shapes["limb"] > 8) & (place[..., 1] > 15)] = level["muscle"]
    bones = np.maximum.reduce([shapes[bone] for bone in ("femur", "tibia", "patella")])
    joint = (bones > -3) & (np.abs(place[..., 2]) < 6)
    image[joint] = level["cartilage"]
    image[bones > 0] = level["marrow"]
    if kind == "bright":
        image[(bones > 0) & (bones < 1.5)] = level["cortex"]
    bias = 1 + 0.15 * place[..., 2] / 75 - 0.1 * place[..., 1] / 55
    random = np.random.default_rng(seed)
    parts = image * bias + random.normal(0, noise, image.shape), random.normal(0, noise, image.shape)
    return Volume(intensity=np.hypot(*parts), grid=grid)


THICK_MM = {"femur": 2.6, "tibia": 2.2, "patella": 3.0}
"""Of made cartilage, about: on an egg it is thicker than that along its long axes."""


def labels_with_cartilage(grid: VoxelGrid, *, thicker: float = 1.0, bend_mm: float = 0.0) -> Labels:
    """Bones under cartilage: below and before the condyles, on the tibia's plateau and behind the patella."""
    shapes = signed_shapes(grid, bend_mm=bend_mm)
    k, j, i = np.meshgrid(*[np.arange(n) for n in grid.shape], indexing="ij")
    x, y, z = np.moveaxis(grid.lps(np.stack([i, j, k], axis=-1).astype(float)), -1, 0)
    where = {"femur": z < 24, "tibia": np.hypot(x / 32, (y - 2) / 19) < 1, "patella": (y > -36) & (abs(z - 36) < 15)}
    labels = np.zeros(grid.shape, dtype=np.uint8)
    for bone, place in where.items():
        shell = place & (shapes[bone] > -thicker * THICK_MM[bone]) & (labels == 0)
        labels[shell] = LABELS[CARTILAGE_OF_BONE[bone]]
    for bone in where:
        labels[shapes[bone] > 0] = LABELS[bone]
    return Labels(labels=labels, grid=grid)


def patella_grid(spacing: tuple[float, float, float]) -> VoxelGrid:
    """About the patella and the femur before it."""
    low, extent = np.array([-22.0, -54.0, 8.0]), np.array([50.0, 42.0, 56.0])
    lps_from_voxel = np.diag([*spacing, 1.0])
    lps_from_voxel[:3, 3] = low
    i, j, k = (extent / spacing).astype(int).tolist()
    return VoxelGrid(shape=(k, j, i), lps_from_voxel=lps_from_voxel)


def volume_with_cartilage(fine: VoxelGrid, *, noise: float = 3.0) -> Volume:
    """An image with dark marrow, each voxel the mean over eight of a finer grid."""
    labels, level = labels_with_cartilage(fine).labels, LEVELS["dark"]
    image = np.where(signed_shapes(fine)["limb"] > 0, level["fat"], level["air"])
    image[np.isin(labels, [LABELS[bone] for bone in BONES])] = level["marrow"]
    image[np.isin(labels, [LABELS[each] for each in CARTILAGE_OF_BONE.values()])] = level["cartilage"]
    k, j, i = (n // 2 for n in fine.shape)
    means = image[: 2 * k, : 2 * j, : 2 * i].reshape(k, 2, j, 2, i, 2).mean((1, 3, 5))
    lps_from_voxel = fine.lps_from_voxel @ np.diag([2.0, 2, 2, 1])
    lps_from_voxel[:3, 3] = fine.lps(np.full(3, 0.5))
    random = np.random.default_rng(5)
    noisy = np.hypot(means + random.normal(0, noise, means.shape), random.normal(0, noise, means.shape))
    return Volume(intensity=noisy, grid=VoxelGrid(shape=means.shape, lps_from_voxel=lps_from_voxel))

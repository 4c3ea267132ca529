"""Seeds of the bones, found from the image or given, and the level of marrow about them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from marey.arrays import Floats, Integers, Mask
from marey.errors import MareyError, SettingProblem
from marey.knee.bones.marrow import MARROW_DEFAULTS, WORK_MM, Kind, MarrowSettings, PreparedImage
from marey.knee.bones.region_growing import GROWING_DEFAULTS, GrowingSettings
from marey.knee.space.distances import distance_within


@dataclass(frozen=True, kw_only=True)
class SeedSettings:
    """Settings for finding and checking seeds.

    Values without a stated source were chosen by hand.
    """

    patella_sd_mm: tuple[float, float, float] = (12.0, 8.0, 9.0)
    """Standard deviations [mm], along LPS, of the patella's middle from its usual place."""
    patella_radius_mm: tuple[float, float] = (4.0, 13.0)
    """Least and largest radius [mm] of the largest ball that fits into a patella."""
    least_marrow_share: float = 0.3
    """Least share of the ball about a given seed that may be marrow."""
    checked_radius_mm: float = 4.0
    """Radius [mm] of the ball about a seed in which marrow is examined."""
    patella_from_joint_mm: tuple[float, float, float] = (0.0, -44.0, 36.0)
    """Usual place [mm] of a patella's middle, LPS, from the middle of the joint line of a straight knee."""


SEED_DEFAULTS = SeedSettings()
"""Default settings for finding and checking seeds."""


class NoPairFound(MareyError):
    """An image shows no femur above a tibia: no knee, an unknown sequence, or one of the two only."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Blob:
    """A thick piece of what may be marrow."""

    voxel: Integers
    """(3,) k, j, i of its middle in the upright grid."""
    radius_mm: float


@dataclass(frozen=True, eq=False, kw_only=True)
class LongBoneMarrow:
    """The kind of marrow in an image, and the thickest marrow of femur and tibia."""

    kind: Kind
    femur: Blob
    tibia: Blob


@dataclass(frozen=True, eq=False, kw_only=True)
class MarrowLevel:
    """Brightness of the marrow about a seed in one image."""

    median: float
    limit: float
    """Brightness at which marrow ends: above (dark marrow) or below the median."""

    def likeness(self, intensity: np.ndarray) -> np.ndarray:
        """Return the similarity of intensities to marrow: 1 at and beyond the median, decreasing to 0 at the limit."""
        return np.clip((intensity - self.limit) / (self.median - self.limit), 0, 1).astype(np.float32)


@dataclass(frozen=True, eq=False, kw_only=True)
class LongBoneSeeds:
    """The kind of marrow, and a voxel (k, j, i) of the upright grid in each bone."""

    kind: Kind
    femur: Integers
    tibia: Integers


def find_seeds(
    knee: PreparedImage,
    given: Mapping[str, Integers],
    *,
    settings: SeedSettings = SEED_DEFAULTS,
    marrow: MarrowSettings = MARROW_DEFAULTS,
) -> LongBoneSeeds:
    """Use the given seeds of femur and tibia, and find the others.

    Args:
        knee: The prepared image.
        given: Bone to voxel (3,) k, j, i.
        settings: Least share of marrow about a seed, and radius of the ball in which it is examined.
        marrow: Settings for finding marrow.

    Raises:
        SettingProblem: A given seed does not lie in marrow.
        NoPairFound: A seed that is not given cannot be found.
    """
    if "femur" in given and "tibia" in given:
        kind = kind_at(knee, [given["femur"], given["tibia"]], settings=settings)
        seeds = LongBoneSeeds(kind=kind, femur=given["femur"], tibia=given["tibia"])
    else:
        found = marrow_of(knee, settings=marrow)
        seeds = LongBoneSeeds(
            kind=found.kind,
            femur=given.get("femur", found.femur.voxel),
            tibia=given.get("tibia", found.tibia.voxel),
        )
    check_in_marrow(knee, seeds.kind, given, settings=settings)
    return seeds


def marrow_of(knee: PreparedImage, *, settings: MarrowSettings = MARROW_DEFAULTS) -> LongBoneMarrow:
    """Determine whether marrow is dark or bright by its thick, deep pieces: two, one above the other.

    Args:
        knee: The prepared image.
        settings: Tuned constants of the algorithm.

    Raises:
        NoPairFound: Neither kind shows a femur above a tibia.
    """
    pairs = {
        kind: _best_pair(_thick_blobs(knee, kind, settings=settings), settings=settings) for kind in ("dark", "bright")
    }
    found: list[tuple[float, Kind, tuple[Blob, Blob]]] = []
    for kind, pair in pairs.items():
        if pair is not None:
            found.append((pair[0].radius_mm + pair[1].radius_mm, kind, pair))  # type: ignore[arg-type]
    if not found:
        raise NoPairFound(
            "No femur above a tibia is found: the image shows no knee, or it is of an unknown sequence."
            " Marrow must be clearly darker (fat suppressed) or brighter than muscle; seeds (--seed) may help."
        )
    _, kind, (femur, tibia) = max(found, key=lambda each: each[0])
    return LongBoneMarrow(kind=kind, femur=femur, tibia=tibia)


def _thick_blobs(knee: PreparedImage, kind: Kind, *, settings: MarrowSettings) -> list[Blob]:
    likely = knee.candidates[kind]
    # A bone continues beyond the end of the image, as it does beyond the end of the grid.
    radius = np.where(likely, distance_within(likely | ~knee.within) * WORK_MM, 0.0)
    peaks = (
        (ndimage.maximum_filter(radius, 15) == radius)
        & (radius >= settings.least_radius_mm)
        & (knee.depth_mm >= settings.least_depth_mm)
    )
    return [Blob(voxel=each, radius_mm=float(radius[tuple(each)])) for each in np.argwhere(peaks)]


def _best_pair(blobs: list[Blob], *, settings: MarrowSettings) -> tuple[Blob, Blob] | None:
    """Return the thickest two of which one lies above the other as femur and tibia do."""
    pairs = []
    for upper in blobs:
        for lower in blobs:
            apart = (upper.voxel - lower.voxel) * WORK_MM
            if (
                settings.height_difference_mm[0] <= apart[0] <= settings.height_difference_mm[1]
                and np.hypot(apart[1], apart[2]) <= settings.largest_offset_mm
            ):
                pairs.append((upper, lower))
    return max(pairs, key=lambda pair: pair[0].radius_mm + pair[1].radius_mm, default=None)


def kind_at(knee: PreparedImage, voxels: list[Integers], *, settings: SeedSettings = SEED_DEFAULTS) -> Kind:
    """Return the kind of marrow by its brightness about voxels (3,) k, j, i within it.

    Args:
        knee: The prepared image.
        voxels: (3,) k, j, i each.
        settings: Radius of the ball about each voxel.
    """
    balls = [seed_ball(knee, voxel, settings.checked_radius_mm) for voxel in voxels]
    level = float(np.median([np.median(knee.intensity[ball]) for ball in balls]))
    return "bright" if level > knee.bright_from else "dark"


def kind_of(
    knee: PreparedImage,
    voxels: list[Integers],
    *,
    settings: SeedSettings = SEED_DEFAULTS,
    marrow: MarrowSettings = MARROW_DEFAULTS,
) -> Kind:
    """Return an image's kind of marrow by its own femur and tibia, or else by its brightness about given voxels.

    Args:
        knee: The prepared image.
        voxels: (3,) k, j, i each, within marrow.
        settings: Radius of the ball about each voxel.
        marrow: Settings for finding marrow.
    """
    try:
        return marrow_of(knee, settings=marrow).kind
    except NoPairFound:
        return kind_at(knee, voxels, settings=settings)


def check_in_marrow(
    knee: PreparedImage, kind: Kind, seeds: Mapping[str, Integers], *, settings: SeedSettings = SEED_DEFAULTS
) -> None:
    """Check that seeds lie in what may be marrow.

    Args:
        knee: The prepared image.
        kind: Whether marrow is dark or bright.
        seeds: Bone to voxel (3,) k, j, i.
        settings: Least share of marrow about a seed, and radius of the ball in which it is examined.

    Raises:
        SettingProblem: A seed does not.
    """
    likely = knee.candidates[kind]
    for bone, voxel in seeds.items():
        if likely[seed_ball(knee, voxel, settings.checked_radius_mm)].mean() < settings.least_marrow_share:
            place = knee.grid.lps(voxel[::-1].astype(float))
            raise SettingProblem(
                f"The seed of the {bone} at LPS {_as_text(place)} mm does not lie in {kind} marrow:"
                " choose a point within the bone, away from its edge."
            )


def seed_voxel(knee: PreparedImage, bone: str, place_mm: Floats) -> Integers:
    """Return the voxel (3,) k, j, i of a seed given in LPS.

    Raises:
        SettingProblem: It lies outside the image or in the air.
    """
    voxel = np.rint(knee.grid.voxels(place_mm)).astype(np.int64)[::-1]
    if (voxel < 0).any() or (voxel >= knee.grid.shape).any():
        low, high = knee.grid.lps(np.zeros(3)), knee.grid.lps(np.array(knee.grid.shape[::-1]) - 1.0)
        raise SettingProblem(
            f"The seed of the {bone} at LPS {_as_text(place_mm)} mm lies outside the image,"
            f" which reaches from {_as_text(low)} to {_as_text(high)}."
        )
    if not knee.body[tuple(voxel)]:
        raise SettingProblem(
            f"The seed of the {bone} at LPS {_as_text(place_mm)} mm lies in the air, outside the body."
        )
    return voxel


def seed_ball(
    knee: PreparedImage,
    voxel: Integers,
    radius_mm: float | None = None,
    *,
    settings: GrowingSettings = GROWING_DEFAULTS,
) -> Mask:
    """(k, j, i) true within a ball about a voxel, and in the body; the radius is by default that of the settings."""
    radius_mm = settings.seed_radius_mm if radius_mm is None else radius_mm
    about = [np.arange(n) - v for n, v in zip(knee.grid.shape, voxel, strict=True)]
    squares = about[0][:, None, None] ** 2 + about[1][None, :, None] ** 2 + about[2][None, None, :] ** 2
    return np.asarray((squares <= (radius_mm / WORK_MM) ** 2) & knee.body)


def marrow_level(
    knee: PreparedImage,
    kind: Kind,
    voxel: Integers,
    radius_mm: float | None = None,
    *,
    settings: GrowingSettings = GROWING_DEFAULTS,
) -> MarrowLevel:
    """Measure the brightness of marrow in the ball about a seed.

    Args:
        knee: The prepared image.
        kind: Whether marrow is dark or bright.
        voxel: (3,) k, j, i of the seed.
        radius_mm: Radius of the ball; by default that of the settings.
        settings: Tuned constants of the algorithm.

    Raises:
        SettingProblem: The seed lies in the air.
    """
    values = knee.intensity[seed_ball(knee, voxel, radius_mm, settings=settings)]
    if not values.size:
        raise SettingProblem("The seed lies in the air, outside the body: choose a point within the bone.")
    median = float(np.median(values))
    deviation = max(1.4826 * float(np.median(np.abs(values - median))), settings.least_deviation * median)
    return MarrowLevel(median=median, limit=median + (1 if kind == "dark" else -1) * settings.deviations * deviation)


def marrow_likeness(
    knees: Sequence[PreparedImage],
    kinds: Sequence[Kind],
    voxel: Integers,
    radius_mm: float | None = None,
    *,
    settings: GrowingSettings = GROWING_DEFAULTS,
) -> np.ndarray:
    """Return the similarity of each voxel to the marrow about a seed.

    Args:
        knees: The prepared images of one knee.
        kinds: Whether marrow is dark or bright, for each image.
        voxel: (3,) k, j, i of the seed.
        radius_mm: Radius of the ball in which the marrow's level is measured; by default that of the settings.
        settings: Tuned constants of the algorithm.

    Returns:
        (k, j, i) from 0 to 1, the least over the images; NaN outside one of them.
    """
    each = []
    for knee, kind in zip(knees, kinds, strict=True):
        level = marrow_level(knee, kind, voxel, radius_mm, settings=settings)
        each.append(np.where(knee.within, level.likeness(knee.intensity) * knee.body, np.float32(np.nan)))
    return np.asarray(np.minimum.reduce(each))


def marrow_likenesses(
    knees: Sequence[PreparedImage],
    kinds: Sequence[Kind],
    seeds: Mapping[str, Integers],
    *,
    settings: GrowingSettings = GROWING_DEFAULTS,
) -> dict[str, np.ndarray]:
    """Return bone to the similarity (k, j, i) of each voxel to the marrow about its seed, as `marrow_likeness`."""
    return {name: marrow_likeness(knees, kinds, voxel, settings=settings) for name, voxel in seeds.items()}


def patella_seeds(
    knee: PreparedImage, likeness: np.ndarray, taken: Mask, joint_mm: Floats, *, settings: SeedSettings = SEED_DEFAULTS
) -> list[Integers]:
    """Return voxels that may be the middle of a patella, the likeliest first.

    Args:
        knee: The prepared image.
        likeness: (k, j, i) similarity to marrow, 0 to 1; NaN outside the image.
        taken: (k, j, i) femur and tibia.
        joint_mm: (3,) LPS of the middle of the joint line.
        settings: Tuned constants of the algorithm.
    """
    free = (likeness > 0) & ~ndimage.binary_dilation(taken, iterations=1)
    radius = np.where(free, distance_within(free | np.isnan(likeness)) * WORK_MM, 0.0)
    peaks = (ndimage.maximum_filter(radius, 9) == radius) & (radius >= settings.patella_radius_mm[0])
    voxels = np.argwhere(peaks & (radius <= settings.patella_radius_mm[1]))
    off = (
        knee.grid.lps(voxels[:, ::-1].astype(float)) - joint_mm - settings.patella_from_joint_mm
    ) / settings.patella_sd_mm
    odds = -0.5 * (off**2).sum(axis=1) + 0.5 * radius[tuple(voxels.T)]
    near = (np.abs(off) < 3).all(axis=1)
    order = np.argsort(-odds[near])
    return list(voxels[near][order][:8])


def _as_text(place_mm: Floats) -> str:
    """Return a position [mm] as text."""
    return " ".join(f"{each:.1f}" for each in np.asarray(place_mm))

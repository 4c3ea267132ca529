"""Seeds of the bones: found from the image, or given."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from marey.arrays import Floats, Integers, Mask
from marey.errors import MareyError, SettingProblem
from marey.knee.bones.marrow import MARROW_DEFAULTS, WORK_MM, Kind, MarrowSettings, PreparedImage, candidates, marrow_of
from marey.knee.bones.region_growing import seed_ball
from marey.knee.space.bias_field import between_two_classes
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


@dataclass(frozen=True, eq=False, kw_only=True)
class LongBoneSeeds:
    """The kind of marrow, and a voxel (k, j, i) of the upright grid in each bone."""

    kind: Kind
    femur: Integers
    tibia: Integers


def find_seeds(
    knee: PreparedImage,
    given_mm: Mapping[str, Floats],
    *,
    settings: SeedSettings = SEED_DEFAULTS,
    marrow: MarrowSettings = MARROW_DEFAULTS,
) -> LongBoneSeeds:
    """Use the given seeds of femur and tibia, and find the others.

    Args:
        knee: The prepared image.
        given_mm: Bone to (3,) LPS.
        settings: Least share of marrow about a seed, and radius of the ball in which it is examined.
        marrow: Settings for finding marrow.

    Raises:
        SettingProblem: A given seed lies outside the image, in the air or not in marrow.
        NoPairFound: A seed that is not given cannot be found.
    """
    given = {bone: seed_voxel(knee, bone, place) for bone, place in given_mm.items()}
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
    likely = candidates(knee, kind)
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


def kind_at(knee: PreparedImage, voxels: list[Integers], *, settings: SeedSettings = SEED_DEFAULTS) -> Kind:
    """Return the kind of marrow by its brightness about voxels (3,) k, j, i within it.

    Args:
        knee: The prepared image.
        voxels: (3,) k, j, i each.
        settings: Radius of the ball about each voxel.

    Raises:
        MareyError: No body is in the image.
    """
    balls = [seed_ball(knee, voxel, settings.checked_radius_mm) for voxel in voxels]
    level = float(np.median([np.median(knee.intensity[ball]) for ball in balls]))
    values = knee.intensity[knee.body & (knee.depth_mm > 4)]
    if not values.size:
        raise MareyError("No body is found in the image.")
    return "bright" if level > between_two_classes(values) else "dark"


def _as_text(place_mm: Floats) -> str:
    """Return a position [mm] as text."""
    return " ".join(f"{each:.1f}" for each in np.asarray(place_mm))

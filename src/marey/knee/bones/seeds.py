"""Where the bones' seeds are: found from the image, or given."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from marey.arrays import Floats, Integers, Mask
from marey.errors import MareyError, SettingProblem
from marey.knee.bones.marrow import WORK_MM, Kind, Knee, candidates, marrow_of
from marey.knee.bones.region_growing import seed_ball
from marey.knee.space.bias_field import between_two_classes
from marey.knee.space.distances import distance_within

_PATELLA_FROM_JOINT_MM = np.array([0.0, -44.0, 36.0])
"""Middle of a patella, LPS, from the middle of the joint line of a straight knee."""
_PATELLA_SD_MM = np.array([12.0, 8.0, 9.0])
_PATELLA_RADIUS_MM = (4.0, 13.0)
_MARROW_SHARE = 0.3


@dataclass(frozen=True, eq=False, kw_only=True)
class Seeds:
    """The kind of marrow, and a voxel (k, j, i) of the upright grid in each bone."""

    kind: Kind
    femur: Integers
    tibia: Integers


def find_seeds(knee: Knee, given_mm: Mapping[str, Floats]) -> Seeds:
    """Take the given seeds of femur and tibia, and find the others.

    Args:
        knee: The prepared image.
        given_mm: Bone to (3,) LPS.

    Raises:
        SettingProblem: A given seed lies outside the image, in the air or not in marrow.
        NoPairFound: A seed that is not given cannot be found.
    """
    given = {bone: seed_voxel(knee, bone, place) for bone, place in given_mm.items()}
    if "femur" in given and "tibia" in given:
        kind = kind_at(knee, [given["femur"], given["tibia"]])
        seeds = Seeds(kind=kind, femur=given["femur"], tibia=given["tibia"])
    else:
        marrow = marrow_of(knee)
        seeds = Seeds(
            kind=marrow.kind,
            femur=given.get("femur", marrow.femur.voxel),
            tibia=given.get("tibia", marrow.tibia.voxel),
        )
    check_in_marrow(knee, seeds.kind, given)
    return seeds


def check_in_marrow(knee: Knee, kind: Kind, seeds: Mapping[str, Integers]) -> None:
    """Make sure that seeds, bone to voxel (3,) k, j, i, lie in what may be marrow.

    Raises:
        SettingProblem: One does not.
    """
    likely = candidates(knee, kind)
    for bone, voxel in seeds.items():
        if likely[seed_ball(knee, voxel, 4.0)].mean() < _MARROW_SHARE:
            place = knee.grid.lps(voxel[::-1].astype(float))
            raise SettingProblem(
                f"The seed of the {bone} at LPS {_said(place)} mm lies in no {kind} marrow:"
                " choose a place within the bone, away from its edge."
            )


def seed_voxel(knee: Knee, bone: str, place_mm: Floats) -> Integers:
    """(3,) the voxel k, j, i of a seed given in LPS.

    Raises:
        SettingProblem: It lies outside the image or in the air.
    """
    voxel = np.rint(knee.grid.voxels(place_mm)).astype(np.int64)[::-1]
    if (voxel < 0).any() or (voxel >= knee.grid.shape).any():
        low, high = knee.grid.lps(np.zeros(3)), knee.grid.lps(np.array(knee.grid.shape[::-1]) - 1.0)
        raise SettingProblem(
            f"The seed of the {bone} at LPS {_said(place_mm)} mm lies outside the image,"
            f" which reaches from {_said(low)} to {_said(high)}."
        )
    if not knee.body[tuple(voxel)]:
        raise SettingProblem(f"The seed of the {bone} at LPS {_said(place_mm)} mm lies in the air, outside the body.")
    return voxel


def patella_seeds(knee: Knee, likeness: np.ndarray, taken: Mask, joint_mm: Floats) -> list[Integers]:
    """List places that may be the middle of a patella, the likeliest first.

    Args:
        knee: The prepared image.
        likeness: (k, j, i) of marrow; NaN outside the image.
        taken: (k, j, i) femur and tibia.
        joint_mm: (3,) LPS of the middle of the joint line.
    """
    free = (likeness > 0) & ~ndimage.binary_dilation(taken, iterations=1)
    radius = np.where(free, distance_within(free | np.isnan(likeness)) * WORK_MM, 0.0)
    peaks = (ndimage.maximum_filter(radius, 9) == radius) & (radius >= _PATELLA_RADIUS_MM[0])
    voxels = np.argwhere(peaks & (radius <= _PATELLA_RADIUS_MM[1]))
    off = (knee.grid.lps(voxels[:, ::-1].astype(float)) - joint_mm - _PATELLA_FROM_JOINT_MM) / _PATELLA_SD_MM
    odds = -0.5 * (off**2).sum(axis=1) + 0.5 * radius[tuple(voxels.T)]
    near = (np.abs(off) < 3).all(axis=1)
    order = np.argsort(-odds[near])
    return list(voxels[near][order][:8])


def kind_at(knee: Knee, voxels: list[Integers]) -> Kind:
    """Tell the kind of marrow by how bright it is about voxels (3,) k, j, i within it.

    Raises:
        MareyError: No body is in the image.
    """
    level = float(np.median([np.median(knee.intensity[seed_ball(knee, voxel, 4.0)]) for voxel in voxels]))
    values = knee.intensity[knee.body & (knee.depth_mm > 4)]
    if not values.size:
        raise MareyError("No body is found in the image.")
    return "bright" if level > between_two_classes(values) else "dark"


def _said(place_mm: Floats) -> str:
    return " ".join(f"{each:.1f}" for each in np.asarray(place_mm))

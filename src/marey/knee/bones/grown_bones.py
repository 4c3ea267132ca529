"""Third stage of the bone segmentation: each bone grown from its seed, on the upright grid."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Integers, Mask
from marey.errors import MareyError, SettingProblem
from marey.knee.bones.bright_marrow import BrightImage, extended_bone
from marey.knee.bones.located_bones import LocatedBones
from marey.knee.bones.marrow import WORK_MM
from marey.knee.bones.partial_view import LONG_BONES
from marey.knee.bones.region_growing import grow, joined_fibula
from marey.knee.bones.seeds import marrow_likeness, patella_seeds, seed_ball, seed_voxel
from marey.knee.bones.template_fit import joint_centre, positions_of, shaft_distance
from marey.knee.space.bias_field import corrected_intensity
from marey.knee.space.distances import signed_distance
from marey.knee.space.resampling import extrapolated, part_of, resampled
from marey.knee.space.volume import VoxelGrid


@dataclass(frozen=True, eq=False, kw_only=True)
class BoneRegion:
    """The voxels of the first image about a bone, with all that the images show there."""

    box: tuple[slice, ...]
    """Where the region lies in the first image."""
    grid: VoxelGrid
    distance_mm: np.ndarray
    """(k, j, i) signed distance to the edge of the bone, positive inside."""
    free: Mask
    """(k, j, i) true where the bone may be: in the body and in no other bone."""
    intensities: tuple[np.ndarray, ...]
    """(k, j, i) of each image, without bias."""

    @property
    def mask(self) -> Mask:
        """(k, j, i) true in the bone."""
        return np.asarray(self.distance_mm > 0)

    @property
    def bright_image(self) -> BrightImage:
        """The first image, with the places where the bone may be."""
        return BrightImage(intensity=self.intensities[0], free=self.free, grid=self.grid)


@dataclass(frozen=True, eq=False, kw_only=True)
class GrownBones:
    """Third stage: the bones as they grew from their seeds."""

    located: LocatedBones
    seeds: Mapping[str, Integers]
    """Bone to voxel (3,) k, j, i, of the patella as well."""
    masks: Mapping[str, Mask]
    """Bone to (k, j, i) on the upright grid."""
    likenesses: Mapping[str, np.ndarray]
    """Bone to (k, j, i) similarity to its own marrow, NaN outside the image; 1 in all of a bone that was extended into
    dimmer marrow."""
    fibula: Mask | None = None
    """(k, j, i) what was separated from the tibia on the upright grid; None without any."""

    @property
    def grid(self) -> VoxelGrid:
        """The upright grid of the masks."""
        return self.located.images.grid

    @property
    def image_grid(self) -> VoxelGrid:
        """The first image's own grid."""
        return self.located.images.volumes[0].grid

    @property
    def long_bones(self) -> tuple[str, ...]:
        """Names of the long bones that grew."""
        return tuple(name for name in LONG_BONES if name in self.masks)

    @property
    def all_bright(self) -> bool:
        """Whether marrow is bright in every image, and both femur and tibia grew."""
        return set(self.located.kinds) == {"bright"} and len(self.long_bones) == len(LONG_BONES)

    @property
    def long_bone_mask(self) -> Mask:
        """(k, j, i) femur and tibia together."""
        return np.asarray(np.logical_or.reduce([self.masks[name] for name in self.long_bones]))

    def region(self, name: str, mask: Mask, margin_mm: float) -> BoneRegion:
        """Return the region of the first image about a bone.

        Args:
            name: Of the bone.
            mask: (k, j, i) the bone on the upright grid; not empty.
            margin_mm: Width of the rim that the region leaves about the mask.
        """
        images = self.located.images
        upright_mm = signed_distance(extrapolated(mask, images.knees[0].within), self.grid.array_spacing_mm)
        distance = resampled(upright_mm, self.grid, self.image_grid, outside=-50.0)
        reach = [np.flatnonzero((distance > -margin_mm).any(axis=axes)) for axes in ((1, 2), (0, 2), (0, 1))]
        box = tuple(slice(int(each[0]), int(each[-1]) + 1) for each in reach)
        grid = part_of(self.image_grid, box)
        others = np.logical_or.reduce([each for other, each in self.masks.items() if other != name])
        if self.fibula is not None:
            others = others | self.fibula
        return BoneRegion(
            box=box,
            grid=grid,
            distance_mm=distance[box],
            free=resampled((images.knees[0].body & ~others).astype(np.float32), self.grid, grid) > 0.5,
            intensities=tuple(
                corrected_intensity(volume, knee.bias, grid)
                for volume, knee in zip(images.volumes, images.knees, strict=True)
            ),
        )

    def without(self, name: str) -> "GrownBones":
        """Return the stage without one bone."""
        return replace(
            self,
            masks={other: each for other, each in self.masks.items() if other != name},
            seeds={other: each for other, each in self.seeds.items() if other != name},
            likenesses={other: each for other, each in self.likenesses.items() if other != name},
        )


def grow_long_bones(located: LocatedBones) -> GrownBones:
    """Grow femur and tibia, or the only one of them in view, from their seeds.

    Raises:
        MareyError: Nothing grows from a seed.
    """
    masks: dict[str, Mask] = {}
    for name in LONG_BONES:
        if name in located.seeds:
            masks[name] = _grown_from_seed(located, name, masks) if located.single is None else located.single
    if len(masks) == 1:
        (name,) = masks
        masks[name] = _within_template(located, name, masks[name])
    return GrownBones(located=located, seeds=located.seeds, masks=masks, likenesses=located.likenesses)


def _grown_from_seed(located: LocatedBones, name: str, masks: Mapping[str, Mask]) -> Mask:
    """(k, j, i) a long bone, outside the other one, or outside the ball about its seed until it has grown."""
    growing = located.images.settings.growing
    keep_out = None
    for other in located.seeds:
        if other != name:
            ball = seed_ball(located.images.knees[0], located.seeds[other], settings=growing)
            keep_out = masks.get(other, ball)
    grown = grow(located.likenesses[name], located.seeds[name], keep_out=keep_out, settings=growing)
    if not grown.any():
        raise MareyError(
            f"No region grows from the seed of the {name} at LPS {located.lps(name)} mm, which was"
            f" {'given' if name in located.images.seeds_mm else 'found'}: give another seed (--seed {name} X Y Z)."
        )
    return grown


def _within_template(located: LocatedBones, name: str, grown: Mask) -> Mask:
    """(k, j, i) the only long bone in view, without what lies too far outside the placed template."""
    if name not in located.seen:
        return grown
    images = located.images
    limit = shaft_distance(images.template[name], located.seen[name].placement, images.grid)
    return np.asarray(grown & ~(limit < -images.settings.template_margin_mm))


def extend_into_dim_marrow(grown: GrownBones) -> GrownBones:
    """Extend bones with bright marrow to where it is dimmer than at the seed.

    Bones with dark marrow are left as they are: dark marrow that brightens resembles what surrounds it.
    """
    if not grown.all_bright:
        return grown
    settings = grown.located.images.settings
    for name in LONG_BONES:
        region = grown.region(name, grown.masks[name], settings.dim_marrow_margin_mm)
        further = extended_bone(region.bright_image, region.mask, settings=settings.bright_marrow)
        if further is not None:
            mask = resampled(further.astype(np.float32), region.grid, grown.grid) > 0.5
            likeness = grown.likenesses[name]
            own = np.where(mask & ~np.isnan(likeness), 1, likeness)
            grown = replace(grown, masks={**grown.masks, name: mask}, likenesses={**grown.likenesses, name: own})
    return grown


def separate_fibula(grown: GrownBones) -> GrownBones:
    """Separate the fibula from a tibia with which it has grown together."""
    if "tibia" not in grown.masks:
        return grown
    tibia = grown.masks["tibia"]
    fibula = joined_fibula(tibia, settings=grown.located.images.settings.growing)
    if not fibula.any():
        return grown
    return replace(grown, masks={**grown.masks, "tibia": tibia & ~fibula}, fibula=fibula)


def grow_patella(grown: GrownBones, limit_mm: np.ndarray | None = None) -> GrownBones:
    """Grow a patella from the given seed, or from the likeliest place that gives one of plausible size.

    Args:
        grown: Femur, tibia or both.
        limit_mm: (k, j, i) signed distance to the template's patella, positive inside, NaN where it is not known.

    Returns:
        The stage with a patella; unchanged where none grows.

    Raises:
        SettingProblem: No patella grows from the given seed.
    """
    located = grown.located
    images = located.images
    settings = images.settings
    taken = grown.long_bone_mask
    if "patella" not in images.seeds_mm:
        joint = joint_centre(
            {name: positions_of(grown.masks[name], grown.grid) for name in grown.long_bones},
            settings=settings.template_fit,
        )
        likeness = located.likenesses[grown.long_bones[0]]
        places = patella_seeds(images.knees[0], likeness, taken, joint, settings=settings.seeds)
    else:
        places = [seed_voxel(images.knees[0], "patella", images.seeds_mm["patella"])]
        likeness = marrow_likeness(images.knees, located.kinds, places[0], 4.0, settings=settings.growing)
    keep_out = taken
    if limit_mm is not None:
        keep_out = taken | (np.nan_to_num(limit_mm, nan=-100.0) < -settings.outside_template_mm)
    for place in places:
        mask = grow(likeness, place, keep_out=keep_out, settings=settings.growing)
        if settings.patella_cm3[0] <= mask.sum() * WORK_MM**3 / 1000 <= settings.patella_cm3[1]:
            own = marrow_likeness(images.knees, located.kinds, place, settings=settings.growing)
            return replace(
                grown,
                masks={**grown.masks, "patella": mask},
                seeds={**grown.seeds, "patella": place},
                likenesses={**grown.likenesses, "patella": own},
            )
    if "patella" in images.seeds_mm:
        raise SettingProblem("No patella grows from its seed: choose a point in the middle of the patella.")
    return grown


def drop_oversized_patella(grown: GrownBones) -> GrownBones:
    """Remove a patella with bright marrow that is so much larger than the template's that it must have leaked."""
    template = grown.located.images.template
    if not grown.all_bright or "patella" not in grown.masks or "patella" not in template:
        return grown
    largest = grown.located.images.settings.largest_bright_patella * int((template["patella"].distance_mm > 0).sum())
    return grown.without("patella") if int(grown.masks["patella"].sum()) > largest else grown

"""Third stage of the bone segmentation: each bone grown from its seed, on the upright grid."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from marey.arrays import Integers, Mask
from marey.errors import MareyError, SettingProblem
from marey.knee.bones.bright_marrow import BrightImage, extended_bone
from marey.knee.bones.located_bones import LocatedBones
from marey.knee.bones.marrow import WORK_MM
from marey.knee.bones.partial_view import LONG_BONES
from marey.knee.bones.region_growing import grow, seed_ball
from marey.knee.bones.seeds import patella_seeds, seed_voxel
from marey.knee.bones.template_fit import joint_centre, positions_of, shaft_distance
from marey.knee.space.bias_field import corrected_intensity
from marey.knee.space.distances import signed_distance
from marey.knee.space.resampling import extrapolated, part_of, resampled
from marey.knee.space.volume import VoxelGrid


@dataclass(frozen=True, eq=False, kw_only=True)
class GrownBones:
    """Third stage: the bones as they grew from their seeds."""

    located: LocatedBones
    seeds: Mapping[str, Integers]
    """Bone to voxel (3,) k, j, i, of the patella as well."""
    masks: Mapping[str, Mask]
    """Bone to (k, j, i) on the upright grid."""
    extended: frozenset[str] = field(default_factory=frozenset)
    """Bones that were extended to where marrow is dimmer than at the seed."""

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

    def long_bone_mask(self) -> Mask:
        """(k, j, i) femur and tibia together."""
        return np.asarray(np.logical_or.reduce([self.masks[name] for name in self.long_bones]))

    def own_likeness(self, name: str) -> np.ndarray:
        """(k, j, i) similarity to a bone's own marrow; 1 in all of a bone that was extended into dimmer marrow."""
        likeness = self.located.likeness(self.seeds[name])
        return np.where(self.masks[name] & ~np.isnan(likeness), 1, likeness) if name in self.extended else likeness

    def bright_image(self, name: str, grid: VoxelGrid) -> BrightImage:
        """Return a part of the first image with the places where a bone may be: in the body and in no other bone."""
        others = np.logical_or.reduce([mask for other, mask in self.masks.items() if other != name])
        images = self.located.images
        free = resampled((images.knees[0].body & ~others).astype(np.float32), self.grid, grid) > 0.5
        return BrightImage(intensity=corrected_intensity(images.volumes[0], grid), free=free, grid=grid)

    def distance_and_box(self, mask: Mask, margin_mm: float) -> tuple[np.ndarray, tuple[slice, ...]]:
        """Return the signed distance to the edge of a mask on the first image's grid, and the box about the mask.

        Args:
            mask: (k, j, i) on the upright grid.
            margin_mm: Width of the rim that the box leaves about the mask.

        Returns:
            (k, j, i) signed distance [mm], and the slices of the box in it.
        """
        mask = extrapolated(mask, self.located.images.knees[0].within)
        spacing = self.grid.array_spacing_mm
        distance = resampled(signed_distance(mask, spacing), self.grid, self.image_grid, outside=-50.0)
        reach = [(np.flatnonzero((distance > -margin_mm).any(axis=axes))) for axes in ((1, 2), (0, 2), (0, 1))]
        return distance, tuple(slice(int(each[0]), int(each[-1]) + 1) for each in reach)

    def with_mask(self, name: str, mask: Mask) -> "GrownBones":
        """Return the stage with one bone's mask replaced."""
        return replace(self, masks={**self.masks, name: mask})

    def without(self, name: str) -> "GrownBones":
        """Return the stage without one bone."""
        return replace(
            self,
            masks={other: mask for other, mask in self.masks.items() if other != name},
            seeds={other: seed for other, seed in self.seeds.items() if other != name},
        )


def grow_long_bones(located: LocatedBones) -> GrownBones:
    """Grow femur and tibia, or the only one of them in view, from their seeds.

    Raises:
        MareyError: Nothing grows from a seed.
    """
    settings = located.images.settings
    masks: dict[str, Mask] = {}
    if len(located.seeds) == 1:
        (name,) = located.seeds
        whole = _grown_from_seed(located, name, None) if located.single is None else located.single
        masks[name] = _within_template(located, name, whole)
    else:
        for name, other in (("femur", "tibia"), ("tibia", "femur")):
            keep_out = masks.get(
                other, seed_ball(located.images.knees[0], located.seeds[other], settings=settings.growing)
            )
            masks[name] = _grown_from_seed(located, name, keep_out)
    return GrownBones(located=located, seeds=located.seeds, masks=masks)


def _grown_from_seed(located: LocatedBones, name: str, keep_out: Mask | None) -> Mask:
    seed = located.seeds[name]
    grown = grow(located.likeness(seed), seed, keep_out=keep_out, settings=located.images.settings.growing)
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
        distance, box = grown.distance_and_box(grown.masks[name], settings.dim_marrow_margin_mm)
        image = grown.bright_image(name, part_of(grown.image_grid, box))
        further = extended_bone(image, distance[box] > 0, settings=settings.bright_marrow)
        if further is not None:
            mask = resampled(further.astype(np.float32), image.grid, grown.grid) > 0.5
            grown = replace(grown.with_mask(name, mask), extended=grown.extended | {name})
    return grown


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
    images, settings = grown.located.images, grown.located.images.settings
    taken = grown.long_bone_mask()
    if "patella" in images.seeds_mm:
        places = [seed_voxel(images.knees[0], "patella", images.seeds_mm["patella"])]
        likeness = grown.located.likeness(places[0], 4.0)
    else:
        joint = joint_centre(
            {name: positions_of(grown.masks[name], grown.grid) for name in grown.long_bones},
            settings=settings.template_fit,
        )
        likeness = grown.located.likeness(grown.seeds[grown.long_bones[0]])
        places = patella_seeds(images.knees[0], likeness, taken, joint, settings=settings.seeds)
    keep_out = taken
    if limit_mm is not None:
        keep_out = taken | (np.nan_to_num(limit_mm, nan=-100.0) < -settings.outside_template_mm)
    for place in places:
        mask = grow(likeness, place, keep_out=keep_out, settings=settings.growing)
        if settings.patella_cm3[0] <= mask.sum() * WORK_MM**3 / 1000 <= settings.patella_cm3[1]:
            return replace(grown.with_mask("patella", mask), seeds={**grown.seeds, "patella": place})
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

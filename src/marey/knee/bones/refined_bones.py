"""Fifth stage of the bone segmentation: each bone's edge on the image's own voxels, and what a user should check."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from marey.arrays import Floats, Mask
from marey.knee.bones.bone_edges import BoneImage, marrow_odds, refine_edge, soft_tissue_odds
from marey.knee.bones.bright_marrow import continued_limit, cut_along_line, evened, template_odds
from marey.knee.bones.grown_bones import GrownBones
from marey.knee.bones.marrow import WORK_MM, air_level
from marey.knee.bones.partial_view import LONG_BONES
from marey.knee.bones.region_growing import outgrowth, thin_share
from marey.knee.bones.settings import BONE_DEFAULTS, BoneSettings
from marey.knee.bones.template_fit import TemplateFit
from marey.knee.bones.template_limits import LimitedBones
from marey.knee.space.bias_field import corrected_intensity
from marey.knee.space.distances import signed_distance
from marey.knee.space.resampling import part_of, resampled
from marey.knee.space.volume import VoxelGrid

Report = Callable[[str, float], None]
"""Called with the name of a step and the share of the work that is done."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Bone:
    """A segmented bone."""

    distance_mm: np.ndarray
    """(k, j, i) signed distance to its surface, positive inside, on `grid`."""
    grid: VoxelGrid
    """The image's own voxels about the bone."""
    seed_mm: Floats
    """(3,) LPS."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RefinedBones:
    """Fifth stage: the bones with refined edges."""

    limited: LimitedBones
    bones: Mapping[str, Bone]
    boxes: Mapping[str, tuple[slice, ...]]
    """Bone to where its grid lies in the first image."""
    rejected: Mapping[str, str]
    """Bone that turned out to be none, to the reason."""
    notes: tuple[str, ...]
    """What a user should check, as sentences."""


def refine_bones(limited: LimitedBones, report: Report) -> RefinedBones:
    """Move the edge of each grown bone to where the image changes, and reject what is mostly not marrow.

    Args:
        limited: The bones with their limits.
        report: Called with the name of the step and the share of the work that is done.
    """
    grown, settings = limited.grown, limited.grown.located.images.settings
    bones, boxes, rejected, notes = {}, {}, {}, []
    for index, name in enumerate(grown.masks):
        report(f"edge of the {name}", 0.5 + 0.5 * index / len(grown.masks))
        limit = limited.limits_mm.get(name)
        bone, box = _refined_bone(grown, name, limit)
        inside = resampled(bone.distance_mm, bone.grid, grown.grid, outside=-50.0) > 0
        share = _marrow_share(grown, name, inside)
        if share < settings.least_marrow:
            rejected[name] = f"No {name} was found: only {100 * share:.0f} % of the candidate resembles marrow."
            continue
        bones[name], boxes[name] = bone, box
        notes += outgrowth_note(name, inside, grown.grid, settings=settings)
        notes += thin_note(name, inside, settings=settings) if limit is None else []
    return RefinedBones(limited=limited, bones=bones, boxes=boxes, rejected=rejected, notes=tuple(notes))


def _marrow_share(grown: GrownBones, name: str, inside: Mask) -> float:
    """Return the share of a bone that resembles the marrow at its seed: a template may have added other voxels."""
    likeness = grown.own_likeness(name)[inside]
    known = likeness[~np.isnan(likeness)]
    return float((known > 0).mean()) if known.size else 0.0


def _refined_bone(grown: GrownBones, name: str, limit_mm: np.ndarray | None) -> tuple[Bone, tuple[slice, ...]]:
    """Refine a grown bone on the first image's own voxels; return it and its box in the first image."""
    settings = grown.located.images.settings
    bright = settings.bright_marrow
    coarse = _coarse(grown, name, limit_mm)
    along_line = grown.all_bright and limit_mm is not None
    margin_mm = settings.bright_margin_mm if along_line else settings.margin_mm
    distance, box = grown.distance_and_box(coarse, margin_mm)
    grid, distance = part_of(grown.image_grid, box), distance[box]
    prior = np.zeros(grid.shape, dtype=np.float32)
    if limit_mm is not None and along_line:
        # The template's edges were moved to where all is marrow: the bone's lie farther out.
        limit_there = continued_limit(limit_mm + settings.prior_from_mm, WORK_MM, settings=bright)
        known = resampled(limit_there, grown.grid, grid, outside=np.nan)
        inside = cut_along_line(grown.bright_image(name, grid), distance > 0, known, settings=bright)
        distance, prior = signed_distance(inside, grid.array_spacing_mm), template_odds(known, settings=bright)
    elif limit_mm is not None:
        known = resampled(np.nan_to_num(limit_mm, nan=0.0), grown.grid, grid, outside=0.0)
        prior = np.clip(known + settings.prior_from_mm, -settings.prior_nats, 0)
    field_mm = _edge(grown, distance, prior, grid, rough=not along_line, small=name not in LONG_BONES)
    seed = grown.grid.lps(grown.seeds[name][::-1].astype(float))
    return Bone(distance_mm=field_mm, grid=grid, seed_mm=seed), box


def _coarse(grown: GrownBones, name: str, limit_mm: np.ndarray | None) -> Mask:
    """(k, j, i) a grown bone without the other bones, within the template's limits or without outgrowths."""
    settings = grown.located.images.settings
    coarse = grown.masks[name]
    for other, mask in grown.masks.items():
        coarse = coarse if other == name else coarse & ~mask
    if limit_mm is not None:
        surely_inside = (limit_mm > settings.inside_template_mm) & grown.located.images.knees[0].body
        return np.asarray((coarse & ~(limit_mm < -settings.outside_template_mm)) | surely_inside)
    return np.asarray(coarse & ~outgrowth(coarse, settings=settings.growing)) if name in LONG_BONES else coarse


def _edge(
    grown: GrownBones, distance: np.ndarray, prior: np.ndarray, grid: VoxelGrid, *, rough: bool, small: bool
) -> np.ndarray:
    """(k, j, i) the edge by the image with dark marrow if there is one: it shows the outside of the cortex."""
    volumes, knees = grown.located.images.volumes, grown.located.images.knees
    settings = grown.located.images.settings
    images = [corrected_intensity(volume, grid) for volume in volumes]
    if not rough:
        # Then marrow is dim nowhere: the edge stays about where the cut along the line placed it.
        images = [evened(image, distance > 0, grid, settings=settings.bright_marrow) for image in images]
    pieces = [
        BoneImage(
            intensity=image,
            distance_mm=distance,
            prior_nats=prior,
            grid=grid,
            rough=rough,
            small=small,
            no_signal=air_level(knee, settings=settings.marrow),
        )
        for image, knee in zip(images, knees, strict=True)
    ]
    kinds = grown.located.kinds
    lead = kinds.index("dark") if "dark" in kinds else 0
    others = []
    for index, (piece, kind) in enumerate(zip(pieces, kinds, strict=True)):
        if index != lead:
            same = kind == kinds[lead]
            others.append(
                marrow_odds(piece, kind, settings=settings.edges)
                if same
                else soft_tissue_odds(piece, settings=settings.edges)
            )
    return refine_edge(pieces[lead], kinds[lead], others, settings=settings.edges)


def fit_note(fit: TemplateFit) -> str:
    """Describe which side the template is of, and how well it fits."""
    side = "mirrored, because it is of the other side" if fit.mirrored else "of the same side"
    return f"The template is {side}; {100 * fit.fit:.0f} % of its edges lie on edges of bone."


def outgrowth_note(name: str, inside: Mask, grid: VoxelGrid, *, settings: BoneSettings = BONE_DEFAULTS) -> list[str]:
    """Describe a part of a femur or tibia that no such bone has: the bone may have leaked there.

    Args:
        name: Of the bone.
        inside: (k, j, i) the bone.
        grid: The upright grid of both.
        settings: Least volume of an outgrowth that is reported.

    Returns:
        One sentence, or none.
    """
    if name not in LONG_BONES:
        return []
    part = outgrowth(inside, settings=settings.growing)
    pieces, count = ndimage.label(part)
    if not count:
        return []
    sizes = np.bincount(pieces.ravel())[1:]
    cm3 = float(sizes.max()) * WORK_MM**3 / 1000
    if cm3 < settings.outgrowth_cm3:
        return []
    x, y, z = grid.lps(np.argwhere(pieces == 1 + int(sizes.argmax())).mean(axis=0)[::-1])
    return [
        f"The {name} has an outgrowth of {cm3:.1f} cm3 about LPS {x:.0f} {y:.0f} {z:.0f} mm that may be a leak."
        " Check it; a template or another seed may prevent the leak."
    ]


def thin_note(name: str, inside: Mask, *, settings: BoneSettings = BONE_DEFAULTS) -> list[str]:
    """Describe a femur or tibia, grown without a template, that has more thin parts than whole bones have.

    Args:
        name: Of the bone.
        inside: (k, j, i) the bone, on an upright grid.
        settings: Largest share of thin parts that is not reported.

    Returns:
        One sentence, or none.
    """
    if name not in LONG_BONES:
        return []
    share = thin_share(inside, settings=settings.growing)
    if share < settings.largest_thin_share:
        return []
    return [
        f"The {name} has {100 * share:.0f} % of its volume in thin parts; correctly segmented bones have 1 to 2 %."
        " The segmentation has probably leaked. Check its surface; a template would prevent leaks."
    ]

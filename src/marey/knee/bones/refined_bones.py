"""Fifth stage of the bone segmentation: each bone's edge on the image's own voxels, and what a user should check."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from marey.arrays import Floats, Mask
from marey.errors import MareyError
from marey.knee.bones.bone_edges import BoneImage, edge_in_images
from marey.knee.bones.bright_marrow import continued_limit, cut_along_line, evened, template_odds
from marey.knee.bones.grown_bones import BoneRegion, GrownBones
from marey.knee.bones.marrow import WORK_MM
from marey.knee.bones.partial_view import LONG_BONES
from marey.knee.bones.region_growing import outgrowth, thin_share
from marey.knee.bones.settings import BoneSettings
from marey.knee.bones.template_limits import LimitedBones
from marey.knee.space.distances import signed_distance
from marey.knee.space.resampling import resampled
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

    Raises:
        MareyError: Nothing remains of a bone, because it and another one grew into each other.
    """
    grown = limited.grown
    settings = grown.located.images.settings
    bones, boxes, rejected, notes = {}, {}, {}, []
    for index, name in enumerate(grown.masks):
        report(f"edge of the {name}", 0.5 + 0.5 * index / len(grown.masks))
        bone, box = _refined_bone(limited, name)
        inside = resampled(bone.distance_mm, bone.grid, grown.grid, outside=-50.0) > 0
        share = _marrow_share(grown.likenesses[name][inside])
        if share < settings.least_marrow:
            rejected[name] = f"No {name} was found: only {100 * share:.0f} % of the candidate resembles marrow."
            continue
        bones[name], boxes[name] = bone, box
        notes += _notes_on_leaks(name, inside, grown.grid, thin=name not in limited.limits_mm, settings=settings)
    return RefinedBones(limited=limited, bones=bones, boxes=boxes, rejected=rejected, notes=tuple(notes))


def _marrow_share(likeness: np.ndarray) -> float:
    """Return the share of voxels that resemble marrow, of those that are known: a template may have added others."""
    known = likeness[~np.isnan(likeness)]
    return float((known > 0).mean()) if known.size else 0.0


def _refined_bone(limited: LimitedBones, name: str) -> tuple[Bone, tuple[slice, ...]]:
    """Refine a grown bone on the first image's own voxels; return it and its box in the first image."""
    grown = limited.grown
    limit_mm = limited.limits_mm.get(name)
    settings = grown.located.images.settings
    along_line = grown.all_bright and limit_mm is not None
    margin_mm = settings.bright_margin_mm if along_line else settings.margin_mm
    coarse = _coarse(grown, name, limit_mm)
    region = grown.region(name, coarse, margin_mm)
    prior = np.zeros(region.grid.shape, dtype=np.float32)
    if limit_mm is not None and along_line:
        region, prior = _cut_region(grown, region, limit_mm)
    elif limit_mm is not None:
        known = resampled(np.nan_to_num(limit_mm, nan=0.0), grown.grid, region.grid, outside=0.0)
        prior = np.clip(known + settings.prior_from_mm, -settings.prior_nats, 0)
    if name == "tibia" and grown.fibula is not None:
        prior = np.minimum(prior, _fibula_prior(grown, grown.fibula, region.grid))
    pieces = [
        BoneImage(
            intensity=intensity,
            distance_mm=region.distance_mm,
            prior_nats=prior,
            grid=region.grid,
            rough=not along_line,
            small=name not in LONG_BONES,
            no_signal=knee.air_level,
        )
        for intensity, knee in zip(region.intensities, grown.located.images.knees, strict=True)
    ]
    field_mm = edge_in_images(pieces, grown.located.kinds, settings=settings.edges)
    seed = grown.grid.lps(grown.seeds[name][::-1].astype(float))
    return Bone(distance_mm=field_mm, grid=region.grid, seed_mm=seed), region.box


def _fibula_prior(grown: GrownBones, fibula: Mask, grid: VoxelGrid) -> np.ndarray:
    """Return the log odds (k, j, i) of tibia about a separated fibula [nat]: one less per millimetre of depth in it."""
    inside_mm = resampled(signed_distance(fibula, grown.grid.array_spacing_mm), grown.grid, grid, outside=-50.0)
    return np.asarray(np.clip(-inside_mm, -grown.located.images.settings.prior_nats, 0))


def _cut_region(grown: GrownBones, region: BoneRegion, limit_mm: np.ndarray) -> tuple[BoneRegion, np.ndarray]:
    """Cut a bone with bright marrow along the dark line about it.

    Returns:
        The region with the edge of the cut bone and images as shares of the level of its marrow, and (k, j, i) the log
        odds of bone by the template.
    """
    settings = grown.located.images.settings
    bright = settings.bright_marrow
    # The template's edges were moved to where all is marrow: the bone's lie farther out.
    limit_there = continued_limit(limit_mm + settings.prior_from_mm, WORK_MM, settings=bright)
    known = resampled(limit_there, grown.grid, region.grid, outside=np.nan)
    prior = template_odds(known, settings=bright)
    inside = cut_along_line(region.bright_image, region.mask, known, settings=bright)
    # Then marrow is dim nowhere: the edge stays about where the cut along the line placed it.
    even = tuple(evened(each, inside, region.grid, settings=bright) for each in region.intensities)
    distance_mm = signed_distance(inside, region.grid.array_spacing_mm)
    return replace(region, distance_mm=distance_mm, intensities=even), prior


def _coarse(grown: GrownBones, name: str, limit_mm: np.ndarray | None) -> Mask:
    """(k, j, i) a grown bone without the other bones, within the template's limits or without outgrowths."""
    settings = grown.located.images.settings
    coarse = grown.masks[name]
    for other, mask in grown.masks.items():
        coarse = coarse if other == name else coarse & ~mask
    if limit_mm is not None:
        surely_inside = (limit_mm > settings.inside_template_mm) & grown.located.images.knees[0].body
        coarse = np.asarray((coarse & ~(limit_mm < -settings.outside_template_mm)) | surely_inside)
    elif name in LONG_BONES:
        coarse = np.asarray(coarse & ~outgrowth(coarse, settings=settings.growing))
    if not coarse.any():
        raise MareyError(
            f"The {name} cannot be separated from the other bones: they grew into each other, because the image shows"
            " no edge between them. Give a template (--template), or an image with smaller voxels."
        )
    return coarse


def _notes_on_leaks(name: str, inside: Mask, grid: VoxelGrid, *, thin: bool, settings: BoneSettings) -> list[str]:
    """Describe parts of a femur or tibia that no such bone has: the bone may have leaked there.

    Args:
        name: Of the bone.
        inside: (k, j, i) the bone.
        grid: The upright grid of both.
        thin: Whether thin parts are reported as well, as for bones that grew without a template.
        settings: What is reported.

    Returns:
        A sentence for each kind of part.
    """
    if name not in LONG_BONES:
        return []
    share = thin_share(inside, settings=settings.growing) if thin else 0.0
    pieces, count = ndimage.label(outgrowth(inside, settings=settings.growing))
    notes = []
    sizes = np.bincount(pieces.ravel())[1:]
    cm3 = float(sizes.max()) * WORK_MM**3 / 1000 if count else 0.0
    if count and cm3 >= settings.outgrowth_cm3:
        x, y, z = grid.lps(np.argwhere(pieces == 1 + int(sizes.argmax())).mean(axis=0)[::-1])
        notes.append(
            f"The {name} has an outgrowth of {cm3:.1f} cm3 about LPS {x:.0f} {y:.0f} {z:.0f} mm that may be a leak."
            " Check it; a template or another seed may prevent the leak."
        )
    if share >= settings.largest_thin_share:
        notes.append(
            f"The {name} has {100 * share:.0f} % of its volume in thin parts; correctly segmented bones have"
            " 1 to 2 %. The segmentation has probably leaked. Check its surface; a template would prevent leaks."
        )
    return notes

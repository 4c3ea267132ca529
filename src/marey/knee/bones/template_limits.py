"""Fourth stage of the bone segmentation: how far each bone may reach, by a template fitted to the grown bones."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from marey.knee.bones.bright_marrow import evenness
from marey.knee.bones.grown_bones import GrownBones, grow_patella
from marey.knee.bones.partial_view import LONG_BONES
from marey.knee.bones.seeds import marrow_level
from marey.knee.bones.template_fit import (
    TemplateFit,
    place_alone,
    place_template,
    shaft_distance,
    template_distance,
)
from marey.knee.space.bias_field import corrected_intensity
from marey.knee.space.resampling import resampled


@dataclass(frozen=True, eq=False, kw_only=True)
class LimitedBones:
    """Fourth stage: the grown bones, and the limits that a template sets to them."""

    grown: GrownBones
    template_fit: TemplateFit | None
    """None without a template, or where it does not fit the only long bone in view."""
    limits_mm: Mapping[str, np.ndarray]
    """Bone to (k, j, i) signed distance to the template's surface on the upright grid, positive inside; NaN where it
    is not known. Bones without a limit are missing."""

    @property
    def template_unused(self) -> bool:
        """Whether a template was given that could not be fitted."""
        return bool(self.grown.located.images.template) and self.template_fit is None


def limit_bones(grown: GrownBones) -> LimitedBones:
    """Fit the template to the grown bones, and compute the signed distance to each of its bones.

    Raises:
        TemplateProblem: The template fits nowhere.
    """
    located = grown.located
    bones, long_bones = located.images.template, grown.long_bones
    if not bones or (len(long_bones) == 1 and long_bones[0] not in located.seen):
        return LimitedBones(grown=grown, template_fit=None, limits_mm={})
    settings = located.images.settings.template_fit
    likeness = _likenesses(grown)
    if len(long_bones) == 2:
        fit = place_template(bones, grown.masks, likeness, grown.grid, settings=settings)
    else:
        seen = located.seen[long_bones[0]]
        start = TemplateFit(
            placements=dict.fromkeys(likeness, seen.placement), mirrored=seen.mirrored, fit=seen.contrast
        )
        fit = place_alone(long_bones[0], bones, start, likeness, grown.grid, settings=settings)
    limits = {
        name: template_distance(bones[name], fit.placements[name], likeness[name], grown.grid, settings=settings)
        for name in likeness
    }
    if len(long_bones) == 1:
        # Nothing else keeps a single bone from leaking beyond the template's end: its shaft is continued there.
        name = long_bones[0]
        shaft = np.minimum(shaft_distance(bones[name], fit.placements[name], grown.grid), 0)
        limits[name] = np.where(np.isnan(limits[name]), shaft, limits[name])
    return LimitedBones(grown=grown, template_fit=fit, limits_mm=limits)


def _likenesses(grown: GrownBones) -> dict[str, np.ndarray]:
    """Bone to (k, j, i) similarity to its marrow, within the grown bone; a patella also where none grew."""
    likeness = {name: grown.likenesses[name] * grown.masks[name] for name in grown.long_bones}
    if "patella" in grown.located.images.template:
        patella = grown.masks.get("patella", ~grown.long_bone_mask)
        likeness["patella"] = grown.located.likenesses[grown.long_bones[0]] * patella
        if grown.all_bright and "patella" not in grown.masks:
            likeness["patella"] = likeness["patella"] * _evenness(grown)
    return likeness


def _evenness(grown: GrownBones) -> np.ndarray:
    """(k, j, i) small in dark lines: only they separate a patella from the fat about it."""
    images, own = grown.located.images, grown.image_grid
    settings, first = images.settings, images.knees[0]
    level = marrow_level(first, "bright", grown.seeds["femur"], settings=settings.growing).median
    share = corrected_intensity(images.volumes[0], first.bias, own) / np.float32(level)
    even = evenness(share, own, settings=settings.bright_marrow)
    return resampled(even, own, grown.grid, outside=1.0)


def limit_patella(limited: LimitedBones) -> LimitedBones:
    """Grow the patella again within the template's if it leaked or did not grow; otherwise remove its limit.

    A patella that grew without a leak needs no limit, and a template's seldom has its shape.

    Raises:
        SettingProblem: No patella grows from the given seed.
    """
    limit = limited.limits_mm.get("patella")
    if limit is not None and _patella_leaks(limited, limit):
        return replace(limited, grown=grow_patella(limited.grown.without("patella"), limit))
    return replace(limited, limits_mm={name: each for name, each in limited.limits_mm.items() if name != "patella"})


def _patella_leaks(limited: LimitedBones, limit_mm: np.ndarray) -> bool:
    """Return whether no patella grew, or, beside a single long bone, one much larger than the template's."""
    masks, fit = limited.grown.masks, limited.template_fit
    if "patella" not in masks:
        return True
    alone = fit is not None and not all(name in fit.placements for name in LONG_BONES)
    largest = limited.grown.located.images.settings.largest_patella * int((limit_mm > 0).sum())
    return alone and int(masks["patella"].sum()) > largest

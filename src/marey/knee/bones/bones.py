"""Segmentation of femur, tibia and patella in one MR volume or two of the same knee, with or without a template."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from marey.arrays import Floats
from marey.knee.bones.grown_bones import (
    GrownBones,
    drop_oversized_patella,
    extend_into_dim_marrow,
    grow_long_bones,
    grow_patella,
    separate_fibula,
)
from marey.knee.bones.located_bones import locate_bones, prepare_images
from marey.knee.bones.marrow import Kind
from marey.knee.bones.refined_bones import Bone, RefinedBones, Report, refine_bones
from marey.knee.bones.settings import BONE_DEFAULTS, BoneSettings
from marey.knee.bones.template_fit import TemplateFit, template_bones
from marey.knee.bones.template_limits import limit_bones, limit_patella
from marey.knee.space.structures import BONES, LABELS
from marey.knee.space.volume import Labels, Volume

_TEMPLATE_UNUSED = (
    "The template is not used, because its bone does not fit the only long bone in view. Without a template the"
    " segmentation of a bone may leak far into its surroundings: check the surface."
)
"""Note for a template that could not be fitted."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BoneSegmentation:
    """The bones of a knee."""

    labels: Labels
    """On the first image's own grid."""
    bones: Mapping[str, Bone]
    kinds: tuple[Kind, ...]
    """Whether marrow is dark or bright, for each image."""
    template_fit: TemplateFit | None
    notes: tuple[str, ...]
    """What a user should know, as sentences."""
    missing: Mapping[str, str] = field(default_factory=dict)
    """Bone that was not found, to the reason."""
    limits: tuple[str, ...] = ()
    """Those of the notes that limit the use of the bones that were found."""


def segment_bones(
    volumes: Sequence[Volume],
    *,
    template: Labels | None = None,
    seeds_mm: Mapping[str, Floats] | None = None,
    settings: BoneSettings = BONE_DEFAULTS,
    report: Report = lambda step, share: None,
) -> BoneSegmentation:
    """Segment femur, tibia and patella.

    Bones are grown from seeds by threshold, with openings against leaks; a template, if given, limits how far they
    reach; then each edge moves to where the image changes, on the image's own voxels. Each stage is a frozen record
    from which the next one is computed.

    Args:
        volumes: One image, or two of the same knee in the same place, with and without fat saturation. The result
            is on the first one's grid.
        template: Labels of another knee, of either side.
        seeds_mm: Bone to (3,) LPS; the seeds of the other bones are found.
        settings: Of all stages.
        report: Called at every step.

    Raises:
        SettingProblem: A seed lies outside the image, in the air, or not in marrow.
        MareyError: No knee is found, the template does not fit, or the two images do not lie in one place.
    """
    report("bias and body", 0.0)
    bones = {} if template is None else template_bones(template, settings=settings.template_fit)
    images = prepare_images(tuple(volumes), bones, dict(seeds_mm or {}), settings)
    located = locate_bones(images)
    report("growing", 0.15)
    grown = grow_long_bones(located)
    grown = extend_into_dim_marrow(grown)
    grown = separate_fibula(grown)
    report("patella" if template is None else "template", 0.3)
    grown = grow_patella(grown)
    grown = drop_oversized_patella(grown)
    limited = limit_bones(grown)
    limited = limit_patella(limited)
    refined = refine_bones(limited, report)
    report("bones", 1.0)
    return _segmentation(refined)


def _segmentation(refined: RefinedBones) -> BoneSegmentation:
    """Collect labels, notes and what is missing."""
    limited = refined.limited
    located = limited.grown.located
    missing = {**_not_grown(limited.grown), **refined.rejected}
    notes = [] if limited.template_fit is None else [_fit_note(limited.template_fit)]
    if limited.grown.fibula is not None:
        notes.append(
            "The fibula had grown together with the tibia, and was separated from it: check the edge between them."
        )
    limits = (*located.limits, *((_TEMPLATE_UNUSED,) if limited.template_unused else ()), *refined.notes)
    return BoneSegmentation(
        labels=_labels(refined),
        bones=refined.bones,
        kinds=located.kinds,
        template_fit=limited.template_fit,
        notes=(*notes, *limits, *missing.values()),
        missing=missing,
        limits=limits,
    )


def _fit_note(fit: TemplateFit) -> str:
    """Describe which side the template is of, and how well it fits."""
    side = "mirrored, because it is of the other side" if fit.mirrored else "of the same side"
    return f"The template is {side}; {100 * fit.fit:.0f} % of its edges lie on edges of bone."


def _not_grown(grown: GrownBones) -> dict[str, str]:
    """Bone that did not grow, to the reason."""
    missing = {}
    if len(grown.long_bones) == 1:
        (name,) = grown.long_bones
        other = "tibia" if name == "femur" else "femur"
        missing[other] = f"No {other} was found: of the long bones, the image shows the {name} only."
    if "patella" not in grown.masks:
        missing["patella"] = "No patella was found: give a seed in it (--seed patella X Y Z)."
    return missing


def _labels(refined: RefinedBones) -> Labels:
    grid = refined.limited.grown.image_grid
    labels = np.zeros(grid.shape, dtype=np.uint8)
    for name in BONES:
        if name in refined.bones:
            part = labels[refined.boxes[name]]
            part[(refined.bones[name].distance_mm > 0) & (part == 0)] = LABELS[name]
    return Labels(labels=labels, grid=grid)

"""Check of a labelled knee that is to be a template: its surfaces, its side, and its faults."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from marey.arrays import Mask
from marey.errors import MareyError
from marey.knee.space.distances import distance_within
from marey.knee.space.sides import is_left
from marey.knee.space.structures import BONES, CARTILAGE_OF_BONE, LABELS
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.surfacing import surface_of_labels
from marey.knee.space.volume import Labels
from marey.wording import listed


@dataclass(frozen=True, kw_only=True)
class TemplateCheckSettings:
    """Settings for checking labels that are to be a template.

    Values without a stated source were chosen by hand.
    """

    crumb: float = 0.02
    """Bones with a larger share of voxels apart from the largest piece are reported."""
    holes: float = 0.002
    """Bones with a larger share of enclosed voxels without label are reported."""
    touching_mm: float = 1.0
    """Cartilage touches its bone when voxels lie within this distance [mm] of it, or a voxel."""
    on_bone_mm: float = 8.0
    """Largest distance [mm] of cartilage from its bone."""
    off_bone: float = 0.05
    """Cartilage is reported when a larger share of it lies farther from its bone."""
    least_contact: float = 0.2
    """Cartilage is reported when a smaller share of it touches its bone."""
    least_mm3: float = 100.0
    """Smaller structures [mm3] are reported."""


TEMPLATE_CHECK_DEFAULTS = TemplateCheckSettings()
"""Default settings for checking labels that are to be a template."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CheckedTemplate:
    """A template, with the results of its check."""

    labels: Labels
    surfaces: Mapping[str, TriangleSurface]
    """Structure to its surface."""
    side: str | None
    """"left" or "right"; None where no patella shows it."""
    faults: tuple[str, ...]
    """Why `marey knee segment` cannot use it, as sentences."""
    notes: tuple[str, ...]
    """What is missing or looks wrong in it, as sentences."""


def checked_template(
    labels: Labels, *, edge_mm: float = 1.0, settings: TemplateCheckSettings = TEMPLATE_CHECK_DEFAULTS
) -> CheckedTemplate:
    """Check whether labels can be a template, and make the surfaces of their structures.

    Args:
        labels: Of a knee.
        edge_mm: Length of the edges of the surfaces' triangles.
        settings: Tuned constants of the algorithm.

    Raises:
        MareyError: The labels contain no bone.
    """
    there = [name for name in LABELS if labels.mask(name).any()]
    bones = [name for name in BONES if name in there]
    if not bones:
        contained = listed((name.replace("_", " ") for name in there), none="nothing")
        raise MareyError(f"The template contains no bone: it needs femur and tibia, and contains {contained}.")
    masks = {name: labels.mask(name) for name in there}
    surfaces = {name: surface_of_labels(labels, name, edge_mm=edge_mm) for name in there}
    left = is_left(surfaces)
    faults = [f"The {name} is missing: `marey knee segment` needs femur and tibia in a template." for name in
              ("femur", "tibia") if name not in bones]  # fmt: skip
    notes = [note for name in there for note in _notes_on_shape(name, masks[name], labels, settings=settings)]
    notes += [note for bone in BONES for note in _notes_on_cartilage(bone, masks, labels, settings=settings)]
    if "patella" not in bones:
        notes.append(
            "The patella is missing: this template cannot find a patella, and the side of the knee is unknown."
        )
    elif left is None and "femur" in bones:
        notes.append("The patella lies in the middle of the femur: the side of the knee is unknown.")
    return CheckedTemplate(
        labels=labels,
        surfaces=surfaces,
        side=None if left is None else "left" if left else "right",
        faults=tuple(faults),
        notes=tuple(notes),
    )


def _notes_on_shape(name: str, mask: Mask, labels: Labels, *, settings: TemplateCheckSettings) -> list[str]:
    """Describe a structure that is too small, in pieces, or hollow."""
    words, notes = name.replace("_", " "), []
    if mask.sum() * labels.grid.voxel_mm3 < settings.least_mm3:
        notes.append(f"The {words} is only {mask.sum() * labels.grid.voxel_mm3:.0f} mm3 large.")
    if name not in BONES:
        return notes
    mask = mask[_box(mask, [1, 1, 1])]
    pieces, count = ndimage.label(mask)
    sizes = np.bincount(pieces.ravel())[1:]
    if count > 1 and sizes.max() < (1 - settings.crumb) * sizes.sum():
        share = 100 * (1 - sizes.max() / sizes.sum())
        notes.append(
            f"The {words} is in {count} pieces, {share:.0f} % of it apart from the largest, which alone is used."
        )
    hollow = (ndimage.binary_fill_holes(mask) & ~mask).sum() / mask.sum()
    if hollow > settings.holes:
        notes.append(f"The {words} is hollow: {100 * hollow:.1f} % of it is enclosed but not labelled.")
    return notes


def _notes_on_cartilage(
    bone: str, masks: Mapping[str, Mask], labels: Labels, *, settings: TemplateCheckSettings
) -> list[str]:
    """Describe cartilage that is missing, or does not lie on its bone."""
    cartilage = CARTILAGE_OF_BONE[bone]
    words = cartilage.replace("_", " ")
    if cartilage not in masks:
        return [f"The {words} is missing: none will be found on the {bone}."] if bone in masks else []
    if bone not in masks:
        return [f"There is {words}, but no {bone}."]
    box = _box(masks[cartilage], [math.ceil(1.2 * settings.on_bone_mm / mm) + 1 for mm in labels.grid.array_spacing_mm])
    distance = distance_within(~masks[bone][box], labels.grid.array_spacing_mm)
    away = distance[masks[cartilage][box]] - min(labels.grid.array_spacing_mm)
    off = float((away > settings.on_bone_mm).mean())
    if off > settings.off_bone:
        return [f"{100 * off:.0f} % of the {words} lies more than {settings.on_bone_mm:.0f} mm away from the {bone}."]
    # A sheet of usual thickness has a third of its voxels and more within a millimetre of the bone or a voxel of it.
    reach = max(settings.touching_mm, max(labels.grid.array_spacing_mm))
    if float((away <= reach).mean()) < settings.least_contact:
        return [f"The {words} does not touch the {bone}: a gap lies between them."]
    return []


def _box(mask: Mask, margins: Sequence[int]) -> tuple[slice, ...]:
    """Return the bounding box of a mask, with margins of voxels along each axis."""
    found = ndimage.find_objects(mask.astype(np.uint8))[0]
    return tuple(slice(max(each.start - more, 0), each.stop + more) for each, more in zip(found, margins, strict=True))

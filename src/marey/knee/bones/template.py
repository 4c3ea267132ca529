"""A knee whose labels are to be another one's template: its surfaces, its side, and what is wrong with it."""

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
from marey.knee.space.surface import Surface
from marey.knee.space.surfacing import surface_of_labels
from marey.knee.space.volume import Labels

_CRUMB = 0.02
_HOLES = 0.002
_TOUCHING_MM = 1.0
_ON_BONE_MM = 8.0
_OFF_BONE = 0.05
_LEAST_CONTACT = 0.2
_LEAST_MM3 = 100.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Template:
    """A template that was looked at."""

    labels: Labels
    surfaces: Mapping[str, Surface]
    """Of each structure that is there."""
    side: str | None
    """"left" or "right"; None where no patella tells."""
    faults: tuple[str, ...]
    """What keeps `marey knee segment` from using it, as sentences."""
    notes: tuple[str, ...]
    """What is missing or looks wrong in it, as sentences."""


def checked_template(labels: Labels, *, edge_mm: float = 1.0) -> Template:
    """Look whether labels can be a template, and make the surfaces of their structures.

    Args:
        labels: Somebody's knee.
        edge_mm: Length of the edges of the surfaces' triangles.

    Raises:
        MareyError: There is no bone in them.
    """
    there = [name for name in LABELS if labels.mask(name).any()]
    bones = [name for name in BONES if name in there]
    if not bones:
        raise MareyError(f"There is no bone in it: a template needs femur and tibia, and has {_listed(there)}.")
    masks = {name: labels.mask(name) for name in there}
    surfaces = {name: surface_of_labels(labels, name, edge_mm=edge_mm) for name in there}
    left = is_left(surfaces)
    faults = [f"The {name} is missing: `marey knee segment` needs femur and tibia in a template." for name in
              ("femur", "tibia") if name not in bones]  # fmt: skip
    notes = [note for name in there for note in _notes_on_shape(name, masks[name], labels)]
    notes += [note for bone in BONES for note in _notes_on_cartilage(bone, masks, labels)]
    if "patella" not in bones:
        notes.append(
            "The patella is missing: it will not be found by this template, and nothing tells left from right."
        )
    elif left is None and "femur" in bones:
        notes.append("The patella lies in the middle of the femur: nothing tells left from right.")
    return Template(
        labels=labels,
        surfaces=surfaces,
        side=None if left is None else "left" if left else "right",
        faults=tuple(faults),
        notes=tuple(notes),
    )


def _notes_on_shape(name: str, mask: Mask, labels: Labels) -> list[str]:
    """Say where a structure is too small to be one, in pieces, or hollow."""
    spoken, notes = name.replace("_", " "), []
    if mask.sum() * labels.grid.voxel_mm3 < _LEAST_MM3:
        notes.append(f"The {spoken} is only {mask.sum() * labels.grid.voxel_mm3:.0f} mm3 large.")
    if name not in BONES:
        return notes
    mask = mask[_box(mask, [1, 1, 1])]
    pieces, count = ndimage.label(mask)
    sizes = np.bincount(pieces.ravel())[1:]
    if count > 1 and sizes.max() < (1 - _CRUMB) * sizes.sum():
        share = 100 * (1 - sizes.max() / sizes.sum())
        notes.append(
            f"The {spoken} is in {count} pieces, {share:.0f} % of it apart from the largest, which alone counts."
        )
    hollow = (ndimage.binary_fill_holes(mask) & ~mask).sum() / mask.sum()
    if hollow > _HOLES:
        notes.append(f"The {spoken} is hollow: {100 * hollow:.1f} % of it is enclosed and not labelled.")
    return notes


def _notes_on_cartilage(bone: str, masks: Mapping[str, Mask], labels: Labels) -> list[str]:
    """Say where a bone has no cartilage, or its cartilage does not lie on it."""
    cartilage = CARTILAGE_OF_BONE[bone]
    spoken = cartilage.replace("_", " ")
    if cartilage not in masks:
        return [f"The {spoken} is missing: none will be found on the {bone}."] if bone in masks else []
    if bone not in masks:
        return [f"There is {spoken}, but no {bone} for it to lie on."]
    box = _box(masks[cartilage], [math.ceil(1.2 * _ON_BONE_MM / mm) + 1 for mm in labels.grid.array_spacing_mm])
    distance = distance_within(~masks[bone][box], labels.grid.array_spacing_mm)
    away = distance[masks[cartilage][box]] - min(labels.grid.array_spacing_mm)
    off = float((away > _ON_BONE_MM).mean())
    if off > _OFF_BONE:
        return [f"{100 * off:.0f} % of the {spoken} lies more than {_ON_BONE_MM:.0f} mm away from the {bone}."]
    # A sheet of usual thickness has a third of its voxels and more within a millimetre of the bone or a voxel of it.
    reach = max(_TOUCHING_MM, max(labels.grid.array_spacing_mm))
    if float((away <= reach).mean()) < _LEAST_CONTACT:
        return [f"The {spoken} does not touch the {bone}: a gap lies between them."]
    return []


def _box(mask: Mask, margins: Sequence[int]) -> tuple[slice, ...]:
    """Where a mask lies, with margins of voxels along each axis."""
    found = ndimage.find_objects(mask.astype(np.uint8))[0]
    return tuple(slice(max(each.start - more, 0), each.stop + more) for each, more in zip(found, margins, strict=True))


def _listed(names: list[str]) -> str:
    return ", ".join(name.replace("_", " ") for name in names) or "nothing"

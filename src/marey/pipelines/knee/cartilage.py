"""Cartilage of a knee: found by that of a template, and written with its thickness."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from marey.arrays import Image
from marey.errors import MareyError
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from marey.io.mr.meshes import write_mesh
from marey.io.mr.tables import write_parts
from marey.io.npz import write_arrays
from marey.io.video.pictures import write_picture
from marey.knee.bones.bones import BoneSegmentation
from marey.knee.cartilage.knee_cartilage import KneeCartilage, find_knee_cartilage, knee_template
from marey.knee.cartilage.labels import with_cartilage
from marey.knee.cartilage.subregions import Subregion, flat_map, subregion_names, subregions, whole
from marey.knee.space.cut_ends import at_cut
from marey.knee.space.sides import MIRROR, is_left
from marey.knee.space.structures import BONES, CARTILAGE_OF_BONE, LABELS
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.surfacing import surface_of_labels
from marey.knee.space.volume import Labels, Volume
from marey.pipelines.progress import Progress
from marey.view.pictures.flat_cartilage import flat_picture
from marey.view.pictures.knee_maps import thickness_colours

_LEFT_OUT = "The template was not used: it does not fit the only long bone in the image."
"""Reason for missing cartilage if the template could not be aligned."""


def cartilage_by_template(
    volumes: Sequence[Volume], bones: BoneSegmentation, surfaces: Mapping[str, TriangleSurface],
    template: Labels | None, progress: Progress,
) -> tuple[KneeCartilage | None, dict[str, str]]:  # fmt: skip
    """Find the cartilages that the template has.

    A cartilage that cannot be found is no error: the result names it with the reason, and the bones are kept.

    Args:
        volumes: The images.
        bones: The segmented bones.
        surfaces: Surfaces of the bones by name.
        template: Labels of another knee, of either side.
        progress: Progress reporter.

    Returns:
        The cartilage, and the names of missing cartilages with the reason.
    """
    fit = bones.template_fit
    if template is None:
        return None, {}
    held = [name for name in LABELS if template.mask(name).any()]
    if not any(CARTILAGE_OF_BONE[bone] in held for bone in BONES):
        progress.warn("The template has no cartilage: only bones were segmented.")
        return None, {}
    wanted = [CARTILAGE_OF_BONE[bone] for bone in BONES if CARTILAGE_OF_BONE[bone] in held]
    if fit is None:
        return None, dict.fromkeys(wanted, _LEFT_OUT)
    try:
        with progress.stage("Template", len(held)) as step:
            parts = {}
            for name in held:
                parts[name] = surface_of_labels(template, name, edge_mm=1.0)
                step()
            model = knee_template(parts, mirror=fit.mirrored)
        with progress.stage_of_shares("Cartilage") as done:
            found = find_knee_cartilage(volumes, surfaces, model, _starts(bones, model.bones), done)
    except MareyError as problem:
        progress.warn(f"Cartilage was not found, only bones were segmented. {problem}")
        return None, dict.fromkeys(wanted, str(problem))
    for note in found.notes:
        progress.warn(note)
    missing = {CARTILAGE_OF_BONE[bone]: found.missing[bone] for bone in BONES if bone in found.missing}
    for name, reason in missing.items():
        progress.warn(f"The {name.replace('_', ' ')} was not found. {reason}")
    return (found if found.sheets else None), missing


def labels_with(bones: BoneSegmentation, cartilage: KneeCartilage | None) -> Labels:
    """Return the labels of the bones, and of the cartilage if there is any."""
    return bones.labels if cartilage is None else with_cartilage(bones.labels, cartilage.sheets)


@dataclass(frozen=True, eq=False, kw_only=True)
class CartilageMaps:
    """Parts of the cartilages, which require a known side of the knee."""

    left: bool | None = None
    """Whether it is a left knee; None if that is not known."""
    parts: Mapping[str, Sequence[Subregion]] = field(default_factory=dict)
    """Measures of the parts of each cartilage, by its name; empty if the side is not known."""


def known_side(surfaces: Mapping[str, TriangleSurface], side: str | None) -> bool | None:
    """Return whether it is a left knee: as given, or by the position of the patella; None if that is not known."""
    return is_left(surfaces) if side is None else side == "left"


def cartilage_maps(
    cartilage: KneeCartilage, surfaces: Mapping[str, TriangleSurface], side: str | None, progress: Progress
) -> CartilageMaps:
    """Measure the parts of each cartilage.

    Args:
        cartilage: The cartilage that was found.
        surfaces: Surfaces of the bones by name.
        side: `left` or `right`; by default the position of the patella decides.
        progress: Progress reporter.
    """
    left = known_side(surfaces, side)
    if left is None:
        progress.warn(
            "The side of the knee is not known: medial and lateral parts are not measured. Give side (--side)."
        )
    elif side is None:
        progress.report(f"This is a {'left' if left else 'right'} knee, according to the position of its patella.")
    for bone, sheet in cartilage.sheets.items():
        name = CARTILAGE_OF_BONE[bone]
        progress.report(f"{name}: {sheet.outer.volume_mm3 / 1000:.1f} cm3, mean {whole(sheet).mean_mm:.2f} mm")
    if left is None:
        return CartilageMaps()
    parts = {
        CARTILAGE_OF_BONE[bone]: subregions(bone, sheet, left=left) for bone, sheet in cartilage.sheets.items()
    }  # fmt: skip
    return CartilageMaps(left=left, parts=parts)


def write_cartilage(folder: Path, cartilage: KneeCartilage, maps: CartilageMaps) -> dict[str, Image]:
    """Write the surface, the thickness and the flat image of each cartilage, and the table of their parts.

    Args:
        folder: The folder.
        cartilage: The cartilage that was found.
        maps: Measures of its parts.

    Returns:
        The flat images by the name of the cartilage; none if the side of the knee is not known.
    """
    pictures: dict[str, Image] = {}
    for bone, sheet in cartilage.sheets.items():
        name = CARTILAGE_OF_BONE[bone]
        arrays: dict[str, object] = {
            "thickness_mm": sheet.thickness_mm,
            "thickness_sd_mm": sheet.thickness_sd_mm,
            "confidence": sheet.confidence,
            "shared_mm": sheet.shared_mm,
            "at_cut": at_cut(sheet.bone),
        }
        colours = thickness_colours(sheet.thickness_mm)
        write_mesh(folder / f"{name}.ply", sheet.outer)
        write_mesh(
            folder / f"{bone}_thickness.ply", sheet.bone, colours=colours,
            values={"thickness_mm": sheet.thickness_mm, "confidence": sheet.confidence},
        )  # fmt: skip
        write_mesh(folder / f"{bone}_thickness.glb", sheet.bone, colours=colours)
        if maps.left is not None:
            arrays["subregion"] = np.array(subregion_names(bone, sheet, left=maps.left))
            flat = flat_map(bone, sheet, left=maps.left)
            pictures[name] = flat_picture(flat.across, flat.along, sheet.thickness_mm)
            write_picture(folder / f"{name}_flat.png", pictures[name])
        write_arrays(folder / f"{bone}_thickness.npz", arrays)
    if maps.parts:
        write_parts(folder / "cartilage.csv", maps.parts)
    return pictures


def _starts(bones: BoneSegmentation, model: Mapping[str, TriangleSurface]) -> dict[str, RigidTransform]:
    """Return the rigid motions nearest to the placements of the template that limited the bones."""
    starts = {}
    fit = bones.template_fit
    for bone, surface in model.items():
        if fit is None or bone not in fit.placements:
            continue
        placement = fit.placements[bone]
        matrix = placement.matrix @ (MIRROR[:3, :3] if fit.mirrored else np.eye(3))
        middle = surface.vertices_mm.mean(0)
        turn = rotations.nearest(matrix)
        starts[bone] = RigidTransform(turn, matrix @ middle + placement.shift - turn @ middle)
    return starts

"""`marey knee thickness`: from the surfaces of a bone and its cartilage to the thickness over each vertex."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem, MareyError
from marey.io.mr.meshes import write_mesh
from marey.io.npz import write_arrays
from marey.knee.cartilage.thickness import cartilage_thickness
from marey.knee.space.surface import Surface
from marey.pipelines.knee.meshes import check_order, check_place, read_bone, read_cartilage
from marey.pipelines.progress import Progress
from marey.view.pictures.knee_maps import thickness_colours


def measure_thickness(
    bone: Path, cartilages: Sequence[Path], out: Path | None, progress: Progress
) -> tuple[Path, str]:  # fmt: skip
    """Measure and write `thickness.npz`, and the bone coloured by it as `thickness.ply`.

    Args:
        bone: A mesh.
        cartilages: The meshes on it.
        out: The folder; `BONE_marey` beside the bone when None.
        progress: Is told what was mended.

    Returns:
        The folder, and a sentence on what was found.

    Raises:
        FileProblem: A mesh cannot be used.
    """
    out = out or bone.with_name(f"{bone.stem}_marey")
    surface = read_bone(bone, progress)
    sheets = [read_cartilage(path, progress) for path in cartilages]
    each = [_over(bone, surface, path, sheet) for path, sheet in zip(cartilages, sheets, strict=True)]
    for path, sheet, over in zip(cartilages, sheets, each, strict=True):
        check_order(bone, surface, path, sheet)
        check_place(bone, surface, path, sheet, over, progress)
    thickness = np.max(each, axis=0)
    write_arrays(out / "thickness.npz", {"thickness_mm": thickness})
    write_mesh(out / "thickness.ply", surface, colours=thickness_colours(thickness), values={"thickness_mm": thickness})
    return out, _summary(thickness)


def _over(bone: Path, on: Surface, path: Path, sheet: Surface) -> Floats:
    """Measure one cartilage alone (N,) [mm]."""
    try:
        return cartilage_thickness(on, [sheet])
    except MareyError as error:
        text = str(error).rstrip(".")
        raise FileProblem(path, text[0].lower() + text[1:], f"Is it the cartilage of {bone}?") from error


def _summary(thickness: Floats) -> str:
    covered = thickness[thickness > 0]
    share = 100 * len(covered) / len(thickness)
    return (
        f"Cartilage over {share:.0f} % of {len(thickness)} vertices: mean {covered.mean():.2f} mm, "
        f"median {np.median(covered):.2f} mm, thickest {covered.max():.2f} mm."
    )

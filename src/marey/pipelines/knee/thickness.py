"""Thickness of cartilage over the vertices of a bone, from the surfaces of both."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from marey.arrays import Floats, Mask
from marey.errors import FileProblem, MareyError
from marey.io.mr.meshes import write_mesh
from marey.io.npz import write_arrays
from marey.knee.cartilage.thickness import cartilage_thickness
from marey.knee.space.cut_ends import at_cut
from marey.knee.space.surface import TriangleSurface
from marey.pipelines.knee.meshes import check_order, check_place, read_bone, read_cartilage
from marey.pipelines.labelled import Described, Summary
from marey.pipelines.progress import Progress, RecordingProgress
from marey.pipelines.run_record import finished_together, write_record
from marey.pipelines.values import PathLike, path_tuple
from marey.pipelines.verdict import Verdict, VerdictReason
from marey.view.pictures.knee_maps import thickness_colours

LEAST_CUT_SHARE = 0.01
"""Share of the covered area at flat ends from which on it is named. Chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class MeasuredThickness(Described):
    """The thickness of cartilage over the V vertices of a bone."""

    surface: TriangleSurface
    """The bone [mm]."""
    thickness_mm: Floats
    """(V,) thickness [mm]; 0 where the bone is bare."""
    cut: Mask
    """(V,) true on a flat end at which the image cut the bone: a thickness there is no measurement."""
    inputs: tuple[Path, ...] = ()
    """The files of the bone and its cartilages."""
    verdict: Verdict = field(default_factory=Verdict)
    """How far the thickness can be used, and what limits it."""

    def summary(self) -> Summary:
        """Return the covered share of the vertices, and mean, median and greatest thickness."""
        measured = self.thickness_mm[~self.cut]
        covered = measured[measured > 0]
        share = 100 * len(covered) / max(len(measured), 1)
        beside = f", without {int(self.cut.sum())} at a flat end" if self.cut.any() else ""
        lines = {
            "covered": f"{share:.0f} % of {len(measured)} vertices{beside}",
            "thickness": f"mean {covered.mean():.2f} mm, median {np.median(covered):.2f} mm, greatest "
            f"{covered.max():.2f} mm",
        }
        return Summary("Cartilage", lines)

    def save(self, folder: Path | str) -> Path:
        """Write `thickness.npz`, the bone coloured by the thickness as `thickness.ply`, and `run.json`.

        Args:
            folder: Folder for the files; it is created if it does not exist.

        Returns:
            The folder.
        """
        out, thickness = Path(folder), self.thickness_mm
        with finished_together(out, inputs=self.inputs) as staging:
            write_arrays(staging / "thickness.npz", {"thickness_mm": thickness, "at_cut": self.cut})
            write_mesh(
                staging / "thickness.ply", self.surface, colours=thickness_colours(thickness),
                values={"thickness_mm": thickness},
            )  # fmt: skip
            write_record(
                staging, command="knee thickness", settings={}, inputs=self.inputs, root=Path.cwd(),
                progress=RecordingProgress(), verdict=self.verdict,
            )  # fmt: skip
        return out


def measure_thickness(
    bone: PathLike, cartilages: PathLike | Sequence[PathLike], *, progress: Progress | None = None
) -> MeasuredThickness:
    """Measure the thickness of cartilage over each vertex of a bone.

    Args:
        bone: A mesh of the bone.
        cartilages: Closed meshes of the cartilage on it.
        progress: Progress reporter; it is warned of everything that was repaired in the meshes.

    Raises:
        FileProblem: A mesh cannot be used.
    """
    progress = progress or RecordingProgress()
    bone, paths = Path(bone), path_tuple(cartilages)
    surface = read_bone(bone, progress)
    sheets = [read_cartilage(path, progress) for path in paths]
    each = [_over(bone, surface, path, sheet) for path, sheet in zip(paths, sheets, strict=True)]
    reasons: list[VerdictReason] = []
    for path, sheet, over in zip(paths, sheets, each, strict=True):
        check_order(bone, surface, path, sheet)
        reasons += check_place(bone, surface, path, sheet, over, progress)
    thickness, cut = np.max(each, axis=0), at_cut(surface)
    reasons += _at_flat_ends(surface, thickness, cut)
    return MeasuredThickness(
        surface=surface, thickness_mm=thickness, cut=cut, inputs=(bone, *paths), verdict=Verdict.of(reasons)
    )


def _at_flat_ends(surface: TriangleSurface, thickness_mm: Floats, cut: Mask) -> tuple[VerdictReason, ...]:
    """Name a thickness at a flat end of the bone: along the normal of a cut, it is a width of the cartilage."""
    area = surface.vertex_areas_mm2
    covered = thickness_mm > 0
    share = float(area[covered & cut].sum() / max(area[covered].sum(), 1e-12))
    if share < LEAST_CUT_SHARE:
        return ()
    what = f"{share:.0%} of the covered area is a flat end of the bone, where its image ended: no thickness is measured"
    return (VerdictReason.limit(f"{what} there (`at_cut`)."),)


def _over(bone: Path, on: TriangleSurface, path: Path, sheet: TriangleSurface) -> Floats:
    """Measure the thickness (V,) of one cartilage [mm]."""
    try:
        return cartilage_thickness(on, [sheet])
    except MareyError as error:
        text = str(error).rstrip(".")
        raise FileProblem(path, text[0].lower() + text[1:], f"Give the cartilage of {bone}.") from error

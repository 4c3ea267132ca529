"""A segmented knee, as a labelled result."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.errors import FileProblem
from marey.extras import import_optional
from marey.io.mr import gadolinium
from marey.io.mr.gadolinium import MarkersInScanner
from marey.io.mr.meshes import read_mesh
from marey.io.mr.tables import read_parts
from marey.io.mr.volumes import read_labels
from marey.io.npz import read_arrays
from marey.knee.cartilage.subregions import Subregion
from marey.knee.space.structures import BONES, CARTILAGE_OF_BONE, LABELS
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.volume import Labels
from marey.pipelines.knee.cartilage import known_side, labels_with
from marey.pipelines.knee.found_knee import FoundKnee
from marey.pipelines.knee.segment_results import write_knee
from marey.pipelines.labelled import Described, Summary
from marey.pipelines.progress import Progress
from marey.pipelines.result_files import ResultFiles
from marey.pipelines.run_details import RunDetails
from marey.pipelines.verdict import Verdict

COMMAND = "knee segment"
"""The command that writes the same files."""
_FILE = "labels.nii.gz"
"""The file by which a folder of results is recognised."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BoneCoverage:
    """The thickness of the cartilage over the V vertices of a bone's surface."""

    bone: str
    """Name of the bone."""
    thickness_mm: Floats
    """(V,) thickness [mm]; 0 where the bone is bare."""
    sd_mm: Floats
    """(V,) standard deviation of the thickness [mm]."""
    confidence: Floats
    """(V,) probability that the thickness, or that the bone is bare, is right to 0.5 mm."""
    areas_mm2: Floats
    """(V,) area of the bone's surface around each vertex [mm2]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "thickness_mm", "sd_mm", "confidence", "areas_mm2")

    @property
    def mean_mm(self) -> float:
        """Mean thickness over the covered area [mm]; NaN if the bone is bare."""
        covered = self.thickness_mm > 0
        if not covered.any():
            return float("nan")
        return float(np.average(self.thickness_mm[covered], weights=self.areas_mm2[covered]))

    def __repr__(self) -> str:
        share = 100 * float((self.thickness_mm > 0).mean())
        return f"<Cartilage of the {self.bone}: mean {self.mean_mm:.2f} mm over {share:.0f} % of its vertices>"


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Knee(Described):
    """The bones and the cartilage of a knee.

    Example:
        >>> import marey
        >>> knee = marey.load_knee("knee_marey")
        >>> knee.bones
        ('femur', 'tibia', 'patella')
        >>> volume_cm3 = knee.surfaces["femur"].volume_mm3 / 1000
    """

    labels: Labels
    """The structure of each voxel, on the grid of the first image."""
    surfaces: Mapping[str, TriangleSurface]
    """Closed surfaces of bones and cartilages by name, LPS [mm]."""
    thickness: Mapping[str, BoneCoverage] = field(default_factory=dict)
    """Thickness of the cartilage over each bone, by the bone's name."""
    parts: Mapping[str, Sequence[Subregion]] = field(default_factory=dict)
    """Area, volume and thickness of the parts of each cartilage, by the cartilage's name."""
    side: str | None = None
    """`left` or `right`; None if it is not known."""
    markers: MarkersInScanner | None = None
    """Gadolinium markers on the skin; None if there are none."""
    missing: Mapping[str, str] = field(default_factory=dict)
    """Structures that were not found, with the reason."""
    details: RunDetails
    """Settings, inputs, warnings and times of the run."""
    found: FoundKnee | None = None
    """All intermediate results; None for a knee that was read from a folder."""
    folder: Path | None = None
    """The folder from which the knee was read."""

    @staticmethod
    def of(found: FoundKnee, details: RunDetails) -> "Knee":
        """Collect the result of a segmentation.

        Args:
            found: Everything that was found in the images.
            details: Settings, inputs, warnings and times of the run.
        """
        sheets = {} if found.cartilage is None else found.cartilage.sheets
        outer = {CARTILAGE_OF_BONE[bone]: sheet.outer for bone, sheet in sheets.items()}
        left = known_side(found.surfaces, found.side)
        return Knee(
            labels=labels_with(found.bones, found.cartilage), surfaces={**found.surfaces, **outer},
            thickness={
                bone: BoneCoverage(
                    bone=bone, thickness_mm=sheet.thickness_mm, sd_mm=sheet.thickness_sd_mm,
                    confidence=sheet.confidence, areas_mm2=sheet.bone.vertex_areas_mm2,
                )
                for bone, sheet in sheets.items()
            },
            parts=found.maps.parts, side=None if left is None else "left" if left else "right", markers=found.markers,
            missing=found.missing, details=details, found=found,
        )  # fmt: skip

    @property
    def bones(self) -> tuple[str, ...]:
        """Names of the bones that were found."""
        return tuple(bone for bone in BONES if bone in self.surfaces)

    @property
    def verdict(self) -> Verdict | None:
        """How far the result can be used, and what limits it; None for a result of an earlier version."""
        return self.details.verdict

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings of the run, one sentence each."""
        return self.details.warnings

    def summary(self) -> Summary:
        """Return a line per structure with its volume, and the mean thickness of each cartilage."""
        lines = {}
        thickness = {CARTILAGE_OF_BONE[bone]: each for bone, each in self.thickness.items()}
        for name, surface in self.surfaces.items():
            volume = f"{surface.volume_mm3 / 1000:.1f} cm3"
            more = f", mean thickness {thickness[name].mean_mm:.2f} mm" if name in thickness else ""
            lines[name] = f"{volume}, {surface.area_mm2 / 100:.0f} cm2{more}"
        if self.missing:
            lines["not found"] = ", ".join(self.missing)
        return Summary(f"Knee, {self.side or 'unknown'} side", lines)

    def to_pandas(self) -> Any:
        """Return the measures of the parts of each cartilage as a `pandas.DataFrame`, one row per part.

        Raises:
            MissingPackage: pandas is not installed.
        """
        pandas = import_optional("pandas", extra="pandas", purpose="Tables")
        rows = [
            {
                "cartilage": name, "part": part.name, "area_mm2": part.area_mm2, "volume_mm3": part.volume_mm3,
                "mean_mm": part.mean_mm, "thickest_mm": part.thickest_mm, "covered_percent": 100 * part.covered,
            }
            for name, parts in self.parts.items()
            for part in parts
        ]  # fmt: skip
        return pandas.DataFrame(rows)

    def to_xarray(self) -> Any:
        """Return the labels as an `xarray.DataArray` (k, j, i); grid position and label names are attributes.

        Raises:
            MissingPackage: xarray is not installed.
        """
        xarray = import_optional("xarray", extra="xarray", purpose="Labelled arrays")
        names = {name: number for name, number in LABELS.items() if (self.labels.labels == number).any()}
        return xarray.DataArray(
            self.labels.labels, dims=("k", "j", "i"), name="labels",
            attrs={"lps_from_voxel": self.labels.grid.lps_from_voxel.ravel().tolist(), "units": "mm", **names},
        )  # fmt: skip

    def plot(self, bone: str = "femur", *, axes: Any = None) -> Any:
        """Draw the thickness of the cartilage over a bone, seen along the axis of the leg; the patella from the front.

        Args:
            bone: Name of the bone.
            axes: Matplotlib's axes to draw on; new ones by default.

        Returns:
            The axes.

        Raises:
            UnknownName: No cartilage was found on this bone.
            MissingPackage: Matplotlib is not installed.
        """
        from marey.pipelines.labelled import find_name
        from marey.view.pictures.thickness_plot import draw_thickness

        name = tuple(self.thickness)[find_name(bone, tuple(self.thickness), kind="bone with cartilage")]
        shown = self.thickness[name]
        return draw_thickness(self.surfaces[name].vertices_mm, shown.thickness_mm, bone=name, axes=axes)

    def save(self, folder: Path | str, *, progress: Progress | None = None) -> Path:
        """Write the files of `marey knee segment`: labels, surfaces, cartilage, markers, report and run.json.

        A knee that was read from a folder is copied from there.

        Args:
            folder: Folder for the files; it is created if it does not exist.
            progress: Progress reporter.

        Returns:
            The folder.
        """
        folder = Path(folder)
        if self.found is None:
            ResultFiles(self.folder or folder).save(folder, file=_FILE)
        else:
            write_knee(self.found, self.details, folder, progress or self.details.resumed_progress())
        return folder


def load_knee(folder: Path | str) -> Knee:
    """Read the results of `marey knee segment`, or of `Knee.save`.

    Args:
        folder: A folder with `labels.nii.gz`, and the surfaces beside it.

    Raises:
        FileProblem: A file is missing or damaged.

    Example:
        >>> import marey
        >>> knee = marey.load_knee("knee_marey")
        >>> knee.side
        'left'
    """
    folder = Path(folder)
    if not (folder / _FILE).is_file():
        raise FileProblem(folder, "has no labels.nii.gz", "Give a folder with the results of `marey knee segment`.")
    surfaces = {name: read_mesh(folder / f"{name}.ply") for name in LABELS if (folder / f"{name}.ply").is_file()}
    details = RunDetails.read(folder, COMMAND, file=_FILE)
    missing, given = details.settings.get("missing"), details.settings.get("side")
    bones = {name: surface for name, surface in surfaces.items() if name in BONES}
    left = known_side(bones, given if isinstance(given, str) else None)
    table, marked = folder / "cartilage.csv", folder / gadolinium.FILE
    return Knee(
        labels=read_labels(folder), surfaces=surfaces,
        thickness={
            bone: _coverage(folder / f"{bone}_thickness.npz", bone, surface)
            for bone, surface in bones.items()
            if (folder / f"{bone}_thickness.npz").is_file()
        },
        parts=read_parts(table) if table.is_file() else {},
        side=None if left is None else "left" if left else "right",
        markers=gadolinium.read_markers(marked) if marked.is_file() else None,
        missing=missing if isinstance(missing, dict) else {}, details=details, folder=folder,
    )  # fmt: skip


def _coverage(path: Path, bone: str, surface: TriangleSurface) -> BoneCoverage:
    arrays = read_arrays(path, ("thickness_mm", "thickness_sd_mm", "confidence"))
    if len(arrays["thickness_mm"]) != len(surface.vertices_mm):
        wrong = f"has {len(arrays['thickness_mm'])} values, and {bone}.ply has {len(surface.vertices_mm)} vertices"
        raise FileProblem(path, wrong, "Run `marey knee segment` again.")
    return BoneCoverage(
        bone=bone, thickness_mm=arrays["thickness_mm"], sd_mm=arrays["thickness_sd_mm"],
        confidence=arrays["confidence"], areas_mm2=surface.vertex_areas_mm2,
    )  # fmt: skip

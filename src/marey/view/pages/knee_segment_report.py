"""report.html of a segmented knee: sizes, slices with outlines, a 3-D view, thickness of cartilage."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from marey.arrays import Floats, Image
from marey.io.atomic import replacing
from marey.knee.cartilage.outer_surface import CartilageSheet
from marey.knee.cartilage.subregions import Subregion, whole
from marey.knee.space.structures import BONES, CARTILAGE_OF_BONE
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.volume import Labels, Volume
from marey.view.pages.curves import CurvesContent, NumberTable, curves_data
from marey.view.pages.html import PageHead, Still, jpeg_address, packed, rendered
from marey.view.pages.knee_scene import part_data, scale_colours, scene_data, thickness_codes
from marey.view.pages.knee_slices import keys_of, slices_with_outlines
from marey.view.pages.problems import readable
from marey.view.pictures.knee_maps import FULL_MM
from marey.view.pictures.knee_picture import DrawnPart

FILE = "report.html"
"""File name of the page."""
FILES = {
    "labels.nii.gz": "structure of each voxel of the image, numbered as in labels.json",
    **{f"{bone}.ply": f"the {bone}'s closed surface in LPS coordinates [mm]" for bone in BONES},
    **{f"{name}.ply": f"the {readable(name)}'s closed surface" for name in CARTILAGE_OF_BONE.values()},
    **{f"{bone}_thickness.npz": f"thickness at each vertex of {bone}.ply, with confidence" for bone in BONES},
    **{f"{bone}_thickness.ply": f"the {bone} coloured by thickness; also as GLB" for bone in BONES},
    **{f"{name}_flat.png": f"thickness map of the {readable(name)} in a plane" for name in CARTILAGE_OF_BONE.values()},
    "cartilage.csv": "table of the regions of each cartilage",
    "markers.json": "centres of the gadolinium markers",
    "run.json": "version, settings, inputs, timings",
}
"""Files beside the page and their content."""
_MEANING = {
    "Outlines": "Boundaries of the structures in labels.nii.gz. Check that they follow the edges of the bones, and "
    "that no bone lacks a part or contains a part of something else.",
    "Volume, area": "Of the closed surfaces. A bone ends where the image ends: its size is that of the imaged part, "
    "including the flat cut.",
    "Thickness": "Measured along the outward normal of the bone. The mean is weighted by the area of the covered "
    "bone. In the table of regions the volume is area times thickness, which on a convex bone is slightly less than "
    "that of the closed surface.",
    "Marrow": "Dark in images with fat suppression, bright in others; determined from the image.",
    "Letters": "Directions of the patient: A anterior, P posterior, H head, F feet, R right, L left. L 12 mm is 12 mm "
    "to the left of the origin of the scanner.",
}
"""Explanations of the terms on the page."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SegmentReport:
    """Content of the page of a segmented knee."""

    title: str
    volume: Volume
    """The image on which the outlines are drawn."""
    labels: Labels
    """Labels on the grid of `volume`."""
    bones: Mapping[str, TriangleSurface]
    kinds: Sequence[str]
    """Marrow of each image: dark or bright."""
    left: bool | None
    """Whether it is a left knee; None if unknown."""
    side_given: bool = False
    sheets: Mapping[str, CartilageSheet] = field(default_factory=dict)
    """Cartilage by bone, for the bones that have cartilage."""
    parts: Mapping[str, Sequence[Subregion]] = field(default_factory=dict)
    """Regions by cartilage; the last is the whole."""
    flat: Mapping[str, Image] = field(default_factory=dict)
    """Flat thickness map by cartilage."""
    marker_diameter_mm: Floats = field(default_factory=lambda: np.zeros(0))
    """(M,) diameters of the gadolinium markers [mm]."""
    notes: Sequence[str] = ()
    timings: Mapping[str, float] = field(default_factory=dict)
    settings: Mapping[str, object] = field(default_factory=dict)
    files: Sequence[str] = ()
    """Names of the files beside the page."""
    head: PageHead = field(default_factory=PageHead)


def write_segment_report(path: Path, report: SegmentReport) -> None:
    """Write the page.

    Args:
        path: The HTML file.
        report: The content of the page.
    """
    with replacing(path) as beside:
        beside.write_text(segment_html(report), encoding="utf-8")


def segment_html(report: SegmentReport) -> str:
    """Return the page as one HTML document that loads nothing from elsewhere."""
    files = {name: what for name, what in FILES.items() if name in (*report.files, "run.json")}
    content = CurvesContent(
        kind="Bones and cartilage of a knee" if report.sheets else "Bones of a knee", title=report.title,
        time=np.zeros(1), tiles=_tiles(report), notes=report.notes, tables=_tables(report), stills=_flat(report),
        timings=report.timings, settings=report.settings, meaning=_MEANING, files=files,
        head=report.head,
    )  # fmt: skip
    pictures = slices_with_outlines(report.volume, report.labels)
    return rendered(
        "knee_segment.html", content, data=curves_data(content, 1) | {"knee": _scene(report)},
        keys=[(readable(name), colour) for name, colour in keys_of(report.labels).items()],
        slices=[(picture.caption, jpeg_address(picture.image)) for picture in pictures],
        slices_legend=_slices_legend(report), scene_legend=_scene_legend(report),
    )  # fmt: skip


def _slices_legend(report: SegmentReport) -> str:
    which = " Shown is the first of the two images." if len(report.kinds) > 1 else ""
    return f"Letters: A anterior, P posterior, H head, F feet, R and L right and left of the patient.{which}"


def _scene_legend(report: SegmentReport) -> str:
    return "Colours: thickness of cartilage." if report.sheets else "Bones only: cartilage was not searched for or "
    "not found."


def _scene(report: SegmentReport) -> dict[str, object]:
    """Return meshes in scanner coordinates, with cartilage coloured by thickness."""
    parts = {name: DrawnPart(bone=name, surface=bone, cartilage=False) for name, bone in report.bones.items()}
    thickness = {}
    for bone, sheet in report.sheets.items():
        name = CARTILAGE_OF_BONE[bone]
        parts[name] = DrawnPart(bone=bone, surface=sheet.outer, cartilage=True)
        thickness[name] = sheet.outer_thickness_mm
    scale = {"ends": ["0 mm", f"{FULL_MM:g} mm."], "colours": scale_colours()} if thickness else None
    still = packed(np.eye(4)[None, :3], "f4")
    return scene_data(parts, left=report.left) | {
        "scale": scale, "parts": [_part(name, part, thickness.get(name)) for name, part in parts.items()],
        "motions": [{"label": "", "poses": dict.fromkeys(report.bones, still), "paths": []}],
        "carried": {}, "held": "room", "heading": 0.0,
    }  # fmt: skip


def _part(name: str, part: DrawnPart, thickness_mm: Floats | None) -> dict[str, object]:
    mesh = part_data(name, part, switch=name, shown=True)
    if thickness_mm is None:
        return mesh | {"sources": None, "maps": [None]}
    codes = packed(thickness_codes(thickness_mm, FULL_MM), "u1")
    return mesh | {"sources": packed(np.arange(len(thickness_mm)), "u4"), "maps": [codes]}


def _tiles(report: SegmentReport) -> list[tuple[str, str, str]]:
    """Return the key figures: label, value, and the line below."""
    side = {None: "unknown", True: "left", False: "right"}[report.left]
    source = "" if report.left is None else "given" if report.side_given else "from the position of the patella"
    images = "images" if len(report.kinds) > 1 else "image"
    tiles = [("side", side, source), ("marrow", ", ".join(report.kinds), f"in the {images}")]
    tiles += [
        (name, f"{bone.volume_mm3 / 1000:.1f} cm³", f"{bone.area_mm2 / 100:.0f} cm² surface area")
        for name, bone in report.bones.items()
    ]
    for bone, sheet in report.sheets.items():
        volume = f"mean thickness; {sheet.outer.volume_mm3 / 1000:.1f} cm³"
        tiles.append((readable(CARTILAGE_OF_BONE[bone]), f"{whole(sheet).mean_mm:.2f} mm", volume))
    count = len(report.marker_diameter_mm)
    wide = f"{np.median(report.marker_diameter_mm):.1f} mm diameter" if count else "none found on the skin"
    return [*tiles, ("gadolinium markers", str(count), wide)]


def _flat(report: SegmentReport) -> list[Still]:
    seen = {"femur": "unrolled about the axis of the condyles", "tibia": "from above", "patella": "from behind"}
    return [
        Still(caption=f"Thickness of the {readable(CARTILAGE_OF_BONE[bone])}, {how}", image=report.flat[name])
        for bone, how in seen.items()
        if (name := CARTILAGE_OF_BONE[bone]) in report.flat
    ]


def _tables(report: SegmentReport) -> list[NumberTable]:
    rows = [
        (readable(name), part.name, *(_number(value, digits) for value, digits in (
            (part.area_mm2, 0), (part.volume_mm3, 0), (part.mean_mm, 2), (part.thickest_mm, 2), (100 * part.covered, 0),
        )))
        for name, found in report.parts.items() for part in found
    ]  # fmt: skip
    if not rows:
        return []
    head = ("cartilage", "region", "area mm²", "volume mm³", "mean mm", "thickest mm", "covered %")
    legend = "As in cartilage.csv. Area: covered bone. Thickest: 99th percentile of the thickness."
    return [NumberTable(title="Regions of the cartilage", head=head, rows=rows, legend=legend, text_columns=(0, 1))]


def _number(value: float, digits: int) -> str:
    return "" if np.isnan(value) else f"{value:,.{digits}f}"

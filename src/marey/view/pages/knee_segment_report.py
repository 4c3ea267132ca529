"""report.html of a segmented knee: its sizes, slices with outlines, bones and cartilage that turn, thickness."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from marey.arrays import Floats, Image
from marey.io.atomic import replacing
from marey.knee.cartilage.outer_surface import CartilageSheet
from marey.knee.cartilage.subregions import Subregion, whole
from marey.knee.space.structures import BONES, CARTILAGE_OF_BONE
from marey.knee.space.surface import Surface
from marey.knee.space.volume import Labels, Volume
from marey.view.pages.curves import CurvesContent, NumberTable, curves_data
from marey.view.pages.html import Still, jpeg_address, packed, rendered
from marey.view.pages.knee_scene import part_data, scale_colours, scene_data, thickness_codes
from marey.view.pages.knee_slices import keys_of, slices_with_outlines
from marey.view.pages.problems import readable
from marey.view.pictures.knee_maps import FULL_MM
from marey.view.pictures.knee_picture import DrawnPart

FILE = "report.html"
FILES = {
    "labels.nii.gz": "what each voxel of the image belongs to, by the numbers in labels.json",
    **{f"{bone}.ply": f"the {bone}'s closed surface, LPS in mm" for bone in BONES},
    **{f"{name}.ply": f"the {readable(name)}'s closed surface" for name in CARTILAGE_OF_BONE.values()},
    **{f"{bone}_thickness.npz": f"thickness at each vertex of {bone}.ply, with confidence" for bone in BONES},
    **{f"{bone}_thickness.ply": f"the {bone} in the colours of thickness; beside it as GLB" for bone in BONES},
    **{f"{name}_flat.png": f"thickness of the {readable(name)} in the plane" for name in CARTILAGE_OF_BONE.values()},
    "cartilage.csv": "the parts of each cartilage as a table",
    "markers.json": "centres of the gadolinium markers",
    "run.json": "version, settings, inputs, timings",
}
_MEANING = {
    "Outlines": "Of the voxels in labels.nii.gz, where half of a voxel belongs to a structure. Look whether they run "
    "on the bones' edges, and whether a bone lacks a part or holds one that is not its own.",
    "Volume, area": "Of the closed surfaces. A bone ends where the image ends: its size is that of the part in view, "
    "with the flat cut.",
    "Thickness": "Along the outward normal of the bone. The mean weighs the covered bone by its area. In the table of "
    "parts a volume is area times thickness, which on a round bone is a little less than that of the closed surface.",
    "Marrow": "Dark where fat is suppressed, bright elsewhere; the program tells by the image.",
    "Letters": "Of the patient: A front, P back, H head, F feet, R right, L left. L 12 mm is 12 mm to the left of the "
    "scanner's origin.",
}


@dataclass(frozen=True, eq=False, kw_only=True)
class SegmentReport:
    """All that the page tells."""

    title: str
    volume: Volume
    """On which the outlines are drawn."""
    labels: Labels
    """On its grid."""
    bones: Mapping[str, Surface]
    kinds: Sequence[str]
    """Marrow of each image, dark or bright."""
    left: bool | None
    """Whether it is a left knee; None where nobody knows."""
    side_given: bool = False
    sheets: Mapping[str, CartilageSheet] = field(default_factory=dict)
    """Cartilage by its bone, of those that have some."""
    parts: Mapping[str, Sequence[Subregion]] = field(default_factory=dict)
    """By the cartilage, the whole as the last."""
    flat: Mapping[str, Image] = field(default_factory=dict)
    """Flat picture of each cartilage."""
    marker_diameter_mm: Floats = field(default_factory=lambda: np.zeros(0))
    """(M,) of the gadolinium markers."""
    notes: Sequence[str] = ()
    timings: Mapping[str, float] = field(default_factory=dict)
    settings: Mapping[str, object] = field(default_factory=dict)
    files: Sequence[str] = ()
    """Names of what stands beside the page."""


def write_segment_report(path: Path, report: SegmentReport) -> None:
    """Write the page.

    Args:
        path: The HTML file.
        report: What it tells.
    """
    with replacing(path) as beside:
        beside.write_text(segment_html(report), encoding="utf-8")


def segment_html(report: SegmentReport) -> str:
    """Give the page's text: one HTML document that loads nothing from elsewhere."""
    files = {name: what for name, what in FILES.items() if name in (*report.files, "run.json")}
    content = CurvesContent(
        kind="Bones and cartilage of a knee" if report.sheets else "Bones of a knee", title=report.title,
        time=np.zeros(1), tiles=_tiles(report), notes=report.notes, tables=_tables(report), stills=_flat(report),
        timings=report.timings, settings=report.settings, meaning=_MEANING, files=files,
    )  # fmt: skip
    pictures = slices_with_outlines(report.volume, report.labels)
    return rendered(
        "knee_segment.html", content, data=curves_data(content, 1) | {"knee": _scene(report)},
        keys=[(readable(name), colour) for name, colour in keys_of(report.labels).items()],
        slices=[(picture.caption, jpeg_address(picture.image)) for picture in pictures],
        slices_legend=_slices_legend(report), scene_legend=_scene_legend(report),
    )  # fmt: skip


def _slices_legend(report: SegmentReport) -> str:
    which = " The first of the two images." if len(report.kinds) > 1 else ""
    return f"Letters: A front, P back, H head, F feet, R and L the patient's right and left.{which}"


def _scene_legend(report: SegmentReport) -> str:
    return "Thickness of cartilage." if report.sheets else "Bones only: no cartilage was looked for, or none found."


def _scene(report: SegmentReport) -> dict[str, object]:
    """Give meshes that stand where the scanner saw them, cartilage in the colours of its thickness."""
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
    """Give the key figures: label, value, and what stands below it."""
    side = {None: "unknown", True: "left", False: "right"}[report.left]
    told = "" if report.left is None else "as it was given" if report.side_given else "by the patella's place"
    tiles = [("side", side, told), ("marrow", ", ".join(report.kinds), f"in the image{'s' * (len(report.kinds) > 1)}")]
    tiles += [
        (name, f"{bone.volume_mm3 / 1000:.1f} cm³", f"{bone.area_mm2 / 100:.0f} cm² of surface")
        for name, bone in report.bones.items()
    ]
    for bone, sheet in report.sheets.items():
        volume = f"mean thickness; {sheet.outer.volume_mm3 / 1000:.1f} cm³"
        tiles.append((readable(CARTILAGE_OF_BONE[bone]), f"{whole(sheet).mean_mm:.2f} mm", volume))
    count = len(report.marker_diameter_mm)
    wide = f"{np.median(report.marker_diameter_mm):.1f} mm wide" if count else "none on the skin"
    return [*tiles, ("gadolinium markers", str(count), wide)]


def _flat(report: SegmentReport) -> list[Still]:
    seen = {"femur": "unrolled about the axis of its condyles", "tibia": "from above", "patella": "from behind"}
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
    head = ("cartilage", "part", "area mm²", "volume mm³", "mean mm", "thickest mm", "covered %")
    legend = "As in cartilage.csv. Area is covered bone; 99 % of it has less than the thickest."
    return [NumberTable(title="Parts of the cartilage", head=head, rows=rows, legend=legend, text_columns=(0, 1))]


def _number(value: float, digits: int) -> str:
    return "" if np.isnan(value) else f"{value:,.{digits}f}"

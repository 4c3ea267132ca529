"""Meshes of bones and cartilage from users: read, checked, and repaired where that is safe."""

from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem
from marey.io.mr.meshes import read_mesh
from marey.knee.space.mesh_repair import consistently_oriented, with_holes_closed
from marey.knee.space.surface import TriangleSurface
from marey.pipelines.progress import Progress
from marey.pipelines.verdict import VerdictReason

SMALLEST_MM, LARGEST_MM = 10.0, 700.0
"""Limits of the longest side of a bone of the knee [mm]: a part of a patella, a whole femur."""

THINNEST_MM = 3.0
"""Least extent of a bone across its plane [mm]; even a part of a patella has more."""
_MOST_CARTILAGE = 0.5
"""Greatest volume of a cartilage, as a share of its bone's; that of a patella has a third at most."""
_LEAST_OVER_BONE, _MOSTLY_OVER_BONE = 0.4, 0.8
"""Shares of a cartilage's volume over its bone below which there is an error, and a warning.

The share is 0.9 and more for a cartilage on its bone, 0.25 at most for one that is 20 mm away, of half the size, or of
another bone, and about 0.5 on half of a bone.
"""

SMALL_HOLE = 30
"""Greatest number of edges of a hole that is closed. Chosen by hand."""


def read_bone(path: Path, progress: Progress) -> TriangleSurface:
    """Read the mesh of a bone; faces whose orientation differs from that of their neighbours are reversed.

    Number and order of the vertices remain unchanged.

    Args:
        path: A mesh.
        progress: Progress reporter; it is warned of reversed faces.

    Raises:
        FileProblem: It cannot be read, it is flat, or its size is not that of a bone in millimetres.
    """
    surface = read_mesh(path)
    used = surface.vertices_mm[surface.faces]
    longest = float((used.max((0, 1)) - used.min((0, 1))).max())
    if not SMALLEST_MM < longest < LARGEST_MM:
        remedy = "Meshes should be in millimetres (GLB in metres)."
        for factor, unit in ((1000.0, "metres"), (10.0, "centimetres"), (0.001, "micrometres")):
            if SMALLEST_MM < factor * longest < LARGEST_MM:
                remedy = f"Is it in {unit}? {remedy} Multiply its coordinates by {factor:g}."
                break
        raise FileProblem(path, f"is {longest:.3g} mm long, unlike any bone of the knee", remedy)
    if _thickness_mm(used.reshape(-1, 3)) < THINNEST_MM:
        wrong = f"is flat: {len(surface.faces)} faces in one plane"
        raise FileProblem(path, wrong, "Give the closed surface of a bone.")
    alike, turned = consistently_oriented(surface)
    if turned.any():
        progress.warn(f"{path.name}: {turned.sum()} of {len(turned)} faces pointed inward and were reversed.")
    return alike


def _thickness_mm(points: Floats) -> float:
    """Return the extent of points (N, 3) across the plane nearest to them [mm]."""
    across = np.linalg.eigh(np.cov(points.T))[1][:, 0]
    return float(np.ptp(points @ across))


def check_order(bone: Path, on: TriangleSurface, cartilage: Path, sheet: TriangleSurface) -> None:
    """Make sure that bone and cartilage were not exchanged.

    Args:
        bone: The file of the bone.
        on: The bone.
        cartilage: The file of the cartilage.
        sheet: The cartilage, closed.

    Raises:
        FileProblem: The cartilage has more than half of the bone's volume. The volume of an open bone is not known.
    """
    whole, _, left = with_holes_closed(on, SMALL_HOLE)
    if not left and sheet.volume_mm3 > _MOST_CARTILAGE * whole.volume_mm3:
        sizes = f"{sheet.volume_mm3 / 1000:.1f} cm3, the bone {bone.name} {whole.volume_mm3 / 1000:.1f} cm3"
        raise FileProblem(
            cartilage, f"is too large for the cartilage of that bone: its volume is {sizes}",
            "Give the bone first, then the cartilages on it; both in millimetres.",
        )  # fmt: skip


def check_place(
    bone: Path, on: TriangleSurface, cartilage: Path, sheet: TriangleSurface, thickness_mm: Floats, progress: Progress
) -> tuple[VerdictReason, ...]:
    """Make sure that a cartilage is on the bone, by the share of its volume over the bone's vertices.

    Args:
        bone: The file of the bone.
        on: The bone.
        cartilage: The file of the cartilage.
        sheet: The cartilage, closed.
        thickness_mm: (V,) thickness of this cartilage alone over the bone's vertices [mm].
        progress: Progress reporter; it is warned of a part that is not on the bone.

    Returns:
        What limits the use of the thickness.

    Raises:
        FileProblem: Most of it is elsewhere: it has another place or size, or is of another bone.
    """
    share = float(thickness_mm @ on.vertex_areas_mm2) / sheet.volume_mm3
    wrong = f"only {100 * share:.0f} % of its volume is over the bone {bone.name}"
    if share < _LEAST_OVER_BONE:
        remedy = "Give bone and cartilage of the same person, in the same place and in millimetres."
        raise FileProblem(cartilage, f"is not on that bone: {wrong}", remedy)
    if share < _MOSTLY_OVER_BONE:
        text = f"{cartilage.name}: {wrong}; the rest is not measured."
        progress.warn(text)
        return (VerdictReason.limit(text),)
    return ()


def read_cartilage(path: Path, progress: Progress) -> TriangleSurface:
    """Read the closed surface of a cartilage; faces that are inward are reversed, and small holes closed.

    Args:
        path: A mesh.
        progress: Progress reporter; it is warned of repairs.

    Raises:
        FileProblem: It cannot be read, or it is open.
    """
    alike, turned = consistently_oriented(read_mesh(path))
    if turned.any():
        progress.warn(f"{path.name}: {turned.sum()} of {len(turned)} faces pointed inward and were reversed.")
    whole, closed, left = with_holes_closed(alike, SMALL_HOLE)
    if closed:
        progress.warn(f"{path.name}: {closed} small {'holes were' if closed > 1 else 'hole was'} closed.")
    if left:
        raise FileProblem(
            path,
            f"is open: {left} edges have a face on one side only, so its volume is not known",
            "Give the cartilage as a closed surface, with its inner and outer sheet.",
        )
    return whole

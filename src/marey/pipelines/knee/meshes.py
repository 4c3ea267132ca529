"""Meshes of bones as users give them: read, and checked for what goes wrong with them."""

from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem
from marey.io.mr.meshes import read_mesh
from marey.knee.space.mesh_repair import consistently_oriented, with_holes_closed
from marey.knee.space.surface import Surface
from marey.pipelines.progress import Progress

SMALLEST_MM, LARGEST_MM = 10.0, 700.0
"""The longest side of a bone of a knee, a patella or a whole femur, lies between them."""

THINNEST_MM = 3.0
"""Even a part of a patella reaches farther across."""
_MOST_CARTILAGE = 0.5
"""Of a bone's volume; a patella's cartilage has a third at most."""
_LEAST_OVER_BONE, _MOSTLY_OVER_BONE = 0.4, 0.8
"""Shares of a cartilage: nine tenths and more where it lies on its bone, a quarter at most where it is moved by 20 mm,
made half as large, or another bone's; half of a bone carries the half."""

SMALL_HOLE = 30
"""A hole with so many edges at most is closed."""


def read_bone(path: Path, progress: Progress) -> Surface:
    """Read a bone's mesh; faces that turn another way than their neighbours are turned, and that is said.

    The vertices stay as they are, in number and order.

    Raises:
        FileProblem: It cannot be read, it is flat, or its size is not that of a bone in millimetres.
    """
    surface = read_mesh(path)
    used = surface.vertices_mm[surface.faces]
    longest = float((used.max((0, 1)) - used.min((0, 1))).max())
    if not SMALLEST_MM < longest < LARGEST_MM:
        remedy = "Meshes are in millimetres here (GLB alone in metres)."
        for factor, unit in ((1000.0, "metres"), (10.0, "centimetres"), (0.001, "micrometres")):
            if SMALLEST_MM < factor * longest < LARGEST_MM:
                remedy = f"Is it in {unit}? {remedy} Multiply its coordinates by {factor:g}."
                break
        raise FileProblem(path, f"is {longest:.3g} mm long, which no bone of a knee is", remedy)
    if _thickness_mm(used.reshape(-1, 3)) < THINNEST_MM:
        raise FileProblem(path, f"is flat: {len(surface.faces)} faces in one plane", "Give the surface of a bone.")
    alike, turned = consistently_oriented(surface)
    if turned.any():
        progress.warn(f"{path.name}: {turned.sum()} of {len(turned)} faces turned inward; they were turned.")
    return alike


def _thickness_mm(points: Floats) -> float:
    """Give how far points (N, 3) reach across the plane that lies nearest to them."""
    across = np.linalg.eigh(np.cov(points.T))[1][:, 0]
    return float(np.ptp(points @ across))


def check_order(bone: Path, on: Surface, cartilage: Path, sheet: Surface) -> None:
    """Make sure that what is given for cartilage is none of the bone's size.

    Raises:
        FileProblem: It encloses more than half as much; an open bone encloses nothing that could be told.
    """
    whole, _, left = with_holes_closed(on, SMALL_HOLE)
    if not left and sheet.volume_mm3 > _MOST_CARTILAGE * whole.volume_mm3:
        sizes = f"{sheet.volume_mm3 / 1000:.1f} cm3, the bone {bone.name} {whole.volume_mm3 / 1000:.1f} cm3"
        raise FileProblem(
            cartilage, f"is too large for the cartilage of that bone: it encloses {sizes}",
            "The bone is named first, then the cartilages on it; both in millimetres.",
        )  # fmt: skip


def check_place(
    bone: Path, on: Surface, cartilage: Path, sheet: Surface, thickness_mm: Floats, progress: Progress
) -> None:
    """Make sure that a cartilage lies on the bone, by how much of it the thickness over the vertices accounts for.

    Args:
        bone: The file of the bone.
        on: The bone.
        cartilage: The file of the cartilage.
        sheet: The cartilage, closed.
        thickness_mm: (N,) of this cartilage alone, over the bone's vertices.
        progress: Is told of a part that lies on nothing.

    Raises:
        FileProblem: Most of it lies elsewhere: it is moved, of another size or another bone's.
    """
    share = float(thickness_mm @ on.vertex_areas_mm2) / sheet.volume_mm3
    wrong = f"only {100 * share:.0f} % of what it encloses lies over the bone {bone.name}"
    if share < _LEAST_OVER_BONE:
        remedy = "Give both as one person's, in one place and in millimetres."
        raise FileProblem(cartilage, f"does not lie on that bone: {wrong}", remedy)
    if share < _MOSTLY_OVER_BONE:
        progress.warn(f"{cartilage.name}: {wrong}; the rest is in no number.")


def read_cartilage(path: Path, progress: Progress) -> Surface:
    """Read the closed surface of a cartilage; faces that turn inward are turned and small holes closed, and both said.

    Raises:
        FileProblem: It cannot be read, or it is open.
    """
    alike, turned = consistently_oriented(read_mesh(path))
    if turned.any():
        progress.warn(f"{path.name}: {turned.sum()} of {len(turned)} faces turned inward; they were turned.")
    whole, closed, left = with_holes_closed(alike, SMALL_HOLE)
    if closed:
        progress.warn(f"{path.name}: {closed} small {'holes were' if closed > 1 else 'hole was'} closed.")
    if left:
        raise FileProblem(
            path,
            f"is open: {left} edges have a face on one side only, so what is within is not known",
            "Give the cartilage as a closed surface, with its inner and its outer sheet.",
        )
    return whole

"""Plot of the thickness of cartilage over a bone with Matplotlib, which is an optional package."""

from typing import Any

from marey.arrays import Floats
from marey.view.pictures.plots import new_axes

_AXES = {"patella": (0, 2, "left (mm)", "head (mm)")}
"""The two LPS axes that a bone is seen along, with their labels; other bones are seen along the axis of the leg."""
_ALONG_LEG = (0, 1, "left (mm)", "back (mm)")
"""The axes and labels of femur and tibia."""
_DOT = 4.0
"""Area of the dot at each vertex [points2]. Chosen by eye."""


def draw_thickness(vertices_mm: Floats, thickness_mm: Floats, *, bone: str, axes: Any = None) -> Any:
    """Draw the thickness at the covered vertices of a bone as coloured dots.

    Args:
        vertices_mm: (V, 3) LPS [mm].
        thickness_mm: (V,) [mm]; 0 where the bone is bare.
        bone: Name of the bone, for the title and the direction of view.
        axes: Matplotlib's axes to draw on; new ones by default.

    Returns:
        The axes.

    Raises:
        MissingPackage: Matplotlib is not installed.
    """
    if axes is None:
        axes = new_axes()
    first, second, label, other_label = _AXES.get(bone, _ALONG_LEG)
    covered = thickness_mm > 0
    dots = axes.scatter(
        vertices_mm[covered, first], vertices_mm[covered, second], c=thickness_mm[covered], s=_DOT, cmap="viridis"
    )
    axes.figure.colorbar(dots, ax=axes, label="thickness (mm)")
    axes.set_aspect("equal")
    axes.set(xlabel=label, ylabel=other_label, title=f"Cartilage of the {bone}")
    return axes

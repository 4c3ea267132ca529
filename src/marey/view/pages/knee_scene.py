"""Data of the 3-D view of a knee: meshes, and colours coded as integers."""

from collections.abc import Mapping, Sequence

import numpy as np

from marey.arrays import Floats
from marey.view.pages.html import packed
from marey.view.pictures.knee_maps import BONE, FAR, OVERLAP, STOPS
from marey.view.pictures.knee_picture import DrawnPart

_STEPS = 65535
"""Largest coded coordinate: 16 bits."""


def scene_data(parts: Mapping[str, DrawnPart], *, left: bool | None) -> dict[str, object]:
    """Return the data of the view besides meshes and poses.

    Args:
        parts: Structures by name.
        left: Whether it is a left knee; None if unknown.
    """
    places = np.concatenate([part.surface.vertices_mm for part in parts.values()])
    low, high = places.min(0), places.max(0)
    return {
        "middle": ((low + high) / 2).tolist(), "size": float((high - low).max()) / 1.9, "left": left,
        "stops": scale_colours(), "overlap": hex_colour(OVERLAP), "far": hex_colour(FAR), "bone": hex_colour(BONE),
    }  # fmt: skip


def part_data(name: str, part: DrawnPart, *, switch: str, shown: bool) -> dict[str, object]:
    """Return the mesh of a structure.

    Args:
        name: Name of the structure.
        part: The drawn part.
        switch: Name of the switch that shows and hides it.
        shown: Whether it is visible initially.
    """
    surface = part.surface
    low = surface.vertices_mm.min(0)
    step = max(float((surface.vertices_mm.max(0) - low).max()) / _STEPS, 1e-9)
    wide = len(surface.vertices_mm) > _STEPS
    return {
        "name": name, "bone": part.bone, "cartilage": part.cartilage, "switch": switch, "shown": shown,
        "low": low.tolist(), "step": step, "places": packed(np.round((surface.vertices_mm - low) / step), "u2"),
        "faces": packed(surface.faces, "u4" if wide else "u2"), "wide": wide,
    }  # fmt: skip


def nearness_codes(distance: Floats, limit_mm: float) -> Floats:
    """Code distances as integers: 0 far or unknown, 1 overlap, 2 to 255 from 0 to the limit."""
    near = np.nan_to_num(distance, nan=np.inf) < limit_mm
    return np.where(near, np.where(distance < 0, 1, 2 + np.round(253 * np.where(near, distance, 0) / limit_mm)), 0)


def thickness_codes(thickness_mm: Floats, full_mm: float) -> Floats:
    """Code thicknesses in the same way, with thick cartilage in the colour of small distances; 0 where bare."""
    return nearness_codes(full_mm - np.clip(np.nan_to_num(thickness_mm), 0, full_mm), full_mm)


def scale_colours() -> list[str]:
    """Return the colours of the scale as #rrggbb, from thin or far to thick or near."""
    return [hex_colour(colour) for colour in STOPS]


def hex_colour(colour: Sequence[float] | Floats) -> str:
    """Format red, green and blue as #rrggbb."""
    return "#" + "".join(f"{int(channel):02x}" for channel in colour)

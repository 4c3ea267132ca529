"""Writing a scaled OpenSim model, and the scale factors and masses with their intervals as JSON."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from marey.body.articulation.model_scaling import BodyScale
from marey.io.atomic import replacing
from marey.io.opensim.osim import NORMAL_95


@dataclass(frozen=True, eq=False, kw_only=True)
class ScaleReport:
    """How a model was scaled to a person."""

    model: Path
    """The model that was given."""
    joints: Mapping[str, str]
    """Maps a joint centre of the person to the body of the model that rotates about it."""
    scales: tuple[BodyScale, ...]
    """Factors of all bodies."""
    masses: Mapping[str, float]
    """Mass of each body [kg]."""
    mass: float | None
    """Mass of the person [kg]; None if unknown."""
    mass_sd: float
    """Its standard deviation [kg]; NaN if it was given or is unknown."""
    mass_source: str
    """Where the mass comes from, as a phrase."""
    notes: tuple[str, ...]
    """What was assumed, one sentence each."""


def write_scaled_osim(path: Path | str, root: Element) -> None:
    """Write the document of an OpenSim model.

    Args:
        path: The file.
        root: The root of the document.
    """
    ElementTree.indent(root)
    with replacing(path) as temporary:
        ElementTree.ElementTree(root).write(temporary, encoding="UTF-8", xml_declaration=True)


def write_scale_report(path: Path | str, report: ScaleReport) -> None:
    """Write `scale.json`: the factors of each body with 95 % intervals, masses, and what was assumed.

    Args:
        path: The file.
        report: The factors.
    """
    share = report.mass_sd / report.mass if report.mass else float("nan")
    masses = {scale.body: report.masses.get(scale.body, 0.0) for scale in report.scales}
    bodies = {
        scale.body: {
            "factors": [round(float(v), 6) for v in scale.factors],
            "interval": [_interval(v, sd) for v, sd in zip(scale.factors, scale.sd, strict=True)],
            "measured": scale.measured,
            "source": scale.source,
            "mass_kg": round(masses[scale.body], 6),
            "mass_interval_kg": _interval(masses[scale.body], share * masses[scale.body]),
        }
        for scale in report.scales
    }  # fmt: skip
    content = {
        "model": report.model.name,
        "interval": "95 %",
        "mass_kg": report.mass,
        "mass_interval_kg": None if report.mass is None else _interval(report.mass, report.mass_sd),
        "mass_source": report.mass_source,
        "joints": dict(report.joints),
        "bodies": bodies,
        "notes": list(report.notes),
    }
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def _interval(value: float, sd: float) -> list[float] | None:
    """Return the limits of the 95 % interval; None if the standard deviation is unknown."""
    if not np.isfinite(sd):
        return None
    return [round(float(value - NORMAL_95 * sd), 6), round(float(value + NORMAL_95 * sd), 6)]

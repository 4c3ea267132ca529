"""`correspondence.json`: transform of each bone from the scanner to its laboratory frame, with its accuracy."""

import json
import re
from pathlib import Path

import numpy as np

from marey.io.atomic import replacing
from marey.knee.markers.correspondence import BoneCorrespondence, KneeCorrespondence

_ROWS = re.compile(r"\[\s+([-+.\deE,\s]+?)\s+\]")
"""Matches a list of numbers over several lines of JSON, to be written in one line."""


def write_correspondence(path: Path | str, found: KneeCorrespondence) -> None:
    """Write the transforms as 4x4 matrices [mm], their standard deviations [deg, mm] and residuals by marker.

    Args:
        path: The file.
        found: The correspondence between the scanned knee and the captured activity.
    """
    naming = found.naming
    table = {
        "unit": "mm",
        "bones": {bone: _bone(each) for bone, each in found.bones.items()},
        "without_correspondence": dict(found.missing),
        "marker_names": list(naming.labels),
        "marker_segment": list(naming.bones),
        "notes": list(found.notes),
    }
    with replacing(path) as beside:
        beside.write_text(_ROWS.sub(_in_one_line, json.dumps(table, indent=1)) + "\n", encoding="utf-8")


def _in_one_line(numbers: re.Match[str]) -> str:
    return "[" + ", ".join(numbers[1].split()).replace(",,", ",") + "]"


def _bone(found: BoneCorrespondence) -> dict[str, object]:
    sd = np.sqrt(np.diag(found.fit.covariance))
    markers = {
        name: {
            "number": ball, "residual_mm": found.fit.residuals_mm[m].round(4).tolist(), "used": bool(found.fit.used[m])
        }
        for m, (name, ball) in enumerate(zip(found.fit.names, found.balls, strict=True))
    }  # fmt: skip
    return {
        "segment": found.segment,
        "mr_anatomic_from_mr_global": found.mr_anatomic_from_mr_global.matrix().tolist(),
        "capture_anatomic_from_mr_anatomic": found.capture_anatomic_from_mr_anatomic.matrix().tolist(),
        "rotation_sd_deg": np.degrees(sd[:3]).tolist(),
        "translation_sd_mm": sd[3:].tolist(),
        "covariance_rad_mm": found.fit.covariance.tolist(),
        "residual_mm": found.fit.residual_mm,
        "reference_posture_residual_mm": found.posture_residual_mm,
        "markers": markers,
        "mr_anatomic_from": found.frame_source,
        "notes": list(found.notes),
    }

"""The content of calibration.json, and the key figures of a calibration in words."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from marey.calibration.adjustment.lens_choice import LensChoice
from marey.calibration.adjustment.state import CAMERA, LENS_NAMES, SHAPE_NAMES
from marey.calibration.quality.finding import left_out_text
from marey.calibration.quality.views import CameraQuality
from marey.calibration.timing.wand_clocks import StatedDelay
from marey.pipelines.calibrate.run import CalibratedSession

POSE_NAMES = ("rx", "ry", "rz", "tx", "ty", "tz")
"""Parameters of a camera's pose behind those of its lens: left rotation [rad] and translation [m] in camera axes."""
_DIGITS = 9
"""Significant digits of the numbers in the file."""


def calibration_content(found: CalibratedSession) -> dict[str, Any]:
    """Return everything that calibration.json holds.

    Args:
        found: The calibrated session.
    """
    solved, corners = found.solved, found.corners
    content = {
        "board": found.board.describe(),
        "together": found.together,
        "world": world_text(found),
        "points": _points(found),
        "floor_pictures": [corners.pictures[k] for k in found.floor],
        "noise": {
            "corner_sd_unit": solved.adjusted.unit,
            "board_rotation_deg": float(np.degrees(solved.adjusted.spread[0])),
            "board_translation_mm": 1e3 * solved.adjusted.spread[1],
        },
        "board_shape": dict(zip(SHAPE_NAMES, solved.state.shape.tolist(), strict=True)) if solved.shape else None,
        "cameras": {each.name: _camera(each) for each in found.cameras},
        "lens_models": _lens_models(found),
        "covariance": _covariance(found),
        "clocks": _clocks(found),
        "volume": {
            "points": found.volume.points.tolist(),
            "sd_mm": [None if np.isnan(sd) else 1e3 * sd for sd in found.volume.sd.tolist()],
            "cameras": found.volume.cameras.tolist(),
            "median_sd_mm": median_volume_mm(found),
        },
        "pictures": _pictures(found),
        "left_out": _left_out(found),
        "not_needed": [corners.pictures[k] for k in found.spare],
        "wrong_corners": solved.wrong_corners,
        "findings": [
            {"code": each.code, "severity": each.severity, "text": each.text, "advice": each.advice}
            for each in found.findings
        ],
    }
    return {key: _rounded(value) for key, value in content.items()}


def world_text(found: CalibratedSession) -> str:
    """Return what sets the world: floor, points, level with the cameras, or none."""
    if found.landmarks is not None:
        return "points"
    return "floor" if found.floor else "level with the cameras" if found.together else "none"


def median_volume_mm(found: CalibratedSession) -> float | None:
    """Return the median predicted standard deviation of a point in the capture volume [mm]; None without one."""
    known = found.volume.sd[np.isfinite(found.volume.sd)]
    return float(1e3 * np.median(known)) if len(known) else None


def _points(found: CalibratedSession) -> dict[str, Any] | None:
    """Return the points with known coordinates that set the world; None without any."""
    if found.landmarks is None:
        return None
    wrong = {name: 1e3 * off for name, off in found.landmarks.wrong}
    return {"used": list(found.landmarks.used), "scale": found.landmarks.scale, "wrong_mm": wrong}


def _lens_models(found: CalibratedSession) -> dict[str, Any] | None:
    """Return the choice of the coefficients of each lens; None if none was made."""
    pairs = zip(found.corners.cameras, found.solved.choices, strict=False)
    return {name: None if choice is None else _lens_choice(choice) for name, choice in pairs} or None


def _covariance(found: CalibratedSession) -> dict[str, Any]:
    """Return the covariance of lenses and poses of all cameras, with the names of the parameters."""
    count = CAMERA * found.solved.state.cameras
    return {
        "parameters": [f"{name}.{key}" for name in found.corners.cameras for key in (*LENS_NAMES, *POSE_NAMES)],
        "units": "px, 1, rad and m; rotations turn the camera's axes on the left, translations as in cameras.toml",
        "matrix": found.solved.covariance[:count, :count].tolist(),
    }


def _clocks(found: CalibratedSession) -> dict[str, Any] | None:
    """Return the delays of the cameras; None if they were not estimated."""
    if found.clock is None:
        return None
    delays = {found.corners.cameras[each.camera]: _delay(each, found.rate) for each in found.delays}
    return {"reference": found.clock, "cameras": delays}


def _left_out(found: CalibratedSession) -> list[dict[str, Any]]:
    """Return the views that were left out, with their reasons; without a camera it is all views of a picture."""
    pictures, cameras = found.corners.pictures, found.corners.cameras
    return [
        {
            "picture": pictures[each.picture], "camera": None if each.camera is None else cameras[each.camera],
            "reason": each.reason,
        }
        for each in found.solved.left_out
    ]  # fmt: skip


def _camera(each: CameraQuality) -> dict[str, Any]:
    return {
        "pictures": each.pictures, "corners": each.corners, "rms_px": each.rms_px, "median_px": each.median_px,
        "covered": each.covered, "coverage": each.coverage.tolist(), "tilt_deg": list(each.tilt_deg),
        "distance_m": list(each.distance_m),
        "lens": {
            name: {"value": float(value), "sd": float(sd)}
            for name, value, sd in zip(LENS_NAMES, each.lens, each.lens_sd, strict=True)
        },
        "rotation_sd_deg": each.rotation_sd_deg, "position_sd_mm": each.position_sd_mm,
        "relative_rotation_sd_deg": each.relative_rotation_sd_deg,
        "relative_position_sd_mm": each.relative_position_sd_mm,
    }  # fmt: skip


def _delay(each: StatedDelay, rate: float | None) -> dict[str, Any]:
    """Return the delay of a camera against the reference, with its standard deviation and 95 % interval."""
    late = each.pictures if each.known else np.nan
    return {
        "late_pictures": late, "sd_pictures": each.sd if each.known else np.nan,
        "interval_95": [late - 1.96 * each.sd, late + 1.96 * each.sd],
        "late_s": late / rate if rate else np.nan, "drift_pictures": each.drift, "drift_sd_pictures": each.drift_sd,
        "determined": each.known, "allowed_for": each.used,
    }  # fmt: skip


def _lens_choice(choice: LensChoice) -> dict[str, Any]:
    return {
        "coefficients": list(choice.coefficients), "given": choice.fixed, "effective_pictures": choice.pictures,
        "compared": [
            {
                "coefficients": list(each.coefficients), "chi_square": each.chi_square, "cost": each.cost,
                "probability": each.probability,
            }
            for each in choice.evidence
        ],
    }  # fmt: skip


def _pictures(found: CalibratedSession) -> list[dict[str, Any]]:
    views, corners = found.views, found.corners
    return [
        {
            "picture": corners.pictures[int(views.picture[k])], "camera": corners.cameras[int(views.camera[k])],
            "corners": int(views.corners[k]), "error_px": float(views.error_px[k]),
            "corner_sd_px": float(views.corner_sd_px[k]), "tilt_deg": float(views.tilt_deg[k]),
            "distance_m": float(views.distance_m[k]),
        }
        for k in range(len(views.camera))
    ]  # fmt: skip


def _rounded(value: Any) -> Any:
    """Return a value with rounded numbers, and None for those that are not finite, which JSON does not have."""
    if isinstance(value, float):
        return float(f"{value:.{_DIGITS}g}") if np.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _rounded(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(each) for each in value]
    return value


def summary_lines(content: Mapping[str, Any]) -> list[str]:
    """Return how good a calibration is and what to do next, one sentence a line.

    Args:
        content: The content of calibration.json.
    """
    return [*figure_lines(content), *_finding_lines(content)]


def figure_lines(content: Mapping[str, Any]) -> list[str]:
    """Return how good a calibration is, one sentence a line.

    Args:
        content: The content of calibration.json.
    """
    cameras = [each for each in content["cameras"].values() if each["corners"]]
    rms = [each["rms_px"] for each in cameras if each["rms_px"] is not None]
    focal = [100 * each["lens"]["fx"]["sd"] / each["lens"]["fx"]["value"] for each in cameras]
    models = [each for each in (content["lens_models"] or {}).values() if each is not None]
    lines = [f"Corners lie {np.median(rms):.2f} px (RMS) from their predictions; focal lengths to {max(focal):.2f} %."]
    if content["together"]:
        turn = max(each["relative_rotation_sd_deg"] for each in cameras)
        place = max(each["relative_position_sd_mm"] for each in cameras)
        median = content["volume"]["median_sd_mm"]
        space = "" if median is None else f"; a point in space to {median:.2f} mm (median)"
        lines.append(f"Cameras relative to each other to {turn:.3f} deg and {place:.2f} mm{space}.")
        floor = content["floor_pictures"]
        several = f" to {floor[-1]}" if len(floor) > 1 else ""
        set_by = f"The board on the floor ({floor[0]}{several}) sets the world." if floor else ""
        if content["world"] == "points":
            count = len(content["points"]["used"])
            set_by = f"{count} points with known coordinates set the world."
        lines.append(set_by or "The floor was not measured: the world is level with the cameras.")
    else:
        lines.append("The cameras recorded one at a time: only their lenses are known, not their poses.")
    if models:
        lines.append(f"Distortion of the lenses: {_model_counts([each['coefficients'] for each in models])}.")
    left = content["left_out"]
    if left:
        pictures = sum(each["camera"] is None for each in left)
        text = left_out_text(pictures, len(left) - pictures)
        lines.append(f"Left out: {text}; calibration.json states the reasons.")
    return lines


def _model_counts(models: Sequence[Sequence[str]]) -> str:
    """Return how many lenses have which coefficients, for example "k1 k2 (3 of 4), none (1 of 4)"."""
    names = [" ".join(each) or "none" for each in models]
    counts = sorted({(-names.count(name), name) for name in names})
    return ", ".join(f"{name} ({-number} of {len(names)})" for number, name in counts)


def _finding_lines(content: Mapping[str, Any]) -> list[str]:
    lines, findings = [], content["findings"]
    for each in [each for each in findings if each["severity"] == "problem"]:
        lines.append(f"Problem: {each['text']} {each['advice']}")
    cautions = [each for each in findings if each["severity"] == "caution"]
    lines += [f"Caution: {each['text']} {each['advice']}" for each in cautions[:_MOST_CAUTIONS]]
    if len(cautions) > _MOST_CAUTIONS:
        lines.append(f"{len(cautions) - _MOST_CAUTIONS} more cautions are in calibration.html.")
    if not any(each["severity"] != "note" for each in findings):
        lines.append("Nothing else needs to be filmed.")
    return lines


_MOST_CAUTIONS = 3
"""Number of cautions that are printed at most; the page has all. Chosen by hand."""

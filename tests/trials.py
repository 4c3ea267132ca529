"""Trials of skin markers whose bones are known, written as files that a laboratory would give."""

from pathlib import Path

import ezc3d
import numpy as np

from marey.geometry import rotations
from marey.io.npz import write_arrays

RATE = 100.0
FRAMES = 120
ORIGINS = {"thigh": np.array([0.0, 0.0, 0.0]), "shank": np.array([0.0, -0.42, 0.01])}


def true_bones(frames: int = FRAMES) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """A right thigh that swings and a shank whose knee bends: rotation (F, 3, 3) and origin (F, 3) [m]."""
    time = np.arange(frames) / RATE
    swing, bend = 0.4 * np.sin(5 * time), -0.6 + 0.5 * np.cos(5 * time)
    zero = np.zeros(frames)
    # Laboratory: Z up, walking along x; bones: X forward, Y up, Z to the right.
    upright = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    thigh = upright @ rotations.exp(np.stack([zero, 0.1 * np.sin(3 * time), swing], 1))
    shank = thigh @ rotations.about(np.eye(3)[2], bend) @ rotations.about(np.eye(3)[0], 0.05 * np.sin(4 * time))
    hip = np.stack([0.8 * time, 0.02 * np.sin(5 * time), 0.95 + zero], 1)
    return {"thigh": (thigh, hip), "shank": (shank, hip + thigh @ ORIGINS["shank"])}


def marker_places(count: int = 5) -> dict[str, np.ndarray]:
    """Markers (M, 3) in the bones' frames [m]."""
    rng = np.random.default_rng(7)
    return {name: np.array([0.03, -0.2, 0.05]) + 0.06 * rng.normal(size=(count, 3)) for name in ORIGINS}


def marker_points(noise: float = 0.0, frames: int = FRAMES) -> dict[str, np.ndarray]:
    """Labels to paths (F, 3) [m] in the laboratory."""
    rng, bones = np.random.default_rng(3), true_bones(frames)
    return {
        f"{name}_{k + 1:02d}": origin + rotation @ place + noise * rng.normal(size=(frames, 3))
        for name, (rotation, origin) in bones.items()
        for k, place in enumerate(marker_places()[name])
    }


def write_trial(
    path: Path, points: dict[str, np.ndarray], *, unit: str = "mm", rate: float = RATE, force: bool = False
) -> Path:
    """Write a C3D; NaN becomes a missing point, `force` adds two analog channels."""
    scale = {"mm": 1e3, "m": 1.0}[unit]
    c3d = ezc3d.c3d()
    c3d["parameters"]["POINT"]["RATE"]["value"] = [rate]
    c3d["parameters"]["POINT"]["UNITS"]["value"] = [unit]
    c3d["parameters"]["POINT"]["LABELS"]["value"] = list(points)
    frames = len(next(iter(points.values()))) if points else 0
    data = np.ones((4, len(points), frames))
    for k, path_of_one in enumerate(points.values()):
        data[:3, k] = path_of_one.T * scale
    missing = np.isnan(data).any(0)
    data[:3, missing] = 0
    c3d["data"]["points"] = data
    c3d["data"]["meta_points"]["residuals"] = np.where(missing, -1.0, 0.3)[None]
    c3d["data"]["meta_points"]["camera_masks"] = np.zeros((7, *missing.shape), bool)
    if force:
        c3d["parameters"]["ANALOG"]["RATE"]["value"] = [10 * rate]
        c3d["parameters"]["ANALOG"]["LABELS"]["value"] = ["Fz", "Mx"]
        analogs = np.stack([np.linspace(0, 700, 10 * frames), np.sin(np.linspace(0, 9, 10 * frames))])
        c3d["data"]["analogs"] = analogs[None]
    c3d.write(str(path))
    return path


def write_reference(path: Path, frames: list[int] | int = 0) -> Path:
    """Write where the true bones are in a frame, or in several."""
    arrays: dict[str, object] = {"frame": np.array(frames), "side": "right"}
    for name, (rotation, origin) in true_bones().items():
        arrays |= {f"{name}_rotation": rotation[frames], f"{name}_origin": 1e3 * origin[frames]}
    write_arrays(path, arrays)
    return path


def write_static(folder: Path, changed: dict[str, np.ndarray] | None = None, *, scale: float = 1.0) -> None:
    """A static trial with landmarks on the true bones, and a TOML that names them; some markers may be elsewhere."""
    bones = true_bones(1)
    thigh, shank = bones["thigh"], bones["shank"]
    places = {
        "EPL": (thigh, [0.0, -0.40, 0.05]), "EPM": (thigh, [0.0, -0.40, -0.05]), "HIP": (thigh, [0.0, 0.0, 0.0]),
        "ANL": (shank, [0.0, 0.0, 0.04]), "ANM": (shank, [0.0, 0.0, -0.04]),
        "TIL": (shank, [0.0, 0.38, 0.04]), "TIM": (shank, [0.0, 0.38, -0.04]),
    }  # fmt: skip
    points = {label: origin + rotation @ np.array(at) for label, ((rotation, origin), at) in places.items()}
    points = {**marker_points(frames=1), **points, **(changed or {})}
    write_trial(folder / "static.c3d", {label: scale * place for label, place in points.items()})
    (folder / "landmarks.toml").write_text(
        '[landmarks]\nHJC = "HIP"\nME = "EPM"\nLE = "EPL"\nMM = "ANM"\nLM = "ANL"\nMC = "TIM"\nLC = "TIL"\n'
    )

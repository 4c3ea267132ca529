"""A person made of rigid bones who wears a known marker set, with true joint angles, standing and walking."""

from pathlib import Path

import ezc3d
import numpy as np

from marey.geometry import rotations
from marey.markers.preprocessing.joint_centres import harrington_hip_centre
from tests.trials import RATE, write_trial

DEPTH, WIDTH, LEG, DIAMETER = 0.16, 0.25, 0.86, 0.014
KNEE_WIDTH, ANKLE_WIDTH = 0.1, 0.07
THIGH, SHANK, FOOT = 0.42, 0.4, 0.14
SIDES = (("left", "L", -1.0), ("right", "R", 1.0))
Angles = dict[str, np.ndarray]
"""Joint angles (F, 3) [rad] of hip, knee and ankle: flexion, adduction, rotation with the signs of the right side."""


def standing(frames: int = 60) -> Angles:
    """Angles of a person who stands straight."""
    return {joint: np.zeros((frames, 3)) for joint in ("hip", "knee", "ankle")}


def walking(frames: int = 80) -> Angles:
    """Angles that change in all three components."""
    time = np.arange(frames) / RATE
    course = np.stack([np.sin(7 * time), np.sin(7 * time + 1), np.sin(7 * time + 2)], 1)
    return {
        "hip": course * [0.4, 0.1, 0.1], "knee": np.abs(course) * [0.8, 0.05, 0.1], "ankle": course * [0.3, 0.05, 0.1]
    }  # fmt: skip


def _turn(angles: np.ndarray, mirror: float, flexion: float) -> np.ndarray:
    """Rotation (F, 3, 3) of a child in its parent by Cardan angles Z-X-Y; the left side is the mirror image."""
    z, x, y = np.eye(3)[[2, 0, 1]]
    first = rotations.about(z, flexion * angles[:, 0])
    return first @ rotations.about(x, mirror * angles[:, 1]) @ rotations.about(y, mirror * angles[:, 2])


def person(angles: Angles, *, speed: float = 0.0) -> dict[str, np.ndarray]:
    """Labels of Plug-in Gait with paths (F, 3) [m]; Z is up, the person looks along x and moves at a speed [m/s].

    The widths, the pelvis and the legs are as the constants state, so that the regression and the chord function give
    the true joint centres. Medial markers of knee and ankle are KNM and MED; markers on clusters are those of CGM2.3.
    """
    frames = len(angles["hip"])
    upright = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    pelvis = np.broadcast_to(upright, (frames, 3, 3))
    middle = np.stack([speed * np.arange(frames) / RATE, np.zeros(frames), np.full(frames, 0.95)], 1)
    points: dict[str, np.ndarray] = {}

    def put(label: str, rotation: np.ndarray, origin: np.ndarray, place: list[float]) -> None:
        points[label] = origin + rotation @ np.array(place)

    for side, letter, sign in SIDES:
        put(f"{letter}ASI", pelvis, middle, [0, 0, sign * WIDTH / 2])
        put(f"{letter}PSI", pelvis, middle, [-(DEPTH + DIAMETER), 0, sign * 0.05])
        hip_place = harrington_hip_centre(DEPTH, WIDTH, LEG, left=side == "left") - [DIAMETER / 2, 0, 0]
        hip = middle + pelvis @ hip_place
        thigh = pelvis @ _turn(angles["hip"], sign, 1.0)
        knee = hip - thigh @ np.array([0, THIGH, 0])
        shank = thigh @ _turn(angles["knee"], sign, -1.0)
        ankle = knee - shank @ np.array([0, SHANK, 0])
        foot = shank @ _turn(angles["ankle"], sign, 1.0)
        lateral, thick = sign * (KNEE_WIDTH + DIAMETER) / 2, sign * (ANKLE_WIDTH + DIAMETER) / 2
        put(f"{letter}THI", thigh, hip, [0, -0.25, sign * 0.1])
        put(f"{letter}KNE", thigh, knee, [0, 0, lateral])
        put(f"{letter}KNM", thigh, knee, [0, 0, -lateral])
        put(f"{letter}THAP", thigh, hip, [0.07, -0.15, sign * 0.02])
        put(f"{letter}THAD", thigh, hip, [0.06, -0.3, sign * 0.02])
        put(f"{letter}TIB", shank, knee, [0, -0.2, sign * 0.07])
        put(f"{letter}ANK", shank, ankle, [0, 0, thick])
        put(f"{letter}MED", shank, ankle, [0, 0, -thick])
        put(f"{letter}TIAP", shank, knee, [0.05, -0.1, 0])
        put(f"{letter}TIAD", shank, knee, [0.04, -0.25, 0])
        for k, place in enumerate(([0.05, -0.2], [0.07, -0.28], [-0.02, -0.3], [-0.04, -0.22]), 1):
            put(f"{letter}TH{k}", thigh, hip, [*place, sign * (0.07 + 0.005 * k)])
            put(f"{letter}SK{k}", shank, knee, [*place, sign * (0.05 + 0.005 * k)])
        put(f"{letter}HEE", foot, ankle, [-0.05, -0.06, 0])
        put(f"{letter}TOE", foot, ankle, [FOOT, -0.06, 0])
        put(f"{letter}FM1", foot, ankle, [FOOT - 0.02, -0.06, -sign * 0.04])
        put(f"{letter}FM5", foot, ankle, [FOOT - 0.02, -0.06, sign * 0.04])
        points[f"{letter}HJC"] = hip
    return points


def lower_body(points: dict[str, np.ndarray], *more: str) -> dict[str, np.ndarray]:
    """The markers of Plug-in Gait, and on both sides those of further labels."""
    wanted = ("ASI", "PSI", "THI", "KNE", "TIB", "ANK", "HEE", "TOE", *more)
    return {label: path for label, path in points.items() if label[1:] in wanted}


def ior(points: dict[str, np.ndarray], *, medial: bool) -> dict[str, np.ndarray]:
    """The same person with the labels of IOR; markers that only follow a bone are somewhere on it."""
    names = {"IAS": "ASI", "IPS": "PSI", "FTC": "THI", "FLE": "KNE", "FAX": "TIAP", "TTC": "TIAD", "FAL": "ANK",
             "FCC": "HEE", "FM1": "FM1", "FM2": "TOE", "FM5": "FM5"}  # fmt: skip
    names |= {"FME": "KNM", "TAM": "MED"} if medial else {}
    return {f"{side}_{name}": points[f"{side}{own}"] for side in "LR" for name, own in names.items()}


def cast(points: dict[str, np.ndarray], *, static: bool) -> dict[str, np.ndarray]:
    """The same person with clusters on thighs and shanks; knees and ankles have markers in the static trial only."""
    names = {"IAS": "ASI", "IPS": "PSI", "FCC": "HEE", "FM1": "FM1", "FM2": "TOE", "FM5": "FM5"}
    names |= {f"{part}{k}": f"{part}{k}" for part in ("TH", "SK") for k in range(1, 5)}
    names |= {"FLE": "KNE", "FME": "KNM", "FAL": "ANK", "TAM": "MED"} if static else {}
    return {f"{side}_{name}": points[f"{side}{own}"] for side in "LR" for name, own in names.items()}


def opencap(points: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The same person with the labels of OpenCap."""
    names = {"knee": "KNE", "mknee": "KNM", "ankle": "ANK", "mankle": "MED", "calc": "HEE", "toe": "TOE",
             "5meta": "FM5", "thigh1": "THI", "thigh2": "THAP", "thigh3": "THAD", "sh1": "TIB", "sh2": "TIAP",
             "sh3": "TIAD", "shoulder": "ASI"}  # fmt: skip
    found = {f"{a}_{name}_study": points[f"{a.upper()}{own}"] for a in "Lr" for name, own in names.items()}
    found |= {f"{a}.{name}_study": points[f"{a.upper()}{name[:-1]}"] for a in "Lr" for name in ("ASIS", "PSIS")}
    return found | {f"{a}HJC_study": points[f"{a}HJC"] for a in "LR"} | {"C7_study": points["LASI"]}


def opensim(points: dict[str, np.ndarray], *, static: bool) -> dict[str, np.ndarray]:
    """The same person with the labels of OpenSim's gait example; knees and ankles have markers in the static trial."""
    names = {"ASIS": "ASI", "Thigh.Upper": "THI", "Thigh.Front": "THAP", "Thigh.Rear": "THAD", "Shank.Upper": "TIB",
             "Shank.Front": "TIAP", "Shank.Rear": "TIAD", "Heel": "HEE", "Midfoot.Sup": "FM1", "Midfoot.Lat": "FM5",
             "Toe.Tip": "TOE"}  # fmt: skip
    if static:
        names |= {"Knee.Lat": "KNE", "Knee.Med": "KNM", "Ankle.Lat": "ANK", "Ankle.Med": "MED"}
    found = {f"{side}.{name}": points[f"{side}{own}"] for side in "LR" for name, own in names.items()}
    return found | {"V.Sacral": (points["LPSI"] + points["RPSI"]) / 2}


def write_measured(
    path: Path, points: dict[str, np.ndarray], measured: dict[str, float] | None = None, *,
    angles: dict[str, np.ndarray] | None = None,
) -> Path:  # fmt: skip
    """Write a C3D with the measurements of the person, or others [mm], in the group PROCESSING, and angles [deg]."""
    write_trial(path, points | {label: 1e-3 * values for label, values in (angles or {}).items()})
    c3d = ezc3d.c3d(str(path))
    if angles:
        c3d.add_parameter("POINT", "ANGLES", list(angles))
    usual = {
        "LKneeWidth": 1e3 * KNEE_WIDTH, "RKneeWidth": 1e3 * KNEE_WIDTH, "LAnkleWidth": 1e3 * ANKLE_WIDTH,
        "RAnkleWidth": 1e3 * ANKLE_WIDTH, "LLegLength": 1e3 * LEG, "RLegLength": 1e3 * LEG,
        "Marker Diameter": 1e3 * DIAMETER,
    }  # fmt: skip
    for name, value in (usual if measured is None else measured).items():
        c3d.add_parameter("PROCESSING", name, [float(value)])
    c3d.write(str(path))
    return path

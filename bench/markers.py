"""Every method on every trial of real skin markers with known bones (Cereatti et al. 2017), by `marey markers` itself.

`python bench/markers.py SHARED OUT` calibrates each trial of SHARED/data/markers/sta from its first frame's true pose,
and again from two postures, that frame and the one farthest from it in knee flexion; nothing else of the truth is used.
It scores what the command leaves with SHARED/score/bones.py and prints a table, and the knee's error against the rigid
fit with one posture.
"""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np

from marey.cli.markers import markers
from marey.cli.markers_settings import MarkersOptions
from marey.cli.progress import Progress
from marey.io.bones import read_bones
from marey.io.npz import write_arrays
from marey.markers.joint_angles import joint_kinematics, joint_of


def references(truth: Path, out: Path) -> list[Path]:
    """Write the calibrations of one and of two postures."""
    bones = read_bones(truth)
    known = np.flatnonzero(bones.motion.answered.all(1))
    flexion = joint_kinematics(bones.motion, [joint_of("thigh", "shank")]).angles[:, 0]
    first = int(known[0])
    far = int(known[np.argmax(np.abs(flexion[known] - flexion[first]))])
    paths = []
    for count, frames in ((1, [first]), (2, [first, far])):
        arrays: dict[str, object] = {"frame": np.array(frames)}
        if bones.side is not None:
            arrays["side"] = bones.side
        for s, name in enumerate(bones.motion.segments):
            arrays[f"{name}_rotation"] = bones.motion.rotation[frames, s]
            arrays[f"{name}_origin"] = 1e3 * bones.motion.origin[frames, s]
        paths.append(out / f"{truth.stem}_{count}.npz")
        write_arrays(paths[-1], arrays)
    return paths


def scored(shared: Path, result: Path, truth: Path) -> dict:
    command = [sys.executable, str(shared / "score" / "bones.py"), str(result), str(truth)]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


def row(name: str, postures: int, method: str, score: dict, against: float | None) -> tuple[str, float]:
    """Write one line of the table, and give the knee's error."""
    knee = score.get("knee_rms_deg", [np.nan] * 3)
    total = float(np.sqrt(np.mean(np.square(knee))))
    thigh, shank = score["thigh"], score["shank"]
    covered = [s["covered_95"] for s in (thigh, shank) if "covered_95" in s]
    cells = [
        name, f"{postures}", method, f"{thigh['turn_rms_deg']:.1f} / {shank['turn_rms_deg']:.1f}",
        f"{thigh['origin_rms_mm']:.1f} / {shank['origin_rms_mm']:.1f}", " ".join(f"{v:.1f}" for v in knee),
        f"{total:.2f}", "" if against is None else f"{100 * (total / against - 1):+.0f} %",
        f"{min(thigh['seen'], shank['seen']):.3f}", f"{np.mean(covered):.2f}" if covered else "",
    ]  # fmt: skip
    return "| " + " | ".join(cells) + " |", total


def main(shared: Path, out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    print(
        "| trial | postures | method | turn deg thigh / shank | origin mm | knee deg | knee | to rigid | seen | held |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    gains: dict[tuple[int, str], list[float]] = {}
    for truth in sorted((shared / "data" / "markers" / "sta").glob("*.npz")):
        rigid = None
        for count, reference in enumerate(references(truth, out), 1):
            folder = out / reference.stem
            options = MarkersOptions(reference=reference, methods=("all",), out=folder)
            markers(truth.with_suffix(".c3d"), options, Progress(quiet=True, stream=(out / "notes.txt").open("a")))
            names = json.loads((folder / "run.json").read_text())["settings"]["methods"]
            files = {m: folder / ("bones.npz" if m == names[0] else f"bones_{m}.npz") for m in names}
            scores = {method: scored(shared, path, truth) for method, path in files.items()}
            if rigid is None:
                rigid = row(truth.stem, count, "rigid", scores["rigid"], None)[1]
            for method, score in scores.items():
                line, total = row(truth.stem, count, method, score, rigid)
                gains.setdefault((count, method), []).append(100 * (total / rigid - 1))
                print(line, flush=True)
    for (count, method), values in gains.items():
        each = ", ".join(f"{v:+.0f}" for v in values)
        print(f"{method}, {count} posture(s): knee {np.mean(values):+.1f} % to the rigid fit with one ({each})")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))

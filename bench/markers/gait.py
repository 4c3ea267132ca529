"""Inverse kinematics of an OpenSim model beside OpenSim's own: joint angles, their optimum, and time a frame.

    python bench/gait.py SHARED [--repeat N]

SHARED holds `data/markers/gait`: a scaled model, two trials, two sets of weights, and the angles that OpenSim 4.6 gives
for one of them. Prints one JSON line a trial and set of weights: the greatest root mean square difference of a joint
angle and of a translation from that file; and, where the package `opensim` is installed, from its inverse kinematics
run here at its own accuracy and at 1e-9, with its time a frame beside ours (process time, the best of N runs, one
thread, files already read; ours with standard deviations, OpenSim's without). `cost` is the weighted sum of squares
of the frames by OpenSim's answer less that by ours, relative: above 0 where ours is the better optimum.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from marey.body.jointed_body import JointedBody
from marey.body.jointed_kinematics import marker_bodies, place
from marey.io.markers import read_markers
from marey.io.mot_sto import read_table
from marey.io.osim_model import read_osim_model
from marey.io.osim_tasks import read_tasks
from marey.markers.inverse_kinematics import InverseKinematics, inverse_kinematics
from marey.markers.tasks import TaskSet
from marey.markers.trajectories import MarkerTrajectories

RUNS = (("walk", "ik_weights"), ("walk", "ik_weights_uniform"), ("static", "ik_weights"))


def quickest(function: Callable[[], object], times: int) -> float:
    """The shortest process time of several runs [s]."""
    spent = []
    for _ in range(times):
        began = time.process_time()
        function()
        spent.append(time.process_time() - began)
    return min(spent)


def difference(found: InverseKinematics, path: Path) -> dict[str, float]:
    """The greatest RMS difference from a MOT: of an angle [degrees], of a translation [mm]; NaN of ours left out."""
    table = read_table(path)
    theirs = table.values[:, [table.columns.index(name) for name in found.coordinate_names]]
    ours = np.where(found.rotational, np.degrees(found.coordinates), 1e3 * found.coordinates)
    apart = ours - np.where(found.rotational, theirs, 1e3 * theirs)
    known = np.isfinite(apart).all(0)
    rms = np.sqrt((apart**2).mean(0))
    return {
        "angle_deg": float(f"{rms[known & found.rotational].max():.2g}"),
        "translation_mm": float(f"{rms[known & ~found.rotational].max():.2g}"),
    }


def cost(model: JointedBody, tasks: TaskSet, trial: MarkerTrajectories, labels: tuple[str, ...], values) -> float:
    """The sum over frames of what both minimise: the weighted mean of squared distances, and the coordinates' tasks."""
    weight = np.array([{t.label: t.weight for t in tasks.markers}[label] for label in labels])
    body, spot = marker_bodies(model, labels)
    seen = trial.select(labels).points
    total = 0.0
    for f, posture in enumerate(values):
        placed = place(model, posture)
        at = (placed.rotation[body] @ spot[..., None])[..., 0] + placed.origin[body]
        here = np.isfinite(seen[f, :, 0])
        total += (weight * ((at - seen[f]) ** 2).sum(-1))[here].sum() / weight[here].sum()
        for task in tasks.coordinates:
            index = model.coordinate(task.coordinate)
            wanted = model.coordinates[index].default if task.value is None else task.value
            total += task.weight * (posture[index] - wanted) ** 2
    return total


def of_opensim(gait: Path, trial: str, weights: str, out: Path, accuracy: float | None) -> Callable[[], None] | None:
    """OpenSim's tool, ready to run; None where the package is not installed."""
    try:
        import opensim
    except ImportError:
        return None
    opensim.Logger.setLevelString("off")
    model = opensim.Model(str(gait / "model_scaled.osim"))
    model.initSystem()
    tool = opensim.InverseKinematicsTool()
    tool.setModel(model)
    tool.set_marker_file(str(gait / f"{trial}.trc"))
    tasks = opensim.IKTaskSet(str(gait / f"{weights}.xml"))
    for i in range(tasks.getSize()):
        tool.upd_IKTaskSet().cloneAndAppend(tasks.get(i))
    markers = opensim.MarkerData(str(gait / f"{trial}.trc"))
    tool.setStartTime(markers.getStartFrameTime())
    tool.setEndTime(markers.getLastFrameTime())
    tool.set_output_motion_file(str(out))
    tool.set_report_errors(False)
    if accuracy is not None:
        tool.set_accuracy(accuracy)
    keep = (model, tool)  # the tool does not keep its model alive
    return lambda: keep[1].run()


def measure(gait: Path, trial: str, weights: str, repeat: int, folder: Path) -> dict[str, object]:
    """One line of the table."""
    model, tasks = read_osim_model(gait / "model_scaled.osim"), read_tasks(gait / f"{weights}.xml")
    markers = read_markers(gait / f"{trial}.trc")
    found = inverse_kinematics(model, tasks, markers)
    row: dict[str, object] = {"trial": trial, "weights": weights, "frames": len(markers)}
    row["ms_a_frame"] = round(
        1e3 * quickest(lambda: inverse_kinematics(model, tasks, markers), repeat) / len(markers), 2
    )
    row["markers"], row["rms_mm"] = len(found.marker_labels), round(1e3 * float(np.nanmean(found.rms)), 2)
    row["not_determined"] = [n for n, d in zip(found.coordinate_names, found.determined.T, strict=True) if not d.any()]
    reference = gait / f"{trial}_reference_ik.mot"
    if reference.exists() and weights == "ik_weights":
        row["from_the_file"] = difference(found, reference)
    for accuracy in (None, 1e-9):
        out = folder / "opensim.mot"
        tool = of_opensim(gait, trial, weights, out, accuracy)
        if tool is None:
            row["opensim"] = "not installed"
            break
        took = quickest(tool, repeat if accuracy is None else 1) / len(markers)
        table = read_table(out)
        theirs = table.values[:, [table.columns.index(name) for name in found.coordinate_names]]
        theirs = np.where(found.rotational, np.radians(theirs), theirs)
        ours = np.where(np.isfinite(found.coordinates), found.coordinates, theirs)
        costs = [cost(model, tasks, markers, found.marker_labels, values) for values in (theirs, ours)]
        name = "opensim" if accuracy is None else f"opensim_at_{accuracy:g}"
        row[name] = {
            **difference(found, out), "ms_a_frame": round(1e3 * took, 2),
            "cost": float(f"{(costs[0] - costs[1]) / costs[1]:.1e}"),
        }  # fmt: skip
    return row


def main() -> None:
    """Print one line for each trial and set of weights."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shared", type=Path)
    parser.add_argument("--repeat", type=int, default=5)
    asked = parser.parse_args()
    gait = asked.shared.resolve() / "data" / "markers" / "gait"
    with threadpool_limits(1), tempfile.TemporaryDirectory() as folder:
        for trial, weights in RUNS:
            print(json.dumps(measure(gait, trial, weights, asked.repeat, Path(folder))), flush=True)


if __name__ == "__main__":
    main()

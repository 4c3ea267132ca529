"""Inverse kinematics of an OpenSim model beside OpenSim's own: joint angles, their optimum, and time per frame.

The angles are compared with those that OpenSim 4.6 gives for one trial (a file of the recordings) and, where the
package `opensim` is installed, with its inverse kinematics run here, at its default accuracy and at 1e-9. Times are
the shortest process time of several runs, on one thread, with files already read; ours with standard deviations,
OpenSim's without.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from bench.declaration import Bench
from bench.recording import Column, Run, Table
from marey.body.articulation.jointed_body import JointedBody
from marey.body.articulation.jointed_kinematics import place
from marey.io.markers.readers import read_markers
from marey.io.opensim.mot_sto import read_table
from marey.io.opensim.osim_model import read_osim_model
from marey.io.opensim.osim_tasks import read_tasks
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.kinematics.inverse_kinematics import InverseKinematics, inverse_kinematics
from marey.markers.kinematics.tasks import TaskSet

BENCH = Bench(
    measures="Inverse kinematics of an OpenSim model, against OpenSim's own.",
    sources=("src/marey/markers", "src/marey/body"),
    minutes=2,
)
RUNS = (("walk", "ik_weights"), ("walk", "ik_weights_uniform"), ("static", "ik_weights"))


def quickest(function: Callable[[], object], times: int) -> float:
    """The shortest process time of several runs [s]."""
    spent = []
    for _ in range(times):
        began = time.process_time()
        function()
        spent.append(time.process_time() - began)
    return min(spent)


def difference(found: InverseKinematics, path: Path) -> tuple[float, float]:
    """The greatest RMS difference from a MOT: of an angle [degrees], of a translation [mm]."""
    table = read_table(path)
    theirs = table.values[:, [table.columns.index(name) for name in found.coordinate_names]]
    ours = np.where(found.rotational, np.degrees(found.coordinates), 1e3 * found.coordinates)
    apart = ours - np.where(found.rotational, theirs, 1e3 * theirs)
    known = np.isfinite(apart).all(0)
    rms = np.sqrt((apart**2).mean(0))
    return float(rms[known & found.rotational].max()), float(rms[known & ~found.rotational].max())


def cost(model: JointedBody, tasks: TaskSet, trial: MarkerTrajectories, labels: tuple[str, ...], values) -> float:
    """The sum over frames of what both minimise: the weighted mean of squared distances, and the coordinates' tasks."""
    weight = np.array([{t.label: t.weight for t in tasks.markers}[label] for label in labels])
    body, spot = model.marker_bodies(labels)
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


def measure(table: Table, gait: Path, trial: str, weights: str, repeat: int, folder: Path) -> None:
    """The rows of one trial and set of weights."""
    model, tasks = read_osim_model(gait / "model_scaled.osim"), read_tasks(gait / f"{weights}.xml")
    markers = read_markers(gait / f"{trial}.trc")
    found = inverse_kinematics(model, tasks, markers)
    own_ms = 1e3 * quickest(lambda: inverse_kinematics(model, tasks, markers), repeat) / len(markers)
    reference = gait / f"{trial}_reference_ik.mot"
    name = f"{trial} ({len(markers)} frames)"
    if reference.exists() and weights == "ik_weights":
        table.row((name, weights, f"`{reference.name}`"), *_short(*difference(found, reference)), own_ms, None, None)
    for accuracy in (None, 1e-9):
        out = folder / "opensim.mot"
        tool = of_opensim(gait, trial, weights, out, accuracy)
        if tool is None:
            table.note = "OpenSim is not installed here."
            return
        theirs_ms = 1e3 * quickest(tool, repeat if accuracy is None else 1) / len(markers)
        stored = read_table(out)
        theirs = stored.values[:, [stored.columns.index(name) for name in found.coordinate_names]]
        theirs = np.where(found.rotational, np.radians(theirs), theirs)
        ours = np.where(np.isfinite(found.coordinates), found.coordinates, theirs)
        costs = [cost(model, tasks, markers, found.marker_labels, values) for values in (theirs, ours)]
        other = "OpenSim" if accuracy is None else f"OpenSim at {accuracy:g}"
        above = f"{(costs[0] - costs[1]) / costs[1]:.0e}"
        table.row((name, weights, other), *_short(*difference(found, out)), own_ms, theirs_ms, above)


def _short(*values: float) -> list[str]:
    return [f"{value:.2g}" for value in values]


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("--repeat", type=int, default=5, help="runs of which the shortest counts")


def run(run: Run) -> None:
    """Solve, and compare."""
    table = run.table(
        "Coordinates beside OpenSim's",
        ("trial", "weights", "beside"),
        Column("greatest difference of an angle", "deg"),
        Column("of a translation", "mm"),
        Column("per frame", "ms", 2),
        Column("OpenSim, per frame", "ms", 1),
        Column("OpenSim's cost above ours, relative"),
    )
    with threadpool_limits(1):
        for trial, weights in RUNS:
            measure(table, run.shared / "data" / "markers" / "gait", trial, weights, run.arguments.repeat, run.out)

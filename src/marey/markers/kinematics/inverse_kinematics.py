"""Inverse kinematics: the postures of a jointed body that follow the markers best, with their uncertainty."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, Mask, freeze_fields
from marey.body.articulation.jointed_body import JointedBody
from marey.body.articulation.jointed_kinematics import marker_bodies
from marey.errors import MareyError
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.kinematics.inverse_kinematics_covariance import Setup, marker_variance, posterior, solve_system
from marey.markers.kinematics.inverse_kinematics_kernels import descend, linearised
from marey.markers.kinematics.tasks import MarkerTask, TaskSet

_STOP = 1e-8  # rad or m
_STEPS = 200
_LOST = 3.0  # times the usual residual: the posture before was no good start
_FITS = 1e-3  # m; a frame that fits as well as this needs no other start
_BETTER = 1 - 1e-6  # of the cost; another start that ends no lower may be the same posture in other angles


@dataclass(frozen=True, eq=False, kw_only=True)
class InverseKinematics:
    """The postures of a jointed body over F frames; NaN where the markers and tasks say nothing."""

    coordinate_names: tuple[str, ...]
    """N names."""
    rotational: Mask
    """(N,) true for angles."""
    coordinates: Floats
    """(F, N) [rad or m]."""
    coordinates_sd: Floats
    """(F, N) [rad or m]; NaN where markers do not determine it, 0 where it is locked."""
    determined: Mask
    """(F, N) true where the markers determine the coordinate: not where a task, a limit or a lock does."""
    marker_labels: tuple[str, ...]
    """M markers that were followed."""
    marker_weights: Floats
    """(M,) as the tasks give them."""
    residuals: Floats
    """(F, M, 3) measured less model [m]; NaN where the marker is missing."""
    bones: BoneMotion
    """The bodies, in the ground of the model."""
    passed_over: tuple[str, ...]
    """Sentences: which markers of trial, model or tasks were not used."""

    def __post_init__(self) -> None:
        freeze_fields(self, "coordinates", "coordinates_sd", "marker_weights", "residuals")
        freeze_fields(self, "rotational", "determined", dtype=bool)

    @property
    def rms(self) -> Floats:
        """(F,) root mean square distance of the markers [m]; NaN in frames without an answer."""
        squares = (self.residuals**2).sum(-1)
        seen = np.isfinite(squares)
        count = seen.sum(1)
        mean = np.where(seen, squares, 0.0).sum(1) / np.maximum(count, 1)
        return np.asarray(np.where(count > 0, np.sqrt(mean), np.nan))


def inverse_kinematics(
    model: JointedBody,
    tasks: TaskSet | None,
    trajectories: MarkerTrajectories,
    *,
    targets: Mapping[str, Floats] | None = None,
) -> InverseKinematics:
    """Follow markers with a jointed body, all segments at once ([Lu1999]), as OpenSim's inverse kinematics does.

    Each frame's posture has the least sum of weighted squared distances of the markers, plus the tasks of coordinates.
    As in OpenSim a coordinate's task is weighed against the markers' weighted mean, locked coordinates stay at their
    defaults, clamped ones stay within their range, coupled ones follow. Markers are used that the trial, the model and
    the tasks have.

    Unlike the paper, and unlike OpenSim, the answer comes with its standard deviations: from the size that each
    marker's residual has over the trial, whatever weight it was given. They know nothing of an error that the residuals
    do not show, such as skin that moves with its whole segment.

    Args:
        model: The body, as `marey.io.opensim.osim_model.read_osim_model` gives it.
        tasks: Weights, as `marey.io.opensim.osim_tasks.read_tasks` gives them; None follows all markers alike.
        trajectories: The trial, in the axes of the model's ground (OpenSim's files: Y up).
        targets: For tasks `from_file`: (F,) of each coordinate [rad or m].

    Returns:
        The postures. A coordinate that nothing fixes is NaN, and so are the bodies that hang on it.

    Raises:
        MareyError: No marker is common to all, a task names no coordinate of the model, or a target is missing.
    """
    setup, passed_over = _set_up(model, tasks, trajectories, targets or {})
    observed = np.ascontiguousarray(trajectories.select(setup.labels).points)
    observed = np.where(np.isfinite(observed).all(-1, keepdims=True), observed, np.nan)
    values = _solve_all(setup, observed)
    return _with_uncertainty(setup, observed, values, passed_over)


def _set_up(
    model: JointedBody, tasks: TaskSet | None, trajectories: MarkerTrajectories, targets: Mapping[str, Floats]
) -> tuple[Setup, tuple[str, ...]]:
    """Bring the tasks, the model's markers and the trial's together."""
    in_model = {m.label for m in model.markers}
    if not in_model:
        raise MareyError(f"The model {model.name!r} has no markers.")
    if tasks is None:
        tasks = TaskSet(markers=tuple(MarkerTask(label=m.label, weight=1.0) for m in model.markers))
    used = [t for t in tasks.markers if t.weight > 0 and t.label in in_model and t.label in trajectories.labels]
    if not used:
        raise MareyError(
            "No marker is common to trial, model and tasks. "
            f"The trial has {_some(trajectories.labels)}; the model {_some(sorted(in_model))}; "
            f"the tasks {_some([t.label for t in tasks.markers])}."
        )
    labels = tuple(t.label for t in used)
    body, place = marker_bodies(model, labels)
    weight, target = _coordinate_tasks(model, tasks, len(trajectories), targets)
    setup = Setup(
        model, labels, body, place, np.array([t.weight for t in used]), weight, target,
        np.array([c.lower for c in model.coordinates]), np.array([c.upper for c in model.coordinates]),
    )  # fmt: skip
    return setup, _passed_over(tasks, in_model, trajectories.labels)


def _some(names: list[str] | tuple[str, ...]) -> str:
    return ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "") if names else "none"


def _passed_over(tasks: TaskSet, in_model: set[str], in_trial: tuple[str, ...]) -> tuple[str, ...]:
    """Say which markers are not used, and why."""
    asked = [t.label for t in tasks.markers]
    reasons = (
        ("tasks name markers that the model has not", [n for n in asked if n not in in_model]),
        ("markers of the model are not in the trial", [n for n in asked if n in in_model and n not in in_trial]),
        ("markers of the trial are not in the model", [n for n in in_trial if n not in in_model]),
        ("markers have no task", sorted(n for n in in_model if n in in_trial and n not in asked)),
        ("markers have the weight 0", [t.label for t in tasks.markers if t.weight == 0]),
    )
    return tuple(f"{len(names)} {reason}: {', '.join(names)}" for reason, names in reasons if names)


def _coordinate_tasks(
    model: JointedBody, tasks: TaskSet, frames: int, targets: Mapping[str, Floats]
) -> tuple[Floats, Floats]:
    """Give weight (N,) and value (F, N) of the coordinates' tasks."""
    weight, target = np.zeros(len(model.coordinates)), np.zeros((frames, len(model.coordinates)))
    for task in tasks.coordinates:
        index = model.coordinate(task.coordinate)
        weight[index] = task.weight
        if not task.from_file:
            target[:, index] = model.coordinates[index].default if task.value is None else task.value
            continue
        given = np.asarray(targets.get(task.coordinate, np.zeros(0)), float)
        if given.shape != (frames,) or not np.isfinite(given).all():
            raise MareyError(
                f"The task of {task.coordinate!r} takes its values from a file, and there is no number for each of the "
                f"{frames} frames."
            )
        target[:, index] = given
    return weight, target


def _solve_all(setup: Setup, observed: Floats) -> Floats:
    """Find the posture (F, N) of every frame, each from the one before it; NaN where no marker is seen."""
    model = setup.model
    values = np.full((len(observed), len(model.coordinates)), np.nan)
    near, lost = model.defaults, True
    usual: list[float] = []
    for f, points in enumerate(observed):
        weight = setup.weight[np.isfinite(points[:, 0])].sum()
        if weight == 0:
            lost = True
            continue
        near, cost = _descend(setup, points, setup.target[f], near)
        limit = max(_FITS, _LOST * float(np.median(usual[-50:]))) if usual else 0.0
        if (lost and cost / weight > _FITS**2) or cost / weight > limit**2:
            fresh, fresh_cost = _search(setup, points, setup.target[f])
            if fresh_cost < _BETTER * cost:
                near, cost = fresh, fresh_cost
        usual.append(float(np.sqrt(cost / weight)))
        values[f], lost = near, False
    return values


def _descend(
    setup: Setup, points: Floats, target: Floats, start: Floats, free: Mask | None = None, most: int = _STEPS
) -> tuple[Floats, float]:
    values = np.array(start)
    cost, _ = descend(
        setup.model.packed, (setup.body, setup.place, setup.weight, points), (setup.task_weight, target),
        setup.model.free if free is None else free, setup.lower, setup.upper, values, most, _STOP,
    )  # fmt: skip
    return values, cost


def _search(setup: Setup, points: Floats, target: Floats) -> tuple[Floats, float]:
    """Look for the posture without one to begin with: the whole body is turned every way first.

    The joints on the ground turn by quarters; the two starts of least cost go on with all coordinates. Of postures that
    are one and the same, written in different angles, the one nearest to the model's default is taken.
    """
    model = setup.model
    based = [(m.coordinate, m.turns) for b in model.bodies if b.parent is None for m in b.motions]
    moving = model.free & np.array([any(name == c for c, _ in based) for name in model.coordinate_names], bool)
    turns = np.array([(name, True) in based for name in model.coordinate_names], bool)
    turning = np.flatnonzero(moving & turns)[:3]
    starts = []
    for quarters in np.ndindex(*[4] * len(turning)):
        start = np.array(model.defaults)
        start[turning] += (np.array(quarters, float) + 1) % 4 * np.pi / 2 - np.pi / 2
        found, cost = _descend(setup, points, target, start, moving, 20)
        starts.append((_unwound(setup, found, turning), cost))
    ends = [_descend(setup, points, target, start) for start, _ in _best_first(setup, starts, turning)[:2]]
    return _best_first(setup, ends, turning)[0]


def _unwound(setup: Setup, values: Floats, turning: Integers) -> Floats:
    """Take whole turns out of the coordinates that turn a body by as much as themselves."""
    model = setup.model
    plain = {
        m.coordinate
        for b in model.bodies for m in b.motions
        if m.turns and m.function.coefficients.shape == (1, 2) and abs(m.function.coefficients[0, 1]) == 1
    } - {m.coordinate for b in model.bodies for m in b.motions if not m.turns}  # fmt: skip
    values, defaults = np.array(values), model.defaults
    for c in turning:
        if model.coordinate_names[c] in plain and np.isinf(setup.lower[c]) and np.isinf(setup.upper[c]):
            values[c] -= 2 * np.pi * np.round((values[c] - defaults[c]) / (2 * np.pi))
    return values


def _best_first(setup: Setup, found: list[tuple[Floats, float]], turning: Integers) -> list[tuple[Floats, float]]:
    """Order postures by cost; those as good as the best by their distance from the default."""
    least = min(cost for _, cost in found)
    same = least * (1 + 1e-6) + 1e-12 * setup.weight.sum()

    def rank(pair: tuple[Floats, float]) -> tuple[float, float]:
        away = float(np.abs(pair[0] - setup.model.defaults)[turning].sum())
        return max(pair[1], same), away

    return sorted(found, key=rank)


def _with_uncertainty(
    setup: Setup, observed: Floats, values: Floats, passed_over: tuple[str, ...]
) -> InverseKinematics:
    """Add residuals, the bodies, and what the markers determine of each posture."""
    model = setup.model
    frames, bodies, count = len(observed), len(model.bodies), len(model.coordinates)
    residuals, leverage = np.full(observed.shape, np.nan), np.zeros(observed.shape[:2])
    rotation, origin = np.full((frames, bodies, 3, 3), np.nan), np.full((frames, bodies, 3), np.nan)
    covariance = np.full((frames, bodies, 6, 6), np.nan)
    sd, determined = np.full((frames, count), np.nan), np.zeros((frames, count), bool)
    coordinates = np.array(values)
    answered = np.flatnonzero(np.isfinite(values).all(1))
    systems = {}
    for f in answered:
        posed, jacobian, rotation[f], origin[f], _ = linearised(model.packed, setup.body, setup.place, values[f])
        residuals[f] = observed[f] - posed
        systems[f] = solve_system(setup, observed[f], values[f], jacobian)
        leverage[f] = systems[f].leverage
    variance = marker_variance(setup.weight, residuals, leverage)
    for f in answered:
        _, jacobian, _, _, moved = linearised(model.packed, setup.body, setup.place, values[f])
        known = posterior(setup, systems[f], variance, jacobian, moved, values[f])
        coordinates[f, known.open] = np.nan
        sd[f], determined[f], covariance[f] = known.sd, known.determined, known.bodies
        rotation[f, known.lost], origin[f, known.lost] = np.nan, np.nan
    bones = BoneMotion(segments=model.body_names, rotation=rotation, origin=origin, covariance=covariance)
    return InverseKinematics(
        coordinate_names=model.coordinate_names, rotational=model.rotational, coordinates=coordinates,
        coordinates_sd=sd, determined=determined, marker_labels=setup.labels, marker_weights=setup.weight,
        residuals=residuals, bones=bones, passed_over=passed_over,
    )  # fmt: skip

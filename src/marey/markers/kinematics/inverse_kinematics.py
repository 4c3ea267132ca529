"""Inverse kinematics: the postures of a jointed body that best fit the markers, with their uncertainty."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Integers, Mask, freeze_fields
from marey.body.articulation.jointed_body import JointedBody
from marey.body.articulation.jointed_kinematics import marker_bodies
from marey.errors import MareyError
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.kinematics.inverse_kinematics_covariance import (
    INVERSE_KINEMATICS_DEFAULTS,
    InverseKinematicsSettings,
    InverseKinematicsSetup,
    marker_variance,
    posterior,
    solve_system,
)
from marey.markers.kinematics.inverse_kinematics_kernels import descend, linearised
from marey.markers.kinematics.tasks import MarkerTask, TaskSet
from marey.wording import listed

_MOST_LISTED = 8
"""Number of markers of each source that an error message lists. Chosen by hand."""
_STEP_TOLERANCE = 1e-8
"""A shorter step ends the iteration [rad or m]; numerical."""
_MINIMUM_COST_RATIO = 1 - 1e-6
"""A search replaces the posture only if its cost is below this ratio; equal cost may be the same posture in other
angles."""


@dataclass(frozen=True, eq=False, kw_only=True)
class InverseKinematics:
    """The postures of a jointed body over F frames; NaN where markers and tasks do not determine them."""

    coordinate_names: tuple[str, ...]
    """N names."""
    rotational: Mask
    """(N,) True for angles."""
    coordinates: Floats
    """(F, N) coordinates [rad or m]."""
    coordinates_sd: Floats
    """(F, N) standard deviations [rad or m]; NaN where the markers do not determine a coordinate, 0 if it is locked."""
    determined: Mask
    """(F, N) True where the markers determine the coordinate, rather than a task, a limit or a lock."""
    marker_labels: tuple[str, ...]
    """Labels of the M markers used."""
    marker_weights: Floats
    """(M,) weights from the tasks."""
    residuals: Floats
    """(F, M, 3) measured minus modelled position [m]; NaN where the marker is missing."""
    bones: BoneMotion
    """The bodies, in the ground frame of the model."""
    skipped: tuple[str, ...]
    """Markers of trial, model or tasks that were not used, one sentence per reason."""

    def __post_init__(self) -> None:
        freeze_fields(self, "coordinates", "coordinates_sd", "marker_weights", "residuals")
        freeze_fields(self, "rotational", "determined", dtype=bool)

    @property
    def rms(self) -> Floats:
        """(F,) root mean square distance of the markers [m]; NaN in frames without an estimate."""
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
    settings: InverseKinematicsSettings = INVERSE_KINEMATICS_DEFAULTS,
) -> InverseKinematics:
    """Fit a jointed body to markers, all segments at once ([Lu1999]), as OpenSim's inverse kinematics does.

    Each frame's posture minimises the weighted sum of squared distances of the markers, plus the coordinate tasks. As
    in OpenSim, a coordinate task is weighted relative to the markers' weighted mean, locked coordinates keep their
    defaults, clamped ones stay within their range, and coupled ones are dependent. Only markers contained in the trial,
    the model and the tasks are used.

    Unlike the paper and OpenSim, the result has standard deviations, derived from the size of each marker's residuals
    over the trial, regardless of its weight. They do not include errors that the residuals do not show, such as skin
    motion common to a whole segment.

    Args:
        model: The body, from `marey.io.opensim.osim_model.read_osim_model`.
        tasks: Weights, from `marey.io.opensim.osim_tasks.read_tasks`; None uses all markers with equal weights.
        trajectories: The trial, in the axes of the model's ground (OpenSim's files: Y up).
        targets: For tasks `from_file`: values (F,) of each coordinate [rad or m].
        settings: Numbers of steps, and when a frame is searched anew or undetermined.

    Returns:
        The postures. An undetermined coordinate is NaN, and so are the bodies that depend on it.

    Raises:
        MareyError: No marker is common to all, a task refers to an unknown coordinate, or a target is missing.
    """
    setup, skipped = _set_up(model, tasks, trajectories, targets or {}, settings)
    observed = np.ascontiguousarray(trajectories.select(setup.labels).points)
    observed = np.where(np.isfinite(observed).all(-1, keepdims=True), observed, np.nan)
    values = _solve_all(setup, observed)
    return _with_uncertainty(setup, observed, values, skipped)


def _set_up(
    model: JointedBody,
    tasks: TaskSet | None,
    trajectories: MarkerTrajectories,
    targets: Mapping[str, Floats],
    settings: InverseKinematicsSettings,
) -> tuple[InverseKinematicsSetup, tuple[str, ...]]:
    """Match the markers of tasks, model and trial."""
    in_model = {m.label for m in model.markers}
    if not in_model:
        raise MareyError(f"The model {model.name!r} has no markers.")
    if tasks is None:
        tasks = TaskSet(markers=tuple(MarkerTask(label=m.label, weight=1.0) for m in model.markers))
    used = [t for t in tasks.markers if t.weight > 0 and t.label in in_model and t.label in trajectories.labels]
    if not used:
        raise MareyError(
            "No marker is common to trial, model and tasks. "
            f"The trial has {listed(trajectories.labels, most=_MOST_LISTED)}; "
            f"the model {listed(sorted(in_model), most=_MOST_LISTED)}; "
            f"the tasks {listed((t.label for t in tasks.markers), most=_MOST_LISTED)}."
        )
    labels = tuple(t.label for t in used)
    body, place = marker_bodies(model, labels)
    weight, target = _coordinate_tasks(model, tasks, len(trajectories), targets)
    setup = InverseKinematicsSetup(
        model, labels, body, place, np.array([t.weight for t in used]), weight, target,
        np.array([c.lower for c in model.coordinates]), np.array([c.upper for c in model.coordinates]),
        settings,
    )  # fmt: skip
    return setup, _unused_markers(tasks, in_model, trajectories.labels)


def _unused_markers(tasks: TaskSet, in_model: set[str], in_trial: tuple[str, ...]) -> tuple[str, ...]:
    """Report the markers that are not used, and why."""
    in_tasks = [t.label for t in tasks.markers]
    reasons = (
        ("markers of the tasks are missing from the model", [n for n in in_tasks if n not in in_model]),
        (
            "markers of the model are missing from the trial",
            [n for n in in_tasks if n in in_model and n not in in_trial],
        ),
        ("markers of the trial are missing from the model", [n for n in in_trial if n not in in_model]),
        ("markers have no task", sorted(n for n in in_model if n in in_trial and n not in in_tasks)),
        ("markers have the weight 0", [t.label for t in tasks.markers if t.weight == 0]),
    )
    return tuple(f"{len(names)} {reason}: {', '.join(names)}" for reason, names in reasons if names)


def _coordinate_tasks(
    model: JointedBody, tasks: TaskSet, frames: int, targets: Mapping[str, Floats]
) -> tuple[Floats, Floats]:
    """Return the weights (N,) and target values (F, N) of the coordinate tasks."""
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
                f"The task of {task.coordinate!r} takes its values from a file, which must contain one number for each "
                f"of the {frames} frames."
            )
        target[:, index] = given
    return weight, target


def _solve_all(setup: InverseKinematicsSetup, observed: Floats) -> Floats:
    """Estimate the posture (F, N) of every frame, starting from the previous one; NaN where no marker is visible."""
    model, settings = setup.model, setup.settings
    values = np.full((len(observed), len(model.coordinates)), np.nan)
    near, lost = model.defaults, True
    usual: list[float] = []
    for f, points in enumerate(observed):
        weight = setup.weight[np.isfinite(points[:, 0])].sum()
        if weight == 0:
            lost = True
            continue
        near, cost = _descend_from(setup, points, setup.target[f], near)
        recent = usual[-settings.recent_frames :]
        limit = max(settings.good_rms_m, settings.restart_ratio * float(np.median(recent))) if usual else 0.0
        if (lost and cost / weight > settings.good_rms_m**2) or cost / weight > limit**2:
            fresh, fresh_cost = _search(setup, points, setup.target[f])
            if fresh_cost < _MINIMUM_COST_RATIO * cost:
                near, cost = fresh, fresh_cost
        usual.append(float(np.sqrt(cost / weight)))
        values[f], lost = near, False
    return values


def _descend_from(
    setup: InverseKinematicsSetup,
    points: Floats,
    target: Floats,
    start: Floats,
    free: Mask | None = None,
    most: int | None = None,
) -> tuple[Floats, float]:
    values = np.array(start)
    most = setup.settings.most_steps if most is None else most
    cost, _ = descend(
        setup.model.packed, (setup.body, setup.place, setup.weight, points), (setup.task_weight, target),
        setup.model.free if free is None else free, setup.lower, setup.upper, values, most, _STEP_TOLERANCE,
    )  # fmt: skip
    return values, cost


def _search(setup: InverseKinematicsSetup, points: Floats, target: Floats) -> tuple[Floats, float]:
    """Search for the posture without an initial one, from all orientations of the whole body.

    The joints to the ground are rotated by quarter turns; the two results of smallest cost are refined with all
    coordinates. Of identical postures expressed in different angles, the one closest to the model's default is used.
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
        found, cost = _descend_from(setup, points, target, start, moving, setup.settings.search_steps)
        starts.append((_unwound(setup, found, turning), cost))
    ends = [_descend_from(setup, points, target, start) for start, _ in _best_first(setup, starts, turning)[:2]]
    return _best_first(setup, ends, turning)[0]


def _unwound(setup: InverseKinematicsSetup, values: Floats, turning: Integers) -> Floats:
    """Remove full rotations from the coordinates that are themselves rotation angles of a body."""
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


def _best_first(
    setup: InverseKinematicsSetup, found: list[tuple[Floats, float]], turning: Integers
) -> list[tuple[Floats, float]]:
    """Sort postures by cost; those equal to the best by their distance from the default."""
    least = min(cost for _, cost in found)
    same = least * (1 + 1e-6) + 1e-12 * setup.weight.sum()

    def rank(pair: tuple[Floats, float]) -> tuple[float, float]:
        away = float(np.abs(pair[0] - setup.model.defaults)[turning].sum())
        return max(pair[1], same), away

    return sorted(found, key=rank)


def _with_uncertainty(
    setup: InverseKinematicsSetup, observed: Floats, values: Floats, skipped: tuple[str, ...]
) -> InverseKinematics:
    """Add residuals, bodies, and the uncertainty of each posture."""
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
        coordinates[f, known.undetermined] = np.nan
        sd[f], determined[f], covariance[f] = known.sd, known.determined, known.bodies
        rotation[f, known.lost], origin[f, known.lost] = np.nan, np.nan
    bones = BoneMotion(segments=model.body_names, rotation=rotation, origin=origin, covariance=covariance)
    return InverseKinematics(
        coordinate_names=model.coordinate_names, rotational=model.rotational, coordinates=coordinates,
        coordinates_sd=sd, determined=determined, marker_labels=setup.labels, marker_weights=setup.weight,
        residuals=residuals, bones=bones, skipped=skipped,
    )  # fmt: skip

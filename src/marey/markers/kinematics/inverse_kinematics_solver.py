"""Solver of inverse kinematics: the posture of each frame from the previous one, or by a search."""

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.markers.kinematics.inverse_kinematics_kernels import descend
from marey.markers.kinematics.inverse_kinematics_setup import InverseKinematicsSetup

_STEP_TOLERANCE = 1e-8
"""A shorter step ends the iteration [rad or m]; numerical."""
_MINIMUM_COST_RATIO = 1 - 1e-6
"""A search replaces the posture only if its cost is below this ratio; equal cost may be the same posture in other
angles."""


def solve_all(setup: InverseKinematicsSetup, observed: Floats) -> Floats:
    """Estimate the posture of every frame, starting from the previous one.

    Args:
        setup: The body, its markers and their weights.
        observed: (F, M, 3) the markers [m]; NaN where missing.

    Returns:
        (F, N) coordinates [rad or m]; NaN in frames without a visible marker.
    """
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

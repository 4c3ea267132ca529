"""A leg of made-up sizes with every kind of thing that a model may have: splines, couplings, locks and limits."""

import numpy as np

from marey.body.articulation.coordinate_functions import linear, polynomial, scaled, simm_spline
from marey.body.articulation.jointed_body import (
    Coupling,
    JointedBody,
    JointTwist,
    ModelBody,
    ModelCoordinate,
    ModelMarker,
)
from marey.geometry.rigid import RigidTransform

X, Y, Z = np.eye(3)


def _turn(coordinate, axis, function=None):
    return JointTwist(turns=True, axis=axis, coordinate=coordinate, function=function or linear(1.0))


def _shift(coordinate, axis, function=None):
    return JointTwist(turns=False, axis=axis, coordinate=coordinate, function=function or linear(1.0))


def leg(*, without=(), locked=("foot_angle",), ankle_limit=np.inf):
    """Pelvis, thigh, shank whose knee rolls by splines, a patella that follows, foot."""
    bent = [-2.0, -1.2, -0.6, 0.0, 0.2]
    rolls = simm_spline(bent, [-0.03, -0.01, 0.004, 0.0, -0.002])
    glides = scaled(simm_spline(bent, [-0.42, -0.41, -0.405, -0.4, -0.398]), 1.05)
    skewed = np.array([0.1, -0.2, 1.0]) / np.linalg.norm([0.1, -0.2, 1.0])
    bodies = (
        ModelBody(
            name="pelvis", parent=None, joint="ground_pelvis",
            motions=(
                _shift("tx", X), _shift("ty", Y), _shift("tz", Z),
                _turn("tilt", Z), _turn("list", X), _turn("turn", Y),
            ),
        ),
        ModelBody(
            name="thigh", parent="pelvis", joint="hip",
            before=RigidTransform.from_vector(np.array([0.1, 0.2, -0.1]), np.array([-0.07, -0.07, 0.09])),
            motions=(_turn("flexion", Z), _turn("adduction", X), _turn("rotation", Y)),
            after=RigidTransform.from_vector(np.array([0.0, 0.1, 0.0]), np.array([0.01, 0.0, 0.0])),
        ),
        ModelBody(
            name="shank", parent="thigh", joint="knee",
            motions=(_shift("knee", X, rolls), _shift("knee", Y, glides), _turn("knee", skewed)),
        ),
        ModelBody(
            name="patella", parent="thigh", joint="patella",
            motions=(_shift(None, X, polynomial([0.05])), _turn("patella", Z), _shift("patella", Y, linear(0.1, -0.4))),
        ),
        ModelBody(
            name="foot", parent="shank", joint="ankle",
            before=RigidTransform(np.eye(3), np.array([0.0, -0.4, 0.0])),
            motions=(_turn("ankle", Z), _turn("foot_angle", X)),
        ),
    )  # fmt: skip
    names = [*("tx", "ty", "tz", "tilt", "list", "turn"), *("flexion", "adduction", "rotation", "knee"), "patella"]
    defaults = {"ty": 0.9, "foot_angle": 0.15}
    coordinates = [
        ModelCoordinate(
            name=name, rotational=name not in ("tx", "ty", "tz"), default=defaults.get(name, 0.0),
            locked=name in locked, upper=ankle_limit if name == "ankle" else np.inf,
        )
        for name in [*names, "ankle", "foot_angle"]
    ]  # fmt: skip
    rng = np.random.default_rng(7)
    markers = [
        ModelMarker(label=f"{body.name}_{i}", body=body.name, place=rng.normal(scale=0.08, size=3))
        for body in bodies if body.name not in without for i in range(4)
    ]  # fmt: skip
    return JointedBody(
        name="leg", bodies=bodies, coordinates=tuple(coordinates), markers=tuple(markers),
        couplings=(
            Coupling(dependent="patella", independent="knee", function=simm_spline(bent, [1.5, 1.0, 0.5, 0.0, -0.1])),
        ),
    )  # fmt: skip


def walking(body, frames=30):
    """Give postures (F, N) of a smooth motion, couplings kept."""
    phase = np.linspace(0, 2 * np.pi, frames, endpoint=False)[:, None]
    rng = np.random.default_rng(8)
    swing = np.where(body.rotational, 0.25, 0.05) * rng.uniform(0.5, 1.0, len(body.coordinates))
    values = body.defaults + swing * np.sin(phase + rng.uniform(0, 6, len(body.coordinates)))
    values[:, body.coordinate("knee")] = -0.5 + 0.5 * np.sin(phase[:, 0])
    locked = [c.locked for c in body.coordinates]
    values[:, locked] = body.defaults[locked]
    return body.coupled(values)

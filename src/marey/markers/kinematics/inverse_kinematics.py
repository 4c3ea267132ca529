"""Inverse kinematics: the postures of a jointed body that best fit the markers, with their uncertainty."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.body.articulation.jointed_body import JointedBody
from marey.body.articulation.jointed_kinematics import linearised
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.kinematics.inverse_kinematics_covariance import marker_variance, posterior, solve_system
from marey.markers.kinematics.inverse_kinematics_setup import (
    INVERSE_KINEMATICS_DEFAULTS,
    InverseKinematicsSettings,
    InverseKinematicsSetup,
    set_up,
)
from marey.markers.kinematics.inverse_kinematics_solver import solve_all
from marey.markers.kinematics.tasks import TaskSet


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
    setup, skipped = set_up(model, tasks, trajectories.labels, len(trajectories), targets or {}, settings)
    observed = np.ascontiguousarray(trajectories.select(setup.labels).points)
    observed = np.where(np.isfinite(observed).all(-1, keepdims=True), observed, np.nan)
    values = solve_all(setup, observed)
    return _with_uncertainty(setup, observed, values, skipped)


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
        linear = linearised(model.packed, setup.body, setup.place, values[f])
        posed, jacobian, rotation[f], origin[f], _, slopes = linear
        residuals[f] = observed[f] - posed
        systems[f] = solve_system(setup, observed[f], values[f], jacobian, slopes)
        leverage[f] = systems[f].leverage
    variance = marker_variance(setup.weight, residuals, leverage)
    for f in answered:
        # The derivatives of all frames together would need too much memory: they are computed again.
        _, jacobian, _, _, moved, slopes = linearised(model.packed, setup.body, setup.place, values[f])
        known = posterior(setup, systems[f], variance, jacobian, moved, slopes)
        coordinates[f, known.undetermined] = np.nan
        sd[f], determined[f], covariance[f] = known.sd, known.determined, known.bodies
        rotation[f, known.lost], origin[f, known.lost] = np.nan, np.nan
    bones = BoneMotion(segments=model.body_names, rotation=rotation, origin=origin, covariance=covariance)
    return InverseKinematics(
        coordinate_names=model.coordinate_names, rotational=model.rotational, coordinates=coordinates,
        coordinates_sd=sd, determined=determined, marker_labels=setup.labels, marker_weights=setup.weight,
        residuals=residuals, bones=bones, skipped=skipped,
    )  # fmt: skip

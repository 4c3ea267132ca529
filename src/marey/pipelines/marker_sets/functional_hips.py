"""Centres of hips from functional trials of a person who wears a known marker set."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem, MareyError
from marey.io.markers.trial_file import MarkerFile
from marey.markers.data.clusters import MINIMUM_MARKERS
from marey.markers.data.marker_set_tables import plain_label
from marey.markers.data.marker_sets import RecognisedSet, labels_by_person
from marey.markers.data.rigid_fit import in_cluster_frame
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.preprocessing.functional import FunctionalCentre, score, sphere_centre, transfer_point
from marey.wording import listed

_SIDES = ("left", "right")
"""Names of the body's sides."""
_MM = 1e3
"""Millimetres in a metre."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FunctionalHips:
    """Centres of hips in a posture."""

    places: Mapping[str, Floats]
    """Maps `left_HJC`, `right_HJC` to places (3,) in the laboratory of the posture [m]."""
    notes: tuple[str, ...]
    """How they were found, one sentence each."""


def functional_hips(
    trials: Sequence[MarkerFile], recognised: RecognisedSet, posture: MarkerTrajectories
) -> FunctionalHips:
    """Estimate the centre of the hip that moves in each functional trial, and transfer it by the pelvis.

    With three markers on the thigh it is the symmetrical centre of rotation ([Ehrig2006]), with fewer the centre of the
    spheres on which they move ([Gamage2002]).

    Args:
        trials: Trials in which one hip was moved in all directions.
        recognised: The marker set.
        posture: The markers of the pelvis in the frames of the posture.

    Raises:
        FileProblem: A trial does not show the pelvis and a thigh, or does not determine the centre.
    """
    places, notes = {}, []
    for trial in trials:
        side, thigh, found, pelvis = _of_trial(trial, recognised)
        known = labels_by_person(posture.labels).get(recognised.person, {})
        shared = [name for name in pelvis if name in known]
        shape = found.parent_shape[[list(pelvis).index(name) for name in shared]]
        moved = transfer_point(shape, found.in_parent, posture.select([known[name] for name in shared]).points)
        seen = moved[np.isfinite(moved).all(1)]
        if not len(seen):
            raise FileProblem(trial.path, "shares fewer than three markers of the pelvis with the static trial")
        places[f"{side}_HJC"] = seen.mean(0)
        sd, kind = _MM * float(np.sqrt(np.diag(found.covariance).max())), "rotates" if thigh else "moves on spheres"
        notes.append(
            f"The {side} hip centre is the one about which the thigh {kind} in {trial.path.name}: standard deviation "
            f"{sd:.1f} mm, RMS of the residuals {_MM * found.residual:.1f} mm."
        )
    return FunctionalHips(places=places, notes=tuple(notes))


def _of_trial(
    trial: MarkerFile, recognised: RecognisedSet
) -> tuple[str, bool, FunctionalCentre, Mapping[str, str]]:  # fmt: skip
    """Return the side that moves most, whether its thigh is rigid, the centre, and the labels of the pelvis."""
    points = trial.trajectories
    labels = labels_by_person(points.labels).get(recognised.person, {})
    pelvis = dict(_seen(points, labels, recognised.marker_set.segments.get("pelvis", ())))
    thighs = {
        side: dict(_seen(points, labels, recognised.marker_set.segments.get(f"{side}_thigh", ()))) for side in _SIDES
    }
    thighs = {side: own for side, own in thighs.items() if own}
    if len(pelvis) < MINIMUM_MARKERS or not thighs:
        wanted = [name for key in ("pelvis", "left_thigh") for name in recognised.marker_set.segments.get(key, ())]
        wrong = f"lacks markers of the pelvis or of a thigh ({listed(wanted)})"
        raise FileProblem(trial.path, wrong, "Give a trial in which a hip is moved, with the markers of the set.")
    parent = points.select(list(pelvis.values())).points
    side = max(thighs, key=lambda each: _spread(parent, points.select(list(thighs[each].values())).points))
    child = points.select(list(thighs[side].values())).points
    rigid = len(thighs[side]) >= MINIMUM_MARKERS
    try:
        return side, rigid, score(parent, child) if rigid else sphere_centre(parent, child), pelvis
    except MareyError as problem:
        wrong = f"does not determine the centre of the {side} hip ({str(problem).rstrip('.')})"
        raise FileProblem(trial.path, wrong) from None


def _seen(points: MarkerTrajectories, labels: Mapping[str, str], names: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield the plain labels of a segment that are ever visible, each with the label in the trial."""
    for name in dict.fromkeys(map(plain_label, names)):
        if name in labels and points.present[:, points.labels.index(labels[name])].any():
            yield name, labels[name]


def _spread(parent: Floats, child: Floats) -> float:
    """Return how far the markers (F, N, 3) of a thigh move relative to the pelvis [m]."""
    _, rotation, translation = in_cluster_frame(parent)
    local = np.einsum("fji,fnj->fni", rotation, child - translation[:, None])
    known = local[np.isfinite(local).all((1, 2))]
    return float(known.std(0).sum()) if len(known) else 0.0

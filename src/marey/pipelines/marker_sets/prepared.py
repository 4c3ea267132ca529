"""From the labels of a known marker set to segments and a posture with landmarks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from marey.arrays import Floats, Integers
from marey.errors import FileProblem, MareyError
from marey.io.markers.trial_file import MarkerFile
from marey.markers.data.labels import MOST_LABELS, FoundClusters
from marey.markers.data.marker_set_tables import MarkerSet, plain_label
from marey.markers.data.marker_sets import RecognisedSet, labels_by_person
from marey.markers.data.person import PersonMeasurements
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.preprocessing.set_landmarks import (
    PELVIS_LANDMARKS,
    CentredTrial,
    landmarks_of_set,
    with_joint_centres,
)
from marey.markers.preprocessing.standing import (
    LEAST_STANDING_S,
    LegLabels,
    knee_bend_deg,
    most_upright_frame,
    standing_frames,
)
from marey.pipelines.marker_sets.functional_hips import functional_hips
from marey.pipelines.marker_sets.posture import LandmarkPosture
from marey.pipelines.verdict import VerdictReason
from marey.wording import listed

_SIDES = (("left", "LASIS"), ("right", "RASIS"))
"""Names of the body's sides, each with the anterior spine of its side."""
_REMEDY = (
    "Name the markers of the segments in a TOML (--clusters), or give a trial that has them; "
    "docs/reference/marker-input.md lists the markers of each set."
)
"""What to do about markers that a set needs."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PreparedSet:
    """A trial with a known marker set, ready for its calibration."""

    name: str
    """Name of the marker set."""
    file: MarkerFile
    """The trial, with the joint centres that its segments need."""
    found: FoundClusters
    """The segments."""
    posture: LandmarkPosture
    """The posture in which the landmarks are known."""
    reasons: tuple[VerdictReason, ...]
    """What limits the calibration."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Chosen:
    """The frames of a file from which the landmarks are taken."""

    file: MarkerFile
    labels: dict[str, str]
    """Labels of the person by their plain names."""
    frames: Integers
    standing: bool
    notes: tuple[str, ...] = ()
    reasons: tuple[VerdictReason, ...] = ()


def prepare_marker_set(
    file: MarkerFile, recognised: RecognisedSet, person: PersonMeasurements, *, static: MarkerFile | None,
    functional: Sequence[MarkerFile] = (),
) -> PreparedSet:  # fmt: skip
    """Find segments, landmarks and joint centres by the labels of a marker set.

    The landmarks are those of the static trial, or of a part of the trial itself in which the person stands still, or
    of its most upright frame.

    Args:
        file: The trial.
        recognised: The marker set.
        person: Measurements that the user gives; those in the files complete them.
        static: A trial of the person standing; None if there is none.
        functional: Trials in which a hip was moved; its centre replaces the predicted one.

    Raises:
        FileProblem: Essential markers or measurements are missing, or nobody stands in the static trial.
    """
    known = recognised.marker_set
    labels = labels_by_person(file.trajectories.labels).get(recognised.person, {})
    person = person.completed_by(file.person)
    if static is None:
        chosen = _of_trial(_Source(file, labels, known))
    else:
        person = person.completed_by(static.person)
        own = labels_by_person(static.trajectories.labels).get(recognised.person, {})
        chosen = _of_static(_Source(static, own, known))
    at = _means(chosen.file.trajectories, chosen.frames)
    seen = {name: at[label] for name, label in chosen.labels.items() if label in at}
    up = np.eye(3)[1 if chosen.file.y_up else 2]
    hips = functional_hips(functional, recognised, _in_frames(chosen))
    landmarks_for = partial(landmarks_of_set, known, seen, up=up, standing=chosen.standing, centres=hips.places)
    try:
        landmarks = landmarks_for(person)
        full = person.with_assumed(landmarks.assumed)
        larger = (full.with_value(one.name, one.value_m + one.sd_m) for one in landmarks.assumed)
        shifted = [landmarks_for(other).places for other in larger]
    except MareyError as problem:
        wrong = f"does not give the joints of the marker set {known.name}: {problem}".rstrip(".")
        raise FileProblem(chosen.file.path, wrong, _REMEDY) from None
    followed = {
        segment: tuple(labels[plain] for name in names if (plain := plain_label(name)) in labels)
        for segment, names in known.segments.items()
    }
    standing = {labels[name]: place for name, place in seen.items() if name in labels}
    centred = with_joint_centres(file.trajectories, followed, standing, landmarks.places)
    _require_segments(file.path, known, centred)
    posture = LandmarkPosture(
        path=chosen.file.path, name=chosen.file.path.name, y_up=chosen.file.y_up, places=landmarks.places,
        trajectories=_posture_markers(chosen, labels, centred, landmarks.places),
        notes=(*file.person_notes, *chosen.notes, *hips.notes, *landmarks.notes), remedy=_REMEDY,
        assumed=landmarks.assumed, shifted=tuple(shifted),
    )  # fmt: skip
    return PreparedSet(
        name=known.name, file=replace(file, trajectories=centred.trajectories), posture=posture, reasons=chosen.reasons,
        found=_found(recognised, labels, centred),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Source:
    """A file in which a posture is sought."""

    file: MarkerFile
    labels: dict[str, str]
    known: MarkerSet

    def label(self, landmark: str) -> str | None:
        """Return the label of the marker on a landmark; None without one that is ever visible."""
        trial = self.file.trajectories
        for choice in self.known.landmarks.get(landmark, ()):
            own = self.labels.get(plain_label(choice[0]))
            if own is not None and trial.present[:, trial.labels.index(own)].any():
                return own
        return None

    def legs(self) -> list[LegLabels]:
        """Return the labels of the legs whose spine, knee and ankle have a marker."""
        found = [tuple(map(self.label, (spine, f"{side}_LE", f"{side}_LM"))) for side, spine in _SIDES]
        return [(a, b, c) for a, b, c in found if a and b and c]

    def further(self) -> list[str]:
        """Return the labels of pelvis and heels."""
        names = (*PELVIS_LANDMARKS, *(f"{side}_CA" for side, _ in _SIDES))
        return list(dict.fromkeys(label for name in names if (label := self.label(name))))

    def require_legs(self) -> list[LegLabels]:
        """Return the legs.

        Raises:
            FileProblem: The pelvis or both legs lack a marker.
        """
        needed = [*PELVIS_LANDMARKS, *(f"{side}_{name}" for side, _ in _SIDES for name in ("LE", "LM"))]
        missing = [self.known.landmarks[name][0][0] for name in needed if self.label(name) is None]
        legs = self.legs()
        if not legs or any(self.label(name) is None for name in PELVIS_LANDMARKS):
            wrong = f"lacks markers that the marker set {self.known.name} needs: {listed(dict.fromkeys(missing))}"
            raise FileProblem(self.file.path, wrong, _REMEDY)
        return legs


def _of_static(source: _Source) -> _Chosen:
    """Choose the frames of a static trial in which the person stands."""
    legs = source.require_legs()
    up = np.eye(3)[1 if source.file.y_up else 2]
    frames = standing_frames(source.file.trajectories, legs, source.further(), up=up)
    if not len(frames):
        wrong = f"has no part of {LEAST_STANDING_S} s in which the person stands upright and still"
        raise FileProblem(source.file.path, wrong, "Give a trial of the person standing as static (--static).")
    return _Chosen(file=source.file, labels=source.labels, frames=frames, standing=True)


def _of_trial(source: _Source) -> _Chosen:
    """Choose the frames of the trial itself: standing still, or else the most upright one."""
    legs, trial = source.require_legs(), source.file.trajectories
    up = np.eye(3)[1 if source.file.y_up else 2]
    frames = standing_frames(trial, legs, source.further(), up=up)
    if len(frames):
        note = f"The person stands still in the frames {frames[0]} to {frames[-1]}, which serve as static trial."
        return _Chosen(file=source.file, labels=source.labels, frames=frames, standing=True, notes=(note,))
    frame = most_upright_frame(trial, legs, source.further())
    if frame is None:
        wrong = "has no frame in which all markers of pelvis, knees, ankles and heels are visible"
        raise FileProblem(source.file.path, wrong, "Give a static trial (--static), or fill the gaps of the trial.")
    bent = max(float(knee_bend_deg(trial, leg)[frame]) for leg in legs)
    reason = VerdictReason.limit(
        f"The person never stands still: the bones are those of the most upright frame, {frame}, with knees bent by up "
        f"to {bent:.0f} degrees, as seen between the markers.",
        "Give a static trial (--static).",
        cause="no static posture",
    )
    return _Chosen(file=source.file, labels=source.labels, frames=np.array([frame]), standing=False, reasons=(reason,))


def _means(trial: MarkerTrajectories, frames: Sequence[int] | Integers) -> dict[str, Floats]:
    """Return the mean place (3,) of each marker that is visible in some frames."""
    points = trial.points[np.asarray(frames)]
    known = np.isfinite(points).all(-1)
    return {
        label: points[known[:, m], m].mean(0) for m, label in enumerate(trial.labels) if known[:, m].any()
    }  # fmt: skip


def _in_frames(chosen: _Chosen) -> MarkerTrajectories:
    """Return the markers in the frames of the posture."""
    trial, frames = chosen.file.trajectories, chosen.frames
    return replace(
        trial, points=trial.points[frames], filled=trial.filled[frames], residuals=trial.residuals[frames]
    )  # fmt: skip


def _posture_markers(
    chosen: _Chosen, labels: dict[str, str], centred: CentredTrial, places: Mapping[str, Floats]
) -> MarkerTrajectories:
    """Return the markers in the frames of the posture under the labels of the trial, with the joint centres."""
    shared = {name: label for name, label in chosen.labels.items() if name in labels}
    part = _in_frames(chosen).select(list(shared.values()))
    part = replace(part, labels=tuple(labels[name] for name in shared))
    return part.with_points({name: np.repeat(places[name][None], len(chosen.frames), 0) for name in centred.added})


def _require_segments(path: Path, known: MarkerSet, centred: CentredTrial) -> None:
    """Check that the pelvis and one more segment have markers in the trial."""
    there = {cluster.segment for cluster in centred.clusters}
    if "pelvis" in there and len(there) > 1:
        return
    lacking = [name for name in known.segments if name not in there]
    wrong = f"has fewer than three markers of the marker set {known.name} on {listed(lacking)}"
    raise FileProblem(path, wrong, _REMEDY)


def _found(recognised: RecognisedSet, labels: dict[str, str], centred: CentredTrial) -> FoundClusters:
    """Return the segments, with notes on the set and on the labels that are not used."""
    used = {label for cluster in centred.clusters for label in cluster.labels}
    known = recognised.marker_set
    marks = {plain_label(label) for choices in known.landmarks.values() for choice in choices for label in choice}
    marks |= set(map(plain_label, known.planes.values()))
    used |= {label for name, label in labels.items() if name in marks}
    others = [label for label in centred.trajectories.labels if label not in used]
    notes = [recognised.sentence, *recognised.notes]
    if others:
        notes.append(f"Labels that the set does not use for the legs are ignored: {listed(others, most=MOST_LABELS)}.")
    return FoundClusters(clusters=centred.clusters, skipped=tuple(others), notes=tuple(notes))

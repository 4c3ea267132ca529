"""Gait events of a trial, and joint angles over the cycle."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from marey.arrays import Floats
from marey.geometry.continuity import continuous_angles
from marey.io.axes import OPENSIM_FROM_WORLD
from marey.io.markers.trial_file import MarkerFile
from marey.markers.data.clusters import Cluster
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.kinematics.joint_angles import JointKinematics
from marey.markers.preprocessing.gait_events import events_from_force
from marey.motion.events.curves import CycleCurves, average_over_cycles
from marey.motion.events.cycles import GaitCycle, GaitEvent, gait_cycles
from marey.motion.events.detection import find_events
from marey.motion.events.feet import FootPath, WalkPaths
from marey.pipelines.gait.walk import Gait, count_events, gait_from

_FOOT = re.compile(
    r"(?P<side>l|r|left|right)?[._ ]?(?P<what>heel?|calc?|fcc|toe|fm2)([._ ]?tip)?(_study)?", re.IGNORECASE
)
"""Labels of heel and toe markers in common marker sets."""
_TOES = ("toe", "fm2")
"""What labels call the toe; other parts are the heel."""
_SIDES = {"l": "left", "left": "left", "r": "right", "right": "right"}
"""Side by its abbreviation in a label."""
_TRUNK = ("pelvis", "thorax", "left_thigh", "right_thigh", "thigh")
"""Segments that can stand for the body, the best first."""
_TRUNK_LABELS = ("SACR", "LASI", "RASI", "LPSI", "RPSI", "V.Sacral", "L.ASIS", "R.ASIS")
"""Labels of pelvis markers in common marker sets."""


def find_gait(file: MarkerFile, clusters: Sequence[Cluster], *, side: str | None) -> Gait:
    """Return the events of the file; if it has none, find them from the heels, or else from force plates.

    Args:
        file: The trial.
        clusters: Segments of the trial; the motion of the heels is measured relative to the pelvis, or a thigh.
        side: `left` or `right`, for a foot whose label does not contain it.
    """
    paths = walk_paths(file, clusters, side=side)
    for candidate in _candidates(file, paths, side):
        if gait_cycles(candidate.events):
            break
    found = gait_from(paths, candidate.events)
    notes = list(file.plate_notes)
    if candidate.events:
        notes.append(f"Gait events {candidate.source}: {count_events(found)}.")
    frames = {plate.name: plate.laboratory_from_plate for plate in file.plates}
    return replace(found, notes=tuple(notes), plates=frames)


class _Candidate(NamedTuple):
    """The events that one source gives."""

    events: tuple[GaitEvent, ...]
    source: str
    """Where they come from, for a note."""


def _candidates(file: MarkerFile, paths: WalkPaths | None, side: str | None) -> Iterator[_Candidate]:
    """Yield the events of each source, the best source first; the last one also serves without a complete cycle."""
    given = _Candidate(file.events, "given in the file")
    yield given
    trajectories = file.trajectories
    feet = _feet(trajectories, side)
    if paths is not None:
        labels = ", ".join(name for foot in feet.values() if "heel" in foot for name in foot.values())
        yield _Candidate(find_events(paths), f"found from {labels}")
    heels = {own: trajectories.select([foot["heel"]]).points[:, 0] for own, foot in feet.items() if "heel" in foot}
    by_force = events_from_force(file.plates, heels, rate=trajectories.rate, start_s=trajectories.start_s)
    yield _Candidate(by_force, "found from the force plates") if by_force else given


def _feet(trajectories: MarkerTrajectories, side: str | None) -> dict[str, dict[str, str]]:
    """Find the markers of heels and toes by their labels, by side ("" if it is unknown)."""
    feet: dict[str, dict[str, str]] = {}
    there = np.asarray(trajectories.present.any(0))
    for label, seen in zip(trajectories.labels, there, strict=True):
        match = _FOOT.fullmatch(label)
        if match and seen:
            own = _SIDES.get((match["side"] or "").lower(), side or "")
            what = "toe" if match["what"].lower() in _TOES else "heel"
            feet.setdefault(own, {}).setdefault(what, label)
    return feet


def _body(trajectories: MarkerTrajectories, clusters: Sequence[Cluster]) -> Floats | None:
    """Return the path (F, 3) of the pelvis, or of a segment that moves with it; None if there is none."""
    by_name = {cluster.segment: cluster.labels for cluster in clusters}
    trunk = [label for label in _TRUNK_LABELS if label in trajectories.labels]
    choices = [by_name[name] for name in _TRUNK[:2] if name in by_name]
    choices += [tuple(trunk)] if trunk else []
    choices += [by_name[name] for name in _TRUNK[2:] if name in by_name]
    for labels in choices:
        points = trajectories.select(labels).points
        known = np.isfinite(points).all(-1)
        steady = known.mean(0) > 0.5 * known.mean(0).max(initial=0.0)
        points = points[:, steady]
        if points.shape[1]:
            # A mean over markers that come and go would jump.
            return np.asarray(points.mean(1))
    return None


def walk_paths(file: MarkerFile, clusters: Sequence[Cluster], *, side: str | None) -> WalkPaths | None:
    """Return the paths of heels, toes and body, Z up; None if there is no heel, or nothing that moves with the pelvis.

    Args:
        file: The trial.
        clusters: Segments of the trial.
        side: `left` or `right`, for a foot whose label does not contain it.
    """
    trajectories = file.trajectories
    body = _body(trajectories, clusters)
    upright = OPENSIM_FROM_WORLD if file.y_up else np.eye(3)  # points are rows: the transposed rotation from the right

    def path(label: str) -> Floats:
        return np.asarray(trajectories.select([label]).points[:, 0] @ upright)

    feet = [
        FootPath(side=own or None, heel=path(foot["heel"]), toe=path(foot["toe"]) if "toe" in foot else None)
        for own, foot in _feet(trajectories, side).items() if "heel" in foot
    ]  # fmt: skip
    if body is None or not feet:
        return None
    return WalkPaths(
        body=body @ upright, feet=tuple(feet), rate=trajectories.rate, start_s=trajectories.start_s
    )  # fmt: skip


def cycle_curves(
    joints: JointKinematics, time: Floats, cycles: Sequence[GaitCycle], *, side: str | None
) -> CycleCurves | None:  # fmt: skip
    """Average joint angles [degrees] and translations [mm] over the gait cycles of their own side.

    Args:
        joints: Angles and translations over the trial.
        time: (F,) [s].
        cycles: Cycles of both feet.
        side: `left` or `right`, for joints whose names do not contain it.

    Returns:
        None if no cycle has values in all of its frames.
    """
    names = [f"{n}_deg" for n in joints.angle_names] + [f"{n}_mm" for n in joints.translation_names]
    values = np.concatenate(
        [continuous_angles(np.degrees(joints.angles), period=360.0, centred=True), 1e3 * joints.translations], 1
    )
    return average_over_cycles(names, values, time, cycles, side=side)

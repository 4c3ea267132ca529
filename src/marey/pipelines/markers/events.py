"""Gait events of a trial, and joint angles over the cycle."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from marey.arrays import Floats
from marey.errors import MareyError
from marey.geometry.rigid import RigidTransform
from marey.io.markers.trial_file import MarkerFile
from marey.markers.data.clusters import Cluster
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.kinematics.joint_angles import JointKinematics
from marey.markers.preprocessing.gait_events import events_from_force, events_from_markers
from marey.motion.gait import STRIKE, GaitCycle, GaitEvent, gait_cycles, over_cycles

_FOOT = re.compile(r"(?P<side>l|r|left|right)?[._ ]?(?P<what>heel?|cal|calc|toe)([._ ]?tip)?", re.IGNORECASE)
"""Labels of heel and toe markers in common marker sets."""
_SIDES = {"l": "left", "left": "left", "r": "right", "right": "right"}
"""Side by its abbreviation in a label."""
_TRUNK = ("pelvis", "thorax", "left_thigh", "right_thigh", "thigh")
"""Segments that can stand for the body, the best first."""
LEAST_CYCLES = 3
"""Number of cycles from which on their standard deviation is stated: that of two is itself uncertain by 71 %, that of
three by 50 %."""
_TRUNK_LABELS = ("SACR", "LASI", "RASI", "LPSI", "RPSI", "V.Sacral", "L.ASIS", "R.ASIS")
"""Labels of pelvis markers in common marker sets."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Gait:
    """The events of a trial and the cycles between them."""

    events: tuple[GaitEvent, ...]
    cycles: tuple[GaitCycle, ...]
    notes: tuple[str, ...]
    plates: Mapping[str, RigidTransform]
    """Frames of the force plates, laboratory from plate [m]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CycleCurves:
    """Joint angles and translations over 0 to 100 % of the gait cycle."""

    names: tuple[str, ...]
    """N names, with units as in angles.csv."""
    mean: Floats
    """(101, N) mean over the cycles [degrees, mm]."""
    spread: Floats
    """(101, N) standard deviation between the cycles [degrees, mm]; NaN for fewer than three cycles."""
    counts: tuple[int, ...]
    """(N,) number of cycles."""


def find_gait(file: MarkerFile, clusters: Sequence[Cluster], *, side: str | None) -> Gait:
    """Return the events of the file; if it has none, find them from the heels, or else from force plates.

    Args:
        file: The trial.
        clusters: Segments of the trial; the motion of the heels is measured relative to the pelvis, or a thigh.
        side: `left` or `right`, for a foot whose label does not contain it.
    """
    for candidate in _candidates(file, clusters, side):
        cycles = gait_cycles(candidate.events)
        if cycles:
            break
    notes = list(file.plate_notes)
    if candidate.events:
        strikes = sum(event.kind == STRIKE for event in candidate.events)
        offs = len(candidate.events) - strikes
        counts = f"{strikes} foot strikes, {offs} foot offs, {len(cycles)} complete cycles"
        notes.append(f"Gait events {candidate.source}: {counts}.")
    frames = {plate.name: plate.laboratory_from_plate for plate in file.plates}
    return Gait(events=candidate.events, cycles=cycles, notes=tuple(notes), plates=frames)


class _Candidate(NamedTuple):
    """The events that one source gives."""

    events: tuple[GaitEvent, ...]
    source: str
    """Where they come from, for a note."""


def _candidates(file: MarkerFile, clusters: Sequence[Cluster], side: str | None) -> Iterator[_Candidate]:
    """Yield the events of each source, the best source first; the last one also serves without a complete cycle."""
    given = _Candidate(file.events, "given in the file")
    yield given
    trajectories = file.trajectories
    feet = _feet(trajectories, side)
    body = _body(trajectories, clusters)
    if body is not None:
        found: list[GaitEvent] = []
        for own, foot in feet.items():
            if "heel" in foot:
                found += _of_foot(foot, body, trajectories, own or None, file.y_up)
        labels = ", ".join(name for foot in feet.values() for name in foot.values())
        yield _Candidate(tuple(sorted(found, key=lambda e: e.time)), f"found from {labels}")
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
            what = "toe" if match["what"].lower() == "toe" else "heel"
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


def _of_foot(
    foot: dict[str, str], body: Floats, trajectories: MarkerTrajectories, side: str | None, y_up: bool
) -> tuple[GaitEvent, ...]:
    paths = {what: trajectories.select([label]).points[:, 0] for what, label in foot.items()}
    try:
        return events_from_markers(
            paths["heel"], body, rate=trajectories.rate, start_s=trajectories.start_s, side=side, toe=paths.get("toe"),
            up=np.array([0.0, 1.0, 0.0] if y_up else [0.0, 0.0, 1.0]),
        )  # fmt: skip
    except MareyError:
        return ()  # heel and body are never seen together


def cycle_curves(
    joints: JointKinematics, time: Floats, cycles: Sequence[GaitCycle], *, side: str | None
) -> CycleCurves | None:  # fmt: skip
    """Average joint angles and translations over the gait cycles of their own side.

    Args:
        joints: Angles and translations over the trial.
        time: (F,) [s].
        cycles: Cycles of both feet.
        side: `left` or `right`, for joints whose names do not contain it.

    Returns:
        None if no cycle has values in all of its frames.
    """
    names = [f"{n}_deg" for n in joints.angle_names] + [f"{n}_mm" for n in joints.translation_names]
    values = np.concatenate([np.degrees(joints.angles), 1e3 * joints.translations], 1)
    mean, spread, counts = [], [], []
    for k, name in enumerate([*joints.angle_names, *joints.translation_names]):
        own = _of_side(cycles, _side_of(name) or side)
        curves = over_cycles(values[:, k], time, own)
        whole = curves[np.isfinite(curves).all(1)]
        counts.append(len(whole))
        mean.append(whole.mean(0) if len(whole) else np.full(101, np.nan))
        spread.append(whole.std(0, ddof=1) if len(whole) >= LEAST_CYCLES else np.full(101, np.nan))
    if not any(counts):
        return None
    return CycleCurves(
        names=tuple(names), mean=np.stack(mean, 1), spread=np.stack(spread, 1), counts=tuple(counts)
    )  # fmt: skip


def _side_of(name: str) -> str | None:
    """Return the side of an angle: `left_knee_flexion`, or `knee_angle_l` as in OpenSim's models."""
    if name.startswith(("left_", "right_")):
        return name.partition("_")[0]
    return {"_l": "left", "_r": "right"}.get(name[-2:])


def _of_side(cycles: Sequence[GaitCycle], side: str | None) -> list[GaitCycle]:
    """Return the cycles of a side; an angle without a side uses those of the right foot, or else the others."""
    sides = {cycle.side for cycle in cycles}
    for wanted in (side, None, *(() if side else ("right", "left"))):
        if wanted in sides:
            return [cycle for cycle in cycles if cycle.side == wanted]
    return []

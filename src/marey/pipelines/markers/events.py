"""Gait events of a trial, and joint angles over the cycle."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem, MareyError
from marey.geometry.rigid import RigidTransform
from marey.io.markers.c3d_forces import read_events, read_force_plates
from marey.markers.data.clusters import Cluster
from marey.markers.data.force_plates import ForcePlate
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.kinematics.joint_angles import JointKinematics
from marey.markers.preprocessing.gait_events import events_from_force, events_from_markers
from marey.motion.gait import STRIKE, GaitCycle, GaitEvent, gait_cycles, over_cycles

_FOOT = re.compile(r"(?P<side>l|r|left|right)?[._ ]?(?P<what>heel?|cal|calc|toe)([._ ]?tip)?", re.IGNORECASE)
_SIDES = {"l": "left", "left": "left", "r": "right", "right": "right"}
_TRUNK = ("pelvis", "thorax", "left_thigh", "right_thigh", "thigh")
_TRUNK_LABELS = ("SACR", "LASI", "RASI", "LPSI", "RPSI", "V.Sacral", "L.ASIS", "R.ASIS")


@dataclass(frozen=True, eq=False, kw_only=True)
class Gait:
    """The events of a trial and the cycles between them."""

    events: tuple[GaitEvent, ...]
    cycles: tuple[GaitCycle, ...]
    notes: tuple[str, ...]
    plates: Mapping[str, RigidTransform]
    """The force plates' frames, laboratory from plate [m]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CycleCurves:
    """Joint angles and translations over 0 to 100 % of the cycle, one curve a cycle."""

    names: tuple[str, ...]
    """N names, with units as in angles.csv."""
    mean: Floats
    """(101, N) over the cycles; degrees, mm."""
    spread: Floats
    """(101, N) standard deviation between the cycles; NaN of a single cycle."""
    counts: tuple[int, ...]
    """(N,) cycles."""


def find_gait(
    path: Path, trajectories: MarkerTrajectories, clusters: Sequence[Cluster], *, side: str | None, y_up: bool
) -> Gait:
    """Take the events that the file gives; else find them from the heels, else from force plates.

    Args:
        path: The trial.
        trajectories: Its markers.
        clusters: Of its segments; the pelvis, or a thigh, goes along with the body.
        side: Of a foot whose label does not tell it.
        y_up: Whether the trial has Y up instead of Z.
    """
    is_c3d = path.suffix.lower() == ".c3d"
    plates, unread = _plates(path) if is_c3d else ((), ())
    events, how = _events(path if is_c3d else None, plates, trajectories, clusters, side=side, y_up=y_up)
    cycles = gait_cycles(events)
    notes = list(unread)
    if events:
        strikes = sum(event.kind == STRIKE for event in events)
        offs = len(events) - strikes
        notes.append(f"Gait events, {how}. Foot strikes: {strikes}; foot offs: {offs}; whole cycles: {len(cycles)}.")
    frames = {plate.name: plate.laboratory_from_plate for plate in plates}
    return Gait(events=tuple(events), cycles=cycles, notes=tuple(notes), plates=frames)


def _plates(path: Path) -> tuple[tuple[ForcePlate, ...], tuple[str, ...]]:
    """Read the force plates; what cannot be read of them is said, as markers do not need it."""
    try:
        return read_force_plates(path), ()
    except FileProblem as problem:
        return (), (f"The force plates are not read: {problem}",)


def _events(
    c3d: Path | None, plates: Sequence[ForcePlate], trajectories: MarkerTrajectories, clusters: Sequence[Cluster],
    *, side: str | None, y_up: bool,
) -> tuple[Sequence[GaitEvent], str]:  # fmt: skip
    """Give the events and where they are from."""
    events = () if c3d is None else read_events(c3d)
    if gait_cycles(events):
        return events, "given in the file"
    feet = _feet(trajectories, side)
    body = _body(trajectories, clusters)
    found: list[GaitEvent] = []
    if body is not None:
        for own, foot in feet.items():
            if "heel" in foot:
                found += _of_foot(foot, body, trajectories, own or None, y_up)
    if gait_cycles(found):
        labels = ", ".join(name for foot in feet.values() for name in foot.values())
        return sorted(found, key=lambda e: e.time), f"found from {labels}"
    heels = {own: trajectories.select([foot["heel"]]).points[:, 0] for own, foot in feet.items() if "heel" in foot}
    by_force = events_from_force(plates, heels, rate=trajectories.rate, start_s=trajectories.start_s)
    return (by_force, "found from the force plates") if by_force else (events, "given in the file")


def _feet(trajectories: MarkerTrajectories, side: str | None) -> dict[str, dict[str, str]]:
    """Find the heels' and toes' markers by their labels: side ("" where unknown) to `heel` and `toe`."""
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
    """Give the path (F, 3) of something that goes along with the pelvis, None where there is nothing."""
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
        return ()  # the heel and the body are never seen together: no event shows


def cycle_curves(
    joints: JointKinematics, time: Floats, cycles: Sequence[GaitCycle], *, side: str | None
) -> CycleCurves | None:  # fmt: skip
    """Put joint angles and translations over the cycles of their own side.

    Args:
        joints: Over the trial.
        time: (F,) [s].
        cycles: Of either foot.
        side: Of joints whose names do not tell it.

    Returns:
        None where no cycle lies within what is known.
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
        spread.append(whole.std(0, ddof=1) if len(whole) > 1 else np.full(101, np.nan))
    if not any(counts):
        return None
    return CycleCurves(
        names=tuple(names), mean=np.stack(mean, 1), spread=np.stack(spread, 1), counts=tuple(counts)
    )  # fmt: skip


def _side_of(name: str) -> str | None:
    """Tell the side of an angle: `left_knee_flexion`, or `knee_angle_l` as OpenSim's models write it."""
    if name.startswith(("left_", "right_")):
        return name.partition("_")[0]
    return {"_l": "left", "_r": "right"}.get(name[-2:])


def _of_side(cycles: Sequence[GaitCycle], side: str | None) -> list[GaitCycle]:
    """Choose the cycles of a side; what has none goes by the right foot's, or by those that there are."""
    sides = {cycle.side for cycle in cycles}
    for wanted in (side, None, *(() if side else ("right", "left"))):
        if wanted in sides:
            return [cycle for cycle in cycles if cycle.side == wanted]
    return []

"""Points, weights and setups with which OpenSim's inverse kinematics and dynamics run on the results of a recording."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from marey.arrays import Floats, Mask, true_runs
from marey.body.articulation.jointed_body import JointedBody
from marey.body.articulation.model_points import undriven_coordinates
from marey.io.axes import OPENSIM_FROM_WORLD
from marey.io.opensim.external_loads import EXTERNAL_LOADS
from marey.io.opensim.tool_setups import ik_task_set, write_id_setup, write_ik_setup, write_ik_tasks
from marey.io.opensim.trc import PointPaths, write_trc
from marey.markers.kinematics.model_placement import (
    SegmentPoint,
    place_segment_points,
    relative_weights,
    segment_point_paths,
    with_carried_segments,
    with_upright_thorax,
)
from marey.motion.events.cycles import STRIKE, GaitEvent
from marey.pipelines.exchange.opensim_person import OpenSimPerson

POINTS, TASKS, IK_SETUP, ID_SETUP = "points.trc", "ik_tasks.xml", "ik_setup.xml", "id_setup.xml"
"""Names of the points, the weights, and the setups."""
_IK, _ID = "ik.mot", "id.sto"
"""Names of the files that OpenSim's tools write."""
_HELD = 1.0
"""Weight of a coordinate that no point determines [1/rad2 or 1/m2]. Any positive value holds it at its default."""
_ASSUMED = 0.01
"""Relative weight of the points of a thorax that was not measured. Nothing else moves it, so any weight that is small
beside those of the pelvis gives the same posture."""
_OVERLAP = 0.5
"""Share of a stance that a plate carries from which the stance counts as measured. Chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ToolInputs:
    """What OpenSim's inverse kinematics needs of a recording."""

    points: tuple[SegmentPoint, ...]
    """The P points that the model follows."""
    paths: PointPaths
    """Their paths."""
    weights: Floats
    """(P,) relative weights, of which the largest is 1."""
    assumed: bool
    """Whether the trunk was not measured, and is assumed to be upright."""
    held: tuple[str, ...]
    """Coordinates that no point determines."""
    span: tuple[float, float]
    """First and last time of the longest part in which the segments are known [s]."""


def tool_inputs(model: JointedBody, joints: Mapping[str, str], person: OpenSimPerson) -> ToolInputs | None:
    """Find the points through which a scaled model follows a person.

    Args:
        model: The scaled model.
        joints: Maps a joint centre to the body that rotates about it.
        person: The person.

    Returns:
        None if model and person have no segment in common, or no two frames in succession show all of them.
    """
    motion, reference = person.motion, person.reference
    assumed = "pelvis" in reference.segments and "pelvis" in motion.segments and "thorax" not in motion.segments
    if assumed:
        motion, reference = with_upright_thorax(motion, reference, rate=person.rate)
    placed = place_segment_points(model, joints, reference)
    motion = with_carried_segments(motion, placed.carried)
    points = tuple(point for point in placed.points if point.segment in motion.segments)
    points = tuple(p for p in points if motion.answered[:, motion.segments.index(p.segment)].any())
    if not points:
        return None
    paths, sd = segment_point_paths(points, motion)
    whole: Mask = np.asarray(np.isfinite(paths).all((1, 2)))
    runs = true_runs(whole)
    first, end = max(runs, key=lambda run: run[1] - run[0], default=(0, 0))
    if end - first < 2:
        return None
    kept = slice(first, end)
    weights = relative_weights(sd[kept])
    weights[[assumed and point.segment == "thorax" for point in points]] = _ASSUMED
    return ToolInputs(
        points=points, weights=weights, assumed=assumed and any(point.segment == "thorax" for point in points),
        paths=PointPaths(
            names=tuple(point.label for point in points), time=person.time[kept], rate=person.rate,
            points=paths[kept] @ OPENSIM_FROM_WORLD,
        ),
        held=undriven_coordinates(model, [point.body for point in points]),
        span=(float(person.time[first]), float(person.time[end - 1])),
    )  # fmt: skip


def write_tool_inputs(
    folder: Path, inputs: ToolInputs, *, model: str, span: tuple[float, float] | None
) -> None:
    """Write points, weights and setups.

    Args:
        folder: The folder.
        inputs: Points and weights.
        model: Name of the model in the folder.
        span: Times in which forces are complete [s]; None without forces.
    """
    write_trc(folder / POINTS, inputs.paths)
    write_ik_tasks(folder / TASKS, _tasks(inputs))
    write_ik_setup(
        folder / IK_SETUP, model=model, markers=POINTS, tasks=_tasks(inputs), span=inputs.span, out=_IK
    )
    if span is not None:
        write_id_setup(
            folder / ID_SETUP, model=model, coordinates=_IK, loads=EXTERNAL_LOADS, span=span, out=_ID
        )  # fmt: skip


def _tasks(inputs: ToolInputs) -> Element:
    weights = {point.label: float(w) for point, w in zip(inputs.points, inputs.weights, strict=True)}
    return ik_task_set(weights, dict.fromkeys(inputs.held, _HELD))


def measured_span(
    inputs: ToolInputs, events: Sequence[GaitEvent], contacts: Sequence[tuple[str, float, float]]
) -> tuple[float, float] | None:
    """Return the longest time in which every foot on the floor is on a plate.

    Args:
        inputs: Points; the time lies in theirs.
        events: Foot strikes and offs of the walk.
        contacts: Side, begin and end of each contact with a plate [s].

    Returns:
        First and last time [s]; without events those of the contacts; None if there is no such time.
    """
    first, last = inputs.span
    if not contacts:
        return None
    if not events:
        begin, end = max(first, min(c[1] for c in contacts)), min(last, max(c[2] for c in contacts))
        return (begin, end) if end > begin else None
    elsewhere = [
        stance for stance in _stances(events, first, last)
        if max((_shared(stance, c) for c in contacts), default=0.0) < _OVERLAP
    ]  # fmt: skip
    edges = sorted({first, last, *(t for _, a, b in elsewhere for t in (a, b) if first < t < last)})
    free = [
        (a, b) for a, b in pairwise(edges)
        if not any(begin < (a + b) / 2 < end for _, begin, end in elsewhere)
        and any(begin < b and end > a for _, begin, end in contacts)
    ]  # fmt: skip
    return max(free, key=lambda each: each[1] - each[0], default=None)


def _stances(events: Sequence[GaitEvent], first: float, last: float) -> list[tuple[str, float, float]]:
    """List side, begin and end of each stance; one that begins before or ends after the events is cut."""
    stances = []
    for side in ("left", "right"):
        own = sorted((e for e in events if e.side == side), key=lambda e: e.time)
        begin: float | None = first if own and own[0].kind != STRIKE else None
        for event in own:
            if event.kind == STRIKE:
                begin = event.time
            elif begin is not None:
                stances.append((side, begin, event.time))
                begin = None
        if begin is not None:
            stances.append((side, begin, last))
    return stances


def _shared(stance: tuple[str, float, float], contact: tuple[str, float, float]) -> float:
    """Return the share of a stance that a contact of the same foot covers."""
    if stance[0] != contact[0]:
        return 0.0
    return max(0.0, min(stance[2], contact[2]) - max(stance[1], contact[1])) / max(stance[2] - stance[1], 1e-9)

"""Data of the page of `marey view`, in parts that the page loads when it needs them."""

import json
from collections.abc import Sequence
from functools import cached_property

import numpy as np

from marey.arrays import Floats
from marey.motion.events.cycles import STRIKE
from marey.motion.motion import BodyMotion
from marey.view.pages.capture_report import camera_views, resting_body
from marey.view.pages.curves import CurvePlot, PlotGroup
from marey.view.pages.html import packed
from marey.view.pages.marker_scene import frames_apart, marker_scene
from marey.view.pages.problems import readable
from marey.view.pictures.palette import bone_pairs, side_colour
from marey.view.viewer.plots import event_colour, plot_groups
from marey.view.viewer.viewed import ViewedBody, ViewedMarkers, ViewedResult, ViewerContent

CHUNK = 512
"""Number of frames of a motion that are loaded at once: about 0.3 MB for 21 segments and 16 joints. Chosen by hand."""
_ROTATION_SCALE = 32767
"""Scale of the entries of rotation matrices as 16-bit integers: an error of at most 1.5e-5."""
_NEWTON_PER_HEIGHT = 1500.0
"""Force whose arrow is as long as the distance from the middle of the markers to the outermost ones [N]."""


class ViewerParts:
    """The parts of one page by their names.

    `body/R` is the body of result R at rest, `motion/R/K` the K-th chunk of its motion, `markers/R` a scene of markers,
    and `curves/G` the curves of group G.

    Args:
        content: What the page shows.
    """

    def __init__(self, content: ViewerContent):
        self.content = content
        self.groups = plot_groups(content.results)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of all parts."""
        names = []
        for r, result in enumerate(self.content.results):
            if isinstance(result.shown, ViewedMarkers):
                names.append(f"markers/{r}")
                continue
            names += [f"body/{r}"] if result.shown.body is not None else []
            names += [f"motion/{r}/{k}" for k in range(-(-len(result) // CHUNK))]
        return (*names, *(f"curves/{g}" for g in range(len(self.groups))))

    def part(self, name: str) -> bytes:
        """Return a part.

        Args:
            name: One of `names`.

        Raises:
            KeyError: There is no such part.
        """
        if name not in self.names:
            raise KeyError(name)
        kind, *numbers = name.split("/")
        first, *more = map(int, numbers)
        if kind == "curves":
            return _curve_bytes(self.groups[first])
        shown = self.content.results[first].shown
        if isinstance(shown, ViewedMarkers):
            return json.dumps(_marker_data(self.content.results[first], shown)).encode()
        if kind == "body" and shown.body is not None:
            return json.dumps(resting_body(shown.body)).encode()
        return _motion_bytes(shown, more[0] * CHUNK)

    def page_data(self) -> dict[str, object]:
        """Return what the page needs at its start."""
        first, take = self.content.results[0], self.content.take
        return {
            "time": packed(first.time, "f4"), "state": packed(first.state, "u1"), "rate": first.rate, "stride": 1,
            "first": first.first, "chunk": CHUNK, "without": self.content.without_videos,
            "cameras": [] if take is None else camera_views(take.rig), "sameRoom": self.content.same_room,
            "results": [_result_data(result, first.time) for result in self.content.results],
            "groups": [{"title": group.title, "plots": _plot_data(group)} for group in self.groups],
            "events": [
                {"time": e.time, "side": e.side or "", "kind": e.kind, "colour": event_colour(e.side),
                 "strike": e.kind == STRIKE}
                for e in first.events
            ],
        }  # fmt: skip


def _result_data(result: ViewedResult, time: Floats) -> dict[str, object]:
    shown = result.shown
    data: dict[str, object] = {
        "name": result.name, "level": result.level, "reasons": list(result.reasons), "frames": len(result),
        "report": result.report is not None, "kind": "markers" if isinstance(shown, ViewedMarkers) else "body",
        "rows": None if result.time is time else packed(result.rows_at(time), "i4"),
    }  # fmt: skip
    if isinstance(shown, ViewedMarkers):
        return data
    motion = shown.motion
    return data | {
        "segments": len(_order(shown)), "hasBody": shown.body is not None,
        "joints": {
            "names": [readable(name) for name in motion.joint_names],
            "colours": [side_colour(name) for name in motion.joint_names],
            "bones": bone_pairs(motion.joint_names).tolist(),
        },
        "middle": _middle(motion).tolist(), "floor": _floor(motion),
    }  # fmt: skip


def _middle(motion: BodyMotion) -> Floats:
    """Return the mean place (3,) of the first segment [m]."""
    known = motion.segment_origin[np.isfinite(motion.segment_origin[:, 0]).all(1), 0]
    return known.mean(0) if len(known) else np.array([0.0, 0.0, 1.0])


def _floor(motion: BodyMotion) -> float:
    """Return the height of the floor [m]: that of the lowest joint, or 0 near it, as in the report."""
    heights = motion.joint_centres[..., 2]
    low = float(np.nanmin(heights)) if np.isfinite(heights).any() else 0.0
    return 0.0 if abs(low) < 0.25 else low


def _order(shown: ViewedBody) -> Sequence[int]:
    """Return the indices of the segments of the motion in the order of the body."""
    names = shown.motion.segment_names
    return range(len(names)) if shown.body is None else list(map(names.index, shown.body.skeleton.segment_names))


def _motion_bytes(shown: ViewedBody, first: int) -> bytes:
    """Return a chunk: places of segments and joints as 32-bit floats, then rotations as 16-bit integers."""
    frames, order = slice(first, first + CHUNK), _order(shown)
    rotation = np.nan_to_num(shown.motion.segment_rotation[frames][:, order])
    return b"".join(
        [
            shown.motion.segment_origin[frames][:, order].astype("<f4").tobytes(),
            shown.motion.joint_centres[frames].astype("<f4").tobytes(),
            np.rint(rotation * _ROTATION_SCALE).astype("<i2").tobytes(),
        ]
    )


def _marker_data(result: ViewedResult, shown: ViewedMarkers) -> dict[str, object]:
    every = frames_apart(shown.paths, len(shown.motion.segments), len(result))
    frames = slice(0, len(result), every)
    scene = marker_scene(shown.paths, shown.motion, shown.markers, frames=frames, every=every)
    centre, size = np.array(scene.pop("centre")), float(str(scene.pop("size")))
    upright = shown.paths.upright
    plates = [
        {
            "corners": packed((force.corners @ upright.T - centre) / size, "f4"),
            "at": packed((force.at[frames] @ upright.T - centre) / size, "f4"),
            "force": packed(force.force[frames] @ upright.T / _NEWTON_PER_HEIGHT, "f4"),
        }
        for force in result.forces
    ]
    return scene | {"forces": plates}


def _plot_data(group: PlotGroup) -> list[dict[str, object]]:
    """Return the plots of a group without their values."""
    return [
        {
            "title": plot.title, "unit": plot.unit, "least": plot.least, "digits": plot.digits,
            "marks": [vars(mark) for mark in plot.marks],
            "curves": [
                {"label": c.label, "colour": c.colour, "sd": c.sd is not None, "determined": c.determined is not None}
                for c in plot.curves
            ],
        }
        for plot in group.plots
        if isinstance(plot, CurvePlot)
    ]  # fmt: skip


def _curve_bytes(group: PlotGroup) -> bytes:
    """Return the curves of a group as 32-bit floats.

    Each is followed by its standard deviations if it has any, and by 1 where it is determined, or 0, if that is known.
    """
    arrays = []
    for plot in group.plots:
        for trace in plot.curves if isinstance(plot, CurvePlot) else ():
            arrays += [each for each in (trace.values, trace.sd, trace.determined) if each is not None]
    return b"".join(np.asarray(array).astype("<f4").tobytes() for array in arrays)

"""What a run on markers works with: the trial's trajectories, its clusters, and where the bones were."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from marey.arrays import Mask
from marey.errors import FileProblem, MareyError, SettingProblem
from marey.io.markers.readers import read_markers
from marey.io.markers.setup import read_marker_setup, read_reference
from marey.io.npz import read_arrays
from marey.markers.data.clusters import MINIMUM_MARKERS, AnatomicalCalibration, Cluster
from marey.markers.data.labels import FoundClusters, clusters_from_names, find_clusters
from marey.markers.data.problem import MarkerProblem
from marey.markers.data.setup import MarkerSetup
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.kinematics.joint_angles import usual_joints
from marey.markers.preprocessing.faults import find_faults
from marey.markers.preprocessing.gaps import FROM_CLUSTER, SPLINE, FilledGaps, fill_gaps
from marey.markers.preprocessing.own_frames import calibration_from_cluster_axes
from marey.pipelines.markers.settings import MarkersOptions
from marey.pipelines.markers.static import StaticBones, from_static, read_exercise


@dataclass(frozen=True, eq=False, kw_only=True)
class MarkersTrial:
    """One trial, ready for the methods."""

    path: Path
    measured: MarkerTrajectories
    """As the file has them."""
    used: MarkerTrajectories
    """With what was filled, without frames that were not asked for."""
    filling: FilledGaps | None
    """How gaps were filled, where that was asked for."""
    asked: Mask
    """(F,) the frames that are estimated."""
    problem: MarkerProblem
    anatomical: bool
    """Whether the bones' frames are anatomical ones, or the clusters' own."""
    side: str | None
    """`left` or `right` where it is known and the segments' names do not tell."""
    notes: tuple[str, ...]

    @property
    def key(self) -> object:
        """On what a method's result depends, besides the files."""
        problem = self.problem
        return (
            [(c.segment, c.labels) for c in problem.clusters], problem.calibration, list(problem.joints),
            list(problem.degrees_of_freedom), problem.noise_m, self.asked, self.used.points,
            problem.exercise is not None,
            [(name, s.form, s.period_s, s.pieces, s.functions, s.still) for name, s in problem.skin.items()],
        )  # fmt: skip


def read_trial(path: Path, options: MarkersOptions) -> MarkersTrial:
    """Read a trial and all that was said of it.

    Raises:
        FileProblem: A file cannot be used.
        SettingProblem: A setting does not fit the trial.
    """
    measured = read_markers(path, unit=options.unit)
    setup = MarkerSetup() if options.setup is None else read_marker_setup(options.setup)
    found = found_clusters(path, measured, setup, options)
    asked = asked_frames(len(measured), options.frames)
    used = cut(measured, asked)
    filling = filled(used, found.clusters, options)
    used = used if filling is None else cut(filling.trajectories, asked)
    notes = [*measured.notes, *found.notes, *(() if filling is None else filling.notes)]
    seen = _seen(used, found.clusters)
    static = None if options.static is None else from_static(used, seen, setup, options)
    calibration, anatomical, said = _calibration(path, measured, used, seen, static, options)
    used = with_frames(used, measured, calibration)
    notes += said
    # Frames that were not asked for are empty in what is used; that is no fault of the markers.
    riding = [label for cluster in found.clusters for label in cluster.labels]
    judged = (used if asked.all() else measured).select(riding)
    notes += find_faults(judged, found.clusters, calibration if anatomical else None)
    clusters = tuple(cluster for cluster in found.clusters if cluster.segment in calibration.segments)
    strange = sorted(set(setup.skin) - {cluster.segment for cluster in found.clusters})
    if strange:
        there = ", ".join(cluster.segment for cluster in found.clusters)
        raise SettingProblem(f"The TOML says how skin moves on {', '.join(strange)}; there are: {there}.")
    side, said = _side(calibration.segments, options)
    problem = MarkerProblem(
        trajectories=used, clusters=clusters, calibration=calibration,
        joints=_joints(setup, calibration.segments), skin=setup.skin,
    )  # fmt: skip
    degrees = {(j.parent, j.child): j.degrees_of_freedom for j in setup.joints}
    if degrees:
        problem = replace(problem, degrees_of_freedom=tuple(degrees[pair] for pair in problem.joints))
    if setup.noise_m is not None:
        problem = replace(problem, noise_m=setup.noise_m)
    notes += said if anatomical and problem.joints else []
    if options.exercise is not None:
        problem, told = read_exercise(problem, options)
        notes += told
    if not problem.joints:
        notes.append("No joint is known between the segments, so there are no joint angles: see [joints] of the TOML.")
    return MarkersTrial(
        path=path, measured=measured, used=used, filling=filling, asked=asked, problem=problem,
        anatomical=anatomical, side=side, notes=tuple(notes),
    )  # fmt: skip


def _seen(trajectories: MarkerTrajectories, clusters: Sequence[Cluster]) -> tuple[Cluster, ...]:
    """Give the clusters of which some frame shows enough markers; the others have no answer in any."""
    return tuple(c for c in clusters if (trajectories.select(c.labels).present.sum(1) >= MINIMUM_MARKERS).any())


def found_clusters(
    path: Path, trajectories: MarkerTrajectories, setup: MarkerSetup, options: MarkersOptions
) -> FoundClusters:
    """Find the clusters that the TOML names, or that the labels tell.

    Raises:
        FileProblem: There is none, or one that is named has too few markers.
    """
    if setup.segments:
        try:
            return clusters_from_names(setup.segments, trajectories.labels)
        except MareyError as problem:
            assert options.setup is not None
            raise FileProblem(options.setup, f"does not fit {path.name} ({str(problem).rstrip('.')})") from problem
    found = find_clusters(trajectories.labels)
    if not found.clusters:
        some = ", ".join(trajectories.labels[:12]) + (", ..." if len(trajectories.labels) > 12 else "")
        raise FileProblem(
            path, f"has no three labels that differ by a number only, so no segment can be told; it has {some}",
            'Name the segments in a TOML: [segments] thigh = ["label", ...], and give it with --clusters.',
        )  # fmt: skip
    return found


def asked_frames(count: int, frames: tuple[int, int] | None) -> Mask:
    """Tell which of so many frames (F,) are asked for.

    Raises:
        SettingProblem: None of them.
    """
    asked = np.ones(count, bool)
    if frames is not None:
        first, end = frames
        if first >= count:
            raise SettingProblem(f"--frames begins at {first}; the trial has the frames 0 to {count - 1}.")
        asked[:first] = False
        asked[end:] = False
    return asked


def cut(trajectories: MarkerTrajectories, asked: Mask) -> MarkerTrajectories:
    """Take away what was measured in frames that were not asked for."""
    if asked.all():
        return trajectories
    points = np.array(trajectories.points)
    points[~asked] = np.nan
    return replace(trajectories, points=points)


def with_frames(
    used: MarkerTrajectories, measured: MarkerTrajectories, calibration: AnatomicalCalibration
) -> MarkerTrajectories:
    """Give the frames in which the bones are known their markers again, also where they were not asked for."""
    lost = [f for f in calibration.frames if not used.present[f].any() and measured.present[f].any()]
    if not lost:
        return used
    points = np.array(used.points)
    points[lost] = measured.points[lost]
    return replace(used, points=points)


def filled(trajectories: MarkerTrajectories, clusters: Sequence[Cluster], options: MarkersOptions) -> FilledGaps | None:
    """Fill gaps where that was asked for: as the way that is named does, or by the better one of each gap."""
    ways = {"spline": (SPLINE,), "cluster": (FROM_CLUSTER,), "best": (SPLINE, FROM_CLUSTER)}
    return fill_gaps(trajectories, clusters, ways=ways[options.fill]) if options.fill in ways else None


def _calibration(
    path: Path, measured: MarkerTrajectories, used: MarkerTrajectories, clusters: Sequence[Cluster],
    static: StaticBones | None, options: MarkersOptions,
) -> tuple[AnatomicalCalibration, bool, list[str]]:  # fmt: skip
    """Find where the bones are: as a file says, as a static trial says, or by the clusters' own axes."""
    segments = tuple(cluster.segment for cluster in clusters)
    if not segments:
        raise FileProblem(path, "shows three markers of no segment in any frame", "See the gaps of the trial.")
    if options.reference is not None:
        calibration, notes = read_reference(options.reference, segments, frames=len(measured))
        return calibration, True, list(notes)
    if static is not None:
        return static.carried.calibration, True, list(static.notes)
    try:
        own = calibration_from_cluster_axes(used, clusters)
    except MareyError as problem:
        raise FileProblem(path, str(problem).rstrip("."), "Give a --reference, or name other segments.") from problem
    note = (
        f"Nothing tells how the bones lie beneath the markers. Each segment has its cluster's own axes as they lie in "
        f"frame {int(own.frames[0])}, and joints tell how far they turned since then, not how far they are bent. For "
        "anatomical angles give --reference, or --static with landmarks."
    )
    return own, False, [note]


def _joints(setup: MarkerSetup, segments: Sequence[str]) -> tuple[tuple[str, str], ...]:
    """Take the TOML's joints, or those that the segments' names tell."""
    if setup.joints:
        return tuple((j.parent, j.child) for j in setup.joints if j.parent in segments and j.child in segments)
    return usual_joints(segments)


def _side(segments: Sequence[str], options: MarkersOptions) -> tuple[str | None, list[str]]:
    """Find the side of segments that do not name theirs: typed, or told by the reference."""
    if all(name.startswith(("left_", "right_")) or name in ("pelvis", "thorax", "head") for name in segments):
        return None, []
    if options.side is not None:
        return options.side, []
    if options.reference is not None:
        told = str(read_arrays(options.reference).get("side", ""))
        if told in ("left", "right"):
            return told, []
    return None, ["Which side the segments are of is not said: signs are a right side's. Give --side."]

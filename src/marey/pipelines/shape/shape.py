"""`marey shape`: fit a person's own body of metaballs, and its motion, to the measured surface of a trial."""

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from marey.arrays import Floats, Mask
from marey.body.articulation.pose import Pose, PosedBody, packed_poses, unpacked_poses
from marey.body.articulation.surface import Body
from marey.body.metaballs.metaball_person import required_metaballs, reshaped
from marey.body.metaballs.metaball_skin import MetaballSkin
from marey.body.metaballs.segment_measures import MOST_GIRTH_SD, STATIONS, SegmentMeasures, segment_measures
from marey.body.metaballs.spline_skin import spline_body
from marey.errors import FileProblem, MareyError
from marey.fit.points.lost_points import expected_by_skin
from marey.fit.points.person_tracks import PersonTracks
from marey.fit.points.shape import (
    DETAILS_IN_TURN,
    ShapeEstimate,
    ShapeSettings,
    SurfaceMeasurements,
    evenly_spaced,
    final_covariances,
    has_simple_limbs,
    measured_segments,
    more_detailed,
    refine_shape,
)
from marey.fit.points.shape_start import extend_by_trajectories, start_from_clicked_joints, start_from_person
from marey.fit.points.surface_points import FramePoints, PersonPoints, thinned_evenly
from marey.fit.recipes.person import SilhouetteTake
from marey.fit.recipes.sequence import refine_in_pieces
from marey.fit.recipes.start_joints import clicked_joints, start_from_joints
from marey.fit.solver.picture_times import PictureTimes
from marey.io.gltf.glb import write_glb
from marey.io.npz import read_motion
from marey.io.results.body import segment_lengths
from marey.io.results.csv import write_segments
from marey.io.shapes.measured_surface import read_surface
from marey.io.shapes.trajectories import read_trajectories
from marey.io.stages import Arrays
from marey.io.trial.trial import Trial, read_trial
from marey.motion.from_fit import MeasuredPiece, measure_piece
from marey.observations.observation import Observation
from marey.pipelines.capture.capture import follow_person, refined_person
from marey.pipelines.capture.motion import Motion, load_motion
from marey.pipelines.capture.results import Refined
from marey.pipelines.capture.results import write_capture as write_results_of
from marey.pipelines.capture.run import CAPTURE_RESULTS, CORRECTED_CAMERAS, Bodies, Logs, Run, opened, require_usable
from marey.pipelines.capture.settings import CaptureSettings
from marey.pipelines.capture.tracked import FollowedPerson, Tracked, rounds_of
from marey.pipelines.people.choice import given_start
from marey.pipelines.progress import Progress
from marey.pipelines.run_details import writable_folder
from marey.pipelines.silhouettes import drawn_surface
from marey.pipelines.silhouettes.mask_store import MaskStore
from marey.pipelines.surface.settings import SurfaceOptions
from marey.pipelines.surface.surface import surface_of_trial
from marey.pipelines.surface.tracks import follow_measured, tracks_text, write_tracks
from marey.pipelines.verdict import Verdict, VerdictReason
from marey.surface.tracks.filters import FilterSettings
from marey.surface.tracks.trajectories import Trajectories
from marey.view.pages.curves import NumberTable
from marey.view.pages.problems import readable
from marey.view.pages.segment_table import segment_tables
from marey.wording import listed

SURFACE = ("surface.npz", "trajectories.npz")
"""Files of `marey surface` that the fit reads."""
KEPT = (*SURFACE, "surface.ply", "surface.html", CORRECTED_CAMERAS, "surface_*.png", "tracks_*.png", "surface/*.ply")
"""All files of `marey surface`; they are kept among the results."""
SEEN_M = 0.010
"""Distance from a measured point within which the skin counts as measured [m].

Chosen by hand; results were not measured against other values.
"""
LAST_ROUNDS = 2
"""Rounds of matching and solving in the last refinement of shape and motion.

Chosen by hand; results were not measured against other values.
"""
SILHOUETTES_ALONE = (
    "The shape is fitted to the silhouettes alone: hollows, and all that no outline shows, follow from the bodies of "
    "other people. The intervals of girths, volumes and masses do not include this."
)
"""What the lack of a measured surface costs."""
KEPT_SKINS = 400
"""Number of frames whose posed skin is kept for the results, which bounds the memory to 100 MB with the 10,000 vertices
of a person. Chosen by hand."""

Clicked = Mapping[int, Sequence[Observation]]
"""Clicked joints, by frame."""


def shape_trial(trial: Trial, settings: CaptureSettings, progress: Progress) -> Motion:
    """Fit a person's own body to the measured surface and the silhouettes of a trial.

    Args:
        trial: The trial, opened with `settings.changes()`.
        settings: Settings of the run.
        progress: Progress reporter; it keeps timings and warnings.

    Returns:
        The motion with its body, whose files are in `settings.out`, or in `marey/` in the trial.

    Raises:
        FileProblem: Something in the trial cannot be used.
    """
    out = settings.out or trial.folder / "marey"
    reasons: list[VerdictReason] = []
    results = (*CAPTURE_RESULTS, "skin.glb")
    with writable_folder(out, (), results=results):
        pass
    if not (out / SURFACE[0]).is_file():
        require_usable(trial, settings)
        reasons = measure(trial, out, progress)
    measured_files = [out / name for name in SURFACE if (out / name).is_file()]
    with opened(
        trial, settings, progress, more=measured_files, corrected=out / CORRECTED_CAMERAS, results=results
    ) as opened_run:
        run, bodies, logs = opened_run
        run.reasons.extend(reasons)
        points = points_of(run, out / SURFACE[0])
        tracks = read_trajectories(out / SURFACE[1]) if (out / SURFACE[1]).is_file() else None
        followed, begun, clicked = begin(run, bodies, logs, points, tracks)
        few = {f: thinned_evenly(given, ShapeSettings().points_a_frame) for f, given in points.items()}
        given = SurfaceMeasurements(
            PersonPoints(by_frame=few), None if tracks is None else PersonTracks.of(tracks), clicked
        )
        shaped = fitted(run, followed, begun, given)
        write_shape(run, followed, shaped, points)
    return load_motion(out)


def measure(trial: Trial, out: Path, progress: Progress) -> list[VerdictReason]:
    """Measure the surface first, as `marey surface` does; warn if there is none that can be measured.

    Args:
        trial: The trial.
        out: Folder for the results.
        progress: Progress reporter.

    Returns:
        What limits the use of the shape.
    """
    options = SurfaceOptions(out=out, cameras=trial.settings.cameras, frames=trial.settings.frames)
    try:
        surface = surface_of_trial(read_trial(trial.folder, **options.changes()), options, progress)
    except FileProblem as problem:
        if problem.resumes:
            raise
        why = f"{problem.path} {problem.wrong}. {problem.remedy}".strip()
        reason = VerdictReason.limit(f"No surface was measured: {why}", SILHOUETTES_ALONE)
        progress.warn(str(reason))
        return [reason]
    found = surface.verdict or Verdict()
    return [
        VerdictReason.limit(f"The measured surface: {each.what}", each.remedy, cameras=each.cameras)
        for each in found.reasons if each.level != "good"
    ]  # fmt: skip


def points_of(run: Run, path: Path) -> dict[int, FramePoints]:
    """Read the measured points by frame of the take; empty if nothing was measured."""
    if not path.is_file():
        return {}
    surface, take = read_surface(path), run.trial.take
    found = {}
    for frame in surface.frames:
        if take.first <= frame < take.end:
            own = surface.of_frame(int(frame))
            found[int(frame)] = FramePoints(np.array(own.points), np.array(own.covariance))
    return found


def begin(
    run: Run, bodies: Bodies, logs: Logs, points: Mapping[int, FramePoints], tracks: Trajectories | None
) -> tuple[FollowedPerson, ShapeEstimate, Clicked]:
    """Find the person's motion, a first shape, and the clicked joints.

    With silhouettes this is done as in `marey capture`. Without a background, but with clicked joints, the motion is
    found from those, the points and their trajectories ([Plaenkers1999] section 4.2).

    Args:
        run: The run.
        bodies: The body with many and with few vertices.
        logs: Storage of the silhouettes.
        points: Measured points by frame.
        tracks: Trajectories of points; None without any.

    Returns:
        The tracked person, its first shape, and clicked joints by frame.
    """
    trial = run.trial
    if trial.start is not None and points and not trial.masks and not trial.background:
        return begin_by_points(run, bodies, logs, points, tracks)
    followed = follow_person(run, bodies, logs)
    refined = refined_person(run, followed, bodies)
    return followed, start_from_person(refined.body, refined.poses, ShapeSettings()), {}


def begin_by_points(
    run: Run, bodies: Bodies, logs: Logs, points: Mapping[int, FramePoints], tracks: Trajectories | None
) -> tuple[FollowedPerson, ShapeEstimate, Clicked]:
    """Start from clicked joints, and follow the trajectories from there.

    Args:
        run: The run.
        bodies: The body with many and with few vertices.
        logs: Storage of the silhouettes.
        points: Measured points by frame.
        tracks: Trajectories of points; None without any.

    Returns:
        The tracked person, its first shape, and clicked joints by frame.

    Raises:
        FileProblem: There are several frames but no trajectories, or the clicked frame has no points.
    """
    trial, settings = run.trial, ShapeSettings()
    wanted = "First run `marey surface` with the same folder for its results; it also follows the points."
    if tracks is None and len(points) > 1:
        raise FileProblem(run.out / SURFACE[1], "does not exist, and there are no silhouettes", wanted)
    outlines = no_outlines(run, logs)
    joints = given_start(trial)
    assert joints is not None
    if joints.frame not in points:
        remedy = "Click the joints in a frame whose surface was measured."
        raise FileProblem(trial.start or trial.folder, f"names frame {joints.frame}, which has no points", remedy)
    take = SilhouetteTake(tuple(trial.rig), outlines, tuple(points), trial.take.rate)
    with run.progress.stage("Start"):
        found = start_from_joints(take, joints.frame, joints.joint_names, joints.pixels, bodies.fine, run.person)[1]
        clicked = {joints.frame: clicked_joints(list(trial.rig), joints.joint_names, joints.pixels, found.posed)}
        begun = start_from_clicked_joints(found.posed, clicked, points, settings)
    if tracks is not None:
        inside = [row for row, f in enumerate(tracks.frames) if trial.take.first <= f < trial.take.end]
        position = tracks.position[inside][:, ~tracks.removed]
        with run.progress.stage("Motion by trajectories", len(inside)) as step:
            begun = extend_by_trajectories(
                begun, tracks.frames[inside], position, points, settings, progress=lambda frame: step()
            )  # fmt: skip
    tracked = Tracked(begun.body, begun.poses, dict.fromkeys(begun.poses, 1.0))
    return FollowedPerson(tracked, {}, outlines, tuple(points)), begun, clicked


def no_outlines(run: Run, logs: Logs) -> MaskStore:
    """Store empty silhouettes for every frame, and return them."""
    cameras = list(run.trial.rig)
    store = MaskStore(logs.outlines, run.trial.take.first, cameras)
    empty = [np.zeros((camera.height, camera.width), bool) for camera in cameras]
    for _ in range(len(store.frames), run.trial.take.end - run.trial.take.first):
        store.append(empty)
    return store


@dataclass(frozen=True, eq=False)
class Fitted:
    """The fitted person."""

    body: Body
    poses: Mapping[int, Pose]
    pieces: Sequence[MeasuredPiece]
    shaped: ShapeEstimate


def fitted(run: Run, followed: FollowedPerson, begun: ShapeEstimate, given: SurfaceMeasurements) -> Fitted:
    """Fit the whole body, then single metaballs; refine the motion a last time."""
    settings = ShapeSettings()
    take = SilhouetteTake(
        tuple(run.trial.rig), followed.outlines, tuple(begun.poses), run.trial.take.rate, followed.outlines.edges
    )
    levels = take.levels(run.person.fine_height)
    # Simplified limbs are used only if the start has them: learned shapes are nearer (docs/accuracy/rejected.md).
    for i, detail in enumerate(DETAILS_IN_TURN if has_simple_limbs(begun.body) else DETAILS_IN_TURN[1:]):
        now = replace(begun, body=more_detailed(begun.body, detail, settings))
        scale = settings.begin_scale_m if i == 0 else np.inf

        def compute(now: ShapeEstimate = now, scale: float = scale, detail: str = detail) -> Arrays:
            total = settings.repeats * settings.rounds * len(now.poses)
            with run.progress.stage(f"Shape, {NAMES[detail]}", total) as step:
                return _packed(
                    refine_shape(
                        now, levels, given, rate=take.rate, repeats=settings.repeats, settings=settings, scale_m=scale,
                        times=run.times, progress=lambda frame: step(),
                    )
                )  # fmt: skip

        begun = _unpacked(run.cache.arrays(f"body_{detail}", compute, depends=run.scope), now)
    return _last(run, take, begun, given, settings)


NAMES = {"simple": "simplified limbs", "full": "whole body", "single": "single balls"}
"""Names of the fitted bodies for the progress display, by `DETAILS_IN_TURN`."""


def _last(
    run: Run, take: SilhouetteTake, begun: ShapeEstimate, given: SurfaceMeasurements, settings: ShapeSettings
) -> Fitted:
    measured_there = given.with_uncertainty(begun)
    levels = take.levels(run.person.fine_height)
    poses: dict[int, Pose] = {}
    body = begun.body
    with (
        rounds_of(run, "last") as memory,
        run.progress.stage("Motion and shape", LAST_ROUNDS * len(begun.poses)) as step,
    ):
        for fit in refine_in_pieces(
            list(begun.poses), list(begun.poses.values()), begun.body, levels,
            rate=take.rate, rounds=LAST_ROUNDS, shape_frames=evenly_spaced(list(begun.poses), settings.shape_frames),
            settings=replace(settings.sequence, sigma_px=begun.outline_sd_px),
            extra_terms=measured_there.terms_of_round, times=run.times, progress=lambda frame: step(),
            checkpoint=memory,
        ):  # fmt: skip
            poses |= fit.by_frame
            body = fit.body
    found = replace(begun, body=body, poses=poses)
    pieces: list[MeasuredPiece] = []
    with run.progress.stage("Standard deviations"):
        for fit in final_covariances(found, levels, measured_there, rate=take.rate, settings=settings, times=run.times):
            pieces.append(measure_piece(fit))
            body = fit.body
    return Fitted(body, poses, pieces, replace(found, body=body))


def _packed(found: ShapeEstimate) -> Arrays:
    return {
        "frames": np.array(list(found.poses)),
        **packed_poses(found.poses.values()),
        "numbers": np.array(found.body.numbers),
        "sds": np.array([found.model_sd_m, found.outline_sd_px, found.skin_sd_m]),
    }


def _unpacked(arrays: Arrays, begun: ShapeEstimate) -> ShapeEstimate:
    poses = dict(zip(map(int, arrays["frames"]), unpacked_poses(arrays), strict=True))
    return ShapeEstimate(reshaped(begun.body, arrays["numbers"]), poses, *map(float, arrays["sds"]))


def write_shape(run: Run, followed: FollowedPerson, found: Fitted, points: Mapping[int, FramePoints]) -> None:
    """Write the files of a capture, the skin with its measured part, and the table of segments."""
    skin = posed_skin(found.body, found.poses, run.times)
    refined = Refined(found.body, found.poses, found.pieces, frozenset())

    def more(folder: Path) -> list[NumberTable]:
        with run.progress.stage("Segments"):
            tables = write_table(folder, found.body, run.progress.warn)
        with run.progress.stage("Skin"):
            write_skin_glb(folder, found.body, run.progress.warn)
        keep(run.out, folder)
        if (folder / SURFACE[1]).is_file():
            find_lost_points(run, folder, skin, found)
        return tables

    write_results_of(
        run, refined, followed.outlines, followed.frames, command="shape", skin=skin,
        seen=seen_of(skin, points, run.trial.take.count, sorted(found.poses), run) if points else None, more=more,
    )  # fmt: skip


def find_lost_points(run: Run, folder: Path, skin: drawn_surface.PosedSkin, found: Fitted) -> None:
    """Follow the measured surface again with the body as a predictor of lost points, and write its trajectories.

    Args:
        run: The run.
        folder: The folder with the measured surface and its trajectories.
        skin: The skin of the fitted body in every frame.
        found: The fitted body, on which the checkpoints of the trajectories depend.
    """
    trial, surface = run.trial, read_surface(folder / SURFACE[0])
    if surface.camera_names != trial.rig.names:
        run.progress.warn("The surface was measured with other cameras: its trajectories are not extended.")
        return
    parts = [surface.of_frame(frame) for frame in range(trial.take.first, trial.take.end)]
    expected = expected_by_skin(
        lambda frame: skin.vertices_of(frame) if frame in found.poses else None, skin.faces
    )  # fmt: skip
    arrays = _packed(found.shaped)
    followed = follow_measured(
        trial.take, trial.rig, parts, run.cache, run.progress, filters=FilterSettings(), depends=(run.scope, arrays),
        expected=expected,
    )  # fmt: skip
    write_tracks(folder, followed, trial.take, trial.rig)
    run.progress.report(tracks_text(followed))


def write_skin_glb(folder: Path, body: Body, warn: Callable[[str], None]) -> None:
    """Write `skin.glb`: the closed skin over the person's metaballs, with the motion of `motion.npz` beside it.

    Args:
        folder: The folder, with the motion in it.
        body: A body of metaballs.
        warn: Called with the reason if the metaballs are not connected, so that there is no such skin.
    """
    try:
        skin = spline_body(body)
    except MareyError as error:
        warn(f"There is no skin.glb. {error}")
        return
    write_glb(folder / "skin.glb", skin, read_motion(folder / "motion.npz"))


def posed_skin(body: Body, poses: Mapping[int, Pose], times: PictureTimes | None = None) -> drawn_surface.PosedSkin:
    """Return the surface of the metaballs in every frame, which is finer than the triangles of the body.

    Args:
        body: The body.
        poses: Poses by frame.
        times: When the cameras have taken their pictures; None if that is at the instants of the frames. The rows of a
            rolling shutter are drawn at the instant of the picture.
    """
    skin = MetaballSkin(body)

    @lru_cache(maxsize=KEPT_SKINS)
    def vertices(frame: int) -> Floats:
        """Return the vertices of a frame; each of the results needs them again."""
        return skin.vertices(poses[frame])

    def late(frame: int, camera: int) -> Floats:
        assert times is not None
        return skin.vertices(times.posed(frame, PosedBody(body, poses[frame]), poses)[camera].pose)

    return drawn_surface.PosedSkin(skin.faces, vertices, None if times is None else late)


def seen_of(
    skin: drawn_surface.PosedSkin, points: Mapping[int, FramePoints], count: int, frames: Sequence[int], run: Run
) -> Iterator[Mask]:
    """Yield for every frame which vertices are near measured points; without points, which are on the rim."""
    nothing = np.zeros(drawn_surface.vertices_in(skin, frames), bool)
    for frame in range(count):
        if frame not in frames:
            yield nothing
        elif frame in points and len(points[frame]):
            away, _ = cKDTree(points[frame].points).query(skin.vertices_of(frame), distance_upper_bound=SEEN_M)
            yield away <= SEEN_M
        else:
            yield drawn_surface.on_rim(skin, frame, list(run.trial.rig))


def write_table(folder: Path, body: Body, warn: Callable[[str], None]) -> list[NumberTable]:
    """Write `segments.csv`, the measures of the segments that the preset follows, and return it for the report.

    Args:
        folder: The folder.
        body: A body of metaballs.
        warn: Called with the girths that are not determined, if there are any.
    """
    there = measured_segments(body)
    measures = segment_measures(required_metaballs(body), body.numbers, body.numbers_covariance, segments=there)
    length, length_sd = (values[there] for values in segment_lengths(body))
    write_segments(folder / "segments.csv", measures, length, length_sd)
    if measures.undetermined_girths.any():
        warn(_undetermined_text(measures))
    return segment_tables(measures, length, length_sd)


def _undetermined_text(measures: SegmentMeasures) -> str:
    """Name the girths that are not determined, with the reason."""
    places = []
    for station, lost in zip(STATIONS, measures.undetermined_girths.T, strict=True):
        names = [readable(name) for name, own in zip(measures.names, lost, strict=True) if own]
        places += [f"at {100 * station:.0f} % of the length of {listed(names)}"] if names else []
    return (
        f"Girths that are not determined and left out: {'; '.join(places)}. Their standard deviations "
        f"exceed {100 * MOST_GIRTH_SD:.0f} %, the spread among people of the same size, as near shoulders and hips, "
        "where a limb merges with the trunk."
    )


def keep(out: Path, folder: Path) -> None:
    """Copy the files of the measured surface to the new results."""
    for path in (path for pattern in KEPT for path in sorted(out.glob(pattern))):
        beside = folder / path.relative_to(out)
        beside.parent.mkdir(exist_ok=True)
        shutil.copyfile(path, beside)

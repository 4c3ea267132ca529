"""`marey capture`: the motion of a person from the videos of a trial."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from marey.arrays import Mask
from marey.body.articulation.pose import Pose
from marey.body.articulation.surface import Body
from marey.cameras.camera import Camera
from marey.errors import FileProblem
from marey.fit.recipes.hypotheses import with_alternatives
from marey.fit.recipes.person import (
    SilhouetteTake,
    TrackCheckpoint,
    interpolated_poses,
    refine_person,
    repair_person,
    start_person,
    track_person,
    unsupported_frames,
    with_shape,
)
from marey.fit.recipes.sequence import FrameTermsFactory
from marey.fit.recipes.start_joints import start_from_joints
from marey.fit.recipes.uncertainty import with_camera_contradictions
from marey.fit.search.search import Candidate
from marey.images.silhouettes.background import shrunk
from marey.io.calibration.readers import write_cameras_toml
from marey.io.results.results import write_results
from marey.io.stages import Arrays
from marey.io.trial.trial import Trial
from marey.motion.from_fit import MeasuredPiece, measure_piece, motion_of
from marey.motion.motion import BodyMotion
from marey.observations.observation import Observation
from marey.pipelines.cameras.knocked import CameraKnocked, find_knocked
from marey.pipelines.capture import drawn_surface, stages
from marey.pipelines.capture.by_regions import follow_by_regions, nothing_given, search_for_limbs, with_open_limbs
from marey.pipelines.capture.detected import DetectedPerson, detected_person
from marey.pipelines.capture.drawn import drawn_from_silhouettes
from marey.pipelines.capture.evidence import (
    first_silhouettes,
    person_evidence,
    with_evidence,
)
from marey.pipelines.capture.hypotheses import explored, undetermined, warn_of_alternatives
from marey.pipelines.capture.motion import Motion, load_motion
from marey.pipelines.capture.report import draw_overlays, report_capture
from marey.pipelines.capture.run import CAPTURE_RESULTS, CORRECTED_CAMERAS, Bodies, Logs, Run, opened
from marey.pipelines.capture.settings import CaptureSettings
from marey.pipelines.capture.tracked import (
    FollowedPerson,
    SilhouetteRound,
    Tracked,
    camera_errors,
    frames_for_sizes,
    pack_candidates,
    pack_tracked,
    report_found_camera,
    rounds_of,
    terms_for,
    track_patches,
    unpack_tracked,
    with_found_camera,
    with_occluders,
)
from marey.pipelines.capture.without_plate import follow_detected, follow_in_any_room
from marey.pipelines.clocks.disagreement import ClocksDisagree, require_common_clock
from marey.pipelines.consistency.check import check_cameras
from marey.pipelines.consistency.repairs import CamerasContradict, Repairs
from marey.pipelines.consistency.result import reasons_of
from marey.pipelines.consistency.unusable import write_not_usable
from marey.pipelines.kept_candidates import KeptCandidates
from marey.pipelines.occlusion.occluders import Occluders
from marey.pipelines.people.choice import given_start
from marey.pipelines.people.foreground import ForegroundPerson, foreground_person
from marey.pipelines.people.other_regions import CapturedPerson
from marey.pipelines.progress import Progress
from marey.pipelines.run_record import finished_together, write_record
from marey.pipelines.silhouettes.empty_rooms import cameras_without_image, in_small_pictures, model_backgrounds
from marey.pipelines.silhouettes.mask_store import MaskStore, separated
from marey.pipelines.verdict import NotUsable, Verdict, VerdictReason
from marey.view.pages.curves import NumberTable
from marey.view.pages.html import Still
from marey.wording import listed

SHAPE_ROUNDS = 4
"""Rounds of matching and solving in the first refinement of shape and motion.

Chosen by hand; results were not measured against other values.
"""
FINE_ROUNDS = 3
"""Rounds of matching and solving in the last refinement, in larger images.

Four or eight rounds change the joints of no take by more than 0.9 mm (docs/accuracy/rejected.md).
"""


MOST_REPAIRS = 4
"""Largest number of repairs of contradicting cameras, after which they are not checked again. Chosen by hand."""
CLEARLY_BETTER = 0.02
"""Gain of agreement for which a start from detected joints replaces one from silhouettes. The sizes of a body that is
fitted to detected joints are wrong by centimetres: `jacks` with plates has joint errors of 14.1 instead of 11.6 mm if
it always starts from them."""


def capture_trial(
    trial: Trial,
    settings: CaptureSettings,
    progress: Progress,
    *,
    observations: Mapping[int, Sequence[Observation]] | None = None,
    captured: Mapping[int, CapturedPerson] | None = None,
) -> Motion:
    """Capture the joint motion of the person in a trial.

    Args:
        trial: The trial, opened with `settings.changes()`.
        settings: Settings of the run.
        progress: Progress reporter; it keeps timings and warnings.
        observations: Further observations by frame, of any kind; they are used in the refinement of motion and body.
        captured: Other people of the trial that were captured before, by their numbers.

    Returns:
        The motion, whose files are in `settings.out`, or in `marey/` in the trial.

    Raises:
        FileProblem: Something in the trial cannot be used.
        NotUsable: The cameras contradict each other, and what is known of the cause does not repair it.
    """
    with_agreeing_cameras(trial, settings, progress, run_capture, observations=observations, captured=captured)
    return load_motion(settings.out or trial.folder / "marey")


def with_agreeing_cameras(
    trial: Trial, settings: CaptureSettings, progress: Progress, work: Callable[[Run, Bodies, Logs], None], *,
    observations: Mapping[int, Sequence[Observation]] | None = None,
    captured: Mapping[int, CapturedPerson] | None = None,
) -> None:  # fmt: skip
    """Do some work on a trial, again from the beginning with repaired cameras or clocks if the silhouettes show these.

    Args:
        trial: The trial, opened with `settings.changes()`.
        settings: Settings of the run.
        progress: Progress reporter.
        work: The work on an opened run.
        observations: Further observations by frame.
        captured: Other people of the trial that were captured before, by their numbers.

    Raises:
        NotUsable: The cameras contradict each other, and what is known of the cause does not repair it.
    """
    repairs = Repairs()
    while True:
        repaired = repairs.applied(trial)
        again = len(repairs.reasons) < MOST_REPAIRS
        checks_clocks = again and repaired.clocks is None and trial.settings.sync is None
        checks_cameras = again and trial.settings.check is None
        try:
            with opened(
                repaired, settings, progress, observations=observations, captured=captured, results=CAPTURE_RESULTS
            ) as (run, bodies, logs):  # fmt: skip
                run = replace(
                    run, repairs=repairs, moved=repairs.moved, checks_clocks=checks_clocks,
                    checks_cameras=checks_cameras,
                )  # fmt: skip
                work(run, bodies, logs)
            return
        except ClocksDisagree as found:
            progress.warn(str(found))
            reason = VerdictReason(level="good", what=str(found), cameras=found.apart, cause="late")
            more = Repairs(clocks=found.clocks, reasons=(reason,))
        except CameraKnocked as found:
            progress.warn(str(found))
            name = found.before.name
            reason = VerdictReason(
                level="usable with limits", what=str(found), cameras=(name,), remedy="Calibrate the cameras again.",
                cause="moved",
            )
            more = Repairs(cameras={name: found.rig[name]}, moved=found.before, reasons=(reason,))
        except CamerasContradict as found:
            progress.warn(str(found))
            more = found.repairs
        except NotUsable as problem:
            verdict = Verdict.of([*problem.verdict.reasons, *repairs.reasons])
            page = write_not_usable(settings.out or trial.folder / "marey", trial, verdict, progress)
            raise NotUsable(verdict, page) from problem
        repairs = repairs.then(more)


def run_capture(run: Run, bodies: Bodies, logs: Logs) -> None:
    """Run all stages: silhouettes, the person, silhouettes with the person as prior, the refined person, and results.

    Args:
        run: The run.
        bodies: The body with many and with few vertices.
        logs: Storage of the silhouettes.
    """
    followed = follow_person(run, bodies, logs)
    run = replace(run, trial=replace(run.trial, rig=followed.rig or run.trial.rig))
    refined = refined_person(run, followed, bodies)

    def cameras(folder: Path) -> None:
        if run.moved is not None:
            write_cameras_toml(run.trial.rig, folder / CORRECTED_CAMERAS)

    write_capture(
        run, refined, followed.outlines, followed.frames, rounds=followed.rounds, more=cameras,
        occluders=followed.occluders,
    )  # fmt: skip


def follow_person(run: Run, bodies: Bodies, logs: Logs) -> FollowedPerson:
    """Find silhouettes, a person's poses in every frame, and silhouettes with the person as prior."""
    trial, progress = run.trial, run.progress
    detected = detected_person(run)
    terms = terms_for(run, detected)
    bare = not trial.masks and bool(cameras_without_image(trial))
    if detected is not None and (bare or (detected.people > 1 and not trial.masks)):
        followed = follow_detected(run, bodies, logs, detected, terms)
        return with_open_limbs(run, bodies, followed, detected)
    if nothing_given(trial):
        return follow_by_regions(run, bodies, logs, terms)
    cameras, first = list(trial.rig), trial.take.first
    outlines, small = MaskStore(logs.outlines, first, cameras), cameras
    if trial.masks:
        stages.known_silhouettes(trial, outlines, progress)
        store = outlines
        if trial.network is not None:
            progress.warn("The network is not used: the given silhouettes are final.")
    elif bare:
        store, small = first_silhouettes(run, logs.first)
    else:
        models, small = model_backgrounds(trial, progress)
        store = MaskStore(logs.first, first, small)
        views = [stages.SilhouetteState(shrunk(m, c.size)) for m, c in zip(models, small, strict=True)]
        stages.find_silhouettes(trial, views, small, store, progress, name="Silhouettes")
    frames = stages.frames_with_somebody(store)
    stages.require_somebody(trial, frames)
    if not bare:
        _check_cameras(run, store, small, frames)
    elif run.checks_clocks:
        _require_common_clock(run, store, small, frames)
    apart = _apart(run, store, small, frames, detected) if not bare or trial.follow is not None else None
    if apart is not None:
        store = separated(store, small, apart, MaskStore(logs.common, first, small), progress)
        outlines = store if trial.masks else outlines
        frames = stages.frames_with_somebody(store)
        stages.require_somebody(trial, frames)
    elif not trial.masks:
        cut = stages.cut_in(store, small, frames)
        if stages.cluttered(store, small, frames, progress, cut):
            store = stages.common_silhouettes(store, small, MaskStore(logs.common, first, small), progress, cut)
            frames = stages.frames_with_somebody(store)
            stages.require_somebody(trial, frames)
    take = SilhouetteTake(tuple(small), store, frames, trial.take.rate, hidden_of=store.hidden, times=run.times)
    tracked = _tracked(run, take, bodies, detected, terms)
    if run.moved is not None:
        run, take, tracked, _ = with_found_camera(run, take, tracked, height=run.person.track_height, detected=detected)
        cameras, small, terms = list(run.trial.rig), list(take.cameras), terms_for(run, detected)
    occluders = None
    if not bare and apart is None and not trial.masks:
        tracked, occluders = with_occluders(run, take, tracked, bodies, terms)
    filled = interpolated_poses(tracked.poses, longest=run.person.bridge * trial.take.rate)
    known = dict(sorted({**tracked.poses, **filled}.items()))
    stages.warn_of_lost(progress, frames, known, count=trial.take.count)
    if bare or (apart is not None and not trial.masks):
        return _in_turn(run, bodies, logs, replace(tracked, poses=known), take, terms, apart, filled=filled)
    if not trial.masks:
        views = [stages.SilhouetteState(model) for model in models]
        predicted = stages.expectations(tracked.body, known, cameras, small, run.times, occluders)
        with person_evidence(run, tracked.body, known) as evidence:
            predicted = with_evidence(predicted, evidence)
            stages.find_silhouettes(trial, views, cameras, outlines, progress, name="Outlines", predicted=predicted)
    tracked = replace(tracked, poses=known)
    covariance = None
    if run.moved is not None:
        whole = SilhouetteTake(
            tuple(cameras), outlines, tuple(known), trial.take.rate, outlines.edges, outlines.hidden, run.times
        )
        run, _, tracked, covariance = with_found_camera(
            run, whole, tracked, height=run.person.fine_height, detected=detected
        )
        report_found_camera(run, covariance)
        terms = terms_for(run, detected)
    return FollowedPerson(
        tracked, filled, outlines, frames, terms=terms, repaired=apart is None, rig=run.trial.rig,
        camera_covariance=covariance, occluders=occluders,
    )  # fmt: skip


def _in_turn(
    run: Run, bodies: Bodies, logs: Logs, tracked: Tracked, take: SilhouetteTake, terms: FrameTermsFactory | None,
    apart: ForegroundPerson | None, *, filled: Mapping[int, Pose],
) -> FollowedPerson:  # fmt: skip
    """Estimate silhouettes and motion in turn, from a person who was tracked in the first silhouettes."""
    drawn, repaired = drawn_from_silhouettes(run, tracked, take, terms), None
    if apart is not None:
        drawn, repaired = replace(drawn, others=run.with_captured(apart.rough)), search_for_limbs(run, bodies)
    return follow_in_any_room(run, logs, drawn, terms, frames=take.frames, filled=filled, repaired=repaired)


def _check_cameras(run: Run, store: MaskStore, small: Sequence[Camera], frames: Sequence[int]) -> None:
    """Check that the first silhouettes of all cameras agree; see `check_cameras` and `require_common_clock`.

    Raises:
        CameraKnocked: One camera was moved, and is found again; it is used instead of being left out.
    """
    found: list[VerdictReason] = []
    if run.checks_cameras:
        with run.progress.stage("Check of cameras"):
            try:
                found = check_cameras(
                    small, list(run.trial.rig), frames, store.frames, store.of_camera, rate=run.trial.take.rate,
                    clocks=run.trial.clocks is None and run.trial.settings.sync != "off",
                    shutter=run.trial.shutter,
                )  # fmt: skip
            except CamerasContradict as contradiction:
                knocked = None
                if contradiction.moved is not None and run.repairs.moved is None:
                    knocked = find_knocked(small, frames, store.of_camera)
                if knocked is None or knocked.number != contradiction.moved:
                    raise
                raise CameraKnocked(run.trial.rig, knocked) from None
    for reason in found:
        run.progress.warn(str(reason))
    run.reasons.extend(found)
    if run.checks_clocks:
        _require_common_clock(run, store, small, frames)


def _require_common_clock(run: Run, store: MaskStore, small: Sequence[Camera], frames: Sequence[int]) -> None:
    """Check that the first silhouettes of all cameras show the same instants; see `require_common_clock`."""
    with run.progress.stage("Clocks"):
        shown = range(min(frames), max(frames) + 1)
        warning = require_common_clock(
            small, shown, store.of_camera, rate=run.trial.take.rate, shutter=run.trial.shutter
        )
    if warning is not None:
        run.progress.warn(warning)
        run.reasons.append(VerdictReason.limit(warning, "Run `marey sync`.", cause="late"))


def _apart(
    run: Run, store: MaskStore, cameras: Sequence[Camera], frames: Sequence[int], detected: DetectedPerson | None
) -> ForegroundPerson | None:
    """Return the person to follow if the silhouettes show several people; None for a single one."""
    track = None if detected is None else detected.track
    return foreground_person(run.trial, cameras, store, frames, run.progress, track, run.captured)


def _tracked(
    run: Run, take: SilhouetteTake, bodies: Bodies, detected: DetectedPerson | None, terms: FrameTermsFactory | None
) -> Tracked:
    """Find the start, track the person, and estimate the shape."""
    person, progress, cache = run.person, run.progress, run.cache
    free = bodies.held() if run.settings.fixed_sizes else bodies

    def start() -> Arrays:
        count = min(person.start_frames, len(take.frames))
        with (
            cache.frames("start_frames", depends=run.scope) as log,
            progress.stage("Start", count) as step,
        ):
            kept = KeptCandidates(log, free.fine)
            frame, found = begin(run, take, free, kept, detected, done=lambda frame: step())
        return pack_candidates({frame: found}, bodies.fine if run.settings.fixed_sizes else found.posed.body)

    def follow() -> Arrays:
        begun = unpack_tracked(cache.arrays("start", start, depends=run.scope), bodies.fine)
        frame = next(iter(begun.poses))
        with (
            cache.frames("tracked_frames", depends=run.scope) as tracked,
            cache.frames("picked_up_frames", depends=run.scope) as picked,
            cache.frames("repaired_frames", depends=run.scope) as repaired,
            progress.stage("Tracking", len(take.frames)) as step,
        ):
            memory = TrackCheckpoint(
                KeptCandidates(tracked, begun.body),
                KeptCandidates(picked, begun.body),
                KeptCandidates(repaired, begun.body),
            )
            found = track_person(
                take, begun.body, with_shape(begun.body, bodies.coarse), (frame, begun.poses[frame]), person,
                progress=lambda frame: step(), checkpoint=memory,
            )  # fmt: skip
        return pack_candidates(found, begun.body)

    def shape() -> Arrays:
        followed = unpack_tracked(cache.arrays("tracked", follow, depends=run.scope), bodies.fine)
        poses: dict[int, Pose] = {}
        with (
            rounds_of(run, "shape") as memory,
            progress.stage("Shape and motion", SHAPE_ROUNDS * len(followed.poses)) as step,
        ):
            for fit in refine_person(
                take, followed.body, followed.poses, frames_for_sizes(run, followed.scores), person,
                height=person.track_height, rounds=SHAPE_ROUNDS, extra_terms=terms,
                progress=lambda frame: step(), checkpoint=memory,
            ):  # fmt: skip
                poses |= fit.by_frame
            # This frees space on the disk; a round is soon repeated if the run ends at this point.
            memory.parts.clear()
        return pack_tracked(poses, fit.body, followed.scores)

    found = unpack_tracked(cache.arrays("shape", shape, depends=run.scope), bodies.fine)
    take.forget()
    return found


def begin(
    run: Run,
    take: SilhouetteTake,
    bodies: Bodies,
    kept: KeptCandidates[Any],
    detected: DetectedPerson | None = None,
    *,
    done: Callable[[int], None],
) -> tuple[int, Candidate]:
    """Find the start, from given or detected joints or without any.

    Args:
        run: The run.
        take: Cameras and silhouettes.
        bodies: The body with many and with few vertices.
        kept: Receives the candidates.
        detected: The person whose joints were detected.
        done: Called with each frame that was tried.

    Returns:
        The frame, and the body's pose in it.

    Raises:
        FileProblem: The silhouettes have nothing in common, or the person lies or hangs head down although the user
            has not named the axis that points up.
    """
    trial = run.trial
    joints = given_start(trial)
    if joints is not None:
        found: tuple[int, Candidate] | None = start_from_joints(
            take,
            joints.frame,
            joints.joint_names,
            in_small_pictures(joints.pixels, list(trial.rig), take.cameras),
            bodies.fine,
            run.person,
        )
        done(joints.frame)
    else:
        found = start_person(take, bodies.coarse, bodies.fine, run.person, progress=done, checkpoint=kept)
        found = better_start(run, take, bodies, found, detected)
    if found is None:
        remedy = "Check that all cameras are calibrated in one world, and that the silhouettes show the person."
        raise FileProblem(trial.folder, "has silhouettes that no point in space projects into in all cameras", remedy)
    stages.require_upright(trial, found[1].posed)
    return found


def better_start(
    run: Run,
    take: SilhouetteTake,
    bodies: Bodies,
    found: tuple[int, Candidate] | None,
    detected: DetectedPerson | None,
) -> tuple[int, Candidate] | None:
    """Return the start from detected joints if it agrees clearly better with the silhouettes than the one from them.

    Args:
        run: The run.
        take: Cameras and silhouettes.
        bodies: The body with many and with few vertices.
        found: The start from silhouettes alone; None if there is none.
        detected: The person whose joints were detected.
    """
    best = None if detected is None else detected.clearest(take.frames)
    if detected is None or best is None:
        return found
    pixels = in_small_pictures(detected.agreeing_pixels(best), list(run.trial.rig), take.cameras)
    other = start_from_joints(take, best, detected.joints.joint_names, pixels, bodies.fine, run.person)
    return other if found is None or other[1].score > found[1].score + CLEARLY_BETTER else found


@dataclass(frozen=True, eq=False)
class Refined:
    """The final motion and body."""

    body: Body
    poses: Mapping[int, Pose]
    pieces: Sequence[MeasuredPiece]
    filled: frozenset[int]
    """Frames whose pose depends on their neighbours only."""
    tracks: Mapping[str, tuple[int, float]] | None = None
    """Number of tracked patches of the surface and their mean length in frames, by segment; None without tracking."""


def refined_person(run: Run, followed: FollowedPerson, bodies: Bodies) -> Refined:
    """Repair single frames and refine the whole motion, with the better body and silhouettes.

    Interpolated frames count as measured if the better silhouettes agree with them.

    Args:
        run: The run.
        followed: The tracked person.
        bodies: The body with many and with few vertices.

    Returns:
        The refined motion and body.
    """
    person, take, tracked = run.person, followed.take(run), followed.tracked
    unused = [str(frame) for frame in sorted(run.observations) if frame not in tracked.poses]
    if unused:
        run.progress.warn(f"Observations of frames without a pose are not used: {', '.join(unused)}.")
    poses = dict(tracked.poses)
    if followed.repaired:
        with (
            run.cache.frames("repaired_before_refinement", depends=run.scope) as log,
            run.progress.stage("Repair of frames"),
        ):
            poses = repair_person(
                take, tracked.body, with_shape(tracked.body, bodies.coarse), tracked.poses, person,
                checkpoint=KeptCandidates(log, tracked.body),
            )  # fmt: skip
    usual = float(np.median(list(tracked.scores.values())))
    blind = unsupported_frames(take, tracked.body, poses, followed.filled, person, usual=usual)
    terms = followed.terms
    alternatives = followed.alternatives
    if followed.repaired:
        poses, alternatives = explored(run, take, tracked.body, bodies, poses)
    else:
        warn_of_alternatives(run.progress, alternatives)
    tracks = None
    if run.settings.surface_tracks:
        poses, terms, tracks = track_patches(run, take, tracked.body, poses, terms)
    take.forget()
    found: dict[int, Pose] = {}
    pieces = []
    with (
        rounds_of(run, "refined") as memory,
        run.progress.stage("Refinement", FINE_ROUNDS * len(poses)) as step,
    ):
        for fit in refine_person(
            take, tracked.body, poses, frames_for_sizes(run, tracked.scores), person,
            height=person.fine_height, rounds=FINE_ROUNDS, ignored_frames=blind, extra_terms=terms,
            cameras=camera_errors(run, followed.camera_covariance), progress=lambda frame: step(), checkpoint=memory,
        ):  # fmt: skip
            found |= fit.by_frame
            fit = with_camera_contradictions(fit, rate=take.rate)
            piece = measure_piece(with_alternatives(fit, alternatives))
            pieces.append(undetermined(piece, alternatives))
    return Refined(fit.body, found, pieces, frozenset(blind), tracks)


def write_capture(
    run: Run, refined: Refined, store: MaskStore, frames: Sequence[int], *, command: str = "capture",
    skin: drawn_surface.PosedSkin | None = None, seen: Iterable[Mask] | None = None,
    rounds: Sequence[SilhouetteRound] = (),
    more: Callable[[Path], Sequence[NumberTable] | None] = lambda folder: None, occluders: Occluders | None = None,
) -> None:  # fmt: skip
    """Write all results at once.

    Args:
        run: The run.
        refined: The motion and the body.
        store: The silhouettes.
        frames: Frames that show a person.
        command: The command, for the record.
        skin: A skin other than the body's own.
        seen: For each frame of the video which vertices of the skin were measured; by default those on the rim of the
            surface.
        rounds: The course of silhouettes and pose, if they were estimated in turn.
        more: Writes further files to the folder that it is given, and may return further tables for the report.
        occluders: Things of the room in front of the person; None if they were not searched for.
    """
    trial, progress, take = run.trial, run.progress, run.trial.take
    cameras, body, poses = list(trial.rig), refined.body, refined.poses
    lost = np.zeros(take.count, bool)
    lost[[frame for frame in frames if frame not in poses]] = True
    known, skin = sorted(poses), skin or drawn_surface.PosedSkin.of(body, poses, run.times)
    drawn = drawn_surface.surface_masks(skin, known, cameras)
    with finished_together(run.out) as folder:
        with progress.stage("Comparison", len(poses)) as step:
            agreement = drawn_surface.agreements(drawn, poses, store, done=step)
            hidden = drawn_surface.hidden_shares(drawn, known, store, occluders, trial.rig.names)
        motion = motion_of(
            refined.pieces, body, count=take.count, rate=take.rate, lost=lost, camera_names=trial.rig.names,
            agreement=agreement, filled=refined.filled,
        )  # fmt: skip
        if hidden:
            parts = [f"{100 * share.person:.0f} % in {name}" for name, share in hidden.items() if share.person > 0]
            progress.report(f"Hidden part of the person: {listed(parts)}")
        with progress.stage("Results"):
            drawn_surface.write_all_masks(folder, trial, store, drawn)
            write_results(
                folder, motion, body, preset=trial.settings.preset or "full", mass_kg=trial.settings.mass_kg,
                skin=drawn_surface.skins(skin, known, take.count), skin_faces=skin.faces,
                seen=seen or drawn_surface.seen_vertices(skin, known, cameras, take.count),
            )  # fmt: skip
            tables = more(folder) or ()
        effective = {"preset": "full"} | trial.settings.model_dump(mode="json", exclude_none=True)
        effective |= {"body": str(run.settings.body)} if run.settings.body else {}
        effective |= {} if run.settings.surface_tracks else {"surface_tracks": False}
        effective |= {"fixed_sizes": True} if run.settings.fixed_sizes else {}
        effective |= {} if run.settings.camera_uncertainty else {"camera_uncertainty": False}
        show, stills = store.known, list[Still]()
        if run.settings.overlay:
            stills = draw_overlays(
                trial, body, poses, motion, show, folder=folder, progress=progress, times=run.times,
                hidden_of=store.known_hidden,
            )  # fmt: skip
        verdict = verdict_of(run, motion, body)
        report_capture(
            trial, motion, body, show, stills=stills, settings=effective, rounds=rounds, folder=folder,
            progress=progress, verdict=verdict, tracks=refined.tracks, hidden=hidden, command=command,
            tables=tables,
        )  # fmt: skip
        write_record(
            folder, command=command, settings=effective, inputs=trial.input_files, root=trial.folder, progress=progress,
            verdict=verdict,
            more=({"silhouette_rounds": [asdict(each) for each in rounds]} if rounds else {})
            | ({"hidden": {name: asdict(share) for name, share in hidden.items()}} if hidden else {})
            | ({} if refined.tracks is None else {"surface_tracks": _tracks_record(refined.tracks)}),
        )  # fmt: skip


def _tracks_record(tracks: Mapping[str, tuple[int, float]]) -> dict[str, dict[str, float]]:
    return {name: {"count": count, "mean_frames": round(length, 1)} for name, (count, length) in tracks.items()}


def verdict_of(run: Run, motion: BodyMotion, body: Body) -> Verdict:
    """Return the verdict on a motion, from what was repaired before the run and found in it, and from the motion."""
    selected = range(run.trial.take.first, run.trial.take.end)
    own = reasons_of(motion, body, selected, preset=run.trial.settings.preset or "full")
    return Verdict.of([*run.repairs.reasons, *run.reasons, *own])

"""`marey capture`: the motion of a person from the videos of a trial."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.pose import Pose
from marey.cameras.camera import Camera
from marey.fit.recipes.hypotheses import with_alternatives
from marey.fit.recipes.person import (
    SilhouetteTake,
    interpolated_poses,
    refine_person,
    repair_person,
    unsupported_frames,
    with_shape,
)
from marey.fit.recipes.sequence_equations import FrameTermsFactory
from marey.fit.recipes.uncertainty import with_camera_contradictions, with_unusual_shoulders
from marey.images.silhouettes.background import Background, shrunk
from marey.io.calibration.readers import write_cameras_toml
from marey.io.stages import Arrays
from marey.io.trial.trial import Trial
from marey.motion.from_fit import measure_piece
from marey.observations.observation import Observation
from marey.pipelines.cameras.knocked import CameraKnocked, find_knocked
from marey.pipelines.capture.begun import tracked_in_silhouettes
from marey.pipelines.capture.by_regions import follow_by_regions, nothing_given, search_for_limbs, with_open_limbs
from marey.pipelines.capture.detected import DetectedPerson, detected_person
from marey.pipelines.capture.drawn import drawn_from_silhouettes
from marey.pipelines.capture.evidence import (
    first_silhouettes,
    person_evidence,
    with_evidence,
)
from marey.pipelines.capture.hypotheses import (
    explored,
    mostly_ambiguous,
    undetermined,
    warn_of_alternatives,
    with_better_answers,
)
from marey.pipelines.capture.motion import Motion, load_motion
from marey.pipelines.capture.results import Refined, write_capture
from marey.pipelines.capture.run import CAPTURE_RESULTS, CORRECTED_CAMERAS, Bodies, Logs, Run, opened
from marey.pipelines.capture.settings import CaptureSettings
from marey.pipelines.capture.tracked import (
    FollowedPerson,
    Tracked,
    camera_errors,
    frames_for_sizes,
    report_found_camera,
    rounds_of,
    terms_for,
    track_patches,
    with_found_camera,
    with_occluders,
    with_placed_hips,
)
from marey.pipelines.capture.without_plate import follow_detected, follow_in_any_room
from marey.pipelines.clocks.disagreement import ClocksDisagree, require_common_clock
from marey.pipelines.consistency.check import check_cameras
from marey.pipelines.consistency.repairs import CamerasContradict, Repairs
from marey.pipelines.consistency.unusable import write_not_usable
from marey.pipelines.kept_candidates import KeptCandidates
from marey.pipelines.occlusion.occluders import Occluders
from marey.pipelines.people.foreground import ForegroundPerson, foreground_person
from marey.pipelines.people.other_regions import CapturedPerson
from marey.pipelines.progress import Progress
from marey.pipelines.silhouettes import stages
from marey.pipelines.silhouettes.empty_rooms import cameras_without_image, model_backgrounds
from marey.pipelines.silhouettes.mask_store import MaskStore, separated
from marey.pipelines.verdict import NotUsable, Verdict, VerdictReason

FINE_ROUNDS = 3
"""Rounds of matching and solving in the last refinement, in larger images.

Four or eight rounds change the joints of no take by more than 0.9 mm (docs/accuracy/rejected.md).
"""


MOST_REPAIRS = 4
"""Largest number of repairs of contradicting cameras, after which they are not checked again. Chosen by hand."""


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
    captured: Mapping[int, CapturedPerson] | None = None, results: Sequence[str] = CAPTURE_RESULTS,
) -> None:  # fmt: skip
    """Do some work on a trial, again from the beginning with repaired cameras or clocks if the silhouettes show these.

    Args:
        trial: The trial, opened with `settings.changes()`.
        settings: Settings of the run.
        progress: Progress reporter.
        work: The work on an opened run.
        observations: Further observations by frame.
        captured: Other people of the trial that were captured before, by their numbers.
        results: Names of files that the work writes in any case; those of the user are not replaced.

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
                repaired, settings, progress, observations=observations, captured=captured, results=results
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
                level="usable with limits",
                what=str(found),
                cameras=(name,),
                remedy="Calibrate the cameras again.",
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


@dataclass(frozen=True, eq=False, kw_only=True)
class _FirstSilhouettes:
    """Silhouettes that were found before anything is known of the body."""

    store: MaskStore
    """The silhouettes of the person to follow, or of everybody."""
    cameras: Sequence[Camera]
    """The cameras with the size of the images in which the silhouettes were found."""
    frames: Sequence[int]
    """Frames that show somebody."""
    models: Sequence[Background]
    """Background of each camera in full images; none for given silhouettes and without images of the empty room."""
    apart: ForegroundPerson | None
    """The person to follow, if the silhouettes show several people."""


def follow_person(run: Run, bodies: Bodies, logs: Logs) -> FollowedPerson:
    """Find silhouettes, a person's poses in every frame, and silhouettes with the person as prior."""
    trial = run.trial
    detected = detected_person(run)
    terms = terms_for(run, detected)
    bare = not trial.masks and bool(cameras_without_image(trial))
    if detected is not None and (bare or (detected.people > 1 and not trial.masks)):
        followed = follow_detected(run, bodies, logs, detected, terms)
        return with_open_limbs(run, bodies, followed, detected)
    if nothing_given(trial):
        return follow_by_regions(run, bodies, logs, terms)
    first = _first_silhouettes(run, logs, detected, bare=bare)
    take = SilhouetteTake(
        tuple(first.cameras),
        first.store,
        tuple(first.frames),
        trial.take.rate,
        hidden_of=first.store.hidden,
        times=run.times,
    )
    tracked = tracked_in_silhouettes(run, take, bodies, detected, terms)
    if run.moved is not None:
        run, take, tracked, _ = with_found_camera(run, take, tracked, height=run.person.track_height, detected=detected)
        terms = terms_for(run, detected)
    occluders = None
    if not bare and first.apart is None and not trial.masks:
        tracked = with_better_answers(run, take, tracked, bodies)
        tracked, occluders = with_occluders(run, take, tracked, bodies, terms)
    filled = interpolated_poses(tracked.poses, longest=run.person.bridge * trial.take.rate)
    tracked = replace(tracked, poses=dict(sorted({**tracked.poses, **filled}.items())))
    stages.warn_of_lost(run.progress, first.frames, tracked.poses, count=trial.take.count)
    if bare or (first.apart is not None and not trial.masks):
        return _in_turn(run, bodies, logs, tracked, take, terms, first.apart, filled=filled)
    outlines = first.store if trial.masks else _outlines(run, logs, first, take, tracked, occluders)
    covariance = None
    if run.moved is not None:
        run, tracked, covariance = _with_camera_in_outlines(run, outlines, tracked, detected)
        terms = terms_for(run, detected)
    return FollowedPerson(
        tracked, filled, outlines, first.frames, terms=terms, repaired=first.apart is None, rig=run.trial.rig,
        camera_covariance=covariance, occluders=occluders,
    )  # fmt: skip


def _first_silhouettes(run: Run, logs: Logs, detected: DetectedPerson | None, *, bare: bool) -> _FirstSilhouettes:
    """Find or read the first silhouettes, check the cameras, and separate the person to follow from others."""
    trial, progress = run.trial, run.progress
    small: Sequence[Camera] = list(trial.rig)
    first, models = trial.take.first, list[Background]()
    if trial.masks:
        store = MaskStore(logs.outlines, first, small)
        stages.known_silhouettes(trial, store, progress)
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
    alone = store
    if apart is not None:
        alone = separated(store, small, apart, MaskStore(logs.common, first, small), progress)
    elif not trial.masks:
        cut = stages.cut_in(store, small, frames)
        if stages.cluttered(store, small, frames, progress, cut):
            alone = stages.common_silhouettes(store, small, MaskStore(logs.common, first, small), progress, cut)
    if alone is not store:
        frames = stages.frames_with_somebody(alone)
        stages.require_somebody(trial, frames)
    return _FirstSilhouettes(store=alone, cameras=small, frames=frames, models=models, apart=apart)


def _outlines(
    run: Run, logs: Logs, first: _FirstSilhouettes, take: SilhouetteTake, tracked: Tracked, occluders: Occluders | None
) -> MaskStore:
    """Find silhouettes in full images, with the tracked person as prior."""
    trial, cameras = run.trial, list(run.trial.rig)
    outlines = MaskStore(logs.outlines, trial.take.first, cameras)
    views = [stages.SilhouetteState(model) for model in first.models]
    predicted = stages.expectations(tracked.body, tracked.poses, cameras, take.cameras, run.times, occluders)
    with person_evidence(run, tracked.body, tracked.poses) as evidence:
        predicted = with_evidence(predicted, evidence)
        stages.find_silhouettes(trial, views, cameras, outlines, run.progress, name="Outlines", predicted=predicted)
    return outlines


def _with_camera_in_outlines(
    run: Run, outlines: MaskStore, tracked: Tracked, detected: DetectedPerson | None
) -> tuple[Run, Tracked, Floats | None]:
    """Find the camera that was moved once more, in the outlines; also its covariance, which is reported."""
    whole = SilhouetteTake(
        tuple(run.trial.rig), outlines, tuple(tracked.poses), run.trial.take.rate, outlines.edges, outlines.hidden,
        run.times,
    )  # fmt: skip
    run, _, tracked, covariance = with_found_camera(
        run, whole, tracked, height=run.person.fine_height, detected=detected
    )
    report_found_camera(run, covariance)
    return run, tracked, covariance


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

    def compute() -> Arrays:
        with run.progress.stage("Clocks"):
            shown = range(min(frames), max(frames) + 1)
            found = require_common_clock(
                small, shown, store.of_camera, rate=run.trial.take.rate, shutter=run.trial.shutter
            )
        return {"warning": np.array([] if found is None else [found], str)}

    for warning in run.cache.arrays("common_clock", compute, depends=run.scope)["warning"].tolist():
        run.progress.warn(warning)
        run.reasons.append(VerdictReason.limit(warning, "Run `marey sync`.", cause="late"))


def _apart(
    run: Run, store: MaskStore, cameras: Sequence[Camera], frames: Sequence[int], detected: DetectedPerson | None
) -> ForegroundPerson | None:
    """Return the person to follow if the silhouettes show several people; None for a single one."""
    track = None if detected is None else detected.track
    return foreground_person(run.trial, cameras, store, frames, run.progress, track, run.captured)


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
    person, take, tracked = run.person, followed.take(run), with_placed_hips(run, followed.tracked)
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
    if (limit := mostly_ambiguous(alternatives, tracked.body.skeleton, len(poses))) is not None:
        run.reasons.append(limit)
    take.forget(keep=person.fine_height)
    tracks = None
    found: dict[int, Pose] = {}
    pieces = []
    with run.cache.frames("surface_tracks", depends=run.scope) as patches, rounds_of(run, "refined") as memory:
        if run.settings.surface_tracks:
            patches.cut(0)  # a run that is resumed follows the surface again
            poses, terms, tracks = track_patches(run, take, tracked.body, poses, terms, patches)
        with run.progress.stage("Refinement", FINE_ROUNDS * len(poses)) as step:
            for fit in refine_person(
                take, tracked.body, poses, frames_for_sizes(run, tracked.scores), person,
                height=person.fine_height, rounds=FINE_ROUNDS, ignored_frames=blind, extra_terms=terms,
                cameras=camera_errors(run, followed.camera_covariance), progress=lambda frame: step(),
                checkpoint=memory,
            ):  # fmt: skip
                found |= fit.by_frame
                fit = with_camera_contradictions(fit, rate=take.rate)
                if not followed.repaired:
                    fit = with_unusual_shoulders(fit)
                piece = measure_piece(with_alternatives(fit, alternatives))
                pieces.append(undetermined(piece, alternatives, fit.body))
    return Refined(fit.body, found, pieces, frozenset(blind), tracks)

"""The results of a capture: files, report, record and verdict."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from marey.arrays import Mask
from marey.body.articulation.pose import Pose
from marey.body.articulation.surface import Body
from marey.io.results.results import write_results
from marey.motion.events.repetitions import Repetitions
from marey.motion.from_fit import MeasuredPiece, motion_of
from marey.motion.motion import BodyMotion
from marey.pipelines.capture.report import draw_overlays, report_capture
from marey.pipelines.capture.run import Run
from marey.pipelines.capture.tracked import SilhouetteRound
from marey.pipelines.consistency.cut_off import cut_off_reasons
from marey.pipelines.consistency.one_direction import one_direction_reasons
from marey.pipelines.consistency.result import reasons_of
from marey.pipelines.gait.files import body_curves, write_gait
from marey.pipelines.gait.repetitions import count_repetitions, repetitions_of_body, save_repetitions
from marey.pipelines.gait.walk import Gait, count_events, gait_of_body
from marey.pipelines.occlusion.occluders import Occluders
from marey.pipelines.progress import Progress
from marey.pipelines.run_record import finished_together, write_record
from marey.pipelines.silhouettes import drawn_surface
from marey.pipelines.silhouettes.mask_store import MaskStore
from marey.pipelines.verdict import Verdict
from marey.view.gait.repetition_table import repetition_tables
from marey.view.pages.curves import NumberTable
from marey.view.pages.html import Still
from marey.wording import listed


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
    body, poses = refined.body, refined.poses
    lost = np.zeros(take.count, bool)
    lost[[frame for frame in frames if frame not in poses]] = True
    skin = skin or drawn_surface.PosedSkin.of(body, poses, run.times)
    with finished_together(run.out) as folder:
        with progress.stage("Comparison", len(poses)) as step:
            drawn = drawn_surface.draw_skin(skin, poses, trial, store, folder=folder, occluders=occluders, done=step)
        motion = motion_of(
            refined.pieces, body, count=take.count, rate=take.rate, lost=lost, camera_names=trial.rig.names,
            agreement=drawn.agreement, filled=refined.filled,
        )  # fmt: skip
        gait = gait_of_body(motion, body)
        repetitions = repetitions_of_body(motion, body, gait)
        _report_hidden(progress, drawn.hidden)
        with progress.stage("Results"):
            drawn_surface.write_silhouettes(folder, trial, store)
            write_results(
                folder, motion, body, preset=trial.settings.preset or "full", mass_kg=trial.settings.mass_kg,
                skin=drawn_surface.skins(skin, poses, take.count), skin_faces=skin.faces,
                seen=seen or drawn.seen_vertices(take.count),
                events=() if gait is None else gait.events,
            )  # fmt: skip
            tables = more(folder) or ()
            _write_events(folder, gait, repetitions, motion, progress)
        effective, show, stills = _effective_settings(run), store.known, list[Still]()
        if run.settings.overlay:
            stills = draw_overlays(
                trial, body, poses, motion, show, folder=folder, progress=progress, times=run.times,
                hidden_of=store.known_hidden,
            )  # fmt: skip
        verdict = verdict_of(run, motion, body)
        report_capture(
            trial, motion, body, show, stills=stills, settings=effective, rounds=rounds, folder=folder,
            progress=progress, verdict=verdict, tracks=refined.tracks, hidden=drawn.hidden, command=command,
            tables=[*repetition_tables(repetitions), *tables], gait=gait,
        )  # fmt: skip
        write_record(
            folder, command=command, settings=effective, inputs=trial.input_files, root=trial.folder, progress=progress,
            verdict=verdict, more=_more_record(rounds, drawn.hidden, refined.tracks),
        )  # fmt: skip


def _report_hidden(progress: Progress, hidden: Mapping[str, drawn_surface.HiddenShare]) -> None:
    """Report which part of the person things in front hide in each camera."""
    parts = [f"{100 * share.person:.0f} % in {name}" for name, share in hidden.items() if share.person > 0]
    if hidden:
        progress.report(f"Hidden part of the person: {listed(parts)}")


def _write_events(
    folder: Path, gait: Gait | None, repetitions: Repetitions, motion: BodyMotion, progress: Progress
) -> None:
    """Write what was found of gait and of repetitions, and report how much it is."""
    if gait is not None:
        write_gait(folder, gait, body_curves(gait, motion))
        progress.report(f"Gait: {count_events(gait)}")
    save_repetitions(folder, repetitions)
    if len(repetitions):
        progress.report(f"Repetitions: {count_repetitions(repetitions)}")


def _more_record(
    rounds: Sequence[SilhouetteRound], hidden: Mapping[str, drawn_surface.HiddenShare],
    tracks: Mapping[str, tuple[int, float]] | None,
) -> dict[str, object]:  # fmt: skip
    """Return what `run.json` states of the course of the silhouettes, of hidden parts, and of tracks of the surface."""
    record: dict[str, object] = {}
    if rounds:
        record["silhouette_rounds"] = [asdict(each) for each in rounds]
    if hidden:
        record["hidden"] = {name: asdict(share) for name, share in hidden.items()}
    if tracks is not None:
        record["surface_tracks"] = _tracks_record(tracks)
    return record


def _effective_settings(run: Run) -> dict[str, object]:
    """Return the settings of a run that differ from the defaults, for the report and the record."""
    effective: dict[str, object] = {"preset": "full"}
    effective |= run.trial.settings.model_dump(mode="json", exclude_none=True)
    effective |= {"body": str(run.settings.body)} if run.settings.body else {}
    effective |= {} if run.settings.surface_tracks else {"surface_tracks": False}
    effective |= {"fixed_sizes": True} if run.settings.fixed_sizes else {}
    return effective | ({} if run.settings.camera_uncertainty else {"camera_uncertainty": False})


def _tracks_record(tracks: Mapping[str, tuple[int, float]]) -> dict[str, dict[str, float]]:
    return {name: {"count": count, "mean_frames": round(length, 1)} for name, (count, length) in tracks.items()}


def verdict_of(run: Run, motion: BodyMotion, body: Body) -> Verdict:
    """Return the verdict on a motion, from what was repaired before the run and found in it, and from the motion."""
    selected = range(run.trial.take.first, run.trial.take.end)
    preset = run.trial.settings.preset or "full"
    own = reasons_of(motion, body, selected, preset=preset)
    cameras = list(run.trial.rig)
    outside = cut_off_reasons(motion, cameras) if preset == "full" else ()
    along = one_direction_reasons(motion, cameras)
    return Verdict.of([*run.repairs.reasons, *run.reasons, *own, *outside, *along])

"""`marey capture`: from the videos of a trial to the motion of the person in it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from marey.body.pose import Pose, PosedBody
from marey.body.presets import person_body
from marey.body.surface import Body
from marey.cli import capture_stages as stages
from marey.cli.progress import Progress
from marey.cli.run_record import StageCache, finished_together, write_record
from marey.cli.settings import CaptureSettings
from marey.errors import FileProblem
from marey.fit.person import (
    PersonSettings,
    Take,
    refine_person,
    shape_frames,
    start_person,
    track_person,
    with_shape,
)
from marey.fit.search import Candidate
from marey.fit.sequence import SequenceFit
from marey.io.results import write_results
from marey.io.stages import Arrays, file_fingerprint
from marey.io.trial import Trial, read_trial
from marey.motion.from_fit import motion_of


@dataclass(frozen=True, eq=False)
class Tracked:
    """A person followed through a take: the body, and a pose a frame."""

    body: Body
    poses: Mapping[int, Pose]
    scores: Mapping[int, float]


def capture(folder: Path, settings: CaptureSettings, progress: Progress) -> Path:
    """Capture the joint motion of the person in a trial.

    Args:
        folder: The trial.
        settings: What is asked for; what it leaves open, trial.toml may say.
        progress: Is shown, and keeps timings and warnings.

    Returns:
        The folder with the results.

    Raises:
        FileProblem: Something in the trial cannot be used.
    """
    trial = read_trial(
        folder, cameras=settings.cameras, frames=settings.frames, stature_m=settings.stature_m,
        mass_kg=settings.mass_kg, preset=None if settings.preset == "full" else settings.preset, rate=settings.rate,
    )  # fmt: skip
    out = settings.out or folder / "marey"
    for note in trial.take.notes:
        progress.warn(note)
    stages.quiet_threads()
    with threadpool_limits(1):
        cache = StageCache(out, [file_fingerprint(path) for path in trial.input_files])
        return _capture(trial, settings, progress, cache, out)


def _capture(trial: Trial, settings: CaptureSettings, progress: Progress, cache: StageCache, out: Path) -> Path:
    person = PersonSettings()
    scope = (trial.rig.names, trial.take.first, trial.take.end, trial.settings.preset)
    fine, coarse = person_body("fine"), person_body("coarse")
    with cache.frames("silhouettes", depends=scope) as log, cache.frames("outlines", depends=scope) as second:
        store = stages.MaskStore(log, trial.take.first, list(trial.rig))
        models = stages.backgrounds(trial, progress)
        stages.find_silhouettes(trial, models, store, progress, name="Silhouettes")
        frames = stages.frames_with_somebody(store)
        stages.require_somebody(trial, frames)
        take = Take(tuple(trial.rig), store, frames, trial.take.rate)
        tracked = _tracked(take, coarse, fine, person, progress, cache, scope, trial)
        better = stages.MaskStore(second, trial.take.first, list(trial.rig))
        predicted = stages.surface_masks(tracked.body, tracked.poses, list(trial.rig))
        stages.find_silhouettes(trial, models, better, progress, name="Outlines about the body", predicted=predicted)
        take = Take(tuple(trial.rig), better, tuple(tracked.poses), trial.take.rate)
        fit = _refined(take, tracked, person, progress)
        _write(trial, settings, fit, better, frames, progress, out)
    cache.clear()
    return out


def _tracked(
    take: Take,
    coarse: Body,
    fine: Body,
    person: PersonSettings,
    progress: Progress,
    cache: StageCache,
    scope: object,
    trial: Trial,
) -> Tracked:
    """Find the start, follow the person, and learn the shape."""

    def start() -> Arrays:
        count = min(person.start_frames, len(take.frames))
        with progress.stage("Start", count) as step:
            found = start_person(take, coarse, fine, person, done=lambda frame: step())
        if found is None:
            remedy = (
                "Look whether the cameras are calibrated in one world, and whether the silhouettes show the person."
            )
            raise FileProblem(trial.folder, "has silhouettes that have no point of space in common", remedy)
        return _packed({found[0]: found[1]}, found[1].posed.body)

    def follow() -> Arrays:
        begun = _unpacked(cache.arrays("start", start, depends=scope), fine)
        frame = next(iter(begun.poses))
        with progress.stage("Tracking", len(take.frames)) as step:
            found = track_person(
                take, begun.body, with_shape(begun.body, coarse), (frame, begun.poses[frame]), person,
                done=lambda frame: step(),
            )  # fmt: skip
        return _packed(found, begun.body)

    def shape() -> Arrays:
        followed = _unpacked(cache.arrays("tracked", follow, depends=scope), fine)
        rounds = 4
        with progress.stage("Shape and motion", rounds * len(followed.poses)) as step:
            fit = refine_person(
                take, followed.body, followed.poses, shape_frames(followed.scores, person.shape_frames), person,
                height=person.track_height, rounds=rounds, done=lambda frame: step(),
            )  # fmt: skip
        poses = dict(zip(map(int, fit.frames), fit.poses, strict=True))
        return _pack(poses, fit.body, followed.scores)

    return _unpacked(cache.arrays("shape", shape, depends=scope), fine)


def _refined(take: Take, tracked: Tracked, person: PersonSettings, progress: Progress) -> SequenceFit:
    rounds = 3
    with progress.stage("Refinement", rounds * len(tracked.poses)) as step:
        return refine_person(
            take, tracked.body, tracked.poses, shape_frames(tracked.scores, person.shape_frames), person,
            height=person.fine_height, rounds=rounds, done=lambda frame: step(),
        )  # fmt: skip


def _packed(found: Mapping[int, Candidate], body: Body) -> Arrays:
    return _pack({f: c.posed.pose for f, c in found.items()}, body, {f: c.score for f, c in found.items()})


def _pack(poses: Mapping[int, Pose], body: Body, scores: Mapping[int, float]) -> Arrays:
    return {
        "frames": np.array(list(poses)),
        "translation": np.array([pose.translation for pose in poses.values()]),
        "rotation": np.array([pose.rotation for pose in poses.values()]),
        "angles": np.array([pose.angles for pose in poses.values()]),
        "score": np.array([scores[frame] for frame in poses]),
        "numbers": np.array(body.numbers),
    }


def _unpacked(arrays: Arrays, body: Body) -> Tracked:
    frames = [int(frame) for frame in arrays["frames"]]
    poses = [Pose(*parts) for parts in zip(arrays["translation"], arrays["rotation"], arrays["angles"], strict=True)]
    return Tracked(
        body.with_numbers(arrays["numbers"]),
        dict(zip(frames, poses, strict=True)),
        dict(zip(frames, map(float, arrays["score"]), strict=True)),
    )


def _write(
    trial: Trial,
    settings: CaptureSettings,
    fit: SequenceFit,
    store: stages.MaskStore,
    frames: Sequence[int],
    progress: Progress,
    out: Path,
) -> None:
    """Write all results at once."""
    take, cameras = trial.take, list(trial.rig)
    poses = dict(zip(map(int, fit.frames), fit.poses, strict=True))
    lost = np.zeros(take.count, bool)
    lost[[frame for frame in frames if frame not in poses]] = True
    with finished_together(out) as folder:
        agreement = {}
        with progress.stage("Results", len(poses)) as step:
            for frame, _, overlap in stages.compare_with_silhouettes(fit.body, poses, cameras, store):
                agreement[frame] = overlap
                step()
        motion = motion_of(
            fit, count=take.count, rate=take.rate, lost=lost, camera_names=trial.rig.names, agreement=agreement
        )
        skin = np.full((take.count, len(fit.body.vertices), 3), np.nan)
        for frame, pose in poses.items():
            skin[frame] = PosedBody(fit.body, pose).vertices
        write_results(folder, motion, fit.body, preset=settings.preset, mass_kg=trial.settings.mass_kg, skin=skin)
        write_record(
            folder, command="capture", settings=settings.as_text(), inputs=trial.input_files, root=trial.folder,
            progress=progress,
        )  # fmt: skip

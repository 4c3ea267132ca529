"""Capture of all people in a trial, one after the other; each is an occluder of the others."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from marey.body.people.person import measured_stature
from marey.errors import MareyError
from marey.fit.recipes.present_people import PresentPerson
from marey.io.npz import read_arrays
from marey.io.results.people import PersonRow, write_people
from marey.io.stages import Arrays, file_fingerprint
from marey.io.trial.person_choice import PersonNumber, parse_person
from marey.io.trial.trial import Trial
from marey.motion.motion import MEASURED
from marey.pipelines.capture.capture import capture_trial
from marey.pipelines.capture.motion import Motion, load_body, load_motion
from marey.pipelines.capture.settings import CaptureSettings
from marey.pipelines.capture.tasks import reopened
from marey.pipelines.group.listing import PeopleList, listed_people
from marey.pipelines.people.other_regions import CapturedPerson
from marey.pipelines.progress import Progress, RecordingProgress
from marey.pipelines.run_record import StageCache, finished_together, write_record
from marey.pipelines.verdict import LEVELS, Verdict, VerdictReason

SUMMARY = "people.csv"
"""Name of the table of all captured people."""
LENGTHS = {"stature_m": "stature", "leg_length_m": "leg length", "asis_distance_m": "ASIS distance"}
"""Settings that are measured on one person, and their names."""


@dataclass(frozen=True, eq=False)
class CapturedPeople:
    """All captured people of a trial.

    Example:
        >>> import marey
        >>> found = marey.capture_people("street", out="results", keypoints="detections")  # doctest: +SKIP
        >>> {number: motion.report for number, motion in found.motions.items()}  # doctest: +SKIP
    """

    people: PeopleList
    """The people who are present."""
    motions: Mapping[int, Motion]
    """The motion of each person who was captured, by number; the files are in `person1`, `person2`, ..."""
    failures: Mapping[int, str]
    """Why a person was not captured, by number."""
    summary: Path
    """Path of the table `people.csv`."""
    verdict: Verdict
    """How far the motions of all people can be used together; the verdict on each is its own."""


def capture_people(
    trial: Trial | Path | str, *, out: Path | str, keypoints: Path | str | None = None, overlay: bool = True,
    progress: Progress | None = None,
) -> CapturedPeople:  # fmt: skip
    """Capture everybody in a trial, as `marey capture --people all` does.

    Args:
        trial: A trial, or its folder.
        out: Folder for the results: `person1`, `person2`, ... with the files of a capture each, and `people.csv`.
        keypoints: A folder with the joints that a detector found in every image.
        overlay: Draw overlay videos.
        progress: Progress reporter.

    Returns:
        The motions by number.

    Raises:
        FileProblem: Something in the trial cannot be used, or nobody could be captured.

    Example:
        >>> import marey
        >>> found = marey.capture_people("street", out="results", keypoints="detections")  # doctest: +SKIP
        >>> found.motions[2].angles["left knee flexion"]  # doctest: +SKIP
    """
    settings = CaptureSettings(
        out=Path(out), keypoints=None if keypoints is None else Path(keypoints), overlay=overlay
    )  # fmt: skip
    return captured_people(reopened(trial, settings.changes()), settings, progress or RecordingProgress())


def captured_people(trial: Trial, settings: CaptureSettings, progress: Progress) -> CapturedPeople:
    """Capture everybody in an opened trial; see `capture_people`.

    A person who was captured before hides the later ones by the fitted body, the others by their detected joints or
    their part of the foreground. Lengths that were measured on one person are used for the followed one alone, number 1
    unless the settings name another. An interrupted run goes on with the first person who is not finished.

    Args:
        trial: The trial, opened with `settings.changes()`.
        settings: Settings of each capture.
        progress: Progress reporter.
    """
    out = settings.out or trial.folder / "marey"
    motions: dict[int, Motion] = {}
    failures: dict[int, str] = {}
    how = (str(settings.body), settings.fixed_sizes, settings.overlay)
    files = trial.input_files
    inputs = [trial.folder, *files]
    with StageCache(out, [*map(file_fingerprint, files), how], files=inputs, results=[SUMMARY]) as cache:
        people = listed_people(trial, replace(settings, out=out), progress)
        scope = (trial.rig.names, trial.take.first, trial.take.end, trial.settings.model_dump_json(), len(people))
        measured = _measured_person(trial, len(people), progress)
        for number in range(1, len(people) + 1):
            folder = out / f"person{number}"
            own = replace(settings, person=number, out=folder)
            progress.report(f"Person {number} of {len(people)}: {folder}")
            captured = {n: _captured(motion) for n, motion in motions.items()}

            def finish(own: CaptureSettings = own, captured: Mapping[int, CapturedPerson] = captured) -> Arrays:
                opened = reopened(trial, own.changes())
                opened = opened if own.person == measured else _without_lengths(opened)
                capture_trial(opened, own, progress, captured=captured)
                return {"finished": np.ones(1)}

            noted = _begin_report(progress)
            try:
                cache.arrays(f"person_{number}", finish, depends=(scope, sorted(captured)))
                motions[number] = load_motion(folder)
            except MareyError as problem:
                if len(people) == 1 or problem.resumes:
                    raise
                failures[number] = str(problem)
                progress.warn(f"Person {number} was not captured. {problem}")
            progress.warnings[:0] = noted
        if not motions:
            raise MareyError(" ".join(failures.values()))
        rows = [
            _row(number, person, motions.get(number), failures.get(number, ""), out / f"person{number}")
            for number, person in enumerate(people.people, 1)
        ]
        verdict = people_verdict(motions, failures)
        with finished_together(out) as staging:
            write_people(staging / SUMMARY, rows)
            write_record(
                staging, command="people", settings=trial.settings.model_dump(mode="json", exclude_none=True),
                inputs=files, root=trial.folder, progress=progress, verdict=verdict,
            )  # fmt: skip
    return CapturedPeople(people, motions, failures, out / SUMMARY, verdict)


def _measured_person(trial: Trial, count: int, progress: Progress) -> int | None:
    """Return the number of the person to whom measured lengths belong, and report it if there are others."""
    if count == 1:
        return 1
    known = [name for key, name in LENGTHS.items() if getattr(trial.settings, key) is not None]
    chosen = None if trial.settings.people is None else parse_person(trial.settings.people.follow)
    number = 1 if chosen is None else chosen.number if isinstance(chosen, PersonNumber) else None
    if known:
        whose = f"person {number} alone" if number is not None else "nobody: [people] follow is not a number"
        progress.report(f"Measured lengths ({', '.join(known)}) are used for {whose}.")
    return number


def _without_lengths(trial: Trial) -> Trial:
    """Return a trial without the lengths that were measured on another person."""
    return replace(trial, settings=trial.settings.model_copy(update=dict.fromkeys(LENGTHS)))


def people_verdict(motions: Mapping[int, Motion], failures: Mapping[int, str]) -> Verdict:
    """Return the verdict on the motions of several people: not usable if that of nobody is.

    Args:
        motions: The motion of each captured person, by number.
        failures: Why a person was not captured, by number.
    """
    found = {number: motion.verdict or Verdict() for number, motion in motions.items()}
    # If the motion of some people is usable, those of the others limit the use of the whole.
    worst = LEVELS[1] if any(verdict.usable for verdict in found.values()) else LEVELS[2]
    reasons = [
        replace(each, what=f"Person {number}: {each.what}", level=min(each.level, worst, key=LEVELS.index))
        for number, verdict in found.items() for each in verdict.reasons
    ]  # fmt: skip
    reasons += [VerdictReason.limit(f"Person {number} was not captured. {why}") for number, why in failures.items()]
    return Verdict.of(reasons)


def _begin_report(progress: Progress) -> list[str]:
    """Remove timings and warnings of earlier people, which do not belong in the next report; return the warnings."""
    noted = list(progress.warnings)
    progress.warnings.clear()
    progress.timings.clear()
    progress.steps.clear()
    return noted


def _captured(motion: Motion) -> CapturedPerson:
    assert motion.folder is not None
    skin = read_arrays(motion.folder / "skin.npz")
    return CapturedPerson(np.asarray(skin["vertices"], float), np.asarray(skin["faces"], np.int64))


def _row(
    number: int, person: PresentPerson, motion: Motion | None, problem: str, folder: Path
) -> PersonRow:  # fmt: skip
    """Return the summary of one person."""
    frames = person.frames
    seen = PersonRow(
        person=number, folder=folder.name, first_frame=frames[0], last_frame=frames[-1], frames_seen=len(frames),
        problem=problem,
    )  # fmt: skip
    if motion is None:
        return seen
    height = measured_stature(load_body(folder))
    return replace(
        seen,
        frames_measured=int(np.count_nonzero(motion.data.state == MEASURED)),
        stature_m="" if height is None else f"{height[0]:.3f}",
        agreement=f"{float(np.nanmean(motion.data.agreement)):.3f}",
    )

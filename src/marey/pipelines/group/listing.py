"""The list of the people in a trial, with a picture of their numbers for every camera."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from marey.cameras.camera import Camera
from marey.fit.recipes.present_people import PresentPerson
from marey.images.silhouettes.background import shrunk
from marey.io.trial.trial import Trial
from marey.io.video.pictures import write_picture
from marey.pipelines.capture.by_regions import nothing_given, people_by_regions
from marey.pipelines.capture.detected import detected_people_of
from marey.pipelines.capture.evidence import first_silhouettes
from marey.pipelines.capture.run import Logs, Run, opened
from marey.pipelines.capture.settings import CaptureSettings
from marey.pipelines.capture.tasks import reopened
from marey.pipelines.people.foreground import people_in_foreground
from marey.pipelines.people.region_people import person_of_region
from marey.pipelines.progress import Progress, RecordingProgress
from marey.pipelines.run_record import finished_together, write_record
from marey.pipelines.silhouettes import stages
from marey.pipelines.silhouettes.empty_rooms import cameras_without_image, model_backgrounds
from marey.pipelines.silhouettes.mask_store import MaskStore
from marey.pipelines.verdict import Verdict, VerdictReason
from marey.view.pictures.people_picture import draw_people


@dataclass(frozen=True, eq=False)
class PeopleList:
    """The people who are present in a trial, in the order of their numbers.

    Example:
        >>> import marey
        >>> people = marey.list_people("street", keypoints="street/detections")  # doctest: +SKIP
        >>> print(people)  # doctest: +SKIP
        >>> motion = marey.capture("street", keypoints="street/detections", person=2)  # doctest: +SKIP
    """

    people: tuple[PresentPerson, ...]
    """The people; number 1 is the one who is followed by default."""
    source: str
    """What they were found by: "key points", "foreground", or "colours and motion"."""
    frame: int
    """The frame with the largest number of people, which the pictures show."""
    pictures: tuple[Path, ...]
    """One picture per camera with the numbers of the people in this frame."""
    verdict: Verdict = field(default_factory=Verdict)
    """How far the list can be used, and what limits it."""

    def __len__(self) -> int:
        """Return the number of people."""
        return len(self.people)

    def __str__(self) -> str:
        """Return a table: number, frames, place and height of each person."""
        rows = [f"{'number':>6}  {'frames':>13}  {'seen':>5}  {'in frame':>8}  {'x, y [m]':>14}  {'height [m]':>10}"]
        for number, person in enumerate(self.people, 1):
            frames, shown = person.frames, person.nearest_frame(self.frame)
            x, y, _ = person.middle(shown)
            height = f"{person.height_m:10.2f}" if np.isfinite(person.height_m) else f"{'unknown':>10}"
            rows.append(
                f"{number:>6}  {f'{frames[0]} to {frames[-1]}':>13}  {len(frames):>5}  {shown:>8}  "
                f"{f'{x:.2f}, {y:.2f}':>14}  {height}"
            )
        return "\n".join(rows)


def list_people(
    trial: Trial | Path | str, *, out: Path | str | None = None, keypoints: Path | str | None = None,
    progress: Progress | None = None,
) -> PeopleList:  # fmt: skip
    """Find all people in a trial, and draw their numbers in one image of every camera.

    With key points, these are the people about whose joints at least two cameras agree. With images of the empty room
    or silhouettes, they are the separate parts of the foreground in space, for which three cameras are needed to be
    reliable. With neither, they are found by the colours that the cameras have in common, and by their motion.

    Args:
        trial: A trial, or its folder.
        out: Folder for the pictures `people_CAMERA.png`; by default `marey/` in the trial.
        keypoints: A folder with the joints that a detector found in every image.
        progress: Progress reporter.

    Returns:
        The people in the order of their numbers, and the paths of the pictures.

    Raises:
        FileProblem: Something in the trial cannot be used, or nobody was found.

    Example:
        >>> import marey
        >>> people = marey.list_people("street", keypoints="street/detections")  # doctest: +SKIP
        >>> len(people), people.pictures  # doctest: +SKIP
    """
    settings = CaptureSettings(
        out=None if out is None else Path(out), keypoints=None if keypoints is None else Path(keypoints)
    )
    return listed_people(reopened(trial, settings.changes()), settings, progress or RecordingProgress())


def listed_people(trial: Trial, settings: CaptureSettings, progress: Progress) -> PeopleList:
    """Find all people in an opened trial; see `list_people`.

    Args:
        trial: The trial, opened with `settings.changes()`.
        settings: Settings, of which only the folder of the results is used.
        progress: Progress reporter.
    """
    out = settings.out or trial.folder / "marey"
    detected = detected_people_of(trial, progress)
    people: Sequence[PresentPerson]
    if detected is not None:
        source, people = "key points", detected.present
    elif nothing_given(trial):
        source, people = "colours and motion", _by_regions(trial, settings, progress)
    else:
        source, people = "foreground", _in_foreground(trial, settings, progress)
    frames = sorted({frame for person in people for frame in person.points})
    shown = max(frames, key=lambda frame: (sum(frame in person.points for person in people), -frame))
    images = dict(trial.take.at([shown]))[shown]
    pictures, verdict = list[str](), _verdict(source, len(trial.rig))
    inputs = trial.input_files
    with finished_together(out, inputs=[trial.folder, *inputs]) as folder:
        for camera, image in zip(trial.rig, images, strict=True):
            seen = [
                (number, person.pixels(camera, shown))
                for number, person in enumerate(people, 1)
                if shown in person.points
            ]
            pictures.append(f"people_{camera.name}.png")
            write_picture(folder / pictures[-1], draw_people(image, seen))
        write_record(
            folder, command="list-people", settings=trial.settings.model_dump(mode="json", exclude_none=True),
            inputs=inputs, root=trial.folder, progress=progress, verdict=verdict,
        )  # fmt: skip
    return PeopleList(tuple(people), source, shown, tuple(out / name for name in pictures), verdict)


SEPARATING_CAMERAS = 3
"""Number of cameras from which on separate parts of the foreground are separate people: two silhouettes of two people
also intersect where nobody is."""


def _verdict(source: str, cameras: int) -> Verdict:
    if source != "foreground" or cameras >= SEPARATING_CAMERAS:
        return Verdict()
    what = f"With {cameras} cameras, parts of the foreground also intersect where nobody is."
    return Verdict.of([VerdictReason.limit(what, "Compare the pictures, or give key points (--keypoints).")])


def _by_regions(trial: Trial, settings: CaptureSettings, progress: Progress) -> Sequence[PresentPerson]:
    """Find the people of a trial of which nothing is known."""
    with opened(trial, settings, progress) as (run, bodies, _):
        return [person_of_region(person.body, person.poses) for person in people_by_regions(run, bodies).people]


def _in_foreground(trial: Trial, settings: CaptureSettings, progress: Progress) -> Sequence[PresentPerson]:
    """Find the people in the foreground of a trial without key points."""
    with opened(trial, settings, progress) as (run, _, logs):
        store, small = _first_silhouettes(run, logs)
        frames = stages.frames_with_somebody(store)
        stages.require_somebody(trial, frames)
        _, people = people_in_foreground(trial, small, store, frames, progress)
        stages.require_somebody(trial, frames if people else ())
        return people


def _first_silhouettes(run: Run, logs: Logs) -> tuple[MaskStore, list[Camera]]:
    """Return the foreground of all frames, and the cameras of its images."""
    trial, progress, cameras = run.trial, run.progress, list(run.trial.rig)
    if trial.masks:
        store = MaskStore(logs.first, trial.take.first, cameras)
        stages.known_silhouettes(trial, store, progress)
        return store, cameras
    if cameras_without_image(trial):
        return first_silhouettes(run, logs.first)
    models, small = model_backgrounds(trial, progress)
    store = MaskStore(logs.first, trial.take.first, small)
    views = [stages.SilhouetteState(shrunk(m, c.size)) for m, c in zip(models, small, strict=True)]
    stages.find_silhouettes(trial, views, small, store, progress, name="Silhouettes")
    return store, small

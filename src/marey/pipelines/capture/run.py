"""One run on a trial: the trial, its settings and bodies, and the checkpoints of an interrupted run."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from uuid import uuid4

import numpy as np

from marey.body.articulation.presets import GENERIC_BODIES, PRESETS
from marey.body.articulation.surface import Body
from marey.body.metaballs.metaball_people import metaball_person
from marey.body.metaballs.metaball_person import metaball_body, metaballs_of
from marey.body.people.family import LEVELS
from marey.body.people.person import person_body, preset_body
from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.errors import FileProblem
from marey.fit.recipes.frame_observations import FrameObservations
from marey.fit.recipes.person import (
    PersonSettings,
    with_shape,
)
from marey.fit.recipes.pick_up import with_fixed_shape
from marey.fit.recipes.sequence_equations import FrameTermsFactory
from marey.fit.solver.picture_times import PictureRows, PictureTimes
from marey.io.calibration.readers import read_rig
from marey.io.results.body import open_body
from marey.io.run_files import require_own_folder
from marey.io.stages import FrameLog, file_fingerprint
from marey.io.trial.trial import Trial
from marey.io.work_folder import WorkFolder
from marey.observations.observation import Observation
from marey.pipelines.capture.settings import CaptureSettings
from marey.pipelines.consistency.repairs import Repairs
from marey.pipelines.people.choice import given_start
from marey.pipelines.people.other_regions import CapturedPerson, JoinedPeople, OtherPeople
from marey.pipelines.progress import Progress
from marey.pipelines.run_record import StageCache
from marey.pipelines.verdict import VerdictReason

CORRECTED_CAMERAS = "corrected_cameras.toml"
"""File of cameras that a measurement has corrected, among its results; never the name of a calibration."""
TWIN_M = 1e-4
"""Largest distance of the joints of a body from those of its twin with few vertices [m].

Chosen by hand: only rounding is allowed.
"""
CAPTURE_RESULTS = (
    *("report.html", "motion.npz", "motion.nc", "motion.c3d", "body.npz", "body.osim", "body.glb"),
    *("joint_centres.trc", "angles.mot", "angles.csv", "orientations.sto"),
)
"""Files that every capture writes, whose names are checked before the work."""


def require_usable(trial: Trial, settings: CaptureSettings) -> None:
    """Check what a run reads besides the videos, and the folder of its results, before work that takes long.

    Args:
        trial: The trial, opened with `settings.changes()`.
        settings: Settings of the run.

    Raises:
        FileProblem: Something cannot be used.
    """
    out = settings.out or trial.folder / "marey"
    require_other_body(settings, out)
    require_two_cameras(trial)
    given_start(trial)
    open_bodies(trial, settings)
    require_own_folder(out, [trial.folder, *trial.input_files])
    WorkFolder(out).close()


def require_other_body(settings: CaptureSettings, out: Path) -> None:
    """Check that the body from which a run starts is not the one that it writes.

    Args:
        settings: Settings of the run.
        out: Folder for the results.

    Raises:
        FileProblem: It is.
    """
    if settings.body_file is not None and settings.body_file.resolve().parent == out.resolve():
        wrong = "is in the folder of the results, to which this run writes the body that it finds"
        raise FileProblem(settings.body_file, wrong, "Copy it, or give another folder for the results (--out).")


@contextmanager
def opened(
    trial: Trial,
    settings: CaptureSettings,
    progress: Progress,
    *,
    more: Sequence[Path] = (),
    corrected: Path | None = None,
    observations: Mapping[int, Sequence[Observation]] | None = None,
    captured: Mapping[int, CapturedPerson] | None = None,
    results: Sequence[str] = (),
) -> "Iterator[tuple[Run, Bodies, Logs]]":
    """Open a run on a trial, with the checkpoints of an interrupted run.

    Args:
        trial: The trial, opened with `settings.changes()`.
        settings: Settings of the run.
        progress: Progress reporter.
        more: Other files on which the results depend.
        corrected: A file of cameras in the world of the results that replace the calibrated ones, if it exists.
        observations: Further observations by frame. What such a run has finished is not found by another one.
        captured: Other people of the trial that were captured before, by their numbers.
        results: Names of files that are written in any case; those of the user are not replaced.

    Yields:
        The run, its bodies, and the logs of its silhouettes.

    Raises:
        FileProblem: Something in the trial cannot be used.
    """
    out = settings.out or trial.folder / "marey"
    require_other_body(settings, out)
    if corrected is not None and corrected.is_file() and not corrected.samefile(trial.calibration):
        trial, more = with_corrected_cameras(trial, corrected, progress), [*more, corrected]
    require_two_cameras(trial)
    # It is read again where it is needed; an error in it is to be reported before the work begins.
    given_start(trial)
    for note in trial.take.notes:
        progress.warn(note)
    bodies = open_bodies(trial, settings)
    named = [*trial.input_files, *([settings.body_file] if settings.body_file else []), *more]
    how = f"{settings.body if settings.body_file is None else ''}, {settings.fixed_sizes}, {settings.surface_tracks}"
    how += "" if settings.camera_uncertainty else ", cameras are exact"
    own = [uuid4().hex] if observations else []
    others = sorted(captured or {})
    require_own_folder(out, more)
    prints = [file_fingerprint(path) for path in named]
    cache = StageCache(out, [*prints, how, *own, *others], files=[trial.folder, *trial.input_files], results=results)
    used = trial.take.first, trial.take.end, trial.settings.model_dump_json(), trial.clocks
    scope = (trial.rig.names, trial.rig.packed.tobytes(), *used)
    with (
        cache,
        cache.frames("silhouettes", depends=scope) as log,
        cache.frames("common", depends=scope) as common,
        cache.frames("outlines", depends=scope) as better,
    ):
        run = Run(
            trial, settings, progress, cache, scope, out, observations=observations or {}, captured=captured or {}
        )
        yield run, bodies, Logs(log, common, better)


@dataclass(frozen=True, eq=False)
class Run:
    """One run of a capture."""

    trial: Trial
    settings: CaptureSettings
    progress: Progress
    cache: StageCache
    scope: object
    """Everything that all stages depend on besides the input files."""
    out: Path
    person: PersonSettings = field(default_factory=PersonSettings)
    observations: Mapping[int, Sequence[Observation]] = field(default_factory=dict)
    """Further observations by frame."""
    captured: Mapping[int, CapturedPerson] = field(default_factory=dict)
    """Other people of the trial that were captured before, by their numbers."""
    checks_clocks: bool = False
    """Whether the run ends with `ClocksDisagree` if the silhouettes show that the cameras have clocks of their own."""
    checks_cameras: bool = False
    """Whether the run ends with `CamerasContradict` or `CameraKnocked` if the silhouettes contradict each other, and a
    repair is known."""
    repairs: Repairs = field(default_factory=Repairs)
    """What was repaired in the trial before this run."""
    reasons: list[VerdictReason] = field(default_factory=list)
    """Receives what limits the use of the result."""
    moved: Camera | None = None
    """The camera that was found again by the silhouettes, as it was calibrated; None if there is none."""

    def with_captured(self, others: OtherPeople | None) -> OtherPeople | None:
        """Return other people together with those that were captured before; None if there is nobody."""
        parts = [*([] if others is None else [others]), *self.captured.values()]
        return JoinedPeople(parts) if len(parts) > 1 else parts[0] if parts else None

    @cached_property
    def times(self) -> PictureTimes | None:
        """When the cameras have taken their pictures; None if all of them are of the instants of the frames."""
        take, shutter = self.trial.take, self.trial.shutter
        if shutter is None:
            return None if take.late is None else PictureTimes(take.late)
        late = np.zeros((len(self.trial.rig), take.count)) if take.late is None else take.late
        rows = PictureRows(cameras=tuple(self.trial.rig), readout=shutter.readout_s * take.rate, sides=shutter.sides)
        return PictureTimes(late, rows)

    @property
    def further(self) -> FrameTermsFactory | None:
        """The further observations as terms of the refinement; None without any."""
        return FrameObservations(self.observations).terms_of_round if self.observations else None


@dataclass(frozen=True, eq=False)
class Logs:
    """The logs with the silhouettes of a run."""

    first: FrameLog
    """Silhouettes from the images alone."""
    common: FrameLog
    """The part that the cameras have in common, if much of them is not the person."""
    outlines: FrameLog
    """Silhouettes with the tracked person as prior."""


@dataclass(frozen=True, eq=False)
class Bodies:
    """The body that is captured, with many and with few vertices."""

    fine: Body
    coarse: Body

    def held(self) -> "Bodies":
        """Return the same bodies with fixed sizes."""
        return Bodies(with_fixed_shape(self.fine), with_fixed_shape(self.coarse))


def require_two_cameras(trial: Trial) -> None:
    """Check that depth can be measured.

    Args:
        trial: The trial.

    Raises:
        FileProblem: There is only one camera.
    """
    if len(trial.rig.names) < 2:
        wrong = f"has only the camera '{trial.rig.names[0]}'"
        raise FileProblem(trial.calibration, wrong, "Depth needs at least two cameras; select more of them.")


def with_corrected_cameras(trial: Trial, corrected: Path, progress: Progress) -> Trial:
    """Replace the cameras of a trial by those that an earlier measurement corrected, and warn of it.

    Args:
        trial: The trial.
        corrected: The file with the corrected cameras.
        progress: Progress reporter.

    Returns:
        The trial with the corrected cameras; the given one if some of them are missing.

    Raises:
        FileProblem: The file cannot be read.
    """
    rig = read_rig(corrected)
    missing = [name for name in trial.rig.names if name not in rig.names]
    if missing:
        progress.warn(f"{corrected} lacks {', '.join(missing)}: the calibrated cameras are used.")
        return trial
    progress.warn(f"The cameras are those that an earlier measurement corrected: {corrected}.")
    return replace(trial, rig=Rig(tuple(rig[name] for name in trial.rig.names)))


def open_bodies(trial: Trial, settings: CaptureSettings) -> Bodies:
    """Open the body that the user gave, or make an average one, with the stature if it is known.

    The start tries many postures and needs a body of few vertices. A body of an earlier take has a twin with few
    vertices, the same shape parameters and the same joints. A scan has none and is used itself: the time of the start
    grows with its vertices, but little below 2000. A full body is reduced to what the preset follows.

    Args:
        trial: The trial, with preset and stature.
        settings: Settings of the run, with the body.

    Returns:
        The body with many and with few vertices.
    """
    preset, stature = trial.settings.preset or "full", trial.settings.stature_m
    detail = GENERIC_BODIES.get(str(settings.body))
    fine, coarse = (
        metaball_person(detail, level, preset=preset, stature_m=stature)
        if detail
        else person_body(level, preset=preset, stature_m=stature)
        for level in LEVELS
    )
    if settings.body_file is None:
        return Bodies(fine, coarse)
    given = as_known(open_body(settings.body_file, fine))
    if preset != "full" and given.followed_joints.all():
        given = preset_body(given, PRESETS[preset])
    return Bodies(given, coarse_twin(given, coarse) or given)


def whole_bodies(trial: Trial) -> tuple[Body, Body]:
    """Return the average body of a whole person with few and with many vertices, with the stature if it is known."""
    fine, coarse = (person_body(level, stature_m=trial.settings.stature_m) for level in LEVELS)
    return coarse, fine


def as_known(body: Body) -> Body:
    """Replace the prior of people by the result of an earlier fit of the body's shape parameters."""
    covariance = body.numbers_covariance
    if covariance is None or not len(body.numbers):
        return body
    space = replace(body.space, prior_mean=body.numbers, prior_covariance=covariance)
    balls = metaballs_of(body)
    if balls is not None:
        balls = replace(balls, prior_mean=body.numbers, prior_covariance=covariance)
    return replace(body, space=space, metaballs=balls)


def coarse_twin(given: Body, coarse: Body) -> Body | None:
    """Return a body of few vertices with the shape of another; None if its numbers have other joints."""
    if given.metaballs is not None:
        return metaball_twin(given, coarse)
    same = given.space.names == coarse.space.names and given.skeleton.segment_names == coarse.skeleton.segment_names
    if not same or given.skeleton.coordinate_names != coarse.skeleton.coordinate_names:
        return None
    prior = replace(
        coarse.space, prior_mean=given.space.prior_mean, prior_covariance=given.space.prior_covariance
    )  # fmt: skip
    twin = replace(with_shape(given, coarse), space=prior)
    return twin if np.allclose(twin.joint_centres, given.joint_centres, atol=TWIN_M) else None


def metaball_twin(given: Body, coarse: Body) -> Body | None:
    """Return the vertices of another body on the metaballs of this one; None if its coordinates differ."""
    space = metaballs_of(given)
    if space is None or given.skeleton.coordinate_names != coarse.skeleton.coordinate_names:
        return None
    generic = metaball_body(space, template=coarse, keep_weights=True)
    return with_shape(given, replace(generic, skeleton=given.skeleton))

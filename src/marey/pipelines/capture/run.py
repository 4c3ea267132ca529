"""One run on a trial: what is captured, with which body, and what an interrupted run left."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from uuid import uuid4

import numpy as np

from marey.body.articulation.presets import GENERIC_BODIES, PRESETS
from marey.body.articulation.surface import Body
from marey.body.metaballs.metaball_people import metaball_person
from marey.body.metaballs.metaball_person import metaball_body, metaballs_of
from marey.body.people.family import LEVELS
from marey.body.people.person import person_body, preset_body
from marey.cameras.rig import Rig
from marey.errors import FileProblem
from marey.fit.recipes.frame_observations import FrameObservations
from marey.fit.recipes.person import (
    PersonSettings,
    with_shape,
)
from marey.fit.recipes.pick_up import of_one_shape
from marey.fit.recipes.sequence import Further
from marey.io.calibration.readers import read_rig
from marey.io.results.body import open_body
from marey.io.stages import FrameLog, file_fingerprint
from marey.io.trial.start_joints import read_start_joints
from marey.io.trial.trial import Trial
from marey.observations.observation import Observation
from marey.pipelines.capture.settings import CaptureSettings
from marey.pipelines.progress import Progress
from marey.pipelines.run_record import StageCache

TWIN_M = 1e-4
"""How near the joints of a body and of its twin with few vertices must lie [m]."""


@contextmanager
def opened(
    trial: Trial,
    settings: CaptureSettings,
    progress: Progress,
    *,
    more: Sequence[Path] = (),
    corrected: Path | None = None,
    observations: Mapping[int, Sequence[Observation]] | None = None,
) -> "Iterator[tuple[Run, Bodies, Logs]]":
    """Open a run on a trial, and what an interrupted run on it left.

    Args:
        trial: The trial, opened with `settings.changes()`.
        settings: Settings of the run.
        progress: Progress reporter.
        more: Other files on which the results depend.
        corrected: A file of cameras in the world of the results that replace the calibrated ones, if it exists.
        observations: Further observations by frame. What such a run has finished is not found by another one.

    Yields:
        The run, its bodies, and the logs of its silhouettes.

    Raises:
        FileProblem: Something in the trial cannot be used.
    """
    out = settings.out or trial.folder / "marey"
    if corrected is not None and corrected.is_file() and not corrected.samefile(trial.calibration):
        trial, more = with_corrected_cameras(trial, corrected, progress), [*more, corrected]
    require_two_cameras(trial)
    if trial.start is not None:
        # It is read again where it is needed; an error in it is to be reported before the work begins.
        read_start_joints(trial.start, trial.rig, count=trial.take.count)
    for note in trial.take.notes:
        progress.warn(note)
    bodies = open_bodies(trial, settings)
    named = [*trial.input_files, *([settings.body_file] if settings.body_file else []), *more]
    how = f"{settings.body if settings.body_file is None else ''}, {settings.fixed_sizes}"
    own = [uuid4().hex] if observations else []
    cache = StageCache(out, [*(file_fingerprint(path) for path in named), how, *own])
    scope = (trial.rig.names, trial.take.first, trial.take.end, trial.settings.model_dump_json())
    with (
        cache,
        cache.frames("silhouettes", depends=scope) as log,
        cache.frames("common", depends=scope) as common,
        cache.frames("outlines", depends=scope) as better,
    ):
        run = Run(trial, settings, progress, cache, scope, out, observations=observations or {})
        yield run, bodies, Logs(log, common, better)


@dataclass(frozen=True, eq=False)
class Run:
    """One run of a capture: what is captured, how, and where to."""

    trial: Trial
    settings: CaptureSettings
    progress: Progress
    cache: StageCache
    scope: object
    """What every stage depends on besides the input files."""
    out: Path
    person: PersonSettings = field(default_factory=PersonSettings)
    observations: Mapping[int, Sequence[Observation]] = field(default_factory=dict)
    """Further observations by frame."""

    @property
    def further(self) -> Further | None:
        """The further observations as terms of the refinement; None without any."""
        return FrameObservations(self.observations).of_round if self.observations else None


@dataclass(frozen=True, eq=False)
class Logs:
    """Where the silhouettes of a run are kept."""

    first: FrameLog
    """Found from the pictures alone."""
    common: FrameLog
    """What the cameras have in common of them, where much is not the person's."""
    outlines: FrameLog
    """Found about the person."""


@dataclass(frozen=True, eq=False)
class Bodies:
    """The body that is captured, with many vertices and with few."""

    fine: Body
    coarse: Body

    def held(self) -> "Bodies":
        """The same bodies, whose sizes nothing changes."""
        return Bodies(of_one_shape(self.fine), of_one_shape(self.coarse))


def require_two_cameras(trial: Trial) -> None:
    """Check that depth can be measured.

    Raises:
        FileProblem: There is a single camera.
    """
    if len(trial.rig.names) < 2:
        wrong = f"has only the camera '{trial.rig.names[0]}'"
        raise FileProblem(trial.calibration, wrong, "Depth needs at least two cameras; keep more with --cameras.")


def with_corrected_cameras(trial: Trial, corrected: Path, progress: Progress) -> Trial:
    """Let a trial have the cameras as the measured surface corrected them, and say so.

    Raises:
        FileProblem: The file cannot be read.
    """
    rig = read_rig(corrected)
    missing = [name for name in trial.rig.names if name not in rig.names]
    if missing:
        progress.warn(f"{corrected} lacks {', '.join(missing)}; the cameras stay as they were calibrated.")
        return trial
    progress.warn(f"The cameras are those that the measured surface corrected: {corrected}.")
    return replace(trial, rig=Rig(tuple(rig[name] for name in trial.rig.names)))


def open_bodies(trial: Trial, settings: CaptureSettings) -> Bodies:
    """Open the body that the user gave, or make the one of whom nothing is known but perhaps the stature.

    The start tries many postures and wants few vertices. A body of an earlier take has a twin with few vertices, the
    same shape numbers and the same joints. A scan has none and is used as it is: the start takes the longer the more
    vertices it has; below 2000 they hardly count. Of a whole body only what the preset follows is left.
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


def as_known(body: Body) -> Body:
    """Expect of a body what an earlier fit knows of its numbers, instead of what is expected of people."""
    covariance = body.numbers_covariance
    if covariance is None or not len(body.numbers):
        return body
    space = replace(body.space, prior_mean=body.numbers, prior_covariance=covariance)
    balls = metaballs_of(body)
    if balls is not None:
        balls = replace(balls, prior_mean=body.numbers, prior_covariance=covariance)
    return replace(body, space=space, metaballs=balls)


def coarse_twin(given: Body, coarse: Body) -> Body | None:
    """Give a body of few vertices the shape of another, or None where its numbers do not mean the same joints."""
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
    """Bring the few vertices of another body onto the metaballs of one, or give None where they move otherwise."""
    space = metaballs_of(given)
    if space is None or given.skeleton.coordinate_names != coarse.skeleton.coordinate_names:
        return None
    generic = metaball_body(space, template=coarse, keep_weights=True)
    return with_shape(given, replace(generic, skeleton=given.skeleton))

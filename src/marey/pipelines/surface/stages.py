"""The stages of a surface measurement: the cameras checked by the matches, and the points of every frame."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from marey.arrays import Floats, Image, Mask
from marey.cameras.rig import Rig
from marey.errors import FileProblem
from marey.geometry.rigid import RigidTransform
from marey.images.silhouettes.background import Background
from marey.images.silhouettes.silhouettes import segment
from marey.images.silhouettes.unexplained import unexplained_texture
from marey.io.stages import Arrays, FrameLog
from marey.io.trial.trial import Trial
from marey.pipelines.capture import stages
from marey.pipelines.progress import Progress
from marey.surface.points.clicked import clicked_seeds
from marey.surface.points.dense import GivenSeeds, Tuples, match_tuples
from marey.surface.points.intersection import FLOOR_PX, intersect
from marey.surface.points.measured import MeasuredPoints, joined, shapes
from marey.surface.points.refine_rig import RigRefinement, Sighting, refine_rig
from marey.surface.points.settings import SurfaceSettings
from marey.surface.points.views import Comparison, View, comparisons, views_of

SAMPLES = 5
"""Frames whose matches tell whether the cameras are right."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Measurement:
    """One run: what is measured, and how."""

    trial: Trial
    settings: SurfaceSettings
    progress: Progress
    clicks: Floats | None = None
    """(n, C, 2) seeds clicked in the first frame [px]."""
    backgrounds: Sequence[Background] = ()
    """The empty pictures, one a camera, where they are known."""
    remembered: dict[int, list[Tuples]] = field(default_factory=dict)
    """Matches of frames that were looked at to check the cameras."""

    @cached_property
    def compared(self) -> tuple[Comparison, ...]:
        """Templates, and where each is looked for."""
        return comparisons(self.trial.rig, angle=self.settings.angle)

    @property
    def threads(self) -> int:
        """How many things are done at once."""
        return os.cpu_count() or 1

    def views(self, rig: Rig, frame: int, images: Sequence[Image]) -> tuple[View, ...]:
        """Make the pictures of a frame ready."""
        return views_of(rig, images, self._masks(frame, images))

    def _masks(self, frame: int, images: Sequence[Image]) -> Sequence[Mask] | None:
        if self.trial.masks:
            return [next(iter(self.trial.masks[name].masks([frame]))) for name in self.trial.rig.names]
        if self.backgrounds:
            return [before_the_room(image, empty) for image, empty in zip(images, self.backgrounds, strict=True)]
        return None

    def tuples(self, views: Sequence[View], frame: int) -> list[Tuples]:
        """Match the pictures of a frame."""
        if frame in self.remembered:
            return self.remembered.pop(frame)
        given = self._given(views) if frame == self.trial.take.first else None
        return [match_tuples(views, each, self.settings, given=given, threads=self.threads) for each in self.compared]

    def _given(self, views: Sequence[View]) -> GivenSeeds | None:
        if self.clicks is None:
            return None
        seeds, confirmed = clicked_seeds(views, self.compared, self.clicks, self.settings)
        if not confirmed.all():
            rows = ", ".join(str(row + 1) for row in np.flatnonzero(~confirmed))
            self.progress.warn(f"The pictures do not confirm the clicked seeds number {rows}; they are left out.")
        return seeds


def measurement(trial: Trial, settings: SurfaceSettings, clicks: Floats | None, progress: Progress) -> Measurement:
    """Prepare a run; pictures of the empty room, where all cameras have one, tell where the person is.

    Raises:
        FileProblem: The cameras stand too far apart.
    """
    backgrounds: Sequence[Background] = ()
    if not trial.masks and set(trial.background) == set(trial.rig.names):
        backgrounds, _ = stages.backgrounds(trial, progress)
    run = Measurement(trial=trial, settings=settings, progress=progress, clicks=clicks, backgrounds=backgrounds)
    if not run.compared:
        wrong = f"has no two cameras whose views differ by less than {np.degrees(settings.angle):.0f} degrees"
        remedy = "Patches do not look alike from so far apart; a surface needs cameras 10 to 25 degrees apart."
        raise FileProblem(trial.calibration, wrong, remedy)
    return run


def before_the_room(image: Image, empty: Background) -> Mask:
    """Tell where somebody stands before the empty room, by the silhouette or by texture that is not the room's."""
    return segment(image, empty).mask | unexplained_texture(image, empty.mean)


def sample_frames(trial: Trial) -> list[int]:
    """Choose frames all over the take."""
    first, end = trial.take.first, trial.take.end
    return sorted({int(f) for f in np.linspace(first, end - 1, min(SAMPLES, end - first)).round()})


def checked_rig(run: Measurement) -> RigRefinement | None:
    """Let the matches of some frames say whether the cameras stand as they were calibrated."""
    trial, wanted = run.trial, sample_frames(run.trial)
    sightings: dict[int, list[Sighting]] = {}
    with run.progress.stage("Cameras", len(wanted)) as step:
        for frame in wanted:
            try:
                images = trial.take.images(frame)
            except FileProblem:
                # It is told when the frames before it have been measured.
                continue
            found = run.tuples(run.views(trial.rig, frame, images), frame)
            run.remembered[frame] = found
            for number, tuples in enumerate(found):
                sighting = Sighting(pixels=tuples.pixels, sigma=np.hypot(tuples.sd, FLOOR_PX))
                sightings.setdefault(number, []).append(sighting)
            step()
    every = [sighting for several in sightings.values() for sighting in several]
    return refine_rig(trial.rig, every, fixed=run.compared[0].template)


def measure_frames(run: Measurement, rig: Rig, log: FrameLog) -> None:
    """Measure the frames that are not in the log yet."""
    take = run.trial.take
    with run.progress.stage("Surface", take.end - take.first, done=len(log)) as step:
        for frame, images in take.frames(first=take.first + len(log)):
            views = run.views(rig, frame, images)
            parts = [intersect(views, tuples, run.settings, frame=frame) for tuples in run.tuples(views, frame)]
            log.append(_kept(joined(parts)))
            step()


def _kept(points: MeasuredPoints) -> dict[str, np.ndarray]:
    """Give a frame's arrays, in single precision but for the points."""
    arrays = points.arrays()
    del arrays["camera_names"]
    return {
        name: array.astype(np.float32) if array.dtype == float and name != "points" else array
        for name, array in arrays.items()
    }


class KeptFrames(Sequence[MeasuredPoints]):
    """The frames of a log as measured points, read when they are asked for.

    Args:
        log: One record a frame.
        camera_names: The cameras.
    """

    def __init__(self, log: FrameLog, camera_names: Sequence[str]):
        self._log, self._names = log, tuple(camera_names)

    def __len__(self) -> int:
        """Count the frames."""
        return len(self._log)

    def __getitem__(self, number):  # type: ignore[no-untyped-def]
        if number >= len(self._log):
            raise IndexError(number)
        record = self._log[number]
        return MeasuredPoints(camera_names=self._names, **{name: record[name] for name in shapes(0)})


def rig_arrays(refined: RigRefinement | None, rig: Rig) -> Arrays:
    """Give what a check of the cameras found as arrays, to be kept."""
    if refined is None:
        return {"checked": np.array(False)}
    poses = np.stack([camera.camera_from_world.matrix for camera in refined.rig])
    found = {name: np.asarray(getattr(refined, name)) for name in _NUMBERS}
    return {"checked": np.array(True), "poses": poses, **found}


_NUMBERS = ("turn", "shift", "moved_px", "residual_before", "residual_after", "tuples")


def rig_from(arrays: Mapping[str, np.ndarray], rig: Rig) -> RigRefinement | None:
    """Undo `rig_arrays`."""
    if not arrays["checked"]:
        return None
    cameras = [
        replace(camera, camera_from_world=RigidTransform.from_matrix(pose))
        for camera, pose in zip(rig, arrays["poses"], strict=True)
    ]
    return RigRefinement(
        rig=Rig(tuple(cameras)), turn=arrays["turn"], shift=arrays["shift"], moved_px=arrays["moved_px"],
        residual_before=float(arrays["residual_before"]), residual_after=float(arrays["residual_after"]),
        tuples=int(arrays["tuples"]),
    )  # fmt: skip


def why_nothing(trial: Trial, run: Measurement, images: Sequence[Image]) -> FileProblem:
    """Say why no surface was found."""
    from marey.surface.points.seeds import corners

    views = run.views(trial.rig, trial.take.first, images)
    hidden = [v.camera.name for v in views if v.mask is not None and not v.mask.any()]
    if hidden:
        wrong = f"shows nobody before the empty room in {', '.join(hidden)}"
        return FileProblem(trial.folder, wrong, "Take the pictures in background/ or masks/ away, or mend them.")
    flat = [v.camera.name for v in views if len(corners(v, most=run.settings.seeds)) < _FEW_CORNERS]
    if flat:
        wrong = f"has no texture in the pictures of {', '.join(flat)} that tells one place from the next"
        remedy = "Sharpen the focus, shorten the exposure, or speckle the surface (paint, make-up, a printed shirt)."
        return FileProblem(trial.folder, wrong, remedy)
    names = ", ".join(trial.rig.names)
    wrong = f"shows no surface that {names} have in common"
    remedy = (
        "Do the pictures show the same thing at the same instant, sharply, and is this their calibration? "
        "Cameras should stand 10 to 25 degrees apart; a few clicked seeds may help (--seeds)."
    )
    return FileProblem(trial.folder, wrong, remedy)


_FEW_CORNERS = 20

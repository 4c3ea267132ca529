"""The stages of a surface measurement: correction of the cameras by the matches, and the points of every frame."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np

from marey.arrays import Floats, Image, Mask
from marey.cameras.rig import Rig
from marey.errors import FileProblem
from marey.fit.solver.threads import map_in_threads, usable_threads
from marey.geometry.rigid import RigidTransform
from marey.images.silhouettes.background import Background
from marey.images.silhouettes.silhouettes import segment
from marey.images.silhouettes.unexplained import RoomTexture, unexplained_texture
from marey.io.stages import Arrays, FrameLog
from marey.io.trial.trial import Trial
from marey.pipelines.causes.pictures import PicturesOfInstant, picture_reasons
from marey.pipelines.progress import Progress
from marey.pipelines.silhouettes.empty_rooms import model_backgrounds
from marey.pipelines.verdict import NotUsable, Verdict, VerdictReason
from marey.surface.points.clicked import clicked_seeds
from marey.surface.points.dense import GivenSeeds, Tuples, match_tuples
from marey.surface.points.intersection import intersect
from marey.surface.points.measured import MeasuredPoints, joined, shapes, without_repeats
from marey.surface.points.refine_rig import RigRefinement, Sighting, refine_rig
from marey.surface.points.seeds import corners
from marey.surface.points.settings import RigRefinementSettings, SurfaceSettings
from marey.surface.points.views import SurfaceView, TemplateSearch, comparisons, views_of

SAMPLES = 5
"""Frames whose matches are used to correct the cameras.

Chosen by hand; results were not measured against other values.
"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Measurement:
    """One run of a surface measurement."""

    trial: Trial
    settings: SurfaceSettings
    progress: Progress
    clicks: Floats | None = None
    """(n, C, 2) seeds clicked in the first frame [px]; None without seeds."""
    backgrounds: Sequence[Background] = ()
    """The backgrounds, one per camera; empty if they are not known."""
    remembered: dict[int, list[Tuples]] = field(default_factory=dict)
    """Matches by frame that were already found to correct the cameras."""

    @cached_property
    def compared(self) -> tuple[TemplateSearch, ...]:
        """Each template camera with the cameras in which its patches are searched."""
        return comparisons(self.trial.rig, angle=self.settings.angle, most_searched=self.settings.most_searched)

    @cached_property
    def _textures(self) -> tuple[RoomTexture, ...]:
        return tuple(RoomTexture.of(empty.mean) for empty in self.backgrounds)

    @property
    def threads(self) -> int:
        """Number of threads."""
        return usable_threads()

    def views(self, rig: Rig, frame: int, images: Sequence[Image]) -> tuple[SurfaceView, ...]:
        """Prepare the images of a frame."""
        return views_of(rig, images, self._masks(frame, images))

    def _masks(self, frame: int, images: Sequence[Image]) -> Sequence[Mask] | None:
        if self.trial.masks:
            return [next(iter(self.trial.masks[name].masks([frame]))) for name in self.trial.rig.names]
        if self.backgrounds:
            rooms = zip(images, self.backgrounds, self._textures, strict=True)
            return [foreground(image, empty, texture) for image, empty, texture in rooms]
        return None

    def tuples(self, views: Sequence[SurfaceView], frame: int) -> list[Tuples]:
        """Match the images of a frame."""
        if frame in self.remembered:
            return self.remembered.pop(frame)
        given = self._given(views) if frame == self.trial.take.first else None
        return [match_tuples(views, each, self.settings, given=given, threads=self.threads) for each in self.compared]

    def _given(self, views: Sequence[SurfaceView]) -> GivenSeeds | None:
        if self.clicks is None:
            return None
        seeds, confirmed = clicked_seeds(views, self.compared, self.clicks, self.settings)
        if not confirmed.all():
            rows = ", ".join(str(row + 1) for row in np.flatnonzero(~confirmed))
            self.progress.warn(f"The images do not confirm the clicked seeds in rows {rows}: these seeds are ignored.")
        return seeds


def measurement(trial: Trial, settings: SurfaceSettings, clicks: Floats | None, progress: Progress) -> Measurement:
    """Prepare a run; images of the empty room, if all cameras have one, give the region of the person.

    Args:
        trial: The trial.
        settings: Settings of the matching.
        clicks: (n, C, 2) clicked seeds [px]; None without seeds.
        progress: Progress reporter.

    Returns:
        The run.

    Raises:
        FileProblem: The cameras are too far apart.
    """
    backgrounds: Sequence[Background] = ()
    if not trial.masks and set(trial.background) == set(trial.rig.names):
        backgrounds, _ = model_backgrounds(trial, progress)
    run = Measurement(trial=trial, settings=settings, progress=progress, clicks=clicks, backgrounds=backgrounds)
    if not run.compared:
        wrong = f"has no two cameras whose views differ by less than {np.degrees(settings.angle):.0f} degrees"
        remedy = "Patches look too different from so far apart: a surface needs cameras 10 to 25 degrees apart."
        raise FileProblem(trial.calibration, wrong, remedy)
    return run


def foreground(image: Image, empty: Background, texture: RoomTexture) -> Mask:
    """Return the region in front of the empty room: the silhouette, and texture that the background lacks."""
    return segment(image, empty).mask | unexplained_texture(image, texture)


def sample_frames(trial: Trial) -> list[int]:
    """Return frames that are spread over the take."""
    first, end = trial.take.first, trial.take.end
    return sorted({int(f) for f in np.linspace(first, end - 1, min(SAMPLES, end - first)).round()})


def checked_rig(run: Measurement) -> RigRefinement | None:
    """Estimate from the matches of some frames whether and how the cameras differ from their calibration."""
    trial, wanted = run.trial, sample_frames(run.trial)
    floor_px = run.settings.intersection.floor_px
    sightings: dict[int, list[Sighting]] = {}

    def work(given: tuple[int, Sequence[Image]]) -> tuple[int, list[Tuples]]:
        frame, images = given
        return frame, run.tuples(run.views(trial.rig, frame, images), frame)

    with run.progress.stage("Cameras", len(wanted)) as step:
        for frame, found in map_in_threads(work, _undamaged(trial, wanted)):
            run.remembered[frame] = found
            for number, tuples in enumerate(found):
                sighting = Sighting(pixels=tuples.pixels, sigma=np.hypot(tuples.sd, floor_px))
                sightings.setdefault(number, []).append(sighting)
            step()
    every = [sighting for several in sightings.values() for sighting in several]
    return refine_rig(trial.rig, every, fixed=run.compared[0].template, settings=run.settings.refinement)


def _undamaged(trial: Trial, wanted: Sequence[int]) -> Iterator[tuple[int, Sequence[Image]]]:
    """Read frames; a damaged one is reported after the frames before it have been measured."""
    for frame in wanted:
        with suppress(FileProblem):
            yield frame, trial.take.images(frame)


def measure_frames(run: Measurement, rig: Rig, log: FrameLog) -> None:
    """Measure the frames that are not in the log yet, several at a time.

    Raises:
        FileProblem: A frame is damaged; the frames before it are in the log.
    """
    take = run.trial.take
    damaged: list[FileProblem] = []

    def frames(first: int) -> Iterator[tuple[int, Sequence[Image]]]:
        try:
            yield from take.frames(first=first)
        except FileProblem as problem:
            damaged.append(problem)

    def work(given: tuple[int, Sequence[Image]]) -> Arrays:
        frame, images = given
        views = run.views(rig, frame, images)
        parts = [intersect(views, tuples, run.settings, frame=frame) for tuples in run.tuples(views, frame)]
        return _kept(without_repeats(joined(parts), rig.cameras, spacing=run.settings.spacing))

    with run.progress.stage("Surface", take.end - take.first, done=len(log)) as step:
        for record in map_in_threads(work, frames(take.first + len(log))):
            log.append(record)
            step()
    if damaged:
        raise damaged[0]


def _kept(points: MeasuredPoints) -> dict[str, np.ndarray]:
    """Return the arrays of a frame, all but the points in single precision."""
    arrays = points.arrays()
    del arrays["camera_names"]
    return {
        name: array.astype(np.float32) if array.dtype == float and name != "points" else array
        for name, array in arrays.items()
    }


class KeptFrames(Sequence[MeasuredPoints]):
    """The frames of a log as measured points, whose arrays are read when they are used, and not kept.

    Args:
        log: One record per frame.
        camera_names: Names of the cameras.
    """

    def __init__(self, log: FrameLog, camera_names: Sequence[str]):
        self._log, self._names = log, tuple(camera_names)
        self._counts: dict[int, int] = {}

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._log)

    def __getitem__(self, number):  # type: ignore[no-untyped-def]
        if number >= len(self._log):
            raise IndexError(number)
        if number not in self._counts:
            self._counts[number] = len(self._log.array(number, "frame"))
        return _KeptPoints(self._log, number, self._counts[number], self._names)


class _KeptPoints(MeasuredPoints):
    """Points of one frame of a log; an array is read whenever it is used."""

    _log: FrameLog
    _number: int
    _count: int

    def __init__(self, log: FrameLog, number: int, count: int, camera_names: tuple[str, ...]):
        for name, value in (("_log", log), ("_number", number), ("_count", count), ("camera_names", camera_names)):
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return self._count

    def __getattr__(self, name: str) -> np.ndarray:
        """Read a field that is not an attribute yet."""
        if name not in shapes(0):
            raise AttributeError(name)
        array = self._log.array(self._number, name)
        return array.astype(float) if array.dtype == np.float32 else array


def rig_arrays(refined: RigRefinement | None, rig: Rig) -> Arrays:
    """Return a correction of the cameras as arrays, to be stored."""
    if refined is None:
        return {"checked": np.array(False)}
    poses = np.stack([camera.camera_from_world.matrix for camera in refined.rig])
    found = {name: np.asarray(getattr(refined, name)) for name in _NUMBERS}
    return {"checked": np.array(True), "poses": poses, **found}


_NUMBERS = ("rotation", "shift", "moved_px", "residual_before", "residual_after", "tuples")
"""Fields of a `RigRefinement` that are stored under their own names."""


def rig_from(arrays: Mapping[str, np.ndarray], rig: Rig, settings: RigRefinementSettings) -> RigRefinement | None:
    """Return the correction that `rig_arrays` has stored."""
    if not arrays["checked"]:
        return None
    cameras = [
        replace(camera, camera_from_world=RigidTransform.from_matrix(pose))
        for camera, pose in zip(rig, arrays["poses"], strict=True)
    ]
    return RigRefinement(
        rig=Rig(tuple(cameras)), rotation=arrays["rotation"], shift=arrays["shift"], moved_px=arrays["moved_px"],
        residual_before=float(arrays["residual_before"]), residual_after=float(arrays["residual_after"]),
        tuples=int(arrays["tuples"]), settings=settings,
    )  # fmt: skip


def cause_in_pictures(run: Measurement, *, suspicious: bool) -> tuple[VerdictReason, ...]:
    """Compare the pictures of the middle frame with the calibration, and find the cause if they contradict it.

    Args:
        run: The run.
        suspicious: Whether the measured points make a contradiction likely.

    Returns:
        The cause; empty if there is none, or if it is not known.
    """
    take = run.trial.take
    frame = (take.first + take.end - 1) // 2
    near = range(max(take.first, frame - _REACH), min(take.end, frame + _REACH + 1))
    others = {each - frame: partial(take.images, each) for each in near if each != frame}
    with run.progress.stage("Comparison of the pictures"):
        try:
            images = take.images(frame)
            views = run.views(run.trial.rig, frame, images)
            masks = [view.mask for view in views if view.mask is not None]
            shown = PicturesOfInstant(
                rig=run.trial.rig, images=images, pairs=_pairs(run.compared), others=others, masks=masks or None
            )
            return picture_reasons(shown, suspicious=suspicious)
        except FileProblem:
            # A damaged frame has its own message.
            return ()


def _pairs(compared: Sequence[TemplateSearch]) -> list[tuple[int, int]]:
    return sorted({(min(each.template, i), max(each.template, i)) for each in compared for i in each.searched})


def why_nothing(run: Measurement) -> NotUsable:
    """Return the verdict that explains why no surface was found."""
    trial = run.trial
    views = run.views(trial.rig, trial.take.first, trial.take.images(trial.take.first))
    hidden = [v.camera.name for v in views if v.mask is not None and not v.mask.any()]
    if hidden:
        what = f"{trial.folder} shows nothing in front of the empty room in {', '.join(hidden)}."
        remedy = "Remove or replace the images in background/ or masks/."
        return NotUsable(Verdict.of([VerdictReason.failure(what, remedy, cameras=hidden)]))
    own = run.settings
    strong = [len(corners(view, most=own.seeds, settings=own.seed_search)) for view in views]
    flat = [view.camera.name for view, count in zip(views, strong, strict=True) if count < _FEW_CORNERS]
    if flat:
        what = f"{trial.folder} has too little texture in the images of {', '.join(flat)}."
        remedy = "Improve the focus, shorten the exposure, or speckle the surface (paint, make-up, a printed shirt)."
        return NotUsable(Verdict.of([VerdictReason.failure(what, remedy, cameras=flat)]))
    causes = cause_in_pictures(run, suspicious=True)
    if causes:
        return NotUsable(Verdict.of(causes))
    what = f"{trial.folder} shows no surface that {', '.join(trial.rig.names)} have in common."
    remedy = (
        "Check that the images are sharp, show the same object at the same instant, and belong to this calibration. "
        "Cameras should stand 10 to 25 degrees apart; a few clicked seeds may help (--seeds)."
    )
    return NotUsable(Verdict.of([VerdictReason.failure(what, remedy)]))


_FEW_CORNERS = 20
"""Corners in an image below which the surface counts as without texture. Chosen by hand."""
_REACH = 5
"""Number of frames before and after the compared one whose pictures are tried. Chosen by hand, for the time."""

"""`marey nonrigid`: from videos, tracks or points in space to the shapes of a surface that deforms."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from marey.arrays import Floats, Integers, Mask
from marey.cli.nonrigid_input import NonRigidInput, read_input
from marey.cli.nonrigid_results import write_results
from marey.cli.nonrigid_settings import NonRigidOptions
from marey.cli.nonrigid_video import VideoTracks, follow_video
from marey.cli.progress import Progress
from marey.cli.run_record import StageCache
from marey.errors import SettingProblem
from marey.io.shapes import shape_arrays, shapes_from
from marey.io.stages import file_fingerprint
from marey.nonrigid import one_view
from marey.nonrigid.homogeneous import factorise_points
from marey.nonrigid.one_view import factorise_tracks
from marey.nonrigid.rank import choose_rank
from marey.nonrigid.recovered import RecoveredShapes, from_one_view, from_points, known_distance, usable, widened

_MOST_LISTED = 8


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredPoints:
    """What the shapes are recovered from; one of `tracks` and `points` is there."""

    tracks: Floats | None = None
    """(C, F, 2, P) where points were seen; NaN elsewhere."""
    points: Floats | None = None
    """(F, P, 3)."""
    labels: tuple[str, ...]
    edges: Integers
    unit: str
    """Of the input: px, m, or that nobody says it."""
    videos: tuple[VideoTracks, ...] = ()
    """What was followed."""

    @property
    def seen(self) -> Mask:
        """(F, P) by any camera."""
        if self.tracks is not None:
            return np.asarray(np.isfinite(self.tracks).all(2).any(0))
        assert self.points is not None
        return np.asarray(np.isfinite(self.points).all(2))


def nonrigid(paths: Sequence[Path], options: NonRigidOptions, progress: Progress) -> Path:
    """Recover shape and motion of a deforming surface, and write them.

    Args:
        paths: Videos, one a camera; or one file of tracks or points.
        options: What is asked for.
        progress: Is told, and keeps timings and warnings.

    Returns:
        The folder with the results.

    Raises:
        FileProblem: A file cannot be used.
        SettingProblem: A setting is impossible, or does not suit the input.
        MareyError: The data do not tell a shape.
    """
    with progress.stage("Reading"):
        given = read_input(paths, options)
    for note in given.notes:
        progress.warn(note)
    out = options.out or paths[0].with_name(f"{paths[0].stem}_marey")
    named = [*given.paths, *options.files]
    with threadpool_limits(1), StageCache(out, [file_fingerprint(path) for path in named]) as cache:
        measured = _measured(given, cache, progress)
        found = _recovered(given, measured, options, cache, progress)
        if measured.unit == "m":
            found = replace(found, metres_per_unit=1.0)
        if options.distance is not None:
            found = known_distance(found, *options.distance)
        write_results(given, measured, found, options, out, progress)
    for line in told(found, measured):
        progress.say(line)
    return out


def _measured(given: NonRigidInput, cache: StageCache, progress: Progress) -> MeasuredPoints:
    """Give what is known of the points; in videos they are followed first."""
    if given.data is not None:
        data = given.data
        return MeasuredPoints(
            tracks=data.tracks, points=data.points, labels=data.labels, edges=data.edges, unit=data.unit
        )  # fmt: skip
    videos = tuple(follow_video(given, number, cache, progress) for number in range(len(given.clips)))
    for name, video in zip(given.names, videos, strict=True):
        for note in video.notes:
            progress.warn(f"{name}: {note}" if len(videos) > 1 else note)
    tracks = np.stack([np.where(v.found.visible[:, None], v.found.tracks, np.nan) for v in videos])
    labels = tuple(map(str, range(tracks.shape[-1])))
    return MeasuredPoints(tracks=tracks, labels=labels, edges=np.zeros((0, 2), np.int64), unit="px", videos=videos)


def _recovered(
    given: NonRigidInput, measured: MeasuredPoints, options: NonRigidOptions, cache: StageCache, progress: Progress
) -> RecoveredShapes:
    """Factorise what was measured, as far as it holds enough; the rest has no answer."""
    asked = np.zeros(given.frames, bool)
    asked[given.asked] = True
    least = (3, 2) if measured.points is not None else (one_view.FEWEST_POINTS, one_view.FEWEST_FRAMES)
    frames, points = usable(measured.seen & asked[:, None], least_points=least[0], least_frames=least[1])
    for note in _left_out(asked & ~frames, ~points, measured.labels):
        progress.warn(note)

    def compute() -> dict[str, np.ndarray]:
        if measured.points is not None:
            return shape_arrays(_of_points(measured.points[np.ix_(frames, points)], options))
        assert measured.tracks is not None
        kept = measured.tracks[:, frames][..., points]
        if len(kept) > 1:
            raise SettingProblem("Several cameras are not read yet.")
        return shape_arrays(from_one_view(factorise_tracks(kept[0])))

    depends = (given.matrix, options.basis_shapes, frames, points)
    with progress.stage("Shapes"):
        found = shapes_from(cache.arrays("shapes", compute, depends=depends))
    for note in found.notes:
        progress.warn(note)
    return widened(found, frames, points)


def _of_points(points: Floats, options: NonRigidOptions) -> RecoveredShapes:
    choice = None if options.basis_shapes is not None else choose_rank(points)
    rank = options.basis_shapes if choice is None else choice.rank
    assert rank is not None
    return from_points(factorise_points(points, rank), choice)


def _left_out(frames: Mask, points: Mask, labels: Sequence[str]) -> list[str]:
    """Say which frames and points hold too little; nothing is invented for them."""
    notes = []
    if frames.any():
        numbers = np.flatnonzero(frames)
        notes.append(
            f"{len(numbers)} frames show too few points and have no answer: {_listed([str(n) for n in numbers])}."
        )
    if points.any():
        names = [labels[int(p)] for p in np.flatnonzero(points)]
        notes.append(f"{len(names)} points are seen too seldom and have no answer: {_listed(names)}.")
    return notes


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - _MOST_LISTED} more" if len(names) > _MOST_LISTED else ""
    return ", ".join(names[:_MOST_LISTED]) + more


def told(found: RecoveredShapes, measured: MeasuredPoints) -> list[str]:
    """Say in a few lines what was found."""
    kept = int(np.isfinite(found.basis[0]).all(0).sum())
    many = (
        f"rigid: one basis shape, rank {found.rank}"
        if found.basis_shapes == 1
        else f"{found.basis_shapes} basis shapes"
    )
    rms = np.sqrt(np.nanmean(found.residuals**2))
    metric = np.isfinite(found.metres_per_unit)
    scale, unit = (1e3 * found.metres_per_unit, " mm") if metric else (1.0, " px" if measured.unit == "px" else "")
    size = 2 * scale * float(np.sqrt(np.nanmean((found.basis[0] ** 2).sum(0))))
    sd = scale * float(np.nanmedian(np.sqrt((found.shape_sd**2).sum(1))))
    in_pictures, pixels = len(found.modelled) > 0, " px" if measured.unit == "px" else ""
    residual = f"{rms:.3g}{pixels}" if in_pictures else f"{scale * rms:.3g}{unit}"
    return [
        f"{kept} points in {int(found.answered.sum())} of {len(found)} frames, {found.kind}; {many}.",
        f"Residual {residual} (RMS); the object measures {size:.3g}{unit}, standard deviation {sd:.2g}{unit} (median).",
    ]

"""`marey nonrigid`: from videos, tracks or points in space to the shapes of a surface that deforms."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from marey.arrays import Floats, Mask
from marey.cameras.camera import Camera
from marey.io.shapes.shapes import shape_arrays, shapes_from
from marey.io.stages import file_fingerprint
from marey.nonrigid.in_space.calibrated import factorise_calibrated
from marey.nonrigid.in_space.factorisation import factorise_points
from marey.nonrigid.many_cameras.held_size import factorise_at_held_size
from marey.nonrigid.many_cameras.many_views import factorise_views
from marey.nonrigid.many_cameras.scaled_orthographic import factorise_scaled
from marey.nonrigid.one_camera import one_view, perspective
from marey.nonrigid.one_camera.one_view import factorise_tracks
from marey.nonrigid.one_camera.perspective import factorise_perspective
from marey.nonrigid.recovered import (
    UNSAID,
    RecoveredShapes,
    from_calibrated,
    from_held_size,
    from_many_views,
    from_one_view,
    from_perspective,
    from_points,
    from_scaled,
    known_distance,
    usable,
    widened,
)
from marey.pipelines.nonrigid.input import NonRigidInput, read_input
from marey.pipelines.nonrigid.measure import MeasuredPoints, measure_points
from marey.pipelines.nonrigid.results import write_results
from marey.pipelines.nonrigid.settings import NonRigidOptions
from marey.pipelines.progress import Progress
from marey.pipelines.run_record import StageCache

_MOST_LISTED = 8


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
        measured = measure_points(given, cache, progress)
        found = _recovered(given, measured, options, cache, progress)
        if found.unit == UNSAID:
            metres = 1.0 if measured.unit == "m" else np.nan
            found = replace(found, unit=measured.unit, residual_unit=measured.unit, metres_per_unit=metres)
        if options.distance is not None:
            found = known_distance(found, *options.distance)
        write_results(given, measured, found, options, out, progress)
    for line in told(found):
        progress.say(line)
    return out


def _recovered(
    given: NonRigidInput, measured: MeasuredPoints, options: NonRigidOptions, cache: StageCache, progress: Progress
) -> RecoveredShapes:
    """Factorise what was measured, as far as it holds enough; the rest has no answer."""
    asked = np.zeros(given.frames, bool)
    asked[given.asked] = True
    least = _least(given, measured)
    frames, points = usable(measured.seen & asked[:, None], least_points=least[0], least_frames=least[1])
    for note in _left_out(asked & ~frames, ~points, measured.labels):
        progress.warn(note)

    depends = (given.camera, options.basis_shapes, options.scaled, frames, points)
    with _shapes_stage(given, progress) as told:

        def compute() -> dict[str, np.ndarray]:
            return shape_arrays(_factorised(given, measured, frames, points, options, told))

        found = shapes_from(cache.arrays("shapes", compute, depends=depends))
    for note in found.notes:
        progress.warn(note)
    return widened(found, frames, points)


@contextmanager
def _shapes_stage(given: NonRigidInput, progress: Progress) -> Iterator[Callable[[float], None]]:
    """Show the stage, with the time that is left where the factorisation tells which share is done."""
    if given.camera is None:
        with progress.stage("Shapes"):
            yield lambda share: None
    else:
        with progress.stage_of_shares("Shapes") as told:
            yield told


def _least(given: NonRigidInput, measured: MeasuredPoints) -> tuple[int, int]:
    """Say how many points a frame, and how many frames a point must have at least."""
    if measured.points is not None or given.rig is not None:
        return 3, 2
    if given.camera is not None:
        return perspective.FEWEST_PERSPECTIVE_POINTS, perspective.FEWEST_FRAMES
    return one_view.FEWEST_POINTS, one_view.FEWEST_FRAMES


def _factorised(
    given: NonRigidInput,
    measured: MeasuredPoints,
    frames: Mask,
    points: Mask,
    options: NonRigidOptions,
    told: Callable[[float], None],
) -> RecoveredShapes:
    """Choose the factorisation by what is given; where it tells the share that is done, `told` is called."""
    if measured.points is not None:
        return from_points(factorise_points(measured.points[np.ix_(frames, points)], options.basis_shapes))
    assert measured.tracks is not None
    tracks = measured.tracks[:, frames][..., points]
    if given.camera is not None:
        straight = _straightened(tracks[0], given.camera)
        return from_perspective(factorise_perspective(straight, given.camera.matrix, progress=told), given.camera)
    if given.rig is not None:
        sd = None if measured.tracks_sd is None else measured.tracks_sd[:, frames][..., points]
        found = factorise_calibrated(tracks, given.rig, tracks_sd=sd, rank=options.basis_shapes)
        return from_calibrated(found, given.rig)
    if len(tracks) > 1:
        # Lenses see things larger that are near; tracks in a file may be those of any camera.
        if measured.videos:
            return from_held_size(factorise_at_held_size(tracks))
        return from_many_views(factorise_views(tracks))
    if options.scaled:
        return from_scaled(factorise_scaled(tracks[0]))
    return from_one_view(factorise_tracks(tracks[0]))


def _straightened(tracks: Floats, camera: Camera) -> Floats:
    """Take the lens out of tracks (F, 2, P): give the pixels of a camera of the same matrix without one."""
    flat = camera.undistort(np.moveaxis(tracks, 1, 2))
    return np.moveaxis(flat @ camera.matrix[:2, :2].T + camera.matrix[:2, 2], 2, 1)


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


def told(found: RecoveredShapes) -> list[str]:
    """Say in a few lines what was found."""
    kept = int(np.isfinite(found.basis[0]).all(0).sum())
    many = f"{found.basis_shapes} basis shapes"
    if found.basis_shapes == 1:
        many = f"rigid: one basis shape, rank {found.rank}"
    rms = float(np.sqrt(np.nanmean(found.residuals**2)))
    size = 2 * float(np.sqrt(np.nanmean((found.basis[0] ** 2).sum(0))))
    sd = float(np.nanmedian(np.sqrt((found.shape_sd**2).sum(1))))
    return [
        f"{kept} points in {int(found.answered.sum())} of {len(found)} frames, {found.kind}; {many}.",
        f"Residual {found.residual_text(rms)} (RMS); the object measures {found.length_text(size)}, standard deviation "
        f"{found.length_text(sd)} (median).",
    ]

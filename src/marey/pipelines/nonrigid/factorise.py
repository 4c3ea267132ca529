"""From videos, tracks or points in space to the shapes of a deforming surface."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from marey.arrays import Floats, Mask
from marey.cameras.camera import Camera
from marey.errors import MareyError
from marey.io.shapes.deforming_points import DeformingPoints, deforming_points, read_deforming, with_labels
from marey.io.shapes.shapes import shape_arrays, shapes_from
from marey.nonrigid.core.refinement import FEWEST_FRAMES
from marey.nonrigid.core.track_checks import FEWEST_POINTS
from marey.nonrigid.in_space.calibrated import factorise_calibrated
from marey.nonrigid.in_space.factorisation import factorise_points
from marey.nonrigid.many_cameras.held_size import factorise_at_held_size
from marey.nonrigid.many_cameras.many_views import factorise_views
from marey.nonrigid.many_cameras.scaled_orthographic import factorise_scaled
from marey.nonrigid.one_camera.one_view import factorise_tracks
from marey.nonrigid.one_camera.perspective import FEWEST_PERSPECTIVE_POINTS, factorise_perspective
from marey.nonrigid.recovered import (
    UNKNOWN_UNIT,
    RecoveredShapes,
    expanded,
    from_calibrated,
    from_held_size,
    from_many_views,
    from_one_view,
    from_perspective,
    from_points,
    from_scaled,
    usable_places,
    with_known_distance,
)
from marey.pipelines.causes.calibrated_tracks import calibrated_track_reasons
from marey.pipelines.causes.tracks import track_reasons
from marey.pipelines.consistency.unusable import UnusableRun, with_unusable_page
from marey.pipelines.nonrigid.input import NonRigidInput, input_of_data, read_input
from marey.pipelines.nonrigid.measure import NonRigidPoints, measure_points
from marey.pipelines.nonrigid.results import RESULTS
from marey.pipelines.nonrigid.settings import NonRigidSettings
from marey.pipelines.nonrigid.shapes import COMMAND, Shapes
from marey.pipelines.nonrigid.verdict import shapes_verdict
from marey.pipelines.progress import Progress, RecordingProgress
from marey.pipelines.run_details import RunDetails, checkpoints
from marey.pipelines.run_record import StageCache
from marey.pipelines.values import Frames, PathLike, first_and_end, issue_warnings, optional_path, path_tuple
from marey.pipelines.verdict import NotUsable, Verdict, VerdictReason
from marey.wording import listed

_Tracks = PathLike | Sequence[PathLike] | np.ndarray | DeformingPoints
"""What `factorise` takes: files, arrays, or tracks that were read."""
_UNDETERMINED = "Give more points that are seen together, in more frames, or from another direction."
"""What to do where the points do not determine a shape."""
_NO_SHAPE = (
    "No shape was recovered: the verdict states why the points do not determine it. With other points, frames or "
    "cameras, run the command again."
)
"""What the page of a run without shapes explains."""
_MOST_LISTED = 8
"""Number of frames or points that a note lists; more would hide the rest of the note. Chosen by hand."""


def read_tracks(path: PathLike, *, only: Sequence[str] | None = None) -> DeformingPoints:
    """Read tracks of points in images, or points in space.

    Args:
        path: An NPZ with `tracks` (F, 2, P) or (C, F, 2, P) [px], or `points` (F, 3, P), NaN where a point is missing;
            or a C3D, TRC or CSV of markers.
        only: Labels of the points to be read, or patterns such as `thigh_*`; all by default.

    Returns:
        The tracks or points, for `factorise`.

    Raises:
        FileProblem: The file cannot be used.
        SettingProblem: No point has such a label.

    Example:
        >>> import marey
        >>> tracks = marey.read_tracks("cluster.npz", only=["skin_*"])
        >>> tracks.points.shape
        (40, 9, 3)
    """
    data = read_deforming(Path(path))
    return data if only is None else with_labels(data, only)


def factorise(
    tracks: PathLike | Sequence[PathLike] | np.ndarray | DeformingPoints,
    *,
    rate: float | None = None,
    points: PathLike | Sequence[PathLike] = (),
    mask: PathLike | None = None,
    matrix: PathLike | Floats | None = None,
    scaled: bool = False,
    cameras: PathLike | None = None,
    distance: tuple[int, int, float] | None = None,
    frames: Frames | None = None,
    only: Sequence[str] | None = None,
    basis_shapes: int | None = None,
    overlay: bool = True,
    out: PathLike | None = None,
    progress: Progress | None = None,
) -> Shapes:
    """Recover the moving 3-D shape of a deforming surface, without a model of it.

    Args:
        tracks: Tracks of points in the images of one camera (F, 2, P), or of several (C, F, 2, P) [px], or points in
            space (F, 3, P), NaN where a point is missing; or files of these, or videos in which points are followed.
        rate: Sampling rate of an array [Hz].
        points: NPZ with the points (P, 2) to follow in a video and their `frame`; one for the first video, or one per
            video.
        mask: Image that is white where points may be selected in the first video.
        matrix: Known camera matrix (3, 3) of a single camera, or a file with it.
        scaled: Whether the scale of a single camera may change from frame to frame.
        cameras: Calibration of the cameras, such as cameras.toml.
        distance: Two points, counted from 0, and their known distance [m].
        frames: Frames to be used, counted from 0; all by default.
        only: Labels of the points to be used, or patterns such as `thigh_*`.
        basis_shapes: Number of basis shapes, for points in space and calibrated cameras; estimated by default.
        overlay: Whether overlay videos are drawn when the result is saved.
        out: Folder for the results. If it is given, the files of `marey nonrigid` are written there, and an
            interrupted run can be resumed by the same call; otherwise nothing is written.
        progress: Progress reporter; by default nothing is shown, and the warnings of the run are issued as Python
            warnings of the category `marey.MareyWarning`.

    Returns:
        The shapes.

    Raises:
        FileProblem: A file or an array cannot be used.
        SettingProblem: A value is impossible, or does not suit the input.
        NotUsable: The data do not determine a shape.

    Example:
        >>> import marey
        >>> shapes = marey.factorise("cluster.npz", basis_shapes=2)
        >>> shapes.points["skin 3"].components
        ('x', 'y', 'z')
    """
    settings = NonRigidSettings(
        points=path_tuple(points), mask=optional_path(mask), matrix=_matrix_text(matrix), scaled=scaled,
        cameras=optional_path(cameras), distance=distance, frames=first_and_end(frames),
        only=None if only is None else tuple(only), basis_shapes=basis_shapes, overlay=overlay,
    )  # fmt: skip
    reporter = RecordingProgress() if progress is None else progress
    shapes = _from_tracks(tracks, settings, rate, optional_path(out), reporter)
    if progress is None:
        issue_warnings(reporter)
    return shapes


def _from_tracks(
    tracks: _Tracks, settings: NonRigidSettings, rate: float | None, folder: Path | None, progress: Progress
) -> Shapes:
    """Read the input, recover the shapes and, if there is a folder, write the files."""
    with progress.stage("Reading"):
        given = _input(tracks, settings, rate)
    for note in given.notes:
        progress.warn(note)
    files = [*given.paths, *settings.files]
    with checkpoints(folder, files, results=RESULTS) as cache:
        with with_unusable_page(folder, partial(_unusable, given, settings, files), progress):
            shapes = _shapes(given, settings, files, cache, progress)
        if folder is not None:
            shapes.save(folder, progress=progress)
    return shapes


def _matrix_text(matrix: PathLike | Floats | None) -> str | None:
    """Return a matrix as the settings have it: the name of a file, or nine numbers."""
    if matrix is None or isinstance(matrix, str | Path):
        return None if matrix is None else str(matrix)
    return ",".join(repr(float(value)) for value in np.asarray(matrix).ravel())


def _input(tracks: _Tracks, settings: NonRigidSettings, rate: float | None) -> NonRigidInput:
    if isinstance(tracks, str | Path):
        return read_input([Path(tracks)], settings)
    if isinstance(tracks, DeformingPoints):
        return input_of_data(tracks, settings)
    if not isinstance(tracks, np.ndarray) and all(isinstance(each, str | Path) for each in tracks):
        return read_input([Path(str(each)) for each in tracks], settings)
    values = np.asarray(tracks)
    name = "points" if values.ndim == 3 and values.shape[1] == 3 else "tracks"
    arrays = {name: values} if rate is None else {name: values, "rate": np.array(rate)}
    return input_of_data(deforming_points(Path(name), arrays), settings)


def _shapes(
    given: NonRigidInput, settings: NonRigidSettings, files: Sequence[Path], cache: StageCache, progress: Progress
) -> Shapes:
    measured = measure_points(given, cache, progress)
    try:
        found = _recovered(given, measured, settings, cache, progress)
    except MareyError as problem:
        if type(problem) is not MareyError:  # a wrong setting or file, and not the points
            raise
        name = given.paths[0].name if given.paths else given.title
        what = f"{name}: {str(problem).rstrip('.')}."
        reason = VerdictReason.failure(what, _UNDETERMINED, cause="undetermined")
        raise NotUsable(Verdict.of([*_causes(given, measured), reason])) from problem
    if found.unit == UNKNOWN_UNIT:
        metres = 1.0 if measured.unit == "m" else np.nan
        found = replace(found, unit=measured.unit, residual_unit=measured.unit, metres_per_unit=metres)
    if settings.distance is not None:
        found = with_known_distance(found, *settings.distance)
    wanted = np.zeros(given.frames, bool)
    wanted[given.requested] = True
    return Shapes(
        found=found, labels=measured.labels, rate=given.rate, given=given, measured=measured,
        overlay=settings.overlay and bool(given.clips),
        details=RunDetails.of(
            COMMAND, {**_about(settings), "method": found.kind}, files, _root(given), progress,
            verdict=shapes_verdict(found, wanted, measured.notes, _causes(given, measured)),
        ),
    )  # fmt: skip


def _about(settings: NonRigidSettings) -> dict[str, Any]:
    """Return the settings that were given, for run.json."""
    return {name: value for name, value in vars(settings).items() if value not in (None, ())}


def _root(given: NonRigidInput) -> Path:
    return given.paths[0].parent if given.paths else Path()


def _unusable(
    given: NonRigidInput, settings: NonRigidSettings, files: Sequence[Path], verdict: Verdict
) -> UnusableRun:  # fmt: skip
    """Describe a run whose points do not determine a shape."""
    return UnusableRun(
        command=COMMAND, kind="Shape of a deforming surface", title=given.title, page="report.html", happened=_NO_SHAPE,
        settings=_about(settings), inputs=files, root=_root(given), verdict=verdict,
    )  # fmt: skip


def _causes(given: NonRigidInput, measured: NonRigidPoints) -> tuple[VerdictReason, ...]:
    """Explain jumps of given tracks and points, and contradictions of tracks to the calibration.

    Tracks in videos were followed by the program itself.
    """
    if measured.videos:
        return ()
    views = measured.tracks
    if views is None:
        assert measured.points is not None
        views = measured.points.swapaxes(1, 2)[None]
    chosen = np.arange(given.frames)[given.requested]
    places = np.concatenate(list(views), axis=1)[chosen]
    found = track_reasons(places, chosen, measured.labels, views=len(views), unit=measured.unit)
    if given.rig is None or found:
        return found
    return calibrated_track_reasons(views[:, chosen], given.rig)


def _recovered(
    given: NonRigidInput, measured: NonRigidPoints, settings: NonRigidSettings, cache: StageCache, progress: Progress
) -> RecoveredShapes:
    """Factorise the frames and points with enough data; the others are NaN."""
    wanted = np.zeros(given.frames, bool)
    wanted[given.requested] = True
    least = _least(given, measured)
    frames, points = usable_places(measured.seen & wanted[:, None], least_points=least[0], least_frames=least[1])
    for note in _left_out(wanted & ~frames, ~points, measured.labels):
        progress.warn(note)

    depends = (given.camera, settings.basis_shapes, settings.scaled, frames, points)
    with _shapes_stage(given, progress) as done:

        def compute() -> dict[str, np.ndarray]:
            return shape_arrays(_factorised(given, measured, frames, points, settings, done))

        found = shapes_from(cache.arrays("shapes", compute, depends=depends))
    for note in found.notes:
        progress.warn(note)
    return expanded(found, frames, points)


@contextmanager
def _shapes_stage(given: NonRigidInput, progress: Progress) -> Iterator[Callable[[float], None]]:
    """Open the stage of the factorisation; with a known camera it reports which share of it is finished."""
    if given.camera is None:
        with progress.stage("Shapes"):
            yield lambda share: None
    else:
        with progress.stage_of_shares("Shapes") as done:
            yield done


def _least(given: NonRigidInput, measured: NonRigidPoints) -> tuple[int, int]:
    """Return the least number of points per frame, and of frames per point."""
    if measured.points is not None or given.rig is not None:
        return 3, 2
    if given.camera is not None:
        return FEWEST_PERSPECTIVE_POINTS, FEWEST_FRAMES
    return FEWEST_POINTS, FEWEST_FRAMES


def _factorised(
    given: NonRigidInput,
    measured: NonRigidPoints,
    frames: Mask,
    points: Mask,
    settings: NonRigidSettings,
    done: Callable[[float], None],
) -> RecoveredShapes:
    """Run the factorisation that suits the input; `done` is called with the finished share by those that report it."""
    if measured.points is not None:
        return from_points(factorise_points(measured.points[np.ix_(frames, points)], settings.basis_shapes))
    assert measured.tracks is not None
    tracks = measured.tracks[:, frames][..., points]
    if given.camera is not None:
        straight = _straightened(tracks[0], given.camera)
        return from_perspective(factorise_perspective(straight, given.camera.matrix, progress=done), given.camera)
    if given.rig is not None:
        sd = None if measured.tracks_sd is None else measured.tracks_sd[:, frames][..., points]
        found = factorise_calibrated(tracks, given.rig, tracks_sd=sd, rank=settings.basis_shapes)
        return from_calibrated(found, given.rig)
    if len(tracks) > 1:
        # Perspective changes the size of an object in a video; tracks in a file can be of any camera.
        if measured.videos:
            return from_held_size(factorise_at_held_size(tracks))
        return from_many_views(factorise_views(tracks))
    if settings.scaled:
        return from_scaled(factorise_scaled(tracks[0]))
    return from_one_view(factorise_tracks(tracks[0]))


def _straightened(tracks: Floats, camera: Camera) -> Floats:
    """Remove the lens distortion from tracks (F, 2, P)."""
    flat = camera.undistort(np.moveaxis(tracks, 1, 2))
    return np.moveaxis(flat @ camera.matrix[:2, :2].T + camera.matrix[:2, 2], 2, 1)


def _left_out(frames: Mask, points: Mask, labels: Sequence[str]) -> list[str]:
    """List the frames and points with too few data; they are NaN in the result."""
    notes = []
    if frames.any():
        numbers = np.flatnonzero(frames)
        text = listed(map(str, numbers), most=_MOST_LISTED)
        notes.append(f"{len(numbers)} frames have too few points and no result: {text}.")
    if points.any():
        names = [labels[int(p)] for p in np.flatnonzero(points)]
        text = listed(names, most=_MOST_LISTED)
        notes.append(f"{len(names)} points are seen in too few frames and have no result: {text}.")
    return notes

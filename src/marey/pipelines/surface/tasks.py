"""A surface measurement in one call."""

from collections.abc import Sequence
from pathlib import Path

from marey.io.trial.trial import Trial
from marey.pipelines.capture.tasks import Frames, first_and_end, issue_warnings, reopened
from marey.pipelines.progress import Progress, RecordingProgress
from marey.pipelines.result_files import ResultFiles
from marey.pipelines.surface.result import Surface
from marey.pipelines.surface.settings import SurfaceOptions
from marey.pipelines.surface.surface import surface_of_trial


def measure_surface(
    trial: Trial | Path | str,
    *,
    out: Path | str | None = None,
    frames: Frames | None = None,
    cameras: Sequence[str] | None = None,
    seeds: Path | str | None = None,
    spacing: int = 2,
    patch: int = 13,
    refine_rig: bool | None = None,
    tracks: bool = True,
    max_speed: float | None = None,
    max_acceleration: float | None = None,
    progress: Progress | None = None,
) -> Surface:
    """Measure the visible surface that a trial shows, as the command `marey surface` does.

    Args:
        trial: A trial (see `marey.open_trial`), or its folder.
        out: Folder for the results. An interrupted run with the same folder and settings is resumed. By default the
            results are in a temporary folder until `Surface.save` is called.
        frames: Frames to use, for example `range(0, 10)`.
        cameras: Names of the cameras to use.
        seeds: A table of clicked seeds.
        spacing: Distance of neighbouring points in the image [px].
        patch: Width of the smallest patches that are compared, an odd number [px].
        refine_rig: Whether the camera poses are corrected by the matches; by default only where three or more cameras
            clearly need it.
        tracks: Whether points are followed from frame to frame.
        max_speed: Trajectories faster than this are removed [m/s]; by default a limit is estimated from the data.
        max_acceleration: The same for the acceleration [m/s2].
        progress: Progress reporter; by default nothing is shown, and the warnings of the run are issued as Python
            warnings of the category `marey.MareyWarning`.

    Returns:
        The surface, with standard deviations.

    Raises:
        FileProblem: Something in the trial cannot be used, or its cameras show no common surface.
        SettingProblem: A setting cannot be used.

    Example:
        >>> import marey
        >>> surface = marey.measure_surface("arm3", frames=range(0, 10), spacing=4)  # doctest: +SKIP
        >>> surface.points.shape  # doctest: +SKIP
    """
    files = ResultFiles.at(out)
    options = SurfaceOptions(
        out=files.folder, cameras=None if cameras is None else tuple(cameras), frames=first_and_end(frames),
        seeds=None if seeds is None else Path(seeds), spacing=spacing, patch=patch, refine_rig=refine_rig,
        tracks=tracks, max_speed=max_speed, max_acceleration=max_acceleration,
    )  # fmt: skip
    reporter = RecordingProgress() if progress is None else progress
    surface_of_trial(reopened(trial, options.changes()), options, reporter)
    if progress is None:
        issue_warnings(reporter)
    return Surface(files)

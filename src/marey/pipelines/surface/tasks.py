"""A surface measurement in one call: of a trial, or of images of one instant."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from marey.arrays import Image, Mask
from marey.cameras.rig import Rig
from marey.errors import SettingProblem
from marey.fit.solver.threads import usable_threads
from marey.io.trial.trial import Trial
from marey.io.video.video import read_picture
from marey.pipelines.capture.tasks import reopened
from marey.pipelines.progress import Progress, RecordingProgress
from marey.pipelines.result_files import ResultFiles
from marey.pipelines.surface.result import Surface
from marey.pipelines.surface.settings import SurfaceOptions
from marey.pipelines.surface.surface import surface_of_trial
from marey.pipelines.values import Frames, first_and_end, issue_warnings
from marey.surface.points.dense import match_tuples
from marey.surface.points.intersection import intersect
from marey.surface.points.measured import joined
from marey.surface.points.settings import SurfaceSettings
from marey.surface.points.views import comparisons, views_of


def measure_surface(
    trial: Trial | Path | str,
    *,
    out: Path | str | None = None,
    frames: Frames | None = None,
    cameras: Sequence[str] | None = None,
    seeds: Path | str | None = None,
    sync: str | None = None,
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
        sync: "off" ignores the clocks of the cameras in `sync.json`. By default they are used: each camera's picture
            nearest to a frame counts as taken at its instant.
        spacing: Distance of neighbouring points in the image [px].
        patch: Width of the smallest patches that are compared, an odd number [px].
        refine_rig: Whether the camera poses are corrected by the matches; by default only if there are three
            or more cameras and the matches clearly contradict their poses.
        tracks: Whether points are followed from frame to frame.
        max_speed: Trajectories faster than this are removed [m/s]; by default a limit is estimated from the data.
        max_acceleration: The same for the acceleration [m/s2].
        progress: Progress reporter; by default nothing is shown, and the warnings of the run are issued as Python
            warnings of the category `marey.MareyWarning`.

    Returns:
        The surface, with standard deviations.

    Raises:
        FileProblem: Something in the trial cannot be used.
        NotUsable: Its cameras show no common surface.
        SettingProblem: A setting cannot be used.

    Example:
        >>> import marey
        >>> surface = marey.measure_surface("arm3", frames=range(0, 10), spacing=4)  # doctest: +SKIP
        >>> surface.points.shape  # doctest: +SKIP
    """
    files = ResultFiles.at(out)
    options = SurfaceOptions(
        out=files.folder, cameras=None if cameras is None else tuple(cameras), frames=first_and_end(frames),
        seeds=None if seeds is None else Path(seeds), sync=sync, spacing=spacing, patch=patch, refine_rig=refine_rig,
        tracks=tracks, max_speed=max_speed, max_acceleration=max_acceleration,
    )  # fmt: skip
    reporter = RecordingProgress() if progress is None else progress
    surface_of_trial(reopened(trial, options.changes()), options, reporter)
    if progress is None:
        issue_warnings(reporter)
    return Surface(files)


def match_images(
    images: Sequence[Image | Path | str],
    cameras: Rig,
    *,
    masks: Sequence[Mask | None] | None = None,
    spacing: int = 2,
    patch: int = 13,
) -> Surface:
    """Match images of one instant by least squares, and intersect the rays of the matches.

    Patches of one image are found in its neighbours to a few hundredths of a pixel ([Plaenkers1999] section 2.1).
    The cameras should stand 10 to 25 degrees apart, and the surface needs texture.

    Args:
        images: One image per camera, in the order of the cameras: arrays (height, width, 3) uint8 in blue, green, red,
            or files.
        cameras: The calibrated cameras, see `marey.read_cameras`.
        masks: (height, width) per image, true where the surface is; None uses the whole image.
        spacing: Distance of neighbouring points in the image [px].
        patch: Width of the smallest patches that are compared, an odd number [px].

    Returns:
        The points of the surface, with covariances; `data.pixels` are the matched pixels. It may be empty.

    Raises:
        FileProblem: An image cannot be read.
        SettingProblem: The images do not belong to the cameras, or no two cameras stand close enough to each other.

    Example:
        >>> import marey
        >>> rig = marey.read_cameras("ball")
        >>> surface = marey.match_images(["ball/left.png", "ball/middle.png", "ball/right.png"], rig, spacing=8)
        >>> surface.cameras
        ('left', 'middle', 'right')
        >>> len(surface) > 100
        True
    """
    settings = SurfaceSettings(spacing=spacing, patch=patch)
    pictures = [image if isinstance(image, np.ndarray) else read_picture(Path(image)) for image in images]
    _require_sizes(pictures, cameras)
    compared = comparisons(cameras, angle=settings.angle, most_searched=settings.most_searched)
    if not compared:
        limit = np.degrees(settings.angle)
        raise SettingProblem(f"No two cameras have views that differ by less than {limit:.0f} degrees.")
    views, threads = views_of(cameras, pictures, masks), usable_threads()
    tuples = [match_tuples(views, each, settings, threads=threads) for each in compared]
    return Surface(None, joined(intersect(views, each, settings, frame=0) for each in tuples))


def _require_sizes(pictures: Sequence[Image], cameras: Rig) -> None:
    """Check that there is an image of the right size for each camera.

    Raises:
        SettingProblem: There is not.
    """
    if len(pictures) != len(cameras):
        raise SettingProblem(f"There are {len(pictures)} images for {len(cameras)} cameras; give one per camera.")
    for picture, camera in zip(pictures, cameras, strict=True):
        height, width = picture.shape[:2]
        if (width, height) != camera.size:
            wanted = f"{camera.width} x {camera.height}"
            raise SettingProblem(f"The image of {camera.name} has {width} x {height} pixels; its camera has {wanted}.")

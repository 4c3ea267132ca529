"""The fit of a person's own body in one call."""

from collections.abc import Sequence
from pathlib import Path

from marey.io.trial.trial import Trial
from marey.pipelines.capture.motion import Motion
from marey.pipelines.capture.settings import CaptureSettings
from marey.pipelines.capture.tasks import reopened
from marey.pipelines.progress import Progress, RecordingProgress
from marey.pipelines.result_files import ResultFiles
from marey.pipelines.shape.shape import shape_trial
from marey.pipelines.surface.result import Surface
from marey.pipelines.values import Frames, first_and_end, issue_warnings


def fit_shape(
    trial: Trial | Path | str,
    surface: Surface | None = None,
    *,
    out: Path | str | None = None,
    frames: Frames | None = None,
    cameras: Sequence[str] | None = None,
    preset: str | None = None,
    stature: float | None = None,
    leg_length: float | None = None,
    asis_distance: float | None = None,
    start: Path | str | None = None,
    body: Path | str | None = None,
    overlay: bool = True,
    progress: Progress | None = None,
) -> Motion:
    """Fit a person's own body (skeleton, metaballs, skin) to a trial, as the command `marey shape` does.

    Args:
        trial: A trial (see `marey.open_trial`), or its folder.
        surface: The measured surface of the same trial; by default that of the folder `out`, or else it is measured.
        out: Folder for the results. An interrupted run with the same folder and settings is resumed. By default the
            results are in a temporary folder until `Motion.save` is called.
        frames: Frames to use, for example `range(40, 100)`.
        cameras: Names of the cameras to use.
        preset: Part of the body to follow: full, upper, left_arm, right_arm, left_leg or right_leg.
        stature: The person's height [m].
        leg_length: The person's leg length, from the anterior superior iliac spine to the medial malleolus [m].
        asis_distance: The distance between the person's anterior superior iliac spines [m].
        start: A file with the joints of one frame to start from, or a folder of OpenPose files.
        body: A body.npz to start from, or the name of a generic body.
        overlay: Draw overlay videos.
        progress: Progress reporter; by default nothing is shown, and the warnings of the run are issued as Python
            warnings of the category `marey.MareyWarning`.

    Returns:
        The motion; its `body` is the fitted one.

    Raises:
        FileProblem: Something in the trial cannot be used; the message names the file and the remedy.
        SettingProblem: A setting cannot be used.

    Example:
        >>> import marey
        >>> motion = marey.fit_shape("arm", preset="right_arm")  # doctest: +SKIP
        >>> motion.body.skeleton.segment_names  # doctest: +SKIP
    """
    files = ResultFiles.at(out)
    if surface is not None and surface.folder is not None:
        surface.save(files.folder)
    settings = CaptureSettings(
        out=files.folder, cameras=None if cameras is None else tuple(cameras), frames=first_and_end(frames),
        preset=preset, stature_m=stature, leg_length_m=leg_length, asis_distance_m=asis_distance,
        start=None if start is None else Path(start), body=body, overlay=overlay,
    )  # fmt: skip
    reporter = RecordingProgress() if progress is None else progress
    motion = shape_trial(reopened(trial, settings.changes()), settings, reporter)
    if progress is None:
        issue_warnings(reporter)
    return Motion(motion.data, files)

"""Synchronisation in one call: open a trial, and estimate the clocks of its cameras."""

from collections.abc import Sequence
from pathlib import Path

from marey.io.trial.trial import read_free_trial
from marey.pipelines.progress import Progress, RecordingProgress
from marey.pipelines.sync.settings import SyncSettings
from marey.pipelines.sync.sync import Synchronisation, synchronise_trial
from marey.pipelines.values import issue_warnings


def synchronise(
    trial: Path | str,
    *,
    out: Path | str | None = None,
    cameras: Sequence[str] | None = None,
    keypoints: Path | str | None = None,
    progress: Progress | None = None,
) -> Synchronisation:
    """Estimate the clocks of a trial's cameras, as the command `marey sync` does.

    Args:
        trial: The folder of the trial.
        out: The file for the clocks; by default `sync.json` in the trial, where `capture` and `surface` find it.
        cameras: Names of the cameras to use.
        keypoints: A folder with the joints that a detector found in every image.
        progress: Progress reporter; by default nothing is shown, and the warnings of the run are issued as Python
            warnings of the category `marey.MareyWarning`.

    Returns:
        The clocks, with standard deviations.

    Raises:
        FileProblem: Something in the trial cannot be used, or nothing in it determines the clocks.

    Example:
        >>> import marey
        >>> found = marey.synchronise("walk01")  # doctest: +SKIP
        >>> found.clocks.offset_s, found.clocks.offset_sd_s  # doctest: +SKIP
    """
    settings = SyncSettings(
        out=None if out is None else Path(out), cameras=None if cameras is None else tuple(cameras),
        keypoints=None if keypoints is None else Path(keypoints),
    )  # fmt: skip
    reporter = RecordingProgress() if progress is None else progress
    found = synchronise_trial(read_free_trial(trial, **settings.changes()), settings, reporter)
    if progress is None:
        issue_warnings(reporter)
    return found

"""`marey view`: results and their trial on one page, from a local server or in one file."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from marey.cameras.rig import Rig
from marey.errors import FileProblem, MareyError, SettingProblem
from marey.io.calibration.readers import read_rig
from marey.io.run_files import RECORD, read_record
from marey.io.stages import file_fingerprint
from marey.io.trial.trial import Trial, read_trial
from marey.pipelines.capture.run import CORRECTED_CAMERAS
from marey.pipelines.progress import Progress, RecordingProgress
from marey.pipelines.viewer.results import read_viewed, shifted, with_same_names
from marey.view.viewer.server import ViewerServer
from marey.view.viewer.single_file import write_viewer_file
from marey.view.viewer.viewed import ViewedBody, ViewedResult, ViewedTake, ViewerContent

MOST_RESULTS = 2
"""Number of results that one page shows at most: side by side."""
COPIES = ".view"
"""Name of the folder for copies of the videos in the folder of the results."""
_KEPT_SETTINGS = ("cameras", "rate", "sync")
"""Settings of a run that decide which pictures its frames are."""
_LEVELS_UP = 3
"""Number of folders above the results in which their trial is searched: TRIAL/marey, TRIAL/marey/person1. Chosen by
hand."""


def viewer_content(
    folders: Sequence[Path], trial: Path | None = None, progress: Progress | None = None, *, offset_s: float = 0.0
) -> ViewerContent:
    """Read results, and open the videos of their trial.

    Args:
        folders: One or two folders of results.
        trial: The trial of the first result; by default the folder above it that contains one.
        progress: Progress reporter.
        offset_s: Time that is added to that of the second result, if its clock began at another instant [s].

    Returns:
        The content of the page.

    Raises:
        FileProblem: A file cannot be used.
        SettingProblem: There are more than two folders.
    """
    progress = progress or RecordingProgress()
    if not 1 <= len(folders) <= MOST_RESULTS:
        raise SettingProblem(f"{len(folders)} results were given. Give one, or two to compare.")
    with progress.stage("Reading"):
        results = [read_viewed(folder) for folder in folders]
        if len(results) > 1:
            results = _distinct(with_same_names(results[0], shifted(results[1], offset_s)))
        elif offset_s:
            raise SettingProblem("There is no second result whose time could be shifted (--offset).")
        take, why = _take(results[0], folders[0], trial, progress)
    if why:
        progress.report(why)
    return ViewerContent(results=results, take=take, without_videos=why, same_room=_of_one_trial(folders, results))


def viewer_server(content: ViewerContent, port: int = 0) -> ViewerServer:
    """Make the server of the page.

    Args:
        content: What the page shows.
        port: Port of its address; 0 for any free one.

    Raises:
        MareyError: The port is in use.
    """
    return ViewerServer(content, port)


def write_viewer(content: ViewerContent, path: Path, progress: Progress | None = None) -> Path:
    """Write the page as one file, which can be opened anywhere.

    Args:
        content: What the page shows.
        path: The HTML file.
        progress: Progress reporter.

    Returns:
        The file.

    Raises:
        FileProblem: The file would replace another one, or a video is damaged.
    """
    progress = progress or RecordingProgress()
    if path.suffix.lower() not in (".html", ".htm"):
        raise FileProblem(path, "is not the name of a page", "Give a name that ends in .html.")
    with progress.stage("Page"):
        every = write_viewer_file(path, content)
    if every > 1:
        progress.report(f"To keep the file small, it contains the pictures of one of {every} frames.")
    return path


def serve_viewer(server: ViewerServer) -> None:
    """Serve the page until it is shut down, or interrupted with Ctrl-C.

    Args:
        server: The server; it is closed at the end.
    """
    try:
        with suppress(KeyboardInterrupt):
            server.serve_forever()
    finally:
        server.server_close()


def _of_one_trial(folders: Sequence[Path], results: Sequence[ViewedResult]) -> bool:
    """Return whether two captured motions are of the same videos and cameras, by the records of their runs."""
    if len(results) < MOST_RESULTS or not all(isinstance(result.shown, ViewedBody) for result in results):
        return False
    first, second = (_inputs(_out(folder)) for folder in folders)
    common = set(first) & set(second)
    return bool(common) and all(first[name] == second[name] for name in common)


def _out(folder: Path) -> Path:
    """Return the folder with the motion: the given one, that of a given file, or `marey/` in a trial."""
    out = folder if folder.is_dir() else folder.parent
    return out if (out / "motion.npz").is_file() else out / "marey"


def _inputs(out: Path) -> dict[str, object]:
    """Return the fingerprints of the inputs of a run by their names; empty without a record."""
    inputs = read_record(out).get("inputs", {}) if (out / RECORD).is_file() else {}
    return inputs if isinstance(inputs, dict) else {}


def _distinct(results: Sequence[ViewedResult]) -> list[ViewedResult]:
    """Return the results with different names: equal ones get a number."""
    if len({result.name for result in results}) == len(results):
        return list(results)
    return [replace(result, name=f"{result.name} ({n})") for n, result in enumerate(results, 1)]


def _take(result: ViewedResult, folder: Path, trial: Path | None, progress: Progress) -> tuple[ViewedTake | None, str]:
    """Return the videos of a result, or why there are none.

    Raises:
        FileProblem: The given trial cannot be used.
    """
    if not isinstance(result.shown, ViewedBody):
        if trial is not None:
            raise SettingProblem("A result of markers has no videos. Leave out --trial, or give a captured motion.")
        return None, ""
    names = result.shown.motion.camera_names
    out = _out(folder)
    try:
        opened = _opened(trial, out) if trial is not None else _found_trial(out, names)
    except MareyError as error:
        if trial is not None:
            raise
        return None, f"The videos of the trial cannot be shown: {error}"
    if opened is None:
        return None, "The videos are not shown: no trial was found above the results. Give it with --trial TRIAL."
    missing = [name for name in names if name not in opened.rig.names]
    if missing:
        wrong = f"has no camera {', '.join(missing)} of the result"
        raise FileProblem(opened.calibration, wrong, "Give the trial from which the result was captured (--trial).")
    _warn_of_changes(opened, out, progress)
    clips = [opened.take.clips[opened.take.names.index(name)] for name in names]
    return ViewedTake(rig=_rig(opened, out).subset(names), clips=clips, copies=out / COPIES), ""


def _found_trial(out: Path, names: Sequence[str]) -> Trial | None:
    """Open the nearest folder above the results that is a trial with their cameras; None without any."""
    for folder in out.resolve().parents[:_LEVELS_UP]:
        with suppress(MareyError):
            found = _opened(folder, out)
            if set(names) <= set(found.rig.names):
                return found
    return None


def _opened(trial: Path, out: Path) -> Trial:
    """Open a trial with the settings of the run that decide which pictures are its frames."""
    settings = read_record(out).get("settings", {}) if (out / RECORD).is_file() else {}
    kept = {name: settings[name] for name in _KEPT_SETTINGS if name in settings} if isinstance(settings, dict) else {}
    return read_trial(trial, **kept)


def _rig(trial: Trial, out: Path) -> Rig:
    """Return the cameras of a run: those that it corrected, or those of the trial."""
    corrected = out / CORRECTED_CAMERAS
    return read_rig(corrected) if corrected.is_file() else trial.rig


def _warn_of_changes(trial: Trial, out: Path, progress: Progress) -> None:
    """Report inputs of the run that have changed since."""
    recorded = _inputs(out)
    paths = [path for path in (trial.calibration, *(clip.path for clip in trial.take.clips)) if path.is_file()]
    changed = [path.name for path in paths if recorded.get(path.name) not in (None, file_fingerprint(path))]
    if changed:
        progress.warn(f"{', '.join(changed)} of the trial changed after the run: videos and body may not agree.")

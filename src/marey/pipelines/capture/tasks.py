"""A capture in one call: open a trial, and measure the motion of the person in it."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from marey.cameras.rig import Rig
from marey.errors import SettingProblem
from marey.io.calibration.readers import read_rig
from marey.io.trial.trial import Trial, read_trial
from marey.observations.observation import Observation
from marey.pipelines.capture.capture import capture_trial
from marey.pipelines.capture.motion import Motion
from marey.pipelines.capture.settings import CaptureSettings
from marey.pipelines.progress import Progress, RecordingProgress
from marey.pipelines.result_files import ResultFiles
from marey.pipelines.values import Frames, first_and_end, issue_warnings


def open_trial(
    folder: Path | str,
    *,
    frames: Frames | None = None,
    cameras: Sequence[str] | None = None,
    preset: str | None = None,
    stature: float | None = None,
    leg_length: float | None = None,
    asis_distance: float | None = None,
    start: Path | str | None = None,
    keypoints: Path | str | None = None,
    person: int | str | None = None,
    person_net: Path | str | None = None,
) -> Trial:
    """Open a trial and check everything in it: cameras, videos, background, masks and settings.

    Args:
        folder: The folder with `cameras.toml` and one video per camera, or that of a recording of Pose2Sim, OpenCap,
            Caliscope or FreeMoCap.
        frames: Frames to use, for example `range(40, 100)`; by default those of `trial.toml`, or all.
        cameras: Names of the cameras to use; by default those of `trial.toml`, or all.
        preset: Part of the body to follow: full, upper, left_arm, right_arm, left_leg or right_leg.
        stature: The person's height [m].
        leg_length: The person's leg length, from the anterior superior iliac spine to the medial malleolus [m].
        asis_distance: The distance between the person's anterior superior iliac spines [m].
        start: A file with the joints of one frame to start from, or a folder of OpenPose files.
        keypoints: A folder with the joints that a detector found in every image, as OpenPose writes them.
        person: The person to follow, if several are present: a number of `marey capture --list-people`, or a click
            `"cam01:310,220@40"`, a box `"cam01:250,80,370,400@40"` or a place `"0.4,1.2,0.9@40"` in a frame.
        person_net: A network that segments people, TFLite or ONNX.

    Returns:
        The trial.

    Raises:
        FileProblem: Something in the trial cannot be used; the message names the file and the remedy.
        SettingProblem: A setting cannot be used.

    Example:
        >>> import marey
        >>> trial = marey.open_trial(marey.example_folder(), frames=range(40, 100), cameras=["cam01", "cam02"])
        >>> trial.rig.names
        ('cam01', 'cam02')
    """
    settings = CaptureSettings(
        cameras=_names(cameras), frames=first_and_end(frames), preset=preset, stature_m=stature,
        leg_length_m=leg_length, asis_distance_m=asis_distance, start=None if start is None else Path(start),
        keypoints=None if keypoints is None else Path(keypoints), person=person,
        person_net=None if person_net is None else Path(person_net),
    )  # fmt: skip
    return read_trial(folder, **settings.changes())


def read_cameras(path: Path | str) -> Rig:
    """Read calibrated cameras in the format of Pose2Sim, Anipose, Caliscope, OpenCV, Qualisys, Vicon and others.

    Args:
        path: The file, or a folder that holds one.

    Returns:
        The cameras by name; lengths in metres.

    Raises:
        FileProblem: There is no calibration, or it cannot be used; the message lists everything that is wrong in it.

    Example:
        >>> import marey
        >>> rig = marey.read_cameras(marey.example_folder())
        >>> rig["cam01"].size
        (640, 480)
    """
    return read_rig(path)


def capture(
    trial: Trial | Path | str,
    *,
    out: Path | str | None = None,
    frames: Frames | None = None,
    cameras: Sequence[str] | None = None,
    preset: str | None = None,
    stature: float | None = None,
    leg_length: float | None = None,
    asis_distance: float | None = None,
    start: Path | str | None = None,
    keypoints: Path | str | None = None,
    person: int | str | None = None,
    person_net: Path | str | None = None,
    body: Path | str | None = None,
    fixed_sizes: bool = False,
    surface_tracks: bool = True,
    sync: str | None = None,
    check: str | None = None,
    camera_uncertainty: bool = True,
    overlay: bool = True,
    observations: Mapping[int, Sequence[Observation]] | None = None,
    progress: Progress | None = None,
) -> Motion:
    """Capture the joint motion of the person in a trial, as the command `marey capture` does.

    The settings of the process are left as they are; `marey.tuned_process` sets them for the fastest run.

    Args:
        trial: A trial, or its folder. A setting that is given here replaces that of the trial.
        out: Folder for the results. An interrupted run with the same folder and settings is resumed. By default the
            results are in a temporary folder until `Motion.save` is called.
        frames: Frames to use, for example `range(40, 100)`.
        cameras: Names of the cameras to use.
        preset: Part of the body to follow: full, upper, left_arm, right_arm, left_leg or right_leg.
        stature: The person's height [m].
        leg_length: The person's leg length, from the anterior superior iliac spine to the medial malleolus [m].
        asis_distance: The distance between the person's anterior superior iliac spines [m].
        start: A file with the joints of one frame to start from, or a folder of OpenPose files.
        keypoints: A folder with the joints that a detector found in every image, as OpenPose writes them. They help
            the start and the refinement, and make images of the empty room unnecessary.
        person: The person to follow, if several are present, as in `open_trial`.
        person_net: A network that segments people, TFLite or ONNX; its output is evidence for the silhouettes.
        body: A body.npz, a skinned GLB, a TOML that names a mesh, or the name of a generic body.
        fixed_sizes: Keep the sizes of the body instead of estimating them.
        surface_tracks: Track patches of the surface through the images, to measure turns of limbs about their axes.
        sync: "off" ignores the clocks of the cameras in `sync.json`; by default they are used.
        check: "off": the cameras are not checked against each other. By default, cameras that are exchanged, mirrored,
            late or moved are named, and repaired or not used.
        camera_uncertainty: Enlarge the standard deviations by the uncertainty of the cameras, where `calibration.json`
            beside the cameras states it, or a camera was found again.
        overlay: Draw overlay videos.
        observations: Further observations by frame, also of kinds that are defined outside of marey (see
            `marey.Observation`); they are used in the refinement of motion and body, but not for the start and the
            tracking. A run with observations is not resumed.
        progress: Progress reporter; by default nothing is shown, and the warnings of the run are issued as Python
            warnings of the category `marey.MareyWarning`.

    Returns:
        The motion, with standard deviations and flags.

    Raises:
        FileProblem: Something in the trial cannot be used; the message names the file and the remedy.
        SettingProblem: A setting cannot be used.
        NotUsable: The cameras contradict each other, and what is known of the cause does not repair it.

    Example:
        >>> import marey
        >>> motion = marey.capture("walk01", stature=1.80)  # doctest: +SKIP
        >>> motion.angles["left knee flexion"]  # doctest: +SKIP
    """
    files = ResultFiles.at(out)
    settings = CaptureSettings(
        out=files.folder, cameras=_names(cameras), frames=first_and_end(frames), preset=preset, stature_m=stature,
        leg_length_m=leg_length, asis_distance_m=asis_distance, start=None if start is None else Path(start),
        keypoints=None if keypoints is None else Path(keypoints), person=person,
        person_net=None if person_net is None else Path(person_net), body=body, fixed_sizes=fixed_sizes,
        surface_tracks=surface_tracks, sync=sync, check=check, overlay=overlay,
        camera_uncertainty=camera_uncertainty,
    )  # fmt: skip
    reporter = RecordingProgress() if progress is None else progress
    motion = capture_trial(reopened(trial, settings.changes()), settings, reporter, observations=observations)
    if progress is None:
        issue_warnings(reporter)
    return Motion(motion.data, files)


def reopened(trial: Trial | Path | str, changes: Mapping[str, object]) -> Trial:
    """Open a trial with changed settings.

    Args:
        trial: A trial, or its folder.
        changes: Settings by name that replace those of the trial; None leaves a setting as it is.

    Returns:
        The trial; the given one if nothing changes.
    """
    if not isinstance(trial, Trial):
        return read_trial(trial, **changes)
    given = {name: value for name, value in changes.items() if value is not None}
    if not given:
        return trial
    return read_trial(trial.folder, **(trial.settings.model_dump(exclude_none=True) | given))


def _names(names: Sequence[str] | None) -> tuple[str, ...] | None:
    if isinstance(names, str):
        raise SettingProblem(f"The cameras are {names!r}; they should be a list, for example ['cam01', 'cam02'].")
    return None if names is None else tuple(names)

"""The commands `marey capture`, `marey demo`, `marey surface` and `marey shape`."""

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from marey.cli.options import (
    RESULTS,
    AsisDistance,
    BodyFile,
    Cameras,
    CameraUncertainty,
    Check,
    FixedSizes,
    Frames,
    KeyPointsFolder,
    LegLength,
    ListPeople,
    NoOverlay,
    Out,
    People,
    Person,
    PersonNet,
    Preset,
    Quiet,
    Start,
    Stature,
    SurfaceTracks,
    Sync,
    Workers,
    camera_names,
    frame_range,
    require_trial,
    wants_everybody,
)
from marey.cli.work import end_with_verdict, working

Trial = Annotated[
    Path, typer.Argument(metavar="TRIAL", help="Folder with one video per camera and their calibration, cameras.toml.")
]


def capture(
    trial: Trial,
    out: Out = None,
    cameras: Cameras = None,
    frames: Frames = None,
    preset: Preset = None,
    stature: Stature = None,
    leg_length: LegLength = None,
    asis_distance: AsisDistance = None,
    start: Start = None,
    keypoints: KeyPointsFolder = None,
    person: Person = None,
    people: People = None,
    list_people: ListPeople = False,
    person_net: PersonNet = None,
    body: BodyFile = None,
    fixed_sizes: FixedSizes = False,
    surface_tracks: SurfaceTracks = True,
    sync: Sync = None,
    check: Check = None,
    camera_uncertainty: CameraUncertainty = True,
    no_overlay: NoOverlay = False,
    workers: Workers = None,
    quiet: Quiet = False,
) -> None:
    """Capture the joint motion of the person in a trial.

    TRIAL holds `cam01.mp4`, ... and `cameras.toml`. Images of the empty room, `background/cam01.png`, ..., make the
    silhouettes more accurate; without them, give the joints that a detector found by `--keypoints`. `trial.toml` may
    hold settings. After Ctrl-C, the same command resumes the run.

    Examples:
    * `marey capture walk01`
    * `marey capture walk01 --stature 1.80 --leg-length 0.93 --frames 100:400 --out results/walk01`
    * `marey capture street --keypoints detections`
    * `marey capture street --keypoints detections --list-people`
    * `marey capture street --keypoints detections --person cam01:310,220@40`
    * `marey capture walk01 --cameras cam01,cam02,cam04 --preset upper --no-overlay`
    """
    everybody = wants_everybody(people, person)
    given: dict[str, Any] = {
        "cameras": camera_names(cameras), "frames": frame_range(frames), "preset": preset, "start": start,
        "keypoints": keypoints, "person_net": person_net, "body": body, "fixed_sizes": fixed_sizes,
        "surface_tracks": surface_tracks, "sync": sync, "check": check, "overlay": not no_overlay,
        "camera_uncertainty": camera_uncertainty,
    }  # fmt: skip
    if everybody or list_people:
        _several(
            trial, out=out, everybody=not list_people, workers=workers, quiet=quiet, stature_m=stature,
            leg_length_m=leg_length, asis_distance_m=asis_distance, **given,
        )  # fmt: skip
    else:
        _capture(
            trial, out=out, workers=workers, quiet=quiet, stature=stature, leg_length=leg_length,
            asis_distance=asis_distance, person=person, **given,
        )  # fmt: skip


def demo(out: Out = None, quiet: Quiet = False) -> None:
    """Capture the example that comes with the program, and print the path of its report."""
    from marey.io.trial.example import example_folder

    example = example_folder()
    if out is None and Path(sys.prefix) in example.parents:
        # Results do not belong in the folder of an installed program.
        out = Path("marey-demo")
    _capture(example, out=out, quiet=quiet)


def surface(
    trial: Annotated[
        Path, typer.Argument(metavar="TRIAL", help="Folder with cameras.toml and a video, or stills, of each camera.")
    ],
    out: Out = None,
    cameras: Cameras = None,
    frames: Frames = None,
    seeds: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Clicked seeds: a CSV with one row per seed, x and y in each camera of cameras.toml."
        ),
    ] = None,
    spacing: Annotated[int, typer.Option(metavar="PX", help="Distance between neighbouring points in the image.")] = 2,
    patch: Annotated[int, typer.Option(metavar="PX", help="Width of the smallest patches, an odd number.")] = 13,
    refine_rig: Annotated[
        bool | None,
        typer.Option(
            "--refine-rig/--keep-rig",
            metavar="",
            help="Correct the camera poses by the matches, or keep them. [default: correct them if there are three "
            "or more cameras and the matches clearly contradict their poses]",
        ),
    ] = None,
    tracks: Annotated[
        bool,
        typer.Option("--tracks/--no-tracks", metavar="", help="Follow points over the frames, if there are several."),
    ] = True,
    max_speed: Annotated[
        float | None,
        typer.Option(metavar="M/S", help="Remove trajectories that are faster than this. [default: estimated]"),
    ] = None,
    max_acceleration: Annotated[
        float | None,
        typer.Option(metavar="M/S2", help="Remove trajectories with a larger acceleration. [default: estimated]"),
    ] = None,
    sync: Sync = None,
    workers: Workers = None,
    quiet: Quiet = False,
) -> None:
    """Measure the visible surface of a body or an object as 3-D points, and follow it from frame to frame.

    TRIAL holds `cameras.toml` and `cam01.mp4`, ..., or stills `cam01_1.jpg`, ..., or `images/cam01.jpg`, ... of one
    instant. Images of the empty room in `background/`, or masks in `masks/`, exclude the room. The surface must have
    texture, and neighbouring cameras must be 10 to 25 degrees apart. After Ctrl-C, the same command resumes the run.

    Examples:
    * `marey surface face1`
    * `marey surface arm3 --spacing 4 --frames 0:10`
    * `marey surface face1 --seeds clicked.csv --keep-rig`
    """
    from marey.pipelines.surface.tasks import measure_surface

    require_trial(trial)
    with working(quiet=quiet, parallel_cameras=True, workers=workers, kernels="surface") as progress:
        found = measure_surface(
            trial, out=out or trial / RESULTS, cameras=camera_names(cameras), frames=frame_range(frames), seeds=seeds,
            sync=sync, spacing=spacing, patch=patch, refine_rig=refine_rig, tracks=tracks, max_speed=max_speed,
            max_acceleration=max_acceleration, progress=progress,
        )  # fmt: skip
    end_with_verdict(found.verdict, surface=found.path, report=found.report)


def shape(
    trial: Trial,
    out: Out = None,
    cameras: Cameras = None,
    frames: Frames = None,
    preset: Preset = None,
    stature: Stature = None,
    leg_length: LegLength = None,
    asis_distance: AsisDistance = None,
    start: Start = None,
    body: BodyFile = None,
    no_overlay: NoOverlay = False,
    workers: Workers = None,
    quiet: Quiet = False,
) -> None:
    """Fit the person's own body: skeleton, metaballs and skin.

    The body is fitted to the surface that `marey surface` measured, which is read from the folder of the results or
    measured first, and to the silhouettes. In addition to the files of `marey capture`, `segments.csv` holds lengths,
    girths, volumes, masses and moments of inertia.

    Examples:
    * `marey shape arm --preset right_arm`
    * `marey shape walk01 --stature 1.80 --out results/walk01`
    """
    from marey.pipelines.shape.tasks import fit_shape

    require_trial(trial)
    with working(quiet=quiet, parallel_cameras=True, workers=workers, kernels="shape") as progress:
        found = fit_shape(
            trial, out=out or trial / RESULTS, cameras=camera_names(cameras), frames=frame_range(frames),
            preset=preset, stature=stature, leg_length=leg_length, asis_distance=asis_distance, start=start, body=body,
            overlay=not no_overlay, progress=progress,
        )  # fmt: skip
    end_with_verdict(found.verdict, report=found.report)


def _several(
    trial: Path, *, out: Path | None, everybody: bool, workers: int | None, quiet: bool, **settings: Any
) -> None:  # fmt: skip
    from marey.pipelines.capture.settings import CaptureSettings
    from marey.pipelines.capture.tasks import reopened
    from marey.pipelines.group.everybody import captured_people
    from marey.pipelines.group.listing import listed_people

    require_trial(trial)
    given = CaptureSettings(out=out or trial / RESULTS, **settings)
    with working(quiet=quiet, parallel_cameras=True, workers=workers, kernels="capture") as progress:
        opened = reopened(trial, given.changes())
        if not everybody:
            people = listed_people(opened, given, progress)
        else:
            found = captured_people(opened, given, progress)
    if not everybody:
        typer.echo(f"{people}\nPictures: {', '.join(str(path) for path in people.pictures)}")
        end_with_verdict(people.verdict)
        return
    typer.echo(str(found.people))
    for number, motion in found.motions.items():
        typer.echo(f"Report of person {number}: {motion.report}")
    end_with_verdict(found.verdict, summary=found.summary)


def _capture(trial: Path, *, out: Path | None, workers: int | None = None, quiet: bool, **settings: Any) -> None:
    # The pipeline is imported here, so that help and errors in the arguments appear at once.
    from marey.pipelines.capture.tasks import capture as capture_motion

    require_trial(trial)
    with working(quiet=quiet, parallel_cameras=True, workers=workers, kernels="capture") as progress:
        found = capture_motion(trial, out=out or trial / RESULTS, progress=progress, **settings)
    end_with_verdict(found.verdict, report=found.report)

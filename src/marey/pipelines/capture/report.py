"""Overlay videos, stills and the report of a capture."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np

from marey.arrays import Image, Mask
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.body.people.person import before_images, is_measured, measured_stature, shown_segments
from marey.fit.solver.picture_times import PictureTimes
from marey.fit.solver.threads import usable_threads
from marey.io.results.body import segment_lengths
from marey.io.trial.trial import Trial
from marey.motion.motion import MEASURED, BodyMotion
from marey.pipelines.capture.tracked import SilhouetteRound
from marey.pipelines.gait.files import FILES as GAIT_FILES
from marey.pipelines.gait.files import body_curves, cycle_group, gait_tables
from marey.pipelines.gait.walk import Gait
from marey.pipelines.progress import Progress
from marey.pipelines.run_details import page_head
from marey.pipelines.silhouettes.drawn_surface import HiddenShare
from marey.pipelines.verdict import Verdict
from marey.view.pages.capture_report import ReportContent, Size, write_report
from marey.view.pages.curves import NumberTable, PlotGroup
from marey.view.pages.html import Still, files_beside
from marey.view.pages.problems import find_problems, readable, touches_border
from marey.view.pictures.overlay import BodyAppearance, BodyScene, OverlayVideo

Silhouettes = Callable[[int], Sequence[Mask] | None]
"""Returns the silhouettes (height, width) of a frame, one per camera; None without any."""

FILES = {
    "joint_centres.trc": "joint centres over time, for OpenSim and others",
    "angles.mot, body.osim": "the coordinates of the skeleton for OpenSim, which differ from the anatomical angles of "
    "this page, and the model whose coordinates they are",
    "orientations.sto": "orientations of the segments, for OpenSense",
    "motion.c3d": "joint centres and segments' 4x4 rotations",
    "motion.bvh, body.glb": "the motion and the skinned, animated body, for animation programs",
    "motion.npz, motion.nc": "all results, with standard deviations and flags",
    "angles.csv": "the anatomical angles of this page as a table, with standard deviations and the angles that are not "
    "determined",
    "body.npz, skin.npz": "the person's body at rest, and its skin over time",
    "segments.csv": "lengths, girths, volumes, masses and moments of inertia of the segments",
    "skin.glb": "the closed skin of the fitted body, with the motion",
    "surface.npz, trajectories.npz, surface.html": "the measured surface, its trajectories, and their report",
    "masks/, surface_masks/": "silhouettes of the person, and of the fitted surface",
    "overlay_<camera>.mp4": "the fitted surface over the videos",
    **GAIT_FILES,
    "run.json": "version, settings, inputs, timings",
}
"""The files of a capture and what they contain, for the report."""


def draw_overlays(
    trial: Trial, body: Body, poses: Mapping[int, Pose], motion: BodyMotion, masks_of: Silhouettes, *, folder: Path,
    progress: Progress, times: PictureTimes | None = None, hidden_of: Silhouettes = lambda frame: None,
) -> list[Still]:  # fmt: skip
    """Write `overlay_<camera>.mp4` for every camera, and return some images for the report.

    Args:
        trial: The trial; its take is read once, with one frame at a time in memory.
        body: The fitted body.
        poses: Poses by frame; frames without a pose are shown without a body.
        motion: The measured motion.
        masks_of: The silhouettes.
        folder: Folder for the videos.
        progress: Progress reporter.
        times: When the cameras have taken their pictures; None if that is at the instants of the frames.
        hidden_of: Where something hides the person.

    Returns:
        The middle frame in every camera, and the one with the lowest agreement.
    """
    wanted = _chosen_images(motion)
    stills: list[tuple[tuple[int, int], Still]] = []
    appearance = BodyAppearance(
        faces=body.faces, face_segment=body.face_segment, segment_names=motion.segment_names,
        joint_names=motion.joint_names,
    )  # fmt: skip
    take = trial.take
    with (
        ExitStack() as stack,
        progress.stage("Overlays", take.end - take.first) as step,
        ThreadPoolExecutor(max_workers=usable_threads()) as pool,
    ):
        videos = [
            stack.enter_context(OverlayVideo(folder / f"overlay_{c.name}.mp4", c, appearance, rate=take.rate))
            for c in trial.rig
        ]
        for frame, images in take.frames():
            scenes = _scenes(frame, motion, body, poses, times)
            masks: Sequence[Mask | None] = masks_of(frame) or [None] * len(videos)
            hidden: Sequence[Mask | None] = hidden_of(frame) or [None] * len(videos)

            def add(
                c: int,
                video: OverlayVideo,
                image: Image,
                mask: Mask | None,
                behind: Mask | None,
                scenes: Sequence[BodyScene] = scenes,
                frame: int = frame,
            ) -> Image:
                agreement = float(motion.agreement[frame, c])
                return video.add(image, scenes[c], mask=mask, hidden=behind, agreement=agreement)

            drawn = list(pool.map(add, range(len(videos)), videos, images, masks, hidden))
            for c, name in enumerate(trial.rig.names):
                if (frame, c) in wanted:
                    still = Still(caption=f"{name}, frame {frame}: {wanted[frame, c]}", image=drawn[c])
                    stills.append(((frame, c), still))
            step()
    order = list(wanted)
    return [still for _, still in sorted(stills, key=lambda pair: order.index(pair[0]))]


def _scenes(
    frame: int, motion: BodyMotion, body: Body, poses: Mapping[int, Pose], times: PictureTimes | None
) -> list[BodyScene]:
    """Return what each camera shows, at the instant of its picture."""
    state, count = int(motion.state[frame]), len(motion.camera_names)
    if frame not in poses:
        return [BodyScene(frame=frame, state=state)] * count
    posed = PosedBody(body, poses[frame])
    scene = BodyScene(frame=frame, vertices=posed.vertices, joints=motion.joint_centres[frame], state=state)
    if times is None:
        return [scene] * count
    followed = body.followed_joints[:, None]

    def shown(own: PosedBody) -> BodyScene:
        joints = np.where(followed, own.segment_origin[body.joint_segments], np.nan)
        return scene if own is posed else replace(scene, vertices=own.vertices, joints=joints)

    return [shown(own) for own in times.posed(frame, posed, poses)]


def _chosen_images(motion: BodyMotion) -> dict[tuple[int, int], str]:
    """Choose images (frame, camera) for the report, each with its caption."""
    measured = np.flatnonzero(motion.state == MEASURED)
    if not len(measured):
        return {}
    middle = int(measured[len(measured) // 2])
    chosen = {(middle, c): "the middle of the recording" for c in range(len(motion.camera_names))}
    known = np.where(np.isfinite(motion.agreement), motion.agreement, np.inf)
    frame, camera = np.unravel_index(int(np.argmin(known)), known.shape)
    chosen[int(frame), int(camera)] = "lowest agreement of surface and silhouette"
    return chosen


def cut_by_border(motion: BodyMotion, masks_of: Silhouettes) -> Mask:
    """Return in which frames and cameras (F, C) the border of the image cuts the person."""
    cut = np.zeros(motion.agreement.shape, bool)
    for frame in np.flatnonzero(motion.state > 0):
        masks = masks_of(int(frame))
        if masks is not None:
            cut[frame] = [touches_border(mask) for mask in masks]
    return cut


def person_sizes(body: Body) -> list[Size]:
    """List the person's stature and the lengths of the segments that the images show, with standard deviations."""
    height = measured_stature(body)
    sizes = [] if height is None else [Size(name="stature", value_m=height[0], sd_m=height[1])]
    lengths, sds = segment_lengths(body)
    _, own = segment_lengths(replace(body, joint_offset_sd=None))
    _, before = segment_lengths(before_images(body))
    shown = shown_segments(body)
    for k, name in enumerate(body.skeleton.segment_names):
        if shown[k] and is_measured(own[k], before[k]):
            sizes.append(Size(name=readable(name), value_m=float(lengths[k]), sd_m=float(sds[k])))
    return sizes


def report_capture(
    trial: Trial, motion: BodyMotion, body: Body, masks_of: Silhouettes, *, stills: Sequence[Still],
    settings: Mapping[str, object], folder: Path, progress: Progress, rounds: Sequence[SilhouetteRound] = (),
    verdict: Verdict | None = None, tracks: Mapping[str, tuple[int, float]] | None = None,
    hidden: Mapping[str, HiddenShare] | None = None, command: str = "capture", tables: Sequence[NumberTable] = (),
    gait: Gait | None = None,
) -> None:  # fmt: skip
    """Write report.html.

    Args:
        trial: The trial.
        motion: The measured motion.
        body: The fitted body.
        masks_of: The silhouettes.
        stills: Images from `draw_overlays`.
        settings: Settings, as in run.json.
        folder: Folder for the report.
        progress: Progress reporter, with timings and warnings.
        rounds: The course of silhouettes and pose, if they were estimated in turn.
        verdict: The verdict on the result, for the head of the page; None if there is none.
        tracks: Number of tracked patches of the surface and their mean length in frames, by segment.
        hidden: How much something hides the person, by camera; None if it was not searched for.
        command: The command, for the head of the page.
        tables: Further tables.
        gait: Events, cycles and parameters of a walk; None if the motion is none.
    """
    requested = np.zeros(len(motion), bool)
    requested[trial.take.first : trial.take.end] = True
    problems = find_problems(
        motion, cut=cut_by_border(motion, masks_of), warnings=progress.warnings, usable=requested
    )  # fmt: skip
    person = trial.settings.person
    title = trial.folder.resolve().name + (f" · {person}" if person is not None else "")
    content = ReportContent(
        title=title, motion=motion, body=body, rig=trial.rig, requested=requested, sizes=person_sizes(body),
        tables=[*gait_tables(gait), *tables], cycle=_cycle(gait, motion), problems=problems,
        stills=stills, timings=progress.timings, settings=settings,
        files=files_beside(FILES, [path.name for path in folder.iterdir()]),
        rounds=[(each.energy_nat, each.overlap) for each in rounds],
        tracks={readable(name): known for name, known in (tracks or {}).items()},
        hidden={name: (each.person, each.image) for name, each in (hidden or {}).items()},
        head=page_head(command, verdict, person=person),
    )  # fmt: skip
    write_report(folder / "report.html", content)


def _cycle(gait: Gait | None, motion: BodyMotion) -> PlotGroup | None:
    """Return the plots of the angles over the gait cycle; None without a complete cycle."""
    groups = [] if gait is None else cycle_group(gait, [("", body_curves(gait, motion))])
    return groups[0] if groups else None

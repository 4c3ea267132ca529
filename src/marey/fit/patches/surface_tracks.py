"""Patches of the surface that are tracked through the images, as terms of the refinement of a motion.

Silhouettes hardly show how far a limb has turned about its own axis. Patches of its texture do: the body in its
estimated poses predicts where each patch moves and how it deforms, and its measured shift corrects the poses. Each
patch is compared with its first image, so that its position does not drift; its place on the surface is unknown and
is eliminated, so that a track constrains relative motion only.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from marey.arrays import Floats, Image, Mask
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.cameras.camera import Camera
from marey.fit.patches.kept_patches import KeptPatches, PatchLog
from marey.fit.patches.patch_settings import SurfaceTrackSettings
from marey.fit.patches.patch_tracker import CameraTracker, TrackedFrame, advance_camera
from marey.fit.solver.banded import LocalEquations
from marey.fit.solver.picture_times import PictureTimes
from marey.fit.solver.threads import map_in_two_threads
from marey.observations.surface_tracks import TrackedPatches

FrameImages = Callable[[Sequence[int]], Iterable[tuple[int, Sequence[Image]]]]
"""Reads frames in ascending order: yields each frame's number and one image (height, width, 3) per camera, each of the
camera's size."""


@dataclass(frozen=True, eq=False)
class SurfaceTracks:
    """Patches tracked through a take."""

    by_frame: KeptPatches
    """Patches of each frame, one batch per camera."""
    segment_names: tuple[str, ...]
    """Names of the body's segments."""
    turns: Mapping[int, Floats] = field(default_factory=dict)
    """(S,) by frame: by how much each segment has turned about its axis since the last frame beyond what the poses say,
    according to its patches [rad]; NaN where it has none."""

    def counts(self) -> dict[str, tuple[int, float]]:
        """Return for each segment with tracks their number, and the mean number of frames of a track."""
        segments, frames = self.by_frame.lengths()
        found = {}
        for s in np.unique(segments):
            lengths = frames[segments == s]
            found[self.segment_names[s]] = (len(lengths), float(lengths.sum() / len(lengths)))
        return found


@dataclass(frozen=True, eq=False)
class SurfaceTrackTerms:
    """Tracked patches as terms of one round of a refinement; see `marey.fit.recipes.sequence_equations.LocalTerms`."""

    tracks: SurfaceTracks
    """The tracks, followed with the poses of the last round."""
    local_sd: float
    """Standard deviation of a track's offset [m]."""
    shared: int = 0
    """Number of unknowns that all frames share: none."""

    def terms(self, frame: int, posed: PosedBody) -> tuple[Floats, Floats]:
        """Return equations of zeros: all equations are in `local`."""
        size = len(posed.body.skeleton) + len(posed.body.space)
        return np.zeros((size, size)), np.zeros(size)

    def local(self, frame: int, posed: PosedBody) -> LocalEquations | None:
        """Return the equations of a frame's patches by its pose and by the tracks' offsets; None without patches."""
        batches = self.tracks.by_frame.get(frame, ())
        return _joined_equations([_equations(batch, posed) for batch in batches]) if batches else None


def _equations(batch: TrackedPatches, posed: PosedBody) -> LocalEquations:
    residual, by_pose, by_offset = batch.derivatives(posed)
    weighted_pose = batch.information @ by_pose
    force = batch.information @ residual[..., None]
    flat, back = by_pose.reshape(-1, by_pose.shape[2]), np.swapaxes(by_offset, 1, 2)
    return LocalEquations(
        groups=batch.tracks,
        pose=flat.T @ weighted_pose.reshape(flat.shape),
        pose_gradient=flat.T @ force.ravel(),
        by_pose=np.einsum("nid,nij->dnj", weighted_pose, by_offset),
        own=back @ batch.information @ by_offset,
        gradient=(back @ force)[..., 0],
    )


def _joined_equations(parts: Sequence[LocalEquations]) -> LocalEquations:
    return LocalEquations(
        groups=np.concatenate([part.groups for part in parts]),
        pose=np.sum([part.pose for part in parts], axis=0),
        pose_gradient=np.sum([part.pose_gradient for part in parts], axis=0),
        by_pose=np.concatenate([part.by_pose for part in parts], axis=1),
        own=np.concatenate([part.own for part in parts]),
        gradient=np.concatenate([part.gradient for part in parts]),
    )


def track_surface(
    cameras: Sequence[Camera],
    images: FrameImages,
    masks_of: Callable[[int], Sequence[Mask]],
    poses: Mapping[int, Pose],
    body: Body,
    settings: SurfaceTrackSettings | None = None,
    times: PictureTimes | None = None,
    log: PatchLog | None = None,
) -> SurfaceTracks:
    """Track patches of the surface through a take, with the motion of a posed body as prediction.

    Args:
        cameras: C cameras of the images.
        images: Reads the images.
        masks_of: Returns the silhouettes of a frame, one (height, width) per camera.
        poses: Poses by frame.
        body: The body.
        settings: Settings.
        times: When the cameras have taken their pictures; None if that is at the instants of the frames.
        log: Receives the patches of each frame, so that memory hardly grows with the frames; by default a list.

    Returns:
        The tracks of enough frames; they read the log, which must not be closed or cut while they are used.
    """
    settings = settings or SurfaceTrackSettings()
    trackers = [CameraTracker(camera, body, settings, c, len(cameras)) for c, camera in enumerate(cameras)]
    found = KeptPatches(log)
    turns: dict[int, Floats] = {}
    last = None
    for frame, pictures in images(sorted(poses)):
        begins = last is None or frame - last != 1
        if begins:
            for tracker in trackers:
                tracker.forget()
        step = TrackedFrame(frame, PosedBody(body, poses[frame]), begins or frame % settings.interval == 0)
        late = [step.posed] * len(cameras) if times is None else times.posed(frame, step.posed, poses)
        steps = [step if posed is step.posed else replace(step, posed=posed) for posed in late]
        tasks = list(zip(steps, trackers, pictures, masks_of(frame), strict=True))
        batches = map_in_two_threads(advance_camera, tasks)
        seen = [
            batch if own is step else batch.before_motion(own.posed, step.posed)
            for batch, own in zip(batches, steps, strict=True)
            if batch is not None
        ]
        found.add(frame, seen)
        turns[frame] = _joint_turn(
            np.array([tracker.change for tracker in trackers]), np.array([tracker.strength for tracker in trackers])
        )
        last = frame
    return SurfaceTracks(found.lasting(settings.least_frames), body.skeleton.segment_names, turns)


def _joint_turn(changes: Floats, strength: Floats) -> Floats:
    """Return the mean (S,) of the cameras' changes (C, S), weighted by their information; NaN without any."""
    total = strength.sum(0)
    mean = (changes * strength).sum(0) / np.where(total > 0, total, 1.0)
    return np.where(total > 0, mean, np.nan)

"""Patches of the surface that are tracked through the images, as terms of the refinement of a motion.

Silhouettes hardly show how far a limb has turned about its own axis. Patches of its texture do: the body in its
estimated poses predicts where each patch moves and how it deforms, and its measured shift corrects the poses. Each
patch is compared with its first image, so that its position does not drift; its place on the surface is unknown and
is eliminated, so that a track constrains relative motion only.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from marey.arrays import Floats, Image, Mask
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.cameras.camera import Camera
from marey.fit.patches.kept_patches import KeptPatches, PatchLog
from marey.fit.patches.patch_settings import SurfaceTrackSettings
from marey.fit.patches.patch_tracker import CameraTracker, TrackedFrame
from marey.fit.solver.banded import LocalEquations
from marey.fit.solver.picture_times import PictureTimes
from marey.fit.solver.processes import zip_in_processes
from marey.fit.solver.threads import usable_threads
from marey.observations.surface_tracks import TrackedPatches

CameraImages = Callable[[Sequence[int], Sequence[int]], Iterable[tuple[int, Sequence[Image]]]]
"""Reads frames, in ascending order, of cameras: yields each frame's number and one image (height, width, 3) for each of
these cameras, of the camera's size."""


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
    images: CameraImages,
    mask_of: Callable[[int, int], Mask],
    poses: Mapping[int, Pose],
    body: Body,
    settings: SurfaceTrackSettings | None = None,
    times: PictureTimes | None = None,
    log: PatchLog | None = None,
) -> SurfaceTracks:
    """Track patches of the surface through a take, with the motion of a posed body as prediction.

    The cameras are tracked at the same time, in one process per core, or per camera if these are fewer.

    Args:
        cameras: C cameras of the images.
        images: Reads the images.
        mask_of: Returns the silhouette (height, width) of a frame in a camera.
        poses: Poses by frame.
        body: The body.
        settings: Settings.
        times: When the cameras have taken their pictures; None if that is at the instants of the frames.
        log: Receives the patches of each frame, so that memory hardly grows with the frames; by default a list.

    Returns:
        The tracks of enough frames; they read the log, which must not be closed or cut while they are used.
    """
    settings = settings or SurfaceTrackSettings()
    work = _Tracking(cameras, images, mask_of, poses, body, settings, times)
    count = min(usable_threads(), len(cameras))
    groups = [range(first, len(cameras), count) for first in range(count)]
    found, turns = KeptPatches(log), dict[int, Floats]()
    parts = zip_in_processes([partial(work.of_cameras, group) for group in groups])
    for frame, part in zip(sorted(poses), parts, strict=True):
        seen = dict(sorted(item for group in part for item in group.items()))
        batches = [(c, own.patches) for c, own in seen.items() if own.patches is not None]
        found.add(frame, [replace(patches, camera=cameras[c]) for c, patches in batches])
        turns[frame] = _joint_turn(
            np.array([own.change for own in seen.values()]), np.array([own.strength for own in seen.values()])
        )
    return SurfaceTracks(found.lasting(settings.least_frames), body.skeleton.segment_names, turns)


@dataclass(frozen=True, eq=False)
class _CameraFrame:
    """What one camera shows in one frame."""

    patches: TrackedPatches | None
    """Patches at the instant of the frame; None without any."""
    change: Floats
    """(S,) turn of each segment since the last frame beyond what the poses say [rad]."""
    strength: Floats
    """(S,) information about it [1/rad2]."""


@dataclass(frozen=True, eq=False)
class _Tracking:
    """The arguments of `track_surface`."""

    cameras: Sequence[Camera]
    images: CameraImages
    mask_of: Callable[[int, int], Mask]
    poses: Mapping[int, Pose]
    body: Body
    settings: SurfaceTrackSettings
    times: PictureTimes | None

    def of_cameras(self, group: Sequence[int]) -> Iterator[dict[int, _CameraFrame]]:
        """Track the patches of some cameras, and yield what they show in each frame, by camera."""
        count = len(self.cameras)
        trackers = {c: CameraTracker(self.cameras[c], self.body, self.settings, c, count) for c in group}
        last = None
        for frame, pictures in self.images(sorted(self.poses), group):
            begins = last is None or frame - last != 1
            step = TrackedFrame(
                frame, PosedBody(self.body, self.poses[frame]), begins or frame % self.settings.interval == 0
            )
            late = None if self.times is None else self.times.posed(frame, step.posed, self.poses)
            seen = {}
            for (c, tracker), picture in zip(trackers.items(), pictures, strict=True):
                if begins:
                    tracker.forget()
                own = step if late is None else replace(step, posed=late[c])
                patches = tracker.advance(own, picture, self.mask_of(frame, c))
                if patches is not None and own.posed is not step.posed:
                    patches = patches.before_motion(own.posed, step.posed)
                seen[c] = _CameraFrame(patches, tracker.change, tracker.strength.copy())
            yield seen
            last = frame


def _joint_turn(changes: Floats, strength: Floats) -> Floats:
    """Return the mean (S,) of the cameras' changes (C, S), weighted by their information; NaN without any."""
    total = strength.sum(0)
    mean = (changes * strength).sum(0) / np.where(total > 0, total, 1.0)
    return np.where(total > 0, mean, np.nan)

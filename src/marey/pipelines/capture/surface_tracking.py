"""Patches of the surface, tracked through the images of a trial for the last refinement."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from marey.arrays import Image, Mask
from marey.body.articulation.pose import Pose
from marey.body.articulation.surface import Body
from marey.cameras.camera import Camera
from marey.fit.recipes.detections import JoinedTerms
from marey.fit.recipes.person import SilhouetteTake
from marey.fit.recipes.sequence import FrameTerms, FrameTermsFactory
from marey.fit.recipes.surface_tracks import SurfaceTracks, SurfaceTrackSettings, SurfaceTrackTerms, track_surface
from marey.fit.recipes.turn_jumps import outline_disagreement, without_jumps
from marey.fit.search.levels import FrameLevels
from marey.observations.prior import Habit, JointLimits
from marey.pipelines.capture.run import Run
from marey.pipelines.capture.stages import resized

SETTINGS = SurfaceTrackSettings()
"""Settings of the tracks."""


@dataclass(frozen=True, eq=False)
class TrialImages:
    """The images and silhouettes of a trial at the size of the last refinement."""

    run: Run
    levels: FrameLevels

    def cameras(self, frame: int) -> Sequence[Camera]:
        """Return the cameras of the reduced images, which are the same in every frame."""
        return self.levels.at(frame).cameras

    def masks(self, frame: int) -> Sequence[Mask]:
        """Return the silhouettes of a frame."""
        return self.levels.at(frame).masks

    def images(self, frames: Sequence[int]) -> Iterator[tuple[int, list[Image]]]:
        """Read the images of frames in ascending order."""
        cameras = self.cameras(frames[0])
        for frame, images in self.run.trial.take.at(frames):
            yield frame, [resized(image, camera) for image, camera in zip(images, cameras, strict=True)]

    def tracks(self, poses: Mapping[int, Pose], body: Body) -> SurfaceTracks:
        """Track patches with the motion of a posed body as prediction."""
        return track_surface(self.cameras(min(poses)), self.images, self.masks, poses, body, SETTINGS)


def track_patches(
    run: Run, take: SilhouetteTake, body: Body, poses: Mapping[int, Pose], further: FrameTermsFactory | None
) -> tuple[dict[int, Pose], FrameTermsFactory]:
    """Track patches of the surface, undo jumps of the poses that the tracks show, and prepare the tracks as terms.

    Args:
        run: The run.
        take: Cameras and silhouettes.
        body: The body.
        poses: Poses by frame.
        further: Further observations for the refinement.

    Returns:
        The poses by frame, and the terms of the refinement; each of its rounds tracks the patches again, with its own
        poses.
    """
    levels = take.levels(run.person.fine_height)
    source = TrialImages(run, levels)
    priors = (JointLimits(), Habit(share=run.person.sequence.habit))
    with run.progress.stage("Surface tracks"):
        tracks = source.tracks(poses, body)
        found = without_jumps(tracks, poses, body, outline_disagreement(levels, body, priors))
    run.progress.report(tracks_text(tracks))
    if any(found[frame] is not poses[frame] for frame in found):
        run.progress.report("The turn of the head is another one than that of the tracking, as the tracks show")

    def of_round(poses: Mapping[int, Pose], body: Body) -> FrameTerms:
        own = SurfaceTrackTerms(source.tracks(poses, body), SETTINGS.offset_sd_m)
        return own if further is None else JoinedTerms((own, further(poses, body)))

    return found, of_round


def tracks_text(tracks: SurfaceTracks) -> str:
    """Return how many patches were tracked on which segments, and for how long."""
    counts = tracks.counts()
    if not counts:
        return "Surface tracks: none; the turns of limbs about their axes follow from silhouettes alone"
    parts = [f"{name.replace('_', ' ')} {count} ({length:.0f} frames)" for name, (count, length) in counts.items()]
    return f"Surface tracks: {', '.join(parts)}"

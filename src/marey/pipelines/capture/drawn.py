"""A person as its body would be seen: poses, sizes, and how far the outline may be away."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, Mask
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.cameras.camera import Camera
from marey.fit.recipes.detections import terms_with, track_detections
from marey.fit.recipes.hypotheses import Alternative
from marey.fit.recipes.person import SilhouetteTake, interpolated_poses, refine_person
from marey.fit.recipes.sequence_equations import FrameTermsFactory
from marey.fit.recipes.uncertainty import part_deviations
from marey.fit.search import placements
from marey.io.stages import Arrays
from marey.pipelines.capture.detected import DetectedPerson
from marey.pipelines.capture.run import Bodies, Run
from marey.pipelines.capture.tracked import (
    Tracked,
    frames_for_sizes,
    pack_tracked,
    rounds_of,
    unpack_tracked,
)
from marey.pipelines.occlusion.occluders import Occluders
from marey.pipelines.people.other_regions import OtherPeople, OtherRegions
from marey.pipelines.silhouettes import stages
from marey.pipelines.silhouettes.drawn_body import length_px

DETECTION_ROUNDS = 6
"""Rounds of the refinement to detected joints alone. Chosen by hand."""
DETECTED_SD_M, CLOTHES_SD_M = 0.035, 0.015
"""Standard deviation of the outline from the drawn body beside that of the pose [m]: with a body that was fitted to
detected joints, whose sizes are wrong by centimetres, and with one that was fitted to outlines, from which clothes
differ. Chosen by hand."""


@dataclass(frozen=True, eq=False)
class Drawn:
    """The person of a take as its body would be seen: poses, and how far the outline may be away."""

    body: Body
    poses: Mapping[int, Pose]
    deviations: Mapping[int, Floats]
    """(C, P) standard deviation of each part's outline in each full image, by frame [px]."""
    elsewhere: Mask | None = None
    """(F, C) true where a detector found only other people in an image; None without a detector."""
    others: OtherPeople | None = None
    """Other people; None if nothing is known of any."""
    alternatives: Sequence[Alternative] = ()
    """Other postures of limbs that the images do not exclude."""
    searched: Sequence[str] = placements.SEARCHED_LIMBS
    """Names of the limbs that the next search for lost limbs places."""
    occluders: Occluders | None = None
    """Things of the room in front of the person; None as long as nothing is known of any."""

    def regions(self, posed: PosedBody, frame: int, number: int, camera: Camera) -> OtherRegions | None:
        """Return where other people are in an image; None if there is nobody else."""
        place = posed.segment_origin.mean(axis=0)
        return None if self.others is None else self.others.regions(frame, number, camera, place)


def drawn_from_detections(run: Run, bodies: Bodies, detected: DetectedPerson) -> Drawn:
    """Estimate motion and rough shape from detected joints alone; short gaps are interpolated.

    Args:
        run: The run.
        bodies: The body with many and with few vertices.
        detected: The person and its detected joints.

    Returns:
        The person.
    """
    rate, person, cameras = run.trial.take.rate, run.person, tuple(run.trial.rig)
    free = bodies.held() if run.settings.fixed_sizes else bodies

    def compute() -> Arrays:
        with run.progress.stage("Detected joints"):
            body, poses, first = track_detections(
                detected.joints, detected.track, free.fine, person, rate=rate, start=detected.start
            )  # fmt: skip
        stages.require_upright(run.trial, PosedBody(body, poses[first]))
        poses = dict(sorted({**poses, **interpolated_poses(poses, longest=person.bridge * rate)}.items()))
        nothing = [np.zeros((camera.height, camera.width), bool) for camera in cameras]
        take = SilhouetteTake(cameras, lambda frame: nothing, tuple(poses), rate)
        every, terms = dict.fromkeys(poses, 1.0), terms_with(detected.joints, run.further, alone=True)
        drawn = Drawn(body, poses, {})
        drawn = fitted_person(run, take, drawn, every, terms, DETECTION_ROUNDS, DETECTED_SD_M, "detections")
        return pack_drawn(drawn, every)

    return unpack_drawn(run.cache.arrays("detected", compute, depends=run.scope), bodies.fine)


def drawn_from_silhouettes(run: Run, tracked: Tracked, take: SilhouetteTake, terms: FrameTermsFactory | None) -> Drawn:
    """Refine a person that was tracked in first silhouettes, which gives the uncertainty of its poses.

    Args:
        run: The run.
        tracked: The tracked person.
        take: Cameras and first silhouettes.
        terms: Further observations for the refinement.

    Returns:
        The person.
    """
    full = list(run.trial.rig)

    def compute() -> Arrays:
        drawn = Drawn(tracked.body, tracked.poses, {})
        scores = {frame: tracked.scores.get(frame, 0.0) for frame in tracked.poses}
        return pack_drawn(fitted_person(run, take, drawn, scores, terms, 1, DETECTED_SD_M, "first", full), scores)

    return unpack_drawn(run.cache.arrays("drawn", compute, depends=run.scope), tracked.body)


def fitted_person(
    run: Run, take: SilhouetteTake, drawn: Drawn, scores: Mapping[int, float], terms: FrameTermsFactory | None,
    rounds: int, outline_sd_m: float, name: str, cameras: Sequence[Camera] | None = None,
) -> Drawn:  # fmt: skip
    """Refine motion and shape, and project the uncertainty of each pose into the images.

    Args:
        run: The run.
        take: Cameras and silhouettes.
        drawn: The person.
        scores: Scores of the frames, by which those for the sizes are chosen.
        terms: Further observations.
        rounds: Number of rounds of the refinement.
        outline_sd_m: Standard deviation of the outline from the drawn body beside that of the pose [m].
        name: Name of the stored rounds.
        cameras: Cameras of the images in which deviations are stated; by default those of the silhouettes.

    Returns:
        The person with refined poses and sizes, and their deviations.
    """
    poses: dict[int, Pose] = {}
    deviations: dict[int, Floats] = {}
    cameras, degrees = list(cameras or take.cameras), len(drawn.body.skeleton)
    with (
        rounds_of(run, name) as memory,
        run.progress.stage("Shape and motion", rounds * len(drawn.poses)) as step,
    ):
        for fit in refine_person(
            take, drawn.body, drawn.poses, frames_for_sizes(run, scores), run.person, height=run.person.track_height,
            rounds=rounds, extra_terms=terms, progress=lambda frame: step(), checkpoint=memory,
        ):  # fmt: skip
            for frame, pose, covariance in zip(fit.frames, fit.poses, fit.covariance, strict=True):
                posed = PosedBody(fit.body, pose)
                poses[int(frame)] = pose
                own = part_deviations(posed, covariance[:degrees, :degrees], cameras)
                clothes = np.array([length_px(posed, camera, outline_sd_m) for camera in cameras])
                deviations[int(frame)] = np.sqrt(own**2 + clothes[:, None] ** 2)
            body = fit.body
        memory.parts.clear()
    return replace(drawn, body=body, poses=poses, deviations=deviations)


def pack_drawn(drawn: Drawn, scores: Mapping[int, float]) -> Arrays:
    """Return a person's poses, sizes and deviations, and the scores of the frames, as arrays to be stored."""
    return pack_tracked(drawn.poses, drawn.body, scores) | {"deviations": np.array(list(drawn.deviations.values()))}


def unpack_drawn(arrays: Arrays, body: Body) -> Drawn:
    """Return the person of stored arrays, with a body of the same kind as another one."""
    tracked = unpack_tracked(arrays, body)
    deviations = dict(zip(tracked.poses, arrays["deviations"], strict=True))
    return Drawn(tracked.body, tracked.poses, deviations)

"""A person tracked through a take, the checkpoints of its poses, patches on its surface, and what stands in front."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from marey.arrays import Floats, Image
from marey.body.articulation.pose import Pose, packed_poses, unpacked_poses
from marey.body.articulation.surface import Body
from marey.body.metaballs.metaball_person import reshaped
from marey.body.people.known_lengths import KnownLengths, can_place_hips, place_hips
from marey.cameras.camera import Camera
from marey.cameras.parameters import LENS_PARAMETERS, PARAMETERS
from marey.cameras.rig import Rig
from marey.fit.cameras.refine import CAMERA_ROUNDS, CameraPrior, refine_cameras
from marey.fit.patches.kept_patches import PatchLog
from marey.fit.patches.patch_settings import SurfaceTrackSettings
from marey.fit.patches.surface_tracks import SurfaceTracks, SurfaceTrackTerms, track_surface
from marey.fit.patches.turn_jumps import outline_disagreement, without_jumps
from marey.fit.recipes.detections import JoinedTerms, terms_with
from marey.fit.recipes.hypotheses import Alternative
from marey.fit.recipes.person import (
    SilhouetteTake,
    pose_scores,
    refined_poses,
    repair_person,
    shape_frames,
    with_shape,
)
from marey.fit.recipes.sequence import RefineCheckpoint
from marey.fit.recipes.sequence_equations import FrameTerms, FrameTermsFactory
from marey.fit.search.levels import FrameLevels
from marey.fit.search.search import Candidate
from marey.fit.solver.camera_terms import CameraUnknowns
from marey.images.silhouettes.occluders import OccluderSettings
from marey.io.stages import Arrays
from marey.observations.prior import Habit, JointLimits
from marey.pipelines.cameras.knocked import UNDETERMINED_DEG, UNDETERMINED_MM, displacement, displacement_sd
from marey.pipelines.capture.detected import DetectedPerson
from marey.pipelines.capture.run import Bodies, Run
from marey.pipelines.kept_candidates import KeptArrays, KeptCandidates
from marey.pipelines.occlusion.occluders import BodyTake, Occluders, find_occluders
from marey.pipelines.silhouettes.empty_rooms import resized
from marey.pipelines.silhouettes.mask_store import MaskStore
from marey.wording import listed


@dataclass(frozen=True, eq=False)
class Tracked:
    """A person tracked through a take: the body, and one pose per frame."""

    body: Body
    poses: Mapping[int, Pose]
    scores: Mapping[int, float]


@dataclass(frozen=True)
class SilhouetteRound:
    """One of the rounds in which silhouettes and pose are estimated in turn."""

    energy_nat: float
    """Mean energy of the silhouettes of a frame, the sum over its images, relative to that of no person [nat];
    that of reduced images is scaled to the size of full ones, which holds only roughly."""
    overlap: float
    """Mean overlap of the silhouettes with the body about which they were found, from 0 to 1."""
    kept: int = 0
    """Number of frames whose silhouettes are those of the round before, because the body has hardly moved since."""


@dataclass(frozen=True, eq=False)
class FollowedPerson:
    """A person tracked through the take, and the silhouettes with the person as prior."""

    tracked: Tracked
    filled: Mapping[int, Pose]
    """Interpolated poses of frames between others with a pose."""
    outlines: MaskStore
    frames: Sequence[int]
    """Frames that show a person."""
    terms: FrameTermsFactory | None = None
    """Further observations for the refinement."""
    repaired: bool = True
    """Whether single frames are repaired by searching for limbs in the silhouettes; they must show the whole person."""
    rounds: Sequence[SilhouetteRound] = ()
    """The course of silhouettes and pose, if they were estimated in turn."""
    alternatives: Sequence[Alternative] = ()
    """Other postures of limbs that the images do not exclude."""
    rig: Rig | None = None
    """The cameras, if one of them was found again; None for those of the trial."""
    occluders: Occluders | None = None
    """Things of the room in front of the person; None if they were not searched for."""
    camera_covariance: Floats | None = None
    """(15 C, 15 C) of the cameras' parameters after one was found again; None if none was."""

    def take(self, run: Run) -> SilhouetteTake:
        """Return the take as the refinement needs it."""
        poses, store = self.tracked.poses, self.outlines
        return SilhouetteTake(
            tuple(run.trial.rig), store, tuple(poses), run.trial.take.rate, store.edges, store.hidden, run.times
        )


def frames_for_sizes(run: Run, scores: Mapping[int, float]) -> list[int]:
    """Return the frames from which the sizes of the body are estimated; none if they are fixed."""
    return [] if run.settings.fixed_sizes else shape_frames(scores, run.person.shape_frames)


def with_placed_hips(run: Run, tracked: Tracked) -> Tracked:
    """Place the hips of a tracked person by the lengths that the user measured; see `place_hips`."""
    settings, body = run.trial.settings, tracked.body
    known = KnownLengths(leg_m=settings.leg_length_m, asis_m=settings.asis_distance_m)
    if known == KnownLengths():
        return tracked
    if not can_place_hips(body):
        run.progress.warn(
            "The measured leg length and ASIS distance are not used: "
            "the body has no hips that could be moved alone, or its legs are not followed."
        )
        return tracked
    placed = place_hips(body, known)
    for name, seen in placed.refused.items():
        run.progress.warn(
            f"The measured {name} is not used: the images show a body of another size ({seen:.2f} m between its "
            "joint centres). Check its value, its unit and the person."
        )
    for name, moved in placed.moved_m.items():
        run.progress.report(f"The measured {name} moves each hip by {1000 * abs(moved):.0f} mm.")
    return replace(tracked, body=placed.body)


@contextmanager
def rounds_of(run: Run, name: str) -> Iterator[RefineCheckpoint]:
    """Open the checkpoints of a refinement: finished rounds, and finished windows of the present round."""
    with (
        run.cache.frames(f"{name}_rounds", depends=run.scope) as rounds,
        run.cache.frames(f"{name}_windows", depends=run.scope) as windows,
    ):
        yield RefineCheckpoint(KeptArrays(rounds), KeptArrays(windows))


def pack_candidates(found: Mapping[int, Candidate], body: Body) -> Arrays:
    """Return candidates by frame, and the shape parameters of their body, as arrays."""
    return pack_tracked({f: c.posed.pose for f, c in found.items()}, body, {f: c.score for f, c in found.items()})


def pack_tracked(poses: Mapping[int, Pose], body: Body, scores: Mapping[int, float]) -> Arrays:
    """Return poses and scores by frame, and the shape parameters of the body, as arrays."""
    return {
        "frames": np.array(list(poses)),
        **packed_poses(poses.values()),
        "score": np.array([scores[frame] for frame in poses]),
        "numbers": np.array(body.numbers),
    }


def unpack_tracked(arrays: Arrays, body: Body) -> Tracked:
    """Return the tracked person from its arrays; the body is another one of the same shape parameters."""
    frames = [int(frame) for frame in arrays["frames"]]
    return Tracked(
        reshaped(body, arrays["numbers"]),
        dict(zip(frames, unpacked_poses(arrays), strict=True)),
        dict(zip(frames, map(float, arrays["score"]), strict=True)),
    )


SURFACE_TRACKS = SurfaceTrackSettings()
"""Settings of the tracks."""


@dataclass(frozen=True, eq=False)
class TrialImages:
    """The images and silhouettes of a trial at the size of the last refinement."""

    run: Run
    levels: FrameLevels
    log: PatchLog = field(default_factory=list[Arrays])
    """Receives the tracked patches."""

    def cameras(self, frame: int) -> Sequence[Camera]:
        """Return the cameras of the reduced images, which are the same in every frame."""
        return self.levels.at(frame).cameras

    def images(self, frames: Sequence[int], cameras: Sequence[int]) -> Iterator[tuple[int, list[Image]]]:
        """Read the images of some cameras, of frames in ascending order."""
        own = self.cameras(frames[0])
        for frame, images in self.run.trial.take.at(frames, cameras):
            yield frame, [resized(image, own[c]) for image, c in zip(images, cameras, strict=True)]

    def tracks(self, poses: Mapping[int, Pose], body: Body) -> SurfaceTracks:
        """Track patches with the motion of a posed body as prediction."""
        return track_surface(
            self.cameras(min(poses)), self.images, self.levels.mask, poses, body, SURFACE_TRACKS, self.run.times,
            self.log,
        )  # fmt: skip


def track_patches(
    run: Run, take: SilhouetteTake, body: Body, poses: Mapping[int, Pose], further: FrameTermsFactory | None,
    log: PatchLog,
) -> tuple[dict[int, Pose], FrameTermsFactory, dict[str, tuple[int, float]]]:  # fmt: skip
    """Track patches of the surface, undo jumps of the poses that the tracks show, and prepare the tracks as terms.

    Args:
        run: The run.
        take: Cameras and silhouettes.
        body: The body.
        poses: Poses by frame.
        further: Further observations for the refinement.
        log: Receives the patches of each frame, those of every tracking after those of the one before; it is in use
            as long as the terms are.

    Returns:
        The poses by frame; the terms of the refinement, each of whose rounds with other poses tracks the patches
        again; and the number of patches and their mean length in frames, by segment.
    """
    levels = take.levels(run.person.fine_height)
    source = TrialImages(run, levels, log)
    priors = (JointLimits(), Habit(share=run.person.sequence.habit))
    with run.progress.stage("Surface tracks"):
        tracks = source.tracks(poses, body)
        found = without_jumps(tracks, poses, body, outline_disagreement(levels, body, priors))
    run.progress.report(tracks_text(tracks))
    if any(found[frame] is not poses[frame] for frame in found):
        run.progress.report("The turn of the head is another one than that of the tracking, as the tracks show")

    def of_round(current: Mapping[int, Pose], fitted: Body) -> FrameTerms:
        same = fitted is body and all(poses[frame] is pose for frame, pose in current.items())
        own = SurfaceTrackTerms(tracks if same else source.tracks(current, fitted), SURFACE_TRACKS.offset_sd_m)
        return own if further is None else JoinedTerms((own, further(current, fitted)))

    return found, of_round, tracks.counts()


def tracks_text(tracks: SurfaceTracks) -> str:
    """Return how many patches were tracked on which segments, and for how long."""
    counts = tracks.counts()
    if not counts:
        return "Surface tracks: none; the turns of limbs about their axes follow from silhouettes alone"
    parts = [f"{name.replace('_', ' ')} {count} ({length:.0f} frames)" for name, (count, length) in counts.items()]
    return f"Surface tracks: {', '.join(parts)}"


def terms_for(run: Run, detected: DetectedPerson | None) -> FrameTermsFactory | None:
    """Return the detected joints, in the cameras of the run, and the user's observations as terms of a refinement."""
    if detected is None:
        return run.further
    joints = detected.joints if run.moved is None else replace(detected.joints, cameras=run.trial.rig.cameras)
    return terms_with(joints, run.further)


FOUND_CAMERA = CameraPrior(turn_rad=0.05, shift_m=0.2)
"""Error of a camera that was found by the frontier points of silhouettes: about the largest of 16 such cameras of four
rendered takes, 2.6 degrees and 160 mm, and 0.7 degrees and 50 mm in the mean."""


def with_found_camera(
    run: Run, take: SilhouetteTake, tracked: Tracked, *, height: float, detected: DetectedPerson | None
) -> tuple[Run, SilhouetteTake, Tracked, Floats]:
    """Refine the camera that was found again, together with motion and body.

    Args:
        run: The run.
        take: Cameras and silhouettes, possibly of smaller images than those of the trial.
        tracked: The person.
        height: Height of the person in the images [px].
        detected: The person whose joints were detected.

    Returns:
        The run and the take with the camera, the person, and the covariance (15 C, 15 C) of the cameras.
    """
    names = run.trial.rig.names
    moved = names.index(run.moved.name) if run.moved is not None else -1
    priors = [FOUND_CAMERA if c == moved else CameraPrior() for c in range(len(names))]

    def terms_of(cameras: Sequence[Camera]) -> FrameTermsFactory | None:
        return terms_for(_in_place(run, cameras), detected)

    with run.progress.stage("Camera", CAMERA_ROUNDS) as step:
        found = refine_cameras(
            take, tracked.body, tracked.poses, frames_for_sizes(run, tracked.scores), run.person, priors=priors,
            height=height, terms_of=terms_of, progress=step,
        )  # fmt: skip
    take.forget()
    return (
        _in_place(run, found.cameras), replace(take, cameras=found.cameras),
        Tracked(found.body, found.poses, tracked.scores), found.covariance,
    )  # fmt: skip


def _in_place(run: Run, cameras: Sequence[Camera]) -> Run:
    """Return the run with its cameras at the places of others of the same names."""
    rig = Rig(
        tuple(
            replace(own, camera_from_world=other.camera_from_world)
            for own, other in zip(run.trial.rig, cameras, strict=True)
        )
    )
    return replace(run, trial=replace(run.trial, rig=rig))


def report_found_camera(run: Run, covariance: Floats) -> None:
    """Warn of the camera that was found again, with its displacement and how well that is known."""
    if run.moved is None:
        return
    camera, c = run.trial.rig[run.moved.name], run.trial.rig.names.index(run.moved.name)
    own = covariance[PARAMETERS * c : PARAMETERS * (c + 1), PARAMETERS * c : PARAMETERS * (c + 1)]
    turn_deg, shift_mm = displacement(run.moved, camera)
    turn_sd_deg, shift_sd_mm = displacement_sd(camera, own)
    if turn_sd_deg > UNDETERMINED_DEG or shift_sd_mm > UNDETERMINED_MM:
        more = " The take hardly determines it: film a person who walks through the whole volume."
    else:
        more = " `marey calibrate --from-person` keeps it in a file; better calibrate the cameras again."
    run.progress.warn(
        f"{camera.name} is not where the calibration places it: it was found again by the silhouettes, turned by "
        f"{turn_deg:.2f} degrees (sd {turn_sd_deg:.2f}) and shifted by {shift_mm:.0f} mm (sd {shift_sd_mm:.0f}).{more}"
    )


def camera_errors(run: Run, found: Floats | None) -> CameraUnknowns | None:
    """Return the errors of the cameras that enlarge the standard deviations; None if they are not known.

    Args:
        run: The run.
        found: (15 C, 15 C) covariance of the camera that was found again; None if none was.
    """
    stated = run.trial.camera_covariance
    if not run.settings.camera_uncertainty or (stated is None and found is None):
        return None
    count = PARAMETERS * len(run.trial.rig)
    total = np.zeros((count, count)) if stated is None else np.array(stated)
    if found is not None and run.moved is not None:
        c = run.trial.rig.names.index(run.moved.name)
        pose = slice(PARAMETERS * c + LENS_PARAMETERS, PARAMETERS * (c + 1))
        total[pose], total[:, pose] = 0.0, 0.0
        total[pose, pose] = found[pose, pose]
    return CameraUnknowns.of_covariance(run.trial.rig.cameras, total) if total.any() else None


REFIT_ROUNDS = 4
"""Rounds of matching and solving after things in front of the person were found. Chosen by hand."""


def with_occluders(
    run: Run, take: SilhouetteTake, tracked: Tracked, bodies: Bodies, terms: FrameTermsFactory | None
) -> tuple[Tracked, Occluders]:
    """Find what stands in front of a tracked person, and fit its motion and shape again if there is something.

    Args:
        run: The run.
        take: Cameras and first silhouettes.
        tracked: The person, tracked as if nothing were in front.
        bodies: The body with many and with few vertices.
        terms: Further observations for the refinement.

    Returns:
        The person and the things.
    """
    found = _found(run, take, tracked, "occluders")
    if not found.any:
        return tracked, found
    report_occluders(run, found)
    tracked = _fitted_again(run, take, tracked, bodies, terms, found)
    return tracked, _found(run, take, tracked, "occluders_again")


def report_occluders(run: Run, found: Occluders) -> None:
    """Report which share of each camera's image lies behind a thing."""
    shares = [
        f"{name} {100 * thing.share:.1f} %"
        for name, thing in zip(run.trial.rig.names, found.things, strict=True)
        if thing.share > 0
    ]
    run.progress.report(f"In front of the person: something in {listed(shares)} of the image")


def _found(run: Run, take: SilhouetteTake, tracked: Tracked, name: str) -> Occluders:
    seen = BodyTake(take.cameras, tracked.body, tracked.poses, take.times)

    def compute() -> Arrays:
        with run.progress.stage("Things in front"):
            return find_occluders(seen, take.masks_of, take.hidden_of, OccluderSettings()).packed()

    return Occluders.unpacked(run.cache.arrays(name, compute, depends=run.scope))


def _fitted_again(
    run: Run, take: SilhouetteTake, tracked: Tracked, bodies: Bodies, terms: FrameTermsFactory | None, found: Occluders
) -> Tracked:
    """Repair single frames, and refine motion and shape, where nothing is in front."""
    person = run.person
    seen = BodyTake(take.cameras, tracked.body, tracked.poses, take.times)
    take = replace(take, hidden_of=found.hidden_in(seen, take.masks_of))

    def compute() -> Arrays:
        coarse = with_shape(tracked.body, bodies.coarse)
        with (
            run.cache.frames("repaired_behind", depends=run.scope) as log,
            rounds_of(run, "behind") as memory,
            run.progress.stage("Shape and motion", REFIT_ROUNDS * len(tracked.poses)) as step,
        ):
            kept = KeptCandidates[tuple[int, int]](log, tracked.body)
            start = repair_person(take, tracked.body, coarse, tracked.poses, person, checkpoint=kept)
            scores = _scores(run, take, tracked, start)
            poses, body = refined_poses(
                take, tracked.body, start, frames_for_sizes(run, scores), person, height=person.track_height,
                rounds=REFIT_ROUNDS, extra_terms=terms, progress=lambda frame: step(), checkpoint=memory,
            )  # fmt: skip
        return pack_tracked(poses, body, scores)

    again = unpack_tracked(run.cache.arrays("behind", compute, depends=run.scope), tracked.body)
    take.forget()
    return again


def _scores(run: Run, take: SilhouetteTake, tracked: Tracked, poses: dict[int, Pose]) -> dict[int, float]:
    """Return the scores of poses where nothing is in front."""
    return pose_scores(take.levels(run.person.track_height), tracked.body, poses, run.person.start)

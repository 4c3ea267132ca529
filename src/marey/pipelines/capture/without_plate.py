"""Capture in a room of which there is no empty image: silhouettes and pose are estimated in turn.

The first poses follow from detected joints. With them, the background of every camera is learned where the person is
elsewhere, and the colours of the parts of the body where the person is. The level sets are drawn to the projected body,
with a weight that follows from its uncertainty, and the body to the level sets ([Rosenhahn2006] section 3.1), until the
poses of all frames have converged.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace

import cv2
import numpy as np

from marey.arrays import Floats, Image, Mask
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.skeleton import COLOUR_PARTS
from marey.cameras.camera import Camera
from marey.fit.recipes.person import SilhouetteTake
from marey.fit.recipes.sequence_equations import FrameTermsFactory
from marey.fit.recipes.uncertainty import part_displacements
from marey.fit.solver.threads import map_in_threads
from marey.images.features.part_evidence import EDGE
from marey.images.features.texture import CELLS
from marey.images.silhouettes.background import Background
from marey.images.silhouettes.occluders import OccluderSettings
from marey.images.silhouettes.other_person import TwoColours
from marey.images.silhouettes.part_colours import PartColourCounts, PartColours
from marey.images.silhouettes.uncovered import background_with_empty
from marey.io.stages import Arrays
from marey.observations.correspondence import view_of
from marey.pipelines.capture.detected import DetectedPerson
from marey.pipelines.capture.drawn import (
    CLOTHES_SD_M,
    Drawn,
    drawn_from_detections,
    fitted_person,
    pack_drawn,
    unpack_drawn,
)
from marey.pipelines.capture.evidence import PersonEvidence, person_evidence, with_evidence
from marey.pipelines.capture.run import Bodies, Logs, Run
from marey.pipelines.capture.tracked import (
    FollowedPerson,
    SilhouetteRound,
    Tracked,
)
from marey.pipelines.occlusion.occluders import BodyTake, Occluders, find_occluders
from marey.pipelines.people.other_regions import OtherColourSums
from marey.pipelines.silhouettes import stages
from marey.pipelines.silhouettes.drawn_body import cells_inside, outline_prior, part_map
from marey.pipelines.silhouettes.empty_rooms import TRACKED_PX, empty_rooms, reduced_cameras, resized
from marey.pipelines.silhouettes.mask_store import MaskStore
from marey.pipelines.silhouettes.small_take import ABSENT_FRAMES, far_from, spread

LEARNED_IMAGES = 24
"""Number of images per camera from which the background and the colours of the parts are learned.

Chosen by hand; the time grows with its square.
"""
MOST_ROUNDS = 6
"""Largest number of times that silhouettes are found. With detected joints, the silhouettes of 78 of 99 frames of
`market`, 110 of 120 of `jacks` and 48 of 120 of `office` are kept in the last one. Without them, the joints of `office`
are 18.3 mm off after five times and 17.4 mm after seven, those of `stealth` 8.9 and 8.0 mm."""
PEEKED_FRAMES = 6
"""Number of frames in which the height of the person is measured. Chosen by hand."""
ROUGH_ROUNDS, ROUGH_PX = 2, 150.0
"""Number of first rounds in which silhouettes are found in reduced images, and the height of the person in the image
that shows it largest which is enough then [px]. With the key points of `jacks`, the capture takes 92 core-seconds and
the joints are 11.4 mm off, with full images 112 and 11.8 mm, with three rounds of reduced images 89 and 11.4 mm."""
SETTLED = 1.0
"""Largest displacement of a part of the body in an image since its silhouette was found, relative to the standard
deviation of the part's outline, with which the silhouettes of the frame are kept. With 0.5, captures of four takes with
key points need 17 to 58 % more processor time, and their joints are 0.1 to 0.8 mm better."""
REPAIRED_ROUNDS = (2, 3, 4)
"""Rounds of silhouettes and pose after which the person is repaired, as long as the last search has replaced limbs or
left them uncertain: the sizes of the body are known then, and a repaired limb has a further round to become accurate.
In `office`, the error is 33.5 mm with a repair after round 2, 28.1 mm after rounds 2 and 4, and 20.6 mm after all
three: the next search learns the colours of each repaired limb."""
OCCLUDED_ROUNDS = (2, 4)
"""Rounds of silhouettes and pose after which things in front of the person are searched: the silhouettes have full size
from then on, and the body is accurate to centimetres. Chosen by hand."""
OUTLINE_ROUNDS = 4
"""Rounds of the refinement after each set of silhouettes. Chosen by hand."""
LEAST_OVERLAP = 0.8
"""Mean overlap of silhouettes and body below which a warning is given. It is 0.90 to 0.93 in four takes with errors of
13 to 33 mm, and 0.67 with the key points of another take; a wrong pose may have more."""
WITHOUT_PLATE = OccluderSettings(most_seen=0.4)
"""What counts as a thing in front of the person where its colours are decided image by image, and often wrongly. Chosen
by hand."""
REACH_SDS = 2.5
"""Distance from the drawn body within which the background is not learned, in standard deviations. Chosen by hand."""


Repair = Callable[[Drawn, int], Drawn]
"""Repairs a person after the round of a number."""


def follow_detected(
    run: Run, bodies: Bodies, logs: Logs, detected: DetectedPerson, terms: FrameTermsFactory | None
) -> FollowedPerson:
    """Follow a person without images of the empty room, from detected joints.

    Args:
        run: The run.
        bodies: The body with many and with few vertices.
        logs: Storage of the last silhouettes.
        detected: The person and its detected joints.
        terms: The detected joints and further observations as terms of the refinement.

    Returns:
        The tracked person, with silhouettes.
    """
    drawn = drawn_from_detections(run, bodies, detected)
    found = {seen.frame for seen in detected.track.seen}
    filled = {frame: pose for frame, pose in drawn.poses.items() if frame not in found}
    # Between its first and its last frame the person may be hidden, or missed by the detector, but is there.
    frames = range(min(drawn.poses), max(drawn.poses) + 1)
    stages.warn_of_lost(run.progress, frames, drawn.poses, count=run.trial.take.count)
    drawn = replace(drawn, elsewhere=detected.elsewhere, others=run.with_captured(detected.others))
    return follow_in_any_room(run, logs, drawn, terms, frames=frames, filled=filled)


def follow_in_any_room(
    run: Run, logs: Logs, drawn: Drawn, terms: FrameTermsFactory | None, *, frames: Sequence[int],
    filled: Mapping[int, Pose], repaired: "Repair | None" = None,
) -> FollowedPerson:  # fmt: skip
    """Estimate silhouettes and motion in turn, without images of the empty room.

    Args:
        run: The run.
        logs: Storage of the last silhouettes.
        drawn: The person by a first estimate of the motion.
        terms: Further observations for the refinement.
        frames: Frames that show a person.
        filled: Interpolated poses among those of the person.
        repaired: Repairs the person after a round of `REPAIRED_ROUNDS`, whose number it receives.

    Returns:
        The tracked person, with silhouettes.
    """
    full, first, course = list(run.trial.rig), run.trial.take.first, list[SilhouetteRound]()
    rough = _rough_cameras(run, drawn)
    frames_of_take = range(first, run.trial.take.end)
    about = dict[int, Drawn]()
    kept: stages.EarlierSilhouettes | None = None
    with person_evidence(run, drawn.body, drawn.poses) as evidence, ExitStack() as logs_of_rounds:
        for number in range(1, MOST_ROUNDS + 1):
            cameras = rough if number <= ROUGH_ROUNDS else full
            log = logs_of_rounds.enter_context(run.cache.frames(f"silhouettes_{number}", depends=run.scope))
            store = RoundStore(cameras, MaskStore(log, first, cameras), cameras[0].width / full[0].width)
            scores = _find_silhouettes(run, drawn, store, number, evidence, kept)
            course.append(_round(run, drawn, store, scores, kept))
            about |= {frame: drawn for frame in frames_of_take if kept is None or frame not in kept.frames}
            if number == MOST_ROUNDS:
                break
            drawn = _refined(run, drawn, store, scores, terms, number)
            if number in OCCLUDED_ROUNDS:
                drawn = replace(drawn, occluders=_occluders(run, drawn, store, number))
            if repaired is not None and number in REPAIRED_ROUNDS and drawn.searched:
                drawn = repaired(drawn, number)
            if store.share < 1 and number == ROUGH_ROUNDS:
                kept = None  # The next images are larger.
                continue
            kept = stages.EarlierSilhouettes(store.masks, _settled(drawn, about, full))
            converged = store.share == 1 and kept.frames >= set(drawn.poses)
            if converged and (repaired is None or not drawn.searched or number > max(REPAIRED_ROUNDS)):
                break
        outlines = MaskStore(logs.outlines, first, full)
        while len(outlines.frames) < len(store.masks.frames):
            outlines.keep(store.masks)
    if course[-1].overlap < LEAST_OVERLAP:
        run.progress.warn(
            f"Silhouettes and body have an overlap of only {course[-1].overlap:.2f}: the pose is probably wrong. Look "
            "at the overlay videos, and check calibration, synchronisation and key points."
        )
    tracked = Tracked(drawn.body, drawn.poses, scores)
    return FollowedPerson(
        tracked, filled, outlines, frames, terms=terms, repaired=False, rounds=course,
        alternatives=drawn.alternatives, occluders=drawn.occluders,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class RoundStore:
    """The silhouettes of a round, and the cameras of the images in which they were found."""

    cameras: Sequence[Camera]
    masks: MaskStore
    share: float = 1.0
    """Size of the images relative to the full ones."""


def _rough_cameras(run: Run, drawn: Drawn) -> list[Camera]:
    """Return cameras of images that are just large enough for the first rounds."""
    full, known = list(run.trial.rig), sorted(drawn.poses)
    if len(run.trial.background) == len(full):
        return full
    looked = [known[i] for i in np.unique(np.linspace(0, len(known) - 1, PEEKED_FRAMES).astype(int))]
    posed = [PosedBody(drawn.body, drawn.poses[frame]) for frame in looked]
    tallest = max(np.count_nonzero(view_of(each, camera).mask().any(1)) for each in posed for camera in full)
    return reduced_cameras(full, float(tallest), ROUGH_PX)


def _settled(drawn: Drawn, about: Mapping[int, Drawn], cameras: Sequence[Camera]) -> frozenset[int]:
    """Return the frames in which the body has hardly moved since their silhouettes were found.

    Args:
        drawn: The person.
        about: The person about which the silhouettes of each frame were found.
        cameras: The cameras of the full images.

    Returns:
        The frames; those without a pose, then and now, are among them.
    """

    def settled(frame: int, before: Drawn) -> bool:
        if frame not in drawn.poses or frame not in before.poses:
            return (frame in drawn.poses) == (frame in before.poses)
        earlier, now = (PosedBody(each.body, each.poses[frame]) for each in (before, drawn))
        share = part_displacements(earlier, now, cameras) / drawn.deviations[frame]
        return bool(np.nanmax(share, initial=0.0) < SETTLED)

    return frozenset(frame for frame, before in about.items() if settled(frame, before))


def _round(
    run: Run, drawn: Drawn, store: RoundStore, scores: Mapping[int, float], kept: stages.EarlierSilhouettes | None
) -> SilhouetteRound:
    """Return the energy and the overlap of a round, and report them; energies are those of full images."""
    energy_nat = float(np.mean([store.masks.energy(frame) for frame in drawn.poses]))
    found = SilhouetteRound(
        energy_nat / store.share**2, float(np.mean(list(scores.values()))),
        0 if kept is None else len(kept.frames & set(drawn.poses)),
    )  # fmt: skip
    run.progress.report(
        f"Silhouettes: overlap with the body {found.overlap:.3f}, energy {found.energy_nat:.4g} nat per frame, "
        f"kept in {found.kept} of {len(drawn.poses)} frames"
    )
    return found


def _refined(
    run: Run, drawn: Drawn, store: RoundStore, scores: Mapping[int, float], terms: FrameTermsFactory | None, number: int
) -> Drawn:
    """Refine motion and shape with the silhouettes of a round."""
    masks, name, full = store.masks, f"round_{number}", list(run.trial.rig)
    take = SilhouetteTake(
        tuple(store.cameras), masks, tuple(drawn.poses), run.trial.take.rate, masks.edges, masks.hidden, run.times
    )

    def compute() -> Arrays:
        fitted = fitted_person(run, take, drawn, scores, terms, OUTLINE_ROUNDS, CLOTHES_SD_M, name, full)
        return pack_drawn(fitted, scores)

    found = unpack_drawn(run.cache.arrays(f"refined_{number}", compute, depends=run.scope), drawn.body)
    return replace(drawn, body=found.body, poses=found.poses, deviations=found.deviations)


def _occluders(run: Run, drawn: Drawn, store: RoundStore, number: int) -> Occluders:
    """Find the things in front of the person from what the silhouettes of a round lack in many frames."""
    take = BodyTake(store.cameras, drawn.body, drawn.poses, run.times)

    def unknown(frame: int) -> list[Mask] | None:
        if drawn.others is None and drawn.elsewhere is None:
            return None
        posed, found = PosedBody(drawn.body, drawn.poses[frame]), []
        for c, camera in enumerate(store.cameras):
            regions = drawn.regions(posed, frame, c, camera)
            missed = drawn.elsewhere is not None and bool(drawn.elsewhere[frame, c])
            nothing = np.full((camera.height, camera.width), missed)
            found.append(nothing if regions is None else nothing | regions.near)
        return found

    def compute() -> Arrays:
        with run.progress.stage("Things in front"):
            return find_occluders(take, store.masks, unknown, WITHOUT_PLATE).packed()

    return Occluders.unpacked(run.cache.arrays(f"occluders_{number}", compute, depends=run.scope))


def _find_silhouettes(
    run: Run, drawn: Drawn, store: RoundStore, number: int, evidence: PersonEvidence | None,
    kept: stages.EarlierSilhouettes | None,
) -> dict[int, float]:  # fmt: skip
    """Find the silhouettes of all frames about the drawn body; return their overlap with it by frame."""
    trial = run.trial
    if len(store.masks.frames) < trial.take.end - trial.take.first:
        _find_missing(run, drawn, store, f"Silhouettes {number}", evidence, kept)
    return _scores(drawn, store.cameras, store.masks)


def _find_missing(
    run: Run, drawn: Drawn, store: RoundStore, name: str, evidence: PersonEvidence | None,
    kept: stages.EarlierSilhouettes | None,
) -> None:  # fmt: skip
    trial, cameras = run.trial, list(store.cameras)
    with run.progress.stage("Background"):
        backgrounds, colours, two = _learned(run, drawn, cameras, store.share)
    views = [
        stages.SilhouetteState(b, colours=c, two_colours=t) for b, c, t in zip(backgrounds, colours, two, strict=True)
    ]
    small = [camera.scaled(min(1.0, TRACKED_PX / camera.height)) for camera in cameras]

    def predicted(frame: int) -> list[stages.Expected] | None:
        if frame not in drawn.poses:
            return None
        now = PosedBody(drawn.body, drawn.poses[frame])
        late = [now] * len(cameras) if run.times is None else run.times.posed(frame, now, drawn.poses)
        behind = [None] * len(cameras) if drawn.occluders is None else drawn.occluders.behind(late, cameras)
        each = zip(late, cameras, small, store.share * drawn.deviations[frame], behind, strict=True)
        return [
            replace(
                _expected(
                    posed, camera, less, own, elsewhere=drawn.elsewhere is not None and bool(drawn.elsewhere[frame, c])
                ),
                others=drawn.regions(posed, frame, c, camera), behind=hidden,
            )
            for c, (posed, camera, less, own, hidden) in enumerate(each)
        ]  # fmt: skip

    expected = with_evidence(predicted, evidence)
    masks, progress = store.masks, run.progress
    stages.find_silhouettes(trial, views, cameras, masks, progress, name=name, predicted=expected, earlier=kept)


def _expected(
    posed: PosedBody, camera: Camera, small: Camera, deviations: Floats, *, elsewhere: bool
) -> stages.Expected:
    """Draw the body with the prior of its silhouette and its parts."""
    expected = stages.expected_of(posed, camera, small)
    parts = part_map(posed, camera)
    if not expected.mask.any():
        return expected
    known = np.where(np.isfinite(deviations), deviations, np.nanmedian(deviations))
    pull = outline_prior(parts, known)
    slack = 2.0 * float(np.median(known))
    return replace(expected, pull=pull, parts=parts, slack=slack, elsewhere=elsewhere)


def _learned(
    run: Run, drawn: Drawn, cameras: Sequence[Camera], share: float
) -> tuple[list[Background], list[PartColours], list[TwoColours | None]]:
    """Learn the backgrounds of which there are no images, the colours of the parts, and those of other people."""
    take = run.trial.take
    frames = spread(sorted(drawn.poses), LEARNED_IMAGES)
    absent = spread(far_from(range(take.first, take.end), drawn.poses), ABSENT_FRAMES)
    samples = dict(take.at(sorted([*frames, *absent])))
    posed = {frame: PosedBody(drawn.body, drawn.poses[frame]) for frame in frames}
    channels = samples[frames[0]][0].shape[2]
    counts = PartColourCounts(len(cameras), len(COLOUR_PARTS), channels, CELLS)
    others_seen = OtherColourSums(len(cameras))
    plates = empty_rooms(run.trial, cameras)

    def background_of_camera(c: int) -> Background:
        camera, covered, always = cameras[c], [], np.ones(cameras[c].size[::-1], bool)
        pictures: list[Image] = [resized(samples[frame][c], camera) for frame in frames]
        for frame, picture in zip(frames, pictures, strict=True):
            parts = part_map(posed[frame], camera)
            if drawn.occluders is not None:
                parts = np.where(drawn.occluders.behind([posed[frame]] * len(cameras), cameras)[c], -1, parts)
            inside = np.ascontiguousarray(parts >= 0)
            always &= inside
            sd = share * float(np.nanmedian(drawn.deviations[frame][c]))
            away = cv2.distanceTransform((~inside).view(np.uint8), cv2.DIST_L2, 3)
            covered.append(away < REACH_SDS * sd if inside.any() else inside)
            others = drawn.regions(posed[frame], frame, c, camera)
            if others is not None:
                others_seen.add(c, picture, others, inside)
                covered[-1], parts = covered[-1] | others.near, np.where(others.near, -1, parts)
            depth = cv2.distanceTransform(inside.view(np.uint8), cv2.DIST_L2, 3)
            per_pixel = (np.linalg.norm(posed[frame].segment_origin.mean(0) - camera.centre) / camera.matrix[0, 0]) ** 2
            inner = np.where(depth > 0.5 * sd, parts, -1)
            counts.add(c, picture, inner, float(per_pixel), cells_inside(picture, depth > 0.5 * sd + EDGE))
        if c in plates:
            return plates[c]
        absent_images = [resized(samples[frame][c], camera) for frame in absent]
        return background_with_empty(pictures, covered, always, absent_images)

    backgrounds = list(map_in_threads(background_of_camera, range(len(cameras))))
    learned = counts.learned()
    return backgrounds, learned, others_seen.learned(learned)


def _scores(drawn: Drawn, cameras: Sequence[Camera], store: MaskStore) -> dict[int, float]:
    """Return the overlap of body and silhouettes by frame, where nothing hides the person."""
    found = {}
    for frame, pose in drawn.poses.items():
        posed, hidden = PosedBody(drawn.body, pose), store.hidden(frame)
        shares = []
        for c, (camera, mask) in enumerate(zip(cameras, store(frame), strict=True)):
            if hidden is not None and hidden[c].all():
                continue
            body = view_of(posed, camera).mask()
            seen = body if hidden is None else body & ~hidden[c]
            union = np.count_nonzero(seen | mask)
            shares += [np.count_nonzero(seen & mask) / union] if union else []
        found[frame] = float(np.mean(shares)) if shares else 0.0
    return found

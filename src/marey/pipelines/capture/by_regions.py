"""A first estimate of the motion where nothing is given: no image of the empty room, no detected joints, no masks.

The person is found and tracked in strongly reduced images by the colours of its parts, see
`marey.fit.regions.region_track`. From these poses the background is learned where the person is elsewhere, which makes
further tracks and the rough sizes of the body more accurate. Silhouettes and pose then follow in turn, as with
detected joints.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np

from marey.arrays import Floats
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.skeleton import COLOUR_PARTS
from marey.body.articulation.surface import Body
from marey.cameras.camera import Camera
from marey.fit.progress import FrameProgress
from marey.fit.recipes.detections import joint_offsets
from marey.fit.recipes.person import SilhouetteTake, interpolated_poses
from marey.fit.recipes.sequence_equations import FrameTermsFactory
from marey.fit.recipes.start_joints import start_from_joints
from marey.fit.regions.limb_repair import repaired_limbs, searches, uncertain_limbs, undetermined_postures
from marey.fit.regions.recovery import find_again
from marey.fit.regions.region_people import ImagesBeside, find_clear_people, find_other_people
from marey.fit.regions.region_search import RegionImages, RegionSearch, thinned
from marey.fit.regions.region_track import ImagesOf, RegionTrack, RegionTracker
from marey.fit.search import placements
from marey.geometry import rotations
from marey.io.stages import Arrays
from marey.io.trial.start_joints import StartJoints
from marey.io.trial.trial import Trial
from marey.pipelines.capture.detected import DetectedPerson
from marey.pipelines.capture.drawn import Drawn
from marey.pipelines.capture.evidence import evidence_of_all_cameras
from marey.pipelines.capture.hypotheses import pack_alternatives, report_replaced, unpack_alternatives
from marey.pipelines.capture.run import Bodies, Logs, Run
from marey.pipelines.capture.tracked import FollowedPerson, Tracked, pack_tracked, unpack_tracked
from marey.pipelines.capture.without_plate import Repair, follow_in_any_room
from marey.pipelines.people.choice import given_start
from marey.pipelines.people.other_regions import JoinedPeople, OtherPeople, PosedPerson
from marey.pipelines.people.region_people import REGION_SD_M, followed_region, longest_first, others_of_regions
from marey.pipelines.silhouettes import stages
from marey.pipelines.silhouettes.drawn_body import length_px
from marey.pipelines.silhouettes.empty_rooms import cameras_without_image
from marey.pipelines.silhouettes.small_take import SmallTake, small_take
from marey.pipelines.verdict import NotUsable, Verdict, VerdictReason

REACHES_M = (0.12, 0.08)
"""Distance from the drawn body within which the background is not learned, in each further track [m]. Chosen by
hand; in a prototype, the joints of the first track of `jacks` were 89 mm off, of the second 60, and of the third 53."""
REPAIR_REACH_M = 0.04
"""The same distance while lost limbs are searched, about a refined body [m]. Chosen by hand."""
FIRST_SD_M = 0.04
"""Standard deviation of the outline of the body after tracking by regions [m]. In a prototype, the joints of two takes
were 53 and 61 mm off then, along and across the lines of sight."""


DECIDED = 0.97
"""Share of the best score below which a track that faces the other way is given up. After the first backgrounds, the
share of the wrong facing is 0.99 in `office`, and 0.83 to 0.94 in `jacks`, `market`, `stealth`, `walk` and `reach`; in
`office`, it is 0.91 after the second ones."""


def nothing_given(trial: Trial) -> bool:
    """Return whether a trial without detected joints gives neither silhouettes nor all images of the empty room."""
    given = trial.masks or not cameras_without_image(trial)
    return not given and not evidence_of_all_cameras(trial)


@dataclass(frozen=True, eq=False)
class RegionPeople:
    """The people of a take who were tracked by regions."""

    people: Sequence[Tracked]
    """The people, in the order of their numbers."""
    followed: int
    """Index of the followed one."""
    undecided: bool = False
    """Whether the followed one may as well face the other way."""


def follow_by_regions(run: Run, bodies: Bodies, logs: Logs, terms: FrameTermsFactory | None) -> FollowedPerson:
    """Follow a person of whom nothing is known, without images of the empty room.

    Args:
        run: The run.
        bodies: The body with many and with few vertices.
        logs: Storage of the last silhouettes.
        terms: Further observations for the refinement.

    Returns:
        The tracked person, with silhouettes.
    """
    run.progress.warn(_less_reliable(run.trial))
    reduced = cache(lambda: small_take(run.trial, run.progress))
    found, longest = people_by_regions(run, bodies, reduced), run.person.bridge * run.trial.take.rate
    person = found.people[found.followed]
    if found.undecided:
        run.reasons.append(
            VerdictReason.limit(
                "The colours hardly distinguish the front of the person from the back, which exchanges left and right.",
                "Look at the overlay videos; key points (--keypoints) or the joints of one frame (--start) decide.",
                cause="facing",
            )
        )
    others = others_of_regions(
        [(other.body, other.poses) for other in found.people], found.followed, longest, run.captured
    )  # fmt: skip
    filled = interpolated_poses(person.poses, longest=longest)
    poses = dict(sorted({**person.poses, **filled}.items()))
    deviations = _deviations(person.body, poses, list(run.trial.rig))
    drawn = Drawn(person.body, poses, deviations, others=run.with_captured(others))
    frames = range(min(poses), max(poses) + 1)
    stages.warn_of_lost(run.progress, frames, poses, count=run.trial.take.count)
    beside = [
        RegionTrack(other.body, other.poses, other.scores, np.zeros(0))
        for i, other in enumerate(found.people)
        if i != found.followed
    ]
    return follow_in_any_room(
        run, logs, drawn, terms, frames=frames, filled=filled,
        repaired=lambda refined, number: _with_lost_limbs(
            run, bodies, reduced, refined, number,
            lambda take, track: ImagesBeside(take.images_of, take.cameras, beside, track),
        ),
    )  # fmt: skip


def search_for_limbs(run: Run, bodies: Bodies) -> Repair:
    """Return the search for lost limbs of one of several people, in reduced images in which the others do not count.

    Args:
        run: The run.
        bodies: The body with many and with few vertices.
    """
    reduced = cache(lambda: small_take(run.trial, run.progress))

    def repaired(drawn: Drawn, number: int) -> Drawn:
        cameras, others = tuple(run.trial.rig), drawn.others
        return _with_lost_limbs(
            run, bodies, reduced, drawn, number,
            lambda take, track: _ImagesOfPerson(take, cameras, track.body, track.poses, others),
        )  # fmt: skip

    return repaired


def _less_reliable(trial: Trial) -> str:
    """Return the note that the result is less reliable, and why."""
    missing = "neither images of the empty room nor key points"
    if trial.background:
        wanting = ", ".join(cameras_without_image(trial))
        missing = f"no key points, and no images of the empty room for {wanting}"
    how = "found" if trial.start is None else "followed"
    return (
        f"There are {missing}: the person is {how} by colours and motion. Look at the overlay "
        "videos; key points (--keypoints) or images of the empty room make the result more reliable."
    )


def _with_lost_limbs(
    run: Run, bodies: Bodies, reduced: Callable[[], SmallTake], drawn: Drawn, number: int,
    images_of: Callable[[SmallTake, RegionTrack], ImagesOf],
) -> Drawn:  # fmt: skip
    """Search lost limbs of a person in the reduced images, after the round of a number.

    Limbs of which the search before was certain are not searched again; what was found of them remains.
    """

    def compute() -> Arrays:
        body = thinned(bodies.coarse).with_numbers(drawn.body.numbers)
        track = RegionTrack(body, drawn.poses, dict.fromkeys(drawn.poses, 0.0), np.zeros(0))
        take, rate = reduced().with_backgrounds(track, REPAIR_REACH_M, drawn.others), run.trial.take.rate
        search = RegionSearch(take.cameras, len(take.words))
        images, only = images_of(take, track), drawn.searched
        with run.progress.stage("Search for lost limbs", searches(list(drawn.poses), rate, only=only)) as step:
            found = repaired_limbs(
                search, images, body, drawn.poses, rate, only=only, progress=lambda frame: step()
            )  # fmt: skip
        report_replaced(run.progress, found.replaced)
        poses = pack_tracked(found.poses, body, dict.fromkeys(found.poses, 0.0))
        named = [name.replace("_", " ") for name in only]
        kept = [other for other in drawn.alternatives if other.name not in named]
        alternatives = pack_alternatives([*kept, *found.alternatives], body.skeleton)
        again = {_AGAIN: np.isin(placements.SEARCHED_LIMBS, uncertain_limbs(found))}
        return poses | again | {f"{_OTHER}{name}": values for name, values in alternatives.items()}

    stored = run.cache.arrays(f"lost_limbs_{number}", compute, depends=run.scope)
    others_stored = {name.removeprefix(_OTHER): values for name, values in stored.items() if name.startswith(_OTHER)}
    poses = unpack_tracked(stored, drawn.body).poses
    again = [name for name, own in zip(placements.SEARCHED_LIMBS, stored[_AGAIN], strict=True) if own]
    return replace(drawn, poses=poses, alternatives=unpack_alternatives(others_stored), searched=again)


_OTHER = "other_"
"""Begin of the names of the stored arrays of alternatives."""
_AGAIN = "searched_again"
"""Name of the stored array that is true for the limbs of `SEARCHED_LIMBS` that are searched again."""


def people_by_regions(run: Run, bodies: Bodies, reduced: Callable[[], SmallTake] | None = None) -> RegionPeople:
    """Estimate the motion and the rough sizes of all people from the colours of their parts.

    Args:
        run: The run.
        bodies: The body with many and with few vertices.
        reduced: Returns the take in reduced images; by default, they are read.

    Returns:
        The people; the followed one is tracked more accurately.

    Raises:
        NotUsable: No two cameras can have a person in view.
        SettingProblem: Nobody is where the user named a person.
    """
    free = bodies.held() if run.settings.fixed_sizes else bodies

    def compute() -> Arrays:
        take = small_take(run.trial, run.progress) if reduced is None else reduced()
        search = RegionSearch(take.cameras, len(take.words))
        tracker = RegionTracker(search, take.images_of, tuple(take.pictures), run.trial.take.rate)
        people, followed, undecided = _tracked(run, tracker, take, thinned(free.coarse))
        packed = {
            "followed": np.array(followed), "count": np.array(len(people)), "undecided": np.array(undecided)
        }  # fmt: skip
        for i, track in enumerate(people):
            own = pack_tracked(track.poses, track.body, track.scores)
            packed |= {f"person{i}_{name}": values for name, values in own.items()}
        return packed

    stored = run.cache.arrays("regions", compute, depends=run.scope)
    people = []
    for i in range(int(stored["count"])):
        start = f"person{i}_"
        own = {name.removeprefix(start): values for name, values in stored.items() if name.startswith(start)}
        people.append(unpack_tracked(own, bodies.fine))
    return RegionPeople(people, int(stored["followed"]), bool(stored["undecided"]))


def _tracked(
    run: Run, tracker: RegionTracker, take: SmallTake, body: Body
) -> tuple[list[RegionTrack], int, bool]:  # fmt: skip
    """Find and track all people.

    Returns:
        Their tracks in the order of their numbers; the index of the followed one; and whether that may as well face the
        other way.
    """
    progress, settings, count = run.progress, tracker.settings, len(tracker.frames)
    first, clear, tracker, undecided = _first_person(run, tracker, take, body)
    with progress.stage("Other people", count) as step:
        others = find_other_people(tracker, body, first, clear, progress=lambda frame: step())
    people = longest_first([first, *others])
    followed = followed_region(run.trial, people, progress, None if run.trial.start is None else first)
    track = people[followed]
    beside = [other for i, other in enumerate(people) if i != followed]
    own = replace(tracker, images_of=ImagesBeside(tracker.images_of, tracker.search.cameras, beside, track))
    if track is not first:
        with progress.stage("Tracking of the followed person") as step:
            facings = own.both_facings(track, progress=lambda frame: step())
            kept = _undecided(facings, settings.least_share)
            undecided = _opposed([facings[i] for i in kept])
            track = own.with_sizes(facings[kept[0]], progress=lambda frame: step())
    with progress.stage("Tracking from both ends", 2 * count) as step:
        track = own.swept_again(track, progress=lambda frame: step()).shown(settings.least_share)
    people[followed] = track
    progress.report(f"Tracking by colours: mean score {track.mean_score:.2f} nat m2")
    return people, followed, undecided


def _first_person(
    run: Run, tracker: RegionTracker, take: SmallTake, body: Body
) -> tuple[RegionTrack, Sequence[RegionTrack], RegionTracker, bool]:  # fmt: skip
    """Find and track the person with the best scores, and track it again with learned backgrounds and sizes.

    Returns:
        The track; those of the other people who are clear already; the tracker with the learned backgrounds; and
        whether the person may as well face the other way.
    """
    progress, settings = run.progress, tracker.settings
    every, tracks = _first_tracks(run, tracker, body)
    clear = _clear_people(run, every, body, tracks)
    others = JoinedPeople([PosedPerson(each.body, each.poses, REGION_SD_M) for each in clear]) if clear else None
    for reach, own in zip(REACHES_M, (every, tracker), strict=True):
        # Only with a learned background do the scores distinguish front and back; if they do, one track is left.
        with progress.stage("Tracking again", len(tracks) * len(own.frames)) as step:
            learned = [take.with_backgrounds(track.shown(settings.least_share), reach, others) for track in tracks]
            trackers = [
                replace(own, images_of=ImagesBeside(each.images_of, take.cameras, clear, track))
                for each, track in zip(learned, tracks, strict=True)
            ]
            again = [
                each.with_sizes(track, progress=lambda frame: step())
                for each, track in zip(trackers, tracks, strict=True)
            ]
        kept, rate = _undecided(again, settings.least_share), own.rate / own.step
        count = sum(searches(list(again[i].poses), rate) for i in kept)
        with progress.stage("Search for lost limbs", count) as step:
            tracks = [_with_replaced_limbs(trackers[i], again[i], progress=lambda frame: step()) for i in kept]
        tracker = trackers[kept[0]]
    with progress.stage("Search for a lost person") as step:
        found = find_again(tracker, tracks[0], progress=lambda frame: step())
    everywhere = replace(tracker, images_of=learned[kept[0]].images_of)
    return found.shown(settings.least_share), clear, everywhere, _opposed(tracks)


def _clear_people(
    run: Run, tracker: RegionTracker, body: Body, tracks: Sequence[RegionTrack]
) -> list[RegionTrack]:  # fmt: skip
    """Find the other people who are clear before a background is learned; poses between tracked frames are filled."""
    first = max(tracks, key=lambda track: track.mean_score)
    with run.progress.stage("People before a background is known") as step:
        found = find_clear_people(tracker, body, first, progress=lambda frame: step())
    longest = run.person.bridge * run.trial.take.rate
    return [replace(each, poses={**each.poses, **interpolated_poses(each.poses, longest=longest)}) for each in found]


def _undecided(tracks: Sequence[RegionTrack], least_share: float) -> list[int]:
    """Return the indices of the best of some tracks, and of those with hardly lower scores where a person is shown."""
    shown = set[int]().union(*(track.shown(least_share).poses for track in tracks))
    means = [float(np.mean([track.scores[frame] for frame in shown])) for track in tracks]
    order = np.argsort(-np.array(means))
    return [int(i) for i in order if means[i] >= DECIDED * means[order[0]]]


def _opposed(tracks: Sequence[RegionTrack]) -> bool:
    """Return whether any tracks face opposite ways in most frames."""
    first = tracks[0].poses
    for track in tracks[1:]:
        common = [frame for frame in first if frame in track.poses]
        turns = [rotations.turn_between(first[f].rotation, track.poses[f].rotation) for f in common]
        if np.median(np.linalg.norm(turns, axis=1)) > np.pi / 2:
            return True
    return False


def _with_replaced_limbs(tracker: RegionTracker, track: RegionTrack, progress: FrameProgress) -> RegionTrack:
    """Search the limbs of a track by the colours of those on the other side, and replace lost ones.

    A limb that was lost at the start teaches the tracker the colours of what it was confused with, and remains lost.
    """
    shown, rate = track.shown(tracker.settings.least_share), tracker.rate / tracker.step
    found = repaired_limbs(
        tracker.search, tracker.images_of, track.body, shown.poses, rate, progress=progress
    )  # fmt: skip
    return replace(track, poses={**track.poses, **found.poses})


def _first_tracks(run: Run, tracker: RegionTracker, body: Body) -> tuple[RegionTracker, Sequence[RegionTrack]]:
    """Track a person for the first time: from the given joints of a frame, or from the best place and either facing.

    Returns:
        The tracker of reduced rate, and one or two tracks.
    """
    progress, settings, given = run.progress, tracker.settings, given_start(run.trial)
    if given is not None:
        every = tracker.reduced(through=given.frame)
        with progress.stage("Start"):
            started = every.started_at(_posed_by_joints(run, given, body), given.frame)
        with progress.stage("Tracking", len(every.frames)) as step:
            return every, [every.track(started, every.frames, progress=lambda frame: step())]
    every = tracker.reduced()
    with progress.stage("Start", settings.frames * len(settings.whole_shares)) as step:
        found = every.start(body, progress=lambda frame: step())
    if found is None:
        remedy = "Check that all cameras are calibrated in one world, with Z up and metres as unit."
        what = f"No two cameras of {run.trial.calibration} see a standing person at one place."
        raise NotUsable(Verdict.of([VerdictReason.failure(what, remedy, cause="nobody")]))
    count, window = len(every.frames), 2 * round(settings.window * tracker.rate / every.step) + 1
    with progress.stage("Tracking", 2 * (settings.starts * min(count, window) + count)) as step:
        return every, every.both_facings(found, progress=lambda frame: step())


def _posed_by_joints(run: Run, given: StartJoints, body: Body) -> PosedBody:
    """Return a body in the pose, and with the rough sizes, that the given joints of a frame show."""
    cameras = tuple(run.trial.rig)
    nothing = [np.zeros((camera.height, camera.width), bool) for camera in cameras]
    take = SilhouetteTake(cameras, lambda frame: nothing, (given.frame,), run.trial.take.rate)
    _, found = start_from_joints(take, given.frame, given.joint_names, given.pixels, body, run.person)
    stages.require_upright(run.trial, found.posed)
    return replace(found.posed, body=body.with_numbers(found.posed.body.numbers))


def _deviations(body: Body, poses: Mapping[int, Pose], cameras: Sequence[Camera]) -> dict[int, Floats]:
    """Return the standard deviation of each part's outline in each camera (C, P) by frame [px]."""
    found = {}
    for frame, pose in poses.items():
        posed = PosedBody(body, pose)
        own = np.array([length_px(posed, camera, FIRST_SD_M) for camera in cameras])
        found[frame] = np.repeat(own[:, None], len(COLOUR_PARTS), axis=1)
    return found


def with_open_limbs(run: Run, bodies: Bodies, followed: FollowedPerson, detected: DetectedPerson) -> FollowedPerson:
    """Search other postures of the limbs of a person where the detected joints leave them open.

    Args:
        run: The run.
        bodies: The body with many and with few vertices.
        followed: The person after the rounds of silhouettes and pose.
        detected: The person's detected joints.

    Returns:
        The person with these postures; the poses remain.
    """
    tracked, rate = followed.tracked, run.trial.take.rate
    limbs = detected.open_limbs(tracked.poses, run.person.bridge * rate)
    if not limbs:
        return followed

    def compute() -> Arrays:
        body = thinned(bodies.coarse).with_numbers(tracked.body.numbers)
        track = RegionTrack(body, tracked.poses, dict.fromkeys(tracked.poses, 0.0), np.zeros(0))
        others = run.with_captured(detected.others)
        take = small_take(run.trial, run.progress).with_backgrounds(track, REPAIR_REACH_M, others)
        images_of = _ImagesOfPerson(take, tuple(run.trial.rig), body, tracked.poses, others)
        search = RegionSearch(take.cameras, len(take.words))
        offsets = joint_offsets(detected.joints, tracked.poses, body)

        def support(frame: int, pose: Pose) -> float:
            return detected.joints.log_likelihood(frame, PosedBody(body, pose), offsets)

        with run.progress.stage("Search for open limbs"):
            found = undetermined_postures(search, images_of, body, tracked.poses, rate, limbs, support=support)
        return pack_alternatives(found, body.skeleton)

    stored = run.cache.arrays("open_limbs", compute, depends=run.scope)
    return replace(followed, alternatives=unpack_alternatives(stored))


@dataclass(frozen=True, eq=False)
class _ImagesOfPerson:
    """The reduced images of a take, in which other people are no evidence."""

    take: SmallTake
    cameras: tuple[Camera, ...]
    """The cameras of the full images."""
    body: Body
    poses: Mapping[int, Pose]
    others: OtherPeople | None

    def __call__(self, frame: int) -> RegionImages:
        """Return the classes of the pixels of a frame."""
        images = self.take.images_of(frame)
        if self.others is None:
            return images
        covered = np.zeros(images.words.shape, bool)
        place: Floats = PosedBody(self.body, self.poses[frame]).segment_origin.mean(axis=0)
        for c, (camera, small) in enumerate(zip(self.cameras, self.take.cameras, strict=True)):
            regions = self.others.regions(frame, c, camera, place)
            if regions is not None:
                near = cv2.resize(regions.near.view(np.uint8), small.size, interpolation=cv2.INTER_NEAREST)
                covered[c, : small.height, : small.width] = near > 0
        return images.without(covered)

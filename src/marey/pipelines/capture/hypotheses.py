"""Several answers to the same outlines, in a capture: exploration, reports, and flags."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice

import numpy as np

from marey.arrays import Mask
from marey.body.articulation.pose import Pose, packed_poses, unpacked_poses
from marey.body.articulation.skeleton import ROOT_COORDINATES, Skeleton
from marey.body.articulation.surface import Body
from marey.fit.recipes.hypotheses import (
    Alternative,
    HypothesisSettings,
    LimbCheckpoint,
    OtherPostures,
    explore_hypotheses,
)
from marey.fit.recipes.person import SilhouetteTake, with_shape
from marey.fit.search.pose_cost import contradicted_frames
from marey.io.stages import Arrays
from marey.motion.anatomical import anatomy_of
from marey.motion.from_fit import MeasuredPiece
from marey.pipelines.capture.run import Bodies, Run
from marey.pipelines.capture.tracked import Tracked, pack_tracked, unpack_tracked
from marey.pipelines.progress import Progress
from marey.pipelines.verdict import VerdictReason
from marey.view.pages.problems import frames_text

FIRST_ANSWERS = HypothesisSettings(clearly=3.0)
"""In the first silhouettes, which have more errors than those that follow, another answer must be 20 times as probable
as the present one. The right postures of arms in `jacks` and `walk` with two cameras are 170 times as probable or more;
a wrong one of `walk` that was taken without this limit, 1.3 times."""
LARGEST_AMBIGUOUS_SHARE = 0.5
"""Share of the frames, averaged over the limbs, with two possible postures above which the verdict states a limit.
Chosen by hand: it is 0.00 to 0.26 in six takes without images of the empty room, and 0.84 for somebody who stands still
and faces the wrong way."""


def explored(
    run: Run, take: SilhouetteTake, body: Body, bodies: Bodies, poses: dict[int, Pose]
) -> tuple[dict[int, Pose], Sequence[Alternative]]:
    """Explore other answers of the limbs, report those that replace the present ones, and warn where two remain.

    Args:
        run: The run.
        take: Cameras and silhouettes.
        body: The body.
        bodies: The body with many and with few vertices.
        poses: Poses by frame.

    Returns:
        The poses by frame, and the answers that remain possible beside them.
    """

    def stored(limb: str, compute: Callable[[], OtherPostures]) -> OtherPostures:
        name = f"other_answers_{limb.replace(' ', '_')}"
        return unpack_postures(
            run.cache.arrays(name, lambda: pack_postures(compute(), body.skeleton), depends=run.scope)
        )

    with run.progress.stage_of_shares("Other answers") as done:
        found = _searched(run, take, body, bodies, poses, progress=done, checkpoint=stored)
    report_replaced(run.progress, found.replaced)
    warn_of_alternatives(run.progress, found.alternatives)
    return dict(found.poses), found.alternatives


def with_better_answers(run: Run, take: SilhouetteTake, tracked: Tracked, bodies: Bodies) -> Tracked:
    """Replace postures of limbs that the first silhouettes contradict, before silhouettes are drawn to the person.

    Silhouettes that are drawn to a person lose a limb that was tracked wrongly: afterwards nothing contradicts it.

    Args:
        run: The run.
        take: Cameras and first silhouettes.
        tracked: The tracked person.
        bodies: The body with many and with few vertices.

    Returns:
        The person with the most probable postures.
    """

    def compute() -> Arrays:
        poses, levels = tracked.poses, take.levels(run.person.track_height)
        with run.progress.stage_of_shares("Limbs outside of the body") as done:
            only = contradicted_frames(levels, tracked.body, poses, rate=take.rate, times=take.times)
            if only:
                found = _searched(run, take, tracked.body, bodies, poses, only, FIRST_ANSWERS, progress=done)
                report_replaced(run.progress, found.replaced)
                poses = found.poses
        return pack_tracked(poses, tracked.body, tracked.scores)

    return unpack_tracked(run.cache.arrays("better_answers", compute, depends=run.scope), tracked.body)


def _searched(
    run: Run, take: SilhouetteTake, body: Body, bodies: Bodies, poses: Mapping[int, Pose],
    only: Collection[int] | None = None, settings: HypothesisSettings | None = None, *,
    progress: Callable[[float], None], checkpoint: LimbCheckpoint = lambda limb, compute: compute(),
) -> OtherPostures:  # fmt: skip
    person = run.person
    return explore_hypotheses(
        take.levels(person.track_height), take.levels(person.fine_height), take.levels(person.rough_height),
        body, with_shape(body, bodies.coarse), poses, rate=take.rate, times=take.times,
        only=only, settings=settings, progress=progress, checkpoint=checkpoint,
    )  # fmt: skip


def report_replaced(progress: Progress, replaced: Sequence[Alternative]) -> None:
    """Report the limbs whose postures were replaced, with their frames."""
    for limb, frames, _ in _by_limb(replaced):
        progress.report(f"{limb}, {frames}: another posture explains the images better")


def warn_of_alternatives(progress: Progress, alternatives: Sequence[Alternative]) -> None:
    """Warn of limbs with two possible postures."""
    for limb, frames, probabilities in _by_limb(alternatives):
        low, high = (f"{value:.2f}" for value in (min(probabilities), max(probabilities)))
        progress.warn(
            f"{limb}, {frames}: two postures explain the images. The stated standard deviations cover both; the "
            f"posture that is not stated has a probability of {low if low == high else f'{low} to {high}'}. Do not use "
            "the angles of this limb in these frames."
        )


def mostly_ambiguous(alternatives: Sequence[Alternative], skeleton: Skeleton, frames: int) -> VerdictReason | None:
    """Return a limit of the result if two postures explain the images of most limbs in most frames.

    Args:
        alternatives: The alternatives.
        skeleton: The skeleton, with the limbs that are followed.
        frames: Number of frames with a pose.

    Returns:
        The limit; None if there are fewer.
    """
    followed = np.unique(skeleton.segment_limb[skeleton.coordinate_segment])
    limbs = int(np.count_nonzero(followed > 0))
    ambiguous = {(answer.name, frame) for answer in alternatives for frame in answer.poses}
    share = len(ambiguous) / max(limbs * frames, 1)
    if share <= LARGEST_AMBIGUOUS_SHARE:
        return None
    what = (
        f"Two postures explain the images of the limbs in {100 * share:.0f} % of the frames: the person may face the "
        "other way."
    )
    remedy = "Look at the overlay videos; key points (--keypoints) or the joints of one frame (--start) decide."
    return VerdictReason.limit(what, remedy, cause="facing")


def _by_limb(answers: Sequence[Alternative]) -> Iterator[tuple[str, str, list[float]]]:
    """Iterate over limbs: the name, the frames as text, and the probabilities of the answers."""
    for limb in dict.fromkeys(answer.name for answer in answers):
        own = sorted((answer for answer in answers if answer.name == limb), key=lambda answer: min(answer.poses))
        chosen = np.zeros(max(max(answer.poses) for answer in own) + 1, bool)
        for answer in own:
            chosen[min(answer.poses) : max(answer.poses) + 1] = True
        yield limb.capitalize(), frames_text(chosen), [answer.probability for answer in own]


def pack_alternatives(alternatives: Sequence[Alternative], skeleton: Skeleton) -> Arrays:
    """Return alternatives as arrays.

    Args:
        alternatives: The alternatives.
        skeleton: The skeleton, whose number of coordinates is D.

    Returns:
        The name, probability, coordinates (D,) and number of frames of each one, and all frames and poses.
    """
    columns = np.zeros((len(alternatives), len(skeleton)), bool)
    for own, other in zip(columns, alternatives, strict=True):
        own[other.columns] = True
    return {
        "name": np.array([other.name for other in alternatives], str),
        "probability": np.array([other.probability for other in alternatives]),
        "columns": columns,
        "count": np.array([len(other.poses) for other in alternatives], np.int64),
        "frame": np.array([frame for other in alternatives for frame in other.poses], np.int64),
        **packed_poses(pose for other in alternatives for pose in other.poses.values()),
    }


def unpack_alternatives(arrays: Arrays) -> list[Alternative]:
    """Return alternatives from their arrays, see `pack_alternatives`."""
    poses = zip(map(int, arrays["frame"]), unpacked_poses(arrays), strict=True)
    each = zip(*(arrays[key] for key in ("name", "columns", "count", "probability")), strict=True)
    return [
        Alternative(str(name), np.flatnonzero(columns), dict(islice(poses, int(count))), float(probability))
        for name, columns, count, probability in each
    ]


def pack_postures(found: OtherPostures, skeleton: Skeleton) -> Arrays:
    """Return poses by frame, other answers and former poses as arrays.

    Args:
        found: The poses and the other answers.
        skeleton: The skeleton.
    """
    arrays: dict[str, np.ndarray] = {"pose_frame": np.array(list(found.poses), np.int64)}
    for prefix, part in (
        ("pose", packed_poses(found.poses.values())),
        ("other", pack_alternatives(found.alternatives, skeleton)),
        ("former", pack_alternatives(found.replaced, skeleton)),
    ):
        arrays |= {f"{prefix}_{name}": value for name, value in part.items()}
    return arrays


def unpack_postures(arrays: Arrays) -> OtherPostures:
    """Return poses by frame, other answers and former poses from their arrays, see `pack_postures`."""

    def part(prefix: str) -> dict[str, np.ndarray]:
        start = f"{prefix}_"
        return {name.removeprefix(start): value for name, value in arrays.items() if name.startswith(start)}

    poses = part("pose")
    return OtherPostures(
        dict(zip(map(int, poses.pop("frame")), unpacked_poses(poses), strict=True)),
        unpack_alternatives(part("other")), unpack_alternatives(part("former")),
    )  # fmt: skip


def undetermined(piece: MeasuredPiece, alternatives: Sequence[Alternative], body: Body) -> MeasuredPiece:
    """Return a piece whose coordinates and angles with several possible answers are flagged as not determined.

    Args:
        piece: The piece.
        alternatives: Other answers.
        body: The fitted body.
    """
    determined, angles_determined = np.array(piece.determined), np.array(piece.angles_determined)
    for other in alternatives:
        where = np.isin(piece.frames, list(other.poses))
        determined[np.ix_(where, other.columns)] = False
        angles_determined[np.ix_(where, _angles_of(other, body))] = False
    return replace(piece, determined=determined, angles_determined=angles_determined)


def _angles_of(other: Alternative, body: Body) -> Mask:
    """Return which anatomical angles (A,) are those of segments that another answer rotates."""
    skeleton = body.skeleton
    turned = skeleton.coordinate_segment[other.columns - len(ROOT_COORDINATES)]
    rotated = {skeleton.segment_names[segment] for segment in turned}
    return np.isin(anatomy_of(skeleton, body.joint_centres).angle_segments, list(rotated))

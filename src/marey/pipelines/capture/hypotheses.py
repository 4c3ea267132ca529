"""Several answers to the same outlines, in a capture: exploration, reports, and flags."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from marey.body.articulation.pose import Pose
from marey.body.articulation.surface import Body
from marey.fit.recipes.hypotheses import Alternative, explore_hypotheses
from marey.fit.recipes.person import SilhouetteTake, with_shape
from marey.motion.from_fit import MeasuredPiece
from marey.pipelines.capture.run import Bodies, Run


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
    person = run.person
    with run.progress.stage("Other answers"):
        found = explore_hypotheses(
            take.levels(person.track_height), take.levels(person.fine_height), take.levels(person.rough_height),
            body, with_shape(body, bodies.coarse), poses, rate=take.rate,
        )  # fmt: skip
    for former in found.replaced:
        run.progress.report(f"{_named(former)}: another posture explains the images better")
    for other in found.alternatives:
        run.progress.warn(
            f"{_named(other)}: two postures explain the images. The stated standard deviations cover both; the "
            f"other one has a probability of {other.probability:.2f}."
        )
    return dict(found.poses), found.alternatives


def _named(answer: Alternative) -> str:
    return f"{answer.name.capitalize()}, frames {min(answer.poses)} to {max(answer.poses)}"


def undetermined(piece: MeasuredPiece, alternatives: Sequence[Alternative]) -> MeasuredPiece:
    """Return a piece whose coordinates with several possible answers are flagged as not determined."""
    determined = np.array(piece.determined)
    for k, frame in enumerate(map(int, piece.frames)):
        for other in alternatives:
            if frame in other.poses:
                determined[k, other.columns] = False
    return replace(piece, determined=determined)

"""Start and first estimate of the motion and the shape, in silhouettes."""

from collections.abc import Callable
from functools import partial
from typing import Any

from marey.body.articulation.presets import follows_limb
from marey.fit.recipes.person import (
    SilhouetteTake,
    TrackCheckpoint,
    refined_poses,
    start_person,
    track_person,
    with_shape,
)
from marey.fit.recipes.sequence_equations import FrameTermsFactory
from marey.fit.recipes.start_joints import start_from_joints
from marey.fit.search.search import Candidate
from marey.io.stages import Arrays
from marey.io.trial.trial import Trial
from marey.pipelines.capture.detected import DetectedPerson
from marey.pipelines.capture.run import Bodies, Run, whole_bodies
from marey.pipelines.capture.tracked import (
    Tracked,
    frames_for_sizes,
    pack_candidates,
    pack_tracked,
    rounds_of,
    unpack_tracked,
)
from marey.pipelines.kept_candidates import KeptCandidates
from marey.pipelines.people.choice import given_start
from marey.pipelines.silhouettes import stages
from marey.pipelines.silhouettes.empty_rooms import in_small_pictures
from marey.pipelines.verdict import NotUsable, Verdict, VerdictReason

SHAPE_ROUNDS = 4
"""Rounds of matching and solving in the first refinement of shape and motion.

Chosen by hand; results were not measured against other values.
"""
CLEARLY_BETTER = 0.02
"""Gain of agreement for which a start from detected joints replaces one from silhouettes. The sizes of a body that is
fitted to detected joints are wrong by centimetres: `jacks` with plates has joint errors of 14.1 instead of 11.6 mm if
it always starts from them."""
LIMB_AGREEMENT = 0.67
"""Agreement of the start with the silhouettes below which they show more than the single limb of a preset. In parts of
`arm3`, whose images show an arm, the trunk and a little of the head and of the other arm, it is 0.75 to 0.86, and in
made silhouettes of a limb with its part of the trunk 0.93 and more (twelve postures); in silhouettes of whole persons
(`reach` and `walk`, two and four cameras) it is 0.40 to 0.63."""


def tracked_in_silhouettes(
    run: Run, take: SilhouetteTake, bodies: Bodies, detected: DetectedPerson | None, terms: FrameTermsFactory | None
) -> Tracked:
    """Find the start, track the person, and estimate the shape.

    Args:
        run: The run.
        take: Cameras and silhouettes.
        bodies: The body with many and with few vertices.
        detected: The person's detected joints; None without key points.
        terms: Further observations for the refinement.

    Returns:
        The tracked person.
    """
    person, progress, cache = run.person, run.progress, run.cache
    free = bodies.held() if run.settings.fixed_sizes else bodies

    def start() -> Arrays:
        count = min(person.start_frames, len(take.frames))
        with (
            cache.frames("start_frames", depends=run.scope) as log,
            cache.frames("opposite_start_frames", depends=run.scope) as opposite_log,
            progress.stage("Start", count) as step,
        ):
            kept, opposite = KeptCandidates(log, free.fine), KeptCandidates(opposite_log, free.fine)
            frame, found = begin(run, take, free, kept, opposite, detected, done=lambda frame: step())
        return pack_candidates({frame: found}, bodies.fine if run.settings.fixed_sizes else found.posed.body)

    def follow() -> Arrays:
        begun = unpack_tracked(cache.arrays("start", start, depends=run.scope), bodies.fine)
        frame = next(iter(begun.poses))
        with (
            cache.frames("tracked_frames", depends=run.scope) as tracked,
            cache.frames("picked_up_frames", depends=run.scope) as picked,
            cache.frames("repaired_frames", depends=run.scope) as repaired,
            progress.stage("Tracking", len(take.frames)) as step,
        ):
            memory = TrackCheckpoint(
                KeptCandidates(tracked, begun.body),
                KeptCandidates(picked, begun.body),
                KeptCandidates(repaired, begun.body),
            )
            found = track_person(
                take, begun.body, with_shape(begun.body, bodies.coarse), (frame, begun.poses[frame]), person,
                progress=lambda frame: step(), checkpoint=memory,
            )  # fmt: skip
        return pack_candidates(found, begun.body)

    def shape() -> Arrays:
        followed = unpack_tracked(cache.arrays("tracked", follow, depends=run.scope), bodies.fine)
        with (
            rounds_of(run, "shape") as memory,
            progress.stage("Shape and motion", SHAPE_ROUNDS * len(followed.poses)) as step,
        ):
            poses, body = refined_poses(
                take, followed.body, followed.poses, frames_for_sizes(run, followed.scores), person,
                height=person.track_height, rounds=SHAPE_ROUNDS, extra_terms=terms,
                progress=lambda frame: step(), checkpoint=memory,
            )  # fmt: skip
        return pack_tracked(poses, body, followed.scores)

    found = unpack_tracked(cache.arrays("shape", shape, depends=run.scope), bodies.fine)
    take.forget()
    return found


def begin(
    run: Run,
    take: SilhouetteTake,
    bodies: Bodies,
    kept: KeptCandidates[Any],
    opposite: KeptCandidates[Any],
    detected: DetectedPerson | None = None,
    *,
    done: Callable[[int], None],
) -> tuple[int, Candidate]:
    """Find the start, from given or detected joints or without any.

    Args:
        run: The run.
        take: Cameras and silhouettes.
        bodies: The body with many and with few vertices.
        kept: Receives the candidates.
        opposite: Receives the candidates that face the other way.
        detected: The person whose joints were detected.
        done: Called with each frame that was tried.

    Returns:
        The frame, and the body's pose in it.

    Raises:
        NotUsable: The silhouettes have nothing in common, they show more than the single limb of the preset, or the
            person is horizontal or upside down and no setting names the axis that points up.
    """
    trial = run.trial
    joints = given_start(trial)
    if joints is not None:
        found: tuple[int, Candidate] | None = start_from_joints(
            take,
            joints.frame,
            joints.joint_names,
            in_small_pictures(joints.pixels, list(trial.rig), take.cameras),
            bodies.fine,
            run.person,
        )
        done(joints.frame)
    else:
        whole = partial(whole_bodies, trial) if follows_limb(trial.settings.preset) else None
        found = start_person(
            take, bodies.coarse, bodies.fine, run.person, progress=done, checkpoint=kept, opposite=opposite,
            whole=whole,
        )  # fmt: skip
        found = better_start(run, take, bodies, found, detected)
    if found is None:
        remedy = "Check that all cameras are calibrated in one world, and that the silhouettes show the person."
        what = f"{trial.folder} has silhouettes that no point in space projects into in all cameras."
        raise NotUsable(Verdict.of([VerdictReason.failure(what, remedy, cause="nobody")]))
    require_limb_alone(trial, found[1])
    stages.require_upright(trial, found[1].posed)
    return found


def require_limb_alone(trial: Trial, found: Candidate) -> None:
    """Check that the silhouettes show no more than a limb and its part of the trunk, if the preset is a single limb.

    Args:
        trial: The trial.
        found: The start.

    Raises:
        NotUsable: They show more: the limb may then be found in any part of the outline.
    """
    preset = trial.settings.preset
    if not follows_limb(preset) or found.score >= LIMB_AGREEMENT:
        return
    what = (
        f"The preset {preset} follows one limb, and the silhouettes show more of the person: the best start that was "
        f"found agrees with them by {found.score:.2f} only (1 is perfect)."
    )
    remedy = (
        "Leave out the preset (--preset, or preset in trial.toml) to capture the whole person; the results contain the "
        "angles of all limbs. A preset of one limb needs silhouettes of this limb and its part of the trunk alone."
    )
    raise NotUsable(Verdict.of([VerdictReason.failure(what, remedy, cause="preset")]))


def better_start(
    run: Run,
    take: SilhouetteTake,
    bodies: Bodies,
    found: tuple[int, Candidate] | None,
    detected: DetectedPerson | None,
) -> tuple[int, Candidate] | None:
    """Return the start from detected joints if it agrees clearly better with the silhouettes than the one from them.

    Args:
        run: The run.
        take: Cameras and silhouettes.
        bodies: The body with many and with few vertices.
        found: The start from silhouettes alone; None if there is none.
        detected: The person whose joints were detected.
    """
    best = None if detected is None else detected.clearest(take.frames)
    if detected is None or best is None:
        return found
    pixels = in_small_pictures(detected.agreeing_pixels(best), list(run.trial.rig), take.cameras)
    other = start_from_joints(take, best, detected.joints.joint_names, pixels, bodies.fine, run.person)
    return other if found is None or other[1].score > found[1].score + CLEARLY_BETTER else found

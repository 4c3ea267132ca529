from dataclasses import replace

import numpy as np
import pytest
from tests import made_steps, performer

from marey.body.metaballs.metaball_people import metaball_person
from marey.motion.events.body_feet import paths_of_body
from marey.motion.motion import BodyMotion

FRAMES = 150


def walking_body() -> BodyMotion:
    """The made walk at 30 Hz, as the motion of a captured body that faces -y."""
    person, walk = performer.body(), made_steps.made_walk(30.0, FRAMES / 30.0)
    motion = performer.motion(person, FRAMES, gap=())
    forward = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]).T  # the walk's x is the body's -y
    rotation, origin = np.array(motion.segment_rotation), np.array(motion.segment_origin)
    names = list(motion.segment_names)
    centres = dict(zip(names, person.joint_centres, strict=True))
    origin[:, names.index("pelvis")] = walk.body @ forward.T
    for foot in walk.feet:
        assert foot.toe is not None
        pitch = np.arcsin((foot.toe - foot.heel)[:, 2] / made_steps.FOOT_M)
        c, s, zero, one = np.cos(pitch), np.sin(pitch), 0 * pitch, 0 * pitch + 1
        turn = np.stack([one, zero, zero, zero, c, s, zero, -s, c], -1).reshape(-1, 3, 3)
        heel = centres[f"{foot.side}_foot"] + [0.0, 0.04, -0.04]  # of the box about the ankle
        for name in ("foot", "toes"):
            k = names.index(f"{foot.side}_{name}")
            rotation[:, k] = turn
            origin[:, k] = foot.heel @ forward.T + turn @ (centres[f"{foot.side}_{name}"] - heel)
    return replace(motion, segment_rotation=rotation, segment_origin=origin)


@pytest.mark.slow
def test_heels_are_behind_the_ankles_and_toes_before_the_balls_of_the_feet():
    person = metaball_person("simple", "coarse")
    motion = performer.motion(person, 3, gap=())
    rest = replace(
        motion,
        segment_rotation=np.broadcast_to(np.eye(3), motion.segment_rotation.shape),
        segment_origin=np.broadcast_to(person.joint_centres, motion.segment_origin.shape),
    )
    paths = paths_of_body(rest, person)
    assert paths is not None
    assert [foot.side for foot in paths.feet] == ["left", "right"]
    centres = dict(zip(person.skeleton.segment_names, person.joint_centres, strict=True))
    for foot in paths.feet:
        ankle, ball = centres[f"{foot.side}_foot"], centres[f"{foot.side}_toes"]
        assert foot.toe is not None
        assert 0.02 < foot.heel[0, 1] - ankle[1] < 0.08  # a body faces -y
        assert 0.02 < ankle[2] - foot.heel[0, 2] < 0.09
        assert 0.02 < ball[1] - foot.toe[0, 1] < 0.10
        assert abs(foot.heel[0, 0] - ankle[0]) < 0.03
    np.testing.assert_array_equal(paths.body, np.tile(centres["pelvis"], (3, 1)))


def test_points_are_carried_by_their_segments_and_gaps_stay_gaps():
    person, motion = performer.body(), walking_body()
    paths = paths_of_body(motion, person)
    assert paths is not None
    k = motion.segment_names.index("left_foot")
    local = np.einsum("fba,fb->fa", motion.segment_rotation[:, k], paths.feet[0].heel - motion.segment_origin[:, k])
    np.testing.assert_allclose(local, np.tile(local[0], (FRAMES, 1)), atol=1e-12)
    origin = np.array(motion.segment_origin)
    origin[20] = np.nan
    gap = paths_of_body(replace(motion, segment_origin=origin), person)
    assert gap is not None
    np.testing.assert_array_equal(np.isnan(gap.feet[0].heel).any(1), np.arange(FRAMES) == 20)


def test_a_motion_without_feet_has_no_paths():
    motion = performer.motion(performer.body(), 3, gap=())
    kept = [i for i, name in enumerate(motion.segment_names) if "toes" not in name]
    upper = replace(
        motion, segment_names=tuple(motion.segment_names[i] for i in kept),
        segment_rotation=motion.segment_rotation[:, kept], segment_origin=motion.segment_origin[:, kept],
    )  # fmt: skip
    assert paths_of_body(upper, performer.body()) is None

"""The skin of metaballs in any pose."""

import numpy as np
import pytest

from marey.body.articulation.pose import Pose, PosedBody
from marey.body.metaballs.metaball_people import metaball_person
from marey.body.metaballs.metaball_skin import MetaballSkin
from marey.body.metaballs.metaballs import PosedMetaballs
from marey.body.people.person import person_body


def test_the_skin_lies_on_the_metaballs_where_a_joint_is_bent():
    body = metaball_person("simple", "coarse", preset="right_arm")
    angles = np.zeros(len(body.skeleton) - 6)
    angles[[c.name for c in body.skeleton.coordinates].index("right_elbow_flexion")] = 1.2
    pose, skin = Pose(np.zeros(3), np.eye(3), angles), MetaballSkin(body)
    used = np.unique(skin.faces)
    on = PosedMetaballs(body.metaballs.balls(body.numbers), pose)
    away = np.abs(on.distance(skin.vertices(pose)[used]))
    # In a crease, where two limbs meet, the blended skin stays.
    assert np.mean(away < 1e-4) > 0.9
    blended = np.abs(on.distance(PosedBody(body, pose).vertices[np.unique(body.faces)]))
    assert np.count_nonzero(blended > 1e-3) / len(blended) > 2 * np.mean(away > 1e-3)


def test_a_learned_person_has_no_metaballs():
    with pytest.raises(ValueError, match="no metaballs"):
        MetaballSkin(person_body("coarse")).vertices(Pose(np.zeros(3), np.eye(3), np.zeros(48)))

from dataclasses import replace

import numpy as np
import pytest
from tests.markers.methods.test_joint_constraints import leg

from marey.geometry import rotations
from marey.markers.methods.joint_constraints import joint_rows
from marey.markers.methods.joint_support import laxity_factors

CENTRES = (np.zeros(3), np.zeros(3))


def factors_of(clusters, joint):
    rows = joint_rows(joint, clusters, np.zeros((len(joint.time), 2, 6)), CENTRES)
    return laxity_factors(joint, clusters, rows)


def known_once(joint):
    """The same joint, known in its first posture alone."""
    first = slice(0, 1)
    poses = {
        name: tuple(part[first] for part in getattr(joint, name)) for name in ("parent_pose", "child_pose")
    }  # fmt: skip
    return replace(joint, frames=joint.frames[first], **poses)


def turned(clusters, axis, size):
    """The same leg whose shank also swings about one of its own axes by up to this angle [rad]."""
    course = size * np.sin(np.linspace(0, 4 * np.pi, len(clusters[1].origin)))
    course -= course[0]
    turn = rotations.about(np.eye(3)[axis], course)
    return [clusters[0], replace(clusters[1], rotation=clusters[1].rotation @ turn)]


def test_a_hinge_keeps_the_usual_laxity(rng):
    clusters, joint = leg(rng, frames=60)
    np.testing.assert_array_equal(factors_of(clusters, joint), 1)


@pytest.mark.parametrize(("axis", "row"), [(0, 3), (1, 4)])
def test_a_knee_that_rotates_far_is_held_less_in_that_rotation_alone(rng, axis, row):
    clusters, joint = leg(rng, frames=60, spread=1e-3)
    found = factors_of(turned(clusters, axis, 1.0), known_once(joint))
    assert found[row] > 4
    np.testing.assert_array_equal(found[:3], 1)
    assert found[7 - row] < found[row]


def test_skin_that_moves_as_far_explains_the_same_rotation(rng):
    tight, joint = leg(rng, frames=60, spread=1e-3)
    joint = known_once(joint)
    loose = [replace(cluster, prior=cluster.prior * 1e6) for cluster in tight]
    assert factors_of(turned(tight, 1, 0.6), joint)[4] > factors_of(turned(loose, 1, 0.6), joint)[4]


def test_a_trial_of_known_postures_only_says_nothing(rng):
    clusters, joint = leg(rng, frames=12)
    everything = np.arange(12)
    every = replace(
        joint, frames=everything, parent_pose=(clusters[0].rotation, clusters[0].origin),
        child_pose=(clusters[1].rotation, clusters[1].origin),
    )  # fmt: skip
    np.testing.assert_array_equal(factors_of(clusters, every), 1)

import numpy as np
import pytest
from tests.skin_clusters import leg_and_bones, rigid_leg, turns

from marey.errors import SettingProblem
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.methods.methods import METHODS, choose_methods

WITHOUT_EXERCISE = [entry for entry in METHODS.values() if not entry.exercise]


def test_all_are_every_method_and_names_keep_their_order():
    assert [entry.name for entry in choose_methods(["all"])] == list(METHODS)
    assert [entry.name for entry in choose_methods(["rigid"])] == ["rigid"]


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(SettingProblem, match=r"no method fast\. Available methods: rigid"):
        choose_methods(["rigid", "fast"])


def test_a_missing_requirement_is_reported(rng):
    leg = rigid_leg(rng)
    assert METHODS["rigid"].missing_requirement(leg) == ""


@pytest.mark.parametrize("entry", WITHOUT_EXERCISE, ids=lambda entry: entry.name)
def test_with_rigid_markers_every_method_gives_the_truth(entry, rng):
    leg, bones = leg_and_bones(rng, known=[0, 20])
    motion: BoneMotion = entry.run(leg)
    assert motion.segments == ("thigh", "shank")
    for name, (rotation, origin) in bones.items():
        estimated, place = motion.bone(name)
        assert turns(estimated, rotation).max() < 1e-9
        assert np.abs(place - origin).max() < 1e-9

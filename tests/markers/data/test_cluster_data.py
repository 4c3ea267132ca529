from dataclasses import replace

import numpy as np
import pytest
from tests.skin_clusters import placed, rigid_leg

from marey.errors import MareyError
from marey.markers.data.cluster_data import cluster_data, frame_count_note
from marey.markers.data.clusters import Cluster


def test_the_places_on_the_bone_carry_back_to_the_known_postures(rng):
    leg = rigid_leg(rng, known=[0, 7])
    data = cluster_data(leg, leg.clusters[1])
    for k, frame in enumerate(data.frames):
        back = placed(data.rotation[k : k + 1], data.origin[k : k + 1], data.postures[k])[0]
        np.testing.assert_allclose(back, data.points[frame], atol=1e-12)
    np.testing.assert_allclose(data.reference, data.postures[0], atol=1e-12)


def test_the_error_on_a_segment_missing_from_the_calibration_lists_its_segments(rng):
    leg = rigid_leg(rng)
    with pytest.raises(MareyError, match=r"no segment 'foot'\. It has: thigh, shank"):
        cluster_data(leg, Cluster(segment="foot", labels=("shank_00",)))


def test_a_posture_outside_the_trial_is_an_error(rng):
    leg = rigid_leg(rng)
    late = replace(leg, calibration=replace(leg.calibration, frames=np.array([40])))
    with pytest.raises(MareyError, match="frame 40; the trial has 40 frames"):
        cluster_data(late, leg.clusters[0])


def test_no_note_for_no_frames():
    assert frame_count_note("thigh", np.zeros(4, bool), "fell") == ()
    assert frame_count_note("thigh", np.array([True, False]), "fell") == ("thigh: 1 of 2 frames fell.",)

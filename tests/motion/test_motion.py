"""A motion is checked when it is made, and cannot be changed afterwards."""

from dataclasses import replace

import numpy as np
import pytest

from marey.errors import MareyError
from marey.motion.motion import MEASURED, BodyMotion


def test_a_wrong_shape_is_named_with_the_right_one(motion: BodyMotion):
    with pytest.raises(MareyError, match=r"joint_centres_sd has the shape .* and should have"):
        replace(motion, joint_centres_sd=motion.joint_centres_sd[:-1])


def test_every_fault_is_listed_at_once(motion: BodyMotion):
    with pytest.raises(MareyError, match=r"rate is .* state contains"):
        replace(motion, rate=0.0, state=np.full(len(motion), 7))


def test_two_equal_names_are_rejected(motion: BodyMotion):
    names = (motion.joint_names[0], *motion.joint_names[:-1])
    with pytest.raises(MareyError, match="are equal"):
        replace(motion, joint_names=names)


def test_the_arrays_cannot_be_written_to(motion: BodyMotion):
    with pytest.raises(ValueError, match="read-only"):
        motion.coordinates[0, 0] = 1.0


def test_frames_of_a_slice_a_list_and_a_mask_agree(motion: BodyMotion):
    mask = np.zeros(len(motion), bool)
    mask[3:6] = True
    for chosen in (slice(3, 6), [3, 4, 5], mask):
        part = motion.frames(chosen)
        np.testing.assert_array_equal(part.joint_centres, motion.joint_centres[3:6])
        np.testing.assert_array_equal(part.time, motion.time[3:6])
        assert part.joint_names == motion.joint_names


def test_gaps_are_the_runs_between_the_first_and_the_last_result(motion: BodyMotion):
    rotation = np.array(motion.segment_rotation)
    rotation[:2] = rotation[5:7] = rotation[9] = rotation[-1] = np.nan
    assert replace(motion, segment_rotation=rotation).gaps() == [(5, 7), (9, 10), (11, 13)]
    assert replace(motion, segment_rotation=rotation * np.nan).gaps() == []


def test_the_error_on_a_missing_name_lists_the_existing_ones(motion: BodyMotion):
    with pytest.raises(MareyError, match="left_knee"):
        motion.joint("left_nee")
    assert motion.joint("left_knee").shape == (len(motion), 3)
    assert motion.state[3] == MEASURED

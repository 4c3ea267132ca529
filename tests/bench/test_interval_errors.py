"""What the bench of intervals compares: shapes, turns and flexions, after what no result determines is taken out."""

import argparse

import numpy as np
import pytest
from bench.intervals.of_clocks import of_clocks
from bench.intervals.of_motion import flexion, true_joints
from bench.intervals.of_shapes import shape_sample, turn_sample

from marey.cameras.clocks import Clocks
from marey.geometry import rotations

MIRROR = np.diag([1.0, 1.0, -1.0])


@pytest.mark.parametrize("mirror", [np.eye(3), MIRROR])
def test_axes_and_mirror_of_a_shape_are_no_errors(mirror: np.ndarray):
    rng = np.random.default_rng(0)
    true = rng.normal(size=(6, 3, 20)) + 5.0
    own = mirror @ rotations.exp(np.array([0.4, -0.2, 1.0])) @ true
    found = shape_sample("made", "seed 0", own, np.ones_like(own), true)
    assert found.error.shape == (120, 3)
    # Rounding of values of about ten, in per cent of a size of about one.
    assert np.abs(found.error).max() < 1e-10


def test_errors_of_a_shape_are_in_per_cent_of_its_size():
    rng = np.random.default_rng(1)
    true, noise = rng.normal(size=(40, 3, 30)), 0.05 * rng.normal(size=(40, 3, 30))
    found = shape_sample("made", "seed 1", true + noise, np.full(true.shape, 0.05), true)
    # Each frame's mean and the common axes are taken out: one of 30 points, and three numbers.
    assert np.sqrt(np.mean(found.error**2)) == pytest.approx(5.0, rel=0.05)
    assert np.allclose(found.sd, 5.0, rtol=0.05)


@pytest.mark.parametrize("mirror", [np.eye(3), MIRROR])
def test_the_object_s_axes_are_no_errors_of_turns(mirror: np.ndarray):
    true = rotations.exp(np.random.default_rng(2).normal(size=(8, 3)))
    axes = rotations.exp(np.array([0.3, 0.1, -0.5]))
    found = turn_sample("made", "seed 2", mirror @ true @ axes @ mirror, np.ones((8, 3)), true)
    assert np.abs(found.error).max() < 1e-5  # The logarithm of rotations near the identity loses half of the digits.


def test_a_right_angle_is_a_flexion_of_90_degrees_and_a_line_is_none():
    bent = np.array([[[0, 0, 1.0], [0, 0, 0], [1, 0, 0]], [[0, 0, 2.0], [0, 0, 1], [0, 0, 0]]])
    assert flexion(bent) == pytest.approx([90.0, 0.0])


def test_joints_are_named_by_side():
    truth = {"joint_names": np.array(["l_knee", "r_hip"]), "joints": np.arange(12.0).reshape(2, 2, 3)}
    assert np.array_equal(true_joints(truth, ["right_hip"]), truth["joints"][:, 1:])


def test_the_first_clock_is_the_reference_and_undetermined_ones_are_left_out():
    clocks = Clocks(
        names=("cam01", "cam03"), offset_s=np.array([0.0, 0.25]), drift=np.array([0.0, 2e-5]),
        offset_sd_s=np.array([0.0, 1e-3]), drift_sd=np.array([0.0, 1e-5]),
    )  # fmt: skip
    true = np.array([0.0, 9.0, 0.249]), np.array([0.0, 9.0, 1e-5])
    offset, drift = of_clocks("take", "made", clocks, ("cam01", "cam02", "cam03"), *true)
    assert (offset.error.item(), offset.sd.item()) == pytest.approx((1.0, 1.0))
    assert (drift.error.item(), drift.sd.item()) == pytest.approx((10.0, 10.0))


def test_a_capability_is_an_argument():
    for name in ("skimage", "SimpleITK"):
        pytest.importorskip(name)
    from bench.intervals.coverage import CAPABILITIES, ONLY_BY_NAME, arguments

    parser = argparse.ArgumentParser(exit_on_error=False)
    arguments(parser)
    assert parser.parse_args(["bones", "clocks"]).capabilities == ["bones", "clocks"]
    with pytest.raises(argparse.ArgumentError, match="there is no capability 'bone'"):
        parser.parse_args(["bone"])
    assert set(ONLY_BY_NAME) < set(CAPABILITIES)

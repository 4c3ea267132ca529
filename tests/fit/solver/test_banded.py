"""The banded system: its algebra against a dense solve, in one piece and in windows."""

import numpy as np
import pytest

from marey.fit.solver.banded import BandedSystem, LocalEquations, Window, windows, with_shape_covariance
from marey.fit.solver.body_solver import bounded_step

FRAMES, DEGREES, NUMBERS = 6, 4, 3
NO_TRUST = np.full(DEGREES, np.inf)


def random_system(rng, numbers=NUMBERS, frames=FRAMES):
    """A random positive system of the shape that poses, smoothness and a border give, and the same one dense."""
    system = BandedSystem.empty(frames, DEGREES, numbers)
    size = frames * DEGREES + numbers
    dense, gradient = np.zeros((size, size)), np.zeros(size)
    shape = list(range(frames * DEGREES, size))
    for f in range(frames):
        own = [*range(f * DEGREES, (f + 1) * DEGREES), *shape]
        rows = rng.normal(size=(20, len(own)))
        hessian, slope = rows.T @ rows, rng.normal(size=len(own))
        system.add_frame(f, hessian, slope, DEGREES)
        dense[np.ix_(own, own)] += hessian
        gradient[own] += slope
    return system, dense, gradient


def add_smoothness(rng, system, dense, gradient):
    """Smoothness is linear where a pose's turn stays small: here the poses of a body without turns."""
    spread = rng.uniform(0.5, 2.0, DEGREES)
    values = rng.normal(size=(FRAMES, DEGREES))

    class Flat:
        """A pose without turns."""

        def __init__(self, value):
            self.value = value

        def change_to(self, other):
            return other.value - self.value

    for f in range(1, FRAMES - 1):
        system.add_smoothness(f, [Flat(v) for v in values], spread)
        jacobian = np.zeros((DEGREES, len(gradient)))
        for offset, share in ((-1, 1.0), (0, -2.0), (1, 1.0)):
            columns = (f + offset) * DEGREES + np.arange(DEGREES)
            jacobian[np.arange(DEGREES), columns] = share
        residual = values[f + 1] - 2 * values[f] + values[f - 1]
        dense += jacobian.T @ (jacobian / spread[:, None] ** 2)
        gradient += jacobian.T @ (residual / spread**2)


def shape_of(dense, gradient):
    """The information about the shape alone from all frames."""
    return dense[-NUMBERS:, -NUMBERS:], gradient[-NUMBERS:]


@pytest.mark.parametrize("numbers", [0, NUMBERS])
def test_the_banded_solution_is_the_dense_one(rng, numbers):
    system, dense, gradient = random_system(rng, numbers)
    add_smoothness(rng, system, dense, gradient)
    left = system.eliminate(NO_TRUST, slice(0, FRAMES))
    expected = -np.linalg.solve(dense, gradient)
    shape = np.zeros(0)
    if numbers:
        corner, slope = shape_of(dense, gradient)
        shape = -np.linalg.solve(corner - left["taken"], slope - left["taken_gradient"])
    step = -(left["own"] + left["by_shape"] @ shape)
    np.testing.assert_allclose(np.concatenate([step, shape]), expected, atol=1e-8)


@pytest.mark.parametrize("numbers", [0, NUMBERS])
def test_the_covariances_are_blocks_of_the_dense_inverse(rng, numbers):
    system, dense, gradient = random_system(rng, numbers)
    add_smoothness(rng, system, dense, gradient)
    found = system.covariances(DEGREES, slice(0, FRAMES))
    inverse = np.linalg.inv(dense)
    shape = np.linalg.inv(shape_of(dense, gradient)[0] - found["loss"]) if numbers else np.zeros((0, 0))
    covariance = with_shape_covariance(found["blocks"], found["spread"], shape)
    for f in range(FRAMES):
        own = [*range(f * DEGREES, (f + 1) * DEGREES), *range(FRAMES * DEGREES, len(dense))]
        np.testing.assert_allclose(covariance[f], inverse[np.ix_(own, own)], atol=1e-7 * np.abs(inverse).max())


def test_poses_independent_of_the_shape_leave_it_unchanged(rng):
    blocks, shape = np.tile(np.eye(DEGREES), (2, 1, 1)), 0.1 * np.eye(NUMBERS)
    whole = with_shape_covariance(blocks, np.zeros((2, DEGREES, 0)), shape)
    np.testing.assert_array_equal(whole[:, :DEGREES, :DEGREES], blocks)
    np.testing.assert_array_equal(whole[:, DEGREES:, DEGREES:], np.tile(shape, (2, 1, 1)))
    assert not whole[:, :DEGREES, DEGREES:].any()


def test_cores_of_a_system_share_it_between_them(rng):
    system, dense, gradient = random_system(rng)
    add_smoothness(rng, system, dense, gradient)
    whole = system.eliminate(NO_TRUST, slice(0, FRAMES))
    first, second = (system.eliminate(NO_TRUST, core) for core in (slice(0, 2), slice(2, FRAMES)))
    for name in ("taken", "taken_gradient"):
        np.testing.assert_allclose(first[name] + second[name], whole[name], atol=1e-12)
    for name in ("own", "by_shape"):
        np.testing.assert_allclose(np.concatenate([first[name], second[name]]), whole[name], atol=1e-12)


@pytest.mark.parametrize(
    ("count", "length", "overlap"), [(1, 10, 3), (16, 10, 3), (17, 10, 3), (95, 10, 3), (1000, 240, 30)]
)
def test_every_frame_counts_in_one_window_that_sees_its_neighbours(count, length, overlap):
    found = windows(count, length, overlap)
    assert [f for window in found for f in range(window.begin, window.end)] == list(range(count))
    for window in found:
        assert window.first == max(window.begin - overlap, 0) or len(found) == 1
        assert window.last == min(window.end + overlap, count) or len(found) == 1
        assert window.end - window.begin <= length + 2 * overlap
        assert (window.core.start, window.core.stop) == (window.begin - window.first, window.end - window.first)


def test_a_short_sequence_is_one_window():
    assert windows(16, 10, 3) == [Window(0, 16, 0, 16)]


def test_with_a_limited_shape_step_the_poses_take_the_best_remaining_step(rng):
    system, dense, gradient = random_system(rng)
    add_smoothness(rng, system, dense, gradient)
    left = system.eliminate(NO_TRUST, slice(0, FRAMES))
    corner, slope = shape_of(dense, gradient)
    information, pull = corner - left["taken"], slope - left["taken_gradient"]
    held = 0.3 * np.abs(np.linalg.solve(information, pull))
    shape = bounded_step(information, pull, -held, held)
    assert np.all(np.abs(shape) <= held * (1 + 1e-6) + 1e-8)
    step = np.concatenate([-(left["own"] + left["by_shape"] @ shape), shape])
    slope = gradient + dense @ step
    np.testing.assert_allclose(slope[:-NUMBERS], 0.0, atol=1e-7 * np.abs(gradient).max())
    # At a bound the cost would fall only by leaving it.
    assert np.all(slope[-NUMBERS:] * np.sign(shape) <= 1e-7 * np.abs(gradient).max())


def local_equations(rng, pairs):
    """Random equations of a pose and of pairs of unknowns, and the same ones dense: first the pose, then the pairs."""
    by_pair = [rng.normal(size=(5, DEGREES + 2)) for _ in pairs]
    slopes = [rng.normal(size=5) for _ in pairs]
    pose = sum(rows[:, :DEGREES].T @ rows[:, :DEGREES] for rows in by_pair)
    return (
        LocalEquations(
            groups=np.array(pairs),
            pose=pose,
            pose_gradient=sum(rows[:, :DEGREES].T @ slope for rows, slope in zip(by_pair, slopes, strict=True)),
            by_pose=np.stack([rows[:, :DEGREES].T @ rows[:, DEGREES:] for rows in by_pair], 1),
            own=np.array([rows[:, DEGREES:].T @ rows[:, DEGREES:] for rows in by_pair]),
            gradient=np.array([rows[:, DEGREES:].T @ slope for rows, slope in zip(by_pair, slopes, strict=True)]),
        ),
        list(zip(pairs, by_pair, slopes, strict=True)),
    )


@pytest.mark.parametrize("numbers", [0, NUMBERS])
def test_unknowns_of_a_few_frames_are_eliminated_exactly(rng, numbers):
    system, dense, gradient = random_system(rng, numbers)
    add_smoothness(rng, system, dense, gradient)
    frames, prior_sd = {0: [7, 2], 1: [2], 3: [7, 5, 2], 5: [5]}, 3.0
    poses, names, size = FRAMES * DEGREES, [2, 5, 7], len(gradient)
    whole, slope = np.zeros((size + 6, size + 6)), np.append(gradient, np.zeros(6))
    whole[:size, :size] = dense
    whole[range(size, size + 6), range(size, size + 6)] = 1.0 / prior_sd**2
    equations = {}
    for f, pairs in frames.items():
        equations[f], parts = local_equations(rng, pairs)
        for name, block, right in parts:
            first = size + 2 * names.index(name)
            columns = [*range(f * DEGREES, (f + 1) * DEGREES), first, first + 1]
            whole[np.ix_(columns, columns)] += block.T @ block
            slope[columns] += block.T @ right
    system.add_local(equations, DEGREES, prior_sd=prior_sd)
    left = system.eliminate(NO_TRUST, slice(0, FRAMES))
    expected, inverse = -np.linalg.solve(whole, slope), np.linalg.inv(whole)
    shape = np.zeros(0)
    if numbers:
        corner, pull = shape_of(dense, gradient)
        shape = -np.linalg.solve(corner - left["taken"], pull - left["taken_gradient"])
    step = -(left["own"] + left["by_shape"] @ shape)
    np.testing.assert_allclose(np.concatenate([step, shape]), expected[:size], atol=1e-8)
    found = system.covariances(DEGREES, slice(0, FRAMES))
    shape = np.linalg.inv(shape_of(dense, gradient)[0] - found["loss"]) if numbers else np.zeros((0, 0))
    covariance = with_shape_covariance(found["blocks"], found["spread"], shape)
    for f in range(FRAMES):
        own = [*range(f * DEGREES, (f + 1) * DEGREES), *range(poses, size)]
        np.testing.assert_allclose(covariance[f], inverse[np.ix_(own, own)], atol=1e-7)


def test_without_equations_there_are_no_further_unknowns(rng):
    system, _, _ = random_system(rng)
    system.add_local({}, DEGREES, prior_sd=1.0)
    assert system.groups is None


@pytest.mark.parametrize("core", [slice(0, FRAMES), slice(2, 4)])
def test_the_jackknife_is_that_of_the_dense_equations_without_each_camera(rng, core):
    count, size = 4, FRAMES * DEGREES
    system, whole = BandedSystem.empty(FRAMES, DEGREES, 0), [(np.zeros((size, size)), np.zeros(size))] * count
    cameras = []
    for f in range(FRAMES):
        parts = []
        for c in range(count):
            rows = rng.normal(size=(10, DEGREES))
            parts.append((rows.T @ rows, rng.normal(size=DEGREES)))
            here = np.ix_(range(f * DEGREES, (f + 1) * DEGREES), range(f * DEGREES, (f + 1) * DEGREES))
            dense, gradient = whole[c][0].copy(), whole[c][1].copy()
            dense[here] += parts[c][0]
            gradient[here[0].ravel()] += parts[c][1]
            whole[c] = dense, gradient
        # The third frame has no silhouettes.
        cameras.append(() if f == 2 else parts)
        prior = np.eye(DEGREES)
        system.add_frame(f, sum((h for h, _ in parts), prior), sum((g for _, g in parts), np.zeros(DEGREES)), DEGREES)
    damping = np.full(DEGREES, 2.0)
    found = system.jackknife(cameras, system.eliminate(damping, core)["own"], damping, core)
    every = sum(h for h, _ in whole) + (1.0 + 1.0 / 2.0**2) * np.eye(size)
    slope = sum(g for _, g in whole)
    used = np.repeat([float(bool(parts)) for parts in cameras], DEGREES)
    total = np.zeros((FRAMES, DEGREES, DEGREES))
    for dense, gradient in whole:
        without = np.linalg.solve(every - dense * used, slope - gradient * used)
        change = (np.linalg.solve(every, slope) - without).reshape(FRAMES, DEGREES)
        total += (count - 1) / count * change[:, :, None] * change[:, None]
    np.testing.assert_allclose(found, total[core], atol=1e-10)


def test_two_cameras_have_no_jackknife():
    system = BandedSystem.empty(1, DEGREES, 0)
    system.add_frame(0, np.eye(DEGREES), np.ones(DEGREES), DEGREES)
    part = (0.5 * np.eye(DEGREES), np.zeros(DEGREES))
    assert system.jackknife([(part, part)], np.ones(DEGREES), np.ones(DEGREES), slice(0, 1)).shape == (
        0,
        DEGREES,
        DEGREES,
    )

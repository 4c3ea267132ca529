import cv2
import numpy as np
import pytest
from scipy import stats
from tests.reference_matching import changed, grey_values, noise_effects, offsets, one_step
from tests.textures import MAP, Pair, make_pair

from marey.errors import SettingProblem
from marey.images.matching.matching import (
    MatchSettings,
    Outcome,
    match,
)
from marey.images.matching.splines import spline_of

GAIN, OFFSET = 0.9, 12.0


def splines(pair: Pair):
    return spline_of(pair.template), spline_of(pair.search)


def starts_about(truth, rng, reach=1.0):
    return truth + rng.uniform(-reach, reach, truth.shape)


def normalised_squares(errors, covariance):
    return np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariance), errors)


@pytest.fixture(scope="module")
def pair() -> Pair:
    return make_pair(np.random.default_rng(3), (300, 400), noise=1.0)


@pytest.fixture(scope="module")
def exact() -> Pair:
    return make_pair(np.random.default_rng(4), (160, 200), noise=0.0, kind=np.float32, shortest=9.0)


def test_derivatives_are_those_of_differences(pair, rng):
    template, _ = splines(pair)
    change, step = np.array([0.3, -0.2, 0.03, -0.02, 0.01, 0.04, 0.9, 5.0]), 1e-5
    _, derivative = grey_values(template, np.array([61.3, 47.8]), change, half=6)
    for k in range(8):
        ahead, behind = (
            grey_values(template, np.array([61.3, 47.8]), change + sign * step * np.eye(8)[k], half=6)[0]
            for sign in (1, -1)
        )
        difference = (ahead - behind) / (2 * step)
        np.testing.assert_allclose(derivative[:, k], difference, atol=1e-5 * np.abs(derivative[:, k]).max() + 1e-5)


@pytest.mark.parametrize("pixel", [[60.0, 50.0], [141.37, 88.81]])
@pytest.mark.parametrize("size", [5, 9, 13, 21, 37])
def test_a_step_of_the_kernel_is_that_of_the_plain_formula(pair, pixel, size):
    template, search = splines(pair)
    pixel, start = np.array(pixel), pair.carried(np.array(pixel)) + [0.4, -0.3]
    half, settings = size // 2, MatchSettings(size=size, steps=1, precision=9.0)
    found = match(template, search, pixel[None], start[None], settings=settings)
    expected, change, left = one_step(template, search, pixel, np.array([*start, 1, 0, 0, 1]), half=half)
    _, derivative = grey_values(template, pixel, np.array([0.0, 0, 0, 0, 0, 0, 1, 0]), half=half)
    residual, gain = np.sqrt(left @ left / (size**2 - 8)), change[6]
    noise, bias, _ = noise_effects(derivative, pixel, expected, residual=residual, stated=1.0, gain=gain, half=half)
    expected = changed(expected, bias)
    _, _, covariance = noise_effects(derivative, pixel, expected, residual=residual, stated=1.0, gain=gain, half=half)
    assert found.converged.all()
    np.testing.assert_allclose(found.pixels[0], expected[:2], atol=1e-4)
    np.testing.assert_allclose(found.search_from_template[0].ravel(), expected[2:], atol=1e-4)
    np.testing.assert_allclose(found.covariance[0], covariance, rtol=0.01, atol=0.01 * np.trace(covariance))
    np.testing.assert_allclose([found.gain[0], found.noise[0]], [gain, noise], rtol=0.005)


@pytest.mark.slow
def test_the_last_step_is_the_plain_formulas_last_step(pair):
    template, search = splines(pair)
    pixels = pair.grid(60)
    found = match(template, search, pixels, pair.carried(pixels), settings=MatchSettings(precision=1e-4))
    for i, pixel in enumerate(pixels):
        to_search = np.concatenate([pair.carried(pixel), [1, 0, 0, 1]])
        for _ in range(10):
            to_search, change, left = one_step(template, search, pixel, to_search, half=6)
        _, derivative = grey_values(template, pixel, np.array([0.0, 0, 0, 0, 0, 0, 1, 0]), half=6)
        residual = np.sqrt(left @ left / 161)
        _, bias, _ = noise_effects(derivative, pixel, to_search, residual=residual, stated=1.0, gain=change[6], half=6)
        np.testing.assert_allclose(found.pixels[i], changed(to_search, bias)[:2], atol=1e-4)
        grey, _ = grey_values(template, pixel, np.array([0, 0, 0, 0, 0, 0, *change[6:]]), half=6)
        assert found.correlation[i] == pytest.approx(np.corrcoef(grey, grey + left)[0, 1], abs=1e-4)


def test_without_noise_the_truth_is_found(exact, rng):
    template, search = splines(exact)
    pixels = exact.grid(7) + rng.uniform(-0.5, 0.5, exact.grid(7).shape)
    truth = exact.carried(pixels)
    found = match(template, search, pixels, starts_about(truth, rng), settings=MatchSettings(precision=1e-3))
    assert found.converged.all()
    # The remaining error is that of the spline for waves of nine pixels, a few thousandths of the contrast.
    np.testing.assert_allclose(found.pixels, truth, atol=0.004)
    np.testing.assert_allclose(found.search_from_template, np.broadcast_to(MAP, (len(pixels), 2, 2)), atol=0.004)
    np.testing.assert_allclose(found.gain, GAIN, atol=0.005)
    np.testing.assert_allclose(found.correlation, 1, atol=1e-4)


def test_truth_is_recovered_within_the_stated_covariance(pair, rng):
    template, search = splines(pair)
    pixels = pair.grid(13)
    truth = pair.carried(pixels)
    found = match(template, search, pixels, starts_about(truth, rng))
    assert found.converged.all()
    errors = found.pixels - truth
    squares = normalised_squares(errors, found.covariance)
    # Patches that do not overlap: each square is chi-squared with two degrees of freedom, or nearly so.
    assert squares.max() < stats.chi2.isf(0.001 / len(squares), 2) * 1.5
    assert np.sqrt((errors**2).sum(-1).mean()) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "contrast"), [(0.5, 30.0), (1.0, 30.0), (3.0, 30.0), (1.0, 10.0)])
def test_covariance_is_honest(noise, contrast):
    ratios, levels = [], []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        drawn = make_pair(rng, (300, 400), noise=noise, contrast=contrast)
        pixels = drawn.grid(13)
        pixels += rng.uniform(-0.5, 0.5, pixels.shape)
        truth = drawn.carried(pixels)
        found = match(*splines(drawn), pixels, starts_about(truth, rng, 0.5), settings=MatchSettings(noise=noise))
        assert found.converged.all()
        ratios.append(normalised_squares(found.pixels - truth, found.covariance) / 2)
        levels.append(found.noise)
    ratio = np.concatenate(ratios)
    # The mean of n such squares has the standard deviation 1 / sqrt(n); and if the noise is 10 % of the contrast, the
    # stated covariance is known to be 5 % too large.
    assert abs(ratio.mean() - 1) < 3 / np.sqrt(len(ratio)) + 0.05
    assert np.concatenate(levels).mean() == pytest.approx(np.sqrt(noise**2 + 1 / 12), rel=0.03)


def test_pictures_that_differ_make_no_noisy_gradients(rng):
    """Gloss: a smooth pattern that only the search image has; the covariance includes it, and the positions stay."""
    drawn = make_pair(rng, (300, 400), noise=0.3)
    y, x = np.indices(drawn.search.shape)
    gloss = spline_of(drawn.search + 12 * np.cos(0.7 * x + 0.2 * y))
    pixels = drawn.grid(13) + 0.25
    truth = drawn.carried(pixels)
    found = match(spline_of(drawn.template), gloss, pixels, truth, settings=MatchSettings(noise=0.3))
    errors = (found.pixels - truth)[found.converged]
    assert found.converged.mean() > 0.99
    assert np.median(found.noise[found.converged]) > 3
    assert (np.abs(errors.mean(0)) < 4 * errors.std(0) / np.sqrt(len(errors))).all()


def test_noise_draws_no_match_to_whole_pixels():
    """A bias of 0.025 px in each axis, without the correction."""
    errors = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        drawn = make_pair(rng, (300, 400), noise=1.0, contrast=10.0)
        pixels = drawn.grid(13) + 0.25
        truth = drawn.carried(pixels)
        errors.append(match(*splines(drawn), pixels, truth).pixels - truth)
    errors = np.concatenate(errors)
    assert (np.abs(errors.mean(0)) < 4 * errors.std(0) / np.sqrt(len(errors))).all()


def on_line(truth, rng, reach=1.0):
    """Lines through the truth, and starts somewhere on them."""
    angle = rng.uniform(0, np.pi, len(truth))
    along = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return along, truth + rng.uniform(-reach, reach, (len(truth), 1)) * along


def test_on_the_epipolar_line_the_same_is_found_as_free(exact, rng):
    template, search = splines(exact)
    pixels = exact.grid(9)
    along, starts = on_line(exact.carried(pixels), rng)
    settings = MatchSettings(precision=1e-3)
    free = match(template, search, pixels, starts, settings=settings)
    held = match(template, search, pixels, starts, along=3 * along, settings=settings)
    assert held.converged.all()
    np.testing.assert_allclose(held.pixels, free.pixels, atol=0.004)
    across = (held.pixels - starts)[:, 0] * along[:, 1] - (held.pixels - starts)[:, 1] * along[:, 0]
    np.testing.assert_allclose(across, 0, atol=1e-9)


def test_on_the_line_a_match_is_the_free_one_conditioned_on_the_line(pair, rng):
    template, search = splines(pair)
    pixels = pair.grid(13)
    truth = pair.carried(pixels)
    along, starts = on_line(truth, rng)
    settings = MatchSettings(precision=1e-3)
    free = match(template, search, pixels, starts, settings=settings)
    held = match(template, search, pixels, starts, along=along, settings=settings)
    across = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    # The point of the line that is most probable, given the free match: least squares with one condition.
    beside = np.einsum("ni,ni->n", across, truth - free.pixels)
    column = np.einsum("nij,nj->ni", free.covariance, across)
    expected = free.pixels + column * (beside / np.einsum("ni,ni->n", across, column))[:, None]
    sd = np.sqrt(np.einsum("ni,nij,nj->n", along, held.covariance, along))
    difference = np.linalg.norm(held.pixels - expected, axis=-1)
    assert np.sqrt(np.mean((difference / sd) ** 2)) < 0.1
    errors = np.einsum("ni,ni->n", along, held.pixels - truth) / sd
    assert abs(np.mean(errors**2) - 1) < 4 * np.sqrt(2 / len(errors)) + 0.1
    assert np.linalg.matrix_rank(held.covariance[0], tol=1e-12) == 1


def test_the_shift_alone_keeps_the_map(pair, rng):
    template, search = splines(pair)
    pixels = pair.grid(30)
    truth, maps = pair.carried(pixels), np.broadcast_to(MAP, (len(pair.grid(30)), 2, 2))
    settings = MatchSettings(shift_only=True)
    found = match(template, search, pixels, starts_about(truth, rng), maps=maps, settings=settings)
    assert found.converged.all()
    np.testing.assert_array_equal(found.search_from_template, maps)
    squares = normalised_squares(found.pixels - truth, found.covariance)
    assert abs(squares.mean() / 2 - 1) < 4 / np.sqrt(len(squares)) + 0.1


def test_threads_change_nothing(pair, rng):
    template, search = splines(pair)
    pixels = pair.grid(8)
    starts = starts_about(pair.carried(pixels), rng)
    one, two = (match(template, search, pixels, starts, threads=threads) for threads in (1, 2))
    np.testing.assert_array_equal(one.pixels, two.pixels)
    np.testing.assert_array_equal(one.outcome, two.outcome)


def outcome_of(template, search, pixel, start, **changes):
    found = match(spline_of(template), spline_of(search), np.array([pixel]), np.array([start]), **changes)
    assert np.isnan(found.pixels[~found.converged]).all()
    assert np.isnan(found.covariance[~found.converged]).all()
    return Outcome(found.outcome[0])


def test_a_patch_at_the_border_left_the_image(pair):
    inside = np.array([60.0, 60.0])
    assert outcome_of(pair.template, pair.search, [6.0, 60.0], inside) == Outcome.LEFT_PICTURE
    assert outcome_of(pair.template, pair.search, inside, [60.0, 304.0]) == Outcome.LEFT_PICTURE
    assert outcome_of(pair.template, pair.search, inside, [-1e9, 60.0]) == Outcome.LEFT_PICTURE
    assert outcome_of(pair.template, pair.search, inside, pair.carried(inside)) == Outcome.CONVERGED


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_a_flat_patch_is_textureless(pair, rng, noise):
    flat = 90 + rng.normal(0, noise, (80, 80))
    pixels = np.stack(np.meshgrid(np.arange(12, 68, 3.0), np.arange(12, 68, 3.0)), axis=-1).reshape(-1, 2)
    found = match(spline_of(flat), spline_of(pair.search), pixels, pixels)
    assert (found.outcome == Outcome.TEXTURELESS).all()


def test_a_straight_edge_is_textureless_unless_the_line_crosses_it():
    x = np.arange(80)
    edge = np.tile(120 + 60 * np.tanh((x - 40) / 2.0), (80, 1))
    along = {"across": [[1.0, 0.0]], "with the edge": [[0.0, 1.0]]}
    settings = MatchSettings(shift_only=True)
    assert outcome_of(edge, edge, [40.0, 40], [40.5, 40], settings=settings) == Outcome.TEXTURELESS
    for name, expected in (("across", Outcome.CONVERGED), ("with the edge", Outcome.TEXTURELESS)):
        line = np.array(along[name])
        assert outcome_of(edge, edge, [40.0, 40], [40.5, 40], along=line, settings=settings) == expected


def test_missing_pixels_and_starts_are_flagged_as_missing(pair):
    inside = np.array([60.0, 60.0])
    truth = pair.carried(inside)
    holed = pair.template.astype(np.float32)
    holed[63, 58] = np.nan
    assert outcome_of(holed, pair.search, inside, truth) == Outcome.MISSING
    assert outcome_of(holed, pair.search, inside + 30, pair.carried(inside + 30)) == Outcome.CONVERGED
    holed = pair.search.astype(np.float32)
    holed[tuple(np.round(truth[::-1]).astype(int))] = np.nan
    assert outcome_of(pair.template, holed, inside, truth) == Outcome.MISSING
    assert outcome_of(pair.template, pair.search, inside, [np.nan, 60]) == Outcome.MISSING
    assert outcome_of(pair.template, pair.search, [60, np.nan], truth) == Outcome.MISSING
    assert outcome_of(pair.template, pair.search, inside, truth, along=np.zeros((1, 2))) == Outcome.MISSING


def test_matches_that_move_too_far_or_fold_are_flagged(pair):
    inside = np.array([60.0, 60.0])
    truth = pair.carried(inside)
    near = MatchSettings(reach=0.5)
    assert outcome_of(pair.template, pair.search, inside, truth + [1, 0], settings=near) == Outcome.STRAYED
    mirrored = np.array([[[-1.0, 0], [0, 1]]])
    assert outcome_of(pair.template, pair.search, inside, truth, maps=mirrored) == Outcome.DEGENERATE
    hurried = MatchSettings(steps=1)
    assert outcome_of(pair.template, pair.search, inside, truth + [1, 0], settings=hurried) == Outcome.UNFINISHED


def test_a_flat_or_reversed_search_image_is_unlike(pair):
    inside = np.array([60.0, 60.0])
    assert outcome_of(pair.template, np.full((90, 90), 7.0), inside, inside) == Outcome.UNLIKE
    reversed_ = 255 - pair.template
    settings = MatchSettings(shift_only=True)
    assert outcome_of(pair.template, reversed_, inside, inside, settings=settings) == Outcome.UNLIKE


def test_unrelated_images_do_not_correlate(pair, rng):
    other = make_pair(rng, (300, 400), noise=1.0)
    pixels = pair.grid(13)
    found = match(spline_of(pair.template), spline_of(other.search), pixels, pixels)
    assert (~(found.correlation > 0.95)).all()


def test_no_patch_gives_no_match(pair):
    assert len(match(*splines(pair), np.zeros((0, 2)), np.zeros((0, 2)))) == 0


def test_impossible_settings_are_named_together():
    with pytest.raises(SettingProblem, match=r"size is 12.*steps is 0.*stretch is 0\.5.*reach is -1"):
        MatchSettings(size=12, steps=0, stretch=0.5, reach=-1.0)


def test_the_pixels_of_a_patch_go_row_by_row():
    np.testing.assert_array_equal(offsets(1)[:4], [[-1, -1], [0, -1], [1, -1], [-1, 0]])


@pytest.mark.slow
@pytest.mark.parametrize("other", ["left_5", "right_1"])
def test_real_speckle_is_found_where_an_independent_program_finds_it(shared, other):
    folder = shared / "data" / "surface" / "cylinder"
    if not folder.is_dir():
        pytest.skip("the cylinder is not among the recordings")
    template, search = (
        spline_of(cv2.imread(str(folder / f"{name}.jpg"), cv2.IMREAD_GRAYSCALE)) for name in ("left_1", other)
    )
    side, position = other.split("_")
    with np.load(folder / "reference.npz") as stored:
        reference = dict(stored)
    there = reference[f"points_{side}"][int(position) - 1]
    good = reference[f"mismatch_{side}"][int(position) - 1] < 0.05
    pixels = reference["points_left"][0]
    small = match(template, search, pixels, there)
    maps = np.where(small.converged[:, None, None], small.search_from_template, np.eye(2))
    found = match(template, search, pixels, there, maps=maps, settings=MatchSettings(size=31))
    assert found.converged[good].mean() > 0.99
    # The other program has errors of some hundredths of a pixel itself.
    assert np.sqrt(np.mean((found.pixels - there)[good & found.converged] ** 2)) < 0.1

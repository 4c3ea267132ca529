from dataclasses import replace

import numpy as np
import pytest

from marey.errors import MareyError
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from marey.knee.markers.marker_fit import CommonMarkers, fit_markers

PLACES = np.array([[-40.0, 0, 10], [35, -20, 20], [0, 40, 45], [20, 30, -5], [-25, -35, 50]])


def common(rng, *, count: int = 5, noise_mm: float = 0.0, motion: RigidTransform | None = None) -> CommonMarkers:
    motion = motion or RigidTransform.from_vector(rng.normal(size=3), rng.normal(0, 100, 3))
    places = PLACES[:count]
    return CommonMarkers(
        names=tuple(f"M{n}" for n in range(count)), from_mm=places, from_sd_mm=np.full(places.shape, 0.05),
        to_mm=motion.apply(places) + rng.normal(0, noise_mm, places.shape),
        to_sd_mm=np.full(places.shape, max(noise_mm, 0.05)),
    )  # fmt: skip


def shifted(markers: CommonMarkers, index: int, shift_mm: np.ndarray) -> CommonMarkers:
    places = np.array(markers.to_mm)
    places[index] += shift_mm
    return replace(markers, to_mm=places)


def test_exact_markers_give_the_transform_back(rng):
    motion = RigidTransform.from_vector(rng.normal(size=3), rng.normal(0, 100, 3))
    fit = fit_markers(common(rng, motion=motion))
    assert fit.rotation == pytest.approx(motion.rotation, abs=1e-12)
    assert fit.translation_mm == pytest.approx(motion.translation, abs=1e-10)
    assert fit.residual_mm < 1e-10
    assert fit.notes == ()


def test_the_gain_is_the_derivative_of_the_fit_by_the_markers_places(rng):
    markers = common(rng)
    fit, step = fit_markers(markers), 1e-4
    for m in range(5):
        for axis in range(3):
            ahead, behind = (fit_markers(shifted(markers, m, sign * step * np.eye(3)[axis])) for sign in (1, -1))
            turn = rotations.log(behind.rotation.T @ ahead.rotation) / (2 * step)
            place = (ahead.translation_mm - behind.translation_mm) / (2 * step)
            assert fit.gain[:, m, axis] == pytest.approx(np.concatenate([turn, place]), abs=1e-6)


@pytest.mark.slow
def test_the_covariance_and_the_raised_one_are_those_of_draws(rng):
    motion = RigidTransform.from_vector(rng.normal(size=3), rng.normal(0, 100, 3))
    errors, stated, raised = [], [], 0
    for _ in range(800):
        fit = fit_markers(common(rng, noise_mm=0.5, motion=motion, count=4))
        turn = rotations.log(fit.rotation.T @ motion.rotation)
        errors.append(np.concatenate([turn, motion.translation - fit.translation_mm]))
        stated.append(fit.covariance / fit.raised)
        raised += fit.raised > 1
    seen, stated_sd = np.sqrt(np.mean(np.square(errors), 0)), np.sqrt(np.diag(np.mean(stated, 0)))
    assert seen == pytest.approx(stated_sd, rel=4 / np.sqrt(2 * 800))
    # The deviations are raised where chance makes the residuals so large in one case of twenty.
    assert raised / 800 == pytest.approx(0.05, abs=4 * np.sqrt(0.05 * 0.95 / 800))


def test_a_better_known_marker_counts_more(rng):
    markers = common(rng, count=4)
    moved = shifted(markers, 3, np.array([1.0, 0, 0]))
    uncertain = replace(moved, to_sd_mm=np.array([[0.05] * 3] * 3 + [[5.0] * 3]))
    residual = np.linalg.norm(fit_markers(uncertain).residuals_mm, axis=1)
    assert residual[3] > 0.9
    assert residual[:3].max() < 0.01


def test_a_marker_put_back_elsewhere_is_left_out_and_named(rng):
    for moved in range(5):
        markers = shifted(common(rng, noise_mm=0.3), moved, np.array([6.0, -5, 4]))
        fit = fit_markers(markers)
        assert fit.used.tolist() == [m != moved for m in range(5)]
        assert any(note.startswith(f"M{moved} lies") for note in fit.notes)
        rest = fit_markers(markers.without(moved))
        assert fit.rotation == pytest.approx(rest.rotation, abs=1e-12)
        assert (fit.gain[:, moved] == 0).all()


def test_of_four_markers_one_of_two_that_may_have_moved_is_not_guessed(rng):
    # M0 turns about the line through M2 and M3: only its distance from M1 changes, as if M1 had turned the other way.
    markers = common(rng, count=4, motion=RigidTransform.identity())
    line = PLACES[3] - PLACES[2]
    turn = rotations.exp(np.radians(8) * line / np.linalg.norm(line))
    moved = np.array(markers.to_mm)
    moved[0] = PLACES[2] + turn @ (PLACES[0] - PLACES[2])
    fit = fit_markers(replace(markers, to_mm=moved, to_sd_mm=np.full((4, 3), 0.5)))
    assert fit.used.all()
    assert fit.raised > 1
    assert any("M0 or M1" in note for note in fit.notes)


def test_of_three_markers_the_moved_one_is_named_and_kept_with_raised_deviations(rng):
    apart = PLACES[2] - PLACES[:2].mean(0)
    motion = RigidTransform.identity()
    markers = shifted(common(rng, count=3, motion=motion), 2, 0.2 * apart)
    fit = fit_markers(markers)
    assert fit.used.all()
    assert fit.raised > 10
    assert any("M2 seems to have moved" in note for note in fit.notes)


def test_exchanged_names_are_reported(rng):
    markers = common(rng)
    order = [1, 0, 2, 3, 4]
    fit = fit_markers(replace(markers, to_mm=markers.to_mm[order]))
    assert any("with M0 and M1 exchanged, all markers would agree" in note for note in fit.notes)


@pytest.mark.parametrize("count", [0, 2])
def test_fewer_than_three_markers_are_an_error(rng, count):
    with pytest.raises(MareyError, match=f"{count} markers in common"):
        fit_markers(common(rng, count=count))


def test_three_markers_nearly_in_a_line_are_an_error_that_names_them(rng):
    markers = common(rng, count=3, noise_mm=0.5)
    line = np.array([[0.0, 0, 0], [30, 1, 0], [60, 0, 0]])
    with pytest.raises(MareyError, match=r"M0, M1, M2 lie so near to one line"):
        fit_markers(replace(markers, from_mm=line, to_mm=line))


def test_arrays_that_do_not_fit_the_names_are_an_error():
    with pytest.raises(MareyError, match="do not fit together"):
        CommonMarkers(names=("A",), from_mm=PLACES, from_sd_mm=PLACES, to_mm=PLACES, to_sd_mm=PLACES)

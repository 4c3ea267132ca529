import numpy as np
import pytest
from tests import made_walk

from marey.fit.clocks.signals import joint_signals, outermost_planes, outline_pixels, tangent_signals

PX = 1.5
"""A silhouette of whole pixels is up to half a pixel too small on each side, in both images."""


@pytest.fixture(scope="module")
def seen():
    cameras = made_walk.cameras()
    return cameras, made_walk.silhouettes(cameras, made_walk.clocks([0, 0, 0, 0]), frames=[12] * 4)


def test_tangents_of_silhouettes_of_one_instant_agree(seen):
    signals = tangent_signals(*seen)
    assert len(signals) == 12
    measured = 0
    for signal in signals:
        turn = np.angle(np.exp(1j * (signal.angles[0] - signal.angles[1])))
        known = np.isfinite(turn)
        measured += np.count_nonzero(known)
        assert (np.abs(turn) / np.hypot(*signal.radians_per_pixel))[known].max(initial=0) < PX
    assert measured > 90


def test_the_planes_of_several_outlines_are_those_of_each_alone(rng):
    counts = np.array([40, 1, 25, 30])
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    angle = np.repeat([0.3, -2.0, 3.1, 0.1], counts) + rng.uniform(-0.2, 0.2, counts.sum())
    lever, border, delays = np.ones(len(angle)), np.zeros(len(angle), bool), rng.uniform(0, 0.01, len(angle))
    # The third is cut at its end, and a pixel of the fourth is in no plane.
    border[65 - np.argmax(angle[41:66][::-1]) : 66], angle[70] = True, np.nan
    found = outermost_planes(angle, lever, border, delays, starts, per_pixel=1e-3)
    for k, (start, count) in enumerate(zip(starts, counts, strict=True)):
        own = [values[start : start + count] for values in (angle, lever, border, delays)]
        np.testing.assert_allclose(outermost_planes(*own, np.zeros(1, int), per_pixel=1e-3)[0], found[k], atol=1e-12)
    np.testing.assert_allclose(found[0, :, 0], [angle[:40].min(), angle[:40].max()], atol=1e-12)
    assert found[0, 0, 2] == delays[np.argmin(angle[:40])]
    assert np.isnan(found[2, 1]).all()
    assert np.isnan(found[3]).all()


def test_tangents_are_not_used_where_the_border_cuts_the_silhouette(seen):
    cameras, masks = seen
    cut = [[mask.copy() for mask in own] for own in masks]
    for mask in cut[0]:
        rows = np.flatnonzero(mask.any(1))
        mask[: (rows[0] + rows[-1]) // 2] = False
        shift = np.flatnonzero(mask.any(1))[0]
        mask[:] = np.roll(mask, -shift, axis=0)
    known = [np.isfinite(s.angles[0]).sum() for s in tangent_signals(cameras, cut) if s.cameras[0] == 0]
    before = [np.isfinite(s.angles[0]).sum() for s in tangent_signals(cameras, masks) if s.cameras[0] == 0]
    assert sum(known) < 0.7 * sum(before)


def test_an_empty_picture_has_no_tangent(seen):
    cameras, masks = seen
    nothing = [[np.zeros_like(mask) for mask in own] for own in masks]
    assert all(np.isnan(signal.angles[0]).all() for signal in tangent_signals(cameras, nothing))
    assert len(outline_pixels(nothing[0][0])) == 0


def test_small_regions_beside_a_silhouette_are_ignored(seen):
    mask = seen[1][0][0].copy()
    alone = outline_pixels(mask)
    mask[:6, :6] = True
    np.testing.assert_array_equal(outline_pixels(mask), alone)


def test_the_planes_of_a_joint_agree_and_missing_ones_stay_missing(seen, rng):
    cameras, _ = seen
    points = rng.normal(size=(9, 3, 3)) * 0.2 + [0, 0, 1]
    pixels = [camera.project(points) for camera in cameras]
    pixels[1][4, 2] = np.nan
    signals = joint_signals(cameras, pixels)
    assert len(signals) == 18
    for signal in signals:
        turn = np.angle(np.exp(1j * (signal.angles[0] - signal.angles[1])))
        np.testing.assert_allclose(turn[np.isfinite(turn)], 0, atol=1e-9)
    assert sum(np.isnan(signal.angles[0]).sum() + np.isnan(signal.angles[1]).sum() for signal in signals) == 3

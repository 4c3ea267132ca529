"""The cost of a pose: least for the true one, limited for what is far away, that of the priors; uncovered parts."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.fit.search.levels import SilhouetteLevel
from marey.fit.search.limb_moves import limb_chains, swung
from marey.fit.search.pose_cost import contradicted_frames, largest_uncovered, outline_cost, prior_cost
from marey.images.silhouettes.contours import trace_contour
from marey.observations.correspondence import view_of

SCALE, SIGMA = 2.0, 3.2


@pytest.fixture(scope="module")
def scene():
    body, cameras = worlds.scan(), worlds.ring()
    truth = PosedBody(body, worlds.pose(body))
    return truth, SilhouetteLevel.at_size(cameras, worlds.silhouettes(truth, cameras))


def cost(posed, level):
    return outline_cost(posed, level, scale=SCALE, sigma_px=SIGMA)


def test_the_cost_of_the_outlines_is_least_for_the_true_pose(scene):
    truth, level = scene
    # Drawn and observed outlines of the same body are the same pixels.
    assert cost(truth, level) == 0.0
    swing = swung(truth, limb_chains(truth.body.skeleton)[0], 1.5)
    assert cost(PosedBody(truth.body, swing), level) > 1.0


def traced_cost(posed, level):
    """The plain formula, by the distances of all pixels of two traced outlines."""
    total = 0.0
    for sighting in level.sightings:
        drawn = trace_contour(view_of(posed, sighting.camera).mask()).pixels
        apart = np.linalg.norm(drawn[:, None] - sighting.contour.pixels, axis=-1)
        square = np.concatenate([apart.min(axis=0), apart.min(axis=1)]) ** 2
        total += np.sum(SCALE**2 * square / (SCALE**2 + square))
    return 0.5 * total / SIGMA**2


@pytest.mark.parametrize("turn", [0.2, 1.0])
def test_the_cost_is_that_of_traced_outlines(scene, turn):
    truth, level = scene
    posed = PosedBody(truth.body, swung(truth, limb_chains(truth.body.skeleton)[0], turn))
    # Distances beyond five scales count as the limit, of which they miss 4 %.
    assert cost(posed, level) == pytest.approx(traced_cost(posed, level), rel=0.04)


def test_a_shift_costs_its_robust_square_and_no_pixel_more_than_the_limit(scene):
    truth, level = scene
    pixels = sum(len(sighting.contour.pixels) for sighting in level.sightings)
    change = np.zeros(len(truth.body.skeleton))
    costs = []
    for metres in (0.003, 0.3, 3.0):
        change[0] = metres
        costs.append(cost(truth.moved(change), level))
    # 3 mm are a quarter of a pixel here; far away, each pixel of either outline costs half the squared scale.
    limit = SCALE**2 / SIGMA**2
    assert costs[0] < 0.05 * costs[1] < costs[1]
    assert costs[1] < pixels * limit
    nothing = SilhouetteLevel.at_size(level.cameras, [np.zeros_like(mask) for mask in level.masks])
    assert cost(truth, nothing) == pytest.approx(0.5 * pixels * limit)


def test_the_priors_cost_half_their_sum_of_squares(scene):
    body = scene[0].body
    mean, sd = body.skeleton.habit
    usual = worlds.pose(body, {})
    posed = PosedBody(body, type(usual)(usual.translation, usual.rotation, mean + 0.5 * sd))
    # No limit lies within half a standard deviation of the mean.
    assert prior_cost(posed, habit=0.1) == pytest.approx(0.5 * 0.1 * 0.25 * len(mean))


def test_the_largest_part_beside_the_body_is_a_share_of_its_silhouette(scene):
    truth, level = scene
    assert largest_uncovered(truth, level, margin_px=0) == 0.0
    masks = [np.array(mask) for mask in level.masks]
    # Two separate parts in one image: the larger one counts.
    masks[1][:10, :12], masks[1][-4:, :5] = True, True
    found = largest_uncovered(truth, SilhouetteLevel.at_size(level.cameras, masks), margin_px=2)
    assert found == pytest.approx(120 / np.count_nonzero(masks[1]))


def test_the_margin_about_the_body_is_covered(scene):
    truth, level = scene
    body = [np.array(mask) for mask in level.masks]
    wide = [cv2.dilate(mask.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool) for mask in body]
    wider = SilhouetteLevel.at_size(level.cameras, wide)
    assert largest_uncovered(truth, wider, margin_px=2) == 0.0
    assert largest_uncovered(truth, wider, margin_px=1) > 0.0


def test_frames_with_an_arm_beside_the_body_are_found():
    body = worlds.scan()
    truth = dict(enumerate(worlds.swing(body, 13, first={**worlds.ARMS_AND_KNEES, "left_elbow_flexion": 80})))
    seen = worlds.levels([PosedBody(body, pose) for pose in truth.values()], worlds.ring())
    turn = np.isin(np.arange(len(truth[0].angles)), limb_chains(body.skeleton)[0].ball) * np.deg2rad(60)
    raised = {f: replace(p, angles=p.angles + turn) if f in range(4, 10) else p for f, p in truth.items()}
    # Every third frame is looked at.
    assert contradicted_frames(seen, body, raised, rate=worlds.RATE) == [6, 9]

import numpy as np
import pytest
from tests.made_balls import limb_grid, limb_with_balls, on_skin

from marey.knee.markers import ball_fit
from marey.knee.markers.ball_candidates import BallCandidate
from marey.knee.markers.ball_fit import BALL_FIT_DEFAULTS, fit_ball

GRID = limb_grid((0.7, 0.7, 1.2))
CENTRE = np.array(on_skin(2.0, 3.3, 3.0))


def start(off: float = 0.0, radius: float = 3.0) -> BallCandidate:
    return BallCandidate(centre_mm=CENTRE + off, radius_mm=radius, share=1.0)


def test_the_model_has_the_derivatives_that_it_states(rng):
    patch = ball_fit._patch(limb_with_balls(GRID, CENTRE, [3.0], "bright"), start(), (), settings=BALL_FIT_DEFAULTS)
    assert patch is not None
    numbers = np.array([0.2, -0.3, 0.1, 2.9, 0.4, 160, 5, 120, 2, -1, 0.5, 0.3, 0.9, -0.6, 0.4])
    _, jacobian = ball_fit._model(numbers, patch, derivatives=True)
    for n in range(len(numbers)):
        step = np.zeros(len(numbers))
        step[n] = 1e-5
        up, down = (ball_fit._model(numbers + sign * step, patch, derivatives=False)[0] for sign in (1, -1))
        np.testing.assert_allclose(jacobian[:, n], (up - down) / 2e-5, atol=2e-4)


@pytest.mark.parametrize("kind", ["dark", "bright"])
def test_a_ball_is_recovered_from_a_start_a_millimetre_off(kind):
    ball = fit_ball(limb_with_balls(GRID, CENTRE, [3.0], kind), start(0.6, 3.6))
    assert ball is not None
    assert np.linalg.norm(ball.centre_mm - CENTRE) < 0.06
    assert ball.radius_mm == pytest.approx(3.0, abs=0.06)
    assert ball.seen == 1.0


def test_a_ball_beyond_the_image_is_no_ball_and_one_at_its_end_is_seen_in_part():
    assert fit_ball(limb_with_balls(GRID, CENTRE, [3.0], "dark"), start(300.0)) is None
    end = np.array(on_skin(2.0, 0.0, 3.0)) + [0, 0, GRID.lps(np.array(GRID.shape[::-1]) - 1.0)[2]]
    ball = fit_ball(limb_with_balls(GRID, end, [3.0], "dark"), BallCandidate(centre_mm=end, radius_mm=3.0, share=1.0))
    assert ball is not None
    assert 0.55 < ball.seen < 0.75

from dataclasses import replace

import numpy as np
import pytest
from tests.people import stick_person

from marey.body.people.person import stature


def test_the_height_reaches_from_the_lowest_to_the_highest_point(rng):
    body = stick_person(rng)
    height, sd = stature(body)
    assert height == pytest.approx(np.ptp(body.vertices[:, 2]))
    assert np.isnan(sd)


def test_its_spread_is_that_of_the_numbers(rng):
    body = stick_person(rng)
    body = replace(body, numbers_covariance=np.eye(len(body.space)) * 1e-6)
    _, sd = stature(body)
    draws = [stature(body.with_numbers(body.numbers + rng.normal(size=len(body.space)) * 1e-3))[0] for _ in range(4000)]
    # A standard deviation from n draws is good to 1 / sqrt(2 n).
    assert sd == pytest.approx(np.std(draws), rel=4 / np.sqrt(2 * 4000))

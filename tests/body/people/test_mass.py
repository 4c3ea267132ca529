from dataclasses import replace

import numpy as np
import pytest
from tests import performer

from marey.body.people.mass import BODY_DENSITY, BODY_DENSITY_SD, CLOTHES_SD_M, estimated_mass


def test_boxes_have_the_mass_of_their_volume():
    person = performer.body()  # Every segment is a cube of 80 mm; the boxes overlap, and each counts.
    mass, sd = estimated_mass(person)
    count = len(person.skeleton.segment_names)
    volume, area = count * 0.08**3, count * 6 * 0.08**2
    assert mass == pytest.approx(BODY_DENSITY * volume, rel=1e-9)
    assert sd == pytest.approx(np.hypot(BODY_DENSITY * CLOTHES_SD_M * area, BODY_DENSITY_SD * volume), rel=1e-9)


def test_an_uncertain_shape_makes_the_mass_uncertain_as_the_volume_changes():
    plain = performer.body()
    outward = 0.01 * (plain.vertices - plain.joint_centres.repeat(8, axis=0))  # each box grows by 1 % of its size
    space = replace(
        plain.space, names=("size",), vertex_modes=outward[None], joint_modes=np.zeros((1, *plain.joint_centres.shape)),
        prior_mean=np.zeros(1), prior_covariance=np.eye(1),
    )  # fmt: skip
    person = replace(plain, space=space, numbers=np.zeros(1), numbers_covariance=np.array([[0.25]]))
    mass, sd = estimated_mass(person)
    _, other = estimated_mass(plain)
    assert sd**2 - other**2 == pytest.approx((0.5 * 3 * 0.01 * mass) ** 2, rel=1e-6)

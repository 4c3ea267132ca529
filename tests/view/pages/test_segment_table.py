"""The tables of segments: the numbers of the results, with their units and intervals."""

import numpy as np
import pytest

from marey.body.metaballs.segment_measures import SegmentMeasures
from marey.view.pages.segment_table import segment_tables

NAMES = ("left_thigh", "right_thigh", "head")


@pytest.fixture
def measures() -> SegmentMeasures:
    """Both thighs have one volume; the head has no girth, and nothing is known of the spread of its mass."""
    girth = np.array([[0.55, 0.5, 0.42], [0.56, 0.51, 0.43], [np.nan] * 3])
    centre = np.array([[0.01, -0.02, -0.18]] * 3)
    inertia = np.array([[0.11, 0.12, 0.02, 0.001, -0.003, -1e-6]] * 3)
    return SegmentMeasures(
        names=NAMES, girth=girth, girth_sd=0.01 * girth, volume=np.array([0.0081, 0.0081, 0.0045]),
        volume_sd=np.full(3, 1e-4), mass=np.array([8.5, 8.5, 5.0]), mass_sd=np.array([0.1, 0.1, np.nan]),
        centre=centre, centre_sd=np.full((3, 3), 0.001), inertia=inertia, inertia_sd=np.full((3, 6), 1e-3),
    )  # fmt: skip


def test_each_cell_is_the_value_with_its_95_percent_interval_in_the_unit_of_the_head(measures):
    sizes, masses = segment_tables(measures, np.array([0.412, 0.413, 0.25]), np.array([0.005, 0.005, np.nan]))
    row = dict(zip(sizes.head, sizes.rows[0], strict=True))
    assert row == {
        "segment": "left thigh", "length cm": "41.2 ± 1.0", "girth 1/4 cm": "55.0 ± 1.1", "girth 1/2 cm": "50.0 ± 1.0",
        "girth 3/4 cm": "42.0 ± 0.8", "volume l": "8.10 ± 0.20", "equal by the model to": "right thigh",
    }  # fmt: skip
    row = dict(zip(masses.head, masses.rows[0], strict=True))
    assert row["mass kg"] == "8.50 ± 0.20"
    assert [row[f"centre {axis} cm"] for axis in "xyz"] == ["1.0 ± 0.2", "−2.0 ± 0.2", "−18.0 ± 0.2"]
    assert row["Ixx kg cm²"] == "1100 ± 20"
    assert row["Ixz kg cm²"] == "−30 ± 20"
    # A value that is rounded to zero has no sign.
    assert row["Iyz kg cm²"] == "0 ± 20"


def test_what_is_not_defined_is_empty_and_an_unknown_interval_is_named(measures):
    sizes, masses = segment_tables(measures, np.array([0.412, 0.413, 0.25]), np.array([0.005, 0.005, np.nan]))
    assert sizes.rows[2] == ["head", "25.0 ± unknown", "", "", "", "4.50 ± 0.20", ""]
    assert masses.rows[2][1] == "5.00 ± unknown"

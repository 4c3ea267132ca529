"""The tables of segments: the numbers of the results, with their units and intervals."""

from dataclasses import replace

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
        whole_volume=0.0207, whole_volume_sd=2e-4, whole_mass=22.0, whole_mass_sd=0.5,
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


def test_a_girth_that_is_not_determined_is_marked_and_the_legend_states_why(measures):
    girth = measures.girth.copy()
    girth[0, 0] = np.nan
    length, length_sd = np.array([0.412, 0.413, 0.25]), np.full(3, 0.005)
    sizes, _ = segment_tables(replace(measures, girth=girth), length, length_sd)
    assert sizes.rows[0][2:4] == ["not determined", "50.0 ± 1.0"]
    assert sizes.rows[2][2] == ""
    assert "exceeds 6 % of the girth" in sizes.legend
    sizes, _ = segment_tables(measures, length, length_sd)
    assert "Not determined" not in sizes.legend


def test_the_last_row_is_the_sum_of_all_segments(measures):
    sizes, masses = segment_tables(measures, np.full(3, 0.4), np.full(3, 0.005))
    assert sizes.rows[-1] == ["all segments", "", "", "", "", "20.70 ± 0.39", ""]
    assert masses.rows[-1][:3] == ["all segments", "22.00 ± 0.98", ""]
    assert len(masses.rows[-1]) == len(masses.head)
    assert "lengths of both sides are equal by the model" in sizes.legend


def test_a_column_without_content_is_left_out(measures):
    sizes, _ = segment_tables(replace(measures, volume=np.array([0.0081, 0.0082, 0.0045])), *np.full((2, 3), 0.01))
    assert sizes.head[-1] == "volume l"
    assert {len(row) for row in sizes.rows} == {len(sizes.head)}


def test_a_small_interval_has_as_many_digits_as_it_needs(measures):
    inertia_sd = np.full((3, 6), 1.4e-6)
    _, masses = segment_tables(replace(measures, inertia_sd=inertia_sd), *np.full((2, 3), 0.01))
    row = dict(zip(masses.head, masses.rows[0], strict=True))
    assert row["Iyz kg cm²"] == "−0.01 ± 0.03"
    assert row["mass kg"] == "8.50 ± 0.20"

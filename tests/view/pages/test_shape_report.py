"""The page of recovered shapes."""

import base64
import json
import re
from dataclasses import replace

import numpy as np
import pytest

from marey.geometry import rotations
from marey.io.shapes.shapes import upright
from marey.nonrigid.recovered import GAUGES, IN_SPACE, ONE_VIEW, UNKNOWN_UNIT, RankCurve, RecoveredShapes
from marey.view.pages.shape_report import ShapeReport, shape_html

FRAMES, POINTS = 12, 5


@pytest.fixture
def report(rng) -> ShapeReport:
    """The last frame and the last point have no result."""
    basis = rng.normal(size=(2, 3, POINTS))
    basis[:, :, -1] = np.nan
    coefficients = np.stack([np.ones(FRAMES), np.sin(np.arange(FRAMES))], 1)
    coefficients[-1] = np.nan
    rotation = rotations.exp(0.1 * rng.normal(size=(FRAMES, 3)))
    rotation[-1] = np.nan
    translation = rng.normal(size=(FRAMES, 2)) + 300
    translation[-1] = np.nan
    shape = np.einsum("fk,kip->fip", coefficients, basis)
    modelled = (rotation @ shape)[:, :2] + translation[:, :, None]
    found = RecoveredShapes(
        kind=ONE_VIEW, shape=shape, shape_sd=0.1 * np.abs(shape), rotation=rotation,
        rotation_sd=np.where(np.isfinite(translation[:, :1]), 0.02, np.nan) * np.ones(3), translation=translation,
        basis=basis, coefficients=coefficients, residuals=np.abs(shape[None, :, 0]), modelled=modelled[None],
        predicted=np.zeros((FRAMES, POINTS), bool), noise_sd=np.array([0.1]), gauge=GAUGES[ONE_VIEW], unit="px",
        residual_unit="px",
        curve=RankCurve(ranks=np.array([1, 2, 6]), errors=np.array([3.0, 1.0, 2.0]), errors_sd=np.full(3, np.nan),
                        measure="error of what was held back"),
    )  # fmt: skip
    return ShapeReport(
        title="<face>", found=found, rate=25.0, labels=list("abcde"), lines=np.array([[0, 1], [1, 2]]), own_lines=True,
        upright=upright(found), views=("cam01",),
    )  # fmt: skip


def embedded(text: str) -> dict:
    return json.loads(re.search(r'<script id="data"[^>]*>(.*?)</script>', text, re.DOTALL)[1])


def numbers(packed: str, kind: str = "<f4") -> np.ndarray:
    return np.frombuffer(base64.b64decode(packed), kind)


def test_the_page_states_what_was_chosen_and_what_is_undetermined(report):
    page = shape_html(report)
    assert "http" not in page
    for text in (
        "&lt;face&gt;",
        "Sign of depth",
        "error of what was held back",
        "The lines come from the input",
        "of 12, 25 Hz",
    ):
        assert text in page


def test_the_replay_contains_the_shapes_upright_and_of_one_size(report):
    replay = embedded(shape_html(report))["shapes"]
    place = numbers(replay["place"]).reshape(FRAMES, POINTS, 3)
    found, turn = report.found, report.upright
    known = np.isfinite(place)
    np.testing.assert_array_equal(known, np.isfinite(np.moveaxis(found.shape, 1, 2)))
    wanted = np.moveaxis(turn @ found.shape, 1, 2)
    np.testing.assert_allclose(place[known] * (wanted[known] / place[known])[0], wanted[known], rtol=1e-5)
    assert np.nanmax(np.linalg.norm(place, axis=2)) < 1.2
    spin = numbers(replay["rotation"]).reshape(FRAMES, 3, 3)
    np.testing.assert_allclose(spin[0], turn @ found.rotation[0] @ turn.T, atol=1e-6)
    assert replay["lines"] == [[0, 1], [1, 2]]


def test_ranks_that_were_not_tried_lie_on_a_line_between_those_that_were(report):
    plot = embedded(shape_html(report))["groups"][0]["plots"][0]
    assert numbers(plot["axis"]).tolist() == [1, 2, 3, 4, 5, 6]
    np.testing.assert_allclose(numbers(plot["curves"][0]["values"]), [3, 1, 1.25, 1.5, 1.75, 2])


def test_long_recordings_are_thinned_out(report, monkeypatch):
    monkeypatch.setattr("marey.view.pages.shape_report._MOST_NUMBERS", 20)
    data = embedded(shape_html(report))
    assert data["stride"] == 3
    assert len(numbers(data["time"])) == 4


def test_lengths_are_in_millimetres_if_the_scale_is_known(report):
    page = shape_html(replace(report, found=replace(report.found, metres_per_unit=0.002)))
    assert "per unit of the input" in page
    assert re.search(r"± [\d.e+]+ mm", page)


def tiles(page: str) -> dict[str, tuple[str, str]]:
    found = re.findall(r'"label">(.*?)</span><span class="value">(.*?)</span><span class="below">(.*?)</span>', page)
    return {label: (value, below) for label, value, below in found}


def test_what_is_not_determined_stands_below_the_verdict(report):
    value, below = tiles(shape_html(report))["not determined"]
    assert (value, below.split(";")[0]) == ("scale", "and distance, sign of depth")
    scaled = replace(report, found=replace(report.found, metres_per_unit=0.002))
    assert tiles(shape_html(scaled))["not determined"][0] == "distance"
    in_space = replace(report, found=replace(report.found, gauge=GAUGES[IN_SPACE]))
    assert "not determined" not in tiles(shape_html(in_space))


def test_lengths_of_an_unknown_unit_are_in_input_units(report):
    page = shape_html(replace(report, found=replace(report.found, unit=UNKNOWN_UNIT, residual_unit=UNKNOWN_UNIT)))
    found = tiles(page)
    assert found["residual"][0].endswith(" input units")
    assert found["shape"][0].endswith(" input units")
    assert "residuals [unit of the input]" in page
    assert "Lengths without a unit are in input units." in page
    assert page.count(" input units") < 10


def test_the_legend_of_the_replay_names_the_vertical(report):
    assert "The vertical is that of the image." in shape_html(report)
    in_space = replace(report.found, kind=IN_SPACE, gauge=GAUGES[IN_SPACE])
    assert "The vertical is that of the laboratory." in shape_html(replace(report, found=in_space))


def test_the_chosen_number_is_marked_and_it_is_stated_if_fewer_would_do(report):
    page = shape_html(report)
    assert embedded(page)["groups"][0]["plots"][0]["marks"][0]["at"] == 2
    assert "1, 2, 6 were tested, and the dashed line marks the chosen number." in page
    assert "the number is not certain" not in page
    curve = RankCurve(
        ranks=np.array([1, 2, 6]), errors=np.array([3.0, 1.0, 0.95]), errors_sd=np.full(3, np.nan), measure="error"
    )
    basis = np.concatenate([report.found.basis, np.zeros((4, 3, POINTS))])
    coefficients = np.concatenate([report.found.coefficients, np.zeros((FRAMES, 4))], axis=1)
    more = replace(report, found=replace(report.found, curve=curve, basis=basis, coefficients=coefficients))
    page = shape_html(more)
    assert "2 basis shapes already give 95 % of the decrease or more, so that the number is not certain." in page

import numpy as np
import pytest

from marey.view.pictures.plots import Line, draw_lines

matplotlib = pytest.importorskip("matplotlib")
matplotlib.use("Agg")

TIME = np.arange(3.0)


@pytest.mark.slow
def test_lines_of_one_plot_have_a_legend_and_the_unit_on_the_axis():
    lines = [Line(label=name, time=TIME, values=TIME) for name in ("left knee", "right knee")]
    axes = draw_lines(lines, unit="deg")
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["left knee", "right knee"]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("time (s)", "deg")
    assert len(axes.collections) == 0


def test_a_band_has_gaps_where_its_limits_are_not_known():
    low, high = np.array([0.0, np.nan, 1.0]), np.array([1.0, np.nan, 2.0])
    axes = draw_lines([Line(label="knee", time=TIME, values=TIME, low=low, high=high)])
    assert np.isfinite(axes.collections[0].get_paths()[0].vertices).all()

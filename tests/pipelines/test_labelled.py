import importlib

import numpy as np
import pytest

from marey.errors import MareyError, MissingPackage
from marey.pipelines.labelled import Curve, Curves, Summary, UnknownName, find_name

NAMES = ("left_knee_flexion", "right_knee_flexion", "left_hip_flexion", "pelvis_tilt")


def curve(**more) -> Curve:
    given = {
        "name": "left_knee_flexion", "time": np.arange(4) / 10, "values": [1.0, 3.0, 2.0, np.nan],
        "sd": [0.5, 0.5, 1.0, np.nan], "unit": "deg", "flags": ("", "", "filled", "lost"),
    }  # fmt: skip
    return Curve(**given | more)


def point() -> Curve:
    values = np.arange(12.0).reshape(4, 3)
    return curve(name="neck", values=values, sd=None, unit="m", components=("x", "y", "z"))


def test_a_curve_is_used_like_an_array():
    found = curve()
    assert np.asarray(found).tolist()[:3] == [1.0, 3.0, 2.0]
    assert np.nanmax(found) == 3.0
    assert found[1] == 3.0
    assert len(found) == 4
    assert np.subtract(found, 1.0)[1] == 2.0
    with pytest.raises(ValueError, match="read-only"):
        np.asarray(found)[0] = 7.0


def test_a_part_of_a_curve_keeps_its_labels():
    part = curve()[1:3]
    assert (part.name, part.unit, part.flags) == ("left_knee_flexion", "deg", ("", "filled"))
    assert part.time.tolist() == [0.1, 0.2]
    assert part.sd.tolist() == [0.5, 1.0]
    assert curve()[[True, False, False, True]].time.tolist() == [0.0, pytest.approx(0.3)]


def test_the_interval_is_that_of_a_normal_distribution():
    low, high = curve().interval(0.95)
    np.testing.assert_allclose(high - low, 2 * 1.959964 * curve().sd, rtol=1e-6)
    with pytest.raises(MareyError, match="not known"):
        point().interval()
    with pytest.raises(MareyError, match="between 0 and 1"):
        curve().interval(95)


def test_values_with_a_flag_do_not_count_as_measured():
    assert curve().measured.tolist() == [True, True, False, False]


def test_a_curve_describes_itself():
    expected = "left knee flexion [deg]: 4 frames, 0 to 0.3 s; 1 to 3, median standard deviation 0.5; 1 filled; 1 lost"
    assert repr(curve()) == expected
    assert repr(curve(values=[np.nan] * 4)) == "left knee flexion [deg]: 4 frames, 0 to 0.3 s; no values"


def test_a_component_is_a_curve():
    assert np.asarray(point().component("Z")).tolist() == [2.0, 5.0, 8.0, 11.0]
    assert point().component("x").name == "neck_x"


@pytest.mark.parametrize("wrong", [{"values": [1.0]}, {"sd": [1.0]}, {"flags": ("lost",)}])
def test_arrays_that_do_not_fit_are_rejected(wrong):
    with pytest.raises(MareyError, match="left_knee_flexion"):
        curve(**wrong)


@pytest.mark.parametrize("name", ["left_knee_flexion", "left knee flexion", "Left Knee-Flexion"])
def test_a_name_is_found_however_it_is_written(name):
    assert find_name(name, NAMES, kind="angle") == 0


def test_an_unknown_name_lists_the_most_similar_ones():
    curves = Curves("angle", NAMES, lambda i: curve(name=NAMES[i]))
    with pytest.raises(UnknownName) as caught:
        curves["left knee flexing"]
    assert str(caught.value).startswith("There is no angle 'left knee flexing'. Did you mean: left knee flexion,")
    assert isinstance(caught.value, KeyError)
    assert curves.get("qqq") is None
    with pytest.raises(UnknownName, match="There are 4 angles"):
        curves["qqq"]


def test_curves_are_a_mapping_by_name():
    curves = Curves("angle", NAMES, lambda i: curve(name=NAMES[i]))
    assert list(curves) == list(NAMES)
    assert "right knee flexion" in curves
    assert [each.name for each in curves.matching("knee")] == list(NAMES[:2])
    assert [each.name for each in curves.matching([NAMES[3], NAMES[0]])] == [NAMES[3], NAMES[0]]
    with pytest.raises(UnknownName):
        curves.matching(["qqq"])
    assert repr(curves).startswith("4 angles: left knee flexion, right knee flexion,")


def test_a_summary_is_text_and_html():
    summary = Summary("A <trial>", {"frames": "4", "rate": "10 Hz"})
    assert str(summary) == "A <trial>\n  frames  4\n  rate    10 Hz"
    assert "<b>A &lt;trial&gt;</b>" in summary.html()


def test_a_curve_becomes_an_xarray():
    pytest.importorskip("xarray")
    array = curve().to_xarray()
    assert array.attrs["units"] == "deg"
    assert float(array.sel(time=0.1)) == 3.0
    assert array.coords["flag"].values.tolist() == ["", "", "filled", "lost"]
    assert point().to_xarray().sel(component="y").shape == (4,)


def test_a_curve_draws_its_interval():
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    axes = curve().plot()
    assert axes.get_ylabel() == "left knee flexion (deg)"
    assert len(axes.collections) == 1
    assert len(point().plot(axes=axes).lines) == 4


def test_a_missing_package_is_named_with_the_command_that_installs_it(monkeypatch):
    def missing(name, *more):
        raise ModuleNotFoundError(f"No module named {name!r}")

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(MissingPackage, match="pip install"):
        curve().to_xarray()

"""A scanned knee whose balls do not correspond to the laboratory: cause, figures, record and page."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.made_animations import MadeActivity, made_activity

from marey.io.markers.c3d import write_c3d
from marey.io.markers.readers import read_markers
from marey.io.opensim.trc import PointPaths
from marey.pipelines.knee.animate import animate_knee
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.verdict import NotUsable, VerdictReason


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> MadeActivity:
    return made_activity(tmp_path_factory.mktemp("causes"), fine=2)


@pytest.fixture
def cause(made: MadeActivity, tmp_path: Path) -> Callable[..., VerdictReason]:
    """The gravest reason why a knee cannot be moved."""

    def of(knee: Path | None = None, motion: Path | None = None, **options: Any) -> VerdictReason:
        options = {"reference": made.standing} | options
        with pytest.raises(NotUsable) as problem:
            animate_knee(
                knee or made.knee, motion or made.motion, out=tmp_path / "out", progress=RecordingProgress(), **options
            )  # fmt: skip
        [reason] = problem.value.verdict.reasons
        record = json.loads((tmp_path / "out" / "run.json").read_text(encoding="utf-8"))
        assert record["verdict"]["level"] == "not usable"
        assert record["verdict"]["reasons"][0]["cause"] == reason.cause
        assert problem.value.report == tmp_path / "out" / "knee.html"
        assert reason.what in problem.value.report.read_text(encoding="utf-8").replace("&#39;", "'")
        assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["knee.html", "run.json"]
        return reason

    return of


@pytest.fixture
def knee_with(made: MadeActivity, tmp_path: Path) -> Callable[[Callable[[dict[str, Any]], dict[str, Any]]], Path]:
    """The knee with other entries of markers.json."""

    def changed(change: Callable[[dict[str, Any]], dict[str, Any]]) -> Path:
        shutil.copytree(made.knee, tmp_path / "knee")
        table = json.loads((made.knee / "markers.json").read_text(encoding="utf-8"))
        (tmp_path / "knee" / "markers.json").write_text(json.dumps(table | change(table)), encoding="utf-8")
        return tmp_path / "knee"

    return changed


def centres(table: dict[str, Any], factor: object) -> dict[str, Any]:
    return {"marker_centres_lps_mm": (np.array(table["marker_centres_lps_mm"]) * factor).tolist()}


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "before"), [(0.1, "41 mm"), (1000.0, "46 m")])
def test_a_wrong_unit_of_the_balls_is_the_cause(cause, knee_with, factor, before):
    reason = cause(knee_with(lambda table: centres(table, factor)))
    assert reason.cause == "unit"
    assert f"multiplied by {1 / factor:g}, the balls lie 0.0 mm" in reason.what
    assert f"instead of {before} (RMS)" in reason.what


@pytest.mark.slow
def test_a_mirror_image_is_the_cause(cause, knee_with):
    reason = cause(knee_with(lambda table: centres(table, [-1, 1, 1])))
    assert (reason.cause, "instead of 10 mm" in reason.what) == ("mirrored", True)


@pytest.mark.slow
def test_exchanged_names_are_the_cause(cause, knee_with):
    reason = cause(knee_with(lambda table: {"marker_names": ["MR1", "MR0", *table["marker_names"][2:]]}))
    assert reason.cause == "exchanged"
    assert "MR0" in reason.what
    assert "MR1" in reason.what


@pytest.mark.slow
def test_names_that_nothing_explains_leave_results_that_are_not_usable(made, knee_with):
    def turned(table: dict[str, Any]) -> dict[str, Any]:
        return {"marker_names": [*table["marker_names"][3:], *table["marker_names"][:3]]}

    moving = animate_knee(
        knee_with(turned), made.motion, reference=made.standing, views=("plateau",), progress=RecordingProgress()
    )  # fmt: skip
    first = moving.verdict.reasons[0]
    assert (first.level, first.cause) == ("not usable", "unexplained")
    assert "no unit, mirror image, side or exchange of two names explains it" in first.what


@pytest.mark.parametrize(("signs", "kind"), [((0.1, 0.1, 0.1), "unit"), ((1, -1, 1), "mirrored")])
def test_a_reference_that_contradicts_the_activity_is_the_cause(cause, made, tmp_path, signs, kind):
    stood = read_markers(made.standing)
    points = PointPaths(names=stood.labels, time=np.arange(5) / 50, rate=50.0, points=stood.points * signs)
    write_c3d(tmp_path / "wrong.c3d", points)
    reason = cause(reference=tmp_path / "wrong.c3d")
    assert reason.cause == kind
    assert "wrong.c3d" in reason.what
    assert "the activity" in reason.what


@pytest.mark.slow
def test_the_motion_of_the_other_leg_is_told_from_a_mirror_image(cause, made, tmp_path):
    other = made_activity(tmp_path / "left", left=True, sided=True, fine=2)
    reason = cause(motion=other.motion, reference=other.standing)
    assert reason.cause == "sides"
    assert "has the bones of the left leg, but the scanned knee is a right one" in reason.what
    assert "0.0 mm from the markers of the laboratory (RMS) as they are, and 10 mm as a mirror image" in reason.what
    # The whole scan mirrored: the patella is on the other side, and the balls fit mirrored only.
    own = made_activity(tmp_path / "right", sided=True, fine=2)
    table = json.loads((own.knee / "markers.json").read_text(encoding="utf-8"))
    for path in other.knee.glob("*.ply"):
        shutil.copy(path, own.knee / path.name)
    (own.knee / "markers.json").write_text(json.dumps(table | centres(table, [-1, 1, 1])), encoding="utf-8")
    reason = cause(own.knee, own.motion, reference=own.standing)
    assert reason.cause == "mirrored"
    assert "with the scan mirrored, the balls lie 0.0 mm" in reason.what

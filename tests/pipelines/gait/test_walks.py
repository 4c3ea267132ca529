import csv
import json
from pathlib import Path

import numpy as np
import pytest
from tests import made_steps

import marey
from marey.errors import FileProblem, SettingProblem
from marey.io.results.gait import write_cycle_csv
from marey.motion.events.detection import find_events
from marey.pipelines.gait.files import write_gait
from marey.pipelines.gait.walk import gait_from

NAMES = ("pelvis_rotation_deg", "left_knee_flexion_deg", "right_knee_flexion_deg", "left_knee_distraction_mm")
ARC = np.sin(np.linspace(0, 2 * np.pi, 101))


def measured(folder: Path, *offsets: float, command: str = "markers", reasons: tuple[str, ...] = ()) -> Path:
    """Write the results of a walk, whose curves differ from those of others by constants."""
    folder.mkdir(parents=True)
    walk = made_steps.made_walk()
    write_gait(folder, gait_from(walk, find_events(walk)), None)
    mean = ARC[:, None] + np.array(offsets)
    write_cycle_csv(folder / "cycles.csv", NAMES, mean, np.ones(mean.shape))
    verdict = {"level": reasons[0] if reasons else "good", "reasons": [
        {"level": reasons[0], "what": reasons[1], "remedy": "", "cameras": []}
    ] if reasons else []}  # fmt: skip
    record = {"command": command, "verdict": verdict, "files": ["cycles.csv", "events.csv", "run.json"]}
    (folder / "run.json").write_text(json.dumps(record))
    return folder


def references(folder: Path) -> Path:
    for number, offset in enumerate((-2.0, 0.0, 2.0)):
        measured(folder / f"r{number}", 90.0 * number, offset, offset, 5.0)
    return folder


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_walk_beside_references_has_its_profile_on_the_page_and_as_a_table(tmp_path):
    walk = measured(tmp_path / "walk01" / "marey", 10.0, 6.0, 0.0, 5.0)
    gait = marey.compare_gait(tmp_path / "walk01", references(tmp_path / "norm"))
    out = gait.save(tmp_path / "out")
    assert {path.name for path in out.iterdir()} == {
        "report.html", "gait_parameters.csv", "gait_profile.csv", "run.json",
    }  # fmt: skip
    profile = marey.gait_profile(walk, tmp_path / "norm")
    assert gait.profiles["walk01"].scores == profile.scores
    scores = {(row["angle"], row["side"]): row for row in rows_of(out / "gait_profile.csv")}
    assert float(scores["knee_flexion", "left"]["score_deg"]) == pytest.approx(6.0, abs=1e-4)
    assert float(scores["pelvis_rotation", "both"]["score_deg"]) == pytest.approx(0.0, abs=1e-4)
    page = (out / "report.html").read_text()
    assert 'id="profile"' in page
    assert "Verdict" in page
    assert gait.verdict.level == "good"
    parameters = rows_of(out / "gait_parameters.csv")
    length = next(row for row in parameters if (row["quantity"], row["side"]) == ("stride_length", "left"))
    assert float(length["value"]) == pytest.approx(made_steps.STRIDE_M, abs=1e-4)
    assert float(length["references_mean"]) == pytest.approx(made_steps.STRIDE_M, abs=1e-4)
    assert "walk01" in str(gait)
    assert "3 reference walks" in str(gait)


def test_bands_are_means_and_spreads_over_walks_and_sides(tmp_path):
    measured(tmp_path / "walk", 0.0, 0.0, 0.0, 0.0)
    gait = marey.compare_gait(tmp_path / "walk", references(tmp_path / "norm"))
    band = gait.bands["knee_flexion_deg"]
    np.testing.assert_allclose(band[:, 0], ARC, atol=1e-5)
    np.testing.assert_allclose(band[:, 1], np.std([-2, -2, 0, 0, 2, 2], ddof=1), atol=1e-5)
    assert "knee_distraction_mm" in gait.bands


def test_walks_are_compared_without_references_and_named_by_their_paths_if_equal(tmp_path):
    first, second = (measured(tmp_path / day / "walk", 0.0, 1.0, 2.0, 0.0) for day in ("monday", "tuesday"))
    gait = marey.compare_gait([first, second])
    assert list(gait.walks) == [str(first), str(second)]
    out = gait.save(tmp_path / "out")
    assert not (out / "gait_profile.csv").exists()
    page = (out / "report.html").read_text()
    assert "second − first" in page
    assert 'id="profile"' not in page


@pytest.mark.slow
def test_what_limits_a_walk_limits_the_comparison(tmp_path):
    known = references(tmp_path / "norm")
    weak = measured(tmp_path / "weak", 0.0, 0.0, 0.0, 0.0, reasons=("usable with limits", "A camera was left out."))
    assert marey.compare_gait(weak, known).verdict.level == "usable with limits"
    failed = measured(tmp_path / "failed", 0.0, 0.0, 0.0, 0.0, reasons=("not usable", "Nothing agrees."))
    assert "Nothing agrees" in str(marey.compare_gait(failed, known).verdict)
    assert not marey.compare_gait(failed, known).verdict.usable
    other = measured(tmp_path / "other", 0.0, 0.0, 0.0, 0.0, command="capture")
    assert [reason.cause for reason in marey.compare_gait(other, known).verdict.reasons] == ["measured apart"]
    measured(known / "bad", 0.0, 0.0, 0.0, 0.0, reasons=("not usable", "Nothing agrees."))
    sound = measured(tmp_path / "sound", 0.0, 0.0, 0.0, 0.0)
    assert [reason.cause for reason in marey.compare_gait(sound, known).verdict.reasons] == ["references"]


def test_what_cannot_be_compared_is_named(tmp_path):
    walk = measured(tmp_path / "walk", 0.0, 0.0, 0.0, 0.0)
    with pytest.raises(SettingProblem, match="nothing to compare"):
        marey.compare_gait(walk)
    with pytest.raises(SettingProblem, match="given twice"):
        marey.compare_gait([walk, tmp_path / "." / "walk"])
    with pytest.raises(FileProblem, match=r"nowhere.*not a folder"):
        marey.compare_gait([walk, tmp_path / "nowhere"])
    with pytest.raises(FileProblem, match=r"has no cycles\.csv"):
        marey.compare_gait([walk, tmp_path])
    (walk / "events.csv").unlink()
    with pytest.raises(FileProblem, match=r"no events\.csv"):
        marey.compare_gait(walk, references(tmp_path / "norm"))

from pathlib import Path

import numpy as np
import pytest

from marey.errors import FileProblem, SettingProblem
from marey.io.results.gait import write_cycle_csv
from marey.pipelines.gait.profile import gait_profile

NAMES = ("pelvis_rotation_deg", "left_knee_flexion_deg", "right_knee_flexion_deg", "thorax_tilt_deg")
ARC = np.sin(np.linspace(0, 2 * np.pi, 101))


def walk(folder: Path, offsets: tuple[float, float, float, float], names: tuple[str, ...] = NAMES) -> Path:
    """Curves that differ from each other by constants."""
    folder.mkdir(parents=True)
    mean = ARC[:, None] + np.array(offsets)[: len(names)]
    write_cycle_csv(folder / "cycles.csv", names, mean, np.full(mean.shape, np.nan))
    return folder


def test_scores_are_root_mean_square_differences_from_the_mean_of_the_references(tmp_path):
    own = walk(tmp_path / "walk", (90.0, 5.0, 1.0, 40.0))
    walk(tmp_path / "norm" / "a", (10.0, -1.0, 0.0, 0.0))
    walk(tmp_path / "norm" / "deeper" / "b", (-70.0, 1.0, 0.0, 0.0))
    profile = gait_profile(own, tmp_path / "norm")
    left = profile.score("knee flexion", "left")
    assert left.score_deg == pytest.approx(5.0, abs=1e-4)
    assert left.reference_deg == pytest.approx(2.0, abs=1e-4)  # each of the two from the other
    assert profile.score("knee_flexion", "right").score_deg == pytest.approx(1.0, abs=1e-4)
    assert profile.score("pelvis rotation").score_deg == pytest.approx(
        0.0, abs=1e-4
    )  # the direction of walking is none
    assert profile.score(side="left").score_deg == pytest.approx(np.sqrt(25 / 2), abs=1e-4)
    assert profile.score().score_deg == pytest.approx(np.sqrt(26 / 3), abs=1e-4)  # thorax is no part
    assert [path.name for path in profile.references] == ["a", "b"]
    with pytest.raises(SettingProblem, match="no score of 'elbow'"):
        profile.score("elbow")


def test_a_walk_in_the_folder_of_references_is_not_its_own_reference(tmp_path):
    own = walk(tmp_path / "a", (0.0, 5.0, 0.0, 0.0))
    walk(tmp_path / "b", (0.0, 0.0, 0.0, 0.0))
    walk(tmp_path / "c", (0.0, 0.0, 0.0, 0.0))
    assert gait_profile(own, tmp_path).score("knee flexion", "left").score_deg == pytest.approx(5.0, abs=1e-4)


def test_what_is_missing_or_damaged_is_named(tmp_path):
    own = walk(tmp_path / "walk", (0.0, 0.0, 0.0, 0.0))
    with pytest.raises(FileProblem, match="is not a folder"):
        gait_profile(own, tmp_path / "nowhere")
    (tmp_path / "norm").mkdir()
    with pytest.raises(FileProblem, match="results of 0 reference walks"):
        gait_profile(own, tmp_path / "norm")
    walk(tmp_path / "norm" / "a", (0.0, 0.0, 0.0, 0.0))
    with pytest.raises(FileProblem, match="results of 1 reference walks"):
        gait_profile(own, tmp_path / "norm")
    walk(tmp_path / "norm" / "b", (0.0, 0.0, 0.0, 0.0), names=("thorax_tilt_deg",))
    with pytest.raises(SettingProblem, match="no angle"):
        gait_profile(own, tmp_path / "norm")
    with pytest.raises(FileProblem, match=r"has no cycles\.csv"):
        gait_profile(tmp_path, tmp_path / "norm")
    (own / "cycles.csv").write_text("cycle_percent,left_knee_flexion_deg_mean\n0,1\n")
    with pytest.raises(FileProblem, match="101 rows"):
        gait_profile(own, tmp_path / "norm")

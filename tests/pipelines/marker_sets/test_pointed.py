"""Clusters whose landmarks a pointer shows, from their files to joint angles."""

from pathlib import Path

import numpy as np
import pytest
from tests.marker_set_trials import cast, person, standing, walking, write_measured

from marey.errors import MareyError
from marey.geometry import rotations
from marey.pipelines.markers.bones import Bones
from marey.pipelines.markers.estimate import estimate_bones, open_markers
from marey.pipelines.progress import RecordingProgress

SHOWN = {f"{side}_{name}": f"{side[0].upper()}{label}" for side in ("left", "right")
         for name, label in (("LE", "KNE"), ("ME", "KNM"), ("LM", "ANK"), ("MM", "MED"))}  # fmt: skip
"""Landmarks that the pointer shows, and the labels of the true places."""
SIZES = {"leg_length_mm": 860, "marker_diameter_mm": 14}
TIP_MM = 120.0
BODY = np.array([[0.0, 0.0, 0.2], [0.05, 0.0, 0.25], [-0.03, 0.04, 0.3], [0.0, 0.0, 0.35]])
"""Markers of the pointer, whose tip is the origin."""


def pointing(tip: np.ndarray, *, swing: float = 10.0) -> dict[str, np.ndarray]:
    """Labels of a pointer's markers with paths (F, 3) [m]: W1 and W2 on a line with the tip, B1 to B4 on a body."""
    time = np.arange(len(tip)) / len(tip)
    vectors = np.radians(swing) * np.stack([np.sin(9 * time), np.sin(14 * time + 1), 0 * time], 1)
    rotation = rotations.exp(vectors)
    line = {"W1": [0, 0, 2e-3 * TIP_MM], "W2": [0, 0, 1e-3 * TIP_MM]}
    places = {**line, **{f"B{k}": place for k, place in enumerate(BODY, 1)}}
    return {label: tip + rotation @ np.array(place) for label, place in places.items()}


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    write_measured(tmp_path / "walk.c3d", cast(person(walking(), speed=1.0), static=False), {})
    still = person(standing())
    write_measured(tmp_path / "static.c3d", cast(still, static=False), {})
    # The person sways while the examiner points.
    sways = {joint: 0.05 * angles[:40] for joint, angles in walking().items()}
    pointed = person(sways)
    for name, label in SHOWN.items():
        write_measured(tmp_path / f"{name}.c3d", cast(pointed, static=False) | pointing(pointed[label]), {})
    fixed = np.broadcast_to([0.3, 0.2, 0.0], (80, 3))
    write_measured(tmp_path / "pivot.c3d", pointing(fixed, swing=30.0), {})
    described("line.toml", 'markers = ["W1", "W2"]', f"tip_mm = {TIP_MM}")
    described("pivot.toml", 'markers = ["B1", "B2", "B3", "B4"]', 'pivot = "pivot.c3d"')
    return tmp_path


def described(name: str, *lines: str, trials: dict[str, str] | None = None, before: str = "") -> None:
    """Write a TOML with the pointer and its trials."""
    files = {landmark: f"{landmark}.c3d" for landmark in SHOWN} if trials is None else trials
    rows = [f'{landmark} = "{file}"' for landmark, file in files.items()]
    Path(name).write_text("\n".join([before, "[pointer]", *lines, "[pointer.trials]", *rows, ""]))


def bones(clusters: str, **options) -> Bones:
    settings = {"static": "static.c3d", "measurements": SIZES, **options}
    opened = open_markers("walk.c3d", clusters=clusters, **settings)
    return estimate_bones(opened, "rigid", progress=RecordingProgress())


def require_true(found: Bones) -> None:
    """A C3D keeps single precision: micrometres at a metre, and 0.01 degrees over clusters of centimetres."""
    for side in ("left", "right"):
        for joint in ("hip", "knee"):
            for k, word in enumerate(("flexion", "adduction", "rotation")):
                true = np.degrees(walking()[joint][:, k])
                np.testing.assert_allclose(found.angles[f"{side} {joint} {word}"].values, true, atol=0.02)
    true = person(walking(), speed=1.0)
    for name, label in SHOWN.items():
        np.testing.assert_allclose(found.landmarks[name].values, true[label], atol=3e-5)


@pytest.mark.slow
@pytest.mark.parametrize("how", ["line.toml", "pivot.toml"])
def test_a_pointer_gives_the_true_angles_and_landmarks(folder, how):
    found = bones(how)
    require_true(found)
    assert any("left_LE is where the pointer rests in left_LE.c3d" in note for note in found.warnings)
    assert any(path.name == "right_MM.c3d" for path in found.details.inputs)


@pytest.mark.slow
def test_without_a_static_trial_a_standing_part_of_the_trial_serves(folder):
    both = {joint: np.concatenate([standing()[joint], walking()[joint]]) for joint in standing()}
    write_measured(folder / "walk.c3d", cast(person(both), static=False), {})
    found = bones("line.toml", static=None)
    np.testing.assert_allclose(
        found.angles["left knee flexion"].values[60:], np.degrees(walking()["knee"][:, 0]), atol=0.02
    )


def test_clusters_of_a_toml_are_calibrated_with_the_pointer(folder):
    """All landmarks of the right thigh and shank are shown; the hip is a marker of the static trial."""
    hip = person(standing())["RHJC"]
    write_measured(folder / "static.c3d", cast(person(standing()), static=False) | {"HIP": hip}, {})
    clusters = '[segments]\nright_thigh = ["R_TH?"]\nright_shank = ["R_SK?"]\n[landmarks]\nright_HJC = "HIP"\n'
    right = {name: f"{name}.c3d" for name in SHOWN if name.startswith("right")}
    described("who.toml", 'markers = ["W1", "W2"]', f"tip_mm = {TIP_MM}", trials=right, before=clusters)
    found = bones("who.toml", measurements={})
    true = walking()["knee"]
    for k, word in enumerate(("flexion", "adduction", "rotation")):
        np.testing.assert_allclose(found.angles[f"right knee {word}"].values, np.degrees(true[:, k]), atol=0.02)


@pytest.mark.parametrize(
    ("lines", "trials", "wrong"),
    [
        (['markers = ["W1", "W2"]'], None, "neither tip_mm nor pivot"),
        (['markers = ["W1", "W2"]', "tip_mm = 5", 'pivot = "pivot.c3d"'], None, "both tip_mm and pivot"),
        (['markers = ["W1"]', "tip_mm = 5"], None, "pointer.markers"),
        (['markers = ["W1", "X"]', "tip_mm = 5"], None, "left_LE.c3d: lacks the markers X of the pointer"),
        (['markers = ["W1", "W2"]', "tip_mm = 120"], {"left_XY": "left_LE.c3d"}, "landmark left_XY .* none of the seg"),
        (['markers = ["W1", "W2"]', "tip_mm = 120"], {"left_LE": "none.c3d"}, "none.c3d: does not exist"),
        (['markers = ["W1", "W2"]', "tip_mm = 120"], {"left_LE": "pivot.c3d"}, "fewer than 3 markers of left_thigh"),
        (['markers = ["W1", "W2"]', 'pivot = "pivot.c3d"'], None, r"pivot.c3d: does not determine the tip .*needs 3"),
        (['markers = ["W1", "W2"]', "tip_mm = 120"], {"left_LE": "loose.c3d"}, "loose.c3d: does not show left_LE"),
    ],
)
def test_wrong_input_is_named(folder, lines, trials, wrong):
    loose = cast(person(standing(80)), static=False)
    still = np.linspace(0, 0.3, 80)[:, None] * np.ones(3)
    write_measured(folder / "loose.c3d", loose | pointing(still), {})
    described("bad.toml", *lines, trials=trials)
    with pytest.raises(MareyError, match=wrong):
        bones("bad.toml")

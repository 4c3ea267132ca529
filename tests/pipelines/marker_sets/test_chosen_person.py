"""One person out of a file with the markers of several."""

from pathlib import Path

import ezc3d
import numpy as np
import pytest
from tests.marker_set_trials import lower_body, person, standing, walking, write_measured
from tests.trials import marker_points, write_trial

from marey.errors import MareyError
from marey.io.markers.trial_file import read_marker_file
from marey.pipelines.marker_sets.chosen_person import file_of
from marey.pipelines.markers.bones import Bones
from marey.pipelines.markers.estimate import estimate_bones, open_markers
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.viewer.results import read_viewed

ANN, BO = walking(), {name: 0.5 * values for name, values in walking().items()}
SIZES = {"knee_width_mm": 100, "ankle_width_mm": 70, "leg_length_mm": 860, "marker_diameter_mm": 14}


def two(between: str = ":", *, speeds=(1.0, 0.8)) -> dict[str, np.ndarray]:
    """Ann and Bo, who walks 2 m beside her with half of her angles."""
    points = {}
    for name, angles, speed, aside in (("Ann", ANN, speeds[0], 0.0), ("Bo", BO, speeds[1], 2.0)):
        own = lower_body(person(angles, speed=speed))
        points |= {f"{name}{between}{label}": path + [0, aside, 0] for label, path in own.items()}
    return points


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    write_measured(tmp_path / "walk.c3d", two(), {})
    write_measured(tmp_path / "static.c3d", lower_body(person(standing())), {})
    return tmp_path


def bones(trial: str = "walk.c3d", **options) -> Bones:
    settings = {"static": "static.c3d", "measurements": SIZES, **options}
    return estimate_bones(open_markers(trial, **settings), "rigid", progress=RecordingProgress())


@pytest.mark.slow
@pytest.mark.parametrize(("who", "true"), [("Ann", ANN), ("bo", BO)])
def test_the_chosen_person_has_the_own_angles(folder, who, true):
    found = bones(person=who)
    knee = found.angles["left knee flexion"].values
    np.testing.assert_allclose(knee, np.degrees(true["knee"][:, 0]), atol=0.01)
    assert found.details.settings["person"].casefold() == who.casefold()
    assert any("are used; 16 others are ignored, among them those of" in note for note in found.warnings)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("between", "stated"), [("_", {}), ("-", {"NAMES": ["Ann", "Bo"], "LABEL_PREFIXES": ["Ann-", "Bo-"]})]
)
def test_names_before_other_characters_are_recognised(folder, between, stated):
    c3d = ezc3d.c3d(str(write_measured(folder / "walk.c3d", two(between), {})))
    for name, values in stated.items():
        c3d.add_parameter("SUBJECTS", name, values)
    c3d.write("walk.c3d")
    knee = bones(person="Bo").angles["right knee flexion"].values
    np.testing.assert_allclose(knee, np.degrees(BO["knee"][:, 0]), atol=0.01)
    with pytest.raises(MareyError, match=r"several people \(Ann, Bo\)"):
        bones()


@pytest.mark.slow
def test_the_only_person_in_a_known_set_needs_no_choice(folder):
    points = {label: path for label, path in two().items() if label.startswith("Ann")}
    write_measured(folder / "walk.c3d", points | {"Box:LASI": points["Ann:LASI"], "Box:1": points["Ann:RASI"]}, {})
    found = bones()
    np.testing.assert_allclose(found.angles["left hip flexion"].values, np.degrees(ANN["hip"][:, 0]), atol=0.01)
    assert found.details.settings["person"] == "Ann"


@pytest.mark.slow
def test_one_name_before_all_labels_is_removed_and_may_be_given(folder):
    points = {label: path for label, path in two().items() if label.startswith("Ann")}
    write_measured(folder / "walk.c3d", points, {})
    for options in ({}, {"person": "ann"}):
        assert bones(**options).segments[0] == "pelvis"
    with pytest.raises(MareyError, match="has no markers of Bo"):
        bones(person="Bo")


@pytest.mark.slow
def test_the_static_trial_of_several_people_gives_the_same_person(folder):
    still = {
        f"{name}:{label}": path for name in ("Bo", "Ann") for label, path in lower_body(person(standing())).items()
    }
    still = {label: path + [0, 2.0 * label.startswith("Bo"), 0] for label, path in still.items()}
    write_measured(folder / "static.c3d", still, {})
    np.testing.assert_allclose(
        bones(person="Bo").angles["left knee flexion"].values, np.degrees(BO["knee"][:, 0]), atol=0.01
    )
    write_measured(folder / "walk.c3d", lower_body(person(ANN)), {})
    with pytest.raises(MareyError, match=r"static.c3d: has the markers of several people \(Bo, Ann\)"):
        bones()


@pytest.mark.parametrize(
    ("options", "wrong"),
    [
        (
            {},
            r"walk.c3d: has the markers of several people \(Ann, Bo\). Choose one of them with person \(--person Ann\)",
        ),
        ({"person": "Carl"}, r"walk.c3d: has no markers of Carl. Choose one of Ann, Bo with person \(--person\)"),
        ({"person": " "}, r"person \(--person\) is empty"),
        ({"person": "Ann", "trial": "static.c3d"}, "has no markers of Ann. Leave out person"),
        ({"person": "Ann", "static": "other.c3d"}, "other.c3d: has no markers of Ann. Choose one of Carl"),
    ],
)
def test_a_choice_that_is_missing_or_wrong_is_named(folder, options, wrong):
    other = {f"Carl:{label}": path for label, path in lower_body(person(standing())).items()}
    write_measured(folder / "other.c3d", other, {})
    with pytest.raises(MareyError, match=wrong):
        bones(**options)


def test_measurements_and_events_of_several_people_are_not_mixed(folder):
    path = write_measured(folder / "walk.c3d", two(), {"LKneeWidth": 120.0})
    c3d = ezc3d.c3d(str(path))
    c3d.add_parameter("EVENT", "USED", [3])
    c3d.add_parameter("EVENT", "SUBJECTS", ["Ann", "Bo", "Ann"])
    c3d.add_parameter("EVENT", "CONTEXTS", ["Left", "Left", "Right"])
    c3d.add_parameter("EVENT", "LABELS", ["Foot Strike"] * 3)
    c3d.add_parameter("EVENT", "TIMES", np.array([[0.0, 0, 0], [0.1, 0.2, 0.3]]))
    c3d.write(str(path))
    file = file_of(read_marker_file(path), "Ann")
    assert [(event.side, event.time) for event in file.events] == [
        ("left", pytest.approx(0.1)), ("right", pytest.approx(0.3))
    ]  # fmt: skip
    assert file.person.lengths == {}
    assert file.person_notes == (
        "The measurements of a person in the file are ignored: it does not state whose they are.",
    )


def test_angles_in_the_file_are_those_of_the_person(folder):
    angles = {f"{name}:LKneeAngles": np.degrees(own["knee"]) for name, own in (("Ann", ANN), ("Bo", BO))}
    write_measured(folder / "walk.c3d", two(), {}, angles=angles)
    found = bones(person="Bo")
    assert found.given_angles is not None
    assert found.given_angles.labels == ("LKneeAngles",)
    assert max(abs(row.agreement.bias) for row in found.given_agreement) < 1e-3


@pytest.mark.slow
def test_results_are_those_of_the_person_also_when_read_again(folder):
    points = two()
    points["Bo:LTHI"][20:24] = np.nan
    write_measured(folder / "walk.c3d", points, {})
    opened = open_markers("walk.c3d", static="static.c3d", measurements=SIZES, person="Bo", fill="spline")
    estimate_bones(opened, "rigid", out="out", progress=RecordingProgress())
    again = read_marker_file(folder / "out" / "motion.c3d").trajectories
    filled = again.select(["Bo:LTHI"]).points[20:24, 0]
    np.testing.assert_allclose(filled, two()["Bo:LTHI"][20:24], atol=2e-3)
    shown = read_viewed(folder / "out").shown
    assert {"LASI", "RTOE", "left_HJC"} <= set(shown.paths.labels)
    assert not any(":" in label for label in shown.paths.labels)


def test_a_toml_may_name_the_markers_of_several_people(folder):
    names = [f"{side}_{part}" for side in ("Ann", "Bo") for part in ("thigh", "shank")]
    points = {f"{who}:{label}": path for who in ("Ann", "Bo") for label, path in marker_points().items()}
    write_trial(folder / "clusters.c3d", points)
    lines = (f'{name} = ["{name.partition("_")[0]}:{name.partition("_")[2]}_*"]' for name in names)
    (folder / "who.toml").write_text("[segments]\n" + "\n".join(lines) + "\n")
    assert set(open_markers("clusters.c3d", clusters="who.toml").segments) == set(names)
    assert set(open_markers("clusters.c3d", person="Ann").segments) == {"thigh", "shank"}
    with pytest.raises(MareyError, match="several people"):
        open_markers("clusters.c3d")

"""Trials of known marker sets from their files to joint angles, without a TOML."""

from pathlib import Path

import numpy as np
import pytest
from tests.marker_set_trials import cast, ior, lower_body, opencap, opensim, person, standing, walking, write_measured

from marey.errors import MareyError
from marey.io.markers.trial_file import read_marker_file
from marey.pipelines.markers.bones import Bones, load_bones
from marey.pipelines.markers.estimate import estimate_bones, open_markers
from marey.pipelines.progress import RecordingProgress

CLUSTERS = ("THAP", "THAD", "TIAP", "TIAD")


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    write_measured(tmp_path / "walk.c3d", lower_body(person(walking(), speed=1.0)))
    write_measured(tmp_path / "static.c3d", lower_body(person(standing())))
    return tmp_path


def bones(trial: str = "walk.c3d", **options) -> Bones:
    return estimate_bones(open_markers(trial, **options), "rigid", progress=RecordingProgress())


def require_true_angles(found: Bones, *, atol: float = 0.01) -> None:
    """Compare with the angles of the made walk, in degrees. A C3D keeps single precision, 0.1 micrometres at a metre.

    Over clusters some centimetres wide that is 0.001 degrees; three in a chain and the crosstalk of the angles stay
    below 0.01 degrees.
    """
    names = {"hip": ("flexion", "adduction", "rotation"), "knee": ("flexion", "adduction", "rotation"),
             "ankle": ("dorsiflexion", "inversion", "rotation")}  # fmt: skip
    for side in ("left", "right"):
        for joint, words in names.items():
            for k, word in enumerate(words):
                true = np.degrees(walking()[joint][:, k])
                np.testing.assert_allclose(
                    found.angles[f"{side} {joint} {word}"].values, true, atol=atol, err_msg=f"{side} {joint} {word}"
                )


@pytest.mark.slow
def test_plug_in_gait_with_a_static_trial_gives_the_true_angles(folder):
    found = bones(static="static.c3d")
    assert found.segments == (
        "pelvis", "left_thigh", "left_shank", "left_foot", "right_thigh", "right_shank", "right_foot"
    )  # fmt: skip
    require_true_angles(found)
    for name, true in (("tilt", 0), ("obliquity", 0), ("rotation", -90)):  # the person faces along x
        np.testing.assert_allclose(found.angles[f"pelvis {name}"].values, true, atol=0.01)
    assert "The labels are those of the marker set Plug-in Gait, lower body; none is missing." in found.warnings
    assert found.details.settings["marker_set"] == "Plug-in Gait, lower body"
    assert str(found.verdict) == "Verdict: good"


def circling(side: str, frames: int = 120) -> dict[str, np.ndarray]:
    """Angles of a person who moves one hip in all directions."""
    time = np.arange(frames) / 20
    moved = person({joint: np.zeros((frames, 3)) for joint in ("hip", "knee", "ankle")})
    angles = np.stack([0.5 * np.sin(time), 0.3 * np.cos(time), 0.1 * np.sin(3 * time)], 1)
    own = person({"hip": angles, "knee": np.zeros((frames, 3)), "ankle": np.zeros((frames, 3))})
    return {label: (own if label[0] == side else moved)[label] for label in own}


@pytest.mark.slow
@pytest.mark.parametrize(("more", "kind"), [((), "moves on spheres"), (CLUSTERS, "rotates")])
def test_hips_of_functional_trials_replace_the_predicted_ones(folder, more, kind):
    # A wrong leg length makes the predicted centres wrong.
    wrong = {"LLegLength": 700.0, "RLegLength": 700.0, "LKneeWidth": 100, "RKneeWidth": 100, "LAnkleWidth": 70,
             "RAnkleWidth": 70, "Marker Diameter": 14}  # fmt: skip
    for name, points in (("walk", person(walking(), speed=1.0)), ("static", person(standing()))):
        write_measured(folder / f"{name}.c3d", lower_body(points, *more), wrong)
    for letter in "LR":
        write_measured(folder / f"{letter}.c3d", lower_body(circling(letter), *more), wrong)
    true = person(standing())
    trial = open_markers("walk.c3d", static="static.c3d", functional=["L.c3d", "R.c3d"], progress=RecordingProgress())
    found = estimate_bones(trial, "rigid", progress=RecordingProgress())
    for side, letter in (("left", "L"), ("right", "R")):
        np.testing.assert_allclose(trial.landmarks[f"{side}_HJC"], true[f"{letter}HJC"].mean(0), atol=1e-5)
        assert any(f"The {side} hip centre is the one about which the thigh {kind}" in text for text in found.warnings)
    require_true_angles(found)
    predicted = open_markers("walk.c3d", static="static.c3d", progress=RecordingProgress())
    assert np.linalg.norm(predicted.landmarks["left_HJC"] - true["LHJC"].mean(0)) > 0.005


def test_ior_without_medial_markers_names_what_is_missing(folder):
    write_measured(folder / "ior.c3d", ior(person(walking()), medial=False))
    write_measured(folder / "stands.c3d", ior(person(standing()), medial=False))
    with pytest.raises(MareyError, match=r"needs a marker on its medial side \(LFME\) in the posture of the landmarks"):
        bones("ior.c3d", static="stands.c3d")


@pytest.mark.slow
def test_cgm_with_medial_markers_in_the_static_trial_needs_no_measurements(folder):
    write_measured(folder / "walk.c3d", lower_body(person(walking(), speed=1.0), *CLUSTERS), {})
    write_measured(folder / "static.c3d", lower_body(person(standing()), *CLUSTERS, "KNM", "MED"), {})
    (folder / "person.toml").write_text("[person]\nleg_length_mm = 860\n")
    found = bones(static="static.c3d", clusters="person.toml")
    require_true_angles(found)
    assert found.details.settings["marker_set"] == "CGM2.3, lower body"


@pytest.mark.slow
def test_cgm_with_heads_of_the_metatarsals_gives_the_true_angles(folder):
    for name, angles, more in (("walk.c3d", walking(), ()), ("static.c3d", standing(), ("KNM", "MED"))):
        points = person(angles, speed=float(name == "walk.c3d"))
        worn = lower_body(points, *CLUSTERS, *more) | {f"{s}FMH": points[f"{s}FM1"] for s in "LR"}
        write_measured(folder / name, worn | {f"{s}VMH": points[f"{s}FM5"] for s in "LR"}, {})
    (folder / "person.toml").write_text("[person]\nleg_length_mm = 860\n")
    found = bones(static="static.c3d", clusters="person.toml")
    require_true_angles(found)
    assert found.details.settings["marker_set"] == "CGM2.4, lower body"


@pytest.mark.slow
def test_measurements_of_the_toml_replace_those_of_the_file(folder):
    write_measured(folder / "walk.c3d", lower_body(person(walking(), speed=1.0)), {"LKneeWidth": 180.0})
    write_measured(folder / "static.c3d", lower_body(person(standing())), {})
    (folder / "person.toml").write_text(
        "[person]\nleg_length_mm = 860\nknee_width_mm = 100\nankle_width_mm = 70\nmarker_diameter_mm = 14\n"
    )
    found = bones(static="static.c3d", clusters="person.toml")
    require_true_angles(found)
    assert str(found.verdict) == "Verdict: good"


@pytest.mark.slow
def test_given_measurements_replace_those_of_the_toml(folder):
    write_measured(folder / "walk.c3d", lower_body(person(walking(), speed=1.0)), {})
    write_measured(folder / "static.c3d", lower_body(person(standing())), {})
    (folder / "person.toml").write_text("[person]\nleg_length_mm = 860\nknee_width_mm = 180\nankle_width_mm = 70\n")
    given = {"knee_width_mm": 100, "marker_diameter_mm": 14}
    found = bones(static="static.c3d", clusters="person.toml", measurements=given)
    require_true_angles(found)
    assert found.details.settings["measurements"] == given
    assert found.runs[0].offsets == ()


def without_widths(folder: Path, *more: str) -> None:
    """Write the trials with leg length and diameter only, and on both sides with markers of further labels."""
    known = {"LLegLength": 860.0, "RLegLength": 860.0, "MarkerDiameter": 14.0}
    write_measured(folder / "walk.c3d", lower_body(person(walking(), speed=1.0), *more), known)
    write_measured(folder / "static.c3d", lower_body(person(standing()), *more), known)


@pytest.mark.slow
def test_assumed_widths_are_named_and_limit_the_verdict(folder):
    """The made person has the widths that are assumed, so that the angles are true."""
    without_widths(folder)
    found = bones(static="static.c3d")
    require_true_angles(found)
    assert found.verdict is not None
    assert [reason.cause for reason in found.verdict.reasons] == ["assumed widths"]
    assert "Means of other people are used for left knee width" in found.verdict.reasons[0].what
    assert any("left knee width and right knee width 100 mm, standard deviation 9.0 mm" in x for x in found.warnings)


@pytest.mark.slow
def test_the_intervals_contain_what_a_width_larger_by_its_deviation_changes(folder):
    """The offsets are constant in the bones. The centre of the knee moves 4.5 mm, 0.6 degrees of each bone, aside.

    Measured again with that centre, the shank follows it as the knee bends: some 10 % of 1.2 degrees.
    """
    without_widths(folder)
    assumed = bones(static="static.c3d")
    measured = {"ankle_width_mm": 70, "right_knee_width_mm": 100}
    known = bones(static="static.c3d", measurements={**measured, "left_knee_width_mm": 100})
    wider = bones(static="static.c3d", measurements={**measured, "left_knee_width_mm": 109})
    rows = {row.angle: np.degrees(row.sd) for row in assumed.runs[0].offsets
            if row.measurement.name == "left_knee_width"}  # fmt: skip
    changes = np.degrees(np.median(np.abs(wider.joints.angles - known.joints.angles), 0))
    for name, change in zip(assumed.joints.angle_names, changes, strict=True):
        assert rows.get(name, 0.0) == pytest.approx(change, abs=0.12), name
    assert rows["left_knee_adduction"] == pytest.approx(1.2, abs=0.12)
    assert not any(name.startswith("right") for name in rows)
    added = np.degrees(np.sqrt(assumed.joints.angles_sd**2 - known.joints.angles_sd**2))
    hip = assumed.joints.angle_names.index("left_hip_adduction")  # which no other assumed measurement changes
    np.testing.assert_allclose(added[:, hip], rows["left_hip_adduction"], rtol=0.02)
    thigh = assumed.segments.index("left_thigh")
    turned = assumed.motion.rotation_sd[:, thigh, 0] ** 2 - known.motion.rotation_sd[:, thigh, 0] ** 2
    np.testing.assert_allclose(np.degrees(np.sqrt(turned)), np.degrees(0.0045 / 0.42), rtol=0.02)


@pytest.mark.slow
def test_assumed_measurements_are_in_the_files_and_on_the_page(folder):
    without_widths(folder)
    estimate_bones(open_markers("walk.c3d", static="static.c3d"), "rigid", out="out", progress=RecordingProgress())
    rows = (folder / "out" / "assumed.csv").read_text().splitlines()
    assert rows[0] == "measurement,value_mm,sd_mm,angle,angle_sd_deg"
    assert any(row.startswith("left_knee_width,100.000,9.000,left_knee_adduction,1.1") for row in rows)
    assert "Assumed measurements" in (folder / "out" / "report.html").read_text()


def test_medial_markers_leave_no_width_to_assume(folder):
    without_widths(folder, "KNM", "MED")
    found = bones(static="static.c3d")
    assert found.runs[0].offsets == ()
    assert str(found.verdict) == "Verdict: good"


@pytest.mark.slow
def test_a_standing_part_of_the_trial_serves_as_static_trial(folder):
    both = {joint: np.concatenate([standing()[joint], walking()[joint]]) for joint in standing()}
    write_measured(folder / "walk.c3d", lower_body(person(both)))
    found = bones()
    assert any("which serve as static trial" in note for note in found.warnings)
    np.testing.assert_allclose(
        found.angles["left knee flexion"].values[60:], np.degrees(walking()["knee"][:, 0]), atol=0.01
    )
    assert str(found.verdict) == "Verdict: good"


@pytest.mark.slow
def test_without_any_standing_part_the_most_upright_frame_serves_and_limits_the_verdict(folder):
    found = bones()
    require_true_angles(found, atol=20.0)  # the foot's angles count from another posture
    np.testing.assert_allclose(found.angles["left knee flexion"].values, np.degrees(walking()["knee"][:, 0]), atol=0.05)
    assert found.verdict is not None
    assert [reason.cause for reason in found.verdict.reasons] == ["no static posture"]


@pytest.mark.slow
def test_ior_with_medial_markers_in_the_static_trial_gives_the_true_angles(folder):
    write_measured(folder / "walk.c3d", ior(person(walking(), speed=1.0), medial=False), {})
    write_measured(folder / "static.c3d", ior(person(standing()), medial=True), {})
    (folder / "person.toml").write_text("[person]\nleg_length_mm = 860\n")
    found = bones(static="static.c3d", clusters="person.toml")
    require_true_angles(found)
    assert found.details.settings["marker_set"] == "IOR"


@pytest.mark.slow
def test_opencap_needs_no_measurements_because_it_has_all_joints(folder):
    write_measured(folder / "walk.c3d", opencap(person(walking(), speed=1.0)), {})
    write_measured(folder / "static.c3d", opencap(person(standing())), {})
    found = bones(static="static.c3d")
    require_true_angles(found)
    assert not any("predicted" in note for note in found.warnings)


def test_clusters_with_knees_and_ankles_in_the_static_trial_only_give_the_true_angles(folder):
    write_measured(folder / "walk.c3d", opensim(person(walking(), speed=1.0), static=False), {})
    write_measured(folder / "static.c3d", opensim(person(standing()), static=True), {})
    (folder / "person.toml").write_text("[person]\nleg_length_mm = 860\n")
    found = bones(static="static.c3d", clusters="person.toml")
    require_true_angles(found)
    assert found.details.settings["marker_set"] == "OpenSim's gait example"


def test_clusters_of_cast_give_the_true_angles(folder):
    write_measured(folder / "walk.c3d", cast(person(walking(), speed=1.0), static=False), {})
    write_measured(folder / "static.c3d", cast(person(standing()), static=True), {})
    given = {"leg_length_mm": 860, "marker_diameter_mm": 14}
    found = bones(static="static.c3d", measurements=given)
    require_true_angles(found)
    assert found.details.settings["marker_set"] == "CAST"
    true = person(walking(), speed=1.0)
    for name, label in (("left_LE", "LKNE"), ("left_ME", "LKNM"), ("right_LM", "RANK"), ("right_MM", "RMED")):
        np.testing.assert_allclose(found.landmarks[name].values, true[label], atol=1e-5)  # a C3D keeps micrometres
    assert str(found.verdict) == "Verdict: good"
    with pytest.raises(MareyError, match=r"walk.c3d: lacks markers that the marker set CAST needs: LFLE, LFAL"):
        bones()


@pytest.mark.slow
def test_clusters_with_other_labels_give_the_true_angles_with_landmarks_in_the_static_trial(folder):
    """Labels of no known set, a cluster on the pelvis, and the landmarks in the static trial only."""
    words = {"KNE": "LK", "KNM": "MK", "ANK": "LA", "MED": "MA"}
    for name, angles in (("walk.c3d", walking()), ("static.c3d", standing())):
        still, points = name == "static.c3d", person(angles, speed=float(name == "walk.c3d"))
        worn = {f"{s}TH{k}": points[f"{s}TH{k}"] for s in "LR" for k in range(1, 5)}
        worn |= {f"{s}_shank_{k}": points[f"{s}SK{k}"] for s in "LR" for k in range(1, 4)}
        worn |= {f"PV{k}": points[label] + [0, 0, 0.05 * k] for k, label in enumerate(("LPSI", "RPSI", "LASI"), 1)}
        worn |= {f"{s}{label}": points[f"{s}{label}"] for s in "LR" for label in ("HEE", "TOE", "FM5")}
        if still:
            worn |= {f"{s}{label}": points[f"{s}{label}"] for s in "LR" for label in ("ASI", "PSI")}
            worn |= {f"{s}{word}": points[f"{s}{own}"] for s in "LR" for own, word in words.items()}
        write_measured(folder / name, worn, {})
    found = bones(static="static.c3d", measurements={"leg_length_mm": 860, "marker_diameter_mm": 14})
    require_true_angles(found)
    assert found.details.settings["marker_set"] == "CAST, numbered clusters"
    (note,) = (note for note in found.warnings if note.startswith("Labels of the landmarks: RASIS RASI, "))
    assert "left_LE LLK" in note


@pytest.mark.slow
def test_a_marker_on_the_sacrum_and_labels_in_small_letters_give_the_true_angles(folder):
    for name, angles in (("walk.c3d", walking()), ("static.c3d", standing())):
        points = lower_body(person(angles, speed=float(name == "walk.c3d")))
        points["SACR"] = (points.pop("LPSI") + points.pop("RPSI")) / 2
        write_measured(folder / name, {label.lower(): path for label, path in points.items()})
    found = bones(static="static.c3d")
    require_true_angles(found)
    assert found.details.settings["marker_set"] == "Plug-in Gait, lower body"


def test_one_leg_is_estimated_if_the_set_is_named(folder):
    for name, angles in (("walk.c3d", walking()), ("static.c3d", standing())):
        points = lower_body(person(angles, speed=float(name == "walk.c3d")))
        one = {label: path for label, path in points.items() if label[0] == "L" or label in ("RASI", "RPSI")}
        write_measured(folder / name, one)
    found = bones(static="static.c3d", marker_set="PIG-lower")
    assert found.segments == ("pelvis", "left_thigh", "left_shank", "left_foot")
    np.testing.assert_allclose(found.angles["left hip flexion"].values, np.degrees(walking()["hip"][:, 0]), atol=0.01)


@pytest.mark.slow
def test_saved_results_are_anatomical_when_read_again(folder):
    opened = open_markers("walk.c3d", static="static.c3d")
    found = estimate_bones(opened, "rigid", out="out", progress=RecordingProgress())
    again = load_bones("out")
    for name in ("RASIS", "right_KJC", "left_HJC"):
        np.testing.assert_allclose(again.landmarks[name].values, found.landmarks[name].values, atol=1e-7)
        np.testing.assert_allclose(again.landmarks[name].sd, found.landmarks[name].sd, atol=1e-7)
    assert again.anatomical
    np.testing.assert_allclose(
        again.angles["right knee flexion"].values, np.degrees(walking()["knee"][:, 0]), atol=0.01
    )


@pytest.mark.slow
def test_joint_centres_that_were_computed_are_in_the_c3d_which_can_be_a_trial_again(folder):
    opened = open_markers("walk.c3d", static="static.c3d")
    found = estimate_bones(opened, "rigid", out="out", progress=RecordingProgress())
    written = read_marker_file(folder / "out" / "motion.c3d").trajectories
    assert written.labels[:16] == opened.labels[:16]
    centre = written.select(["left_KJC"]).points[:, 0]
    np.testing.assert_allclose(centre, found.landmarks["left_KJC"].values, atol=1e-5)  # a C3D keeps micrometres
    again = bones("out/motion.c3d", static="static.c3d")
    np.testing.assert_allclose(again.joints.angles, found.joints.angles, atol=1e-6)


def without(*labels: str) -> dict[str, np.ndarray]:
    points = lower_body(person(walking(), speed=1.0))
    return {label: path for label, path in points.items() if label not in labels}


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"marker_set": "helen hayes"}, "should be one of pig-lower, pig-full"),
        ({"marker_set": "pig-lower", "reference": "frame0.npz"}, "--reference"),
        ({"static": "static.c3d", "functional": ["static.c3d"]}, "static.c3d: does not determine the centre of the"),
        (
            {"static": "static.c3d", "functional": ["turned.c3d"]},
            r"turned.c3d: lacks markers of the pelvis or of a thigh",
        ),
        ({"marker_set": "pig-lower", "clusters": "segments.toml"}, r"names \[segments\] or \[landmarks\]"),
        ({"static": "walk.c3d"}, "walk.c3d: has no part of 0.5 s in which the person stands upright and still"),
        ({"trial": "few.c3d"}, "few.c3d: lacks markers that the marker set .* needs: LASI, LKNE"),
        ({"trial": "loose.c3d", "marker_set": "pig-lower"}, "lacks markers .* needs: RASI, LASI, RPSI, LPSI"),
        ({"measurements": {"knee_width_mm": 9}}, r"measurements \(--measurements\) has knee_width_mm = 9.*such as"),
        ({"measurements": {"height_mm": 1700}}, r"measurements \(--measurements\) has the unknown key 'height_mm'"),
        ({"trial": "numbered.c3d", "measurements": {"knee_width_mm": 99}}, "apply to trials with a known marker set"),
        ({"trial": "two.c3d"}, r"two.c3d: has the markers of several people \(Ann, Bo\). .*--person Ann"),
        ({"clusters": "odd.toml"}, "odd.toml: has the unknown key 'person.height'"),
        ({"clusters": "tiny.toml"}, "tiny.toml: has person.knee_width_mm = 9"),
    ],
)
def test_wrong_input_is_named(folder, options, expected):
    np.savez(folder / "frame0.npz", frame=0)
    (folder / "segments.toml").write_text('[segments]\npelvis = ["LASI", "RASI", "LPSI"]\n')
    (folder / "odd.toml").write_text("[person]\nheight = 1.7\n")
    (folder / "tiny.toml").write_text("[person]\nknee_width_mm = 9\n")
    write_measured(folder / "few.c3d", without("LASI", "LKNE"))
    write_measured(folder / "turned.c3d", without("LASI", "RASI"))
    write_measured(folder / "numbered.c3d", {f"left_thigh_{k}": x for k, x in enumerate(without().values())})
    write_measured(folder / "loose.c3d", {"a": person(walking())["LASI"], "b": person(walking())["RASI"]})
    write_measured(
        folder / "two.c3d",
        {f"{name}:{label}": path for name in ("Ann", "Bo") for label, path in without().items()},
    )
    with pytest.raises(MareyError, match=expected):
        bones(options.pop("trial", "walk.c3d"), **options)


@pytest.mark.slow
def test_angles_in_the_file_are_kept_and_compared(folder):
    true = np.degrees(walking()["knee"])
    points = lower_body(person(walking(), speed=1.0))
    write_measured(folder / "walk.c3d", points, angles={"LKneeAngles": true - [2.0, 0.0, -1.0], "LFoot": true})
    progress = RecordingProgress()
    found = estimate_bones(open_markers("walk.c3d", static="static.c3d"), "rigid", out="out", progress=progress)
    for bones_ in (found, load_bones("out")):
        assert bones_.given_angles is not None
        assert bones_.given_angles.labels == ("LKneeAngles", "LFoot")
        biases = {row.agreement.name: np.degrees(row.agreement.bias) for row in bones_.given_agreement}
        assert biases == {
            "left_knee_flexion": pytest.approx(2, abs=0.01), "left_knee_adduction": pytest.approx(0, abs=0.01),
            "left_knee_rotation": pytest.approx(-1, abs=0.01),
        }  # fmt: skip
        assert "3 angles of ours differ" in bones_.summary().lines["angles in the file"]
    rows = (folder / "out" / "given_agreement.csv").read_text().splitlines()
    assert rows[0] == "angle,label,component,sign,frames,bias_deg,spread_deg,correlation"
    assert rows[1].startswith("left_knee_flexion,LKneeAngles,x,1,80,2.00")
    page = (folder / "out" / "report.html").read_text()
    assert "Angles in the file" in page
    assert "Beside the angles in the file" in page


def test_without_anatomical_bones_angles_in_the_file_are_kept_only(folder):
    points = {f"left_thigh_{k}": path for k, path in enumerate(lower_body(person(walking())).values())}
    write_measured(folder / "other.c3d", points, angles={"LKneeAngles": np.degrees(walking()["knee"])})
    found = bones("other.c3d")
    assert found.given_angles is not None
    assert found.given_agreement == ()


@pytest.mark.slow
def test_a_walk_of_a_laboratory_agrees_with_the_angles_in_its_file(shared):
    """The bounds are those measured by `python -m bench run markers/marker_sets`, rounded up."""
    folder = shared / "data" / "markers" / "functional"
    found = bones(str(folder / "walk.c3d"), static=folder / "static.c3d")
    spreads = {row.agreement.name: np.degrees(row.agreement.sd) for row in found.given_agreement}
    assert len(spreads) == 21
    for name, spread in spreads.items():
        largest = 10.0 if "inversion" in name else 0.7 if "hip_flexion" in name or "knee_flexion" in name else 2.5
        assert spread < largest, name
    assert str(found.verdict) == "Verdict: good"

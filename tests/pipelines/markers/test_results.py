"""The files of a marker trial, what is skipped, and the errors for invalid input."""

import csv
import json
from pathlib import Path
from typing import Any

import ezc3d
import numpy as np
import pytest
from tests.trials import FRAMES, RATE, marker_points, true_bones, write_reference, write_static, write_trial

from marey.errors import MareyError
from marey.io.markers.bones import read_bones
from marey.io.markers.readers import read_markers
from marey.io.markers.reading_results import read_static_landmarks
from marey.io.npz import write_arrays
from marey.io.opensim.mot_sto import read_orientations, read_table
from marey.io.opensim.trc import PointPaths, write_trc
from marey.markers.data.marker_set_tables import MARKER_SETS
from marey.markers.methods.methods import DEFAULT_METHOD
from marey.motion.events.summaries import LEAST_CYCLES
from marey.pipelines.compare import compare
from marey.pipelines.markers.estimate import estimate_bones, open_markers
from marey.pipelines.progress import RecordingProgress

FILES = ["angles.csv", "angles.mot", "bones.npz", "marker_motion.csv", "motion.c3d", "orientations.sto",
         "report.html", "run.json"]  # fmt: skip


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    write_trial(tmp_path / "walk.c3d", marker_points(), force=True)
    write_reference(tmp_path / "frame0.npz")
    return tmp_path


def estimated(trial: Path | str = "walk.c3d", *, method: str = "rigid", out: Path | None = None, **options: Any) -> str:
    """Estimate the bones, write the results to `<trial>_marey` by default, and return the summary and the warnings."""
    progress = RecordingProgress()
    opened = open_markers(trial, progress=progress, **options)
    bones = estimate_bones(
        opened, None if "model" in options else method.split(","), out=out or f"{Path(trial).stem}_marey",
        progress=progress,
    )  # fmt: skip
    return "\n".join([str(bones.summary()), *progress.warnings])


def error_of(trial: Path | str = "walk.c3d", **options: Any) -> str:
    """Return the error of an estimation that must fail."""
    with pytest.raises(MareyError) as problem:
        estimated(trial, **options)
    return str(problem.value)


def test_rigid_data_give_the_true_bones_and_all_files(folder):
    estimated(reference="frame0.npz")
    out = folder / "walk_marey"
    assert sorted(path.name for path in out.iterdir()) == FILES
    found = read_bones(out / "bones.npz")
    assert found.side == "right"
    for name, (rotation, origin) in true_bones().items():
        # A C3D keeps single precision: 0.1 micrometres at a metre, over markers some centimetres apart.
        np.testing.assert_allclose(found.motion.bone(name)[0], rotation, atol=1e-5)
        np.testing.assert_allclose(found.motion.bone(name)[1], origin, atol=1e-5)
    assert np.isfinite(found.motion.rotation_sd).all()


def test_angles_are_in_degrees_beside_their_standard_deviations(folder):
    estimated(reference="frame0.npz")
    table = read_table(folder / "walk_marey" / "angles.mot")
    flexion = table.values[:, table.columns.index("knee_flexion")]
    time = np.arange(FRAMES) / RATE
    np.testing.assert_allclose(flexion, np.degrees(0.6 - 0.5 * np.cos(5 * time)), atol=1e-3)
    assert {"knee_flexion_sd", "knee_distraction_mm", "knee_distraction_sd_mm"} <= set(table.columns)
    with (folder / "walk_marey" / "angles.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert float(rows[5]["knee_flexion_deg"]) == pytest.approx(flexion[5], abs=1e-4)
    assert float(rows[5]["knee_flexion_sd_deg"]) > 0
    # The shank's origin is 420 mm from the thigh's, but the knee opens nowhere. The middle of both pulls its centre
    # by 0.005^2 / (10 * 0.1^2) * 210 mm, divided by the squared sine of the knee's turns: to less than 1 mm.
    assert max(abs(float(row["knee_distraction_mm"])) for row in rows) < 1.0


def test_the_c3d_keeps_force_and_points_and_brings_the_bones(folder):
    estimated(reference="frame0.npz")
    before, after = (ezc3d.c3d(str(path)) for path in (folder / "walk.c3d", folder / "walk_marey" / "motion.c3d"))
    for kind in ("points", "analogs"):
        np.testing.assert_array_equal(after["data"][kind], before["data"][kind])
    assert after["parameters"]["ROTATION"]["LABELS"]["value"] == ["thigh_4X4", "shank_4X4"]
    rotation, origin = true_bones()["shank"]
    np.testing.assert_allclose(after["data"]["rotations"][:3, :3, 1, 7], rotation[7], atol=1e-5)
    np.testing.assert_allclose(after["data"]["rotations"][:3, 3, 1, 7], 1e3 * origin[7], atol=1e-2)


def test_orientations_are_the_bones_axes_in_opensims_ground(folder):
    estimated(reference="frame0.npz")
    lines = (folder / "walk_marey" / "orientations.sto").read_text().splitlines()
    first = [float(v) for v in lines[lines.index("endheader") + 2].split("\t")[1].split(",")]
    # At the start the thigh hangs upright, its X along the laboratory's x, which is OpenSim's z.
    assert read_orientations(folder / "walk_marey" / "orientations.sto").names == ("thigh", "shank")
    np.testing.assert_allclose(np.abs(first), [np.sqrt(0.5), 0, np.sqrt(0.5), 0], atol=1e-5)


@pytest.mark.slow
def test_all_methods_are_in_the_results(folder):
    write_reference(folder / "two.npz", [0, 60])
    text = estimated(reference="two.npz", method="all", out=folder / "all")
    record = json.loads((folder / "all" / "run.json").read_text())
    names = record["settings"]["methods"]
    assert names[0] == DEFAULT_METHOD
    assert {"rigid", "pct", "calibration"} <= set(names)
    assert f"the values are those of {names[0]}" in text
    page = (folder / "all" / "report.html").read_text()
    for name in names:
        assert name in page
        if name != names[0]:
            assert (folder / "all" / f"bones_{name}.npz").is_file()
    assert f"compared with: {', '.join(names[1:])}" in page


def test_the_page_states_the_range_and_the_typical_interval_of_each_angle(folder):
    estimated(reference="frame0.npz", out=folder / "one")
    page = (folder / "one" / "report.html").read_text()
    row = page.split(">knee flexion</th>")[1].split("</tr>")[0]
    cells = [cell.split(">")[-1] for cell in row.split("</td>") if "<td" in cell]
    with (folder / "one" / "angles.csv").open() as file:
        rows = list(csv.DictReader(file))
    angle, sd = (np.array([float(each[f"knee_flexion{end}_deg"]) for each in rows]) for end in ("", "_sd"))
    shown = [float(cell.replace("−", "-").removeprefix("± ")) for cell in cells[:4]]
    np.testing.assert_allclose(shown, [angle.min(), angle.max(), 1.96 * np.median(sd), 1.96 * sd.max()], atol=0.051)
    assert cells[4] == "°"


def test_frames_with_fewer_than_three_markers_and_frames_not_requested_stay_empty(folder):
    points = marker_points()
    for label in ("thigh_01", "thigh_02", "thigh_03"):
        points[label][40:50] = np.nan
    write_trial(folder / "gaps.c3d", points)
    estimated("gaps.c3d", reference="frame0.npz", frames=(0, 90))
    answered = read_bones(folder / "gaps_marey" / "bones.npz").motion.answered
    assert len(answered) == FRAMES
    expected = np.ones((FRAMES, 2), bool)
    expected[40:50, 0] = False
    expected[90:] = False
    np.testing.assert_array_equal(answered, expected)
    with (folder / "gaps_marey" / "angles.csv").open() as file:
        assert list(csv.DictReader(file))[45]["knee_flexion_deg"] == ""


def test_two_exchanged_labels_are_named(folder):
    points = marker_points()
    points["shank_02"][90:], points["shank_04"][90:] = points["shank_04"][90:].copy(), points["shank_02"][90:].copy()
    write_trial(folder / "swapped.c3d", points)
    text = estimated("swapped.c3d", reference="frame0.npz")
    assert "shank_02 and shank_04 look exchanged in the frames 90-119" in text


def test_a_reference_in_metres_is_reported(folder):
    with np.load(folder / "frame0.npz") as file:
        arrays = {k: v * 1e3 if k.endswith("_origin") else v for k, v in file.items()}
    write_arrays(folder / "far.npz", arrays)
    assert "m from its markers. Are its origins in millimetres" in estimated(reference="far.npz")


@pytest.mark.slow
def test_gaps_are_filled_on_request_and_listed(folder):
    points = marker_points()
    for label in ("thigh_01", "thigh_02", "thigh_03"):
        points[label][40:44] = np.nan
    write_trial(folder / "gaps.c3d", points)
    text = estimated("gaps.c3d", reference="frame0.npz", fill="spline")
    assert "12 points were filled by a spline over time" in text
    out = folder / "gaps_marey"
    assert read_bones(out / "bones.npz").motion.answered.all()
    with (out / "filled.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(r["marker"], r["first_frame"], r["last_frame"], r["filled_by"]) for r in rows] == [
        (f"thigh_0{k}", "40", "43", "spline") for k in (1, 2, 3)
    ]
    after = ezc3d.c3d(str(out / "motion.c3d"))
    np.testing.assert_allclose(after["data"]["points"][:3, 0, 41] * 1e-3, marker_points()["thigh_01"][41], atol=1e-3)
    assert "fill (--fill) is 'magic'" in error_of("gaps.c3d", reference="frame0.npz", fill="magic")


def test_bones_that_are_known_in_a_frame_that_was_not_requested_are_used(folder):
    estimated(reference="frame0.npz", frames=(60, 90))
    found = read_bones(folder / "walk_marey" / "bones.npz").motion
    assert found.answered[60:90].all()
    assert not found.answered[:60].any()
    assert not found.answered[90:].any()
    np.testing.assert_allclose(found.bone("shank")[0][60:90], true_bones()["shank"][0][60:90], atol=1e-5)


@pytest.mark.parametrize("reference", [None, "frame0.npz"])
def test_a_segment_that_never_has_three_markers_is_reported_and_the_others_are_estimated(folder, reference):
    points = marker_points()
    for label in [label for label in points if label.startswith("shank")][1:]:
        points[label][:] = np.nan
    write_trial(folder / "half.c3d", points)
    assert "shank: no frame shows 3 of its markers" in estimated("half.c3d", reference=reference)
    found = read_bones(folder / "half_marey" / "bones.npz").motion
    assert found.answered[:, found.segments.index("thigh")].all()


def test_without_a_calibration_rotations_since_the_reference_frame_are_given_with_a_note(folder):
    assert "The poses of the bones beneath the markers are not known" in estimated()
    table = read_table(folder / "walk_marey" / "angles.mot")
    assert table.columns == ("knee_total_rotation", "knee_total_rotation_sd")
    assert table.values[0, 0] == pytest.approx(0, abs=1e-3)


def test_a_trc_and_a_toml_do_as_well(folder):
    points = marker_points()
    names = {label: f"M{k}" for k, label in enumerate(points)}
    paths = PointPaths(names=tuple(names.values()), time=np.arange(FRAMES) / RATE, rate=RATE,
                       points=np.stack(list(points.values()), 1))  # fmt: skip
    write_trc(folder / "walk.trc", paths)
    rows = {s: ", ".join(f'"{n}"' for k, n in names.items() if k.startswith(s)) for s in ("thigh", "shank")}
    (folder / "who.toml").write_text(
        "[segments]\n" + "".join(f"right_{s} = [{r}]\n" for s, r in rows.items()) + "[noise]\nmm = 0.3\n"
    )
    estimated("walk.trc", clusters="who.toml")
    assert read_table(folder / "walk_marey" / "angles.mot").columns[0] == "right_knee_total_rotation"
    estimated("walk.trc", clusters="who.toml", frames=(0, 20))
    kept = read_markers(folder / "walk_marey" / "motion.c3d")
    assert kept.labels == tuple(names.values())
    assert kept.present.all()


def test_a_segment_of_the_reference_without_markers_is_skipped_and_reported(folder):
    with np.load(folder / "frame0.npz") as file:
        arrays = dict(file)
    write_arrays(folder / "more.npz", {**arrays, "pelvis_rotation": np.eye(3), "pelvis_origin": np.zeros(3)})
    text = estimated(reference="more.npz")
    assert "pelvis, which has no markers in the trial and is skipped" in text
    assert read_bones(folder / "walk_marey" / "bones.npz").motion.segments == ("thigh", "shank")


@pytest.mark.slow
def test_two_runs_can_be_compared_with_their_stated_deviations(folder):
    estimated(reference="frame0.npz", out=folder / "one")
    estimated(reference="frame0.npz", method="pct", out=folder / "two")
    compare("one", "two", shift=0.0, same_laboratory=True).save(folder / "both")
    with (folder / "both" / "compare.csv").open() as file:
        rows = {row["quantity"]: row for row in csv.DictReader(file)}
    assert float(rows["knee_flexion"]["rms"]) < 0.01
    assert float(rows["knee_flexion"]["within_stated_95"]) > 0.9
    assert {"thigh_origin distance", "shank rotation"} <= set(rows)


def test_an_interrupted_run_leaves_no_results_and_is_resumed(folder, monkeypatch):
    def interrupted(*args, **kwargs):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("marey.pipelines.markers.bones.write_results", interrupted)
        with pytest.raises(KeyboardInterrupt):
            estimated(reference="frame0.npz")
    assert [path.name for path in (folder / "walk_marey").iterdir()] == [".work"]
    estimated(reference="frame0.npz")
    assert sorted(path.name for path in (folder / "walk_marey").iterdir()) == FILES


@pytest.mark.parametrize(
    ("trial", "options", "wrong"),
    [
        ("nothing.c3d", {}, "nothing.c3d: does not exist"),
        ("walk.c3d", {"method": "magic"}, "There is no method magic"),
        ("walk.c3d", {"method": "calibration"}, "needs an anatomical calibration in 2 postures"),
        ("walk.c3d", {"reference": "nothing.npz"}, "nothing.npz: does not exist. Correct reference (--reference)."),
        ("walk.c3d", {"side": "up"}, "side (--side) is 'up'"),
        ("walk.c3d", {"unit": "inch"}, "The unit 'inch' is unknown"),
        ("walk.c3d", {"unit": "m"}, "for which its markers would extend over"),
        ("walk.c3d", {"frames": (500, 600)}, "(--frames) begins at 500"),
        ("walk.c3d", {"clusters": "who.toml"}, "has the unknown key 'segment'"),
        ("walk.c3d", {"clusters": "missing.toml"}, "The segment foot has 0 markers"),
        ("loose.c3d", {}, "no three labels that differ only by a number"),
        ("gait.c3d", {}, "The centre of the left knee is unknown: The markers of the joint do not form a triangle"),
        ("empty.c3d", {}, "has no measured point"),
        ("walk.c3d", {"reference": "walk.c3d"}, "is not an NPZ"),
        ("text.c3d", {}, "text.c3d: is too short for a C3D file"),
        ("walk.c3d", {"reference": "feet.npz"}, "has no segment on which the trial has markers"),
        ("notes.txt", {}, "is not a file of markers"),
    ],
)
def test_wrong_input_is_an_error_and_leaves_nothing(folder, trial, options, wrong):
    (folder / "who.toml").write_text('[segment]\nthigh = ["thigh_01"]\n')
    (folder / "missing.toml").write_text('[segments]\nfoot = ["foot_1", "foot_2", "foot_3"]\n')
    (folder / "notes.txt").write_text("x")
    (folder / "text.c3d").write_text("x")
    write_trial(folder / "loose.c3d", dict(zip("ABC", marker_points().values(), strict=False)))
    lower = MARKER_SETS[0].labels[:-1]
    write_trial(folder / "gait.c3d", {label: np.full((4, 3), float(n)) for n, label in enumerate(lower, 1)})
    write_trial(folder / "empty.c3d", {label: np.full((4, 3), np.nan) for label in marker_points()})
    write_arrays(folder / "feet.npz", {"frame": 0, "foot_rotation": np.eye(3), "foot_origin": np.zeros(3)})
    assert wrong in error_of(trial, **options)
    assert not list(folder.glob("*_marey"))


def walking(folder: Path) -> None:
    """Two legs' worth of heel: a foot that swings ahead and settles once a second, while the body goes on."""
    points = marker_points(frames=400)
    time = np.arange(400) / RATE
    hip = true_bones(400)["thigh"][1]
    swing = 0.3 * np.sin(2 * np.pi * time)
    lift = 0.05 * np.maximum(0, np.cos(2 * np.pi * time)) + 0.02
    points["RHEE"] = np.stack([hip[:, 0] + swing, 0 * time, lift], 1)
    write_trial(folder / "gait.c3d", points)
    write_reference(folder / "gait0.npz")


def test_angles_over_the_gait_cycle_are_written_if_a_heel_marker_shows_events(folder):
    walking(folder)
    assert "Gait events found from RHEE" in estimated("gait.c3d", reference="gait0.npz", method="rigid,pct")
    out = folder / "gait_marey"
    with (out / "events.csv").open() as file:
        strikes = [float(row["time_s"]) for row in csv.DictReader(file) if row["event"] == "strike"]
    np.testing.assert_allclose(np.diff(strikes), 1, atol=0.06)
    with (out / "cycles.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 101
    assert {"knee_flexion_deg_mean", "knee_flexion_deg_between_cycles_sd"} <= set(rows[0])
    # Two cycles have a mean, but no standard deviation worth the name.
    assert (rows[50]["knee_flexion_deg_between_cycles_sd"] != "") == (len(strikes) - 1 >= LEAST_CYCLES)
    assert "Gait cycle" in (out / "report.html").read_text()


def test_landmarks_of_a_static_trial_give_the_bones(folder):
    write_static(folder)
    text = estimated(static="static.c3d", side="right", clusters="landmarks.toml")
    assert "is most similar to the static trial" in text
    found = read_bones(folder / "walk_marey" / "bones.npz")
    rotation, origin = true_bones()["thigh"]
    np.testing.assert_allclose(found.motion.bone("thigh")[0], rotation, atol=1e-4)
    np.testing.assert_allclose(found.motion.bone("thigh")[1], origin, atol=1e-4)
    assert "knee_flexion" in read_table(folder / "walk_marey" / "angles.mot").columns
    landmarks, sd = read_static_landmarks(folder / "walk_marey" / "landmarks.csv")
    assert set(landmarks) == {"HJC", "ME", "LE", "MM", "LM", "MC", "LC"}
    rotation, origin = true_bones(1)["thigh"]
    np.testing.assert_allclose(landmarks["LE"], (origin + rotation @ [0.0, -0.40, 0.05])[0], atol=1e-6)
    assert sd == 0.005
    assert "names no landmarks" in error_of(static="static.c3d", side="right")


def test_labels_that_are_exchanged_all_along_show_against_the_static_trial(folder):
    write_static(folder)
    points = marker_points()
    points["thigh_01"], points["thigh_03"] = points["thigh_03"], points["thigh_01"]
    write_trial(folder / "walk.c3d", points)
    text = estimated(static="static.c3d", side="right", clusters="landmarks.toml")
    assert "thigh_01 and thigh_03 look exchanged in every frame" in text


def test_a_medial_landmark_is_put_across_the_joints_centre(folder):
    write_static(folder)
    (folder / "centre.toml").write_text(
        '[landmarks]\nHJC = "HIP"\nKJC = ["EPM", "EPL"]\nLE = "EPL"\nAJC = ["ANM", "ANL"]\nLM = "ANL"\n'
    )
    assert "ME is LE reflected at KJC" in estimated(static="static.c3d", side="right", clusters="centre.toml")
    found = read_bones(folder / "walk_marey" / "bones.npz")
    np.testing.assert_allclose(found.motion.bone("thigh")[0], true_bones()["thigh"][0], atol=1e-4)


@pytest.mark.parametrize(
    ("options", "wrong"),
    [
        ({"functional": "walk.c3d"}, "functional (--functional) gives joint centres in a static trial"),
        ({"exercise_reference": "frame0.npz"}, "exercise_reference (--exercise-reference) requires the trial"),
        ({"weights": "frame0.npz"}, "weights (--weights) requires an OpenSim model"),
        ({"model": "frame0.npz", "reference": "frame0.npz"}, "OpenSim model (--model) defines its own segments"),
        ({"static": "walk.c3d", "reference": "frame0.npz"}, "give one of them"),
    ],
)
def test_settings_that_exclude_each_other_are_reported(folder, options, wrong):
    assert wrong in error_of(**options)


def test_skin_motion_is_learned_from_an_exercise(folder):
    write_trial(folder / "exercise.c3d", marker_points())
    postures = list(range(0, FRAMES, 10))
    write_reference(folder / "known.npz", postures)
    estimated(
        reference="frame0.npz", method="artefact", exercise="exercise.c3d", exercise_reference="known.npz"
    )  # fmt: skip
    found = read_bones(folder / "walk_marey" / "bones.npz").motion
    np.testing.assert_allclose(found.bone("shank")[0], true_bones()["shank"][0], atol=1e-4)


@pytest.mark.slow
def test_a_hip_that_was_moved_about_gives_its_centre(folder, shared):
    trials = shared / "data" / "markers" / "functional"
    (folder / "person.toml").write_text(
        '[segments]\npelvis = ["LASI", "RASI", "LPSI", "RPSI"]\nleft_thigh = ["LF0?"]\n[landmarks]\nRASIS = "RASI"\n'
        'LASIS = "LASI"\nRPSIS = "RPSI"\nLPSIS = "LPSI"\nleft_KJC = "LFEO"\nleft_LE = "LKNE"\n'
    )
    text = estimated(
        trials / "walk.c3d", clusters="person.toml", static=trials / "static.c3d", functional=trials / "left_hip.c3d",
        out=folder / "walk",
    )  # fmt: skip
    assert "left_HJC is the centre about which left_thigh rotates relative to pelvis" in text
    found = read_bones(folder / "walk" / "bones.npz").motion
    hip = read_markers(trials / "walk.c3d").select(["LeftHipCenterScore"]).points[:, 0]
    # The thigh's skin carries the centre here; the pelvis' markers do it within 15 mm in the median.
    assert np.nanmedian(np.linalg.norm(found.bone("left_thigh")[1] - hip, axis=1)) < 0.02
    frames = json.loads((folder / "walk" / "frames.json").read_text())
    assert "force_plate_1" in frames["laboratory_from"]
    with (folder / "walk" / "events.csv").open() as file:
        assert {row["source"] for row in csv.DictReader(file)} == {"given"}
    after = ezc3d.c3d(str(folder / "walk" / "motion.c3d"))
    before = ezc3d.c3d(str(trials / "walk.c3d"))
    np.testing.assert_array_equal(after["data"]["analogs"], before["data"]["analogs"])
    assert after["parameters"]["EVENT"]["TIMES"]["value"].tolist() == before["parameters"]["EVENT"]["TIMES"][
        "value"
    ].tolist()  # fmt: skip


@pytest.mark.slow
def test_a_model_follows_the_markers(folder, shared):
    gait = shared / "data" / "markers" / "gait"
    model = {"model": gait / "model_scaled.osim", "weights": gait / "ik_weights.xml"}
    assert "12 of 12 frames" in estimated(gait / "walk.trc", **model, frames=(0, 12), out=folder / "gait")
    ours = read_table(folder / "gait" / "angles.mot")
    theirs = read_table(gait / "walk_reference_ik.mot")
    assert ours.columns == theirs.columns
    np.testing.assert_allclose(ours.values[:12], theirs.values[:12], atol=0.5)
    assert np.isnan(ours.values[12:]).all()
    assert "No marker is common" in error_of(**model)

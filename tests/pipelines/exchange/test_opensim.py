"""The user's OpenSim model, scaled to a captured person or to the landmarks of a marker trial."""

import json
import warnings
from dataclasses import replace
from xml.etree import ElementTree

import ezc3d
import numpy as np
import pytest
from tests import performer
from tests.trials import marker_points, write_reference, write_trial

import marey
from marey.body.articulation.jointed_kinematics import place
from marey.body.articulation.model_scaling import centre_in_ground, neutral_posture
from marey.cli.main import run
from marey.errors import FileProblem, SettingProblem
from marey.io.devices.results import write_device_clock
from marey.io.markers.readers import read_markers
from marey.io.markers.results import write_static_landmarks
from marey.io.npz import read_motion, write_motion
from marey.io.opensim.mot_sto import read_table
from marey.io.opensim.osim import write_osim
from marey.io.opensim.osim_model import read_osim, read_osim_model
from marey.io.opensim.osim_scaling import body_masses
from marey.io.opensim.osim_tasks import read_tasks
from marey.io.results.body import write_body
from marey.markers.kinematics.inverse_kinematics import inverse_kinematics
from marey.motion.device_clock import DeviceClock
from marey.motion.events.cycles import OFF, STRIKE, GaitEvent
from marey.pipelines.exchange.opensim_tools import ToolInputs, measured_span


def larger(factor):
    """The made-up person, all of whose lengths are larger."""
    person = performer.body()
    space = replace(
        person.space, joint_mean=factor * person.space.joint_mean, vertex_mean=factor * person.space.vertex_mean
    )
    return replace(person, space=space)


@pytest.fixture
def results(tmp_path):
    """The results of a capture of a person of 82 kg."""
    folder, person = tmp_path / "walk01" / "marey", performer.body()
    folder.mkdir(parents=True)
    write_motion(folder / "motion.npz", performer.motion(person))
    write_body(folder / "body.npz", person, preset="full")
    write_osim(folder / "body.osim", person, mass_kg=82.0)
    return folder


@pytest.fixture
def model(tmp_path):
    """A model of somebody else."""
    write_osim(tmp_path / "user.osim", larger(1.3), mass_kg=60.0)
    return tmp_path / "user.osim"


def exported(results, out, **given):
    """Export with a progress reporter, which takes the notes."""
    return marey.export(results, out=out, to="opensim", progress=marey.RecordingProgress(), **given)


def centres(path):
    model = read_osim_model(path)
    placed = place(model, neutral_posture(model))
    return np.array([centre_in_ground(model, placed, name) for name in model.body_names[1:]])


@pytest.mark.slow
def test_the_scaled_model_has_the_joints_and_masses_of_the_person(results, model, tmp_path):
    path = exported(results, tmp_path / "scaled", model=model)
    assert path == tmp_path / "scaled" / "scaled.osim"
    own, scaled = centres(results / "body.osim"), centres(path)
    # The file has 12 digits, and the ground is not scaled: the pelvis stays at the height of the given model.
    np.testing.assert_allclose(scaled - scaled[0], own - own[0], atol=1e-9)
    masses = body_masses(path, read_osim(path))
    assert sum(masses.values()) == pytest.approx(82.0, rel=1e-9)
    report = json.loads((path.parent / "scale.json").read_text())
    assert report["mass_source"] == "given with the trial"
    assert report["bodies"]["left_thigh"]["factors"] == pytest.approx([1 / 1.3] * 3, abs=1e-6)
    assert report["joints"]["left_knee"] == "left_shank"


@pytest.mark.slow
def test_an_estimated_mass_is_marked_with_its_interval(results, model, tmp_path):
    write_osim(results / "body.osim", performer.body())
    path = exported(results, tmp_path / "scaled", model=model)
    report = json.loads((path.parent / "scale.json").read_text())
    low, high = report["mass_interval_kg"]
    assert low < report["mass_kg"] < high
    assert "estimated" in report["mass_source"]
    assert any("The mass was not given" in note for note in report["notes"])


@pytest.mark.slow
def test_notes_are_warnings_without_a_reporter(results, model, tmp_path):
    write_osim(results / "body.osim", performer.body())
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        marey.export(results, out=tmp_path / "scaled", to="opensim", model=model)
    texts = [str(one.message) for one in caught if issubclass(one.category, marey.MareyWarning)]
    assert any("The mass was not given" in text for text in texts)


@pytest.mark.slow
def test_a_given_mass_replaces_that_of_the_recording(results, model, tmp_path):
    path = exported(results, tmp_path / "scaled", model=model, mass_kg=75.0)
    assert sum(body_masses(path, read_osim(path)).values()) == pytest.approx(75.0, rel=1e-9)
    assert json.loads((path.parent / "scale.json").read_text())["mass_source"] == "given"


@pytest.mark.slow
def test_joints_that_are_not_recognised_can_be_named(results, model, tmp_path):
    text = model.read_text()
    for side in ("left", "right"):
        text = text.replace(f"{side}_shank", f"lower_leg_of_the_{side}")
    model.write_text(text)
    (tmp_path / "joints.toml").write_text('[joints]\nleft_knee = "left_knee"\nright_knee = "right_knee"\n')
    path = exported(results, tmp_path / "scaled", model=model, joints=tmp_path / "joints.toml"
    )  # fmt: skip
    report = json.loads((path.parent / "scale.json").read_text())
    assert report["bodies"]["left_thigh"]["factors"] == pytest.approx([1 / 1.3] * 3, abs=1e-6)


@pytest.mark.parametrize(
    ("toml", "says"),
    [
        ('[joints]\nleft_knee = "knee"', "no joint 'knee'"),
        ("[joints]\nleft_knee = 3", r"\[joints\]"),
        ('[joint]\nleft_knee = "left_knee"', r"\[joints\]"),
    ],
)
def test_wrong_joints_are_named(results, model, tmp_path, toml, says):
    (tmp_path / "joints.toml").write_text(toml)
    with pytest.raises(FileProblem, match=says):
        exported(results, tmp_path / "scaled", model=model, joints=tmp_path / "joints.toml")
    assert not (tmp_path / "scaled").exists()


def test_a_model_belongs_to_opensim_alone_and_opensim_needs_one(results, model, tmp_path):
    with pytest.raises(SettingProblem, match="belong to the form opensim"):
        marey.export(results, out=tmp_path / "walk.c3d", to="c3d", model=model)
    with pytest.raises(SettingProblem, match="needs your OpenSim model"):
        marey.export(results, out=tmp_path / "scaled", to="opensim")
    with pytest.raises(SettingProblem, match="mass"):
        exported(results, tmp_path / "scaled", model=model, mass_kg=0.0)


@pytest.mark.slow
def test_the_command_notes_what_it_assumed_and_refuses_other_files_in_one_line(results, model, tmp_path, capsys):
    assert run(["export", str(results), "--to", "opensim", "--model", str(model), "-o", str(tmp_path / "out")]) == 0
    assert "scaled.osim" in capsys.readouterr().out
    bad = tmp_path / "bad.osim"
    bad.write_text("<Model><BodySet/></Model>")
    for given in (str(tmp_path / "none.osim"), str(bad), str(results / "motion.npz")):
        assert run(["export", str(results), "--to", "opensim", "--model", given, "-o", str(tmp_path / "no")]) == 2
        text = capsys.readouterr().err.strip()
        assert len(text.splitlines()) == 1
        assert given.rpartition("/")[2] in text
    assert not (tmp_path / "no").exists()


@pytest.mark.slow
def test_results_of_markers_without_landmarks_are_refused(tmp_path, model):
    write_trial(tmp_path / "walk.c3d", marker_points())
    write_reference(tmp_path / "frame0.npz")
    arguments = ["markers", str(tmp_path / "walk.c3d"), "--reference", str(tmp_path / "frame0.npz"), "-q"]
    assert run(arguments) == 0
    with pytest.raises(FileProblem, match=r"landmarks\.csv"):
        exported(tmp_path / "walk_marey", tmp_path / "out", model=model)
    # Landmarks of one knee's joint centres are enough for a thigh; nothing else is measured.
    write_static_landmarks(
        tmp_path / "walk_marey" / "landmarks.csv", sd_m=0.005,
        landmarks={"left_HJC": np.zeros(3), "left_KJC": np.array([0.0, 0.0, -0.455])},
    )  # fmt: skip
    path = exported(tmp_path / "walk_marey", tmp_path / "out", model=model)
    report = json.loads((path.parent / "scale.json").read_text())
    own = centres(model)
    names = list(read_osim_model(model).body_names[1:])
    length = np.linalg.norm(own[names.index("left_thigh")] - own[names.index("left_shank")])
    assert report["bodies"]["left_thigh"]["factors"][0] == pytest.approx(0.455 / length, abs=1e-6)
    assert report["mass_kg"] is None
    # Two landmarks of 5 mm each: the interval of the factor is 1.96 * sqrt(2) * 5 mm of the model's length wide.
    low, high = report["bodies"]["left_thigh"]["interval"][0]
    assert (high - low) / 2 == pytest.approx(1.959964 * np.sqrt(2) * 0.005 / length, abs=2e-6)


def c3d_with_plates(path, ankle, kilograms=80.0):
    """A C3D whose only plate carries a weight 5 cm beside an ankle, from 0.2 to 0.5 s."""
    c3d = ezc3d.c3d()
    c3d["parameters"]["POINT"]["RATE"]["value"] = [30.0]
    c3d["parameters"]["POINT"]["UNITS"]["value"] = ["m"]
    c3d["parameters"]["POINT"]["LABELS"]["value"] = ["a"]
    c3d["data"]["points"] = np.ones((4, 1, 24))
    c3d["header"]["points"]["first_frame"] = 0
    # The plate has its corners about the ankle; its X is the laboratory's y, its Y the laboratory's x, its Z down.
    corners = ankle * [1, 1, 0] + np.array([[0.3, 0.3, 0], [0.3, -0.3, 0], [-0.3, -0.3, 0], [-0.3, 0.3, 0]])
    force = np.array([0.0, 0.0, 9.81 * kilograms])
    at = np.array([0.0, 0.05, 0.0])
    channels = np.zeros((1, 6, 240))
    channels[0, :, 60:150] = np.concatenate([force, np.cross(at, force)])[:, None]
    c3d["parameters"]["ANALOG"]["RATE"]["value"] = [300.0]
    c3d["parameters"]["ANALOG"]["LABELS"]["value"] = ["Fx", "Fy", "Fz", "Mx", "My", "Mz"]
    c3d["parameters"]["ANALOG"]["UNITS"]["value"] = ["N", "N", "N", "Nm", "Nm", "Nm"]
    c3d["data"]["analogs"] = channels
    c3d.add_parameter("FORCE_PLATFORM", "USED", [1])
    c3d.add_parameter("FORCE_PLATFORM", "TYPE", [2])
    c3d.add_parameter("FORCE_PLATFORM", "ZERO", [0, 0])
    c3d.add_parameter("FORCE_PLATFORM", "CORNERS", corners.T[:, :, None])
    c3d.add_parameter("FORCE_PLATFORM", "ORIGIN", np.zeros((3, 1)))
    c3d.add_parameter("FORCE_PLATFORM", "CHANNEL", np.arange(1.0, 7.0)[:, None])
    c3d.write(str(path))
    return path


@pytest.fixture
def standing(results):
    """The results of a person who stands on the left foot alone."""
    motion = read_motion(results / "motion.npz")
    still = motion.segment_origin.copy()
    names = list(motion.segment_names)
    still[:, names.index("left_foot")] = [0.4, 0.6, 0.08]
    still[:, names.index("right_foot")] = [0.4, 0.2, 0.3]
    write_motion(results / "motion.npz", replace(motion, segment_origin=still))
    return results


@pytest.mark.slow
def test_forces_act_on_the_foot_in_the_axes_of_opensim(standing, model, tmp_path):
    plates = c3d_with_plates(tmp_path / "plates.c3d", np.array([0.4, 0.6, 0.08]))
    path = exported(standing, tmp_path / "scaled", model=model, forces=plates)
    table = read_table(path.parent / "grf.mot")
    columns = dict(zip(table.columns, table.values.T, strict=True))
    on = (table.time > 0.21) & (table.time < 0.49)
    # World y, z, x are OpenSim's x, y, z.
    np.testing.assert_allclose(columns["force_plate_1_left_vy"][on], 9.81 * 80, rtol=1e-6)
    np.testing.assert_allclose(columns["force_plate_1_left_px"][on], 0.6, atol=1e-6)
    np.testing.assert_allclose(columns["force_plate_1_left_py"][on], 0.0, atol=1e-6)
    np.testing.assert_allclose(columns["force_plate_1_left_pz"][on], 0.45, atol=1e-6)
    assert not columns["force_plate_1_left_vy"][table.time > 0.51].any()
    loads = ElementTree.parse(path.parent / "external_loads.xml")
    assert loads.findtext(".//applied_to_body") == "left_foot"
    assert loads.findtext(".//datafile") == "grf.mot"


@pytest.mark.slow
def test_forces_of_another_clock_are_those_of_the_same_instants(standing, model, tmp_path):
    plates = c3d_with_plates(tmp_path / "plates.c3d", np.array([0.4, 0.6, 0.08]))
    clock = DeviceClock(offset_s=0.15, drift=0.01, covariance=np.eye(2) * 1e-6, used=9)
    write_device_clock(tmp_path / "clock.json", clock, method="events")
    path = exported(standing, tmp_path / "scaled", model=model, forces=plates, clock=tmp_path / "clock.json")
    table = read_table(path.parent / "grf.mot")
    loaded = table.time[table.values[:, table.columns.index("force_plate_1_left_vy")] > 100]
    # Samples 60 and 149 of 300 Hz.
    assert loaded[[0, -1]] == pytest.approx(0.15 + 1.01 * np.array([60, 149]) / 300, abs=1e-6)


def test_a_clock_belongs_to_forces_and_is_one(standing, model, tmp_path):
    plates = c3d_with_plates(tmp_path / "plates.c3d", np.array([0.4, 0.6, 0.08]))
    (tmp_path / "clock.json").write_text('{"offset_s": 0.1}')
    with pytest.raises(SettingProblem, match="belongs to force plates"):
        exported(standing, tmp_path / "scaled", model=model, clock=tmp_path / "clock.json")
    with pytest.raises(FileProblem, match=r"clock\.json: is not the clock of a device"):
        exported(standing, tmp_path / "scaled", model=model, forces=plates, clock=tmp_path / "clock.json")
    with pytest.raises(SettingProblem, match="belong to the form opensim"):
        marey.export(standing, out=tmp_path / "a.c3d", to="c3d", clock=tmp_path / "clock.json")


def test_a_file_without_plates_is_refused(standing, model, tmp_path):
    write_trial(tmp_path / "none.c3d", marker_points())
    with pytest.raises(FileProblem, match=r"none\.c3d: has no force plates"):
        exported(standing, tmp_path / "scaled", model=model, forces=tmp_path / "none.c3d")


@pytest.mark.slow
def test_the_scaled_model_follows_the_points_of_the_person_exactly(results, model, tmp_path):
    folder = exported(results, tmp_path / "scaled", model=model).parent
    scaled, tasks = read_osim_model(folder / "scaled.osim"), read_tasks(folder / "ik_tasks.xml")
    found = inverse_kinematics(scaled, tasks, read_markers(folder / "points.trc"))
    motion = marey.load_motion(results).data
    # The longest part of the made-up motion in which every segment is known.
    assert len(found.rms) == 11
    # Points have seven decimals [m], weights six digits; model and person have the same joints.
    assert found.rms.max() < 2e-6
    knee = found.coordinates[:, found.coordinate_names.index("left_knee_flexion")]
    own = motion.coordinate("left_knee_flexion")
    np.testing.assert_allclose(knee, own[13:24], atol=1e-4)


def inputs(first, last):
    return ToolInputs(points=(), paths=None, weights=np.zeros(0), held=(), span=(first, last), assumed=False)


def events(*each):
    return [GaitEvent(kind=kind, side=side, time=time, source="given") for kind, side, time in each]


def test_forces_are_complete_while_every_standing_foot_is_on_a_plate():
    walk = events(
        (OFF, "right", 0.4), (STRIKE, "left", 0.3), (OFF, "left", 1.0), (STRIKE, "right", 0.9), (OFF, "right", 1.6),
        (STRIKE, "left", 1.5), (OFF, "left", 2.2),
    )  # fmt: skip
    contacts = [("left", 0.31, 1.01), ("right", 0.91, 1.61)]
    # The right foot stands elsewhere until 0.4 s, the left one from 1.5 s on.
    assert measured_span(inputs(0.0, 2.5), walk, contacts) == (0.4, 1.5)
    assert measured_span(inputs(0.0, 1.2), walk, contacts) == (0.4, 1.2)
    assert measured_span(inputs(0.0, 2.5), walk, []) is None
    assert measured_span(inputs(0.0, 2.5), [], contacts) == (0.31, 1.61)


def test_opensim_runs_inverse_kinematics_and_dynamics_from_the_files(standing, model, tmp_path, monkeypatch):
    opensim = pytest.importorskip("opensim", reason="The package opensim is not installed.")
    opensim.Logger.setLevelString("off")
    plates = c3d_with_plates(tmp_path / "plates.c3d", np.array([0.4, 0.6, 0.08]))
    folder = exported(standing, tmp_path / "scaled", model=model, forces=plates).parent
    monkeypatch.chdir(folder)
    assert opensim.InverseKinematicsTool("ik_setup.xml").run()
    assert opensim.InverseDynamicsTool("id_setup.xml").run()
    assert np.isfinite(read_table(folder / "id.sto").values).all()


SETUP = """
[segments]
pelvis = ["LASI", "RASI", "LPSI", "RPSI"]
left_thigh = ["LF01", "LF02", "LF03", "LF04", "LF05", "LTHI"]
right_thigh = ["RF01", "RF02", "RF03", "RF04", "RF05", "RTHI"]
left_shank = ["LT01", "LT02", "LT03", "LT04", "LT05", "LTIB"]
right_shank = ["RT01", "RT02", "RT03", "RT04", "RT05", "RTIB"]
left_foot = ["LANK", "LHEE", "LTOE"]
right_foot = ["RANK", "RHEE", "RTOE"]

[landmarks]
LASIS = "LASI"
RASIS = "RASI"
LPSIS = "LPSI"
RPSIS = "RPSI"
left_HJC = "LFEP"
right_HJC = "RFEP"
left_KJC = "LFEO"
right_KJC = "RFEO"
left_AJC = "LTIO"
right_AJC = "RTIO"
left_LE = "LKNE"
right_LE = "RKNE"
left_LM = "LANK"
right_LM = "RANK"
"""


@pytest.mark.slow
def test_a_walk_over_force_plates_is_ready_for_inverse_dynamics(shared, tmp_path):
    data = shared / "data" / "markers"
    (tmp_path / "person.toml").write_text(SETUP)
    model, progress = data / "gait" / "model_scaled.osim", marey.RecordingProgress()
    trial = marey.open_markers(
        data / "functional" / "walk.c3d", clusters=tmp_path / "person.toml", static=data / "functional" / "static.c3d",
        progress=progress,
    )  # fmt: skip
    marey.estimate_bones(trial, ["rigid"], progress=progress).save(tmp_path / "walk")
    folder = marey.export(
        tmp_path / "walk", out=tmp_path / "out", to="opensim", model=model, mass_kg=60.0, progress=progress
    ).parent
    said = " ".join(progress.warnings)
    for plate, side in ((3, "left"), (1, "right"), (2, "left")):
        assert f"force_plate_{plate} carries the {side} foot" in said
    assert "The trunk was not measured" in said
    span = ElementTree.parse(folder / "id_setup.xml").findtext(".//time_range").split()
    # By the events of the file the right foot leaves the floor outside of the plates at 5.158 s and strikes at 6.642 s.
    assert [float(v) for v in span] == pytest.approx([5.1583, 6.6417], abs=1e-3)
    scaled = read_osim_model(folder / "scaled.osim")
    found = inverse_kinematics(scaled, read_tasks(folder / "ik_tasks.xml"), read_markers(folder / "points.trc"))
    # Bones that follow their own markers come apart at the joints by the motion of the skin, some centimetres at most.
    assert np.nanmax(found.rms) < 0.03
    knee = np.degrees(found.coordinates[:, found.coordinate_names.index("knee_angle_l")])
    assert -80 < knee.min() < -45
    table = read_table(folder / "grf.mot")
    total = table.values[:, [name.endswith("_vy") for name in table.columns]].sum(1)
    inside = (table.time > float(span[0])) & (table.time < float(span[1]))
    # Over a whole step and more the mean vertical force is about the weight.
    assert total[inside].mean() == pytest.approx(60 * 9.81, rel=0.05)

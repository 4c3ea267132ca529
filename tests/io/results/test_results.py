"""Every result file contains the same motion, also when read by other programs."""

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from bench.capture import formats
from tests import people, performer
from tests.point_files import read_points

from marey.arrays import Floats
from marey.body.articulation.surface import Body
from marey.body.metaballs.metaball_people import metaball_person
from marey.body.metaballs.metaball_person import metaball_body, reshaped, single_radii
from marey.body.people.mass import estimated_mass
from marey.body.people.person import person_body
from marey.errors import FileProblem
from marey.io import npz
from marey.io.gltf.character import read_character
from marey.io.markers.c3d import read_c3d
from marey.io.opensim.osim import write_osim
from marey.io.results.body import open_body, read_body, segment_lengths, write_body
from marey.io.results.csv import write_angles
from marey.io.results.netcdf import write_netcdf
from marey.io.results.results import write_results
from marey.motion.motion import NO_PERSON, BodyMotion

FILES = {
    "joint_centres.trc", "angles.mot", "body.osim", "orientations.sto", "motion.c3d", "motion.bvh", "body.glb",
    "motion.npz", "motion.nc", "angles.csv", "body.npz", "skin.npz",
}  # fmt: skip


@pytest.fixture(scope="module")
def skin(person: Body, motion: BodyMotion) -> Floats:
    vertices = np.full((len(motion), *person.vertices.shape), np.nan)
    for f in np.flatnonzero(motion.answered):
        vertices[f] = performer.pose(person, motion.coordinates[f]).vertices
    return vertices


@pytest.fixture(scope="module")
def results(person: Body, motion: BodyMotion, skin: Floats, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("trial") / "marey"
    write_results(folder, motion, person, preset="full", mass_kg=70, skin=skin)
    return folder


def test_exactly_the_expected_files_are_written(results: Path):
    assert {path.name for path in results.iterdir()} == FILES


def masses_of(model: Path) -> dict[str, float]:
    """Return the masses of the bodies of an OpenSim model [kg]."""
    return {body.attrib["name"]: float(body.findtext("mass", "nan")) for body in ElementTree.parse(model).iter("Body")}


def test_the_mass_of_the_person_is_that_of_the_bodies_of_the_model(results: Path, person: Body, tmp_path: Path):
    masses = masses_of(results / "body.osim")
    assert sum(masses.values()) == pytest.approx(70, rel=1e-3)
    assert masses["left_thigh"] == pytest.approx(masses["right_thigh"], rel=0.05)


def test_a_mass_that_is_not_given_is_estimated_from_the_volume_and_marked(person: Body, tmp_path: Path):
    path = tmp_path / "without.osim"
    write_osim(path, person)
    mass, sd = estimated_mass(person)
    assert sum(masses_of(path).values()) == pytest.approx(mass, rel=1e-3)
    assert min(masses_of(path).values()) > 0
    credits = ElementTree.parse(path).findtext("Model/credits", "")
    assert f"{mass:.1f} kg (95 % interval {mass - 1.96 * sd:.0f} to {mass + 1.96 * sd:.0f} kg) is estimated" in credits


@pytest.mark.parametrize(
    ("program", "check"),
    [
        ("opensim", "check_opensim"), ("ezc3d", "check_c3d"), ("pygltflib", "check_glb"), ("numpy", "check_bvh"),
        ("xarray", "check_netcdf"), ("bpy", "check_blender"),
    ],
)  # fmt: skip
def test_other_programs_read_the_same_motion(results: Path, motion: BodyMotion, program: str, check: str):
    pytest.importorskip(program)
    found = getattr(formats, check)(results, motion.arrays())
    assert found
    for name, difference in found.items():
        assert difference <= formats.LIMITS[name.rsplit("[", 1)[1][:-1]], name


def test_the_motion_is_read_as_written(results: Path, motion: BodyMotion):
    back = npz.read_motion(results / "motion.npz").arrays()
    assert back.keys() == motion.arrays().keys()
    for name, value in motion.arrays().items():
        np.testing.assert_array_equal(back[name], value, err_msg=name)
        assert back[name].dtype == value.dtype


def test_a_file_that_does_not_state_which_angles_are_determined_is_read(tmp_path: Path, motion: BodyMotion):
    npz.write_motion(tmp_path / "motion.npz", replace(motion, angles_determined=None))
    assert "angles_determined" not in npz.read_arrays(tmp_path / "motion.npz")
    assert npz.read_motion(tmp_path / "motion.npz").angles_determined is None
    write_angles(tmp_path / "angles.csv", replace(motion, angles_determined=None))
    assert "not_determined" not in (tmp_path / "angles.csv").read_text()
    write_netcdf(tmp_path / "motion.nc", replace(motion, angles_determined=None))


def test_the_skin_is_read_as_written(results: Path, skin: Floats, person: Body):
    back = npz.read_arrays(results / "skin.npz", ("vertices", "faces", "seen"))
    np.testing.assert_allclose(back["vertices"], skin, atol=1e-6)
    np.testing.assert_array_equal(back["faces"], person.faces)
    assert back["seen"].dtype == bool


def test_a_skin_from_an_iterable_is_the_same_and_a_short_one_is_rejected(results: Path, skin, person, tmp_path):
    count = len(person.vertices)
    npz.write_skin(tmp_path / "skin.npz", iter(skin), person.faces, frames=len(skin), count=count)
    one, other = (npz.read_arrays(folder / "skin.npz") for folder in (results, tmp_path))
    for name in one:
        np.testing.assert_array_equal(one[name], other[name])
    with pytest.raises(ValueError, match="rows instead of"):
        npz.write_skin(tmp_path / "short.npz", iter(skin[1:]), person.faces, frames=len(skin), count=count)
    assert not (tmp_path / "short.npz").exists()


def test_points_are_read_from_every_file_that_has_them(results: Path, motion: BodyMotion):
    for name in ("joint_centres.trc", "motion.c3d", "motion.npz"):
        paths = read_points(results / name)
        assert paths.names == motion.joint_names
        np.testing.assert_allclose(paths.points, motion.joint_centres, atol=2e-7)
        np.testing.assert_allclose(paths.time, motion.time, atol=1e-6)


def test_the_angles_are_a_table_with_units(results: Path, motion: BodyMotion):
    lines = (results / "angles.csv").read_text().splitlines()
    head = lines[0].split(",")
    assert head[:4] == ["time_s", "state", f"{motion.angle_names[0]}_deg", f"{motion.angle_names[0]}_sd_deg"]
    assert head[-1] == "not_determined"
    assert lines[1].split(",")[2:] == [""] * (len(head) - 2)
    rows = np.genfromtxt(results / "angles.csv", delimiter=",", skip_header=1)
    np.testing.assert_allclose(rows[:, 2:-1:2], motion.angles_deg, atol=0.5e-5)
    np.testing.assert_array_equal(rows[:, 1], motion.state)
    known = np.isfinite(motion.angles_deg)
    for line, sure, there in zip(lines[1:], motion.angles_determined, known, strict=True):
        named = [name for name, a, b in zip(motion.angle_names, sure, there, strict=True) if b and not a]
        assert line.split(",")[-1] == " ".join(named)
    assert any(line.split(",")[-1] for line in lines[1:])


def test_a_bvh_is_continuous_through_gaps_and_full_rotations(results: Path):
    text = (results / "motion.bvh").read_text().split("Frame Time:")[1].splitlines()[1:]
    values = np.array([line.split() for line in text], float)
    assert np.isfinite(values).all()
    assert np.abs(np.diff(values[:, 3:], axis=0)).max() < 180


def test_a_body_is_read_as_written(tmp_path, rng):
    person = people.stick_person(rng)
    person = replace(person, numbers_covariance=np.diag([0.1, 0.2, 0.3, 0.4, 0.5]))
    write_body(tmp_path / "body.npz", person, preset="full")
    back, preset = read_body(tmp_path / "body.npz")
    assert preset == "full"
    assert back.skeleton.coordinate_names == person.skeleton.coordinate_names
    assert [c.segment for c in back.skeleton.coordinates] == [c.segment for c in person.skeleton.coordinates]
    for name in ("vertices", "joint_centres", "faces", "vertex_segments", "vertex_weights", "numbers_covariance"):
        np.testing.assert_array_equal(getattr(back, name), getattr(person, name), err_msg=name)
    for name in ("axes", "limits", "parents"):
        np.testing.assert_array_equal(getattr(back.skeleton, name), getattr(person.skeleton, name))
    np.testing.assert_array_equal(back.with_numbers(0 * back.numbers).vertices, person.space.vertex_mean)


def test_lengths_include_the_uncertainty_of_the_shape(rng):
    person = people.stick_person(rng)
    covariance = 1e-4 * np.diag([0.1, 0.2, 0.3, 0.4, 0.5])
    person = replace(person, numbers_covariance=covariance)
    length, sd = segment_lengths(person)
    k = person.skeleton.segment_names.index("left_thigh")
    shank = person.skeleton.segment_names.index("left_shank")
    assert length[k] == pytest.approx(np.linalg.norm(person.joint_centres[shank] - person.joint_centres[k]))
    count = 3000
    drawn = [person.with_numbers(n) for n in rng.multivariate_normal(person.numbers, covariance, count)]
    spread = np.std([np.linalg.norm(b.joint_centres[shank] - b.joint_centres[k]) for b in drawn])
    assert spread == pytest.approx(sd[k], rel=4 / np.sqrt(2 * count))


def test_lengths_include_the_uncertainty_of_joint_centres_relative_to_the_skin(rng):
    person = replace(people.stick_person(rng), numbers_covariance=np.zeros((5, 5)))
    offsets = rng.uniform(0.002, 0.02, len(person.skeleton.segment_names))
    _, sd = segment_lengths(replace(person, joint_offset_sd=offsets))
    k, shank = (person.skeleton.segment_names.index(name) for name in ("left_thigh", "left_shank"))
    assert sd[k] == pytest.approx(np.hypot(offsets[k], offsets[shank]))


def test_the_uncertainty_of_joint_centres_is_read_as_written(rng, tmp_path):
    known = rng.uniform(0.002, 0.02, 21)
    person = people.stick_person(rng)
    person = replace(person, joint_sd=known[: len(person.joint_centres)], joint_offset_sd=None)
    write_body(tmp_path / "body.npz", person, preset="full")
    back, _ = read_body(tmp_path / "body.npz")
    np.testing.assert_array_equal(back.joint_sd, person.joint_sd)
    assert back.joint_offset_sd is None


def test_the_followed_segments_are_read_as_written(tmp_path):
    limb = person_body("coarse", preset="right_arm")
    write_body(tmp_path / "body.npz", limb, preset="right_arm")
    back, preset = read_body(tmp_path / "body.npz")
    assert preset == "right_arm"
    np.testing.assert_array_equal(back.outline_counts, limb.outline_counts)
    np.testing.assert_array_equal(back.followed_joints, limb.followed_joints)


def test_a_body_of_metaballs_is_read_as_written(tmp_path, rng):
    made = metaball_person("simple", "coarse", preset="right_arm")
    made = reshaped(made, rng.normal(size=len(made.space)) * 0.05)
    person = replace(made, numbers_covariance=0.01 * made.space.prior_covariance)
    write_body(tmp_path / "body.npz", person, preset="right_arm")
    back, _ = read_body(tmp_path / "body.npz")
    for name in ("vertices", "joint_centres", "numbers", "numbers_covariance", "joint_sd", "joint_offset_sd"):
        np.testing.assert_array_equal(getattr(back, name), getattr(person, name), err_msg=name)
    assert back.skeleton.coordinate_names == back.metaballs.mean.skeleton.coordinate_names
    other = rng.normal(size=len(made.space)) * 0.05
    np.testing.assert_array_equal(reshaped(back, other).vertices, reshaped(person, other).vertices)
    np.testing.assert_array_equal(back.space.leading, person.space.leading)


@pytest.mark.slow
def test_radii_in_the_file_include_the_uncertainty_of_the_shape_parameters(tmp_path, rng):
    person = metaball_person("simple", "coarse")
    covariance = 0.01 * person.space.prior_covariance
    write_body(tmp_path / "body.npz", replace(person, numbers_covariance=covariance), preset="full")
    count = 2000
    drawn = [person.metaballs.balls(n).radii for n in rng.multivariate_normal(person.numbers, covariance, count)]
    with np.load(tmp_path / "body.npz") as stored:
        np.testing.assert_array_equal(stored["metaball_radii"], person.metaballs.balls(person.numbers).radii)
        np.testing.assert_allclose(stored["metaball_radii_sd"], np.std(drawn, 0), rtol=5 / np.sqrt(2 * count))
        centres = stored["metaball_centre"] + stored["segment_origin"][stored["metaball_segment"]]
        shapes = {name: stored[f"metaball_{name}"].shape for name in ("centre", "radii", "weight", "rotation")}
    np.testing.assert_allclose(centres, person.metaballs.balls(person.numbers).at_rest().place)
    m = len(person.metaballs.mean)
    assert shapes == {"centre": (m, 3), "radii": (m, 3), "weight": (m,), "rotation": (m, 3, 3)}


@pytest.mark.slow
def test_weights_are_read_as_written_with_their_uncertainty(tmp_path, rng):
    person = metaball_person("simple", "coarse", preset="right_arm")
    space = single_radii(person.metaballs, ["forearm"])
    numbers, count = np.zeros(len(space)), 4000
    sharp = [name.endswith("sharpness") for name in space.names]
    numbers[sharp] = [0.4, -0.3, 0.2]
    covariance = 1e-3 * np.eye(len(space))
    made = replace(metaball_body(space, numbers, person, keep_weights=True), numbers_covariance=covariance)
    write_body(tmp_path / "body.npz", made, preset="right_arm")
    back, _ = read_body(tmp_path / "body.npz")
    balls = back.metaballs.balls(back.numbers)
    np.testing.assert_allclose(balls.weight, space.balls(numbers).weight, rtol=1e-12)
    assert balls.weight.max() > 1.2
    assert balls.weight.min() < 0.9
    drawn = [space.balls(n).weight for n in rng.multivariate_normal(numbers, covariance, count)]
    with np.load(tmp_path / "body.npz") as stored:
        np.testing.assert_allclose(stored["metaball_weight"], balls.weight, rtol=1e-12)
        np.testing.assert_allclose(stored["metaball_weight_sd"], np.std(drawn, 0), rtol=0.1, atol=1e-12)
        old = {k: stored[k] for k in stored.files if k not in ("metaball_mean_weight", "metaball_weight_sd")}
    npz.write_arrays(tmp_path / "damaged.npz", old | {"metaball_weight": balls.weight + 0.1})
    with pytest.raises(FileProblem, match="metaballs differ from those of its shape parameters"):
        read_body(tmp_path / "damaged.npz")


def test_a_body_from_before_weights_were_fitted_is_read(tmp_path):
    write_body(tmp_path / "body.npz", metaball_person("simple", "coarse"), preset="full")
    later = ("metaball_mean_weight", "metaball_weight_sd", "metaball_sharpness_modes", "metaball_fall")
    with np.load(tmp_path / "body.npz") as stored:
        npz.write_arrays(tmp_path / "old.npz", {k: stored[k] for k in stored.files if k not in later})
    space = read_body(tmp_path / "old.npz")[0].metaballs
    assert not space.sharpness_modes.any()
    np.testing.assert_array_equal(space.balls(np.ones(len(space)) * 0.01).weight, 1.0)


def test_metaballs_that_differ_from_those_of_the_shape_parameters_are_rejected(tmp_path):
    write_body(tmp_path / "body.npz", metaball_person("simple", "coarse"), preset="full")
    stored = npz.read_arrays(tmp_path / "body.npz")
    npz.write_arrays(tmp_path / "moved.npz", stored | {"metaball_centre": stored["metaball_centre"] + 0.01})
    with pytest.raises(FileProblem, match="metaballs differ from those of its shape parameters"):
        read_body(tmp_path / "moved.npz")
    npz.write_arrays(tmp_path / "less.npz", {k: v for k, v in stored.items() if k != "metaball_radii_modes"})
    with pytest.raises(FileProblem, match="metaball_radii_modes"):
        read_body(tmp_path / "less.npz")


def test_a_mesh_has_no_metaballs(results: Path):
    with np.load(results / "body.npz") as stored:
        assert [stored[f"metaball_{name}"].shape for name in ("segment", "centre", "radii")] == [(0,), (0, 3), (0, 3)]
    assert read_body(results / "body.npz")[0].metaballs is None


def test_a_written_glb_is_read_as_the_same_body(results: Path, person: Body):
    character = read_character(results / "body.glb")
    np.testing.assert_allclose(character.vertices, person.vertices, atol=1e-6)
    np.testing.assert_array_equal(character.faces, person.faces)
    assert character.weights is not None
    for k, name in enumerate(person.skeleton.segment_names):
        np.testing.assert_allclose(character.joint_centres[name], person.joint_centres[k], atol=1e-6)
        share = np.where(person.vertex_segments == k, person.vertex_weights, 0).sum(1)
        np.testing.assert_allclose(character.weights[name], share, atol=1e-6)


def test_a_body_is_opened_from_npz_and_from_glb(results: Path, person: Body, tmp_path):
    np.testing.assert_array_equal(open_body(results / "body.npz", person).vertices, person.vertices)
    body = open_body(results / "body.glb", person)
    np.testing.assert_allclose(body.joint_centres, person.joint_centres - person.joint_centres[0], atol=1e-6)
    np.testing.assert_allclose(body.vertices, person.vertices - person.joint_centres[0], atol=1e-6)
    (tmp_path / "scan.toml").write_text(f'mesh = "{results / "body.glb"}"\n[joints]\nleft_hip = [0, 0, 0]\n')
    with pytest.raises(FileProblem, match="right_knee"):
        open_body(tmp_path / "scan.toml", person)


def test_a_motion_without_any_pose_is_written(person: Body, motion: BodyMotion, tmp_path):
    empty = replace(
        motion,
        **{
            name: np.full_like(getattr(motion, name), np.nan)
            for name in ("joint_centres", "segment_rotation", "segment_origin", "coordinates", "angles_deg")
        },
        state=np.full(len(motion), NO_PERSON),
    )
    write_results(tmp_path, empty, person, preset="full")
    assert {path.name for path in tmp_path.iterdir()} == FILES - {"motion.bvh", "skin.npz"}
    assert np.isnan(read_c3d(tmp_path / "motion.c3d").points).all()


def test_a_damaged_file_is_an_error_that_names_it(results: Path, tmp_path):
    for name, read in (("motion.npz", npz.read_motion), ("body.npz", read_body), ("motion.c3d", read_c3d)):
        whole = (results / name).read_bytes()
        damaged = tmp_path / name
        damaged.write_bytes(whole[: len(whole) // 3])
        with pytest.raises(FileProblem, match=name):
            read(damaged)
        with pytest.raises(FileProblem, match="does not exist"):
            read(tmp_path / f"no_{name}")
    arrays = npz.read_arrays(results / "body.npz")
    npz.write_arrays(tmp_path / "faces.npz", arrays | {"faces": arrays["faces"] + 10**6})
    with pytest.raises(FileProblem, match=r"faces\.npz: has a skin that differs"):
        read_body(tmp_path / "faces.npz")
    with pytest.raises(FileProblem, match="lacks time"):
        npz.read_motion(results / "skin.npz")

import numpy as np
import pytest

from marey.errors import FileProblem
from marey.geometry import rotations
from marey.io.markers.setup import read_marker_setup, read_reference


def test_marker_settings_are_read(tmp_path):
    path = tmp_path / "markers.toml"
    path.write_text(
        '[segments]\nthigh = ["a", "b", "c"]\nshank = ["s*"]\n[landmarks]\nleft_LE = "LKNE"\nHJC = ["u", "v"]\n'
        '[joints.knee]\nparent = "thigh"\nchild = "shank"\ndegrees_of_freedom = 3\n[noise]\nmm = 0.4\n'
    )
    setup = read_marker_setup(path)
    assert setup.segments == {"thigh": ("a", "b", "c"), "shank": ("s*",)}
    assert setup.landmarks == {"left_LE": ("LKNE",), "HJC": ("u", "v")}
    assert (setup.joints[0].name, setup.joints[0].degrees_of_freedom) == ("knee", 3)
    assert setup.noise_m == pytest.approx(4e-4)


def test_unknown_keys_are_errors_that_list_the_known_ones(tmp_path):
    path = tmp_path / "markers.toml"
    path.write_text('[segment]\na = ["b"]\n[noise]\nmm = -1\n[joints.knee]\nparent = "a"\nchild = "b"\ndof = 3\n')
    with pytest.raises(FileProblem, match=r"'segment'.*The known keys are \[segments\]") as caught:
        read_marker_setup(path)
    assert "'joints.knee.dof'" in str(caught.value)
    assert "noise.mm = -1" in str(caught.value)


def test_a_joint_of_an_unknown_segment_is_an_error(tmp_path):
    path = tmp_path / "markers.toml"
    path.write_text('[segments]\na = ["x"]\n[joints.knee]\nparent = "a"\nchild = "b"\n')
    with pytest.raises(FileProblem, match="unknown segments b"):
        read_marker_setup(path)


@pytest.fixture
def turn(rng) -> np.ndarray:
    return np.stack([rotations.exp(v) for v in rng.normal(size=(2, 3))])


def test_one_posture_and_several_are_read_in_metres(tmp_path, turn):
    path = tmp_path / "reference.npz"
    np.savez(
        path, frame=0, thigh_rotation=turn[0], thigh_origin=[1000.0, 0, 0], hip_rotation=turn[0], hip_origin=[0] * 3
    )
    one, notes = read_reference(path, ("shank", "thigh"), frames=9)
    assert one.segments == ("thigh",)
    assert "hip" in notes[0]
    assert "shank" in notes[1]
    np.testing.assert_array_equal(one.origin, [[[1, 0, 0]]])
    np.savez(path, frame=[0, 8], thigh_rotation=turn, thigh_origin=np.full((2, 3), 500.0))
    two, notes = read_reference(path, ("thigh",), frames=9)
    assert (two.postures, notes) == (2, ())
    np.testing.assert_array_equal(two.rotation[:, 0], turn)


@pytest.mark.parametrize(
    ("change", "wrong"),
    [
        ({"frame": 9}, "frame 9"),
        ({"frame": 0.5}, "not an integer"),
        ({"thigh_origin": None}, "lacks thigh_origin"),
        ({"thigh_rotation": np.eye(3) * 2}, "not a rotation"),
        ({"thigh_rotation": np.diag([1.0, 1, -1])}, "not a rotation"),
        ({"thigh_rotation": np.full((3, 3), np.nan)}, "not a rotation"),
        ({"thigh_origin": np.full(3, np.nan)}, "thigh_origin that is not finite"),
        ({"thigh_rotation": np.zeros((4, 3, 3))}, "shape"),
        ({"frame": None}, "lacks frame"),
    ],
)
def test_an_invalid_reference_is_an_error_that_states_the_problem(tmp_path, change: dict, wrong: str):
    path = tmp_path / "reference.npz"
    whole = {"frame": 0, "thigh_rotation": np.eye(3), "thigh_origin": np.zeros(3)} | change
    np.savez(path, **{key: value for key, value in whole.items() if value is not None})
    with pytest.raises(FileProblem, match=wrong):
        read_reference(path, ("thigh",), frames=9)


def test_a_reference_of_other_segments_is_an_error(tmp_path):
    path = tmp_path / "reference.npz"
    np.savez(path, frame=0, hip_rotation=np.eye(3), hip_origin=np.zeros(3))
    with pytest.raises(FileProblem, match=r"It has hip; the trial has markers on thigh"):
        read_reference(path, ("thigh",), frames=9)


def test_skin_settings_are_read_with_functions_from_a_file(tmp_path):
    np.savetxt(tmp_path / "bump.csv", np.arange(6.0).reshape(3, 2), delimiter=",")
    path = tmp_path / "markers.toml"
    path.write_text(
        '[skin.thigh]\nform = "sinusoid"\nperiod_s = 1.1\nstill = ["thigh_03"]\n'
        '[skin.shank]\nform = "file"\nfile = "bump.csv"\n'
    )
    skin = read_marker_setup(path).skin
    assert (skin["thigh"].form, skin["thigh"].period_s, skin["thigh"].still) == ("sinusoid", 1.1, ("thigh_03",))
    np.testing.assert_array_equal(skin["shank"].functions, [[0, 1], [2, 3], [4, 5]])


@pytest.mark.parametrize(
    ("table", "wrong"),
    [
        ('form = "wave"', "form = 'wave'"),
        ('form = "time"\nperiod_s = 1.0', r"period_s in \[skin.thigh\], which does not apply to form = 'time'"),
        ('form = "file"', "no `file`"),
        ('form = "file"\nfile = "none.csv"', "cannot be read"),
        ('form = "file"\nfile = "words.csv"', "not a table of numbers"),
        ('form = "file"\nfile = "empty.csv"', "is empty"),
        ('form = "spline"\npieces = 0', "pieces = 0"),
    ],
)
def test_invalid_skin_settings_are_errors_that_state_the_problem(tmp_path, table: str, wrong: str):
    (tmp_path / "words.csv").write_text("time,skin\n0,1\n")
    (tmp_path / "empty.csv").write_text("")
    path = tmp_path / "markers.toml"
    path.write_text(f"[skin.thigh]\n{table}\n")
    with pytest.raises(FileProblem, match=wrong):
        read_marker_setup(path)

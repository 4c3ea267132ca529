import pytest

from marey.errors import FileProblem
from marey.io.file_names import name_faults, require_plain_names
from marey.io.markers.setup import read_marker_setup


@pytest.mark.parametrize("name", ["cam01", "left thigh", "Kamera ä", "1", "a.b", "x" * 100, ".hidden", "common"])
def test_plain_names_are_accepted(name):
    assert name_faults(name) == []


@pytest.mark.parametrize(
    ("name", "fault"),
    [
        *((name, "is a path") for name in ("../x", "/x", "a/b", "a\\b", ".", "..", "C:\\x")),
        *((name, "control characters") for name in ("a\nb", "a\0b", "\u202ex", "\udcff")),
        *((name, "has no name") for name in ("", " ", "\t")),
        *((name, "one of the characters") for name in ("a:b", "a?", "<script>", 'a"b', "*")),
        *((name, "cannot be a file name") for name in ("con", "NUL", "Com1.png", "a.", "a ", " a")),
        ("x" * 101, "101 characters"),
        ("ä" * 100 + "x", "101 characters"),
        ("漢" * 70, "210 bytes"),
    ],
)
def test_other_names_have_one_fault(name, fault):
    (clause,) = name_faults(name)
    assert fault in clause


@pytest.mark.parametrize("table", ["segments", "landmarks", "joints"])
def test_names_of_a_marker_setup_are_plain(tmp_path, table):
    entry = '{ parent = "a", child = "b" }' if table == "joints" else '["m1", "m2", "m3"]'
    (tmp_path / "setup.toml").write_text(f'[{table}]\n"../thigh" = {entry}\n')
    with pytest.raises(FileProblem, match=rf"setup.toml: {table[:-1]} '../thigh' has a name that is a path"):
        read_marker_setup(tmp_path / "setup.toml")


def test_the_error_shows_a_name_on_one_line(tmp_path):
    with pytest.raises(FileProblem, match=r"f: segment 'a\\nb' has a name with control characters") as error:
        require_plain_names(tmp_path / "f", ["a\nb"], kind="segment")
    assert "\n" not in str(error.value)

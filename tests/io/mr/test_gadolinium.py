import json

import numpy as np
import pytest

from marey.errors import FileProblem
from marey.io.mr.gadolinium import MarkersInScanner, read_markers, write_markers
from marey.knee.markers.gadolinium import Gadolinium


def markers() -> MarkersInScanner:
    centres = np.array([[10.0, -20, 30], [0.5, 4, -8.25], [1, 2, 3]])
    return MarkersInScanner.of(
        Gadolinium(centres_mm=centres, centres_sd_mm=np.full((3, 3), 0.05), diameter_mm=np.array([6.0, 6.0, 5.9]))
    )


def test_written_markers_are_read_with_names_added_by_hand(tmp_path):
    file = tmp_path / "markers.json"
    write_markers(file, markers())
    table = json.loads(file.read_text(encoding="utf-8"))
    assert "marker_names" not in table
    table |= {"marker_names": ["THI1", None, "SHA1"], "marker_segment": ["femur", "femur", "tibia"]}
    file.write_text(json.dumps(table), encoding="utf-8")
    read = read_markers(file)
    np.testing.assert_allclose(read.centres_mm, markers().centres_mm)
    np.testing.assert_allclose(read.sd_mm, 0.05)
    assert read.names == ("THI1", None, "SHA1")
    assert read.bones == ("femur", "femur", "tibia")
    write_markers(file, read)
    assert json.loads(file.read_text(encoding="utf-8")) == table


def test_names_stay_with_markers_that_are_found_again():
    old = markers()
    named = MarkersInScanner(
        centres_mm=old.centres_mm[[2, 0]] + 0.5, sd_mm=old.sd_mm[:2], names=("C", "A"), bones=("tibia", None)
    )
    again = old.named_as(named)
    assert again.names == ("A", None, "C")
    assert again.bones == (None, None, "tibia")
    assert old.named_as(old).names == ()


@pytest.mark.parametrize(
    ("change", "wrong"),
    [
        ({"marker_centres_sd_mm": [[1, 1, 1]]}, "three standard deviations"),
        ({"marker_centres_lps_mm": "many"}, "has no marker_centres_lps_mm"),
        ({"marker_names": ["A"]}, "one entry of marker_names for each of the 3 markers"),
        ({"marker_names": [1, 2, 3]}, "not texts"),
        ({"marker_segment": ["fibula", None, None]}, "unknown bone .fibula"),
    ],
)
def test_a_damaged_file_is_named(tmp_path, change, wrong):
    file = tmp_path / "markers.json"
    write_markers(file, markers())
    file.write_text(json.dumps(json.loads(file.read_text(encoding="utf-8")) | change), encoding="utf-8")
    with pytest.raises(FileProblem, match=wrong):
        read_markers(file)


def test_the_error_on_a_missing_file_names_the_command_that_writes_it(tmp_path):
    with pytest.raises(FileProblem, match="knee segment"):
        read_markers(tmp_path / "markers.json")

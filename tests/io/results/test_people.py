import csv

import pytest

from marey.errors import FileProblem
from marey.io.results.people import PersonRow, write_people


def test_a_row_per_person_with_its_problem(tmp_path):
    seen = {"first_frame": 3, "last_frame": 9, "frames_seen": 6}
    good = PersonRow(person=1, folder="person1", frames_measured=5, stature_m="1.704", agreement="0.912", **seen)
    lost = PersonRow(person=2, folder="person2", problem="cam01, cam02: too small", **seen)
    write_people(tmp_path / "people.csv", [good, lost])
    with (tmp_path / "people.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["person"] for row in rows] == ["1", "2"]
    assert (rows[0]["frames_measured"], rows[0]["stature_m"], rows[0]["problem"]) == ("5", "1.704", "")
    assert (rows[1]["frames_measured"], rows[1]["agreement"], rows[1]["problem"]) == (
        "0",
        "",
        "cam01, cam02: too small",
    )


def test_a_folder_that_cannot_be_written_is_an_error(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(FileProblem, match="cannot be written"):
        write_people(tmp_path / "file" / "people.csv", [])

import numpy as np
import pytest

from marey.errors import FileProblem
from marey.io.results.repetitions import read_repetitions, write_repetitions
from marey.motion.events.repetitions import Flight, Repetition, Repetitions

MADE = Repetitions(
    entries=(
        Repetition(kind="squat", start_s=0.5, lowest_s=1.25, end_s=2.0, depth_m=0.4, depth_sd_m=0.002),
        Repetition(
            kind="jump", start_s=3.0, lowest_s=3.5, end_s=4.25, depth_m=0.3, depth_sd_m=0.002,
            flight=Flight(takeoff_s=3.75, landing_s=4.25, sd_s=0.01),
        ),
    ),
    angle_names=("left_knee_flexion", "right_knee_flexion"), largest_deg=np.array([[100.5, np.nan], [80.25, 81.0]]),
)  # fmt: skip


def test_repetitions_are_read_again(tmp_path):
    write_repetitions(tmp_path / "repetitions.csv", MADE)
    again = read_repetitions(tmp_path / "repetitions.csv")
    assert again.entries == MADE.entries
    assert again.angle_names == MADE.angle_names
    np.testing.assert_array_equal(again.largest_deg, MADE.largest_deg)


def test_a_damaged_table_is_named(tmp_path):
    path = tmp_path / "repetitions.csv"
    with pytest.raises(FileProblem, match="cannot be read"):
        read_repetitions(path)
    write_repetitions(path, MADE)
    text = path.read_text()
    path.write_text(text.replace("squat", "dance"))
    with pytest.raises(FileProblem, match="'dance' is none of squat"):
        read_repetitions(path)
    path.write_text(text.replace("depth_m", "depth"))
    with pytest.raises(FileProblem, match="no column 'depth_m'"):
        read_repetitions(path)
    path.write_text(text.replace("1.250000", "soon"))
    with pytest.raises(FileProblem, match="soon"):
        read_repetitions(path)

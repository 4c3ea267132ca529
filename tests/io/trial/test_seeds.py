import numpy as np
import pytest
from tests import scenes

from marey.errors import FileProblem
from marey.io.trial.seeds import read_seeds

RIG = scenes.rig(-10, 0, 10)


def written(tmp_path, text):
    path = tmp_path / "seeds.csv"
    path.write_text(text)
    return path


@pytest.mark.parametrize("mark", [",", ";"])
def test_seeds_are_read_in_the_order_of_the_cameras_with_gaps(tmp_path, mark):
    text = "left x,left y,middle x,middle y,right x,right y\n10,20.5,30,40,,\n\n,,1,2,3,4\n".replace(",", mark)
    seeds = read_seeds(written(tmp_path, text), RIG)
    np.testing.assert_array_equal(seeds, [[[10, 20.5], [30, 40], [np.nan, np.nan]], [[np.nan, np.nan], [1, 2], [3, 4]]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1,2,3,4,5,6\n1,2,700,4,5,6\n", r"seeds\.csv: has a seed in row 2 at \(700, 4\), outside .* 'middle'.*259"),
        ("1,2,3,4,-9,6\n", r"row 1 at \(-9, 6\), outside the image of 'right'"),
        ("1,2,3,4\n", r"has 4 columns in row 1.*6 cells: left x"),
        ("1,2,x,4,5,6\n", r"has 'x' in row 1 instead of a number"),
        ("a,b\n", r"has no seed"),
        ("1,,3,4,5,6\n", r"row 1 at \(1, nan\), outside"),
    ],
)
def test_a_wrong_row_is_named(tmp_path, text, message):
    with pytest.raises(FileProblem, match=message):
        read_seeds(written(tmp_path, text), RIG)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileProblem, match=r"none\.csv: cannot be read"):
        read_seeds(tmp_path / "none.csv", RIG)

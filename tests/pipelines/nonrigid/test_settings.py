"""Settings of a deforming surface, as given by options."""

import numpy as np
import pytest

from marey.errors import MareyError
from marey.pipelines.nonrigid.settings import parse_matrix

MATRIX = np.array([[700.0, 0, 320], [0, 710, 240], [0, 0, 1]])


@pytest.mark.parametrize("text", ["700,710,320,240", "700 710 320 240", "700,0,320,0,710,240,0,0,1"])
def test_a_matrix_is_given_as_four_or_nine_numbers(text):
    np.testing.assert_array_equal(parse_matrix(text), MATRIX)


def test_a_matrix_is_read_from_a_file(tmp_path):
    np.savez(tmp_path / "a.npz", matrix=MATRIX, other=1)
    np.save(tmp_path / "a.npy", MATRIX)
    np.savetxt(tmp_path / "a.txt", MATRIX)
    np.savetxt(tmp_path / "a.csv", MATRIX, delimiter=",")
    for name in ("a.npz", "a.npy", "a.txt", "a.csv"):
        np.testing.assert_array_equal(parse_matrix(str(tmp_path / name)), MATRIX)


def test_a_file_without_a_matrix_is_named(tmp_path):
    np.savez(tmp_path / "a.npz", first=MATRIX, second=MATRIX)
    (tmp_path / "b.txt").write_text("a b c")
    np.save(tmp_path / "c.npy", np.ones(4))
    np.save(tmp_path / "d.npy", -MATRIX)
    for name, words in (
        ("a.npz", "no array called matrix"),
        ("b.txt", "cannot be read"),
        ("c.npy", "shape"),
        ("d.npy", "focal"),
    ):
        with pytest.raises(MareyError, match=words) as caught:
            parse_matrix(str(tmp_path / name))
        assert name in str(caught.value)

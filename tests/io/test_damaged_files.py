"""Damaged files of every format: a result, or one line that names the file.

`python -m bench run inputs/readers` does the same many times, in processes of their own. Readers in which a library
that is not written in Python reads the file are tested on what their own checks refuse.
"""

import warnings

import numpy as np
import pytest
from tests import file_samples, film_samples
from tests.damaged_files import damaged

from marey.errors import FileProblem

COUNT = 12


def problem_of(sample: file_samples.FileSample) -> str | None:
    """Read a file; return what is reported."""
    try:
        sample.read(sample.path)
    except FileProblem as problem:
        return str(problem)
    return None


@pytest.mark.parametrize("group", ["documents", "archives", "motions", "scans", "calibrations", "films"])
def test_a_damaged_file_is_read_or_named_in_one_line(tmp_path, group):
    (tmp_path / group).mkdir()
    refused = {}
    for name, sample in (file_samples.GROUPS | film_samples.GROUPS)[group](tmp_path / group).items():
        whole, refused[name] = sample.path.read_bytes(), 0
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            sample.read(sample.path)
            for number in range(COUNT):
                sample.path.write_bytes(damaged(sample.path, whole, np.random.default_rng([3, number])))
                text = problem_of(sample)
                refused[name] += text is not None
                assert text is None or (str(tmp_path) in text and "\n" not in text)
        sample.path.write_bytes(whole)
    assert all(refused.values())

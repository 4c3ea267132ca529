"""OpenCap's pickles: nothing in them is executed."""

import os
import pickle
import struct

import numpy as np
import pytest
from tests.rig_files import assert_same_pixels, made_rig, opencap_table

from marey.errors import FileProblem
from marey.io.calibration.opencap import FILE_NAME, read_opencap, read_pickle
from marey.io.calibration.readers import read_rig


def write_session(folder, rig, *, protocol=4):
    for camera in rig:
        place = folder / "Videos" / camera.name
        place.mkdir(parents=True)
        (place / FILE_NAME).write_bytes(pickle.dumps(opencap_table(camera), protocol=protocol))


@pytest.mark.parametrize("protocol", range(6))
def test_the_pickles_of_a_session_are_read(tmp_path, protocol):
    rig = made_rig(("Cam0", "Cam1"))
    write_session(tmp_path, rig, protocol=protocol)
    assert_same_pixels(read_rig(tmp_path), rig)
    assert_same_pixels(read_rig(tmp_path / "Videos"), rig)
    assert_same_pixels(read_rig(tmp_path / "Videos" / "Cam1" / FILE_NAME), rig)


def test_pickles_in_one_folder_are_named_like_their_files(tmp_path):
    rig = made_rig(("cam00", "cam01"))
    for camera in rig:
        (tmp_path / f"{camera.name}.pickle").write_bytes(pickle.dumps(opencap_table(camera)))
    assert_same_pixels(read_rig(tmp_path), rig)


class Harm:
    """An object whose pickle runs a command when it is loaded."""

    def __reduce__(self):
        return os.mkdir, ("harm",)


@pytest.mark.parametrize("protocol", range(6))
def test_a_pickle_that_would_run_a_command_is_refused(tmp_path, monkeypatch, protocol):
    monkeypatch.chdir(tmp_path)
    for content in (Harm(), {"rotation": Harm()}, [Harm()]):
        (tmp_path / "a.pickle").write_bytes(pickle.dumps(content, protocol=protocol))
        with pytest.raises(FileProblem, match="which is not executed"):
            read_opencap(tmp_path / "a.pickle")
        assert not (tmp_path / "harm").exists()


def changed(**changes):
    return pickle.dumps(opencap_table(made_rig()["cam01"]) | changes)


BAD = {
    "empty": (b"", "not a pickle"),
    "text": (b"hello", "not a pickle"),
    "truncated": (changed()[:200], "not a pickle"),
    "a number": (pickle.dumps(3), "is not a table of arrays"),
    "no arrays": (pickle.dumps({"rotation": 3}), "has no array intrinsicMat"),
    "objects": (changed(rotation=np.array([None, 1])), "has an array of the type 'O8'"),
    "texts": (changed(rotation=np.array(["a"])), "has an array of the type 'U1'"),
    "not a number": (changed(translation=np.full((3, 1), np.nan)), "needs a translation"),
    "infinite": (changed(intrinsicMat=np.full((3, 3), np.inf)), "not 3 x 3 finite numbers"),
    "mirrored": (changed(rotation=np.diag([1.0, 1, -1])), "not a reflection"),
    "singular": (changed(rotation=np.zeros((3, 3))), "needs a rotation"),
    "too many": (changed(distortion=np.zeros((1, 15))), "has no array distortion"),
    "a size": (changed(imageSize=np.array([[1e30], [720]])), "whole pixels"),
    "large": (changed(more=np.zeros(10000)), "bytes; at most"),
    "memory": (b"\x80\x02]r\xff\xff\xff\x7f.", "is not a table"),
    "long text": (b"\x8d" + struct.pack("<Q", 2**60) + b"a.", "not a pickle"),
    "nested": (b"\x80\x02" + b"]" * 30000 + b"a" * 29999 + b".", "is not a table"),
    "persistent": (b"\x80\x02U\x01aQ.", "contains the instruction BINPERSID"),
}


@pytest.mark.parametrize(("content", "message"), BAD.values(), ids=BAD.keys())
def test_a_wrong_pickle_is_an_error_that_names_it(tmp_path, content, message):
    (tmp_path / "cam01.pickle").write_bytes(content)
    with pytest.raises(FileProblem, match=message):
        read_opencap(tmp_path / "cam01.pickle")


def test_plain_values_are_read_from_a_pickle(tmp_path):
    content = {"a": [1, 2.5, "text", None, True, (1, 2), {}], "b": {"c": b"\x00"}}
    (tmp_path / "a.pickle").write_bytes(pickle.dumps(content))
    assert read_pickle(tmp_path / "a.pickle", "It should be plain.") == content


def test_pickles_of_other_things_are_not_a_calibration(tmp_path):
    (tmp_path / "cache.pickle").write_bytes(pickle.dumps({"a": 1}))
    with pytest.raises(FileProblem, match="has no calibration"):
        read_rig(tmp_path)


def test_a_folder_without_pickles_is_named(tmp_path):
    with pytest.raises(FileProblem, match="has no calibration"):
        read_rig(tmp_path)
    with pytest.raises(FileProblem, match=f"has no {FILE_NAME}"):
        read_opencap(tmp_path)

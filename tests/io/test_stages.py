import ast

import numpy as np
import pytest

from marey.errors import DamagedCheckpoint, FileProblem, NotWritten
from marey.io import stages
from marey.io.stages import FrameLog, file_fingerprint, load_arrays, save_arrays, saved_arrays


def test_arrays_are_read_as_written(tmp_path, rng):
    arrays = {"x": rng.normal(size=(3, 2)), "flag": np.array([True, False])}
    save_arrays(tmp_path / "a.npz", arrays)
    found = load_arrays(tmp_path / "a.npz")
    assert set(found) == set(arrays)
    np.testing.assert_array_equal(found["x"], arrays["x"])
    assert [p.name for p in tmp_path.iterdir()] == ["a.npz"]


@pytest.mark.parametrize(
    "value",
    [
        np.arange(6, dtype=np.uint8).reshape(2, 3), np.asfortranarray(np.arange(6.0).reshape(2, 3)), np.zeros((0, 5)),
        np.array(2.5), np.array(["left arm", "right"]), np.array([True, False]), np.arange(3, dtype=">f4"),
    ],
)  # fmt: skip
def test_a_log_returns_arrays_of_every_kind_as_they_were(tmp_path, value):
    with FrameLog(tmp_path / "some.log") as log:
        for _ in range(2):
            log.append({"first": value, "second": value[..., None]})
        for record in log:
            assert list(record) == ["first", "second"]
            for found, expected in ((record["first"], value), (record["second"], value[..., None])):
                np.testing.assert_array_equal(found, expected)
                assert found.dtype == expected.dtype
                assert found.flags.writeable


def test_the_headers_of_usual_arrays_are_read_without_the_parser_of_python(tmp_path, monkeypatch):
    values = {"mask": np.ones((3, 5), np.uint8), "one": np.arange(4.0), "deep": np.zeros((2, 1, 3, 1), "<i2")}

    def refuse(text: str) -> None:
        raise SystemError("AST constructor recursion depth mismatch")

    with FrameLog(tmp_path / "frames.log") as log:
        log.append(values)
        monkeypatch.setattr(ast, "literal_eval", refuse)
        for name, value in log[0].items():
            np.testing.assert_array_equal(value, values[name], strict=True)


def test_a_log_holds_no_objects(tmp_path):
    with FrameLog(tmp_path / "some.log") as log, pytest.raises(ValueError, match="allow_pickle"):
        log.append({"first": np.array([{}])})


@pytest.mark.parametrize("lost", [1, 50, 399])
def test_an_incomplete_last_record_is_dropped_and_the_log_is_continued(tmp_path, lost):
    path = tmp_path / "poses.log"
    with FrameLog(path) as log:
        for frame in range(3):
            log.append({"pose": np.full(20, float(frame))})
    path.write_bytes(path.read_bytes()[:-lost])
    with FrameLog(path) as log:
        assert len(log) == 2
        log.append({"pose": np.full(20, 7.0)})
        assert [record["pose"][0] for record in log] == [0, 1, 7]
    with FrameLog(path) as log:
        assert len(log) == 3


def test_a_last_record_with_a_wrong_checksum_is_dropped(tmp_path):
    path = tmp_path / "poses.log"
    with FrameLog(path) as log:
        for frame in range(2):
            log.append({"pose": np.full(20, float(frame))})
    content = bytearray(path.read_bytes())
    content[-60] ^= 0xFF
    path.write_bytes(content)
    with FrameLog(path) as log:
        assert len(log) == 1


@pytest.mark.parametrize(("place", "left"), [(60, 0), (500, 1)])
def test_a_damaged_record_is_dropped_with_all_later_ones(tmp_path, place, left):
    path = tmp_path / "poses.log"
    with FrameLog(path) as log:
        for frame in range(3):
            log.append({"pose": np.full(20, float(frame))})
    content = bytearray(path.read_bytes())
    assert len(content) // 3 == 438
    content[place] ^= 0xFF
    path.write_bytes(content)
    with FrameLog(path) as log:
        assert len(log) == left


def test_a_record_that_is_damaged_while_the_log_is_open_is_an_error_that_names_the_file(tmp_path):
    path = tmp_path / "poses.log"
    with FrameLog(path) as log:
        log.append({"pose": np.zeros(20)})
        content = bytearray(path.read_bytes())
        content[60] ^= 0xFF
        path.write_bytes(content)
        with pytest.raises(DamagedCheckpoint, match=r"poses\.log: is damaged at frame 0"):
            log[0]


def test_one_array_of_a_frame_is_read_alone(tmp_path, rng):
    records = [{"a": rng.normal(size=(5, 3)), "b": np.arange(k, dtype=np.int8)} for k in range(3)]
    with FrameLog(tmp_path / "log") as log:
        for record in records[:2]:
            log.append(record)
        for frame in (1, 0, 1):
            for name, value in records[frame].items():
                found = log.array(frame, name)
                np.testing.assert_array_equal(found, value)
                assert found.dtype == value.dtype
        log.cut(1)
        log.append(records[2])
        np.testing.assert_array_equal(log.array(1, "b"), records[2]["b"])


def test_a_log_on_a_full_disk_is_an_error_that_names_it_and_keeps_the_earlier_frames(tmp_path, full_disk):
    path = tmp_path / "poses.log"
    with FrameLog(path) as log:
        log.append({"pose": np.zeros(20)})
        with full_disk(path.stat().st_size + 100), pytest.raises(NotWritten, match=r"poses\.log: cannot be written"):
            log.append({"pose": np.zeros(200)})
    with FrameLog(path) as log:
        assert len(log) == 1


def test_a_damaged_stage_is_computed_again(tmp_path):
    path = tmp_path / "stage.npz"
    for damage in (lambda content: content[:-40], lambda content: bytes(len(content))):
        saved_arrays(path, lambda: {"x": np.arange(100)})
        path.write_bytes(damage(path.read_bytes()))
        np.testing.assert_array_equal(saved_arrays(path, lambda: {"x": np.arange(7)})["x"], np.arange(7))
        path.unlink()


def test_a_log_can_be_truncated(tmp_path):
    with FrameLog(tmp_path / "a.log") as log:
        for frame in range(4):
            log.append({"x": np.array(frame)})
        log.cut(2)
        log.append({"x": np.array(9)})
        assert [int(r["x"]) for r in log] == [0, 1, 9]


def test_a_fingerprint_depends_on_content_and_not_on_names(tmp_path, monkeypatch):
    a, b = tmp_path / "a.mp4", tmp_path / "b.mp4"
    a.write_bytes(b"film" * 100)
    b.write_bytes(b"film" * 100)
    assert file_fingerprint(a) == file_fingerprint(b)
    b.write_bytes(b"film" * 99 + b"fill")
    assert file_fingerprint(a) != file_fingerprint(b)
    assert len({file_fingerprint(a), file_fingerprint(tmp_path)}) == 2
    with pytest.raises(FileProblem, match="missing"):
        file_fingerprint(tmp_path / "missing.mp4")


def test_large_files_with_different_ends_have_different_fingerprints(tmp_path, monkeypatch):
    monkeypatch.setattr(stages, "WHOLE_BYTES", 100)
    monkeypatch.setattr(stages, "_SAMPLE_BYTES", 10)
    a, b = tmp_path / "a", tmp_path / "b"
    a.write_bytes(b"x" * 1000)
    b.write_bytes(b"x" * 999 + b"y")
    assert file_fingerprint(a) != file_fingerprint(b)

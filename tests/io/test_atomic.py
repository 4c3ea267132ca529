import os

import pytest

from marey.errors import NotWritten
from marey.io import atomic
from marey.io.atomic import replacing, require_place, sync_files, synced_later


@pytest.fixture
def order(monkeypatch):
    """The calls that reach the disk, in their order."""
    calls: list[tuple[str, str]] = []
    fsync, replace, opened = os.fsync, os.replace, os.open
    names: dict[int, str] = {}

    def open_named(path, *more, **how):
        file = opened(path, *more, **how)
        names[file] = os.path.basename(path)
        return file

    def sync(file):
        calls.append(("sync", names[file]))
        fsync(file)

    def rename(old, new):
        calls.append(("rename", os.path.basename(new)))
        replace(old, new)

    monkeypatch.setattr(atomic.os, "open", open_named)
    monkeypatch.setattr(atomic.os, "fsync", sync)
    monkeypatch.setattr(atomic.os, "replace", rename)
    return calls


def test_a_file_is_on_the_disk_before_it_gets_its_name_and_the_name_after_it(tmp_path, order):
    with replacing(tmp_path / "a.txt") as beside:
        beside.write_text("new")
    assert order == [("sync", beside.name), ("rename", "a.txt"), ("sync", tmp_path.name)]


def test_files_that_are_synced_later_are_not_waited_for(tmp_path, order):
    with synced_later(tmp_path), synced_later(tmp_path):
        for name in ("a.txt", "below/b.txt"):
            with replacing(tmp_path / name) as beside:
                beside.write_text("new")
    assert [call for call, _ in order] == ["rename", "rename"]
    sync_files([tmp_path / "a.txt", tmp_path / "below" / "b.txt"])
    assert {name for call, name in order if call == "sync"} == {"a.txt", "b.txt"}
    with replacing(tmp_path / "c.txt") as beside:
        beside.write_text("new")
    assert order[-1] == ("sync", tmp_path.name)


def test_an_error_of_the_program_keeps_its_kind_and_the_old_file(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(ZeroDivisionError), replacing(path) as beside:
        beside.write_text(str(1 / 0))
    with pytest.raises(FileNotFoundError), replacing(path):
        (tmp_path / "input").read_text()
    assert path.read_text() == "old"
    assert [each.name for each in tmp_path.iterdir()] == ["a.txt"]


def test_a_folder_that_is_a_file_is_an_error_that_names_the_file(tmp_path):
    (tmp_path / "out").write_text("mine")
    with pytest.raises(NotWritten, match=r"out/a.txt: cannot be written \("), replacing(tmp_path / "out" / "a.txt"):
        pass


def test_a_place_is_checked_before_the_work(tmp_path):
    (tmp_path / "file").touch()
    require_place(tmp_path / "new" / "sync.json")
    require_place(tmp_path / "file")
    for path, wrong in ((tmp_path / "file" / "sync.json", "Not a directory"), (tmp_path, "Is a directory")):
        with pytest.raises(NotWritten, match=wrong):
            require_place(path)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]

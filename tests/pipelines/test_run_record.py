import json
from pathlib import Path

import numpy as np
import pytest

from marey.errors import DamagedCheckpoint, FileProblem, NotWritten, WorkerKilled
from marey.pipelines import run_record
from marey.pipelines.capture.settings import CaptureSettings
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.run_record import StageCache, fingerprint, finished_together, write_record


def test_a_fingerprint_changes_with_every_part():
    array = np.arange(4.0)
    parts = [1, 1.0, "1", None, (1, 2), array, array[:3], array.astype(np.float32)]
    parts += [CaptureSettings(), CaptureSettings(stature_m=1.8)]
    assert len({fingerprint(part) for part in parts}) == len(parts)
    assert fingerprint(array, "a") == fingerprint(array.copy(), "a")


def test_a_stage_is_computed_once_and_again_only_for_other_settings(tmp_path):
    computed = []

    def compute():
        computed.append(1)
        return {"x": np.arange(3)}

    for depends in (1, 1, 2, 1):
        found = StageCache(tmp_path, "inputs").arrays("start", compute, depends=depends)
        np.testing.assert_array_equal(found["x"], np.arange(3))
    assert len(computed) == 3
    StageCache(tmp_path, "other inputs").arrays("start", compute, depends=1)
    assert len(computed) == 4
    assert len(list((tmp_path / ".work").glob("start-*"))) == 1


def test_stages_whose_names_begin_alike_do_not_lose_each_other(tmp_path):
    cache = StageCache(tmp_path, 0)
    cache.arrays("masks-cam01", lambda: {"x": np.zeros(1)})
    cache.arrays("masks", lambda: {"x": np.zeros(1)})
    assert cache.arrays("masks-cam01", lambda: {"x": np.ones(1)})["x"] == 0


def test_frames_done_before_are_there_after_an_interruption(tmp_path):
    log = StageCache(tmp_path, 0).frames("poses", depends="a")
    for frame in range(3):
        log.append({"pose": np.full(5, frame)})
    log.close()
    with StageCache(tmp_path, 0).frames("poses", depends="a") as again:
        assert [int(record["pose"][0]) for record in again] == [0, 1, 2]
    with StageCache(tmp_path, 0).frames("poses", depends="b") as other:
        assert len(other) == 0


def test_results_appear_together_and_old_ones_by_other_names_go(tmp_path):
    out = tmp_path / "out"
    for names in (("a.txt", "masks/cam01.npz"), ("a.txt", "b.txt")):
        with finished_together(out) as folder:
            for name in names:
                (folder / name).parent.mkdir(exist_ok=True)
                (folder / name).write_text(name)
            write_record(folder, command="capture", settings={}, inputs=[], root=out, progress=RecordingProgress())
    assert sorted(p.name for p in out.iterdir() if p.is_file()) == ["a.txt", "b.txt", "run.json"]
    assert not (out / "masks" / "cam01.npz").exists()


def test_a_failed_run_leaves_the_last_results_as_they_were(tmp_path):
    with finished_together(tmp_path) as folder:
        (folder / "a.txt").write_text("first")

    def fail() -> None:
        with finished_together(tmp_path) as folder:
            (folder / "a.txt").write_text("half")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert (tmp_path / "a.txt").read_text() == "first"
    assert not (tmp_path / ".work" / "results").exists()


def test_the_record_contains_command_settings_and_inputs(tmp_path):
    video = tmp_path / "cam01.mp4"
    video.write_bytes(b"film")
    progress = RecordingProgress()
    with progress.stage("Poses"):
        pass
    settings = {"stature_m": 1.8, "start": Path("clicks.json")}
    write_record(tmp_path, command="capture", settings=settings, inputs=[video], root=tmp_path, progress=progress)
    record = json.loads((tmp_path / "run.json").read_text())
    assert record["settings"] == {"stature_m": 1.8, "start": "clicks.json"}
    assert len(record["inputs"]["cam01.mp4"]) == 32
    assert "Poses" in record["timings_s"]
    assert record["files"] == ["cam01.mp4", "run.json"]


@pytest.mark.parametrize(
    ("error", "kept"),
    [
        (None, False), (FileProblem("a", "b"), False), (KeyboardInterrupt(), True), (NotWritten("a", "full"), True),
        (WorkerKilled(), True), (DamagedCheckpoint("a", 3), True),
    ],
    ids=["end", "input", "interruption", "full disk", "killed worker", "damaged checkpoint"],
)
def test_checkpoints_stay_after_an_interruption_and_go_after_the_end_or_a_users_error(tmp_path, error, kept):
    out = tmp_path / "results"

    def work() -> None:
        with StageCache(out, 0) as cache:
            cache.arrays("start", lambda: {"x": np.ones(1)})
            if error is not None:
                raise error

    if error is None:
        work()
    else:
        with pytest.raises(type(error)):
            work()
    assert out.exists() == kept
    assert bool(list(out.rglob("start-*.npz"))) == kept


def finish(out, *names, command="capture", inputs=(), text="new"):
    with finished_together(out, inputs=inputs) as folder:
        for name in names:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(text)
        write_record(folder, command=command, settings={}, inputs=[], root=out, progress=RecordingProgress())


def content(folder):
    return {p.relative_to(folder).as_posix(): p.read_text() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize("name", ["cameras.toml", "masks/cam01.npz", "run.json"])
def test_results_never_replace_a_file_of_the_user(tmp_path, name):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("mine")
    with pytest.raises(NotWritten, match=rf"{name}: cannot be written \(marey did not write what has this name\)"):
        finish(tmp_path, "a.npz", *({name} - {"run.json"}))
    assert content(tmp_path) == {name: "mine"}


def test_results_never_replace_an_input_that_an_earlier_run_has_written(tmp_path):
    finish(tmp_path, "body.npz", text="old")
    with pytest.raises(NotWritten, match=r"body.npz: cannot be written \(it is an input of this run\)"):
        finish(tmp_path, "body.npz", command="shape", inputs=[tmp_path / "body.npz"])
    assert (tmp_path / "body.npz").read_text() == "old"


def test_a_folder_or_a_file_in_the_place_of_results_is_an_error_before_anything_is_moved(tmp_path):
    for name, there in (("a.npz", tmp_path / "a.npz" / "x"), ("masks/cam01.npz", tmp_path / "masks")):
        there.parent.mkdir(exist_ok=True)
        there.write_text("mine")
        with pytest.raises(NotWritten):
            finish(tmp_path, "0.npz", name)
        assert not (tmp_path / "0.npz").exists()


def test_results_in_a_folder_of_inputs_are_refused_before_the_work(tmp_path):
    (tmp_path / "walk.c3d").write_text("mine")
    for use in (
        lambda: StageCache(tmp_path, 0, files=[tmp_path / "walk.c3d"]),
        lambda: finish(tmp_path, "a.npz", inputs=[tmp_path / "walk.c3d"]),
    ):
        with pytest.raises(FileProblem, match=r"contains inputs of this run \(walk.c3d\)"):
            use()
    assert content(tmp_path) == {"walk.c3d": "mine"}


@pytest.mark.parametrize("moved", range(4))
def test_a_run_that_is_killed_while_results_are_moved_is_repeated(tmp_path, monkeypatch, moved):
    """The next run knows the moved files as its own, and removes those that it does not write any more."""
    calls = []

    def replace(old, new):
        if "results" in Path(old).parts:
            calls.append(new)
            if len(calls) > moved:
                raise SystemExit  # as a killed process: no record is written
        rename(old, new)

    rename = run_record.os.replace
    finish(tmp_path, "a.npz", "b.npz", text="old")
    monkeypatch.setattr(run_record.os, "replace", replace)
    with pytest.raises(SystemExit):
        finish(tmp_path, "a.npz", "c.npz", "d.npz")
    monkeypatch.setattr(run_record.os, "replace", rename)
    finish(tmp_path, "a.npz", "c.npz", text="last")
    found = content(tmp_path)
    assert set(found) == {"a.npz", "c.npz", "run.json"}
    assert {found["a.npz"], found["c.npz"]} == {"last"}


def test_the_results_of_a_run_are_on_the_disk_before_its_record(tmp_path, monkeypatch):
    order = []
    sync, rename = run_record.sync_files, run_record.os.replace
    monkeypatch.setattr(run_record, "sync_files", lambda paths: sync([order.append(p.name) or p for p in paths]))
    monkeypatch.setattr(run_record.os, "replace", lambda old, new: (order.append(f"to {new.name}"), rename(old, new)))
    monkeypatch.setattr(run_record, "sync_folder", lambda folder: order.append("folder"))
    finish(tmp_path, "a.npz")
    assert [step for step in order if step != "to moves.json"] == [
        *("a.npz", "run.json", "to a.npz", "folder", "to run.json", "folder"),
    ]  # fmt: skip


def test_names_that_are_not_unicode_do_not_stop_the_record(tmp_path):
    video = tmp_path / "a\udcff.mp4"
    video.write_bytes(b"film")
    write_record(tmp_path / ".", command="capture", settings={"keypoints": video}, inputs=[video], root=tmp_path,
                 progress=RecordingProgress())  # fmt: skip
    assert "a\udcff.mp4" in json.loads((tmp_path / "run.json").read_text())["inputs"]


def test_a_run_within_a_run_keeps_the_checkpoints_of_the_outer_one(tmp_path):
    with StageCache(tmp_path, 0) as outer:
        outer.arrays("start", lambda: {"x": np.ones(1)})
        with StageCache(tmp_path, 1) as inner:
            inner.arrays("inner", lambda: {"x": np.ones(1)})
        assert outer.arrays("start", lambda: {"x": np.zeros(1)})["x"] == 1
    assert not tmp_path.exists()


def test_a_file_of_the_user_with_the_name_of_a_result_is_reported_before_the_work(tmp_path):
    finish(tmp_path, "motion.npz", "run.json")
    with StageCache(tmp_path, (), results=["motion.npz", "report.html"]):
        pass
    (tmp_path / "report.html").write_text("mine")
    with pytest.raises(NotWritten, match=r"report\.html: cannot be written"):
        StageCache(tmp_path, (), results=["motion.npz", "report.html"])
    # The folder is free again, and unchanged.
    with StageCache(tmp_path, (), results=["motion.npz"]):
        pass
    assert content(tmp_path)["report.html"] == "mine"

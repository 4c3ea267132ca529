import json
from pathlib import Path

import numpy as np
import pytest

from marey.errors import FileProblem
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
    assert len(list((tmp_path / ".work").iterdir())) == 1


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
    ("error", "kept"), [(None, False), (FileProblem("a", "b"), False), (KeyboardInterrupt(), True)]
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

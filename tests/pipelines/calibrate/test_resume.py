"""An interrupted calibration: the same command resumes it, and the results are those of an undisturbed run."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from tests.pipelines.calibrate.board_pictures import DESCRIPTION, CalibratedSession

import marey
from marey.pipelines.progress import RecordingProgress, Step

STAGES = ("Board", "Print, pass 2", "Examination")


class InterruptingProgress(RecordingProgress):
    """Interrupts the work in a stage after some steps, and counts the pictures that are worked on.

    Args:
        name: The stage; None for no interruption.
        steps: Number of steps after which the work is interrupted; with 0, before the stage.
    """

    def __init__(self, name: str | None = None, steps: int = 0):
        super().__init__()
        self.name, self.left = name, steps
        self.done: dict[str, int] = {}
        self.worked: dict[str, int] = {}

    @contextmanager
    def stage(self, name: str, total: int | None = None, *, done: int = 0) -> Iterator[Step]:
        if name == self.name and self.left == 0:
            raise KeyboardInterrupt
        self.done[name] = done
        self.worked.setdefault(name, 0)

        def step() -> None:
            self.worked[name] += 1
            if name == self.name and self.worked[name] == self.left:
                raise KeyboardInterrupt

        with super().stage(name, total, done=done):
            yield step


def contents(folder: Path) -> dict[str, bytes]:
    """Return the files that hold no times."""
    return {name: (folder / name).read_bytes() for name in ("cameras.toml", "calibration.json")}


@pytest.fixture(autouse=True)
def _as_the_command() -> Iterator[None]:
    """Work with one thread of OpenCV, as the command does: with more, its sums differ in the last digits."""
    with marey.tuned_process():
        yield


@pytest.mark.slow
def test_an_interrupted_calibration_is_resumed_with_the_same_results(
    tmp_path: Path, calibrated_session: CalibratedSession
):
    assert set(STAGES) <= set(calibrated_session.progress.timings)
    session, out = calibrated_session.folder, tmp_path / "out"
    for stage in STAGES:
        # The stages that work on pictures are interrupted in the middle.
        steps = 5 if stage.startswith(("Board", "Print")) else 0
        with pytest.raises(KeyboardInterrupt):
            marey.calibrate(session, out=out, floor="last", progress=InterruptingProgress(stage, steps))
        assert [path.name for path in out.iterdir()] == [".work"]
    last = InterruptingProgress()
    marey.calibrate(session, out=out, floor="last", progress=last)
    for stage in ("Board", "Print, pass 1", "Print, pass 2"):
        assert last.worked[stage] == 0
        assert last.done[stage] > 0
    assert contents(out) == contents(calibrated_session.out)
    assert not (out / ".work").exists()


@pytest.mark.slow
def test_corners_of_another_board_file_are_not_used(tmp_path: Path, calibrated_session: CalibratedSession):
    session, out = calibrated_session.folder, tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        marey.calibrate(session, out=out, progress=InterruptingProgress("Board", 5))
    resumed = InterruptingProgress("Board", 1)
    with pytest.raises(KeyboardInterrupt):
        marey.calibrate(session, out=out, progress=resumed)
    assert resumed.done["Board"] > 0
    other = json.loads((session / "board.json").read_text()) | {"square_m": 0.08, "marker_m": 0.06}
    (tmp_path / "board.json").write_text(json.dumps(other))
    again = InterruptingProgress("Board", 1)
    with pytest.raises(KeyboardInterrupt):
        marey.calibrate(session, out=out, board=tmp_path / "board.json", progress=again)
    assert again.done["Board"] == 0


def test_an_error_of_the_user_leaves_no_checkpoints(tmp_path: Path):
    from marey.io.video.pictures import write_picture

    (tmp_path / "board.json").write_text(json.dumps(DESCRIPTION))
    for name in ("cam01_1.png", "cam02_1.png"):
        write_picture(tmp_path / name, np.full((120, 160, 3), 90, np.uint8))
    with pytest.raises(marey.FileProblem, match="shows no ChArUco board"):
        marey.calibrate(tmp_path, out=tmp_path / "marey")
    assert not (tmp_path / "marey").exists()

"""Evidence for the person from given soft silhouettes and from a network."""

import shutil
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from tests.clips import make_trial
from tests.onnx_files import write_onnx
from tests.pipelines.capture.reach import EMPTY, copy_half_trial, give_silhouettes, give_start, truth

from marey.images.silhouettes.interior import InteriorEdges
from marey.io.stages import FrameLog
from marey.io.trial.trial import read_trial
from marey.pipelines.capture import tasks
from marey.pipelines.capture.evidence import (
    ODDS_LIMIT,
    PersonEvidence,
    agreement,
    box_about,
    evidence_of_all_cameras,
    first_silhouettes,
    log_odds,
    person_evidence,
    right_and_all,
    with_evidence,
)
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.silhouettes.stages import Expected, pull_of

COUNT = 4
"""Number of frames of the small trials."""


def run_of(folder: Path) -> Any:
    """Return a run on a small trial that keeps its logs beside it."""

    @contextmanager
    def frames(name: str, depends: object) -> Iterator[FrameLog]:
        with closing(FrameLog(folder.parent / f"{name}.log")) as log:
            yield log

    cache = SimpleNamespace(frames=frames)
    return SimpleNamespace(trial=read_trial(folder), cache=cache, scope=(), progress=RecordingProgress())


def give_levels(folder: Path, name: str, level: int) -> None:
    """Write grey images of a camera whose left half is at a level, and whose right half is certainly no person."""
    image = np.zeros((48, 64), np.uint8)
    image[:, :32] = level
    (folder / "masks" / name).mkdir(parents=True)
    for number in range(COUNT):
        cv2.imwrite(str(folder / "masks" / name / f"{number}.png"), image)


def write_bright(path: Path) -> Path:
    """Write a network to which bright columns are persons."""
    return write_onnx(path, np.full((1, 3), 20 / 3), bias=(-10.0,), shape=(1, 3, 48, 64), end="Sigmoid")


def test_log_odds_are_symmetric_and_limited():
    odds = log_odds(np.arange(256, dtype=np.uint8)[None])[0]
    assert np.allclose(odds, -odds[::-1], atol=1e-6)
    assert np.all(np.diff(odds) >= 0)
    assert odds[0] == -ODDS_LIMIT
    assert odds[255] == ODDS_LIMIT
    assert odds[140] == pytest.approx(np.log(140 / 115))


@pytest.fixture
def log(tmp_path: Path) -> Iterator[FrameLog]:
    with closing(FrameLog(tmp_path / "log")) as opened:
        yield opened


def test_evidence_on_disk_is_that_which_was_added(log, rng):
    cameras: Any = [SimpleNamespace(size=(7, 5)), SimpleNamespace(size=(3, 2))]
    store = PersonEvidence(log, 40, cameras)
    odds = rng.uniform(-2 * ODDS_LIMIT, 2 * ODDS_LIMIT, (5, 7))
    store.append([odds, None])
    store.append([None, None])
    assert store.frames == range(40, 42)
    first, nothing = store(40)
    assert nothing is None
    assert first is not None
    assert np.allclose(first, np.clip(odds, -ODDS_LIMIT, ODDS_LIMIT), atol=ODDS_LIMIT / 250)
    assert store(41) == [None, None]


def test_the_box_about_a_body_is_a_square_as_far_as_the_image_shows_it():
    mask = np.zeros((100, 200), bool)
    assert box_about(mask) is None
    mask[40:60, 90:100] = True
    rows, columns = box_about(mask) or (slice(0), slice(0))
    assert rows.stop - rows.start == pytest.approx(32, abs=1)
    assert columns.stop - columns.start == pytest.approx(32, abs=1)
    mask[0:60, 190:] = True
    rows, columns = box_about(mask) or (slice(0), slice(0))
    assert rows.start == 0
    assert columns.stop == 200


def test_a_source_that_agrees_with_the_drawn_body_has_the_agreement_one():
    drawn = np.zeros((100, 100), bool)
    drawn[20:80, 20:80] = True
    right = np.where(drawn, 255, 0).astype(np.uint8)
    assert agreement(right_and_all(right, drawn)) == 1
    assert agreement(right_and_all(255 - right, drawn)) == -1
    assert agreement(right_and_all(np.full_like(right, 255), drawn)) == 0
    half = right.copy()
    half[:50] = 0
    assert agreement(right_and_all(half, drawn)) == pytest.approx(0.5, abs=0.02)
    # An outline that is off by less than the margins agrees.
    shifted = np.zeros_like(right)
    shifted[20:80, 22:82] = 255
    assert agreement(right_and_all(shifted, drawn)) > 0.95


@pytest.mark.parametrize("left", [True, False], ids=["agrees", "contradicts"])
def test_evidence_that_contradicts_the_drawn_body_is_not_used(tmp_path, monkeypatch, left):
    folder = make_trial(tmp_path, count=COUNT, toml='[masks]\nuse = "evidence"\n')
    give_levels(folder, "cam01", 250)
    drawn = np.zeros((48, 64), bool)
    drawn[:, :32] = left
    drawn[:, 32:] = not left
    monkeypatch.setattr("marey.pipelines.capture.evidence.PosedBody", lambda body, pose: object())
    monkeypatch.setattr("marey.pipelines.capture.evidence.view_of", lambda *_: SimpleNamespace(mask=lambda: drawn))
    poses: Any = dict.fromkeys(range(COUNT))
    with person_evidence(run_of(folder), None, poses) as found:  # type: ignore[arg-type]
        assert found is not None
        odds = found(1)[0]
    if left:
        assert odds is not None
        assert odds[0, 0] == ODDS_LIMIT
        assert odds[0, 63] == -ODDS_LIMIT
    else:
        assert odds is None


def test_evidence_is_added_to_the_prior_of_a_predicted_body(log):
    drawn, nothing = np.zeros((48, 64), bool), np.zeros((48, 64), bool)
    drawn[10:30, 20:40] = True
    camera: Any = SimpleNamespace(size=(64, 48))
    known = Expected(drawn, InteriorEdges.none(), camera)
    own = Expected(drawn, InteriorEdges.none(), camera, pull=np.full((48, 64), 2.0))
    absent = Expected(nothing, InteriorEdges.none(), camera)
    store = PersonEvidence(log, 0, [camera] * 4)
    store.append([np.full((48, 64), ODDS_LIMIT), np.full((48, 64), -ODDS_LIMIT), np.zeros((48, 64)), None])

    def predicted(frame: int) -> list[Expected] | None:
        return [known, own, absent, known] if frame == 0 else None

    joined = with_evidence(predicted, store)
    found = joined(0)
    assert found is not None
    assert np.allclose(found[0].pull, pull_of(drawn) + ODDS_LIMIT)
    assert np.allclose(found[1].pull, 2.0 - ODDS_LIMIT)
    assert found[2] is absent
    assert found[3] is known
    assert joined(1) is None
    assert with_evidence(predicted, None) is predicted


def test_masks_and_a_network_are_one_channel_together(tmp_path):
    folder = make_trial(tmp_path, count=COUNT, toml='[masks]\nuse = "evidence"\n')
    give_levels(folder, "cam01", 140)
    with person_evidence(run_of(folder), None, {}) as found:  # type: ignore[arg-type]
        assert found is not None
        assert found.frames == range(COUNT)
        first, second = found(2)
        assert second is None
        assert first is not None
        assert first[0, 0] == pytest.approx(np.log(140 / 115), abs=ODDS_LIMIT / 250)
        assert first[0, 63] == -ODDS_LIMIT
    (tmp_path / "evidence.log").unlink()
    write_bright(folder / "net.onnx")
    (folder / "trial.toml").write_text('[masks]\nuse = "evidence"\nnetwork = "net.onnx"\n')
    with person_evidence(run_of(folder), None, {}) as found:  # type: ignore[arg-type]
        assert found is not None
        first, second = found(0)
        assert second is not None
        assert first is not None
        # The images of frame 0 are dark: the network sees nobody, which outweighs the masks.
        assert np.all(second == -ODDS_LIMIT)
        assert first[0, 0] == pytest.approx(np.log(140 / 115) - ODDS_LIMIT, abs=ODDS_LIMIT / 250)


def test_evidence_is_resized_to_the_images_of_a_round(log):
    camera: Any = SimpleNamespace(size=(64, 48))
    drawn = np.zeros((24, 32), bool)
    drawn[5:20, 10:20] = True
    store = PersonEvidence(log, 0, [camera])
    odds = np.full((48, 64), -ODDS_LIMIT)
    odds[:24] = ODDS_LIMIT
    store.append([odds])
    own = Expected(drawn, InteriorEdges.none(), camera, pull=np.zeros((24, 32)))
    found = (with_evidence(lambda frame: [own], store)(0) or [own])[0].pull
    assert found is not None
    assert found.shape == drawn.shape
    assert np.allclose(found[:12], ODDS_LIMIT)
    assert np.allclose(found[12:], -ODDS_LIMIT)


def test_without_masks_and_network_there_is_no_evidence(tmp_path):
    run = run_of(make_trial(tmp_path, count=COUNT))
    assert not evidence_of_all_cameras(run.trial)
    with person_evidence(run, None, {}) as found:  # type: ignore[arg-type]
        assert found is None


def test_first_silhouettes_are_where_the_person_is_more_probable_than_not(tmp_path, log):
    folder = make_trial(tmp_path, count=COUNT, toml='[masks]\nuse = "evidence"\n')
    give_levels(folder, "cam01", 200)
    write_bright(folder / "net.onnx")
    (folder / "trial.toml").write_text('[masks]\nuse = "evidence"\nnetwork = "net.onnx"\n')
    # A network alone does not replace the silhouettes of a camera.
    assert not evidence_of_all_cameras(read_trial(folder))
    give_levels(folder, "cam02", 100)
    run = run_of(folder)
    assert evidence_of_all_cameras(run.trial)
    store, cameras = first_silhouettes(run, log)
    assert [camera.size for camera in cameras] == [(64, 48), (64, 48)]
    probable, improbable = store(3)
    assert probable[:, :32].all()
    assert not probable[:, 32:].any()
    assert not improbable.any()


@pytest.mark.slow
@pytest.mark.parametrize("plate", [True, False])
def test_soft_silhouettes_support_a_capture(tmp_path, plate):
    trial = copy_half_trial(tmp_path / "reach")
    give_silhouettes(trial)
    if plate:
        (trial / "masks" / "cam01.npz").unlink()
    else:
        shutil.rmtree(trial / "background")
    (trial / "trial.toml").write_text('[masks]\nuse = "evidence"\n')
    out = tmp_path / "results"
    tasks.capture(
        trial, frames=range(40, 42), start=give_start(trial, 41), overlay=False, out=out, progress=RecordingProgress()
    )  # fmt: skip
    names, joints = truth()
    with np.load(out / "motion.npz") as motion:
        limbs = [i for i, n in enumerate(motion["joint_names"]) if n.endswith(("knee", "elbow", "ankle", "wrist"))]
        found = motion["joint_centres"][40:42, limbs]
        wanted = joints[40 - EMPTY : 42 - EMPTY, [names.index(str(motion["joint_names"][i])) for i in limbs]]
    assert np.linalg.norm(found - wanted, axis=2).mean() < 0.04

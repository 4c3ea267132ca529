import json
import re
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from tests.takes import FRAMES, rig, small_take

from marey.io.calibration.readers import write_cameras_toml
from marey.io.trial.trial import Trial, read_trial
from marey.pipelines.capture import report as capture_report
from marey.pipelines.progress import RecordingProgress


@pytest.fixture
def trial(tmp_path: Path) -> Trial:
    """Grey stills of both cameras, 12 instants."""
    write_cameras_toml(rig(), tmp_path / "cameras.toml")
    (tmp_path / "trial.toml").write_text('rate = 30.0\nperson = "P01"\n')
    for camera in rig():
        for frame in range(FRAMES):
            cv2.imwrite(str(tmp_path / f"{camera.name}_{frame:03}.png"), np.full((120, 160, 3), 90 + frame, np.uint8))
    return read_trial(tmp_path)


def test_pictures_and_page_of_a_capture(trial, tmp_path, rng):
    motion, posed = small_take(rng)
    body = posed[0].body
    poses = {f: p.pose for f, p in enumerate(posed) if np.isfinite(motion.segment_origin[f]).all()}
    mask = np.zeros((120, 160), bool)
    mask[:40, 60:90] = True
    masks = {frame: [mask, ~mask] for frame in poses}
    out = tmp_path / "out"
    out.mkdir()
    progress = RecordingProgress()
    stills = capture_report.draw_overlays(trial, body, poses, motion, masks.get, folder=out, progress=progress)
    assert [still.caption.split(":")[0] for still in stills] == ["cam01, frame 7", "cam02, frame 7", "cam02, frame 6"]
    for camera in rig():
        with av.open(str(out / f"overlay_{camera.name}.mp4")) as video:
            assert sum(1 for _ in video.decode(video=0)) == FRAMES
    capture_report.report_capture(
        trial, motion, body, masks.get, stills=stills, settings={"preset": "full"}, folder=out, progress=progress
    )
    text = (out / "report.html").read_text(encoding="utf-8")
    assert f"{tmp_path.name} · P01" in text
    assert "border of the image cuts the person" in text
    assert "Overlays" in text
    data = json.loads(re.search(r'<script id="data" type="application/json">(.*?)</script>', text, re.DOTALL)[1])
    assert data["frames"] == FRAMES


def test_a_motion_without_measured_frames_has_no_images(trial, tmp_path, rng):
    motion, posed = small_take(rng)
    empty = motion.frames(np.r_[np.zeros(FRAMES, int)])
    progress = RecordingProgress()
    stills = capture_report.draw_overlays(
        trial, posed[0].body, {}, empty, lambda f: None, folder=tmp_path, progress=progress
    )
    assert stills == []


def test_sizes_begin_with_the_stature(rng):
    _, posed = small_take(rng)
    sizes = capture_report.person_sizes(posed[0].body)
    assert sizes[0].name == "stature"
    assert {"left thigh", "right hand"} <= {size.name for size in sizes}

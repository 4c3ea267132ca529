"""Videos of late cameras: which of their pictures belong to which instant."""

from pathlib import Path

from tests.clips import write_video

from marey.calibration.quality.delays import CameraDelay
from marey.io.calibration.session import open_session
from marey.pipelines.calibrate.corners import without_late_pictures


def test_pictures_of_a_late_camera_move_to_the_instants_that_they_show(tmp_path: Path):
    for name in ("cam01", "cam02"):
        write_video(tmp_path / f"{name}.mp4", 12)
    session, instants = open_session(tmp_path), (0, 2, 4, 6, 8, 10)
    moved = without_late_pictures(session, instants, [CameraDelay(camera=1, pictures=2, turns=30)])
    assert moved.clips[0].instants == session.clips[0].instants
    shown = {frame: number for frame, number in enumerate(moved.clips[1].instants) if number in instants}
    assert shown == {4: 0, 6: 2, 8: 4, 10: 6}
    early = without_late_pictures(session, instants, [CameraDelay(camera=1, pictures=-1, turns=30)])
    shown = {frame: number for frame, number in enumerate(early.clips[1].instants) if number in instants}
    assert shown == {0: 2, 2: 4, 4: 6, 6: 8, 8: 10}

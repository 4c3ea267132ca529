"""`marey init`: proposals for the videos of cameras."""

import pytest
from tests.clips import calibration_text, turn_by_metadata, write_video

from marey.errors import FileProblem
from marey.io.trial.sessions import open_calibration_session
from marey.io.trial.trial import read_trial
from marey.pipelines.propose import propose_trial


def make(folder, videos, *, names=("cam01", "cam02"), sizes=None):
    folder.mkdir(exist_ok=True)
    if names:
        size = sizes or {}
        tables = [calibration_text((name,), size.get(name, (64, 48))) for name in names]
        turned = [table.replace("1.2, 0.0", f"1.2, {0.3 * k}") for k, table in enumerate(tables)]
        (folder / "cameras.toml").write_text("".join(turned))
    for number, video in enumerate(videos):
        path = folder / video
        path.parent.mkdir(parents=True, exist_ok=True)
        write_video(path, 3 + number, size=(sizes or {}).get(video, (64, 48)))
    return folder


def pairs(proposal):
    return {each.camera: (each.video.path.name, each.why) for each in proposal.videos}


@pytest.mark.parametrize(
    ("videos", "expected"),
    [
        (["CAM01.MP4", "cam_2.mp4"], [("CAM01.MP4", "the name"), ("cam_2.mp4", "the name")]),
        (["S1_cam02_walk.mp4", "S1_cam01_walk.mp4"],
         [("S1_cam01_walk.mp4", "a part of the name"), ("S1_cam02_walk.mp4", "a part of the name")]),
        (["cam01/GX010042.MP4", "cam02/GX010017.MP4"],
         [("GX010042.MP4", "the name of its folder"), ("GX010017.MP4", "the name of its folder")]),
        (["GX010042.MP4", "GX010017.MP4"],
         [("GX010017.MP4", "the order: check it"), ("GX010042.MP4", "the order: check it")]),
        (["cam02.mp4", "IMG_0815.mov"], [("IMG_0815.mov", "the size of the image"), ("cam02.mp4", "the name")]),
    ],
)  # fmt: skip
def test_videos_are_paired_by_ever_weaker_evidence(tmp_path, videos, expected):
    proposal = propose_trial(make(tmp_path / "trial", videos))
    assert pairs(proposal) == dict(zip(("cam01", "cam02"), expected, strict=True))
    proposal.write()
    trial = read_trial(tmp_path / "trial")
    assert [clip.path.name for clip in trial.take.clips] == [name for name, _ in expected]


def test_the_size_of_the_image_tells_cameras_apart(tmp_path):
    sizes = {"cam01": (64, 48), "cam02": (80, 48), "b.mp4": (64, 48), "a.mp4": (80, 48)}
    proposal = propose_trial(make(tmp_path / "trial", ["a.mp4", "b.mp4"], sizes=sizes))
    assert {name: video for name, (video, _) in pairs(proposal).items()} == {"cam01": "b.mp4", "cam02": "a.mp4"}
    assert "Check the videos" in str(proposal)


def test_later_chapters_of_a_gopro_are_left_out_by_name(tmp_path):
    videos = ["GX010042.MP4", "GX020042.MP4", "GOPR0017.MP4", "GP010017.MP4"]
    proposal = propose_trial(make(tmp_path / "trial", videos))
    assert [path.name for path, _ in proposal.left_out] == ["GP010017.MP4", "GX020042.MP4"]
    assert "GX020042.MP4 is left out: it continues another video of the same GoPro" in str(proposal)
    assert pairs(proposal)["cam01"][0] == "GOPR0017.MP4"


def test_cameras_without_calibration_get_names(tmp_path):
    folder = make(tmp_path / "session", ["GX010042.MP4", "GX010017.MP4"], names=())
    proposal = propose_trial(folder)
    assert proposal.calibration is None
    assert pairs(proposal) == {"cam01": ("GX010017.MP4", "a new name"), "cam02": ("GX010042.MP4", "a new name")}
    proposal.write()
    assert open_calibration_session(folder).names == ("cam01", "cam02")
    ordinary = propose_trial(make(tmp_path / "other", ["left.mp4", "right.mp4"], names=()))
    assert pairs(ordinary) == {"left": ("left.mp4", "the name"), "right": ("right.mp4", "the name")}


def test_a_calibration_elsewhere_is_written_as_a_relative_path(tmp_path):
    make(tmp_path / "session", [])
    folder = make(tmp_path / "trial", ["cam01.mp4", "cam02.mp4"], names=())
    (folder / "trial.toml").write_text('# mine\nstature_m = 1.7 # measured\n\n[world]\nup = "y"\n')
    path = propose_trial(folder, calibration=tmp_path / "session").write()
    text = path.read_text()
    assert text.startswith('# mine\ncalibration = "../session/cameras.toml"\nstature_m = 1.7 # measured\n')
    assert '[videos]\n"cam01" = "cam01.mp4"\n' in text
    settings = read_trial(folder).settings
    assert settings.stature_m == 1.7
    assert settings.world is not None
    with pytest.raises(FileProblem, match=r"has videos and calibration already. Remove them"):
        propose_trial(folder, calibration=tmp_path / "session").write()
    assert path.read_text() == text


def test_a_missing_video_or_another_size_prevents_writing(tmp_path):
    folder = make(tmp_path / "trial", ["cam01.mp4"])
    proposal = propose_trial(folder)
    assert proposal.missing == ("cam02",)
    with pytest.raises(FileProblem, match="has no video of cam02"):
        proposal.write()
    write_video(folder / "cam02.mp4", 3, size=(32, 24))
    proposal = propose_trial(folder)
    assert "cam02.mp4 is 32 x 24, but camera 'cam02' was calibrated at 64 x 48." in str(proposal)
    with pytest.raises(FileProblem, match="is 32 x 24"):
        proposal.write()
    assert not (folder / "trial.toml").exists()
    write_video(folder / "cam02.mp4", 3)
    write_video(folder / "cam03.mp4", 3)
    assert [path.name for path, _ in propose_trial(folder).left_out] == ["cam03.mp4"]


def test_a_rotation_by_metadata_is_shown(tmp_path):
    folder = make(tmp_path / "trial", ["cam01.mp4", "cam02.mp4"], sizes={"cam01": (48, 64), "cam02": (64, 48)})
    for name in ("cam01", "cam02"):
        turn_by_metadata(write_video(folder / f"{name}.mp4", 3), 1)
    lines = propose_trial(folder).lines()
    assert "48 x 64 (rotated 90)" in lines[2]
    assert "rotated" not in lines[3]
    assert "64 x 48" in lines[3]


def test_a_folder_without_videos_is_an_error(tmp_path):
    with pytest.raises(FileProblem, match="has no videos"):
        propose_trial(tmp_path)
    with pytest.raises(FileProblem, match="does not exist"):
        propose_trial(tmp_path / "nowhere")
    with pytest.raises(FileProblem, match="does not exist"):
        propose_trial(make(tmp_path / "trial", ["a.mp4"]), calibration=tmp_path / "nowhere")

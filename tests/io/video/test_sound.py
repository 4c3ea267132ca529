import av
import numpy as np
import pytest
from tests.clips import numbered_picture, write_video

from marey.io.video.sound import SOUND_RATE, read_sound


def write_with_sound(path, samples, rate):
    """Write a video of 25 pictures with the sound of one channel."""
    with av.open(str(path), "w") as container:
        video = container.add_stream("mpeg4", rate=25)
        video.width, video.height, video.pix_fmt = 64, 48, "yuv420p"
        audio = container.add_stream("pcm_s16le", rate=rate)
        audio.layout = "mono"
        for number in range(25):
            container.mux(video.encode(av.VideoFrame.from_ndarray(numbered_picture(number), format="bgr24")))
        container.mux(video.encode())
        frame = av.AudioFrame.from_ndarray((samples * 32767).astype(np.int16)[None], format="s16", layout="mono")
        frame.sample_rate = rate
        container.mux(audio.encode(frame))
        container.mux(audio.encode())


def test_sound_is_read_at_one_rate(tmp_path):
    times = np.arange(44100) / 44100
    samples = np.where(np.abs(times - 0.5) < 0.05, 0.5 * np.sin(2 * np.pi * 1000 * times), 0.0)
    write_with_sound(tmp_path / "cam01.mkv", samples, 44100)
    sound = read_sound(tmp_path / "cam01.mkv")
    assert len(sound.samples) == pytest.approx(SOUND_RATE, abs=40)
    assert sound.begin_s == pytest.approx(0.0, abs=1e-3)
    loud = np.flatnonzero(np.abs(sound.samples) > 0.2) / SOUND_RATE
    assert (loud.min(), loud.max()) == pytest.approx((0.45, 0.55), abs=0.003)


def test_a_video_without_sound_has_none(tmp_path):
    assert read_sound(write_video(tmp_path / "cam01.mp4", 4)) is None
    (tmp_path / "text.mp4").write_text("no video")
    assert read_sound(tmp_path / "text.mp4") is None

import struct
import subprocess
import sys
from collections.abc import Sequence
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest
from tests.clips import number_of, numbered_picture, write_video

from marey.errors import FileProblem
from marey.io.video.video import open_clip, open_stills, open_video
from marey.io.video.video_writer import VideoWriter


@pytest.mark.parametrize("name", ["clip.mp4", "clip.avi"])
def test_every_frame_is_found_by_its_number_in_any_order(tmp_path, name):
    clip = open_clip(write_video(tmp_path / name, 150))
    assert (clip.count, clip.size, clip.rate) == (150, (64, 48), 25.0)
    assert [number_of(image) for image in clip.images(range(150))] == list(range(150))
    order = [149, 0, 80, 81, 3, 3, 120]
    assert [number_of(image) for image in clip.images(order)] == order
    assert number_of(clip.image(100)) == 100


def test_a_frame_that_does_not_exist_is_an_error(tmp_path):
    clip = open_clip(write_video(tmp_path / "clip.mp4", 5))
    for frame in (-1, 5):
        with pytest.raises(IndexError, match="frames 0 to 4"):
            clip.image(frame)


def test_a_container_that_counts_empty_packets_is_counted_by_its_images(shared):
    clip = open_clip(shared / "data/people/seated/cam1.avi")
    assert clip.count == 426
    assert sum(1 for _ in clip.images(range(clip.count))) == 426


def test_a_truncated_clip_is_an_error_when_it_is_opened(tmp_path):
    path = write_video(tmp_path / "clip.avi", 60)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(FileProblem, match=r"clip.avi: is incomplete: its header states 60 frames, but \d+ can be read"):
        open_clip(path)


@pytest.mark.parametrize("content", [b"", b"no video at all" * 100])
def test_a_file_that_is_not_a_video_cannot_be_opened(tmp_path, content):
    path = tmp_path / "cam01.mp4"
    path.write_bytes(content)
    with pytest.raises(FileProblem, match=r"cam01.mp4: cannot be opened as a video"):
        open_clip(path)


def test_the_decoder_writes_no_lines_of_its_own(tmp_path):
    path = tmp_path / "cam01.mp4"
    path.write_bytes(b"no video at all" * 100)
    script = (
        "import pathlib, sys\nfrom marey.errors import FileProblem\nfrom marey.io.video.video import open_clip\n"
        "try:\n    open_clip(pathlib.Path(sys.argv[1]))\nexcept FileProblem:\n    print('reported')"
    )
    run = subprocess.run([sys.executable, "-c", script, str(path)], capture_output=True, text=True, check=True)
    assert (run.stdout, run.stderr) == ("reported\n", "")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileProblem, match=r"cam01.mp4: does not exist"):
        open_clip(tmp_path / "cam01.mp4")


def encode(path, codec: str, *, times: Sequence[int], options: dict[str, str] | None = None):
    """Write numbered images at given times, in hundredths of a second."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25, options=options or {})
        stream.width, stream.height, stream.pix_fmt = 128, 96, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 100)
        for number, time in enumerate(times):
            frame = av.VideoFrame.from_ndarray(numbered_picture(number, (128, 96)), format="bgr24")
            frame.pts, frame.time_base = time, Fraction(1, 100)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


REORDERED = {"x264-params": "bframes=3:b-pyramid=normal:keyint=40:log-level=none"}


@pytest.mark.parametrize("name", ["a.mp4", "a.mov", "a.mkv", "a.ts"])
@pytest.mark.parametrize(
    "times",
    [range(0, 600, 4), range(100, 700, 4), np.cumsum(np.random.default_rng(0).integers(2, 9, 150)).tolist()],
    ids=["from zero", "from one second", "unequal steps"],
)
def test_frames_stored_out_of_order_are_given_in_order_from_any_container(tmp_path, name, times):
    clip = open_clip(encode(tmp_path / name, "libx264", times=times, options=REORDERED))
    assert clip.count == 150
    assert [number_of(image) for image in clip.images(range(150))] == list(range(150))
    order = [149, 0, 80, 81, 3, 120, 120]
    assert [number_of(image) for image in clip.images(order)] == order


def test_a_file_shorter_than_its_header_states_is_incomplete(tmp_path):
    path = encode(tmp_path / "a.mkv", "libx264", times=range(0, 600, 4), options=REORDERED)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(FileProblem, match=r"is incomplete: its header states 6.0\d s, but the last image is at"):
        open_clip(path)


def test_the_damaged_frame_is_named_and_the_frames_before_it_are_usable(tmp_path):
    path = encode(tmp_path / "clip.mp4", "libx264", times=range(0, 400, 4), options=REORDERED)
    sound = path.read_bytes()
    start, end = sound.find(b"mdat") + 1000, sound.find(b"moov") - 400
    if end < start:
        start, end = sound.find(b"mdat") + 1000, len(sound) - 400
    rng = np.random.default_rng(1)
    reported = 0
    for where in np.linspace(start, end, 15).astype(int):
        path.write_bytes(sound[:where] + rng.bytes(60) + sound[where + 60 :])
        shown, problem = read_what_there_is(path)
        reported += problem is not None
        # Frames before the damage are right; those that the decoder could not recognise as damaged may be wrong.
        assert sum(number != i for i, number in enumerate(shown)) <= 3
        if problem is not None and "is damaged: frame" in problem:
            assert f"frame {len(shown)} of 100" in problem
            assert f"frames = [0, {len(shown)}]" in problem
    assert reported >= 12


def read_what_there_is(path):
    shown = []
    try:
        clip = open_clip(path)
        for image in clip.images(range(clip.count)):
            shown.append(number_of(image))
    except FileProblem as problem:
        return shown, str(problem)
    return shown, None


def test_a_video_that_a_player_shows_turned_is_turned(tmp_path):
    path = write_video(tmp_path / "a.mp4", 3)
    content = bytearray(path.read_bytes())
    # The matrix in the track's header, as a telephone held upright writes it.
    matrix = content.find(b"tkhd") + 4 + 40
    content[matrix : matrix + 36] = struct.pack(">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, 48 << 16, 0, 1 << 30)
    path.write_bytes(content)
    clip = open_clip(path)
    assert clip.size == (48, 64)
    shown = cv2.VideoCapture(str(path)).read()[1]
    assert np.array_equal(clip.image(0), shown)
    assert np.array_equal(np.rot90(open_clip(write_video(path, 3)).image(0), -1), shown)


def test_stills_are_one_clip_of_one_size(tmp_path):
    paths = tuple(tmp_path / f"left_{number}.png" for number in range(3))
    for number, path in enumerate(paths):
        cv2.imwrite(str(path), numbered_picture(number))
    clip = open_stills(paths)
    assert (clip.count, clip.size, clip.rate, clip.path) == (3, (64, 48), None, paths[0])
    assert [number_of(image) for image in clip.images([2, 0, 1])] == [2, 0, 1]
    cv2.imwrite(str(paths[2]), numbered_picture(2, (32, 24)))
    with pytest.raises(FileProblem, match=r"left_2.png: has the size 32 x 24"):
        clip.image(2)
    paths[1].write_bytes(b"\xff\xd8\xff broken")
    with pytest.raises(FileProblem, match=r"left_1.png: is not a readable image"):
        clip.image(1)


def test_after_a_seek_all_pictures_are_those_of_reading_in_sequence(tmp_path):
    """Also with pictures that refer to later ones, of which a seek decodes only those that others refer to."""
    path = tmp_path / "a.mp4"
    coding = {"g": "250", "bf": "3", "b_strategy": "0", "b-pyramid": "normal", "sc_threshold": "0"}
    noise = np.random.default_rng(5).integers(0, 255, (48, 96, 3), np.uint8)
    with VideoWriter(path, (64, 48), rate=25.0, coding=coding) as written:
        for shift in range(160):
            written.add(np.ascontiguousarray(np.roll(noise, shift, 1)[:, :64]))
    video = open_video(path)
    with av.open(str(path)) as container:
        assert {int(frame.pict_type) for frame in container.decode(video=0)} == {1, 2, 3}
    expected = list(video.images(range(video.count)))
    for frame in range(60, 150, 7):
        for found, right in zip(video.images(range(frame, frame + 4)), expected[frame:], strict=False):
            assert np.array_equal(found, right)

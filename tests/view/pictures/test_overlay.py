import av
import numpy as np
import pytest
from tests.takes import camera

from marey.view.pictures.drawing import LONGEST_SIDE
from marey.view.pictures.overlay import (
    BodyAppearance,
    BodyScene,
    OverlayVideo,
    draw_overlay,
    fitting_camera,
)

SQUARE = np.array([[-0.5, 0, -0.5], [0.5, 0, -0.5], [0.5, 0, 0.5], [-0.5, 0, 0.5]])
APPEARANCE = BodyAppearance(
    faces=np.array([[0, 1, 2], [0, 2, 3]]), face_segment=np.array([0, 1]), segment_names=("left_thigh", "right_thigh"),
    joint_names=("left_hip", "left_knee"),
)  # fmt: skip
GREY = np.full((120, 160, 3), 128, np.uint8)


def test_the_surface_is_drawn_where_the_camera_sees_it_and_nowhere_else():
    drawn = draw_overlay(GREY, camera(), APPEARANCE, BodyScene(frame=3, vertices=SQUARE, state=1))
    changed = (drawn != GREY).any(2)
    # 1 m at 4 m with 150 px focal length is 37.5 px high and wide, around the image's middle.
    assert changed[60 - 17 : 60 + 17, 80 - 17 : 80 + 17].all()
    assert not changed[90:].any()
    upper_left, lower_right = drawn[50, 70].astype(int), drawn[70, 90].astype(int)
    assert np.abs(upper_left - lower_right).max() > 20
    assert (GREY == 128).all()


def test_silhouette_joints_and_caption_are_drawn():
    mask = np.zeros((120, 160), bool)
    mask[30:90, 100:130] = True
    joints = np.array([[0.0, 0, 0], [0.0, 0, -0.4]])
    drawn = draw_overlay(
        GREY, camera(), APPEARANCE, BodyScene(frame=3, joints=joints, state=1), mask=mask, agreement=0.91
    )
    assert (drawn[30, 105:125] != 128).any(1).all()
    assert (drawn[60, 80] != 128).any()
    assert drawn[:12, :60].min() < 60


def test_joints_behind_the_camera_or_without_a_result_are_left_out():
    joints = np.array([[0.0, -9.0, 0], [np.nan] * 3])
    drawn = draw_overlay(GREY, camera(), APPEARANCE, BodyScene(frame=0, joints=joints))
    np.testing.assert_array_equal(drawn[40:], GREY[40:])


def test_the_video_has_every_image_and_opens_as_h264(tmp_path):
    path = tmp_path / "overlay_cam01.mp4"
    odd = camera(size=(161, 121))
    picture = np.full((121, 161, 3), 90, np.uint8)
    with OverlayVideo(path, odd, APPEARANCE, rate=29.97) as video:
        for frame in range(5):
            video.add(picture, BodyScene(frame=frame))
        assert not path.exists()
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert float(stream.average_rate) == pytest.approx(29.97, rel=1e-4)
        shapes = [frame.to_ndarray(format="bgr24").shape for frame in container.decode(stream)]
    assert shapes == [(122, 162, 3)] * 5
    assert [p.name for p in tmp_path.iterdir()] == ["overlay_cam01.mp4"]


def test_an_interrupted_video_leaves_no_file(tmp_path):
    def draw_and_fail() -> None:
        with OverlayVideo(tmp_path / "overlay_cam01.mp4", camera(), APPEARANCE, rate=30.0) as video:
            video.add(GREY, BodyScene(frame=0))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        draw_and_fail()
    assert list(tmp_path.iterdir()) == []


def test_large_images_are_halved():
    assert fitting_camera(camera()).size == (160, 120)
    assert max(fitting_camera(camera(size=(1920, 1080))).size) <= LONGEST_SIDE

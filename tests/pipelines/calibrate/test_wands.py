"""A wand and tags on the floor, from pictures to cameras and the page."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.made_boards import made_rig
from tests.made_wands import TAGS, made_wand, waved

import marey
from marey.calibration.boards.detection import known_dictionary
from marey.calibration.boards.wand import CalibrationWand
from marey.cameras.camera import Camera
from marey.cli.main import run
from marey.io.video.pictures import write_picture

BALLS = CalibrationWand(distances=(0.2, 0.4), diameter=0.04)
DESCRIPTION = {
    "type": "wand", "distances_m": [0.2, 0.4], "ball_m": 0.04,
    "landmarks": {"dictionary": "DICT_4X4_50", "tags": {str(each.tag): list(each.place) for each in TAGS}},
}  # fmt: skip
SIDE = 0.3
"""Side of the tags [m]."""


def with_tag(image: np.ndarray, camera: Camera, number: int, place: np.ndarray) -> np.ndarray:
    """Draw a tag that lies on the floor with its centre at a place."""
    tag = cv2.aruco.generateImageMarker(known_dictionary("DICT_4X4_50"), number, 240)
    tag = cv2.copyMakeBorder(tag, 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=255)
    half = 0.5 * SIDE * 320 / 240
    corners = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]]) + place
    source = np.array([[-0.5, -0.5], [319.5, -0.5], [319.5, 319.5], [-0.5, 319.5]], np.float32)
    change = cv2.getPerspectiveTransform(source, camera.project(corners).astype(np.float32))
    size = (image.shape[1], image.shape[0])
    drawn = cv2.warpPerspective(tag, change, size, flags=cv2.INTER_AREA)
    inside = cv2.warpPerspective(np.full_like(tag, 255), change, size) > 127
    return np.where(inside, drawn, image)


def with_ball(image: np.ndarray, camera: Camera, centre: np.ndarray, radius: float) -> np.ndarray:
    """Draw the outline of a ball exactly."""
    ahead = centre - camera.centre
    distance = np.linalg.norm(ahead)
    axis = ahead / distance
    side = np.cross(axis, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    ring = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * np.cross(axis, side)
    sine = radius / distance
    points = camera.centre + distance * (1 - sine**2) * axis + radius * np.sqrt(1 - sine**2) * ring
    outline = np.round(camera.project(points) * 64).astype(np.int32)
    return cv2.fillPoly(image.copy(), [outline], 250, cv2.LINE_AA, shift=6)


def plain_cameras() -> list[Camera]:
    """Cameras without distortion, so that straight edges stay straight in the drawings."""
    return list(made_rig(3, np.random.default_rng(3), lens=False, radius=3.2))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from marey.cameras.rig import Rig

    folder = tmp_path_factory.mktemp("wand")
    (folder / "board.json").write_text(json.dumps(DESCRIPTION))
    rig = Rig(tuple(plain_cameras()))
    made = made_wand(rig=rig, pictures=40, seed=2, wand=BALLS)
    for number, camera in enumerate(rig):
        noise = np.random.default_rng(number).normal(0, 1.5, (camera.height, camera.width)).astype(np.float32)
        empty = np.full((camera.height, camera.width), 90, np.uint8)
        for each in TAGS:
            if camera.sees(camera.project(np.array([each.place])), margin=60.0).all():
                empty = with_tag(empty, camera, int(each.tag or 0), np.array(each.place))
        # A lamp that is always there.
        empty = cv2.circle(empty, (640, 30), 6, 255, -1, cv2.LINE_AA)
        for picture, pose in enumerate(made.poses):
            image = empty
            for centre in pose.apply(BALLS.points):
                image = with_ball(image, camera, centre, 0.5 * BALLS.diameter)
            # Noise of another place in each picture.
            noisy = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.6) + np.roll(noise, 977 * picture)
            shown = np.clip(np.round(noisy), 0, 255).astype(np.uint8)
            write_picture(folder / f"{camera.name}_{picture:03d}.jpg", shown)
    return folder


@pytest.mark.slow
def test_cameras_are_calibrated_from_pictures_of_a_wand(folder: Path, tmp_path: Path):
    found = marey.calibrate(folder, out=tmp_path / "out")
    assert found.usable
    assert found.data["world"] == "points"
    assert len(found.data["points"]["used"]) >= 3
    for camera in plain_cameras():
        own = found.cameras[camera.name]
        assert own.matrix[0, 0] == pytest.approx(camera.matrix[0, 0], rel=5e-3)
        np.testing.assert_allclose(own.centre, camera.centre, atol=0.02)


LATE = (0.0, 0.4, 3.0)
"""By how many pictures the cameras of the videos are late."""


@pytest.mark.slow
def test_videos_out_of_step_are_calibrated_with_their_delays(tmp_path: Path):
    folder = tmp_path / "videos"
    folder.mkdir()
    (folder / "board.json").write_text(json.dumps(DESCRIPTION))
    shown = waved(70, np.random.default_rng(2), BALLS, late=LATE, pace=0.14)
    for camera, poses in zip(plain_cameras(), shown, strict=True):
        empty = np.full((camera.height, camera.width), 90, np.uint8)
        for each in TAGS:
            if camera.sees(camera.project(np.array([each.place])), margin=60.0).all():
                empty = with_tag(empty, camera, int(each.tag or 0), np.array(each.place))
        code = cv2.VideoWriter_fourcc(*"MJPG")
        writer = cv2.VideoWriter(str(folder / f"{camera.name}.avi"), code, 10.0, (camera.width, camera.height))
        for pose in poses:
            image = empty
            for centre in pose.apply(BALLS.points):
                image = with_ball(image, camera, centre, 0.5 * BALLS.diameter)
            writer.write(cv2.cvtColor(cv2.GaussianBlur(image, (0, 0), 0.6), cv2.COLOR_GRAY2BGR))
        writer.release()
    found = marey.calibrate(folder, out=tmp_path / "out")
    clocks = found.data["clocks"]
    assert clocks["reference"] == "cam01"
    for name, late in zip(("cam02", "cam03"), LATE[1:], strict=True):
        own = clocks["cameras"][name]
        assert own["determined"]
        assert own["allowed_for"]
        assert own["late_pictures"] == pytest.approx(late, abs=0.02)
        assert own["late_s"] == pytest.approx(late / 10.0, abs=0.002)
        low, high = own["interval_95"]
        assert low < own["late_pictures"] < high
    late_names = [each["text"].split()[0] for each in found.data["findings"] if each["code"] == "camera-late"]
    assert sorted(late_names) == ["cam02", "cam03"]
    page = (tmp_path / "out" / "calibration.html").read_text(encoding="utf-8")
    assert "allowed for" in page
    assert "later than cam01" in page
    for camera in plain_cameras():
        np.testing.assert_allclose(found.cameras[camera.name].centre, camera.centre, atol=0.03)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"distances_m": [0.2, 0.3, 0.4]}, "it should have two or three"),
        ({"colours": ["pink"]}, "unknown colour 'pink'"),
        ({"distances": [0.2]}, "wrong value at 'distances'"),
        ({"landmarks": {"tags": {"1": [0, 0, 0]}, "dictionary": "nothing"}}, "no usable dictionary"),
        ({"landmarks": {"points": {"A": [0, 0, 0]}, "pixels": {"cam01": {"B": [1, 2]}}}}, "pixels of 'B'"),
        ({"landmarks": {}}, "has no point with coordinates and pixels"),
    ],
)
def test_a_wrong_description_of_a_wand_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], change: dict, text: str
):
    write_picture(tmp_path / "cam01_1.png", np.zeros((48, 64), np.uint8))
    wand = {key: value for key, value in DESCRIPTION.items() if key != "landmarks"}
    (tmp_path / "board.json").write_text(json.dumps(wand | change))
    assert run(["calibrate", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert text in error.replace("\n", " ")
    assert not (tmp_path / "marey").exists()

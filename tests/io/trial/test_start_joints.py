import json

import numpy as np
import pytest
from tests.clips import calibration_text

from marey.errors import FileProblem
from marey.io.calibration.readers import read_rig
from marey.io.trial.start_joints import JOINTS, LAYOUTS, read_start_joints


@pytest.fixture
def rig(tmp_path):
    (tmp_path / "cameras.toml").write_text(calibration_text(("cam01", "cam02")))
    return read_rig(tmp_path)


def write(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_clicks_are_read_by_camera_and_joint(tmp_path, rig):
    content = {"frame": 7, "cam02": {"left_hip": [10, 20.5], "head": [1, 2]}, "cam09": {"head": [5000, 0]}}
    for form in (content, {"frame": 7, "cameras": {k: v for k, v in content.items() if k != "frame"}}):
        joints = read_start_joints(write(tmp_path / "start.json", form), rig, frames=range(9))
        assert (joints.frame, joints.camera_names, joints.layout) == (7, ("cam01", "cam02"), "clicked")
        assert np.array_equal(joints.pixels[1, JOINTS.index("left_hip")], [10, 20.5])
        assert np.isfinite(joints.pixels[..., 0]).sum() == joints.confidence.sum() == 2


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "is not JSON"),
        ([1], "does not contain the joints"),
        ({"people": []}, "Give a folder with"),
        ({"cam01": {"head": [1, 2]}}, "has frame = None, which is not a whole number from 0 to 8"),
        ({"frame": 9, "cam01": {"head": [1, 2]}}, "has frame = 9"),
        ({"frame": 1}, "has none of the cameras cam01, cam02"),
        ({"frame": 1, "cam03": {"head": [1, 2]}}, "has none of the cameras cam01, cam02"),
        ({"frame": 1, "cam01": {"l_hip": [1, 2]}}, r"unknown joint 'l_hip' \(the joints are neck, head"),
        ({"frame": 1, "cam01": {"head": [1]}}, r"head = \[1\], which is not \[x, y\]"),
        ({"frame": 1, "cam01": {"head": [1, "2"]}}, r"which is not \[x, y\]"),
        ({"frame": 1, "cam01": {"head": [100, 2]}}, "outside its image of 64 x 48"),
        ({"frame": 1, "cam01": [1]}, "'cam01' has no table of joints by name"),
    ],
)
def test_wrong_clicks_are_reported_with_the_expected_content(tmp_path, rig, content, message):
    with pytest.raises(FileProblem, match=message) as caught:
        read_start_joints(write(tmp_path / "start.json", content), rig, frames=range(9))
    assert "start.json" in str(caught.value)


def test_a_missing_file_is_reported(tmp_path, rig):
    with pytest.raises(FileProblem, match="does not exist"):
        read_start_joints(tmp_path / "none.json", rig, frames=range(9))


def person_at(rig, count: int, shift: float, confidence: float = 0.9):
    """A person whose points lie on a line in space, seen by both cameras."""
    space = np.column_stack([np.linspace(-0.5, 0.5, count), np.full(count, shift), np.linspace(0.4, -0.4, count)])
    return [
        {"pose_keypoints_2d": np.column_stack([camera.project(space), np.full(count, confidence)]).ravel().tolist()}
        for camera in rig
    ]


@pytest.mark.parametrize("count", sorted(LAYOUTS))
@pytest.mark.parametrize("place", ["{name}_json/{name}_{frame:06d}.json", "{name}_{frame:012d}_keypoints.json"])
def test_files_of_openpose_are_read_and_the_clearest_frame_is_used(tmp_path, rig, count, place):
    folder = tmp_path / "pose"
    for frame, confidence in ((3, 0.5), (4, 0.8), (5, 0.0)):
        persons = person_at(rig, count, 0.0, confidence)
        for name, person in zip(rig.names, persons, strict=True):
            write(folder / place.format(name=name, frame=frame), {"version": 1.3, "people": [person]})
    joints = read_start_joints(folder, rig, frames=range(9))
    name, layout = LAYOUTS[count]
    assert (joints.frame, joints.layout) == (4, name)
    points = np.array(person_at(rig, count, 0.0)[0]["pose_keypoints_2d"]).reshape(-1, 3)
    for joint, which in layout.items():
        expected = points[list(which), :2].mean(axis=0)
        assert np.allclose(joints.pixels[0, JOINTS.index(joint)], expected)
    given = [joint in layout for joint in JOINTS]
    assert np.array_equal(joints.confidence[0] > 0, given)
    assert joints.confidence.max() == pytest.approx(0.8)


def test_left_is_left_in_every_layout():
    # The published orders: each side's wrist follows its elbow, and right comes first in OpenPose, left in COCO.
    assert LAYOUTS[25][1]["right_wrist"] == (4,)
    assert LAYOUTS[25][1]["left_ankle"] == (14,)
    assert LAYOUTS[18][1]["left_wrist"] == (7,)
    assert LAYOUTS[18][1]["right_ankle"] == (10,)
    assert LAYOUTS[17][1]["left_wrist"] == (9,)
    assert LAYOUTS[26][1]["right_toe"] == (21, 23)
    for _, layout in LAYOUTS.values():
        assert set(layout) <= set(JOINTS)
        assert len({point for points in layout.values() for point in points}) >= 14


def test_the_person_that_is_visible_in_both_views_is_chosen(tmp_path, rig):
    folder = tmp_path / "pose"
    first, second = person_at(rig, 25, 0.0, 0.7), person_at(rig, 25, 0.7, 0.9)
    write(folder / "cam01_json" / "cam01_000001.json", {"people": [second[0], first[0]]})
    write(folder / "cam02_json" / "cam02_000001.json", {"people": [first[1]]})
    joints = read_start_joints(folder, rig, frames=range(9))
    expected = np.array(first[0]["pose_keypoints_2d"]).reshape(-1, 3)[6, :2]
    assert np.allclose(joints.pixels[0, JOINTS.index("left_elbow")], expected)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            {"people": [{"pose_keypoints_2d": [1, 2, 3]}]},
            r"of 1 points in pose_keypoints_2d. The known numbers of points are 17 \(COCO-17\)",
        ),
        ({"people": [{"pose_keypoints_2d": [1, 2]}]}, "of 0.666667 points"),
        ({"people": [{"pose_keypoints_2d": "x"}]}, "has a person without numbers"),
        ({"persons": []}, "has no list called people"),
        ({"people": []}, "has no person in any frame"),
    ],
)
def test_wrong_keypoints_are_reported(tmp_path, rig, content, message):
    write(tmp_path / "pose" / "cam01" / "0001.json", content)
    with pytest.raises(FileProblem, match=message):
        read_start_joints(tmp_path / "pose", rig, frames=range(9))


def test_a_folder_without_keypoints_is_rejected(tmp_path, rig):
    (tmp_path / "pose").mkdir()
    with pytest.raises(FileProblem, match="has no keypoints of cam01, cam02"):
        read_start_joints(tmp_path / "pose", rig, frames=range(9))

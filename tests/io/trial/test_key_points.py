"""Detected joints of all images: every layout, several persons, and one clear line for each wrong folder."""

import json

import numpy as np
import pytest
from tests.clips import calibration_text
from tests.detected import openpose, write_folder

from marey.errors import FileProblem
from marey.io.calibration.readers import read_rig
from marey.io.trial.key_points import JOINTS, LAYOUTS, LEAST_CONFIDENCE, MOST_PEOPLE, read_key_points

COCO_17 = """
nose left_eye right_eye left_ear right_ear left_shoulder right_shoulder left_elbow right_elbow left_wrist right_wrist
left_hip right_hip left_knee right_knee left_ankle right_ankle
"""
"""The published order of COCO; Halpe-26 and COCO-WholeBody-133 begin with it."""
OPENPOSE = """
nose neck right_shoulder right_elbow right_wrist left_shoulder left_elbow left_wrist
"""
PUBLISHED = {
    17: COCO_17,
    26: f"""{COCO_17} head_top neck pelvis left_big_toe right_big_toe left_small_toe right_small_toe left_heel
        right_heel""",
    133: f"{COCO_17} left_big_toe left_small_toe left_heel right_big_toe right_small_toe right_heel",
    18: f"""{OPENPOSE} right_hip right_knee right_ankle left_hip left_knee left_ankle
        right_eye left_eye right_ear left_ear""",
    25: f"""{OPENPOSE} mid_hip right_hip right_knee right_ankle left_hip left_knee left_ankle
        right_eye left_eye right_ear left_ear left_big_toe left_small_toe left_heel right_big_toe right_small_toe
        right_heel""",
    33: """nose left_eye_inner left_eye left_eye_outer right_eye_inner right_eye right_eye_outer left_ear right_ear
        mouth_left mouth_right left_shoulder right_shoulder left_elbow right_elbow left_wrist right_wrist left_pinky
        right_pinky left_index right_index left_thumb right_thumb left_hip right_hip left_knee right_knee
        left_ankle right_ankle left_heel right_heel left_foot_index right_foot_index""",
}
"""Names of the points in the order that each detector's authors publish."""
MEANS = {
    "neck": ("left_shoulder", "right_shoulder"),
    "head": ("left_ear", "right_ear"),
    "left_toe": ("left_big_toe", "left_small_toe"),
    "right_toe": ("right_big_toe", "right_small_toe"),
}
"""Joints that are the mean of two points, where the layout has no point of the joint's own name."""


@pytest.fixture
def rig(tmp_path):
    (tmp_path / "cameras.toml").write_text(calibration_text(("cam01", "cam02", "cam03")))
    return read_rig(tmp_path)


def someone(seed: int) -> np.ndarray:
    """The pixels (J, 2) of a person's joints."""
    return np.random.default_rng(seed).uniform(5, 40, (len(JOINTS), 2))


@pytest.mark.parametrize("count", sorted(LAYOUTS))
def test_the_points_of_a_layout_are_those_of_the_published_order(count):
    names = PUBLISHED[count].split()
    for joint, points in LAYOUTS[count][1].items():
        expected = (joint,) if joint in names else MEANS[joint]
        assert {names[point] for point in points} == set(expected)
    without_toes = 18, 17, 33
    assert set(JOINTS) - set(LAYOUTS[count][1]) == ({"left_toe", "right_toe"} if count in without_toes else set())


@pytest.mark.parametrize("count", sorted(LAYOUTS))
def test_every_layout_is_recognised_by_its_number_of_points(tmp_path, rig, count):
    pixels = [someone(seed) for seed in range(3)]
    folder = write_folder(tmp_path / "pose", rig.names, [[[openpose(p, 0.8, layout=count)] for p in pixels]])
    found = read_key_points(folder, rig, count=1)
    name, layout = LAYOUTS[count]
    assert (found.layout, found.camera_names, found.joint_names) == (name, rig.names, JOINTS)
    assert found.pixels.shape == (1, 3, 1, len(JOINTS), 2)
    own = [JOINTS.index(joint) for joint in layout if len(layout[joint]) == 1]
    np.testing.assert_allclose(found.pixels[0, :, 0, own], np.array(pixels)[:, own].swapaxes(0, 1))
    given = np.array([joint in layout for joint in JOINTS])
    np.testing.assert_array_equal(found.confidence[0, :, 0], np.where(given, 0.8, 0.0)[None].repeat(3, 0))
    np.testing.assert_array_equal(np.isfinite(found.pixels[0, 0, 0, :, 0]), given)


def test_all_persons_are_kept_the_most_confident_first_and_missing_joints_have_no_pixel(tmp_path, rig):
    crowd = [openpose(someone(seed), 0.3 + 0.1 * seed) for seed in range(MOST_PEOPLE + 1)]
    partly = someone(9)
    partly[JOINTS.index("left_wrist")] = np.nan
    frames = [[crowd, [crowd[1]], []], [[], [openpose(partly)], [crowd[0], crowd[2]]]]
    found = read_key_points(write_folder(tmp_path / "pose", rig.names, frames), rig, count=2)
    assert found.pixels.shape == (2, 3, MOST_PEOPLE, len(JOINTS), 2)
    hip = JOINTS.index("left_hip")
    for p, seed in enumerate((4, 3, 2, 1)):
        np.testing.assert_allclose(found.pixels[0, 0, p, hip], someone(seed)[hip])
        assert found.confidence[0, 0, p, hip] == pytest.approx(0.3 + 0.1 * seed)
    assert np.isnan(found.pixels[0, 1, 1:]).all()
    assert np.isnan(found.pixels[0, 2]).all()
    assert np.isnan(found.pixels[1, 0]).all()
    assert not found.confidence[1, 0].any()
    wrist = JOINTS.index("left_wrist")
    assert np.isnan(found.pixels[1, 1, 0, wrist]).all()
    assert found.confidence[1, 1, 0, wrist] == 0
    np.testing.assert_allclose(found.pixels[1, 1, 0, hip], partly[hip])


def test_a_joint_of_two_points_needs_both_and_has_the_lower_confidence(tmp_path, rig):
    person = openpose(someone(1))
    points = np.array(person["pose_keypoints_2d"]).reshape(-1, 3)
    points[3] = 10, 20, 0.6
    points[4] = 14, 22, 1.2
    points[22, 2] = LEAST_CONFIDENCE / 2
    person = {"pose_keypoints_2d": points.ravel().tolist()}
    found = read_key_points(write_folder(tmp_path / "pose", rig.names, [[[person]] * 3]), rig, count=1)
    np.testing.assert_allclose(found.pixels[0, 0, 0, JOINTS.index("head")], [12, 21])
    assert found.confidence[0, 0, 0, JOINTS.index("head")] == 0.6
    assert np.isnan(found.pixels[0, 0, 0, JOINTS.index("left_toe")]).all()


def test_a_camera_without_files_has_no_joints_and_other_cameras_and_later_frames_are_ignored(tmp_path, rig):
    frames = [[[openpose(someone(frame))]] * 3 for frame in range(5)]
    folder = write_folder(tmp_path / "pose", ("cam01", "cam03", "cam09"), frames)
    (folder / "cam01_json" / "notes.json").write_text("not numbered")
    (folder / "cam01_json" / "cam01_000007.json").write_text("{")
    found = read_key_points(folder, rig, count=4)
    assert found.pixels.shape[0] == 4
    given = np.isfinite(found.pixels[..., 0]).all(axis=(0, 2, 3))
    np.testing.assert_array_equal(given, [True, False, True])


@pytest.mark.parametrize("place", ["{name}/{frame:04d}.json", "{name}_{frame:012d}_keypoints.json"])
def test_the_files_are_found_in_other_places_too(tmp_path, rig, place):
    for frame in range(2):
        for name in rig.names:
            path = tmp_path / "pose" / place.format(name=name, frame=frame)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps({"people": [openpose(someone(frame))]}))
    found = read_key_points(tmp_path / "pose", rig, count=2)
    for frame in range(2):
        np.testing.assert_allclose(found.pixels[frame, 2, 0, 5], someone(frame)[5])


def no_folder(folder):
    return folder / "none", "none: does not exist. Give a folder with CAMERA_json"


def a_file(folder):
    (folder / "pose.json").write_text("{}")
    return folder / "pose.json", r"pose.json: is not a folder. Give a folder with CAMERA_json"


def another_camera_set(folder):
    write_folder(folder / "pose", ("left", "right"), [[[openpose(someone(0))]] * 2])
    return folder / "pose", "has key points of none of the cameras cam01, cam02, cam03. At least two cameras"


def one_camera(folder):
    write_folder(folder / "pose", ("cam02", "right"), [[[openpose(someone(0))]] * 2])
    return folder / "pose", "has key points only of cam02 of the cameras cam01, cam02, cam03. At least two cameras"


def nobody(folder):
    write_folder(folder / "pose", ("cam01", "cam02"), [[[], []]] * 3)
    return folder / "pose", "has no person in the frames 0 to 8. Check that the files belong to this recording"


def only_later_frames(folder):
    for camera in ("cam01", "cam02"):
        path = folder / "pose" / camera / "0009.json"
        path.parent.mkdir(parents=True)
        path.write_text(json.dumps({"people": [openpose(someone(0))]}))
    return folder / "pose", "has no person in the frames 0 to 8"


def two_detectors(folder):
    frames = [[[openpose(someone(0), layout=26)], [openpose(someone(1), layout=133)]]]
    write_folder(folder / "pose", ("cam01", "cam02"), frames)
    return folder / "pose", "mixes the layouts Halpe-26 and COCO-WholeBody-133. Write all files with one detector"


def another_number_of_points(folder):
    person = {"pose_keypoints_2d": [1.0] * 63}
    write_folder(folder / "pose", ("cam01", "cam02"), [[[person], [person]]])
    return folder / "pose", r"cam01_000000.json: has a person of 21 points in pose_keypoints_2d. The known numbers of"


def no_json(folder):
    write_folder(folder / "pose", ("cam01", "cam02"), [[[openpose(someone(0))]] * 2])
    (folder / "pose" / "cam02_json" / "cam02_000000.json").write_text('{"people": [')
    return folder / "pose", "cam02_000000.json: is not JSON: .* Write it with the option write_json of OpenPose"


def no_numbers(folder):
    person = {"pose_keypoints_2d": [None] * 78}
    write_folder(folder / "pose", ("cam01", "cam02"), [[[person], [person]]])
    return folder / "pose", "has a person without numbers in pose_keypoints_2d"


def another_content(folder):
    write_folder(folder / "pose", ("cam01", "cam02"), [[[], []]])
    (folder / "pose" / "cam01_json" / "cam01_000000.json").write_text('{"persons": []}')
    return folder / "pose", "cam01_000000.json: has no list called people"


@pytest.mark.parametrize(
    "spoiled",
    [no_folder, a_file, another_camera_set, one_camera, nobody, only_later_frames, two_detectors,
     another_number_of_points, no_json, no_numbers, another_content],
    ids=lambda spoiled: spoiled.__name__,
)  # fmt: skip
def test_wrong_input_is_one_clear_line(tmp_path, rig, spoiled):
    folder, message = spoiled(tmp_path)
    with pytest.raises(FileProblem, match=message) as caught:
        read_key_points(folder, rig, count=9)
    assert "\n" not in str(caught.value)

"""The check of a take's cameras: what is repaired, what is left out, and what ends the run."""

import re
from dataclasses import replace

import numpy as np
import pytest
from tests import made_walk

from marey.cameras.camera import Camera
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from marey.pipelines.clocks.disagreement import ClocksDisagree
from marey.pipelines.consistency.check import check_cameras
from marey.pipelines.consistency.repairs import CamerasContradict, half_turned
from marey.pipelines.verdict import NotUsable

FIRST, COUNT = 40, 60


@pytest.fixture(scope="module")
def walk():
    cameras = [camera.scaled(2.0) for camera in made_walk.cameras()]
    masks = made_walk.silhouettes(cameras, made_walk.clocks([0] * 4), frames=[COUNT + 20] * 4)
    return cameras, masks


def checked(cameras, masks, *, late=None, clocks=True, count=COUNT, full=None):
    late = late or [0] * len(cameras)

    def mask_of(frame, camera):
        return masks[camera][frame - FIRST + 10 - late[camera]]

    frames = range(FIRST, FIRST + count)
    return check_cameras(
        cameras, full or cameras, frames, frames, mask_of, rate=made_walk.RATE, clocks=clocks
    )  # fmt: skip


def turned(camera: Camera, vector) -> Camera:
    rotation, pose = rotations.exp(np.array(vector)), camera.camera_from_world
    return replace(camera, camera_from_world=RigidTransform(rotation @ pose.rotation, rotation @ pose.translation))


@pytest.mark.slow
def test_sound_cameras_are_left_alone(walk):
    assert checked(*walk) == []


@pytest.mark.slow
def test_exchanged_cameras_get_each_others_calibration(walk):
    cameras, masks = walk
    full = [camera.scaled(3.0) for camera in cameras]
    with pytest.raises(CamerasContradict) as caught:
        checked(cameras, [masks[1], masks[0], *masks[2:]], full=full, count=20)
    repairs = caught.value.repairs
    assert sorted(repairs.cameras) == ["cam01", "cam02"]
    assert repairs.left_out == ()
    assert repairs.cameras["cam01"].name == "cam01"
    np.testing.assert_array_equal(repairs.cameras["cam01"].matrix, full[1].matrix)
    np.testing.assert_array_equal(repairs.cameras["cam02"].centre, full[0].centre)
    [finding] = repairs.reasons
    assert finding.level == "usable with limits"
    assert finding.cameras == ("cam01", "cam02")
    assert "exchanged" in finding.what
    assert "This was repaired" in finding.remedy


@pytest.mark.slow
def test_a_mirrored_camera_is_left_out(walk):
    cameras, masks = walk
    mirrored = [*masks[:2], [np.ascontiguousarray(mask[:, ::-1]) for mask in masks[2]], masks[3]]
    with pytest.raises(CamerasContradict) as caught:
        checked(cameras, mirrored, count=20)
    assert caught.value.repairs.left_out == ("cam03",)
    assert "mirrored" in str(caught.value)
    assert "Only cam01, cam02, cam04 are used" in str(caught.value)


@pytest.mark.slow
def test_a_turned_picture_is_projected_to_as_it_is(walk):
    cameras, masks = walk
    half = [*masks[:2], [np.ascontiguousarray(mask[::-1, ::-1]) for mask in masks[2]], masks[3]]
    with pytest.raises(CamerasContradict) as caught:
        checked(cameras, half, count=20)
    assert list(caught.value.repairs.cameras) == ["cam03"]


def test_the_camera_of_a_turned_picture_projects_to_the_opposite_pixel(rng):
    camera = replace(made_walk.cameras()[0], distortion=np.array([-0.2, 0.05, 0.003, -0.002, 0.01]))
    points = rng.normal(size=(20, 3)) * 0.3 + [0, 0, 1]
    expected = np.array(camera.size) - 1 - camera.project(points)
    np.testing.assert_allclose(half_turned(camera).project(points), expected, atol=1e-9)


@pytest.mark.slow
def test_late_cameras_get_clocks_of_their_own(walk):
    with pytest.raises(ClocksDisagree) as caught:
        checked(*walk, late=[0, 0, 9, 0])
    instants = caught.value.clocks.instants(2, np.array(2.0))
    assert (instants - 2.0) * made_walk.RATE == pytest.approx(-9.0, abs=0.2)


@pytest.mark.slow
def test_a_delay_that_the_user_denies_is_named_and_not_usable(walk):
    with pytest.raises(NotUsable) as caught:
        checked(*walk, late=[0, 0, 9, 0], clocks=False)
    [finding] = caught.value.verdict.reasons
    assert finding.level == "not usable"
    assert finding.cameras == ("cam03",)
    assert "9 frames later" in finding.what


@pytest.mark.slow
def test_a_late_camera_of_a_short_take_is_left_out(walk):
    with pytest.raises(CamerasContradict) as caught:
        checked(*walk, late=[0, 0, 9, 0], count=36)
    assert caught.value.repairs.left_out == ("cam03",)


@pytest.mark.slow
def test_a_camera_that_lost_pictures_is_left_out_with_the_frames(walk):
    cameras, masks = walk
    lost = [*masks[:2], [*masks[2][:42], *masks[2][50:], *masks[2][-1:] * 8], masks[3]]
    with pytest.raises(CamerasContradict) as caught:
        checked(cameras, lost)
    assert caught.value.repairs.left_out == ("cam03",)
    [finding] = caught.value.repairs.reasons
    assert finding.cause == "break"
    assert "show everything 8 frames earlier: pictures are missing" in finding.what
    frame = int(re.search(r"up to about frame (\d+) only", finding.what)[1])
    # Frame FIRST is picture 10, and pictures 42 to 49 are lost; every third frame is compared.
    assert abs(frame - (FIRST + 32)) <= 4


def test_equal_calibrations_of_all_cameras_end_the_run(walk):
    cameras, masks = walk
    with pytest.raises(NotUsable, match="cam01, cam02, cam03, cam04 are equal") as caught:
        checked([replace(cameras[0], name=camera.name) for camera in cameras], masks, count=20)
    assert caught.value.verdict.level == "not usable"


@pytest.mark.slow
def test_of_two_cameras_that_contradict_each_other_none_is_left_out(walk):
    cameras, masks = walk
    with pytest.raises(NotUsable) as caught:
        checked([cameras[0], turned(cameras[1], [0.05, 0, 0.05])], masks[:2], count=20)
    [finding] = caught.value.verdict.reasons
    assert finding.cameras == ("cam01", "cam02")
    assert "About as well explained by" in finding.what


@pytest.mark.slow
def test_contradictions_that_nothing_explains_end_the_run(walk, rng):
    cameras, masks = walk
    mixed = [[own[i] for i in rng.permutation(len(own))] for own in masks]
    with pytest.raises(NotUsable, match="contradict each other by"):
        checked(cameras, mixed)


def test_a_few_frames_are_not_checked(walk):
    cameras, masks = walk
    assert checked(cameras, [masks[1], masks[0], *masks[2:]], count=3) == []


def zoomed(camera: Camera, factor: float) -> Camera:
    return replace(camera, matrix=np.array(camera.matrix) * [[factor, factor, 1], [1, factor, 1], [1, 1, 1]])


@pytest.mark.slow
def test_two_cameras_that_nearly_agree_do_not_decide_about_the_lens(walk):
    cameras, masks = walk
    wrong = [zoomed(camera, 1.1) for camera in cameras]
    [finding] = checked(wrong[:2], masks[:2], count=20)
    assert (finding.level, finding.cameras) == ("usable with limits", ("cam01", "cam02"))
    assert "two cameras cannot decide" in finding.what
    with pytest.raises(NotUsable, match="all pictures were enlarged"):
        checked(wrong, masks, count=20)

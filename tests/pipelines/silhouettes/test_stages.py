"""The stages of a capture: what they keep, what they compare, and what they reject."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import Pose, PosedBody
from marey.body.metaballs.metaball_people import metaball_person
from marey.body.metaballs.metaball_person import reshaped
from marey.body.people.person import person_body
from marey.errors import FileProblem
from marey.geometry import rotations
from marey.images.silhouettes.background import background_of
from marey.io.results.body import write_body
from marey.io.stages import FrameLog
from marey.observations.correspondence import view_of
from marey.pipelines.capture.run import Bodies, coarse_twin, open_bodies, require_two_cameras
from marey.pipelines.capture.settings import CaptureSettings
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.silhouettes import stages
from marey.pipelines.silhouettes.mask_store import MaskStore
from marey.pipelines.verdict import NotUsable
from marey.process import limited_cores


def trial(**parts):
    """The attributes of a trial that the stages use."""
    usual = {"folder": "walk01", "calibration": "walk01/cameras.toml", "up_given": False}
    return SimpleNamespace(**usual | {"settings": SimpleNamespace(preset=None)} | parts)


@pytest.fixture
def store(tmp_path):
    cameras = worlds.ring(3, size=(40, 30))
    with FrameLog(tmp_path / "masks.log") as log:
        yield MaskStore(log, 5, cameras)


def person(*shown):
    masks = [np.zeros((30, 40), bool) for _ in shown]
    for mask, share in zip(masks, shown, strict=True):
        mask[: int(30 * share), 10:20] = True
    return masks


def test_silhouettes_are_kept_by_their_frame(store):
    frames = [person(0.5, 0.2, 0.9), person(0, 0, 0)]
    for masks in frames:
        store.append(masks)
    assert store.frames == range(5, 7)
    np.testing.assert_array_equal(store(5), frames[0])
    assert store.known(4) is None
    assert store.known(7) is None


def test_silhouettes_of_a_round_before_are_kept_and_their_images_are_not_read(tmp_path, rng):
    cameras, read = worlds.ring(2, size=(40, 30)), []
    pictures = {f: [rng.integers(0, 255, (30, 40, 3)).astype(np.uint8) for _ in cameras] for f in range(5, 11)}

    def at(frames):
        for frame in frames:
            read.append(frame)
            yield frame, pictures[frame]

    def find(log, earlier=None):
        store = MaskStore(log, 5, cameras)
        views = [stages.SilhouetteState(background_of(np.full((30, 40, 3), 128, np.float32))) for _ in cameras]
        shown = trial(take=SimpleNamespace(first=5, end=11, at=at))
        stages.find_silhouettes(shown, views, cameras, store, RecordingProgress(), name="Round", earlier=earlier)
        return store

    with FrameLog(tmp_path / "one.log") as first, FrameLog(tmp_path / "two.log") as second:
        before = find(first)
        assert read == [5, 6, 7, 8, 9, 10]
        for images in pictures.values():
            images[:] = [np.full((30, 40, 3), 128, np.uint8) for _ in cameras]
        read.clear()
        after = find(second, stages.EarlierSilhouettes(before, frozenset([5, 7, 8, 10])))
        assert read == [6, 9]
        assert after.frames == before.frames
        for frame in before.frames:
            assert np.any(before(frame))
            np.testing.assert_array_equal(after(frame), np.zeros((2, 30, 40)) if frame in read else before(frame))
            assert after.energy(frame) == (0 if frame in read else before.energy(frame))


def test_silhouettes_do_not_depend_on_the_number_of_cores(tmp_path, rng):
    cameras = worlds.ring(3, size=(40, 30))
    pictures = [[rng.integers(0, 255, (30, 40, 3)).astype(np.uint8) for _ in cameras] for _ in range(6)]
    take = SimpleNamespace(first=0, end=6, at=lambda frames: ((frame, pictures[frame]) for frame in frames))
    found = []
    for count in (1, 2, 5):
        views = [stages.SilhouetteState(background_of(np.full((30, 40, 3), 128, np.float32))) for _ in cameras]
        with FrameLog(tmp_path / f"{count}.log") as log, limited_cores(count):
            store = MaskStore(log, 0, cameras)
            stages.find_silhouettes(trial(take=take), views, cameras, store, RecordingProgress(), name="Silhouettes")
            found.append([store(frame) for frame in store.frames])
    assert np.any(found[0])
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0], found[2])


def test_somebody_is_there_where_two_cameras_see_him(store):
    for shown in ((0, 0, 0), (0.5, 0, 0), (0.5, 0, 0.3), (0.5, 0.5, 0.5), (0, 0, 0)):
        store.append(person(*shown))
    frames = stages.frames_with_somebody(store)
    assert frames == (7, 8)
    stages.require_somebody(trial(), frames)
    with pytest.raises(NotUsable, match="walk01 shows no person that at least two cameras see"):
        stages.require_somebody(trial(), ())


def test_one_camera_is_rejected_with_a_remedy():
    with pytest.raises(FileProblem, match=r"cameras.toml: has only the camera 'cam01'. Depth needs at least two"):
        require_two_cameras(trial(rig=SimpleNamespace(names=("cam01",))))
    require_two_cameras(trial(rig=SimpleNamespace(names=("cam01", "cam02"))))


def turned(axis, degrees, **coordinates):
    body = worlds.person()
    turn = rotations.about(np.array(axis, float), np.array(np.deg2rad(degrees)))
    return PosedBody(body, Pose(np.zeros(3), turn, worlds.pose(body, coordinates).angles))


@pytest.mark.parametrize(
    ("axis", "degrees", "how", "guess"),
    [
        ((1, 0, 0), 90, "lies", '"-y"'),
        ((1, 0, 0), -90, "lies", '"y"'),
        ((0, 1, 0), 90, "lies", '"x"'),
        ((0, 1, 0), 180, "hangs head down", '"-z"'),
    ],
)
def test_a_lying_or_hanging_person_is_an_error_that_names_the_likely_vertical_axis(axis, degrees, how, guess):
    posed = turned(axis, degrees)
    with pytest.raises(NotUsable, match=how) as caught:
        stages.require_upright(trial(), posed)
    # The guess is where the head is: with it given, the person stands.
    head = posed.segment_origin[posed.body.skeleton.segment("head")]
    letter = guess.strip('"-')
    assert np.argmax(np.abs(head)) == "xyz".index(letter)
    assert (head["xyz".index(letter)] < 0) == ("-" in guess)
    assert f"up = {guess}" in str(caught.value)
    stages.require_upright(trial(up_given=True), posed)


def test_a_single_limb_says_nothing_about_the_vertical_axis_but_the_upper_body_does():
    hanging = turned((0, 1, 0), 180)
    for limb in ("left_arm", "right_arm", "left_leg", "right_leg"):
        # It raises an error if the person hangs; no error is the expected result here.
        assert stages.require_upright(trial(settings=SimpleNamespace(preset=limb)), hanging) is None  # type: ignore[func-returns-value]
    with pytest.raises(NotUsable, match="hangs head down"):
        stages.require_upright(trial(settings=SimpleNamespace(preset="upper")), hanging)


@pytest.mark.parametrize("posture", [{}, {"lumbar_flexion": 40, "thoracic_flexion": 15}], ids=["standing", "bowing"])
def test_a_person_who_stands_or_bows_is_upright(posture):
    for yaw in (0, 120, 240):
        # It raises an error if the person lies; no error is the expected result here.
        assert stages.require_upright(trial(), turned((0, 0, 1), yaw, **posture)) is None  # type: ignore[func-returns-value]


def test_silhouettes_of_some_cameras_only_are_rejected(store):
    names = ("cam01", "cam02", "cam03")
    some = trial(masks={"cam01": None}, rig=SimpleNamespace(names=names), take=None, folder=Path("walk01"))
    with pytest.raises(FileProblem, match="none of cam02, cam03"):
        stages.known_silhouettes(some, store, RecordingProgress())


def test_frames_in_which_the_person_was_lost_are_reported():
    progress = RecordingProgress()
    stages.warn_of_lost(progress, range(3, 9), {3: 0, 4: 0, 8: 0}, count=12)
    assert progress.warnings == ["The person is visible but was lost in frames 5 to 7: these frames have no pose."]
    stages.warn_of_lost(progress, range(3, 9), range(12), count=12)
    assert len(progress.warnings) == 1


SIDE = {"left_shoulder_lift": 30, "left_elbow_flexion": 15}
"""From the left, the whole arm crosses the trunk [deg]."""


def painted(posed, camera, rng):
    """An image of the person: arms of another hue than the rest."""
    view = view_of(posed, camera)
    colours = np.array([[70, 80, 160], [110, 150, 200], [110, 150, 200], [70, 80, 160], [70, 80, 160]])
    image = np.full((camera.height, camera.width, 3), 90)
    x, y = view.corner
    part = image[y : y + view.face.shape[0], x : x + view.face.shape[1]]
    part[view.covered] = colours[posed.body.face_limb[view.face[view.covered]]]
    return np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("factor", [1.0, 0.5])
def test_edges_are_searched_for_where_the_body_predicts_them_and_kept_with_the_silhouettes(tmp_path, rng, factor):
    camera = worlds.looking_at(np.array([0.0, 0, 0.1]), np.array([2.9, -1.2, 0.4]), size=(480, 640), focal=900.0)
    true = PosedBody(worlds.person("fine"), worlds.pose(worlds.person("fine"), SIDE))
    expected_pose = worlds.pose(true.body, SIDE | {"left_shoulder_lift": 31})
    small = camera.scaled(factor)
    expected = stages.expectations(true.body, {7: expected_pose}, [camera], [small])
    assert expected(6) is None
    [of_camera] = expected(7)
    np.testing.assert_array_equal(of_camera.mask, view_of(PosedBody(true.body, expected_pose), camera).mask())
    mask, exposure = view_of(true, camera).mask(), SimpleNamespace(noise=np.full(3, 2.0))
    found = stages.look_inside(painted(true, camera, rng), SimpleNamespace(mask=mask, exposure=exposure), of_camera)
    rim = view_of(true, camera).interior_rim(true.body.faces, true.body.face_limb)
    arm = rim.pixels[true.body.face_limb[rim.face] == 1]
    own = found.pixels[found.limb == 1]
    assert len(own) > 0.3 * factor * len(arm)
    # Both thighs have one hue: where one hides the other nothing is seen.
    assert set(found.limb) <= {0, 1}
    # The rim's pixels lie half a pixel within the border, and next to each other; a smaller image shows less.
    distance = np.linalg.norm(own[:, None] - arm, axis=2).min(1)
    assert np.quantile(distance, 0.9) < 1.2 / factor
    with FrameLog(tmp_path / "masks.log") as log:
        store = MaskStore(log, 7, [camera])
        store.append([mask], [found])
        store.append([mask])
        [kept] = store.edges(7)
        assert store.edges(8) is None
    np.testing.assert_allclose(kept.pixels, found.pixels, atol=1e-4)
    np.testing.assert_allclose(kept.inward, found.inward, atol=1e-6)
    np.testing.assert_array_equal(kept.limb, found.limb)


def test_clutter_is_reported_by_camera_and_only_what_is_common_is_kept(tmp_path):
    body = worlds.person()
    cameras = worlds.ring(4)
    masks = worlds.silhouettes(PosedBody(body, worlds.pose(body)), cameras)
    cluttered = [mask.copy() for mask in masks]
    for c in (1, 2, 3):
        cluttered[c][:, :70] = True
    progress = RecordingProgress()
    with (
        FrameLog(tmp_path / "clean") as first,
        FrameLog(tmp_path / "cluttered") as second,
        FrameLog(tmp_path / "common") as third,
    ):
        clean, wrong, empty = (MaskStore(log, 0, cameras) for log in (first, second, third))
        clean.append(masks)
        wrong.append(cluttered)
        assert not stages.cluttered(clean, cameras, [0], progress)
        assert progress.warnings == []
        assert stages.cluttered(wrong, cameras, [0], progress)
        assert cameras[1].name in progress.warnings[0]
        assert cameras[0].name not in progress.warnings[0]
        common = stages.common_silhouettes(wrong, cameras, empty, progress)(0)
    for kept, mask, much in zip(common, masks, cluttered, strict=True):
        assert np.count_nonzero(kept & mask) > 0.97 * np.count_nonzero(mask)
        assert np.count_nonzero(kept & ~mask) <= 0.5 * max(np.count_nonzero(much & ~mask), 400)


def given(path, **settings):
    """The attributes that `open_bodies` uses."""
    trial_settings = SimpleNamespace(preset=settings.get("preset"), stature_m=settings.get("stature_m"))
    return SimpleNamespace(settings=trial_settings), CaptureSettings(body=path)


def test_a_body_of_an_earlier_take_has_a_twin_with_few_vertices(tmp_path, rng):
    person = person_body("fine", stature_m=1.7)
    person = person.with_numbers(rng.normal(size=len(person.space)) * 0.3)
    write_body(tmp_path / "body.npz", person, preset="full")
    bodies = open_bodies(*given(tmp_path / "body.npz"))
    assert len(bodies.coarse.vertices) < 0.5 * len(bodies.fine.vertices)
    np.testing.assert_array_equal(bodies.coarse.numbers, person.numbers)
    np.testing.assert_allclose(bodies.coarse.joint_centres, person.joint_centres, atol=1e-4)
    np.testing.assert_allclose(bodies.coarse.space.prior_mean, person.space.prior_mean)


def test_a_body_whose_numbers_mean_something_else_is_its_own_twin():
    coarse = person_body("coarse")
    assert coarse_twin(worlds.scan("fine"), coarse) is None
    assert coarse_twin(person_body("fine", preset="upper"), coarse) is None
    moved = person_body("fine")
    moved = replace(moved, space=replace(moved.space, joint_mean=moved.space.joint_mean + 0.01))
    assert coarse_twin(moved, coarse) is None


@pytest.mark.slow
@pytest.mark.parametrize("word", ["metaballs", "simple-metaballs"])
def test_a_generic_body_of_metaballs_is_opened_by_its_name(word):
    bodies = open_bodies(*given(word, preset="right_leg"))
    assert bodies.fine.space.names == bodies.coarse.space.names
    assert len(bodies.coarse.vertices) < 0.5 * len(bodies.fine.vertices)
    assert len(bodies.fine.skeleton) == len(bodies.coarse.skeleton) == 15
    np.testing.assert_array_equal(bodies.fine.joint_centres, bodies.coarse.joint_centres)


@pytest.mark.slow
def test_a_body_of_metaballs_from_an_earlier_take_has_a_twin_with_few_vertices(tmp_path, rng):
    person = metaball_person("simple")
    person = reshaped(person, 0.5 * np.linalg.cholesky(person.space.prior_covariance) @ rng.normal(size=26))
    write_body(tmp_path / "body.npz", person, preset="full")
    bodies = open_bodies(*given(tmp_path / "body.npz"))
    assert len(bodies.coarse.vertices) < 0.5 * len(bodies.fine.vertices)
    np.testing.assert_array_equal(bodies.coarse.joint_centres, person.joint_centres)
    off = person.metaballs.balls(person.numbers).at_rest().distance(bodies.coarse.vertices)
    assert np.quantile(np.abs(off), 0.99) < 1e-3


@pytest.mark.slow
def test_of_a_whole_body_the_preset_leaves_what_it_follows(tmp_path):
    write_body(tmp_path / "body.npz", metaball_person("simple"), preset="full")
    bodies = open_bodies(*given(tmp_path / "body.npz", preset="right_arm"))
    assert len(bodies.fine.skeleton) == len(bodies.coarse.skeleton) == 13
    assert not bodies.fine.followed_joints.all()


def test_bodies_with_fixed_sizes_have_no_free_shape_parameters():
    bodies = Bodies(person_body("coarse", stature_m=1.8), metaball_person("simple", "coarse", stature_m=1.8))
    held = bodies.held()
    for one, was in ((held.fine, bodies.fine), (held.coarse, bodies.coarse)):
        assert len(one.space) == 0
        np.testing.assert_allclose(one.vertices, was.vertices, atol=1e-12)
        np.testing.assert_allclose(one.joint_centres, was.joint_centres, atol=1e-12)


@pytest.mark.slow
def test_the_sizes_from_an_earlier_take_are_the_prior(tmp_path, rng):
    for person in (person_body("coarse"), metaball_person("simple", "coarse")):
        numbers = 0.5 * np.sqrt(np.diag(person.space.prior_covariance))
        known = replace(reshaped(person, numbers), numbers_covariance=0.01 * person.space.prior_covariance)
        write_body(tmp_path / "body.npz", known, preset="full")
        for body in vars(open_bodies(*given(tmp_path / "body.npz"))).values():
            np.testing.assert_array_equal(body.space.prior_mean, numbers)
            np.testing.assert_array_equal(body.space.prior_covariance, known.numbers_covariance)
        write_body(tmp_path / "body.npz", replace(known, numbers_covariance=None), preset="full")
        unknown = open_bodies(*given(tmp_path / "body.npz")).fine
        np.testing.assert_array_equal(unknown.space.prior_covariance, person.space.prior_covariance)

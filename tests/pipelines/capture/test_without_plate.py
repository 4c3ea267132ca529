"""The parts of a capture without images of the empty room: the prior of a silhouette, and what is hidden."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.body.articulation.skeleton import COLOUR_PARTS
from marey.images.features.texture import CELLS, texture_cells
from marey.images.silhouettes.background import background_of
from marey.images.silhouettes.contours import trace_contour
from marey.images.silhouettes.densities import COLOUR_SHIFT
from marey.images.silhouettes.part_colours import PartColourCounts
from marey.images.silhouettes.silhouettes import segment
from marey.images.silhouettes.uncovered import background_where_uncovered
from marey.io.stages import FrameLog
from marey.pipelines.capture import without_plate
from marey.pipelines.capture.drawn import Drawn
from marey.pipelines.people.other_regions import OtherRegions
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.silhouettes import stages
from marey.pipelines.silhouettes.drawn_body import part_map
from marey.pipelines.silhouettes.mask_store import MaskStore


@pytest.fixture(scope="module")
def posed():
    body = worlds.person()
    return PosedBody(body, worlds.pose(body))


def painted(posed, camera, rng, box=None):
    """An image of the person in parts of their own colours, before a wall; a box may be in front."""
    colours = np.random.default_rng(3).integers(30, 220, (len(COLOUR_PARTS), 3))
    parts = part_map(posed, camera)
    tiles = np.random.default_rng(4).integers(90, 120, (camera.height // 8, camera.width // 8, 3))
    wall = tiles.repeat(8, 0).repeat(8, 1)
    image = np.where((parts >= 0)[..., None], colours[parts], wall).astype(float)
    if box is not None:
        image[box] = [245, 10, 245]
    return np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)


def learned(posed, camera, rng):
    """The background and the part colours of a camera, as learned from a few images without the box."""
    shifted = [PosedBody(posed.body, worlds.pose(posed.body, at=(x, 0, 0))) for x in np.linspace(-0.5, 0.5, 7)]
    pictures = [painted(each, camera, rng) for each in shifted]
    background = background_where_uncovered(pictures, [part_map(each, camera) >= 0 for each in shifted])
    counts = PartColourCounts(1, len(COLOUR_PARTS), 3, CELLS)
    for each, picture in zip(shifted, pictures, strict=True):
        counts.add(0, picture, part_map(each, camera), 1e-5, texture_cells(picture))
    return stages.SilhouetteState(background, colours=counts.learned()[0])


def expected(posed, camera, sd=3.0, *, elsewhere=False):
    return without_plate._expected(posed, camera, camera, np.full(len(COLOUR_PARTS), sd), elsewhere=elsewhere)


def test_the_silhouette_is_found_about_a_body_that_is_off_and_without_what_hides_it(posed, rng):
    camera = worlds.ring(1)[0]
    view = learned(posed, camera, rng)
    true = part_map(posed, camera) >= 0
    off = PosedBody(posed.body, worlds.pose(posed.body, at=(0.015, -0.015, 0.01)))
    free = stages.update_silhouette(view, painted(posed, camera, rng), expected(off, camera))

    def overlap(mask, other):
        return np.count_nonzero(mask & other) / np.count_nonzero(mask | other)

    drawn = overlap(part_map(off, camera) >= 0, true)
    assert overlap(free.mask, true) > max(drawn, 0.95)
    assert free.hidden is not None
    assert np.count_nonzero(free.hidden & true) < 0.03 * np.count_nonzero(true)
    box = np.zeros(true.shape, bool)
    box[110:150, :] = True
    behind = stages.update_silhouette(view, painted(posed, camera, rng, box), expected(posed, camera))
    # Beside the hidden part the silhouette has a strip of the box; it is left out, but for its ends.
    assert overlap(behind.mask, true & ~box) > 0.9
    assert behind.hidden is not None
    assert overlap(behind.hidden & true, true & box) > 0.95
    assert not (behind.mask & behind.hidden).any()


def test_the_colours_of_parts_and_places_find_a_person_before_an_unknown_background(posed, rng):
    """Where the background is not known, the densities of parts and places are all that distinguishes the person."""
    camera = worlds.ring(1)[0]
    view = learned(posed, camera, rng)
    view = replace(view, background=background_of(view.background.mean, confidence=np.full(view.background.size, 0.1)))
    true, image = part_map(posed, camera) >= 0, painted(posed, camera, rng)
    off = PosedBody(posed.body, worlds.pose(posed.body, at=(0.04, -0.04, 0.02)))

    def overlap(state):
        mask = stages.update_silhouette(state, image, expected(off, camera, 8.0)).mask
        return np.count_nonzero(mask & true) / np.count_nonzero(mask | true)

    drawn = part_map(off, camera) >= 0
    assert overlap(view) > np.count_nonzero(drawn & true) / np.count_nonzero(drawn | true) + 0.05


def test_borders_between_parts_are_edges_inside_the_silhouette(posed, rng):
    camera = worlds.ring(1)[0]
    view, image = learned(posed, camera, rng), painted(posed, camera, rng)
    prediction = expected(posed, camera)
    found = stages.update_silhouette(view, image, prediction)
    silhouette = segment(image, view.background, start=prediction.mask)
    silhouette = replace(silhouette, mask=found.mask)
    without = stages.look_inside(image, silhouette, prediction)
    joined = stages.look_inside(image, silhouette, prediction, view.colours)
    assert len(joined) >= len(without)
    assert len(joined) > 0


def test_another_person_in_front_is_cut_out_and_gives_no_evidence(posed, rng):
    camera = worlds.ring(1)[0]
    view = learned(posed, camera, rng)
    true, box = part_map(posed, camera) >= 0, np.zeros((camera.height, camera.width), bool)
    box[60:200, 105:125] = True
    image = painted(posed, camera, rng, box)
    others = OtherRegions(box, np.zeros_like(box), 1.0)
    found = stages.update_silhouette(view, image, replace(expected(posed, camera), others=others))
    assert not (found.mask & box).any()
    assert np.count_nonzero(found.mask & true & ~box) > 0.9 * np.count_nonzero(true & ~box)
    assert found.hidden is not None
    assert found.hidden[box].all()
    behind = OtherRegions(np.zeros_like(box), box, 1.0)
    plain = painted(posed, camera, rng)
    seen = stages.update_silhouette(view, plain, replace(expected(posed, camera), others=behind))
    assert np.count_nonzero(seen.mask & true & box) > 0.8 * np.count_nonzero(true & box)


def test_of_a_view_in_which_only_others_are_detected_no_outline_is_used(posed, rng):
    camera = worlds.ring(1)[0]
    view = learned(posed, camera, rng)
    image = painted(posed, camera, rng)
    found = stages.update_silhouette(view, image, expected(posed, camera, elsewhere=True))
    plain = stages.update_silhouette(view, image, expected(posed, camera))
    np.testing.assert_array_equal(found.mask, plain.mask)
    assert found.hidden is not None
    assert found.hidden.all()
    assert len(trace_contour(found.mask, hidden=found.hidden).pixels) == 0
    assert len(trace_contour(plain.mask, hidden=plain.hidden).pixels) > 0


def test_without_a_predicted_body_nothing_is_found(posed, rng):
    camera = worlds.ring(1)[0]
    view = learned(posed, camera, rng)
    away = PosedBody(posed.body, worlds.pose(posed.body, at=(50.0, 50.0, 0)))
    for prediction in (None, expected(away, camera)):
        found = stages.update_silhouette(view, painted(posed, camera, rng), prediction)
        assert not found.mask.any()
        assert found.hidden is not None
        assert not found.hidden.any()
        assert found.pictures == 1


def test_the_learned_background_stays_as_it_is(posed, rng):
    camera = worlds.ring(1)[0]
    view = learned(posed, camera, rng)
    after = view
    for _ in range(3):
        after = stages.update_silhouette(after, painted(posed, camera, rng), expected(posed, camera))
    np.testing.assert_array_equal(after.background.mean, view.background.mean)
    assert after.colours is view.colours


def test_scores_leave_out_what_is_hidden(posed, tmp_path):
    cameras = worlds.ring(2)
    drawn = Drawn(posed.body, {0: posed.pose, 1: posed.pose, 2: posed.pose}, {})
    bodies = worlds.silhouettes(posed, cameras)
    upper = [np.arange(mask.shape[0])[:, None] < 120 for mask in bodies]
    shown = [mask & above for mask, above in zip(bodies, upper, strict=True)]
    lower = [np.broadcast_to(~above, mask.shape) for mask, above in zip(bodies, upper, strict=True)]
    drawn = Drawn(drawn.body, dict(drawn.poses) | {3: posed.pose}, {})
    with FrameLog(tmp_path / "log") as log:
        store = MaskStore(log, 0, cameras)
        store.append(bodies)
        store.append(shown)
        store.append(shown, [], lower)
        store.append([bodies[0], shown[1]], [], [np.zeros_like(bodies[0]), np.ones_like(bodies[1])])
        scores = without_plate._scores(drawn, cameras, store)
    share = np.mean([s.sum() / b.sum() for s, b in zip(shown, bodies, strict=True)])
    assert scores == pytest.approx({0: 1.0, 1: share, 2: 1.0, 3: 1.0})


def test_frames_are_settled_in_which_the_body_hardly_moved_since_its_silhouettes_were_found(posed):
    cameras, deviations = worlds.ring(2), np.full((2, len(COLOUR_PARTS)), 4.0)
    degrees = np.eye(len(posed.body.skeleton))

    def drawn(**poses):
        found = {int(name[1:]): pose for name, pose in poses.items()}
        return Drawn(posed.body, found, dict.fromkeys(found, deviations))

    hand = posed.body.skeleton.coordinate_names.index("left_elbow_flexion")
    far, near, limb = (posed.pose.step(change) for change in (0.2 * degrees[0], 0.001 * degrees[0], degrees[hand]))
    before = drawn(f1=posed.pose, f2=posed.pose, f3=posed.pose, f4=posed.pose)
    after = drawn(f1=near, f2=far, f3=limb, f5=posed.pose)
    # Frame 4 has lost its pose, frame 5 has a new one, frame 6 has none as before.
    assert without_plate._settled(after, dict.fromkeys(range(1, 7), before), cameras) == {1, 6}


def test_images_of_the_first_rounds_are_just_large_enough(posed):
    cameras = worlds.ring(2)
    drawn = Drawn(posed.body, {0: posed.pose}, {})
    run = SimpleNamespace(trial=SimpleNamespace(rig=cameras, background={}))
    tallest = max(np.count_nonzero(mask.any(1)) for mask in worlds.silhouettes(posed, cameras))
    large = [camera.scaled(9 * without_plate.ROUGH_PX / tallest) for camera in cameras]
    run.trial.rig = large
    share = without_plate._rough_cameras(run, drawn)[0].width / large[0].width
    # Sizes are halved as long as the person stays tall enough; sizes are whole pixels.
    assert share == pytest.approx(0.125, rel=0.01)
    run.trial.rig = [camera.scaled(0.9 * without_plate.ROUGH_PX / tallest) for camera in cameras]
    assert without_plate._rough_cameras(run, drawn)[0].size == run.trial.rig[0].size


def test_plates_keep_the_images_of_the_first_rounds_full(posed):
    cameras = worlds.ring(2)
    trial = SimpleNamespace(rig=cameras, background={camera.name: [] for camera in cameras})
    found = without_plate._rough_cameras(SimpleNamespace(trial=trial), Drawn(posed.body, {0: posed.pose}, {}))
    assert [camera.size for camera in found] == [camera.size for camera in cameras]


def test_the_energy_of_reduced_images_is_that_of_full_ones(posed, tmp_path):
    cameras = worlds.ring(2)
    drawn, run = Drawn(posed.body, {0: posed.pose}, {}), SimpleNamespace(progress=RecordingProgress())
    with FrameLog(tmp_path / "log") as log:
        masks = MaskStore(log, 0, cameras)
        masks.append(worlds.silhouettes(posed, cameras), energy=[-3.0, -5.0])
        found = [
            without_plate._round(run, drawn, without_plate.RoundStore(cameras, masks, share), {0: 1.0}, None).energy_nat
            for share in (1.0, 0.5)
        ]
    assert found == [-8.0, -32.0]


def test_the_background_is_learned_only_of_cameras_without_an_image_of_the_empty_room(posed, rng, monkeypatch):
    cameras = worlds.ring(2)
    poses = {frame: worlds.pose(posed.body, at=(0.2 * frame - 0.4, 0, 0)) for frame in range(5)}
    shown = {f: [painted(PosedBody(posed.body, pose), camera, rng) for camera in cameras] for f, pose in poses.items()}
    deviations = dict.fromkeys(poses, np.full((2, len(COLOUR_PARTS)), 2.0))
    given = background_of(np.zeros((cameras[1].height, cameras[1].width, 3)))
    monkeypatch.setattr(without_plate, "empty_rooms", lambda *_: {1: given})
    take = SimpleNamespace(at=lambda frames: [(f, shown[f]) for f in frames], first=0, end=len(shown))
    run = SimpleNamespace(trial=SimpleNamespace(take=take))
    (learned, second), colours, _ = without_plate._learned(run, Drawn(posed.body, poses, deviations), cameras, 1.0)
    assert second is given
    wall = part_map(PosedBody(posed.body, poses[0]), cameras[0]) < 0
    close = np.abs(learned.mean - shown[0][0]).max(axis=2) < 10
    assert close[wall & (learned.confidence > 0.9)].mean() > 0.95
    assert len(colours) == 2


def standing_behind_a_bar(posed, rng):
    """A run with a person who steps aside, with a bar of one colour in front of its thighs in the first camera."""
    cameras = worlds.ring(3)
    poses = {frame: worlds.pose(posed.body, at=(0.06 * frame - 0.3, 0.04 * frame, 0)) for frame in range(12)}
    bar = np.zeros((cameras[0].height, cameras[0].width), bool)
    bar[140:165] = True
    shown, masks = {}, {}
    for frame, pose in poses.items():
        own = PosedBody(posed.body, pose)
        shown[frame] = [painted(own, camera, rng, bar if c == 0 else None) for c, camera in enumerate(cameras)]
        masks[frame] = [
            mask & ~bar if c == 0 else mask for c, mask in enumerate(worlds.silhouettes(own, cameras))
        ]  # fmt: skip
    take = SimpleNamespace(at=lambda frames: [(frame, shown[frame]) for frame in frames], first=0, end=len(shown))
    run = SimpleNamespace(
        trial=SimpleNamespace(take=take, background={}), times=None, scope="", progress=RecordingProgress(),
        cache=SimpleNamespace(arrays=lambda name, compute, depends: compute()),
    )  # fmt: skip
    drawn = Drawn(posed.body, poses, dict.fromkeys(poses, np.full((3, len(COLOUR_PARTS)), 2.0)))
    return run, drawn, cameras, masks, bar


@pytest.mark.slow
def test_things_in_front_are_found_from_the_silhouettes_of_a_round(posed, rng, tmp_path):
    run, drawn, cameras, masks, bar = standing_behind_a_bar(posed, rng)
    with FrameLog(tmp_path / "log") as log:
        store = MaskStore(log, 0, cameras)
        for every in masks.values():
            store.append(every)
        rounds = without_plate.RoundStore(cameras, store)
        found = without_plate._occluders(run, drawn, rounds, 2)
        # In an image that shows only other people, nothing is evidence.
        elsewhere = np.zeros((len(masks), 3), bool)
        elsewhere[:, 0] = True
        none = without_plate._occluders(run, replace(drawn, elsewhere=elsewhere), rounds, 2)
    assert [thing.share > 0 for thing in found.things] == [True, False, False]
    assert not none.any
    middle = PosedBody(drawn.body, drawn.poses[6])
    behind = found.behind([middle] * 3, cameras)
    hidden = worlds.silhouettes(middle, cameras)[0] & bar
    assert np.count_nonzero(behind[0] & hidden) > 0.9 * np.count_nonzero(hidden)


@pytest.mark.slow
def test_colours_of_parts_are_not_learned_from_what_is_in_front_of_them(posed, rng, tmp_path, monkeypatch):
    run, drawn, cameras, masks, _ = standing_behind_a_bar(posed, rng)
    monkeypatch.setattr(without_plate, "empty_rooms", lambda *_: {})
    with FrameLog(tmp_path / "log") as log:
        store = MaskStore(log, 0, cameras)
        for every in masks.values():
            store.append(every)
        occluders = without_plate._occluders(run, drawn, without_plate.RoundStore(cameras, store), 2)
    cell = tuple(channel >> COLOUR_SHIFT for channel in (245, 10, 245))

    def density_of_the_bar(known):
        colours = without_plate._learned(run, replace(drawn, occluders=known), cameras, 1.0)[1]
        return float(colours[0].density[COLOUR_PARTS.index("thigh")][cell])

    assert density_of_the_bar(occluders) < 0.1 * density_of_the_bar(None)

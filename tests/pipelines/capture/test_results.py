"""What a capture of videos leaves: every file that is promised, every key, and numbers that agree with each other."""

import json
from pathlib import Path

import numpy as np
import pytest
from tests.pipelines.capture.reach import EMPTY, HALF, copy_half_trial, give_silhouettes, give_start, true_masks, truth
from tests.point_files import read_points

from marey.fit.recipes import person
from marey.fit.search.search import StartSettings
from marey.fit.search.start import find_both_ways
from marey.io.trial.masks import open_masks
from marey.pipelines.capture.tasks import capture
from marey.pipelines.progress import RecordingProgress

COUNT, FIRST, END = 130, 70, 74
LIMBS = ("hip", "knee", "ankle", "toe", "shoulder", "elbow", "wrist")
JOINTS = [f"{side}_{joint}" for side in ("left", "right") for joint in LIMBS]

QUICK = StartSettings(yaws=8, kept=2, finalists=1, arm_directions=16, leg_directions=12)
"""Extent of a search that suffices for a body of known shape."""


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A few frames of the example, from its videos and its images of the empty room."""
    folder = tmp_path_factory.mktemp("results")
    trial = copy_half_trial(folder / "trial")
    clicks = give_start(trial, FIRST + 3)
    # So few and small images may leave a second posture of an arm open, of which a warning would be issued.
    capture(
        trial, out=folder / "out", frames=range(FIRST, END), start=clicks, overlay=False, progress=RecordingProgress()
    )  # fmt: skip
    return folder / "out"


def arrays(path: Path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as stored:
        return {name: stored[name] for name in stored.files}


@pytest.mark.slow
def test_every_promised_file_is_there_and_nothing_of_the_work(results):
    files = {path.relative_to(results).as_posix() for path in results.rglob("*") if path.is_file()}
    cameras = [f"cam{c:02}" for c in (1, 2, 3, 4)]
    promised = {
        "joint_centres.trc", "angles.mot", "body.osim", "orientations.sto", "motion.c3d", "motion.bvh", "body.glb",
        "motion.npz", "motion.nc", "angles.csv", "body.npz", "skin.npz", "report.html", "run.json",
    }  # fmt: skip
    promised |= {f"{kind}/{camera}.npz" for kind in ("masks", "surface_masks") for camera in cameras}
    assert files == promised


def test_the_motion_has_every_key_in_its_shape(results):
    motion = arrays(results / "motion.npz")
    coordinates, segments, angles = (len(motion[f"{kind}_names"]) for kind in ("coordinate", "segment", "angle"))
    joints = [str(name) for name in motion["joint_names"]]
    assert set(joints) == {"neck", "head", *JOINTS}
    shapes = {
        "time": (COUNT,), "rate": (), "joint_names": (16,), "joint_centres": (COUNT, 16, 3),
        "joint_centres_sd": (COUNT, 16, 3), "segment_names": (21,), "segment_rotation": (COUNT, segments, 3, 3),
        "segment_origin": (COUNT, segments, 3), "coordinate_names": (coordinates,),
        "coordinates": (COUNT, coordinates), "coordinates_sd": (COUNT, coordinates),
        "determined": (COUNT, coordinates), "angle_names": (angles,), "angles_deg": (COUNT, angles),
        "angles_deg_sd": (COUNT, angles), "state": (COUNT,), "camera_names": (4,), "agreement": (COUNT, 4),
    }  # fmt: skip
    assert {name: motion[name].shape for name in shapes} == shapes
    assert coordinates >= 40
    measured = motion["state"] == 1
    np.testing.assert_array_equal(np.flatnonzero(measured), np.arange(FIRST, END))
    for name in ("joint_centres", "joint_centres_sd", "coordinates", "angles_deg", "segment_rotation", "agreement"):
        assert np.isfinite(motion[name][measured]).all(), name
        assert np.isnan(motion[name][~measured]).all(), name
    assert (motion["joint_centres_sd"][measured] > 0).all()
    assert not motion["determined"][~measured].any()


def test_joints_lie_where_the_truth_has_them(results):
    motion = arrays(results / "motion.npz")
    names, joints = truth()
    own = [list(motion["joint_names"]).index(name) for name in JOINTS]
    wanted = joints[FIRST - EMPTY : END - EMPTY, [names.index(name) for name in JOINTS]]
    errors = np.linalg.norm(motion["joint_centres"][FIRST:END, own] - wanted, axis=2)
    # A body of unknown shape from six frames.
    assert errors.mean() < 0.03
    assert errors.max() < 0.12


@pytest.mark.slow
def test_silhouettes_are_the_true_ones_and_the_surface_agrees_with_them(results):
    true = true_masks(HALF)
    cameras, _, height, width = true.shape
    agreement = arrays(results / "motion.npz")["agreement"]
    for c in range(cameras):
        kinds = {
            kind: open_masks(results / kind / f"cam{c + 1:02}.npz", shape=(COUNT, height, width))
            for kind in ("masks", "surface_masks")
        }
        seen, drawn = (list(kinds[kind].masks(range(FIRST, END))) for kind in ("masks", "surface_masks"))
        for k in range(END - FIRST):
            wanted = true[c, FIRST - EMPTY + k]
            assert np.count_nonzero(seen[k] & wanted) / np.count_nonzero(seen[k] | wanted) > 0.88
            union = np.count_nonzero(seen[k] | drawn[k])
            assert agreement[FIRST + k, c] == pytest.approx(np.count_nonzero(seen[k] & drawn[k]) / union)
        assert not any(mask.any() for mask in kinds["masks"].masks(range(FIRST)))
    assert np.nanmin(agreement) > 0.8


def test_skin_and_body_have_every_key(results):
    skin, body = arrays(results / "skin.npz"), arrays(results / "body.npz")
    count = skin["vertices"].shape[1]
    assert skin["vertices"].shape == (COUNT, count, 3)
    assert skin["seen"].shape == (COUNT, count)
    assert skin["faces"].shape[1] == 3
    assert np.isnan(skin["vertices"][:FIRST]).all()
    assert not skin["seen"][:FIRST].any()
    assert 0.02 < skin["seen"][FIRST:END].mean() < 0.95
    assert {
        "preset", "joint_names", "joint_centres", "segment_names", "segment_length", "segment_length_sd",
        "metaball_segment", "metaball_centre", "metaball_radii", "metaball_radii_sd", "metaball_weight", "vertices",
        "faces", "vertex_segments", "vertex_weights",
    } <= set(body)  # fmt: skip
    assert str(body["preset"]) == "full"
    assert body["vertices"].shape == (count, 3)
    assert body["vertex_segments"].shape == body["vertex_weights"].shape == (count, 4)
    np.testing.assert_allclose(body["vertex_weights"].sum(1), 1.0, atol=1e-6)


def test_files_of_points_agree_with_the_motion(results):
    wanted = read_points(results / "motion.npz")
    for name, tolerance in (("joint_centres.trc", 1e-6), ("motion.c3d", 1e-5)):
        found = read_points(results / name)
        assert found.names == wanted.names
        np.testing.assert_allclose(found.points, wanted.points, atol=tolerance)


def test_the_record_contains_command_settings_and_inputs(results):
    record = json.loads((results / "run.json").read_text())
    assert record["settings"]["frames"] == [FIRST, END]
    assert {"cam01.mp4", "cameras.toml", "background/cam01.png"} <= set(record["inputs"])
    assert record["timings_s"]
    tracked = record["surface_tracks"]
    with np.load(results / "motion.npz") as motion:
        assert set(tracked) <= set(motion["segment_names"])
    assert all(each["count"] >= 1 and each["mean_frames"] >= 1 for each in tracked.values())
    assert set(record["files"]) == {p.relative_to(results).as_posix() for p in results.rglob("*") if p.is_file()}


@pytest.mark.slow
def test_the_body_found_is_followed_again_from_a_start_without_clicks(results, tmp_path, monkeypatch):
    monkeypatch.setattr(person, "find_both_ways", lambda *given: find_both_ways(*given[:4], QUICK))
    trial = tmp_path / "trial"
    trial.mkdir()
    for path in (results.parent / "trial").iterdir():
        if path.name != "clicks.json":
            (trial / path.name).symlink_to(path.resolve())
    give_silhouettes(trial)
    capture(
        trial, out=tmp_path / "out", frames=(FIRST, FIRST + 1), body=results / "body.npz", overlay=False,
        progress=RecordingProgress(),
    )  # fmt: skip
    first, again = arrays(results / "motion.npz"), arrays(tmp_path / "out" / "motion.npz")
    np.testing.assert_array_equal(np.flatnonzero(again["state"] == 1), [FIRST])
    apart = np.linalg.norm(again["joint_centres"][FIRST] - first["joint_centres"][FIRST], axis=1)
    # Two ways to the same pose: within the standard deviations of both, about two centimetres.
    assert np.mean(apart) < 0.02
    assert np.nanmin(again["agreement"]) > 0.8
    bodies = [arrays(folder / "body.npz") for folder in (results, tmp_path / "out")]
    np.testing.assert_allclose(bodies[1]["segment_length"], bodies[0]["segment_length"], rtol=0.05)

"""Moving a knee from Python: labels, settings, and what is not written."""

from dataclasses import replace

import numpy as np
import pytest
from tests.made_animations import GAP_MM, made_activity

from marey.errors import FileProblem, SettingProblem
from marey.io.npz import read_arrays, write_arrays
from marey.pipelines.knee.animate import AnimateSettings, animate_knee
from marey.pipelines.knee.animated_knee import NO_POSE, WITHIN_SD, AnimatedKnee, load_animated_knee
from marey.pipelines.labelled import UnknownName
from marey.pipelines.progress import RecordingProgress


def test_gaps_and_angles_are_found_by_name(tmp_path):
    made = made_activity(tmp_path, fine=2)
    before = sorted(path.name for path in made.motion.iterdir())
    progress = RecordingProgress()
    moving = animate_knee(made.knee, made.motion, reference=made.standing, views=("plateau",), progress=progress)
    assert moving.moved == ("femur", "tibia")
    gap = moving.gaps["tibiofemoral medial"]
    # A coarse mesh has facets up to some tenths of a millimetre within its ball.
    np.testing.assert_allclose(np.asarray(gap), GAP_MM, atol=0.5)
    assert gap.unit == "mm"
    np.testing.assert_allclose(moving.angles["right knee flexion"].values, made.flexion_deg, atol=0.5)
    assert "tibiofemoral" in repr(moving)
    assert sorted(path.name for path in made.motion.iterdir()) == before
    pytest.importorskip("xarray")
    assert moving.to_xarray()["gap_tibiofemoral_medial"].attrs["units"] == "mm"


@pytest.fixture(scope="module")
def moving(tmp_path_factory: pytest.TempPathFactory) -> AnimatedKnee:
    made = made_activity(tmp_path_factory.mktemp("moving"), fine=2, lost=(3,))
    return animate_knee(
        made.knee, made.motion, reference=made.standing, compare="rigid", views=("plateau",),
        progress=RecordingProgress(),
    )  # fmt: skip


def test_a_saved_result_is_read_back_the_same(moving, tmp_path):
    loaded = load_animated_knee(moving.save(tmp_path / "knee"))
    assert (loaded.moved, loaded.side, loaded.methods) == (moving.moved, "right", ("exact", "rigid"))
    assert loaded.warnings == moving.warnings
    assert repr(loaded) == repr(moving)
    for name in loaded.methods:
        _assert_same(loaded.method(name), moving.method(name))
    copied = load_animated_knee(loaded.save(tmp_path / "copy"))
    assert {path.name for path in (tmp_path / "copy").iterdir()} == {path.name for path in loaded.folder.iterdir()}
    _assert_same(copied, moving)


def _assert_same(loaded: AnimatedKnee, moving: AnimatedKnee) -> None:
    for kind in ("gaps", "near_areas", "centres", "angles", "translations"):
        read, written = getattr(loaded, kind), getattr(moving, kind)
        assert read.names == written.names
        assert len(read) > 0
        for name in read:
            assert read[name].flags == written[name].flags
            assert read[name].unit == written[name].unit
            np.testing.assert_allclose(read[name].values, written[name].values, rtol=1e-12)
            if written[name].sd is not None:
                np.testing.assert_allclose(read[name].sd, written[name].sd, rtol=1e-12)
    for bone in moving.moved:
        np.testing.assert_array_equal(loaded.pose(bone), moving.pose(bone))
    for read, written in zip(loaded.found.joints, moving.found.joints, strict=True):
        assert (read.base.name, read.moving.name) == (written.base.name, written.moving.name)
        np.testing.assert_array_equal(read.base.sources, written.base.sources)
        np.testing.assert_allclose(read.base_distance_mm, written.base_distance_mm, atol=6e-4)
        np.testing.assert_allclose(read.moving_distance_mm, written.moving_distance_mm, atol=6e-4)


def test_values_without_a_pose_have_a_flag(moving):
    gap = moving.gaps["tibiofemoral medial"]
    assert gap.flags[3] == NO_POSE
    assert [bool(known) for known in moving.answered("femur")] == [True, True, True, False, True, True]
    flexion = moving.angles["right knee flexion"]
    assert flexion.measured.tolist() == moving.answered("femur").tolist()
    assert flexion.flags[3] == NO_POSE


def test_a_gap_within_its_standard_deviation_has_a_flag(moving):
    joint = moving.found.joints[0]
    unsure = replace(joint, gap_sd_mm=np.abs(joint.gap_mm) + 1)
    flags = replace(moving, found=replace(moving.found, joints=(unsure,))).gaps["tibiofemoral medial"].flags
    assert set(np.delete(flags, 3)) == {WITHIN_SD}
    assert flags[3] == NO_POSE


def test_a_method_that_was_not_run_is_named(moving):
    with pytest.raises(SettingProblem, match=r"'kriging' was not run\. Methods that were run: exact, rigid"):
        moving.method("kriging")
    with pytest.raises(UnknownName, match="no moved bone 'patella'"):
        moving.pose("patella")


def test_a_method_is_not_compared_with_itself(tmp_path):
    made = made_activity(tmp_path, fine=2)
    with pytest.raises(SettingProblem, match=r"compare \(--compare\) is 'exact', the method that is shown already"):
        animate_knee(made.knee, made.motion, compare="exact")


def test_a_folder_without_results_is_named(tmp_path):
    with pytest.raises(FileProblem, match=r"has no knee_motion\.npz"):
        load_animated_knee(tmp_path)


def test_a_file_with_another_number_of_frames_is_inconsistent(moving, tmp_path):
    arrays = read_arrays(moving.save(tmp_path) / "knee_motion.npz")
    write_arrays(tmp_path / "knee_motion.npz", arrays | {"angles_deg": arrays["angles_deg"][:2]})
    with pytest.raises(FileProblem, match="angles_deg: 2 frames, and time has 6"):
        load_animated_knee(tmp_path)
    del arrays["tibiofemoral_gap_sd_mm"]
    write_arrays(tmp_path / "knee_motion.npz", arrays)
    with pytest.raises(FileProblem, match="lacks gap_sd_mm"):
        load_animated_knee(tmp_path)


@pytest.mark.parametrize(
    "wrong", [{"side": "middle"}, {"frame": "femur"}, {"views": ("above",)}, {"limit_mm": 0.0}, {"noise_mm": -1.0}]
)
def test_impossible_settings_are_errors(wrong):
    with pytest.raises(SettingProblem, match="should be"):
        AnimateSettings(**wrong)

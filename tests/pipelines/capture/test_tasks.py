"""A capture by one call: its result, what it leaves on the disk, and observations of a kind from outside."""

import gc
import warnings
from pathlib import Path

import numpy as np
import pytest
from tests.pipelines.capture import reach

import marey

FRAMES = range(42, 45)
HEIGHT_SD_M = 0.002
"""Standard deviation of the observed height [m]."""


class JointHeight(marey.Observation):
    """The height of a joint above the floor was measured, for example by a laser."""

    def __init__(self, segment: int, height_m: float):
        self.segment, self.height_m = segment, height_m

    @property
    def sigma(self) -> float:
        return HEIGHT_SD_M

    def linearize(self, posed, *, shape: bool = False) -> marey.Linearization:
        residual = posed.segment_origin[self.segment][2:] - self.height_m
        jacobian = posed.pose_jacobian(*posed.joint_parts(np.array([self.segment])))[:, 2]
        if shape:
            jacobian = np.hstack([jacobian, posed.origin_shape_jacobian()[self.segment, 2:]])
        return marey.Linearization(residual, jacobian)


@pytest.fixture(scope="module")
def trial(tmp_path_factory) -> Path:
    folder = reach.copy_half_trial(tmp_path_factory.mktemp("reach") / "trial")
    reach.give_silhouettes(folder)
    reach.give_start(folder, 43)
    (folder / "trial.toml").write_text('[start]\nfile = "clicks.json"\n')
    return folder


@pytest.fixture(scope="module")
def motion(trial: Path) -> marey.Motion:
    return marey.capture(marey.open_trial(trial, frames=FRAMES), overlay=False)


@pytest.mark.slow
def test_a_capture_leaves_the_trial_as_it_is(motion, trial):
    assert sorted(path.name for path in trial.iterdir() if path.suffix != ".mp4") == [
        "background", "cameras.toml", "clicks.json", "masks", "trial.toml",
    ]  # fmt: skip
    assert np.flatnonzero(motion.measured).tolist() == list(FRAMES)
    assert motion.warnings == ()


@pytest.mark.slow
def test_what_is_saved_is_read_again(motion, tmp_path):
    out = motion.save(tmp_path / "out")
    promised = {"motion.npz", "body.npz", "skin.npz", "report.html", "run.json", "masks", "angles.csv"}
    assert promised <= {path.name for path in out.iterdir()}
    assert ".work" not in {path.name for path in out.iterdir()}
    again = marey.load_motion(out)
    for name, values in motion.data.arrays().items():
        np.testing.assert_array_equal(again.data.arrays()[name], values, err_msg=name)
    assert again.record["settings"]["frames"] == [42, 45]
    assert again.report == out / "report.html"
    np.testing.assert_array_equal(again.skin()[0], motion.skin()[0])


@pytest.mark.slow
def test_an_observation_of_a_kind_from_outside_pulls_the_body(motion, trial):
    names = motion.body.skeleton.segment_names
    head = names.index("head")
    before = motion.data.segment_origin[FRAMES, head, 2]
    given = {frame: [JointHeight(head, before[0] + 0.03)] for frame in FRAMES}
    with pytest.warns(marey.MareyWarning, match=r"without a pose are not used: 7\."):
        pulled = marey.capture(trial, frames=FRAMES, overlay=False, observations=given | {7: given[42]})
    after = pulled.data.segment_origin[FRAMES, head, 2]
    np.testing.assert_allclose(after, before[0] + 0.03, atol=0.01)
    assert np.abs(after - before).min() > 0.015


@pytest.mark.slow
def test_a_temporary_folder_goes_with_its_motion(trial):
    found = marey.capture(trial, frames=range(43, 44), overlay=False, progress=marey.RecordingProgress())
    folder = found.folder
    assert folder is not None
    assert folder.is_dir()
    del found
    gc.collect()
    assert not folder.exists()


def test_a_trial_is_opened_again_with_other_settings(trial):
    opened = marey.open_trial(trial, frames=range(10, 20), cameras=["cam01", "cam02", "cam03"])
    from marey.pipelines.capture.tasks import reopened

    again = reopened(opened, {"frames": (12, 15), "cameras": None})
    assert (again.take.first, again.take.end) == (12, 15)
    assert again.rig.names == ("cam01", "cam02", "cam03")
    assert reopened(opened, {"frames": None}) is opened


@pytest.mark.parametrize(
    ("settings", "wrong"),
    [
        ({"frames": range(10, 2)}, r"should be consecutive, for example range\(40, 100\)"),
        ({"frames": range(0, 10, 2)}, "should be consecutive"),
        ({"cameras": "cam01"}, "should be a list"),
        ({"preset": "tail"}, "tail"),
        ({"cameras": ["cam09"]}, "has no camera 'cam09'"),
    ],
)
def test_settings_that_cannot_be_used_are_named(trial, settings, wrong):
    with pytest.raises(marey.MareyError, match=wrong):
        marey.open_trial(trial, **settings)


def test_warnings_of_a_run_are_python_warnings():
    from marey.pipelines.capture.tasks import issue_warnings
    from marey.pipelines.progress import RecordingProgress

    progress = RecordingProgress()
    progress.warn("cam02 is dark")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        issue_warnings(progress)
    assert [str(each.message) for each in caught] == ["cam02 is dark"]
    assert issubclass(caught[0].category, marey.MareyWarning)


def test_trials_and_cameras_describe_themselves(trial):
    opened = marey.open_trial(trial, frames=range(10, 20), cameras=["cam01", "cam02"])
    expected = "Trial trial: 2 cameras (cam01, cam02), frames 10 to 19 of 130 at 30 Hz; with background and silhouettes"
    assert repr(opened) == expected
    assert repr(opened.rig) == "Rig of 2 cameras: Camera cam01 (320 x 240 px), Camera cam02 (320 x 240 px)"

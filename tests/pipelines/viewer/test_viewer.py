"""`marey view` reads results and finds their trial; what cannot be used is one clear line."""

import json
import shutil

import numpy as np
import pytest
from tests import performer
from tests.clips import make_trial
from tests.trials import marker_points, write_trial

from marey.errors import FileProblem, SettingProblem
from marey.io.results.results import write_results
from marey.pipelines.markers.estimate import estimate_bones, open_markers
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.viewer.viewer import viewer_content
from marey.view.viewer.parts import ViewerParts
from marey.view.viewer.viewed import ViewedMarkers


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A trial with the results of a capture of its frames 5 to 19."""
    trial = make_trial(tmp_path_factory.mktemp("made"), count=24)
    person = performer.body()
    write_results(trial / "marey", performer.motion(person), person, preset="full")
    record = {"files": ["motion.npz"], "settings": {"frames": [5, 20]}, "inputs": {"cam01.mp4": "0" * 32}}
    (trial / "marey" / "run.json").write_text(json.dumps(record))
    return trial


@pytest.fixture
def copied(made, tmp_path):
    shutil.copytree(made, tmp_path / "trial")
    return tmp_path / "trial"


def test_the_trial_above_the_results_is_found_and_the_requested_frames_are_shown(made):
    content = viewer_content([made / "marey"])
    assert content.take is not None
    assert content.take.rig.names == ("cam01", "cam02")
    (result,) = content.results
    assert (result.name, result.first, len(result)) == ("trial", 5, 15)
    assert result.shown.body is not None
    assert viewer_content([made]).results[0].first == 5


@pytest.mark.slow
def test_a_result_without_its_trial_is_shown_without_videos(made, tmp_path):
    shutil.copytree(made / "marey", tmp_path / "walk")
    content = viewer_content([tmp_path / "walk"])
    assert content.take is None
    assert "--trial" in content.without_videos
    assert viewer_content([tmp_path / "walk"], made).take is not None


@pytest.mark.slow
def test_damaged_videos_are_no_reason_to_show_nothing(copied):
    (copied / "cam01.mp4").write_bytes(b"no video")
    content = viewer_content([copied / "marey"])
    assert content.take is None
    with pytest.raises(FileProblem, match=r"cam01\.mp4"):
        viewer_content([copied / "marey"], copied)


def test_results_are_of_one_room_if_their_inputs_are_equal(made, copied):
    assert viewer_content([made / "marey", copied / "marey"]).same_room
    record = copied / "marey" / "run.json"
    record.write_text(record.read_text().replace("0" * 32, "1" * 32))
    both = viewer_content([made / "marey", copied / "marey"], offset_s=0.5)
    assert not both.same_room
    assert [result.name for result in both.results] == ["trial (1)", "trial (2)"]
    np.testing.assert_allclose(both.results[1].time - both.results[0].time, 0.5)


@pytest.mark.slow
def test_bones_from_markers_are_shown_beside_a_captured_motion(made, tmp_path):
    path = write_trial(tmp_path / "walk.c3d", marker_points(noise=1e-3))
    estimate_bones(open_markers(path), progress=RecordingProgress()).save(tmp_path / "markers")
    content = viewer_content([made / "marey", tmp_path / "markers"])
    shown = content.results[1].shown
    assert isinstance(shown, ViewedMarkers)
    assert not content.same_room
    scene = json.loads(ViewerParts(content).part("markers/1"))
    assert scene["labels"] == list(shown.paths.labels)
    with pytest.raises(SettingProblem, match="no videos"):
        viewer_content([tmp_path / "markers"], made)


def test_what_cannot_be_shown_is_named(made, tmp_path):
    with pytest.raises(FileProblem, match=r"neither motion\.npz nor bones\.npz"):
        viewer_content([tmp_path])
    with pytest.raises(SettingProblem, match="3 results"):
        viewer_content([made, made, made])
    with pytest.raises(SettingProblem, match="no second result"):
        viewer_content([made], offset_s=1.0)

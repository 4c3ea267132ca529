"""Other answers in a capture: what is reported, and what is flagged."""

from types import SimpleNamespace

import numpy as np
import pytest
from tests import worlds

from marey.fit.recipes.hypotheses import Alternative, OtherPostures
from marey.fit.recipes.person import PersonSettings
from marey.fit.recipes.sequence import SequenceFit
from marey.motion.from_fit import measure_piece
from marey.pipelines.capture import hypotheses
from marey.pipelines.capture.run import Bodies
from marey.pipelines.progress import RecordingProgress


@pytest.fixture
def motion():
    body = worlds.scan()
    return body, dict(enumerate(worlds.swing(body, 4)))


def test_answers_are_named_with_limb_and_frames(motion, monkeypatch):
    body, poses = motion
    other = Alternative("left arm", np.array([20]), {2: poses[2], 3: poses[3]}, 0.3)
    former = Alternative("right leg", np.array([30]), {0: poses[0], 1: poses[1]}, 0.01)
    monkeypatch.setattr(
        hypotheses, "explore_hypotheses", lambda *args, **more: OtherPostures(poses, [other], [former])
    )  # fmt: skip
    run = SimpleNamespace(person=PersonSettings(), progress=RecordingProgress())
    take = SimpleNamespace(levels=lambda height: None, rate=30.0)
    bodies = Bodies(worlds.person("coarse"), worlds.person("coarse"))
    found, others = hypotheses.explored(run, take, body, bodies, poses)
    assert found == poses
    assert others == [other]
    (warning,) = run.progress.warnings
    assert warning.startswith("Left arm, frames 2 to 3: two postures explain the images.")
    assert "0.30" in warning


def test_coordinates_with_two_answers_are_not_determined(motion):
    body, poses = motion
    degrees = len(body.skeleton)
    fit = SequenceFit(
        frames=np.array([2, 3]), poses=(poses[2], poses[3]), body=body,
        covariance=np.stack([1e-6 * np.eye(degrees)] * 2),
        information=np.stack([1e6 * np.eye(degrees)] * 2), residual_px=1.0,
    )  # fmt: skip
    piece = measure_piece(fit)
    assert piece.determined.all()
    found = hypotheses.undetermined(piece, [Alternative("left arm", np.array([20, 21]), {3: poses[3]}, 0.3)])
    assert found.determined[0].all()
    np.testing.assert_array_equal(np.flatnonzero(~found.determined[1]), [20, 21])

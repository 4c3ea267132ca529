"""Other answers in a capture: what is reported, and what is flagged."""

from types import SimpleNamespace

import numpy as np
import pytest
from tests import worlds

from marey.body.articulation.pose import PosedBody
from marey.body.people.person import person_body
from marey.fit.recipes.hypotheses import Alternative, OtherPostures
from marey.fit.recipes.person import PersonSettings
from marey.fit.recipes.sequence import SequenceFit
from marey.fit.search.limb_moves import limb_chains, moved_in_depth
from marey.io.stages import load_arrays, save_arrays
from marey.motion.anatomical import anatomy_of
from marey.motion.from_fit import measure_piece
from marey.pipelines.capture import hypotheses
from marey.pipelines.capture.run import Bodies
from marey.pipelines.capture.tracked import Tracked
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
    run = SimpleNamespace(
        person=PersonSettings(), progress=RecordingProgress(), scope=(),
        cache=SimpleNamespace(arrays=lambda name, compute, depends: compute()),
    )  # fmt: skip
    take = SimpleNamespace(levels=lambda height: None, rate=30.0, times=None)
    bodies = Bodies(worlds.person("coarse"), worlds.person("coarse"))
    found, others = hypotheses.explored(run, take, body, bodies, poses)
    assert list(found) == list(poses)
    assert [(each.name, list(each.poses), each.probability) for each in others] == [("left arm", [2, 3], 0.3)]
    (warning,) = run.progress.warnings
    assert warning.startswith("Left arm, frames 2 to 3: two postures explain the images.")
    assert "0.30" in warning


def test_postures_that_are_ambiguous_in_most_frames_limit_the_result(motion):
    body, poses = motion
    limbs = ("left arm", "right arm", "left leg", "right leg")
    everywhere = [Alternative(name, np.array([20]), poses, 0.2) for name in limbs]
    found = hypotheses.mostly_ambiguous(everywhere, body.skeleton, len(poses))
    assert found is not None
    assert "100 %" in found.what
    assert hypotheses.mostly_ambiguous(everywhere[:2], body.skeleton, len(poses)) is None
    # Of the limbs of a preset, only those that it follows count.
    arms = person_body("coarse", preset="upper").skeleton
    assert hypotheses.mostly_ambiguous(everywhere[:2], arms, len(poses)) is not None
    # Two answers for one frame count once.
    assert hypotheses.mostly_ambiguous([*everywhere[:2], *everywhere[:2]], body.skeleton, len(poses)) is None


@pytest.mark.slow
def test_a_limb_that_the_first_silhouettes_contradict_gets_another_posture():
    body, coarse = worlds.scan(), worlds.scan()
    truth = dict(enumerate(worlds.swing(body, 9, first={**worlds.ARMS_AND_KNEES, "left_elbow_flexion": 80})))
    cameras = worlds.ring(2)
    take = worlds.take([PosedBody(body, pose) for pose in truth.values()], cameras)
    arm = limb_chains(body.skeleton)[0]
    wrist = arm.segments[2]

    def mirrored(pose):
        """Return the farthest posture of the arm on the rays of the first camera."""
        posed = PosedBody(body, pose)
        moved = [PosedBody(body, other) for other in moved_in_depth(posed, arm, cameras[0].centre)]
        far = max(moved, key=lambda other: np.linalg.norm(other.segment_origin[wrist] - posed.segment_origin[wrist]))
        return far.pose

    def errors(poses):
        return [
            np.linalg.norm((PosedBody(body, pose).segment_origin - PosedBody(body, truth[f]).segment_origin)[wrist])
            for f, pose in poses.items()
        ]

    wrong = Tracked(body, {f: mirrored(pose) for f, pose in truth.items()}, dict.fromkeys(truth, 0.9))
    run = SimpleNamespace(
        person=PersonSettings(), progress=RecordingProgress(), scope=(),
        cache=SimpleNamespace(arrays=lambda name, compute, depends: compute()),
    )  # fmt: skip
    found = hypotheses.with_better_answers(run, take, wrong, Bodies(body, coarse))
    assert min(errors(wrong.poses)) > 0.1
    # The silhouettes of 240 px have pixels of about 10 mm.
    assert max(errors(found.poses)) < 0.04
    assert list(found.poses) == list(truth)
    assert dict(found.scores) == dict(wrong.scores)


def test_postures_are_the_same_after_saving(motion, tmp_path):
    body, poses = motion
    other = Alternative("left arm", np.array([20]), {2: poses[2], 3: poses[3]}, 0.3)
    former = Alternative("right leg", np.array([30, 31]), {0: poses[0]}, 0.01)
    for alternatives, replaced in (([other], [former, other]), ([], [])):
        given = OtherPostures(poses, alternatives, replaced)
        save_arrays(tmp_path / "postures.npz", hypotheses.pack_postures(given, body.skeleton))
        found = hypotheses.unpack_postures(load_arrays(tmp_path / "postures.npz"))
        assert list(found.poses) == list(poses)
        for frame, pose in poses.items():
            np.testing.assert_array_equal(found.poses[frame].angles, pose.angles)
            np.testing.assert_allclose(found.poses[frame].rotation, pose.rotation, atol=1e-12)
        for own, before in ((found.alternatives, alternatives), (found.replaced, replaced)):
            assert [(each.name, list(each.columns), list(each.poses), each.probability) for each in own] == [
                (each.name, list(each.columns), list(each.poses), each.probability) for each in before
            ]


def test_frames_of_one_limb_are_joined_in_one_warning(motion):
    _, poses = motion
    progress = RecordingProgress()
    others = [
        Alternative("left arm", np.array([20]), {3: poses[3]}, 0.1),
        Alternative("left arm", np.array([20]), {0: poses[0], 1: poses[1]}, 0.3),
        Alternative("right leg", np.array([30]), {2: poses[2]}, 0.2),
    ]
    hypotheses.warn_of_alternatives(progress, others)
    arm, leg = progress.warnings
    assert arm.startswith("Left arm, frames 0 to 1, 3: two postures explain the images.")
    assert "a probability of 0.10 to 0.30." in arm
    assert leg.startswith("Right leg, frame 2: ")
    assert "a probability of 0.20." in leg


def test_stored_alternatives_are_the_same(motion):
    body, poses = motion
    others = [
        Alternative("left arm", np.array([20, 22]), {0: poses[0], 1: poses[1]}, 0.3),
        Alternative("right leg", np.array([30]), {2: poses[2]}, 0.2),
    ]
    found = hypotheses.unpack_alternatives(hypotheses.pack_alternatives(others, body.skeleton))
    for other, again in zip(others, found, strict=True):
        assert (other.name, other.probability) == (again.name, again.probability)
        np.testing.assert_array_equal(other.columns, again.columns)
        assert list(other.poses) == list(again.poses)
        for frame, pose in other.poses.items():
            np.testing.assert_array_equal(pose.angles, again.poses[frame].angles)
            np.testing.assert_array_equal(pose.rotation, again.poses[frame].rotation)
            np.testing.assert_array_equal(pose.translation, again.poses[frame].translation)
    assert hypotheses.unpack_alternatives(hypotheses.pack_alternatives([], body.skeleton)) == []


def test_coordinates_and_angles_with_two_answers_are_not_determined(motion):
    body, poses = motion
    degrees = len(body.skeleton)
    fit = SequenceFit(
        frames=np.array([2, 3]), poses=(poses[2], poses[3]), body=body,
        covariance=np.stack([1e-6 * np.eye(degrees)] * 2),
        information=np.stack([1e6 * np.eye(degrees)] * 2), residual_px=1.0,
    )  # fmt: skip
    piece = measure_piece(fit)
    assert piece.determined.all()
    assert piece.angles_determined.all()
    own = [6 + worlds.column(body.skeleton, f"left_{name}") for name in ("shoulder_sweep", "elbow_flexion")]
    found = hypotheses.undetermined(piece, [Alternative("left arm", np.array(own), {3: poses[3]}, 0.3)], body)
    assert found.determined[0].all()
    assert found.angles_determined[0].all()
    np.testing.assert_array_equal(np.flatnonzero(~found.determined[1]), own)
    names = anatomy_of(body.skeleton, body.joint_centres).angle_names
    two = {name for name, sure in zip(names, found.angles_determined[1], strict=True) if not sure}
    # The angles of upper arm and forearm, the segments that the two coordinates rotate.
    shoulder = ("plane", "elevation", "axial_rotation", "flexion", "adduction", "rotation")
    expected = {f"left_shoulder_{name}" for name in shoulder}
    assert two == expected | {"left_elbow_flexion", "left_elbow_adduction", "left_forearm_pronation"}

import numpy as np
from tests.people import any_pose, stick_person

from marey.body.pose import PosedBody
from marey.cli.kept_candidates import KeptCandidates
from marey.fit.search import Candidate
from marey.io.stages import FrameLog


def test_candidates_come_back_after_an_interruption(tmp_path, rng):
    body = stick_person(rng)
    shaped = body.with_numbers(body.numbers + 0.5)
    candidates = {frame: Candidate(PosedBody(shaped, any_pose(rng, body)), 0.9 + 0.01 * frame) for frame in (7, 3, 5)}
    with FrameLog(tmp_path / "a.log") as log:
        kept = KeptCandidates(log, body)
        for frame, candidate in candidates.items():
            kept[frame] = candidate
    with FrameLog(tmp_path / "a.log") as log:
        found = KeptCandidates(log, body)
        assert list(found) == [7, 3, 5]
        for frame, candidate in candidates.items():
            assert found[frame].score == candidate.score
            np.testing.assert_array_equal(found[frame].posed.vertices, candidate.posed.vertices)


def test_the_last_of_two_candidates_of_a_frame_counts(tmp_path, rng):
    body = stick_person(rng)
    with FrameLog(tmp_path / "a.log") as log:
        kept = KeptCandidates(log, body)
        for score in (0.8, 0.9):
            kept[4] = Candidate(PosedBody(body, any_pose(rng, body)), score)
        assert len(kept) == 1
        assert KeptCandidates(log, body)[4].score == 0.9
        del kept[4]
        assert 4 not in kept

import numpy as np
from tests.people import any_pose, stick_person

from marey.body.articulation.pose import PosedBody
from marey.fit.search.search import Candidate
from marey.io.stages import FrameLog
from marey.pipelines.kept_candidates import KeptArrays, KeptCandidates


def test_candidates_are_restored_after_an_interruption(tmp_path, rng):
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


def test_candidates_may_be_kept_by_two_numbers(tmp_path, rng):
    body = stick_person(rng)
    candidates = {key: Candidate(PosedBody(body, any_pose(rng, body)), 0.9) for key in ((7, 3), (-1, 3))}
    with FrameLog(tmp_path / "a.log") as log:
        KeptCandidates(log, body).update(candidates)
        found = KeptCandidates(log, body)
        assert set(found) == {(7, 3), (-1, 3)}
        np.testing.assert_array_equal(found[-1, 3].posed.vertices, candidates[-1, 3].posed.vertices)
        # Candidates of one shape share the body, and what was computed for it.
        assert found[-1, 3].posed.body is found[7, 3].posed.body


def test_arrays_are_restored_after_an_interruption_until_they_are_deleted(tmp_path, rng):
    first, second = {"a": rng.normal(size=3), "b": np.zeros((2, 0))}, {"a": np.array(4)}
    with FrameLog(tmp_path / "a.log") as log:
        kept = KeptArrays(log)
        kept[0, 1], kept[0, 2] = first, second
    with FrameLog(tmp_path / "a.log") as log:
        found = KeptArrays(log)
        assert list(found) == [(0, 1), (0, 2)]
        assert set(found[0, 1]) == {"a", "b"}
        np.testing.assert_array_equal(found[0, 1]["a"], first["a"])
        assert found[0, 1]["b"].shape == (2, 0)
        found.clear()
        assert not found
        found[1, 0] = second
        assert list(KeptArrays(log)) == [(1, 0)]
        del found[1, 0]
        assert (1, 0) not in found

"""Candidates of frames, kept on disk as soon as they are found, so that an interrupted run finds them again."""

from collections.abc import Iterator, MutableMapping

import numpy as np

from marey.body.pose import Pose, PosedBody
from marey.body.surface import Body
from marey.fit.search import Candidate
from marey.io.stages import FrameLog


class KeptCandidates(MutableMapping[int, Candidate]):
    """Candidates by frame, in a log on disk.

    Args:
        log: Takes a record for each candidate.
        body: Whose shape space and skin all candidates share.
    """

    def __init__(self, log: FrameLog, body: Body):
        self._log, self._body = log, body
        self._place = {int(record["frame"]): place for place, record in enumerate(log)}

    def __getitem__(self, frame: int) -> Candidate:
        record = self._log[self._place[frame]]
        pose = Pose(record["translation"], record["rotation"], record["angles"])
        return Candidate(PosedBody(self._body.with_numbers(record["numbers"]), pose), float(record["score"]))

    def __setitem__(self, frame: int, candidate: Candidate) -> None:
        pose = candidate.posed.pose
        self._place[frame] = len(self._log)
        self._log.append(
            {
                "frame": np.array(frame),
                "translation": pose.translation,
                "rotation": pose.rotation,
                "angles": pose.angles,
                "numbers": candidate.posed.body.numbers,
                "score": np.array(candidate.score),
            }
        )

    def __delitem__(self, frame: int) -> None:
        del self._place[frame]

    def __iter__(self) -> Iterator[int]:
        return iter(self._place)

    def __len__(self) -> int:
        """Count the frames."""
        return len(self._place)

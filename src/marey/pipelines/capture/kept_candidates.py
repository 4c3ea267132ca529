"""What was found, kept on disk at once, so that an interrupted run finds it again: candidates of frames, and arrays."""

from collections.abc import Iterator, MutableMapping
from typing import Any, Generic, TypeVar

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.fit.search.search import Candidate
from marey.io.stages import Arrays, FrameLog

Key = TypeVar("Key", int, tuple[int, int])


class KeptCandidates(MutableMapping[Key, Candidate], Generic[Key]):
    """Candidates by frame, or by a number and a frame, in a log on disk.

    Args:
        log: Takes a record for each candidate.
        body: Whose shape space and skin all candidates share.
    """

    def __init__(self, log: FrameLog, body: Body):
        self._log, self._body = log, body
        self._place: dict[Key, int] = {_key(record["frame"]): place for place, record in enumerate(log)}

    def __getitem__(self, key: Key) -> Candidate:
        record = self._log[self._place[key]]
        pose = Pose(record["translation"], record["rotation"], record["angles"])
        return Candidate(PosedBody(self._with_numbers(record["numbers"]), pose), float(record["score"]))

    def _with_numbers(self, numbers: Floats) -> Body:
        """Give the body in a shape; candidates of the same shape share it, and what was computed for it."""
        if not np.array_equal(numbers, self._body.numbers):
            self._body = self._body.with_numbers(numbers)
        return self._body

    def __contains__(self, key: object) -> bool:
        return key in self._place

    def __setitem__(self, key: Key, candidate: Candidate) -> None:
        pose = candidate.posed.pose
        self._place[key] = len(self._log)
        self._log.append(
            {
                "frame": np.array(key),
                "translation": pose.translation,
                "rotation": pose.rotation,
                "angles": pose.angles,
                "numbers": candidate.posed.body.numbers,
                "score": np.array(candidate.score),
            }
        )

    def __delitem__(self, key: Key) -> None:
        del self._place[key]

    def __iter__(self) -> Iterator[Key]:
        return iter(self._place)

    def __len__(self) -> int:
        """Count the candidates."""
        return len(self._place)


class KeptArrays(MutableMapping[Key, Arrays], Generic[Key]):
    """Arrays by name, by a number or two, in a log on disk.

    Args:
        log: Takes a record for each entry.
    """

    def __init__(self, log: FrameLog):
        self._log = log
        self._place: dict[Key, int] = {_key(record["key"]): place for place, record in enumerate(log)}

    def __getitem__(self, key: Key) -> Arrays:
        record = self._log[self._place[key]]
        del record["key"]
        return record

    def __contains__(self, key: object) -> bool:
        return key in self._place

    def __setitem__(self, key: Key, arrays: Arrays) -> None:
        self._place[key] = len(self._log)
        self._log.append({"key": np.array(key), **arrays})

    def __delitem__(self, key: Key) -> None:
        del self._place[key]

    def clear(self) -> None:
        """Forget all, and leave its room on the disk."""
        self._place.clear()
        self._log.cut(0)

    def __iter__(self) -> Iterator[Key]:
        return iter(self._place)

    def __len__(self) -> int:
        """Count the entries."""
        return len(self._place)


def _key(stored: np.ndarray) -> Any:
    return tuple(map(int, stored)) if stored.ndim else int(stored)

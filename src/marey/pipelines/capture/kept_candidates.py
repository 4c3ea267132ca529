"""Candidates and arrays that are stored on disk as soon as they are found, so that a run can be resumed."""

from collections.abc import Iterator, MutableMapping
from typing import Any, Generic, TypeVar

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.pose import PosedBody, packed_poses, unpacked_poses
from marey.body.articulation.surface import Body
from marey.fit.search.search import Candidate
from marey.io.stages import Arrays, FrameLog

Key = TypeVar("Key", int, tuple[int, int])


class KeptCandidates(MutableMapping[Key, Candidate], Generic[Key]):
    """Candidates by frame, or by a number and a frame, in a log on disk.

    Args:
        log: Receives one record per candidate.
        body: The body whose shape space and skin all candidates share.
    """

    def __init__(self, log: FrameLog, body: Body):
        self._log, self._body = log, body
        self._place: dict[Key, int] = {_key(record["frame"]): place for place, record in enumerate(log)}

    def __getitem__(self, key: Key) -> Candidate:
        record = self._log[self._place[key]]
        (pose,) = unpacked_poses({name: values[None] for name, values in record.items()})
        return Candidate(PosedBody(self._with_numbers(record["numbers"]), pose), float(record["score"]))

    def _with_numbers(self, numbers: Floats) -> Body:
        """Return the body in a shape; candidates of the same shape share it and the values computed for it."""
        if not np.array_equal(numbers, self._body.numbers):
            self._body = self._body.with_numbers(numbers)
        return self._body

    def __contains__(self, key: object) -> bool:
        return key in self._place

    def __setitem__(self, key: Key, candidate: Candidate) -> None:
        pose = {name: values[0] for name, values in packed_poses([candidate.posed.pose]).items()}
        self._place[key] = len(self._log)
        self._log.append(
            {
                "frame": np.array(key),
                **pose,
                "numbers": candidate.posed.body.numbers,
                "score": np.array(candidate.score),
            }
        )

    def __delitem__(self, key: Key) -> None:
        del self._place[key]

    def __iter__(self) -> Iterator[Key]:
        return iter(self._place)

    def __len__(self) -> int:
        """Return the number of candidates."""
        return len(self._place)


class KeptArrays(MutableMapping[Key, Arrays], Generic[Key]):
    """Arrays by name, by a number or two, in a log on disk.

    Args:
        log: Receives one record per entry.
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
        """Delete all entries, and free their space on the disk."""
        self._place.clear()
        self._log.cut(0)

    def __iter__(self) -> Iterator[Key]:
        return iter(self._place)

    def __len__(self) -> int:
        """Return the number of entries."""
        return len(self._place)


def _key(stored: np.ndarray) -> Any:
    return tuple(map(int, stored)) if stored.ndim else int(stored)

"""Candidates and arrays that are stored on disk as soon as they are found, so that a run can be resumed."""

from abc import abstractmethod
from collections.abc import Iterator, MutableMapping
from typing import Any, Generic, TypeVar

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.pose import PosedBody, packed_poses, unpacked_poses
from marey.body.articulation.surface import Body
from marey.fit.search.search import Candidate
from marey.io.stages import Arrays, FrameLog

Key = TypeVar("Key", int, tuple[int, int])
Value = TypeVar("Value")


class _Kept(MutableMapping[Key, Value], Generic[Key, Value]):
    """Values by a number or two, in a log on disk; the last record of a key counts.

    Args:
        log: Receives one record per value.
    """

    _KEY_NAME: str
    """Name of the array with the key in a record."""

    def __init__(self, log: FrameLog):
        self._log = log
        self._place: dict[Key, int] = {_key(record[self._KEY_NAME]): place for place, record in enumerate(log)}

    @abstractmethod
    def _packed(self, value: Value) -> Arrays:
        """Return a value as arrays by name."""

    @abstractmethod
    def _unpacked(self, arrays: Arrays) -> Value:
        """Return the value that `_packed` has converted."""

    def __getitem__(self, key: Key) -> Value:
        record = self._log[self._place[key]]
        del record[self._KEY_NAME]
        return self._unpacked(record)

    def __contains__(self, key: object) -> bool:
        return key in self._place

    def __setitem__(self, key: Key, value: Value) -> None:
        self._place[key] = len(self._log)
        self._log.append({self._KEY_NAME: np.array(key), **self._packed(value)})

    def __delitem__(self, key: Key) -> None:
        del self._place[key]

    def __iter__(self) -> Iterator[Key]:
        return iter(self._place)

    def __len__(self) -> int:
        """Return the number of values."""
        return len(self._place)


class KeptCandidates(_Kept[Key, Candidate]):
    """Candidates by frame, or by a number and a frame, in a log on disk.

    Args:
        log: Receives one record per candidate.
        body: The body whose shape space and skin all candidates share.
    """

    _KEY_NAME = "frame"

    def __init__(self, log: FrameLog, body: Body):
        super().__init__(log)
        self._body = body

    def _packed(self, value: Candidate) -> Arrays:
        return {
            **{name: values[0] for name, values in packed_poses([value.posed.pose]).items()},
            "numbers": value.posed.body.numbers,
            "score": np.array(value.score),
        }

    def _unpacked(self, arrays: Arrays) -> Candidate:
        (pose,) = unpacked_poses({name: values[None] for name, values in arrays.items()})
        return Candidate(PosedBody(self._with_numbers(arrays["numbers"]), pose), float(arrays["score"]))

    def _with_numbers(self, numbers: Floats) -> Body:
        """Return the body in a shape; candidates of the same shape share it and the values computed for it."""
        if not np.array_equal(numbers, self._body.numbers):
            self._body = self._body.with_numbers(numbers)
        return self._body


class KeptArrays(_Kept[Key, Arrays]):
    """Arrays by name, by a number or two, in a log on disk.

    Args:
        log: Receives one record per entry.
    """

    _KEY_NAME = "key"

    def _packed(self, value: Arrays) -> Arrays:
        return value

    def _unpacked(self, arrays: Arrays) -> Arrays:
        return arrays

    def clear(self) -> None:
        """Delete all entries, and free their space on the disk."""
        self._place.clear()
        self._log.cut(0)


def _key(stored: np.ndarray) -> Any:
    return tuple(map(int, stored)) if stored.ndim else int(stored)

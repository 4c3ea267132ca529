"""A person tracked through a take, and the checkpoints of its poses: a run that is interrupted can be resumed."""

from abc import abstractmethod
from collections.abc import Iterator, Mapping, MutableMapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.pose import Pose, PosedBody, packed_poses, unpacked_poses
from marey.body.articulation.surface import Body
from marey.body.metaballs.metaball_person import reshaped
from marey.fit.recipes.person import SilhouetteTake, shape_frames
from marey.fit.recipes.sequence import FrameTermsFactory, RefineCheckpoint
from marey.fit.search.search import Candidate
from marey.io.stages import Arrays, FrameLog
from marey.pipelines.capture.mask_store import MaskStore
from marey.pipelines.capture.run import Run

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


@dataclass(frozen=True, eq=False)
class Tracked:
    """A person tracked through a take: the body, and one pose per frame."""

    body: Body
    poses: Mapping[int, Pose]
    scores: Mapping[int, float]


@dataclass(frozen=True, eq=False)
class FollowedPerson:
    """A person tracked through the take, and the silhouettes with the person as prior."""

    tracked: Tracked
    filled: Mapping[int, Pose]
    """Interpolated poses of frames between others with a pose."""
    outlines: MaskStore
    frames: Sequence[int]
    """Frames that show a person."""
    terms: FrameTermsFactory | None = None
    """Further observations for the refinement."""
    repaired: bool = True
    """Whether single frames are repaired by searching for limbs in the silhouettes; they must show the whole person."""

    def take(self, run: Run) -> SilhouetteTake:
        """Return the take as the refinement needs it."""
        poses, store = self.tracked.poses, self.outlines
        return SilhouetteTake(tuple(run.trial.rig), store, tuple(poses), run.trial.take.rate, store.edges, store.hidden)


def frames_for_sizes(run: Run, scores: Mapping[int, float]) -> list[int]:
    """Return the frames from which the sizes of the body are estimated; none if they are fixed."""
    return [] if run.settings.fixed_sizes else shape_frames(scores, run.person.shape_frames)


@contextmanager
def rounds_of(run: Run, name: str) -> Iterator[RefineCheckpoint]:
    """Open the checkpoints of a refinement: finished rounds, and finished windows of the present round."""
    with (
        run.cache.frames(f"{name}_rounds", depends=run.scope) as rounds,
        run.cache.frames(f"{name}_windows", depends=run.scope) as windows,
    ):
        yield RefineCheckpoint(KeptArrays(rounds), KeptArrays(windows))


def pack_candidates(found: Mapping[int, Candidate], body: Body) -> Arrays:
    """Return candidates by frame, and the shape parameters of their body, as arrays."""
    return pack_tracked({f: c.posed.pose for f, c in found.items()}, body, {f: c.score for f, c in found.items()})


def pack_tracked(poses: Mapping[int, Pose], body: Body, scores: Mapping[int, float]) -> Arrays:
    """Return poses and scores by frame, and the shape parameters of the body, as arrays."""
    return {
        "frames": np.array(list(poses)),
        **packed_poses(poses.values()),
        "score": np.array([scores[frame] for frame in poses]),
        "numbers": np.array(body.numbers),
    }


def unpack_tracked(arrays: Arrays, body: Body) -> Tracked:
    """Return the tracked person from its arrays; the body is another one of the same shape parameters."""
    frames = [int(frame) for frame in arrays["frames"]]
    return Tracked(
        reshaped(body, arrays["numbers"]),
        dict(zip(frames, unpacked_poses(arrays), strict=True)),
        dict(zip(frames, map(float, arrays["score"]), strict=True)),
    )

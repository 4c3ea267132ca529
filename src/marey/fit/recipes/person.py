"""The recipe: from the silhouettes of a take to one person's motion and shape."""

from collections.abc import Callable, Container, Iterable, Iterator, Mapping, MutableMapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from marey.arrays import Mask
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.body.metaballs.metaball_person import reshaped
from marey.cameras.camera import Camera
from marey.fit.recipes.pick_up import PickUpSettings, better_of, pick_up, start_again, weak_frames
from marey.fit.recipes.sequence import Further, RefineMemory, SequenceFit, SequenceSettings, refine_in_pieces
from marey.fit.recipes.track import TrackSettings, repair, track
from marey.fit.search.levels import FrameLevels, level_factor
from marey.fit.search.search import Candidate, Search, StartSettings
from marey.fit.search.start import find_start
from marey.fit.solver.side_by_side import side_by_side
from marey.images.silhouettes.interior import InteriorEdges

Done = Callable[[int], None]


def _nothing(frame: int) -> None:
    """Tell nobody."""


@dataclass(frozen=True, kw_only=True)
class PersonSettings:
    """How a person is captured; the defaults are what measured best (docs/accuracy.md)."""

    start: StartSettings = field(default_factory=StartSettings)
    track: TrackSettings = field(default_factory=TrackSettings)
    sequence: SequenceSettings = field(default_factory=SequenceSettings)
    pick_up: PickUpSettings = field(default_factory=PickUpSettings)
    bridge: float = 0.2
    """Time without an answer over which a motion is filled from both sides [s]."""
    start_frames: int = 3
    """Frames that are tried for the start."""
    shape_frames: int = 25
    """Frames from which the shape is learned."""
    track_height: float = 160.0
    """Height of the person in the pictures on which it is followed [px]."""
    rough_height: float = 80.0
    fine_height: float = 420.0
    """Height of the person in the pictures on which the sequence is refined [px]."""


@dataclass(frozen=True, eq=False)
class Take:
    """A take as the fit sees it: cameras, and silhouettes by frame."""

    cameras: tuple[Camera, ...]
    masks_of: Callable[[int], Sequence[Mask]]
    """Gives the silhouettes (height, width) of a frame, one a camera."""
    frames: tuple[int, ...]
    """Frames that show somebody, in order."""
    rate: float
    edges_of: Callable[[int], Sequence[InteriorEdges] | None] = lambda frame: None
    """Gives the edges inside of a frame's silhouettes, one set a camera; None where nobody looked for them."""
    _levels: dict[float, FrameLevels] = field(default_factory=dict, init=False, repr=False)

    def levels(self, height: float) -> FrameLevels:
        """Give the frames at the size at which the person is about so high [px]; the same ones each time."""
        if height not in self._levels:
            self._levels[height] = self._shrunk(height)
        return self._levels[height]

    def forget(self) -> None:
        """Let go of all levels: the next work on the take looks at others."""
        for levels in self._levels.values():
            levels.forget()

    def _shrunk(self, height: float) -> FrameLevels:
        sample = self.frames[:: max(1, len(self.frames) // 5)][:5]
        tallest = [mask for frame in sample for mask in self.masks_of(frame)]
        return FrameLevels(self.cameras, self.masks_of, level_factor(tallest, height), self.edges_of)


@dataclass(frozen=True, eq=False)
class Memory:
    """What a run that follows a person has found so far; each part takes a candidate as soon as it is found."""

    followed: MutableMapping[tuple[int, int], Candidate] = field(default_factory=dict)
    """By the frame of the start from which the person was followed, and the frame."""
    starts: MutableMapping[int, Candidate] = field(default_factory=dict)
    """Starts that were tried anew, by frame."""
    mended: MutableMapping[tuple[int, int], Candidate] = field(default_factory=dict)
    """By the way in which frames were gone through (1 or -1), and the frame."""


class OfStart(MutableMapping[int, Candidate]):
    """The part of a memory that belongs to one start.

    Args:
        every: Candidates by start and frame.
        start: Which part.
    """

    def __init__(self, every: MutableMapping[tuple[int, int], Candidate], start: int):
        self._every, self._start = every, start

    def __getitem__(self, frame: int) -> Candidate:
        return self._every[self._start, frame]

    def __contains__(self, frame: object) -> bool:
        return (self._start, frame) in self._every

    def __setitem__(self, frame: int, candidate: Candidate) -> None:
        self._every[self._start, frame] = candidate

    def __delitem__(self, frame: int) -> None:
        del self._every[self._start, frame]

    def __iter__(self) -> Iterator[int]:
        return (frame for start, frame in self._every if start == self._start)

    def __len__(self) -> int:
        """Count the frames."""
        return sum(1 for _ in self)


def promising_frames(take: Take, count: int) -> list[int]:
    """Choose frames that show the person best: in every camera, large, and not cut by the border.

    Args:
        take: cameras and silhouettes.
        count: how many; they lie apart in time.
    """
    stride = max(1, len(take.frames) // 40)
    frames = list(take.frames[::stride])
    shown = np.array([[_shown(mask) for mask in take.masks_of(frame)] for frame in frames])
    usual = np.maximum(np.median(shown[:, :, 0], 0), 1.0)
    merit = np.minimum(shown[:, :, 0] / usual, 1.1).mean(1) - 4.0 * shown[:, :, 1].mean(1)
    merit -= 1.0 * (shown[:, :, 0] < 0.3 * usual).mean(1)
    chosen: list[int] = []
    apart = max(1, len(frames) // (2 * count))
    for i in np.argsort(-merit):
        if all(abs(i - other) >= apart for other in chosen):
            chosen.append(int(i))
        if len(chosen) == count:
            break
    return [frames[i] for i in chosen]


def _shown(mask: Mask) -> tuple[float, float]:
    """Give a silhouette's size [px] and the share of its extent that lies at the picture's border."""
    area = float(np.count_nonzero(mask))
    if area == 0:
        return 0.0, 1.0
    border = float(sum(np.count_nonzero(edge) for edge in (mask[0], mask[-1], mask[:, 0], mask[:, -1])))
    return area, border / np.sqrt(area)


def start_person(
    take: Take,
    coarse: Body,
    fine: Body,
    settings: PersonSettings,
    *,
    done: Done = _nothing,
    memory: MutableMapping[int, Candidate] | None = None,
) -> tuple[int, Candidate] | None:
    """Find the start in the frames that show the person best, until one is explained well; give the best of them.

    A memory takes every candidate as soon as it is found; what it holds already is not sought again.
    """
    memory = {} if memory is None else memory
    found: list[tuple[int, Candidate]] = []
    for frame in promising_frames(take, settings.start_frames):
        if frame not in memory:
            candidate = find_start(take.cameras, take.masks_of(frame), coarse, fine, settings.start)
            if candidate is not None:
                memory[frame] = candidate
        if frame in memory:
            found.append((frame, memory[frame]))
        done(frame)
        if found and found[-1][1].score >= settings.start.good:
            break
    return max(found, key=lambda pair: pair[1].score) if found else None


def track_person(
    take: Take,
    body: Body,
    coarse: Body,
    start: tuple[int, Pose],
    settings: PersonSettings,
    *,
    done: Done = _nothing,
    memory: Memory | None = None,
) -> dict[int, Candidate]:
    """Follow the person from the start to both ends of the take, pick up who was lost, and mend what went wrong.

    Who left and came back after a while is sought anew, as is who was lost; the body's shape is kept. A stretch that
    was followed much worse than the rest is tried again in the same way.

    Args:
        take: cameras and silhouettes.
        body: whose shape stays as it is.
        coarse: the same body with few vertices.
        start: a frame, and the pose in it.
        settings: how a person is followed.
        done: told of every frame once.
        memory: what an interrupted run had found already.
    """
    memory = memory or Memory()
    levels, rough = take.levels(settings.track_height), take.levels(settings.rough_height)
    tell = _once(done)

    def follow(begun: int, pose: Pose, frames: Sequence[int]) -> dict[int, Candidate]:
        return track(
            body, pose, frames, levels, rough, rate=take.rate, settings=settings.track, coarse=coarse, done=tell,
            memory=OfStart(memory.followed, begun),
        )  # fmt: skip

    def anew(frame: int) -> Candidate | None:
        if frame not in memory.starts:
            masks = take.masks_of(frame)
            candidate = start_again(take.cameras, masks, body, coarse, levels, frame, settings.start)
            if candidate is None:
                return None
            memory.starts[frame] = candidate
        return memory.starts[frame]

    frame, pose = start
    ahead, behind = [f for f in take.frames if f >= frame], [f for f in reversed(take.frames) if f < frame]
    found = follow(frame, pose, ahead) | follow(frame, pose, behind)
    weak = weak_frames(found, rate=take.rate, settings=settings.pick_up)
    again = pick_up(
        {f: c for f, c in found.items() if f not in weak}, take.frames, _merits(take), anew, follow, rate=take.rate,
        settings=settings.pick_up,
    )  # fmt: skip
    found = better_of(found, again)
    for frame in take.frames:
        tell(frame)
    return repair(
        found, levels, rough, coarse=coarse, rate=take.rate, settings=settings.track, memory=memory.mended
    )  # fmt: skip


def _once(done: Done) -> Done:
    """Tell of each frame but once."""
    told: set[int] = set()

    def tell(frame: int) -> None:
        if frame not in told:
            told.add(frame)
            done(frame)

    return tell


def _merits(take: Take) -> Callable[[int], float]:
    """Give how well a frame shows the person: all of the silhouettes, less what the pictures' borders cut."""

    def merit(frame: int) -> float:
        shown = [_shown(mask) for mask in take.masks_of(frame)]
        return float(np.mean([np.sqrt(area) * max(1.0 - 4.0 * cut, 0.0) for area, cut in shown]))

    return merit


def mend_person(
    take: Take,
    body: Body,
    coarse: Body,
    poses: Mapping[int, Pose],
    settings: PersonSettings,
    *,
    done: Done = _nothing,
    memory: MutableMapping[tuple[int, int], Candidate] | None = None,
) -> dict[int, Pose]:
    """Mend single frames of a sequence once its body and its silhouettes are better known.

    A memory takes every mended frame as soon as it is found; what it holds already is not sought again.
    """
    levels, rough = take.levels(settings.track_height), take.levels(settings.rough_height)
    seen = ((levels.at(f), pose) for f, pose in poses.items())
    scored = side_by_side(lambda task: Search(task[0], settings.start).judge(PosedBody(body, task[1])), seen)
    judged = dict(zip(poses, scored, strict=True))
    mended = repair(
        judged, levels, rough, coarse=coarse, rate=take.rate, settings=settings.track, done=done, memory=memory
    )
    return {f: candidate.posed.pose for f, candidate in mended.items()}


def bridged(poses: Mapping[int, Pose], *, longest: float) -> dict[int, Pose]:
    """Give poses for moments without an answer, evenly between those on both sides.

    Args:
        poses: that were found, by frame.
        longest: how many frames a moment may last.
    """
    filled = {}
    for before, after in pairwise(sorted(poses)):
        if 1 < after - before <= longest + 1:
            for frame in range(before + 1, after):
                filled[frame] = poses[before].between(poses[after], (frame - before) / (after - before))
    return filled


def unseen(
    take: Take, body: Body, poses: Mapping[int, Pose], frames: Iterable[int], settings: PersonSettings, *, usual: float
) -> set[int]:
    """Tell of frames whose poses were filled which ones the silhouettes do not bear out, much worse than usual."""
    levels = take.levels(settings.track_height)
    return {
        f
        for f in frames
        if Search(levels.at(f), settings.start).judge(PosedBody(body, poses[f])).score < usual - settings.pick_up.worse
    }


def shape_frames(agreements: Mapping[int, float], count: int) -> list[int]:
    """Choose frames for the shape: evenly among the best 70 in a hundred."""
    scores = np.array(list(agreements.values()))
    good = [f for f, s in zip(agreements, scores, strict=True) if s >= np.quantile(scores, 0.3)]
    index = np.unique(np.linspace(0, len(good) - 1, min(count, len(good))).astype(int))
    return [good[i] for i in index]


def refine_person(
    take: Take,
    body: Body,
    poses: Mapping[int, Pose],
    for_shape: Sequence[int],
    settings: PersonSettings,
    *,
    height: float,
    rounds: int,
    blind: Container[int] = (),
    also: Further | None = None,
    done: Done = _nothing,
    memory: RefineMemory | None = None,
) -> Iterator[SequenceFit]:
    """Refine motion and shape together at one size of the pictures; the answer comes piece by piece.

    The silhouettes of blind frames are not believed: only their neighbours speak of them.
    """
    return refine_in_pieces(
        list(poses), list(poses.values()), body, take.levels(height), rate=take.rate, rounds=rounds,
        shape_frames=for_shape, settings=settings.sequence, blind=blind, also=also, done=done, memory=memory,
    )  # fmt: skip


def with_shape(body: Body, other: Body) -> Body:
    """Give a body of another level the shape numbers of this one."""
    return replace(reshaped(other, body.numbers), numbers_covariance=body.numbers_covariance)

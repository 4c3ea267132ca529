"""Evidence for the person from outside: given soft silhouettes, and a network that segments people.

Such silhouettes have gaps and leaks that the images contradict. Their log-odds are therefore one more soft channel
beside the images' evidence and the prior from the drawn body; the level set decides.
"""

import zlib
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from marey.arrays import Floats, Image, Integers, Mask
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.cameras.camera import Camera
from marey.io.stages import FrameLog
from marey.io.trial.trial import Trial
from marey.observations.correspondence import view_of
from marey.pipelines.capture.run import Run
from marey.pipelines.silhouettes import stages
from marey.pipelines.silhouettes.empty_rooms import PEEKS, reduced_cameras, resized
from marey.pipelines.silhouettes.mask_store import MaskStore

ODDS_LIMIT = 1.0
"""Largest log-odds of a pixel from outside. Chosen by hand; with 0.3 and full weights, `office` is 26.3 mm off
instead of 27.9 with 1."""
CHECKED_FRAMES = 8
"""Number of frames in which the evidence of a camera is compared with the drawn body. Chosen by hand."""
UNRELIABLE, RELIABLE = 0.8, 0.95
"""Agreement of a source with the drawn body in one camera, as in `agreement`, up to which it is not used, and from
which on it has its full weight. Chosen on `office`, where the joints with a network and key points are 27.9 mm off with
full weights, 25.2 with these, and 25.3 without the network."""
INNER_SHARE, OUTER_SHARE = 0.015, 0.04
"""Distance inside and outside of the drawn body's outline from which on a pixel counts for the agreement, as a share of
the larger side of the body's box. Chosen by hand."""
BOX_MARGIN = 0.3
"""Margin of the region in which a network looks for the person, as a share of the larger side of the drawn body's box.
Chosen by hand."""
_STEPS = 127
"""Number of steps in which log-odds from 0 to `ODDS_LIMIT` are stored."""


class PersonEvidence:
    """Log-odds of the person at the pixels of all frames, on disk.

    Args:
        log: One record per frame.
        first: The frame of the first record.
        cameras: The cameras, in the order of the records.
    """

    def __init__(self, log: FrameLog, first: int, cameras: Sequence[Camera]):
        self._log, self._first = log, first
        self._sizes = [camera.size for camera in cameras]

    @property
    def frames(self) -> range:
        """The frames that are stored."""
        return range(self._first, self._first + len(self._log))

    def append(self, odds: Sequence[Floats | None]) -> None:
        """Add the log-odds (height, width) of the next frame, one array per camera; None where nothing is known."""
        self._log.append({f"odds_{c}": _packed(each) for c, each in enumerate(odds) if each is not None})

    def __call__(self, frame: int) -> list[Floats | None]:
        """Return the log-odds of a frame, at most `ODDS_LIMIT` in size, one array per camera."""
        record = self._log[frame - self._first]
        return [
            _unpacked(record[f"odds_{c}"], (height, width)) if f"odds_{c}" in record else None
            for c, (width, height) in enumerate(self._sizes)
        ]


def _packed(odds: Floats) -> NDArray[np.uint8]:
    steps = np.rint(np.clip(odds / ODDS_LIMIT, -1, 1) * _STEPS).astype(np.int8)
    return np.frombuffer(zlib.compress(steps.tobytes(), level=1), np.uint8)


def _unpacked(packed: NDArray[np.uint8], shape: tuple[int, int]) -> Floats:
    steps = np.frombuffer(zlib.decompress(packed.tobytes()), np.int8).reshape(shape)
    return np.asarray(steps * np.float32(ODDS_LIMIT / _STEPS))


def log_odds(levels: Image) -> Floats:
    """Return the log-odds log(p / (1 - p)) of probabilities, held to `ODDS_LIMIT`.

    Args:
        levels: (H, W) uint8 probabilities p from 0 to 255.

    Returns:
        (H, W) float32.
    """
    share = np.clip(np.arange(256) / 255.0, 0.5 / 255, 1 - 0.5 / 255)
    table = np.clip(np.log(share / (1 - share)), -ODDS_LIMIT, ODDS_LIMIT).astype(np.float32)
    return np.asarray(table[levels])


def evidence_of_all_cameras(trial: Trial) -> bool:
    """Return whether each camera has given soft silhouettes.

    A network does not count: it finds other people too. From its first silhouettes, the joints of `market` were 377
    instead of 63 mm off.
    """
    return set(trial.evidence) == set(trial.rig.names)


def first_silhouettes(run: Run, log: FrameLog) -> tuple[MaskStore, list[Camera]]:
    """Find the first silhouettes: where the given ones show the person more probably than not.

    Args:
        run: The run; its trial has soft silhouettes of all cameras.
        log: Receives the silhouettes.

    Returns:
        The silhouettes, and cameras of their size.
    """
    trial, cameras = run.trial, list(run.trial.rig)
    take = trial.take
    peeks = [int(i) for i in np.unique(np.linspace(take.first, take.end - 1, PEEKS).astype(int))]
    tallest = max(np.count_nonzero(mask.any(1)) for masks in _probable(trial, peeks) for mask in masks)
    small = reduced_cameras(cameras, float(tallest))
    store = MaskStore(log, take.first, small)
    done = len(store.frames)
    with run.progress.stage("Silhouettes", take.end - take.first, done=done) as step:
        for masks in _probable(trial, range(take.first + done, take.end)):
            store.append(
                [
                    resized(mask.astype(np.uint8) * np.uint8(255), camera) > 127
                    for mask, camera in zip(masks, small, strict=True)
                ]
            )
            step()
    return store, small


def _probable(trial: Trial, frames: Sequence[int]) -> Iterator[tuple[Mask, ...]]:
    """Iterate over the pixels of frames at which the person is more probable than not, by camera."""
    return zip(*(trial.evidence[name].masks(frames) for name in trial.rig.names), strict=True)


@contextmanager
def person_evidence(run: Run, body: Body, poses: Mapping[int, Pose]) -> Iterator[PersonEvidence | None]:
    """Collect the evidence of all frames; a network looks about the drawn body.

    Args:
        run: The run.
        body: The person's body.
        poses: Its poses by frame.

    Yields:
        The evidence; None if the trial has none.
    """
    trial = run.trial
    if not trial.evidence and trial.network is None:
        yield None
        return
    with run.cache.frames("evidence", depends=run.scope) as log:
        evidence = PersonEvidence(log, trial.take.first, list(trial.rig))
        done, count = len(evidence.frames), trial.take.end - trial.take.first
        frames = range(trial.take.first + done, trial.take.end)
        if done < count:
            with run.progress.stage("Evidence", count, done=done) as step:
                for odds in _collected(trial, body, poses, frames):
                    evidence.append(odds)
                    step()
        yield evidence


@dataclass(frozen=True, eq=False)
class _Seen:
    """What a source says about one image."""

    source: str
    camera: int
    box: tuple[slice, slice]
    """The rows and columns about which something is known."""
    levels: Image
    """The probability of the person in the box, from 0 to 255."""
    drawn: Mask | None
    """(H, W) the drawn body; None if no pose is known."""
    shape: tuple[int, int]
    """Height and width of the image."""


def _collected(
    trial: Trial, body: Body, poses: Mapping[int, Pose], frames: Sequence[int]
) -> Iterator[list[Floats | None]]:
    """Iterate over the sum of the log-odds from all sources, by camera."""
    weights = _weights(trial, body, poses)
    for seen in _seen_in(trial, body, poses, frames):
        odds: list[Floats | None] = [None] * len(trial.rig)
        for each in seen:
            weight = weights.get((each.source, each.camera), 1.0)
            if weight > 0:
                own, more = odds[each.camera], np.zeros(each.shape, np.float32)
                more[each.box] = np.float32(weight) * log_odds(each.levels)
                odds[each.camera] = more if own is None else own + more
        yield odds


def _seen_in(trial: Trial, body: Body, poses: Mapping[int, Pose], frames: Sequence[int]) -> Iterator[list[_Seen]]:
    """Iterate over frames: what the given silhouettes and the network say; the network looks about the drawn body."""
    given = {name: file.levels(frames) for name, file in trial.evidence.items()}
    find = None if trial.network is None else trial.network.loaded()
    read = trial.take.at(frames) if find is not None else ((frame, ()) for frame in frames)
    for frame, pictures in read:
        posed, seen = PosedBody(body, poses[frame]) if frame in poses else None, []
        for c, camera in enumerate(trial.rig):
            shape = camera.height, camera.width
            drawn = None if posed is None else view_of(posed, camera).mask()
            whole = slice(0, shape[0]), slice(0, shape[1])
            box = whole if drawn is None else box_about(drawn)
            if camera.name in given:
                seen.append(_Seen("masks", c, whole, next(given[camera.name]), drawn, shape))
            if find is not None and box is not None:
                levels = find(np.ascontiguousarray(pictures[c][box]))
                seen.append(_Seen("network", c, box, levels, drawn, shape))
        yield seen


def _weights(trial: Trial, body: Body, poses: Mapping[int, Pose]) -> dict[tuple[str, int], float]:
    """Return the weight of each source in each camera, from its agreement with the drawn body."""
    known, counts = sorted(poses), defaultdict[tuple[str, int], Integers](lambda: np.zeros(4, np.int64))
    if not known:
        return {}
    index = np.unique(np.linspace(0, len(known) - 1, min(CHECKED_FRAMES, len(known))).astype(int))
    for seen in _seen_in(trial, body, poses, [known[i] for i in index]):
        for each in seen:
            if each.drawn is not None and each.drawn.any():
                near = box_about(each.drawn) or each.box
                levels = np.zeros(each.shape, np.uint8)
                levels[each.box] = each.levels
                counts[each.source, each.camera] += right_and_all(levels[near], each.drawn[near])
    return {
        key: float(np.clip((agreement(count) - UNRELIABLE) / (RELIABLE - UNRELIABLE), 0, 1))
        for key, count in counts.items()
    }


def right_and_all(levels: Image, drawn: Mask) -> Integers:
    """Count the pixels away from the outline of a drawn body at which a source agrees with it.

    Args:
        levels: (H, W) probabilities of the person from 0 to 255, about the body.
        drawn: (H, W) the drawn body.

    Returns:
        (4,) agreeing pixels inside, all inside, agreeing pixels outside, all outside.
    """
    rows, columns = np.flatnonzero(drawn.any(axis=1)), np.flatnonzero(drawn.any(axis=0))
    side = max(rows[-1] - rows[0], columns[-1] - columns[0]) + 1
    person = levels > 127
    inside = cv2.distanceTransform(drawn.view(np.uint8), cv2.DIST_L2, 3) > INNER_SHARE * side
    outside = cv2.distanceTransform((~drawn).view(np.uint8), cv2.DIST_L2, 3) > OUTER_SHARE * side
    pairs = [(inside & person, inside), (outside & ~person, outside)]
    return np.array([np.count_nonzero(region) for pair in pairs for region in pair])


def agreement(counts: Integers) -> float:
    """Return Youden's index: the share of agreeing pixels inside plus that outside, minus 1; 1 is perfect, 0 is chance.

    Args:
        counts: (4,) sums of `right_and_all`.
    """
    return float(counts[0] / max(counts[1], 1) + counts[2] / max(counts[3], 1) - 1)


def box_about(mask: Mask) -> tuple[slice, slice] | None:
    """Return rows and columns about a drawn body: a square with a margin, as far as the image shows it.

    Args:
        mask: (H, W) the drawn body.

    Returns:
        Rows and columns; None if the body is not in the image.
    """
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if len(rows) == 0:
        return None
    half = (0.5 + BOX_MARGIN) * max(rows[-1] - rows[0] + 1, columns[-1] - columns[0] + 1)
    centres = (rows[0] + rows[-1]) / 2, (columns[0] + columns[-1]) / 2
    first, last = (
        slice(max(int(centre - half), 0), min(int(centre + half) + 1, size))
        for centre, size in zip(centres, mask.shape, strict=True)
    )
    return first, last


def with_evidence(
    predicted: Callable[[int], Sequence[stages.Expected] | None], evidence: PersonEvidence | None
) -> Callable[[int], Sequence[stages.Expected] | None]:
    """Add evidence from outside to the prior of predicted silhouettes.

    Args:
        predicted: Returns the predicted body of a frame for each camera; None if it is not known.
        evidence: The evidence; None changes nothing.

    Returns:
        The same function with the evidence in the priors.
    """
    if evidence is None:
        return predicted

    def joined(frame: int) -> Sequence[stages.Expected] | None:
        expected = predicted(frame)
        if expected is None:
            return None
        return [_added(each, odds) for each, odds in zip(expected, evidence(frame), strict=True)]

    return joined


def _added(expected: stages.Expected, odds: Floats | None) -> stages.Expected:
    if odds is None or not expected.mask.any():
        return expected
    pull = stages.pull_of(expected.mask) if expected.pull is None else expected.pull
    if odds.shape != pull.shape:
        odds = np.asarray(cv2.resize(odds.astype(np.float32), pull.shape[::-1], interpolation=cv2.INTER_AREA))
    return replace(expected, pull=pull + odds)

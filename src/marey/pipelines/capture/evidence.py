"""Evidence for the person from outside: given soft silhouettes, and a network that segments people.

Such silhouettes have gaps and leaks that the images contradict. Their log-odds are therefore one more soft channel
beside the images' evidence and the prior from the drawn body; the level set decides.
"""

import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from marey.arrays import Floats, Image, Mask
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.cameras.camera import Camera
from marey.io.stages import FrameLog
from marey.io.trial.trial import Trial
from marey.observations.correspondence import view_of
from marey.pipelines.capture import stages
from marey.pipelines.capture.mask_store import MaskStore
from marey.pipelines.capture.run import Run

ODDS_LIMIT = 0.3
"""Largest log-odds of a pixel from outside. Chosen by hand."""
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
    """Return whether each camera has given soft silhouettes, or a network is given."""
    return trial.network is not None or (len(trial.rig) > 0 and set(trial.evidence) == set(trial.rig.names))


def first_silhouettes(run: Run, log: FrameLog) -> tuple[MaskStore, list[Camera]]:
    """Find the first silhouettes where the evidence for the person is more probable than not.

    Args:
        run: The run; its trial has evidence of all cameras.
        log: Receives the silhouettes.

    Returns:
        The silhouettes, and cameras of their size.
    """
    trial, cameras = run.trial, list(run.trial.rig)
    take = trial.take
    peeks = [int(i) for i in np.unique(np.linspace(take.first, take.end - 1, stages.PEEKS).astype(int))]
    tallest = max(np.count_nonzero(mask.any(1)) for masks in _probable(trial, peeks) for mask in masks)
    small = stages.reduced_cameras(cameras, float(tallest))
    store = MaskStore(log, take.first, small)
    done = len(store.frames)
    with run.progress.stage("Silhouettes", take.end - take.first, done=done) as step:
        for masks in _probable(trial, range(take.first + done, take.end)):
            store.append(
                [
                    stages.resized(mask.astype(np.uint8) * np.uint8(255), camera) > 127
                    for mask, camera in zip(masks, small, strict=True)
                ]
            )
            step()
    return store, small


def _probable(trial: Trial, frames: Sequence[int]) -> Iterator[list[Mask]]:
    """Iterate over the pixels of frames at which the person is more probable than not, by camera."""
    given = {name: file.masks(frames) for name, file in trial.evidence.items()}
    find = None if trial.network is None or set(given) == set(trial.rig.names) else trial.network.loaded()
    images: Iterator[Sequence[Image]] = (
        iter([()] * len(frames)) if find is None else (pictures for _, pictures in trial.take.at(frames))
    )
    for pictures in images:
        masks = []
        for c, name in enumerate(trial.rig.names):
            if name in given:
                masks.append(next(given[name]))
            elif find is not None:
                masks.append(np.asarray(find(pictures[c]) > 127))
        yield masks


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


def _collected(
    trial: Trial, body: Body, poses: Mapping[int, Pose], frames: Sequence[int]
) -> Iterator[list[Floats | None]]:
    """Iterate over the sum of the log-odds from all sources, by camera."""
    given = {name: file.levels(frames) for name, file in trial.evidence.items()}
    find = None if trial.network is None else trial.network.loaded()
    read = trial.take.at(frames) if find is not None else ((frame, ()) for frame in frames)
    for frame, pictures in read:
        odds = [log_odds(next(given[name])) if name in given else None for name in trial.rig.names]
        if find is not None:
            posed = PosedBody(body, poses[frame]) if frame in poses else None
            for c, (camera, picture) in enumerate(zip(trial.rig, pictures, strict=True)):
                found = _found_about(find, picture, camera, posed)
                own = odds[c]
                odds[c] = found if own is None else own if found is None else own + found
        yield odds


def _found_about(
    find: Callable[[Image], Image], picture: Image, camera: Camera, posed: PosedBody | None
) -> Floats | None:
    """Return a network's log-odds about the drawn body, 0 elsewhere; of the entire image if no pose is known."""
    if posed is None:
        return log_odds(find(picture))
    box = box_about(view_of(posed, camera).mask())
    if box is None:
        return None
    odds = np.zeros(picture.shape[:2], np.float32)
    odds[box] = log_odds(find(np.ascontiguousarray(picture[box])))
    return odds


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
    return replace(expected, pull=pull + odds)

"""A take: the synchronised clips of several cameras, found in a folder and checked for consistency."""

import queue
import threading
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from marey.arrays import Floats, Image
from marey.cameras.clocks import Clocks
from marey.cameras.rig import Rig
from marey.errors import FileProblem
from marey.io.video.clip_files import VideoPlaces, find_fitting_clips
from marey.io.video.common_frames import CommonFrames, SelectedPictures, common_frames
from marey.io.video.timestamps import RecordedTimes, recorded_times
from marey.io.video.video import Clip
from marey.wording import listed

COUNT_TOLERANCE = 3
"""Largest difference of the numbers of frames of one take; cameras stop at slightly different times.

Chosen by hand."""
RATE_TOLERANCE = 0.005
"""Largest relative difference of equal frame rates: 29.97 and 30 Hz are equal, 25 and 30 Hz are not.

Chosen by hand."""
_QUEUE_LENGTH = 3
"""Number of decoded images per camera that are queued, to keep the decoder busy. Chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Take:
    """The synchronised clips of several cameras; frame i is the same instant in all of them.

    Cameras with clocks of their own have pictures up to half a frame before or after that instant, see `common`.
    """

    names: tuple[str, ...]
    """The cameras, in the rig's order."""
    clips: tuple[Clip, ...]
    """One clip per camera."""
    rate: float
    """Frame rate [Hz]."""
    count: int
    """Number of frames of the video; every result has one row per frame."""
    first: int
    """The first frame to process."""
    end: int
    """The frame after the last one to process."""
    notes: tuple[str, ...] = ()
    """Remarks for the report: omitted frames, replaced rates."""
    common: CommonFrames | None = None
    """Which pictures of the cameras are the frames, and how late they are; None if the cameras have one clock."""
    clocks: Clocks | None = None
    """The clocks of the cameras that files of timestamps state; None without any."""
    is_free: bool = False
    """Whether nothing is known of the cameras' clocks; frame i is then picture i of each camera."""

    @property
    def late(self) -> Floats | None:
        """(C, F) time from each frame to each camera's picture of it [frames]; None if the cameras have one clock."""
        return None if self.common is None else self.common.late

    def frames(self, first: int | None = None, end: int | None = None) -> Iterator[tuple[int, tuple[Image, ...]]]:
        """Iterate over the frames; each camera is decoded in its own thread, a few frames ahead.

        Args:
            first: First frame; that of the take by default.
            end: The frame after the last one; that of the take by default.

        Yields:
            The frame's number and one image per camera, (height, width, 3) uint8 in blue, green, red.

        Raises:
            FileProblem: A clip is damaged; the message names the frame.
        """
        return self.at(range(self.first if first is None else first, self.end if end is None else end))

    def at(
        self, frames: Sequence[int], cameras: Sequence[int] | None = None
    ) -> Iterator[tuple[int, tuple[Image, ...]]]:
        """Iterate over given frames, fastest in ascending order; otherwise like `frames`.

        Args:
            frames: Frame numbers from 0 to `count` - 1.
            cameras: Numbers of the cameras that are decoded; all by default.

        Yields:
            The frame's number and one image per camera.

        Raises:
            FileProblem: A clip is damaged; the message names the frame.
        """
        clips = self.clips if cameras is None else [self.clips[c] for c in cameras]
        feeders = [_Feeder(clip, frames) for clip in clips]
        try:
            for frame in frames:
                yield frame, tuple(feeder.next() for feeder in feeders)
        finally:
            for feeder in feeders:
                feeder.stop()

    def images(self, frame: int) -> tuple[Image, ...]:
        """Decode one frame.

        Args:
            frame: Number of the frame.

        Returns:
            One image per camera.
        """
        return next(iter(self.at([frame])))[1]


class _Feeder:
    """Decodes one clip in a thread, a few images ahead of the consumer."""

    def __init__(self, clip: Clip, frames: Iterable[int]):
        self._ready: queue.Queue[Image | BaseException] = queue.Queue(maxsize=_QUEUE_LENGTH)
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(clip, frames), daemon=True)
        self._thread.start()

    def next(self) -> Image:
        image = self._ready.get()
        if isinstance(image, BaseException):
            raise image
        return image

    def stop(self) -> None:
        self._stopped.set()
        while self._thread.is_alive():
            # A full queue would block the thread before it checks the event.
            try:
                self._ready.get(timeout=0.01)
            except queue.Empty:
                continue
        self._thread.join()

    def _run(self, clip: Clip, frames: Iterable[int]) -> None:
        try:
            for image in clip.images(frames):
                self._ready.put(image)
                if self._stopped.is_set():
                    return
        except BaseException as error:  # it is raised again in `next`
            self._ready.put(error)


def open_take(
    folder: Path,
    rig: Rig,
    *,
    rate: float | None = None,
    frames: tuple[int, int | None] | None = None,
    others: bool = False,
    clocks: Clocks | None = None,
    places: VideoPlaces | None = None,
    timestamps: bool = True,
) -> Take:
    """Open the clips of a rig's cameras, and check that they agree with the calibration and with each other.

    With clocks, the clips may begin and end at different times and have different rates: the pictures nearest to each
    frame are taken, and frames without a picture of each camera are not processed.

    Args:
        folder: Contains `<camera>.mp4` or another container, stills `<camera>_<number>.jpg`, or `images/<camera>.jpg`.
        rig: The cameras.
        rate: Frame rate [Hz], where that of the containers is wrong or missing.
        frames: First frame to process, and the frame after the last one (None: up to the end).
        others: Whether the folder may contain videos of cameras that are not in the rig.
        clocks: The cameras' clocks; None if they have one. With one clock and different or variable frame rates, the
            videos begin at one instant.
        places: Where the videos are; by default in the folder.
        timestamps: Whether the times of the pictures are those of files of timestamps, or of the containers, if the
            rate of one of them varies, rather than those of constant rates.

    Returns:
        The take.

    Raises:
        FileProblem: A clip is missing, damaged or too short, or its size or rate does not agree.
    """
    clips, found = find_fitting_clips(folder, rig, others=others, places=places)
    recorded = recorded_times(folder, rig.names, clips) if timestamps and rate is None else None
    stated = None if recorded is None else recorded.clocks(rig.names)
    note = _DIFFERENT_RATES if recorded is None else _TIMESTAMPS if stated is not None else _VARIABLE
    if clocks is not None:
        return _take_of_clocks(folder, rig.names, clips, clocks, rate, frames, found, recorded)
    if rate is None and (recorded is not None or _of_one_duration(clips)):
        take = _take_of_clocks(folder, rig.names, clips, stated or one_clock(rig.names), rate, frames, found, recorded)
        return replace(take, notes=(note, *take.notes), clocks=stated)
    first, end = frames if frames is not None else (0, None)
    count, notes = _common_count(rig.names, clips, end)
    common_rate, more = _common_rate(folder, rig.names, clips, rate)
    end = count if end is None else end
    if not 0 <= first < end <= count:
        wrong = f"has {count} frames, so the frames from {first} up to {end} (not included) cannot be used"
        raise FileProblem(folder, wrong, f"Give frames from 0 to {count}, the first one before the end.")
    return Take(
        names=rig.names,
        clips=clips,
        rate=common_rate,
        count=count,
        first=first,
        end=end,
        notes=(*found, *notes, *more),
    )


def _take_of_clocks(
    folder: Path,
    names: tuple[str, ...],
    clips: tuple[Clip, ...],
    clocks: Clocks,
    rate: float | None,
    frames: tuple[int, int | None] | None,
    found: tuple[str, ...],
    recorded: RecordedTimes | None = None,
) -> Take:
    times = None if recorded is None else recorded.times
    rates = rates_of_clips(folder, names, clips, rate) if times is None else tuple(map(_usual_rate, times))
    common = common_frames(clocks, [clip.count for clip in clips], rates, times)
    count = common.pictures.shape[1]
    first, end = frames if frames is not None else (0, None)
    first, end = max(first, common.complete[0]), min(count if end is None else end, common.complete[1])
    if not first < end:
        wrong = "has no frame of which all cameras have a picture, according to sync.json"
        raise FileProblem(folder, wrong, "Check the offsets of the cameras in sync.json, or other frames (--frames).")
    missing = [f"{a} to {b - 1}" for a, b in ((0, common.complete[0]), (common.complete[1], count)) if a < b]
    notes = (f"Not all cameras have a picture of the frames {listed(missing)}, which are ignored.",) if missing else ()
    selected = tuple(
        SelectedPictures(clip=clip, pictures=pictures, rate=common.rate)
        for clip, pictures in zip(clips, common.pictures, strict=True)
    )
    return Take(
        names=names, clips=selected, rate=common.rate, count=count, first=first, end=end, notes=(*found, *notes),
        common=common,
    )  # fmt: skip


_DIFFERENT_RATES = (
    "The cameras have different frame rates: their videos are assumed to begin at one instant, unless the silhouettes "
    "show something else."
)
"""Note on a take whose cameras have different rates."""
_TIMESTAMPS = "The pictures are used at the instants that the files of timestamps state."
"""Note on a take with files of timestamps."""
_VARIABLE = "The frame rate of a video varies: its pictures are used at the times that the file states."
"""Note on a take of variable frame rate."""


def one_clock(names: Sequence[str]) -> Clocks:
    """Return the clocks of cameras that were started together and have one clock."""
    zero = np.zeros(len(names))
    return Clocks(names=tuple(names), offset_s=zero, drift=zero, offset_sd_s=zero, drift_sd=zero)


def _usual_rate(times: Floats) -> float:
    """Return the usual frame rate of times (F,) [Hz]."""
    return float(1 / np.median(np.diff(times))) if len(times) > 1 else 1.0


def _of_one_duration(clips: Sequence[Clip]) -> bool:
    """Return whether all clips have rates, of which two differ, and about the same duration."""
    known = [(clip.count, clip.rate) for clip in clips if clip.rate is not None]
    rates = [rate for _, rate in known]
    if len(known) < len(clips) or max(rates) - min(rates) <= RATE_TOLERANCE * max(rates):
        return False
    frames = [count / rate * min(rates) for count, rate in known]
    return max(frames) - min(frames) <= COUNT_TOLERANCE


def open_free_take(
    folder: Path, rig: Rig, *, rate: float | None = None, others: bool = False, places: VideoPlaces | None = None
) -> Take:
    """Open the clips of a rig's cameras of whose clocks nothing is known.

    Args:
        folder: As for `open_take`.
        rig: The cameras.
        rate: Frame rate of all cameras [Hz], where that of the containers is wrong or missing.
        others: Whether the folder may contain videos of cameras that are not in the rig.
        places: Where the videos are; by default in the folder.

    Returns:
        The take, with the rate of the first camera; its clips have their own numbers of pictures and rates.

    Raises:
        FileProblem: A clip is missing or damaged, its size does not agree, or a rate is not known.
    """
    clips, notes = find_fitting_clips(folder, rig, others=others, places=places)
    count, rates = min(clip.count for clip in clips), rates_of_clips(folder, rig.names, clips, rate)
    return Take(names=rig.names, clips=clips, rate=rates[0], count=count, first=0, end=count, notes=notes, is_free=True)


def rates_of_clips(
    folder: Path, names: Sequence[str], clips: Sequence[Clip], rate: float | None = None
) -> tuple[float, ...]:
    """Return the frame rate of each clip, equal ones for rates that agree within `RATE_TOLERANCE`.

    Args:
        folder: The trial.
        names: The cameras.
        clips: One clip per camera.
        rate: Frame rate of all cameras [Hz], where that of the containers is wrong or missing.

    Returns:
        The rates [Hz].

    Raises:
        FileProblem: The rate of a clip is not known.
    """
    if rate is not None:
        return (rate,) * len(clips)
    known = [clip.rate for clip in clips if clip.rate is not None]
    unknown = [name for name, clip in zip(names, clips, strict=True) if clip.rate is None]
    if unknown:
        wrong = f"has no frame rate of {listed(map(repr, unknown))}"
        raise FileProblem(folder, wrong, "Clocks need the frame rate: give rate in trial.toml.")
    return tuple(next(first for first in known if abs(first - own) <= RATE_TOLERANCE * own) for own in known)


def _common_count(names: Sequence[str], clips: Sequence[Clip], end: int | None) -> tuple[int, tuple[str, ...]]:
    """Return the number of frames that all cameras have, with remarks."""
    counts = [clip.count for clip in clips]
    least, most = min(counts), max(counts)
    if least == most:
        return least, ()
    if most - least > COUNT_TOLERANCE and (end is None or end > least):
        shortest = clips[counts.index(least)].path
        each = ", ".join(f"'{name}' {count}" for name, count in zip(names, counts, strict=True))
        wrong = f"has {least} frames and is shorter than the others ({each})"
        remedy = (
            f"Copy it again, select the frames of all cameras with frames = [0, {least}] in trial.toml, or, if the "
            "cameras were not started together, run `marey sync`."
        )
        raise FileProblem(shortest, wrong, remedy)
    return least, (f"The clips have {least} to {most} frames; frames that are not in all clips are ignored.",)


def _common_rate(
    folder: Path, names: Sequence[str], clips: Sequence[Clip], rate: float | None
) -> tuple[float, tuple[str, ...]]:
    """Return the frame rate, the given one or the common one of all containers, with remarks."""
    rates = [clip.rate for clip in clips]
    known = [value for value in rates if value is not None]
    if rate is not None:
        differ = sorted({f"{value:g}" for value in known if abs(value - rate) > RATE_TOLERANCE * rate})
        note = f"The given rate of {rate:g} Hz is used; the containers have {', '.join(differ)} Hz."
        return rate, ((note,) if differ else ())
    if not known:
        several = max(clip.count for clip in clips) > 1
        return 1.0, (("Stills have no frame rate: 1 Hz is assumed. Give rate in trial.toml.",) if several else ())
    if max(known) - min(known) > RATE_TOLERANCE * max(known):
        each = ", ".join(f"'{name}' {value:g}" for name, value in zip(names, rates, strict=True) if value is not None)
        wrong = f"has cameras with different rates ({each} Hz)"
        remedy = "If a container is wrong, give rate in trial.toml; if the rates are right, run `marey sync`."
        raise FileProblem(folder, wrong, remedy)
    return known[0], ()

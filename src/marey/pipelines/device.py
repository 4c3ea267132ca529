"""`marey device`: the clock of a foreign device, and its signals at the frames of a motion."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from marey.arrays import Floats, true_runs
from marey.errors import FileProblem, SettingProblem
from marey.io.devices.results import write_device_clock, write_device_signals
from marey.io.devices.signals import VERTICAL_FORCE, DeviceSignals, read_event_times, read_signals
from marey.io.markers.recordings import find_motion_file, read_recording, recording_of
from marey.motion.device_clock import (
    ClockUndetermined,
    DeviceClock,
    DeviceClockSettings,
    SignalGroup,
    clock_from_events,
    clock_from_signals,
    resampled_signal,
)
from marey.motion.driving import KINDS, SMOOTH_HZ, angular_velocity, driving_signal
from marey.motion.recording import Recording
from marey.pipelines.capture.motion import Motion
from marey.pipelines.labelled import Described, Summary
from marey.pipelines.progress import Progress, RecordingProgress
from marey.pipelines.run_record import finished_together, write_record
from marey.pipelines.verdict import Verdict, VerdictReason, without_result
from marey.wording import listed

DEVICE_RESULTS = ("clock.json", "signals.csv")
"""Files that every run writes, whose names are checked before the work."""
LOADED_SHARE = 0.5
"""Vertical forces below this share of the 90th percentile are not compared: a foot is beside the plates, or the person
in the air. In walking, the force under both feet stays above 60 % of it. Chosen by hand."""
STEPPING_S = 0.15
"""Time after the force has begun, and before it ends, that is not compared either [s]: about the double support, in
which the other foot is beside the plates. In a real walk over three plates, force and acceleration of the pelvis
correlate by 0.95 without these parts and by 0.73 with them."""
FORCE_SD_S = 0.005
"""Standard deviation of the offset from a vertical force beside that of the measurement [s]: the pelvis is not the
centre of mass. In `walk`, with the masses of [deLeva1996], the hips' middle is 4 ms late, and in the real walk
over plates 6 ms. Chosen from both."""
LARGEST_DRIFT, DRIFT_OF_DEVICE_SD = 3e-3, 1e-3
"""Largest difference of the rates that is searched, and its standard deviation before it is measured [s/s]: cameras of
29.97 Hz whose container states 30 Hz differ by 1e-3, quartz clocks by 1e-4. Chosen by hand."""
POOR_CLOCK_FRAMES = 0.5
"""Standard deviation of the device's clock above which it is named [frames]: a signal may belong to another frame."""
_SHOWN_NAMES = 12
"""Number of names that an error lists at most."""
_THIRD_DIFFERENCES = 20.0
"""Variance of the third differences of white noise, relative to its own."""


@dataclass(frozen=True, kw_only=True)
class DeviceOptions:
    """How the clock of a device is estimated."""

    match: tuple[str, ...] = ()
    """Pairs COLUMNS=QUANTITY of the device's signals and what they are compared with; see `parse_match`."""
    events: Path | None = None
    """A table with the instants of the same events on both clocks; then no signals are compared."""
    within_s: float = np.inf
    """Largest difference of both clocks at one instant, where it is known [s]."""


@dataclass(frozen=True, kw_only=True)
class SignalMatch:
    """A device's signal and the quantity of the motion that rises and falls with it."""

    columns: tuple[str, ...]
    """Names of the device's signals."""
    length: bool
    """Whether they are the parts of a vector rather than terms of a sum. With the turning of a segment, the parts are
    compared with its angular velocity, whose axes may be turned against those of the device; else the length counts."""
    kind: str
    """Kind of the quantity; see `marey.motion.driving.KINDS`."""
    name: str
    """Name of the segment, point or angle."""

    @property
    def by_axis(self) -> bool:
        """Whether the parts of the vector are compared, not its length."""
        return self.length and self.kind == "turning"


def parse_match(text: str) -> SignalMatch:
    """Read a pair COLUMNS=QUANTITY.

    Args:
        text: For example `gyro_x,gyro_y,gyro_z=turning:left_shank` (a vector), `Fz1+Fz2=force` (a sum),
            or `goniometer=angle:left_knee_flexion`.

    Raises:
        SettingProblem: It has another form, or the quantity is unknown.
    """
    columns, equals, quantity = text.rpartition("=")
    kind, _, name = quantity.partition(":")
    parts = tuple(part.strip() for part in columns.split("," if "," in columns else "+"))
    if not equals or not all(parts):
        raise SettingProblem(f"The match '{text}' should be COLUMNS=QUANTITY, for example Fz=force (--match).")
    if kind not in KINDS or bool(name) == (kind == "force"):
        wanted = ", ".join(kind if kind == "force" else f"{kind}:NAME" for kind in KINDS)
        raise SettingProblem(f"The quantity of the match '{text}' should be one of: {wanted} (--match).")
    return SignalMatch(columns=parts, length="," in columns, kind=kind, name=name)


class AlignedDevice(Described):
    """A device's clock, and its signals at the frames of a motion.

    Args:
        signals: The device's signals at its own times.
        clock: Its clock.
        frames: (F,) times of the motion's frames [s].
        method: From what the clock was estimated.
        given: The two files, and the options.
        progress: Progress reporter of the run.

    Example:
        >>> import marey
        >>> aligned = marey.align_device("jump01", "jump01.c3d")  # doctest: +SKIP
        >>> aligned.clock.offset_s, aligned.clock.drift  # doctest: +SKIP
    """

    def __init__(
        self, signals: DeviceSignals, clock: DeviceClock, frames: Floats, *, method: str,
        given: tuple[Path | None, Path, DeviceOptions], progress: Progress,
    ):  # fmt: skip
        self._signals, self._method, self._given, self._progress = signals, method, given, progress
        self.clock = clock
        """The device's clock: its time t is the motion's instant t + offset + drift t."""
        self.time = frames
        """(F,) times of the motion's frames [s]."""
        variance = _noise_variance(signals.values)
        found = resampled_signal((signals.time, signals.values), clock, frames, variance=variance)
        self.values, self.variance = found
        """(F, K) signals at the frames, and their variances, in the units of the file."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the K signals."""
        return self._signals.names

    @property
    def verdict(self) -> Verdict:
        """How far the signals at the frames can be used, and what limits it."""
        return Verdict.of([*_covered(self.values), *_poor_clock(self.clock, self.time)])

    def save(self, folder: Path | str) -> Path:
        """Write clock.json, signals.csv and run.json: the same files as `marey device --out folder`.

        Args:
            folder: Folder for the files; it is created if it does not exist.

        Returns:
            The folder.

        Raises:
            FileProblem: The folder cannot be written to.
        """
        out, (motion, file, options) = Path(folder), self._given
        settings = {
            "motion": motion, "signals": file, "match": list(options.match), "events": options.events,
            "within_s": None if np.isinf(options.within_s) else options.within_s,
        }  # fmt: skip
        inputs = [path for path in (motion, file, options.events) if path is not None]
        with finished_together(out, inputs=inputs) as staging:
            write_device_clock(staging / DEVICE_RESULTS[0], self.clock, method=self._method)
            write_device_signals(staging / DEVICE_RESULTS[1], self.time, self.names, self.values, self.variance)
            write_record(
                staging, command="device", settings=settings, inputs=inputs, root=Path.cwd(), progress=self._progress,
                verdict=self.verdict,
            )  # fmt: skip
        return out

    def summary(self) -> Summary:
        """Return the readable description."""
        clock, known = self.clock, int(np.isfinite(self.values).any(1).sum())
        lines = {
            "clock": clock_text(clock),
            "estimated from": f"{self._method} ({clock.used} used)",
            "signals": f"{len(self.names)}, at {known} of {len(self.time)} frames",
        }
        return Summary(f"Signals of {self._given[1].name}", lines)


def _covered(values: Floats) -> tuple[VerdictReason, ...]:
    """Name the frames at which no signal is known."""
    missing = int((~np.isfinite(values).any(1)).sum())
    return without_result(missing, len(values), "have no signal: the device did not record there")


def _poor_clock(clock: DeviceClock, frames: Floats) -> Iterator[VerdictReason]:
    """Name a clock that is known to less than the distance of two frames."""
    step = float(np.median(np.diff(frames))) if len(frames) > 1 else np.inf
    sd = float(np.max(clock.instants_sd(clock.times(frames))))
    if sd > POOR_CLOCK_FRAMES * step:
        what = f"The device's clock is known to {1e3 * sd:.0f} ms only (standard deviation), {sd / step:.1f} frames."
        yield VerdictReason.limit(what, "Match more signals (--match), or give events (--events).")


def clock_text(clock: DeviceClock) -> str:
    """Describe a device's clock in one line."""
    return (
        f"offset {1e3 * clock.offset_s:+.1f} +- {1e3 * clock.offset_sd_s:.1f} ms, drift {1e6 * clock.drift:+.0f} +- "
        f"{1e6 * clock.drift_sd:.0f} ppm"
    )


def align_device(
    motion: Motion | Path | str,
    signals: Path | str,
    *,
    match: Sequence[str] = (),
    events: Path | str | None = None,
    within: float | None = None,
    progress: Progress | None = None,
) -> AlignedDevice:
    """Estimate the clock of a device and resample its signals at the frames of a motion, as `marey device` does.

    Args:
        motion: A motion, a folder of results, or a file (MOT, STO, TRC, C3D, NPZ).
        signals: The file of the device: C3D, MOT, STO, TRC or CSV.
        match: Pairs COLUMNS=QUANTITY of signals that rise and fall together, for example
            `["gyro_x,gyro_y,gyro_z=turning:left_shank"]`; by default the vertical force of the plates of a C3D.
        events: A table of the instants of the same events on both clocks, with the columns `motion_s` and `device_s`.
        within: Largest difference of both clocks at one instant, where it is known [s].
        progress: Progress reporter; by default nothing is shown.

    Returns:
        The clock with standard deviations, and the signals with variances.

    Raises:
        FileProblem: A file cannot be used, or nothing in it determines the clock.
        SettingProblem: A match has another form.

    Example:
        >>> import marey
        >>> aligned = marey.align_device("walk01", "walk01_forces.c3d")  # doctest: +SKIP
        >>> aligned.clock.offset_s, aligned.clock.offset_sd_s  # doctest: +SKIP
    """
    if within is not None and not within > 0:
        raise SettingProblem(f"The largest difference of the clocks is {within:g} s; it should be above 0 (--within).")
    options = DeviceOptions(
        match=tuple(match), events=None if events is None else Path(events), within_s=within or np.inf
    )
    reporter, path = RecordingProgress() if progress is None else progress, Path(signals)
    pairs = [parse_match(text) for text in options.match]
    if isinstance(motion, Motion):
        file, recording = None if motion.folder is None else motion.folder / "motion.npz", recording_of(motion.data)
    else:
        file = find_motion_file(Path(motion))
        recording = read_recording(file)
    with reporter.stage("Reading"):
        device = read_signals(path)
    with reporter.stage("Clock"):
        try:
            if options.events is not None:
                method, clock = "events", clock_from_events(*read_event_times(options.events))
            else:
                pairs = pairs or [_default_match(path, device)]
                method, clock = "signals", _clock_of(path, device, recording, pairs, options.within_s)
        except ClockUndetermined as problem:
            wrong = f"does not determine a clock: {str(problem).partition(': ')[2].rstrip('.')}"
            remedy = "Match other signals (--match), or give the instants of the same events (--events)."
            raise FileProblem(path if options.events is None else options.events, wrong, remedy) from None
    given = file, path, options
    return AlignedDevice(device, clock, recording.time, method=method, given=given, progress=reporter)


def _default_match(path: Path, device: DeviceSignals) -> SignalMatch:
    if VERTICAL_FORCE in device.names:
        return SignalMatch(columns=(VERTICAL_FORCE,), length=False, kind="force", name="")
    has = f"has no force plates; its signals are {listed(device.names, most=_SHOWN_NAMES)}"
    raise FileProblem(path, has, "State what they measure, for example --match knee=angle:left_knee_flexion.")


def _clock_of(
    path: Path, device: DeviceSignals, motion: Recording, pairs: Sequence[SignalMatch], within_s: float
) -> DeviceClock:  # fmt: skip
    """Estimate the clock from matched signals."""
    measured, own = zip(*(_compared(path, device, motion, pair) for pair in pairs), strict=True)
    groups = [SignalGroup(own=a, device=b) for a, b in zip(_side_by_side(own), _side_by_side(measured), strict=True)]
    signals, times = np.concatenate(measured, axis=1), device.time
    known = np.flatnonzero(np.isfinite(signals).any(axis=1))
    if not len(known):
        raise ClockUndetermined("the device has no known sample.")
    used = slice(known[0], known[-1] + 1)
    # Both clocks count from the beginning of what the device shows, which keeps the error of the drift small.
    begin, start = float(motion.time[0]), float(times[used][0])
    settings = DeviceClockSettings(
        smooth_hz=SMOOTH_HZ, largest_drift=LARGEST_DRIFT, drift_sd=DRIFT_OF_DEVICE_SD,
        offsets=(begin - start - within_s, begin - start + within_s),
        # Whoever states how far apart the clocks are also states that the signals belong together.
        chance=DeviceClockSettings().chance if np.isinf(within_s) else 1.0,
    )  # fmt: skip
    cameras = motion.time - begin, np.concatenate(own, axis=1)
    clock = clock_from_signals(cameras, (times[used] - start, signals[used]), groups=groups, settings=settings)
    if any(pair.kind == "force" for pair in pairs):
        clock = replace(clock, covariance=clock.covariance + np.diag([FORCE_SD_S**2, 0.0]))
    return _of_other_zeros(clock, begin, start)


def _compared(path: Path, device: DeviceSignals, motion: Recording, pair: SignalMatch) -> tuple[Floats, Floats]:
    """Return the device's signals (N, L) of a match, and those of the motion (F, K) that are linear in them."""
    missing = [name for name in pair.columns if name not in device.names]
    if missing:
        has = f"has no signal {listed(map(repr, missing))}"
        raise FileProblem(path, has, f"It has {listed(device.names, most=_SHOWN_NAMES)} (--match).")
    columns = device.values[:, [device.names.index(name) for name in pair.columns]]
    if pair.by_axis:
        return columns, angular_velocity(motion, pair.name)
    signal = np.linalg.norm(columns, axis=1) if pair.length else columns.sum(axis=1)
    signal = _loaded(signal, device.time) if pair.kind == "force" else signal
    return signal[:, None], driving_signal(motion, pair.kind, pair.name)[:, None]


def _side_by_side(parts: Sequence[Floats]) -> list[tuple[int, ...]]:
    """Return the columns of each of several arrays after they were put side by side."""
    ends = np.cumsum([part.shape[1] for part in parts]).tolist()
    return [tuple(range(end - part.shape[1], end)) for part, end in zip(parts, ends, strict=True)]


def _of_other_zeros(clock: DeviceClock, begin_s: float, start_s: float) -> DeviceClock:
    """Return the clock of a device whose times are later by `start_s`, and the motion's by `begin_s`."""
    wrt = np.array([[1.0, -start_s], [0.0, 1.0]])
    return DeviceClock(
        offset_s=clock.offset_s + begin_s - (1 + clock.drift) * start_s, drift=clock.drift,
        covariance=wrt @ clock.covariance @ wrt.T, used=clock.used,
    )  # fmt: skip


def _loaded(force: Floats, time: Floats) -> Floats:
    """Return a vertical force (N,) with NaN where the plates carry only a part of the person."""
    size, out = np.abs(np.nan_to_num(force)), np.full(len(force), np.nan)
    usual = float(np.percentile(size[size > 0], 90)) if size.any() else np.inf
    for first, end in true_runs(size > LOADED_SHARE * usual):
        begin_s = time[first] + (STEPPING_S if first else 0.0)
        end_s = time[end - 1] - (STEPPING_S if end < len(force) else 0.0)
        kept = (time >= begin_s) & (time <= end_s)
        out[kept] = size[kept]
    return out


def _noise_variance(values: Floats) -> Floats:
    """Return the variance (K,) of one sample from third differences, which slow signals hardly change."""
    steps = np.diff(values, n=3, axis=0)
    return np.asarray(np.nanmean(steps**2, axis=0) / _THIRD_DIFFERENCES)

"""`marey compare`: the agreement of two motions, as numbers and plots."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem, MareyError, SettingProblem
from marey.extras import import_optional
from marey.io.markers.recordings import find_motion_file, read_recording, recording_of
from marey.io.results.comparison import SIGNED_KINDS, UNITS, write_comparison
from marey.motion.comparison import Agreement, MotionComparison, NoCommonTime
from marey.motion.device_clock import ClockUndetermined
from marey.motion.recording import Recording
from marey.pipelines.capture.motion import Motion
from marey.pipelines.causes.motions import motion_reasons
from marey.pipelines.clocks.compared import beyond_intervals, compare_defined, comparison_verdict
from marey.pipelines.labelled import Curve, Described, Summary, find_name, plot_curves
from marey.pipelines.progress import Progress, RecordingProgress
from marey.pipelines.run_details import page_head
from marey.pipelines.run_record import finished_together, write_record
from marey.pipelines.same_names import read_name_map, same_names
from marey.pipelines.verdict import Verdict, VerdictReason
from marey.view.pages.comparison_report import write_comparison_report
from marey.wording import count_of, listed

_SHOWN_NAMES = 8
"""Names of a motion that an error lists at most."""
_SHOWN_LEFT_OVER = 12
"""Names of quantities without a counterpart that a warning lists at most."""
_CLOCKS = ("offset", "rate")
"""What may be estimated of the second clock."""
_FILE = "compare.csv"
"""The file with one row per compared quantity."""
COMPARE_RESULTS = (_FILE, "report.html")
"""Files that every run writes, whose names are checked before the work."""


@dataclass(frozen=True, kw_only=True)
class CompareOptions:
    """Settings of a comparison."""

    named: Path | None = None
    """A TOML file with the names of the same quantities in both motions."""
    shift_s: float | None = None
    """The second clock minus the first, where it is known [s]."""
    clock: str = "offset"
    """What is estimated of the second clock: `offset`, or `rate` for offset and rate."""
    same_laboratory: bool = False
    """Whether both motions are in one laboratory, so that no rigid offset is estimated."""

    def __post_init__(self) -> None:
        if self.shift_s is not None and not np.isfinite(self.shift_s):
            raise SettingProblem(f"shift (--shift) is {self.shift_s}; it should be a time in seconds.")


@dataclass(frozen=True, eq=False, kw_only=True)
class ComparedMotion:
    """One of the two motions."""

    given: str
    """What the user gave: a file, a folder, or a description of a motion in memory."""
    file: Path | None
    """The file; None for a motion in memory."""
    label: str
    """Name of the motion in the report."""
    recording: Recording


class Comparison(Described):
    """The agreement of two motions: one row per angle, point and segment.

    Args:
        data: Both motions over common times, their alignment and agreement.
        motions: The two motions.
        options: Settings of the comparison.
        progress: Progress reporter of the run, with its timings and warnings.
        causes: Why the motions do not agree, if it is known.

    Example:
        >>> import marey
        >>> comparison = marey.compare("walk01", "walk01/marey/joint_centres.trc")
        >>> row = comparison["left knee distance"]
        >>> row.kind, row.unit
        ('distance', 'm')
    """

    def __init__(
        self, data: MotionComparison, motions: tuple[ComparedMotion, ComparedMotion], options: CompareOptions,
        progress: Progress, causes: Sequence[VerdictReason] = (),
    ):  # fmt: skip
        self._data, self._motions, self._options, self._progress = data, motions, options, progress
        self._causes = tuple(causes)

    @property
    def labels(self) -> tuple[str, str]:
        """The names of both motions."""
        return self._motions[0].label, self._motions[1].label

    @property
    def data(self) -> MotionComparison:
        """Both motions over common times, their alignment and agreement."""
        return self._data

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the compared quantities."""
        return tuple(row.name for row in self._data.agreements)

    @property
    def shift_s(self) -> float:
        """The second clock minus the first [s]."""
        return self._data.alignment.shift_s

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings of the run, one sentence each."""
        return tuple(self._progress.warnings)

    def __getitem__(self, name: str) -> Agreement:
        """Return how one quantity agrees.

        Raises:
            UnknownName: It was not compared.
        """
        return self._data.agreements[find_name(name, self.names, kind="compared quantity")]

    def __len__(self) -> int:
        """Return the number of compared quantities."""
        return len(self._data.agreements)

    def to_pandas(self) -> Any:
        """Return a `pandas.DataFrame` with one row per quantity, as in `compare.csv`.

        Angles are in degrees, positions and distances in millimetres.

        Raises:
            MissingPackage: pandas is not installed.
        """
        pandas = import_optional("pandas", extra="pandas", purpose="Tables")
        rows = []
        for row in self._data.agreements:
            unit, factor = UNITS[row.kind]
            low, high = row.limits if row.kind in SIGNED_KINDS else (np.nan, np.nan)
            numbers = {"rms": row.rms, "bias": row.bias, "sd": row.sd, "limit_low": low, "limit_high": high}
            rows.append(
                {"quantity": row.name, "kind": row.kind, "unit": unit, "frames": row.frames}
                | {name: factor * value for name, value in numbers.items()}
                | {"correlation": row.correlation, "within_stated_95": row.within_stated}
            )
        return pandas.DataFrame(rows).set_index("quantity")

    def plot(self, name: str, *, axes: Any = None) -> Any:
        """Draw one angle of both motions over time.

        Args:
            name: Name of the angle.
            axes: Matplotlib's axes to draw on; new ones by default.

        Returns:
            The axes.

        Raises:
            UnknownName: There is no such angle in both motions.
            MissingPackage: Matplotlib is not installed.
        """
        curves = []
        for label, recording in zip(self.labels, (self._data.first, self._data.second), strict=True):
            i = find_name(name, recording.angle_names, kind="angle")
            values = np.degrees(recording.angles[:, i])
            curves.append(Curve(name=label, time=self._data.time, values=values, unit="deg"))
        return plot_curves(curves, axes=axes)

    @property
    def verdict(self) -> Verdict:
        """How far the comparison can be used, and what limits it."""
        return comparison_verdict(self._data, self._causes)

    def save(self, folder: Path | str) -> Path:
        """Write compare.csv, report.html and run.json: the same files as `marey compare --out folder`.

        Args:
            folder: Folder for the files; it is created if it does not exist.

        Returns:
            The folder.

        Raises:
            FileProblem: The folder cannot be written to.
        """
        out, options, progress = Path(folder), self._options, self._progress
        settings = {
            "first": self._motions[0].given, "second": self._motions[1].given, "map": options.named,
            "shift_s": options.shift_s, "clock": options.clock, "same_laboratory": options.same_laboratory,
        }  # fmt: skip
        files = (*(motion.file for motion in self._motions), options.named)
        inputs = [path for path in files if path is not None]
        with finished_together(out, inputs=inputs) as staging:
            write_comparison(staging / _FILE, self._data)
            write_comparison_report(
                staging / "report.html", self._data, names=self.labels, notes=progress.warnings, settings=settings,
                head=page_head("compare", self.verdict),
            )  # fmt: skip
            write_record(
                staging, command="compare", settings=settings, inputs=inputs, root=Path.cwd(), progress=progress,
                verdict=self.verdict,
            )  # fmt: skip
        return out

    def summary(self) -> Summary:
        """Return the readable description."""
        data = self._data
        lines = {"frames": frames_text(data)}
        lines["time shift"] = f"{1e3 * self.shift_s:.1f} ms" + _spread(1e3 * data.alignment.shift_sd_s, " ms")
        all_together = {each.kind: each for each in data.together}
        if angles := all_together.get("angles"):
            lines["angles"] = f"{angles.count}, RMS difference {np.degrees(angles.rms):.2f} deg"
        if points := all_together.get("points"):
            lines["points"] = f"{points.count}, RMS distance {1e3 * points.rms:.1f} mm"
        if self.warnings:
            lines["warnings"] = count_of(len(self.warnings), "warning") + ", see .warnings"
        return Summary(f"Comparison of {self.labels[0]} and {self.labels[1]}", lines)


def comparison_folder(first: Path, second: Path) -> Path:
    """Return the default folder of a comparison, named after both motions.

    Args:
        first: A file, or a folder of results.
        second: Another one.
    """
    return Path(f"{_label(first)}_compared_with_{_label(second)}")


def compare_files(first: Path, second: Path, options: CompareOptions, progress: Progress) -> Comparison:
    """Compare the motions of two files.

    Args:
        first: A file, or a folder of results.
        second: Another one; differences are the first minus the second.
        options: Settings of the comparison.
        progress: Progress reporter.

    Returns:
        The comparison, which is not saved yet.

    Raises:
        FileProblem: A file cannot be read, or the two have nothing in common.
    """
    find_motion_file(first), find_motion_file(second)
    chosen = {} if options.named is None else read_name_map(options.named)
    with progress.stage("Reading"):
        motions = _opened(first), _opened(second)
    return _compared(motions, chosen, options, progress)


def _opened(motion: Motion | Path | str) -> ComparedMotion:
    """Open a motion that is compared."""
    if isinstance(motion, Motion):
        file = None if motion.folder is None else motion.folder / "motion.npz"
        label = "motion" if file is None else _label(file)
        return ComparedMotion(
            given=label if file is None else str(file), file=file, label=label, recording=recording_of(motion.data)
        )
    file = find_motion_file(Path(motion))
    return ComparedMotion(given=str(motion), file=file, label=_label(Path(motion)), recording=read_recording(file))


def _compared(
    motions: tuple[ComparedMotion, ComparedMotion], chosen: Mapping[str, Mapping[str, str]], options: CompareOptions,
    progress: Progress,
) -> Comparison:  # fmt: skip
    if options.clock not in _CLOCKS:
        raise SettingProblem(f"The clock is '{options.clock}'. It may be: {', '.join(_CLOCKS)} (--clock).")
    if options.clock == "rate" and options.shift_s is not None:
        raise SettingProblem("The shift is given (--shift), so the rate cannot be estimated. Leave out --clock rate.")
    own, other = same_names(motions[0].recording, motions[1].recording, chosen, options.named)
    with progress.stage("Comparing"):
        try:
            result = compare_defined(
                own, other, shift_s=options.shift_s, same_laboratory=options.same_laboratory,
                free_rate=options.clock == "rate",
            )  # fmt: skip
        except ClockUndetermined as problem:
            remedy = "Estimate the offset alone (--clock offset), or give it (--shift)."
            wrong = f"cannot be compared ({str(problem).rstrip('.')})"
            raise FileProblem(motions[1].given, wrong, remedy) from None
        except NoCommonTime as problem:
            remedy = "Give another shift (--shift), or other motions."
            raise FileProblem(motions[1].given, f"cannot be compared ({str(problem).rstrip('.')})", remedy) from None
        except MareyError as problem:
            wrong = _nothing(own, other, str(problem))
            remedy = "Name the quantities that are the same in a TOML file: names (--map)."
            raise FileProblem(motions[1].given, wrong, remedy) from None
    causes: tuple[VerdictReason, ...] = ()
    if result.clock is None:
        with progress.stage("Causes"):
            causes = motion_reasons(
                own, other, result, shift_s=options.shift_s, same_laboratory=options.same_laboratory
            )  # fmt: skip
    for note in notes_of(result, causes):
        progress.warn(note)
    return Comparison(result, motions, options, progress, causes)


def compare(
    first: Motion | Path | str,
    second: Motion | Path | str,
    *,
    names: Path | str | Mapping[str, Mapping[str, str]] | None = None,
    shift: float | None = None,
    clock: str = "offset",
    same_laboratory: bool = False,
    progress: Progress | None = None,
) -> Comparison:
    """Compare two motions, as the command `marey compare` does.

    The shift of the clocks and the rigid offset of the laboratories are estimated first.

    Args:
        first: A motion, a folder of results, or a file (MOT, STO, TRC, C3D, NPZ).
        second: Another one; differences are the first minus the second.
        names: Names of the same quantities in both motions, as a TOML file or as a mapping:
            `{"angles": {"name in A": "name in B"}}`.
        shift: The second clock minus the first, where it is known [s].
        clock: `offset`, or `rate` to estimate the rate of the second clock too, as for a device of its own.
        same_laboratory: Both motions are in one laboratory: no rigid offset is estimated.
        progress: Progress reporter; by default nothing is shown.

    Returns:
        The agreement of every angle, point and segment that both motions have.

    Raises:
        FileProblem: A file cannot be read, or the two motions have nothing in common.
        SettingProblem: The clock is neither `offset` nor `rate`, or the shift is given with `rate`.

    Example:
        >>> import marey
        >>> comparison = marey.compare("walk01", "walk01/marey/angles.mot")
        >>> abs(comparison.shift_s) < 1e-6
        True
    """
    path = Path(names) if isinstance(names, str | Path) else None
    chosen = {} if names is None else names if isinstance(names, Mapping) else read_name_map(Path(names))
    options = CompareOptions(named=path, shift_s=shift, clock=clock, same_laboratory=same_laboratory)
    reporter = RecordingProgress() if progress is None else progress
    with reporter.stage("Reading"):
        motions = _opened(first), _opened(second)
    return _compared(motions, chosen, options, reporter)


def _label(path: Path) -> str:
    """Return the name of a motion: that of its file, or of the folder with its results."""
    path = path.resolve()
    if path.name in ("motion.npz", "bones.npz"):
        path = path.parent
    if path.name == "marey":
        path = path.parent
    return path.name if path.is_dir() else path.stem


def _nothing(first: Recording, second: Recording, problem: str) -> str:
    has = " and ".join(
        f"{which} has {', '.join([*r.angle_names, *r.point_names, *r.segment_names][:_SHOWN_NAMES])}, ..."
        for which, r in (("the first motion", first), ("the second", second))
    )
    return f"cannot be compared ({problem.rstrip('.')}); {has}"


def notes_of(result: MotionComparison, causes: Sequence[VerdictReason] = ()) -> list[str]:
    """Return warnings that are needed to interpret the figures."""
    notes = [str(reason) for reason in comparison_verdict(result, causes).reasons]
    if beyond := beyond_intervals(result):
        shares = [f"{row.name.replace('_', ' ')} ({100 * row.within_stated:.0f} % within)" for row in beyond]
        shown = listed(shares, most=_SHOWN_LEFT_OVER)
        notes.append(f"Differences mostly larger than the stated 95 % intervals: {shown}.")
    most = result.compared_frames[1]
    if most < len(result.time):
        left_out = f"{len(result.time) - most} of {len(result.time)} frames in both motions"
        notes.append(f"{left_out} are not compared, because one motion has no values there.")
    for which, names in (("first", result.only_first), ("second", result.only_second)):
        if names:
            notes.append(f"Only in the {which} motion, not compared: {listed(names, most=_SHOWN_LEFT_OVER)}.")
    return notes


def comparison_text(result: MotionComparison) -> list[str]:
    """Describe the result of a comparison in a few lines."""
    alignment, lines = result.alignment, []
    lines.append(f"Frames: {frames_text(result)}.")
    lines.append(shift_text(alignment.shift_s, alignment.shift_sd_s))
    if result.clock is not None:
        clock = result.clock
        lines.append(
            f"Clock of the second: time t is {1e3 * clock.offset_s:.1f} ms (sd {1e3 * clock.offset_sd_s:.2g} ms) + "
            f"(1 {clock.drift:+.6f}) t (sd {1e6 * clock.drift_sd:.2g} ppm) on the first clock."
        )
    lines.extend(offset_text(result))
    for row in result.agreements:
        if row.kind == "angle" and row.frames:
            low, high = np.degrees(row.limits)
            lines.append(
                f"{row.name}: RMS {np.degrees(row.rms):.2f} deg, bias {np.degrees(row.bias):+.2f}, limits of agreement "
                f"{low:+.2f} to {high:+.2f}{_correlation(row.correlation)}"
            )
    apart = [row for row in result.agreements if row.kind == "distance" and row.frames]
    if apart:
        last = max(apart, key=lambda row: row.rms)
        lines.append(f"Largest distance: {last.name.removesuffix(' distance')}, {1e3 * last.rms:.1f} mm (RMS).")
    return lines


def frames_text(result: MotionComparison) -> str:
    """Describe how many frames of the common time are compared."""
    least, most = result.compared_frames
    common, span = len(result.time), f"{result.time[-1] - result.time[0]:.2f} s"
    if least == common:
        return f"{common} in common, {span}"
    number = f"{most}" if least == most else f"{least} to {most}"
    return f"{number} compared, of {common} in common, {span}"


def _correlation(value: float) -> str:
    return f", correlation {value:.3f}" if np.isfinite(value) else ""


def shift_text(shift: float, sd: float) -> str:
    """Describe the shift of the clocks."""
    return f"Time shift (second clock minus first): {1e3 * shift + 0.0:.1f} ms{_spread(1e3 * sd, ' ms')}."


def offset_text(result: MotionComparison) -> list[str]:
    """Describe the rigid offset of the laboratories, in one or two sentences."""
    alignment = result.alignment
    if not (result.first.point_names or result.first.segment_names):
        return []
    turn = np.degrees(np.linalg.norm(alignment.first_from_second.rotation_vector))
    spread = _spread(_deg(alignment.turn_sd), " degrees")
    text = f"Room axes: those of the second are rotated by {turn:.2f} degrees{spread}"
    if not result.first.point_names:
        return [f"{text}."]
    place = ", ".join(f"{v:.1f}" for v in np.round(1e3 * alignment.first_from_second.translation, 1) + 0.0)
    return [
        f"{text} and translated by ({place}) mm{_spread(_mm(alignment.translation_sd), ' mm')} in the first.",
        f"Distance of the common points: {1e3 * alignment.residual_m:.1f} mm (RMS).",
    ]


def _deg(sd: Floats) -> float:
    return float(np.degrees(np.max(sd)))


def _mm(sd: Floats) -> float:
    return float(1e3 * np.max(sd))


def _spread(sd: float, unit: str) -> str:
    return f" (sd {sd:.2g}{unit})" if np.isfinite(sd) else ""

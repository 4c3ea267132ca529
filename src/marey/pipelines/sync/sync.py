"""`marey sync`: the clocks of a trial's cameras from what they show in common."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from marey.cameras.clocks import Clocks
from marey.errors import FileProblem
from marey.fit.clocks.estimate import ClockEstimate, estimate_clocks
from marey.fit.clocks.signals import EpipolarSignal
from marey.fit.clocks.sounds import combined
from marey.io.atomic import require_place
from marey.io.trial.clocks import CLOCKS_FILE, clocks_table, require_replaceable_clocks, write_clocks
from marey.io.trial.trial import Trial
from marey.io.video.take import rates_of_clips
from marey.io.video.timestamps import recorded_times
from marey.pipelines.capture.run import require_two_cameras
from marey.pipelines.progress import Progress
from marey.pipelines.sync.measurements import heard_clocks, key_point_signals, lit_clocks, silhouette_signals
from marey.pipelines.sync.settings import SyncSettings
from marey.pipelines.verdict import Verdict, VerdictReason


@dataclass(frozen=True, eq=False, kw_only=True)
class Synchronisation:
    """The clocks of a trial's cameras, and how they were found.

    Example:
        >>> import marey
        >>> found = marey.synchronise("walk01")  # doctest: +SKIP
        >>> print(found)  # doctest: +SKIP
        cam01: the clock to which the others are compared
        cam02: +12.4 +- 0.3 ms, +0.37 frames; drift +41 +- 30 ppm
    """

    clocks: Clocks
    """The clocks of all cameras that could be determined, from all sources together."""
    undetermined: Mapping[str, str]
    """Reasons why the clocks of the other cameras could not be determined."""
    sources: Mapping[str, ClockEstimate]
    """The estimate from each source alone."""
    rates: Mapping[str, float]
    """Frame rate of each camera [Hz]."""
    verdict: Verdict = field(default_factory=Verdict)
    """How far the clocks can be used, and what limits it."""

    def __str__(self) -> str:
        lines = [
            f"{name}: {1000 * offset:+.1f} +- {1000 * sd:.1f} ms, {offset * self.rates[name]:+.2f} frames; drift "
            f"{1e6 * drift:+.0f} +- {1e6 * drift_sd:.0f} ppm"
            for name, offset, sd, drift, drift_sd in zip(
                self.clocks.names, self.clocks.offset_s, self.clocks.offset_sd_s, self.clocks.drift,
                self.clocks.drift_sd, strict=True,
            )
        ]  # fmt: skip
        lines[0] = f"{self.clocks.names[0]}: the clock to which the others are compared"
        return "\n".join([*lines, *(f"{name}: not determined, {why}" for name, why in self.undetermined.items())])

    def save(self, path: Path | str) -> None:
        """Write the clocks to a file, in the form of sync.json."""
        sources = {
            name: {"cameras": clocks_table(each.clocks), "undetermined": each.undetermined}
            | ({} if np.isnan(each.residual_px) else {"residual_px": round(each.residual_px, 3)})
            for name, each in self.sources.items()
        }
        write_clocks(
            path, self.clocks, undetermined=dict(self.undetermined), sources=sources, rates=dict(self.rates),
            verdict=self.verdict.as_record(),
        )  # fmt: skip


def synchronise_trial(trial: Trial, settings: SyncSettings, progress: Progress) -> Synchronisation:
    """Estimate the clocks of a trial's cameras, and write them.

    Args:
        trial: The trial, opened by `read_free_trial` with `settings.changes()`.
        settings: Settings of the run.
        progress: Progress reporter.

    Returns:
        The clocks, which are in `settings.out`, or in `sync.json` in the trial.

    Raises:
        FileProblem: No camera's clock can be determined; then nothing is written.
    """
    require_two_cameras(trial)
    path = settings.out or trial.folder / CLOCKS_FILE
    require_replaceable_clocks(path)
    require_place(path)
    names, clips = trial.rig.names, trial.take.clips
    rates = rates_of_clips(trial.folder, names, clips, trial.settings.rate)
    recorded = recorded_times(trial.folder, names, clips) if trial.settings.rate is None else None
    regular = [np.arange(clip.count) / rate for clip, rate in zip(clips, rates, strict=True)]
    times = regular if recorded is None else recorded.times
    signals, lit = _signals(trial, progress), lit_clocks(trial, times, progress)
    with progress.stage("Clocks"):
        sources = {
            source: estimate_clocks(names, times, [signal for signal in signals if signal.source == source])
            for source in dict.fromkeys(signal.source for signal in signals)
        }
        joint = next(iter(sources.values())) if len(sources) == 1 else estimate_clocks(names, times, signals)
        seen, reasons = joint.clocks, list[VerdictReason]()
        for source, other in (("sound", heard_clocks(trial)), ("light", lit)):
            if other is not None:
                reasons += _contradictions(seen, other.clocks, source)
                sources, joint = sources | {source: other}, combined([joint, other], names)
    if len(joint.undetermined) == len(names) - 1:
        raise FileProblem(trial.folder, f"does not determine the clocks: {_why(joint.undetermined)}", _REMEDY)
    reasons += [
        VerdictReason.limit(f"The clock of {name} is not determined: {why}.", _REMEDY, cameras=[name])
        for name, why in joint.undetermined.items()
    ]
    for reason in reasons:
        progress.warn(reason.what)
    by_name = dict(zip(names, rates, strict=True))
    found = Synchronisation(
        clocks=joint.clocks, undetermined=joint.undetermined, sources=sources, rates=by_name,
        verdict=Verdict.of([*reasons, *_poorly_known(joint.clocks, by_name)]),
    )  # fmt: skip
    found.save(path)
    return found


CONTRADICTION_SD = 4.0
"""Number of standard deviations by which the offsets from sound or light and silhouettes may differ. Chosen by hand."""


POOR_FRAMES = 0.5
"""Standard deviation of an offset above which it is named [frames]: the nearest picture may then be another one."""


def _poorly_known(clocks: Clocks, rates: Mapping[str, float]) -> Iterator[VerdictReason]:
    """Name the clocks that are known to less than the distance of two pictures."""
    for name, sd in zip(clocks.names, clocks.offset_sd_s, strict=True):
        frames = sd * rates[name]
        if frames > POOR_FRAMES:
            what = f"The clock of {name} is known to {frames:.1f} frames only (standard deviation)."
            yield VerdictReason.limit(what, _REMEDY, cameras=[name])


def _contradictions(seen: Clocks, other: Clocks, source: str) -> Iterator[VerdictReason]:
    """Name the cameras whose sound, or changes of the light, show other offsets than their silhouettes."""
    for name in [name for name in other.names[1:] if name in seen.names]:
        k, own = seen.names.index(name), other.names.index(name)
        apart = seen.offset_s[k] - other.offset_s[own]
        if abs(apart) > CONTRADICTION_SD * np.hypot(seen.offset_sd_s[k], other.offset_sd_s[own]):
            way, than = "earlier" if apart > 0 else "later", "pictures" if source == "sound" else "motion"
            what = f"The {source} of {name} is {1000 * abs(apart):.0f} ms {way} than its {than}."
            yield VerdictReason.limit(what, f"Check the {source} of this video, or cut it out.", cameras=[name])


_REMEDY = "Film somebody who walks through the view of all cameras, or give key points (--keypoints)."
"""Remedy in the error message if no clock is determined."""


def _why(reasons: Mapping[str, str]) -> str:
    return "; ".join(f"of {name}, {why}" for name, why in reasons.items())


def _signals(trial: Trial, progress: Progress) -> Sequence[EpipolarSignal]:
    """Measure everything that the trial offers; without images of the empty room, key points alone if there are any."""
    joints = [] if trial.keypoints is None else key_point_signals(trial, progress)
    plain = bool(trial.masks or trial.evidence) or len(trial.background) == len(trial.rig)
    return joints if joints and not plain else [*silhouette_signals(trial, progress), *joints]

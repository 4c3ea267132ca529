"""Problems of a captured motion, listed as sentences: lost frames, poor agreement, undetermined angles."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from marey.arrays import Mask, true_runs
from marey.motion.motion import FILLED, LOST, MEASURED, NO_PERSON, BodyMotion
from marey.wording import count_of

Severity = Literal["problem", "caution", "note"]
"""How much a finding limits the use of a result, the gravest first."""
SEVERITIES: tuple[Severity, ...] = ("problem", "caution", "note")
"""All severities, the gravest first."""
LOW_AGREEMENT = 0.80
"""Intersection over union below which the overlay shows a limb beside its image; judged by eye on overlays."""
SHOWN_RUNS = 6
"""Number of runs of frames that a sentence names; chosen by hand."""
ALWAYS = 0.995
"""Share of frames above which an angle is reported as never determined; chosen by hand."""


@dataclass(frozen=True, kw_only=True)
class Problem:
    """One finding that a reader of the results should know."""

    severity: Severity
    """problem: a result is missing or wrong; caution: a result needs care in its use; note: background information."""
    where: str
    what: str


def find_problems(
    motion: BodyMotion, *, cut: Mask | None = None, warnings: Sequence[str] = (), usable: Mask | None = None
) -> list[Problem]:
    """List the problems of a motion, the gravest first.

    Args:
        motion: The captured motion.
        cut: (F, C) true where the border of the image cuts the person.
        warnings: Warnings of the run.
        usable: (F,) the selected frames; all by default.

    Returns:
        An empty list if there is no problem.
    """
    usable = np.ones(len(motion), bool) if usable is None else usable
    found = [
        *_states(motion, usable),
        *_agreements(motion),
        *_undetermined(motion),
        *_borders(motion, cut),
        *(Problem(severity="note", where="run", what=text) for text in warnings),
    ]
    return sorted(found, key=lambda problem: SEVERITIES.index(problem.severity))


def _states(motion: BodyMotion, usable: Mask) -> list[Problem]:
    texts: tuple[tuple[int, Severity, str], ...] = (
        (LOST, "problem", "The person was lost in these frames; the results contain no pose here."),
        (
            FILLED,
            "caution",
            "These frames were not measured. They were interpolated between their neighbours and are flagged.",
        ),
        (NO_PERSON, "note", "No person detected; the results contain no pose here."),
    )
    found = []
    for state, severity, what in texts:
        where = (motion.state == state) & usable
        if where.any():
            found.append(Problem(severity=severity, where=frames_text(where), what=what))
    if not (motion.state == MEASURED).any():
        found.append(Problem(severity="problem", where="whole recording", what="No frame could be measured."))
    return found


def _agreements(motion: BodyMotion) -> list[Problem]:
    found = []
    for c, name in enumerate(motion.camera_names):
        values = motion.agreement[:, c]
        known = np.isfinite(values)
        if not known.any():
            found.append(
                Problem(severity="caution", where=name, what="No person detected in this camera in any frame.")
            )
            continue
        median = float(np.median(values[known]))
        if median < LOW_AGREEMENT:
            what = (
                f"Surface and silhouette agree poorly in the whole recording (median {median:.2f}). Check the overlay."
            )
            found.append(Problem(severity="problem", where=name, what=what))
            continue
        low = known & (values < LOW_AGREEMENT)
        if low.any():
            what = f"Surface and silhouette agree poorly (down to {values[low].min():.2f}): {frames_text(low)}."
            found.append(Problem(severity="caution", where=name, what=what))
    return found


def _undetermined(motion: BodyMotion) -> list[Problem]:
    measured = motion.state == MEASURED
    if not measured.any():
        return []
    share = _undetermined_shares(motion, measured)
    kind = "angle" if motion.angles_determined is not None else "coordinate"
    always = [name for name, part in share.items() if part > ALWAYS]
    partly = [f"{name} ({100 * part:.0f} %)" for name, part in share.items() if 0 < part <= ALWAYS]
    texts = (
        ("Not determined by the images in any frame", always),
        ("Not determined by the images in part of the recording (share of the frames)", partly),
    )
    follows = (
        "There the values follow from typical postures and neighbouring frames, or are those of one of two postures "
        "that explain the images; do not use them as measurements"
    )
    return [
        Problem(severity="caution", where=count_of(len(group), kind), what=f"{text}: {', '.join(group)}. {follows}.")
        for text, group in texts
        if group
    ]


def _undetermined_shares(motion: BodyMotion, measured: Mask) -> dict[str, float]:
    """Return for each angle with values the share of the measured frames (F,) that do not determine it.

    The angles have the names of the plots. Where it is not known for angles, the coordinates of the skeleton are named.
    """
    if motion.angles_determined is None:
        names, known, determined = motion.coordinate_names, motion.coordinates, motion.determined
    else:
        names, known, determined = motion.angle_names, motion.angles_deg, motion.angles_determined
    there = np.flatnonzero(np.isfinite(known[measured]).any(0))
    return {readable(names[i]): float(1 - determined[measured, i].mean()) for i in there}


def _borders(motion: BodyMotion, cut: Mask | None) -> list[Problem]:
    if cut is None:
        return []
    return [
        Problem(severity="note", where=name, what=f"The border of the image cuts the person: {frames_text(cut[:, c])}.")
        for c, name in enumerate(motion.camera_names)
        if cut[:, c].any()
    ]


def touches_border(mask: Mask) -> bool:
    """Return whether a silhouette (height, width) reaches the border of its image."""
    return bool(mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any())


def frames_text(chosen: Mask) -> str:
    """Format the selected frames (F,) as `frames 3 to 9, 12`; of many runs only the first ones are named."""
    runs = [(first, end - 1) for first, end in true_runs(chosen)]
    texts = [f"{a}" if a == b else f"{a} to {b}" for a, b in runs[:SHOWN_RUNS]]
    more = f" and {len(runs) - SHOWN_RUNS} more stretches" if len(runs) > SHOWN_RUNS else ""
    plural = "s" if chosen.sum() != 1 else ""
    return f"frame{plural} " + ", ".join(texts) + more


def readable(name: str) -> str:
    """Format a name of the results as words: `left_hip_flexion` as `left hip flexion`."""
    return name.replace("_", " ")

"""What went wrong where: every doubt that a motion carries, put into sentences."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from marey.arrays import Mask
from marey.motion.motion import FILLED, LOST, MEASURED, NOBODY, BodyMotion

Severity = Literal["bad", "doubt", "note"]
LOW_AGREEMENT = 0.80
"""Below it a picture of the overlay shows a limb beside itself."""
SHOWN_RUNS = 6
ALWAYS = 0.995
"""Share of frames from which on a coordinate counts as never determined."""


@dataclass(frozen=True, kw_only=True)
class Problem:
    """One thing that a reader of the results should know."""

    severity: Severity
    """bad: an answer is missing or wrong; doubt: an answer to be used with care; note: good to know."""
    where: str
    what: str


def find_problems(
    motion: BodyMotion, *, cut: Mask | None = None, warnings: Sequence[str] = (), usable: Mask | None = None
) -> list[Problem]:
    """List what went wrong where, the gravest first.

    Args:
        motion: What was measured.
        cut: (F, C) true where the picture's border cuts the person.
        warnings: What the run itself warned of.
        usable: (F,) the frames that were asked for; all when missing.

    Returns:
        Nothing where all is well.
    """
    usable = np.ones(len(motion), bool) if usable is None else usable
    found = [
        *_states(motion, usable),
        *_agreements(motion),
        *_undetermined(motion),
        *_borders(motion, cut),
        *(Problem(severity="note", where="run", what=text) for text in warnings),
    ]
    order = ("bad", "doubt", "note")
    return sorted(found, key=lambda problem: order.index(problem.severity))


def _states(motion: BodyMotion, usable: Mask) -> list[Problem]:
    texts: tuple[tuple[int, Severity, str], ...] = (
        (LOST, "bad", "The person was lost here; the results have no answer."),
        (FILLED, "doubt", "Not measured but filled from the neighbouring frames, and flagged as such."),
        (NOBODY, "note", "Nobody is seen; the results have no answer."),
    )
    found = []
    for state, severity, what in texts:
        where = (motion.state == state) & usable
        if where.any():
            found.append(Problem(severity=severity, where=frames_text(where), what=what))
    if not (motion.state == MEASURED).any():
        found.append(Problem(severity="bad", where="whole take", what="No frame could be measured."))
    return found


def _agreements(motion: BodyMotion) -> list[Problem]:
    found = []
    for c, name in enumerate(motion.camera_names):
        values = motion.agreement[:, c]
        known = np.isfinite(values)
        if not known.any():
            found.append(Problem(severity="doubt", where=name, what="This camera never saw the person."))
            continue
        median = float(np.median(values[known]))
        if median < LOW_AGREEMENT:
            what = f"Surface and silhouette agree poorly all along (median {median:.2f}); look at its overlay."
            found.append(Problem(severity="bad", where=name, what=what))
            continue
        low = known & (values < LOW_AGREEMENT)
        if low.any():
            what = f"Surface and silhouette agree poorly (down to {values[low].min():.2f}): {frames_text(low)}."
            found.append(Problem(severity="doubt", where=name, what=what))
    return found


def _undetermined(motion: BodyMotion) -> list[Problem]:
    measured = motion.state == MEASURED
    if not measured.any():
        return []
    share = 1 - motion.determined[measured].mean(0)
    names = [readable(name) for name in motion.coordinate_names]
    always = [name for name, part in zip(names, share, strict=True) if part > ALWAYS]
    partly = [f"{name} ({100 * part:.0f} %)" for name, part in zip(names, share, strict=True) if 0 < part <= ALWAYS]
    never = "Never fixed by the views, their values come from what is usual: "
    sometimes = "Not fixed by the views in a part of the frames: "
    return [
        Problem(severity="doubt", where=_coordinates(len(group)), what=f"{text}{', '.join(group)}.")
        for text, group in ((never, always), (sometimes, partly))
        if group
    ]


def _coordinates(count: int) -> str:
    return "1 coordinate" if count == 1 else f"{count} coordinates"


def _borders(motion: BodyMotion, cut: Mask | None) -> list[Problem]:
    if cut is None:
        return []
    return [
        Problem(severity="note", where=name, what=f"The picture's border cuts the person: {frames_text(cut[:, c])}.")
        for c, name in enumerate(motion.camera_names)
        if cut[:, c].any()
    ]


def touches_border(mask: Mask) -> bool:
    """Tell whether a silhouette (height, width) reaches the border of its picture."""
    return bool(mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any())


def frames_text(chosen: Mask) -> str:
    """Write frames (F,) as people do: `frames 3 to 9, 12` or, of many runs, only the first ones."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], chosen.astype(np.int8), [0]])))
    runs = [(int(a), int(b) - 1) for a, b in edges.reshape(-1, 2)]
    texts = [f"{a}" if a == b else f"{a} to {b}" for a, b in runs[:SHOWN_RUNS]]
    more = f" and {len(runs) - SHOWN_RUNS} more stretches" if len(runs) > SHOWN_RUNS else ""
    plural = "s" if chosen.sum() != 1 else ""
    return f"frame{plural} " + ", ".join(texts) + more


def readable(name: str) -> str:
    """Write a name of the results as words: `left_hip_flexion` as `left hip flexion`."""
    return name.replace("_", " ")

"""Distances of the joint angles of a walk from those of reference walks ([Baker2009])."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats
from marey.motion.events.curves import CycleCurves, side_of, without_side

_ANGLES = (
    "pelvis_tilt", "pelvis_obliquity", "pelvis_list", "pelvis_rotation", "hip_flexion", "hip_adduction", "hip_rotation",
    "knee_flexion", "knee_angle", "ankle_dorsiflexion", "ankle_angle",
)  # fmt: skip
"""Angles of a profile, ours and those of OpenSim's gait models: the nine of [Baker2009] without foot progression, which
is no curve of the tables."""
WHOLE_SCORE = "gait profile score"
"""Name of the score of all angles together."""


@dataclass(frozen=True, kw_only=True)
class ProfileScore:
    """Distance of one angle, or of all angles of a side, from the mean of the reference walks."""

    name: str
    """Angle without its side, or `gait profile score`."""
    side: str
    """`left`, `right`, or `both`, for the pelvis and for all angles together."""
    score_deg: float
    """Root mean square difference over the cycle [degrees]."""
    reference_deg: float
    """Median of the same number of the reference walks, each compared with the mean of the others [degrees]."""
    reference_worst_deg: float
    """Largest one of the reference walks [degrees]."""


def profile_scores(own: Mapping[str, Floats], references: Sequence[Mapping[str, Floats]]) -> tuple[ProfileScore, ...]:
    """Compare the mean angles of a walk over the gait cycle with those of reference walks.

    Args:
        own: Mean curve (101,) of each angle of the walk by its name without a unit [degrees].
        references: The same of two reference walks or more.

    Returns:
        The score of each angle that all walks have, and of all angles of the left side, the right side, and both; none
        if there is no such angle.
    """
    common = set(own).intersection(*references)
    names = [name for name in own if name in common and without_side(name) in _ANGLES]
    if not names:
        return ()
    stack = np.array([[each[name] for name in names] for each in references])
    scores = _distances(np.array([own[name] for name in names]), stack.mean(0))
    others = np.array([_distances(one, np.delete(stack, k, 0).mean(0)) for k, one in enumerate(stack)])
    found = [
        _entry(without_side(name).replace("_", " "), side_of(name) or "both", scores[k], others[:, k])
        for k, name in enumerate(names)
    ]  # fmt: skip
    columns: Mapping[str, list[int]] = {
        side: [k for k, name in enumerate(names) if side == "both" or side_of(name) in (side, None)]
        for side in ("left", "right", "both")
    }
    for side, chosen in columns.items():
        if chosen:
            whole = float(np.sqrt((scores[chosen] ** 2).mean()))
            found.append(_entry(WHOLE_SCORE, side, whole, np.sqrt((others[:, chosen] ** 2).mean(1))))
    return tuple(found)


def reference_bands(walks: Iterable[CycleCurves]) -> dict[str, Floats]:
    """Average the curves of reference walks, both sides of a quantity together.

    Args:
        walks: Curves of the reference walks.

    Returns:
        Mean and standard deviation (101, 2) of each quantity over walks and sides, by its name without side; none of a
        quantity with a single curve.
    """
    found: dict[str, list[Floats]] = defaultdict(list)
    for walk in walks:
        for k, name in enumerate(walk.names):
            if walk.counts[k]:
                found[without_side(name)].append(walk.mean[:, k])
    stacks = {name: np.array(curves) for name, curves in found.items() if len(curves) > 1}
    return {name: np.stack([stack.mean(0), stack.std(0, ddof=1)], 1) for name, stack in stacks.items()}


def _distances(curves: Floats, mean: Floats) -> Floats:
    """Return the root mean square differences (N,) of curves (N, 101) from a mean."""
    return np.asarray(np.sqrt(((curves - mean) ** 2).mean(1)))


def _entry(name: str, side: str, score: float, others: Floats) -> ProfileScore:
    return ProfileScore(
        name=name, side=side, score_deg=float(score), reference_deg=float(np.median(others)),
        reference_worst_deg=float(others.max()),
    )  # fmt: skip

"""Gait profile: how far the joint angles of a walk are from those of reference walks ([Baker2009])."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem, SettingProblem
from marey.io.results.gait import read_cycle_csv
from marey.motion.events.curves import side_of
from marey.wording import listed

_ANGLES = (
    "pelvis_tilt", "pelvis_obliquity", "pelvis_list", "pelvis_rotation", "hip_flexion", "hip_adduction", "hip_rotation",
    "knee_flexion", "knee_angle", "ankle_dorsiflexion", "ankle_angle",
)  # fmt: skip
"""Angles of a profile, ours and those of OpenSim's gait models: the nine of [Baker2009] without foot progression, which
is no curve of the tables."""
_LEAST_REFERENCES = 2
"""Smallest number of reference walks: with one, its own distance from the others is not known."""
_FILE = "cycles.csv"
"""The table of curves over the cycle."""


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


@dataclass(frozen=True, kw_only=True)
class GaitProfile:
    """The Gait Profile Score of a walk, and its parts by angle, the Movement Analysis Profile.

    Example:
        >>> import marey
        >>> profile = marey.gait_profile("walk01/marey", "references")
        >>> knee = profile.score("knee flexion", "left")
        >>> knee.score_deg > knee.reference_worst_deg  # farther than any of the reference walks
        True
    """

    scores: tuple[ProfileScore, ...]
    """Each angle of each side, and the score of the left side, the right side and both."""
    references: tuple[Path, ...]
    """Folders of the reference walks."""

    def score(self, name: str = "gait profile score", side: str = "both") -> ProfileScore:
        """Return one score.

        Args:
            name: An angle without its side, for example `knee flexion`; the score of all angles by default.
            side: `left`, `right` or `both`.

        Raises:
            SettingProblem: There is no such score.
        """
        wanted = name.replace("_", " ")
        for entry in self.scores:
            if (entry.name, entry.side) == (wanted, side):
                return entry
        known = listed(sorted({f"{entry.name} ({entry.side})" for entry in self.scores}))
        raise SettingProblem(f"There is no score of {wanted!r} for {side}. There are: {known}.")


def gait_profile(walk: Path | str, references: Path | str) -> GaitProfile:
    """Compare the mean angles of a walk over the gait cycle with those of reference walks.

    The score of an angle is the root mean square difference between its mean curve and the mean of the reference walks;
    that of a side is the root mean square over its angles and those of the pelvis ([Baker2009]). The rotation of the
    pelvis is taken relative to its mean over the cycle, because the tables do not contain the direction of walking.

    Args:
        walk: Folder with the results of `marey capture` or `marey markers` of a walk.
        references: Folder with the results of reference walks in folders of their own, at any depth.

    Returns:
        The profile, with the same scores of the reference walks among themselves.

    Raises:
        FileProblem: A folder has no results of a walk, or there are fewer than two references.
        SettingProblem: The walk and the references have no angle in common.

    Example:
        >>> import marey
        >>> profile = marey.gait_profile("walk01/marey", "references")
        >>> len(profile.references)
        3
        >>> profile.score()
        ProfileScore(name='gait profile score', side='both', score_deg=..., reference_deg=..., ...)
    """
    walk, references = Path(walk), Path(references)
    own = _curves(walk)
    folders = sorted(path.parent for path in references.rglob(_FILE) if path.parent.resolve() != walk.resolve())
    if len(folders) < _LEAST_REFERENCES:
        wrong = f"has the results of {len(folders)} reference walks and should have at least {_LEAST_REFERENCES}"
        raise FileProblem(
            references, wrong, f"Each of them is a folder with {_FILE}, by `marey capture` or `marey markers`."
        )
    known = [_curves(folder) for folder in folders]
    names = [name for name in own if all(name in each for each in known)]
    if not names:
        raise SettingProblem(f"{walk} and the walks in {references} have no angle of hips, knees or ankles in common.")
    stack = np.array([[each[name] for name in names] for each in known])
    scores = _distances(np.array([own[name] for name in names]), stack.mean(0))
    others = np.array([_distances(one, np.delete(stack, k, 0).mean(0)) for k, one in enumerate(stack)])
    return GaitProfile(scores=tuple(_scores(names, scores, others)), references=tuple(folders))


def _curves(folder: Path) -> dict[str, Floats]:
    """Return the mean curves (101,) of the angles of a profile, by their names without unit [degrees]."""
    path = folder / _FILE
    if not path.is_file():
        raise FileProblem(
            folder, f"has no {_FILE}", "Give the results of a walk with at least one complete gait cycle."
        )
    found = {}
    for column, values in read_cycle_csv(path).items():
        name = column.removesuffix("_deg")
        if name != column and _base(name) in _ANGLES and np.isfinite(values).all():
            found[name] = values - values.mean() if _base(name) == "pelvis_rotation" else values
    return found


def _base(name: str) -> str:
    """Return the name of an angle without its side."""
    side = side_of(name)
    if side is None:
        return name
    return name.removeprefix(f"{side}_") if name.startswith(f"{side}_") else name[:-2]


def _distances(curves: Floats, mean: Floats) -> Floats:
    """Return the root mean square differences (N,) of curves (N, 101) from a mean."""
    return np.asarray(np.sqrt(((curves - mean) ** 2).mean(1)))


def _scores(names: Sequence[str], own: Floats, others: Floats) -> list[ProfileScore]:
    found = [
        _entry(_base(name).replace("_", " "), side_of(name) or "both", own[k], others[:, k])
        for k, name in enumerate(names)
    ]  # fmt: skip
    columns: Mapping[str, list[int]] = {
        side: [k for k, name in enumerate(names) if side == "both" or side_of(name) in (side, None)]
        for side in ("left", "right", "both")
    }
    for side, chosen in columns.items():
        if chosen:
            whole = float(np.sqrt((own[chosen] ** 2).mean()))
            found.append(_entry("gait profile score", side, whole, np.sqrt((others[:, chosen] ** 2).mean(1))))
    return found


def _entry(name: str, side: str, score: float, others: Floats) -> ProfileScore:
    return ProfileScore(
        name=name, side=side, score_deg=float(score), reference_deg=float(np.median(others)),
        reference_worst_deg=float(others.max()),
    )  # fmt: skip

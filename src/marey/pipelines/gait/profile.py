"""Gait profile: how far the joint angles of a walk are from those of reference walks ([Baker2009])."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from marey.arrays import Floats
from marey.errors import SettingProblem
from marey.motion.events.profile import WHOLE_SCORE, ProfileScore, profile_scores
from marey.pipelines.gait.measured_walk import mean_curves, reference_folders, walk_folder
from marey.wording import listed


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

    def score(self, name: str = WHOLE_SCORE, side: str = "both") -> ProfileScore:
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
        walk: Folder with the results of `marey capture` or `marey markers` of a walk, or the trial with them in its
            `marey/`.
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
    folder = walk_folder(walk)
    folders = reference_folders(Path(references), without=[folder])
    return profile_from(folder, mean_curves(folder), {each: mean_curves(each) for each in folders})


def profile_from(
    walk: Path, angles: Mapping[str, Floats], references: Mapping[Path, Mapping[str, Floats]]
) -> GaitProfile:
    """Compare the mean angles of a walk with those of listed reference walks, as `gait_profile` does.

    Args:
        walk: Folder of the walk, for the error.
        angles: Mean curve (101,) of each angle of the walk by its name without unit [degrees].
        references: The same of two reference walks or more, by their folders.

    Raises:
        SettingProblem: The walk and the references have no angle in common.
    """
    scores = profile_scores(angles, list(references.values()))
    if not scores:
        raise SettingProblem(f"{walk} and the reference walks have no angle of hips, knees or ankles in common.")
    return GaitProfile(scores=scores, references=tuple(references))

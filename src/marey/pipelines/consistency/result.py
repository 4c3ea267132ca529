"""What a captured motion itself shows about its use: lost frames, poor agreement, implausible sizes."""

from collections.abc import Iterator, Sequence

import numpy as np

from marey.body.articulation.surface import Body
from marey.body.people.person import stature
from marey.motion.from_fit import joint_centre_sds
from marey.motion.motion import LOST, MEASURED, BodyMotion
from marey.pipelines.verdict import MOST_WITHOUT_RESULT, VerdictReason
from marey.view.pages.problems import LOW_AGREEMENT, frames_text
from marey.wording import listed

NO_AGREEMENT = 0.7
"""Overlap of surface and silhouettes, median over frames and then cameras, below which a motion is not that of the
person in the images. Five sound takes have 0.91 and more in every camera. Chosen by hand."""
SHORTEST_M, TALLEST_M = 0.8, 2.5
"""Range of the stature of people [m]. Chosen by hand."""
WIDE_MM = 100.0
"""Half of the median 95 % interval of a joint's coordinate above which it is named [mm]. Chosen by hand."""


def reasons_of(motion: BodyMotion, body: Body, selected: Sequence[int], *, preset: str = "full") -> list[VerdictReason]:
    """List what limits the use of a captured motion.

    Args:
        motion: The motion.
        body: The fitted body.
        selected: The selected frames.
        preset: Part of the body that was followed; a stature is judged for a whole body only.

    Returns:
        The reasons; empty for a sound motion.
    """
    found = [*_states(motion, selected), *_agreement(motion, preset), *_intervals(motion, body)]
    return [*found, *(_stature(body) if preset == "full" else ())]


def _states(motion: BodyMotion, selected: Sequence[int]) -> Iterator[VerdictReason]:
    chosen = np.zeros(len(motion), bool)
    chosen[list(selected)] = True
    lost, measured = (motion.state == LOST) & chosen, (motion.state == MEASURED) & chosen
    if not measured.any():
        yield VerdictReason(
            level="not usable", what="No frame could be measured.", remedy="Look at the overlay videos.", cause="lost"
        )
    elif lost.any():
        share = lost.sum() / (lost.sum() + measured.sum())
        yield VerdictReason(
            level="not usable" if share > MOST_WITHOUT_RESULT else "usable with limits",
            what=f"The person was lost in {frames_text(lost)}: these frames have no pose.",
            remedy="Look at these frames in the videos; a start (--start) or key points (--keypoints) help.",
            cause="lost",
        )


def _agreement(motion: BodyMotion, preset: str) -> Iterator[VerdictReason]:
    known = np.isfinite(motion.agreement).any(axis=0)
    if not known.any():
        return
    names = np.array(motion.camera_names)[known]
    usual = np.nanmedian(motion.agreement[:, known], axis=0)
    each = listed(f"{name} {value:.2f}" for name, value in zip(names, usual, strict=True))
    if np.median(usual) < NO_AGREEMENT:
        yield VerdictReason(
            level="not usable", cameras=tuple(names), cause="agreement",
            what=f"The fitted body and the silhouettes do not agree (overlap {each}; sound takes have 0.9 or more).",
            remedy="Check the calibration, the clocks of the cameras (`marey sync`) and the images of the empty room."
            + _part_only(preset),
        )  # fmt: skip
    elif (usual < LOW_AGREEMENT).any():
        low = tuple(names[usual < LOW_AGREEMENT])
        yield VerdictReason(
            level="usable with limits", cameras=low, cause="agreement",
            what=f"The fitted body and the silhouettes of {listed(low)} agree poorly (overlap {each}).",
            remedy="Look at the overlay videos; leave the camera out (--cameras) if its images are not usable."
            + _part_only(preset),
        )  # fmt: skip


def _part_only(preset: str) -> str:
    """Return the explanation of a poor agreement of a body that follows a part of the person; empty for a whole one."""
    if preset == "full":
        return ""
    return (
        f" With the preset {preset}, parts of the person that it does not follow, such as bent legs, lower the overlap "
        "as well: if the images show them, capture the whole person (without --preset)."
    )


def _intervals(motion: BodyMotion, body: Body) -> Iterator[VerdictReason]:
    half = 1960 * joint_centre_sds(motion, body)[1]
    if half > WIDE_MM:
        what = f"The joint centres are known within +- {half:.0f} mm only (95 %, median)."
        yield VerdictReason(level="usable with limits", what=what, cause="wide intervals")


def _stature(body: Body) -> Iterator[VerdictReason]:
    height, _ = stature(body)
    if not SHORTEST_M < height < TALLEST_M:
        yield VerdictReason(
            level="not usable", cause="stature", what=f"The person would be {height:.2f} m tall, which nobody is.",
            remedy="Check the unit of the calibration, which should be metres, or give the stature (--stature).",
        )  # fmt: skip

"""The verdict on a measured surface: frames without points, residuals, and cameras that the matches contradict."""

from collections.abc import Iterator, Sequence

import numpy as np

from marey.cameras.rig import Rig
from marey.pipelines.verdict import MOST_WITHOUT_RESULT, Verdict, VerdictReason, without_result
from marey.surface.points.measured import MeasuredPoints
from marey.surface.points.refine_rig import RigRefinement
from marey.surface.tracks.filters import Filtered

MOST_RESIDUAL_PX = 0.5
"""Median residual of the rays above which the cameras are named [px]. Faces with a camera that is 0.4 px off its
calibration have 0.27 to 0.37 px, and points of more than 1 px are rejected. Chosen by hand."""

FEW_CONFIRMED, HARDLY_CONFIRMED = 0.25, 0.02
"""Shares of the points that three cameras see, below which a third camera contradicts the others, or does so
everywhere. Three sound sets of three cameras and more have 0.44 to 0.91; `face1` has 0.14 with one camera an instant
late, and 0 with two cameras exchanged. Chosen by hand."""
_FARTHEST_M = 50.0
"""Median distance of the points from the cameras above which the calibration is in millimetres [m]: persons are filmed
from 0.05 to 50 m, and one unit is 1000 of the other. Chosen by hand."""
_MM = 1e3
"""Millimetres in a metre."""


def surface_verdict(
    rig: Rig, parts: Sequence[MeasuredPoints], count: int, *, refined: RigRefinement | None, followed: Filtered | None,
    third: bool = False, causes: Sequence[VerdictReason] = (),
) -> Verdict:  # fmt: skip
    """Return the verdict on a measured surface.

    Args:
        rig: The cameras.
        parts: The points of each frame that was measured.
        count: Number of frames that were to be measured.
        refined: The correction of the cameras by the matches; None if they were not corrected.
        followed: The trajectories; None if no points were followed.
        third: Whether each template is compared with two other cameras or more, which confirm each other.
        causes: Causes found by trying repairs; what they explain is not listed beside them.
    """
    # Pictures that contradict the calibration explain that cameras do not confirm each other, and that rays miss.
    contradictions = [] if causes else [*(_confirmed(rig, parts) if third else ()), *_cameras(rig, parts, refined)]
    limits = [*_frames(parts, count), *contradictions, *_tracks(followed)]
    return Verdict.of([*causes, *_far(rig, parts), *limits])


def suspicious(parts: Sequence[MeasuredPoints], *, third: bool) -> bool:
    """Return whether the points make it likely that pictures and calibration contradict each other.

    Args:
        parts: The points of each frame.
        third: Whether each template is compared with two other cameras or more.
    """
    empty = sum(not len(part) for part in parts) > MOST_WITHOUT_RESULT * len(parts)
    contradicted = third and _confirmed_share(parts) < FEW_CONFIRMED
    return empty or contradicted or _residual(parts) > MOST_RESIDUAL_PX


def _confirmed_share(parts: Sequence[MeasuredPoints]) -> float:
    return float(np.mean(np.concatenate([part.views for part in parts]) > 2))


def _residual(parts: Sequence[MeasuredPoints]) -> float:
    return float(np.median([np.median(part.residual_px) for part in parts if len(part)]))


def _far(rig: Rig, parts: Sequence[MeasuredPoints]) -> Iterator[VerdictReason]:
    """Name a calibration in millimetres."""
    distances = [np.linalg.norm(part.points[:, None] - rig.centres, axis=-1) for part in parts if len(part)]
    away = float(np.median([np.median(each) for each in distances]))
    if away > _FARTHEST_M:
        what = (
            f"The points are {away:.0f} m from the cameras (median): the calibration is in millimetres. Read as such, "
            f"they are {away / _MM:.2f} m from the cameras."
        )
        yield VerdictReason.failure(what, "Write the positions of the cameras in metres.", cause="unit")


def _confirmed(rig: Rig, parts: Sequence[MeasuredPoints]) -> Iterator[VerdictReason]:
    """Name cameras that do not confirm each other's points."""
    share = _confirmed_share(parts)
    if share < FEW_CONFIRMED:
        make = VerdictReason.failure if share < HARDLY_CONFIRMED else VerdictReason.limit
        what = f"Only {share:.1%} of the points are seen by three cameras: the cameras do not confirm each other."
        remedy = (
            "Check that no pictures are exchanged, that all cameras recorded at one instant, and that none moved after "
            "the calibration."
        )
        yield make(what, remedy, cameras=rig.names)


def _frames(parts: Sequence[MeasuredPoints], count: int) -> Iterator[VerdictReason]:
    if len(parts) < count:
        what = f"Only the {len(parts)} frames before a damaged one were measured, of {count}."
        yield VerdictReason.limit(what, "Copy the videos again, or choose the frames (--frames).")
    empty = sum(not len(part) for part in parts)
    remedy = "Look at the images of these frames: the surface must be sharp, lit, and in view of two cameras."
    yield from without_result(empty, len(parts), "show no point of the surface", remedy)


def _cameras(rig: Rig, parts: Sequence[MeasuredPoints], refined: RigRefinement | None) -> Iterator[VerdictReason]:
    if refined is not None and refined.significant:
        moved = [f"{name} {px:.2f} px" for name, px in zip(rig.names, refined.moved_px, strict=True) if px > 0]
        what = (
            f"The matches contradict the calibration, and the cameras were corrected ({', '.join(moved)}): the median "
            f"residual fell from {refined.residual_before:.2f} to {refined.residual_after:.2f} px."
        )
        yield VerdictReason.limit(what, "Calibrate the cameras again.", cameras=rig.names)
    residual = _residual(parts)
    if residual > MOST_RESIDUAL_PX:
        what = f"The rays of a point miss each other by {residual:.2f} px (median); 0.1 to 0.4 px are usual."
        remedy = "Check that the cameras recorded at one instant, and calibrate them again."
        yield VerdictReason.limit(what, remedy, cameras=rig.names)


def _tracks(followed: Filtered | None) -> Iterator[VerdictReason]:
    if followed is not None and not len(followed.trajectories.kept):
        what = "No point could be followed from one frame to the next: there are no velocities."
        yield VerdictReason.limit(what, "Film with a higher rate, or a shorter exposure.")

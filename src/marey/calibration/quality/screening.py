"""Pictures of one camera that must not be solved together with the others, found before any common solution.

A common solution of a session with such pictures mixes right and wrong ones, and shows neither which camera is at
fault nor what is wrong with it.
"""

from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats
from marey.calibration.adjustment.solve import LeftOut
from marey.calibration.boards.board import CalibrationBoard
from marey.calibration.boards.corners import CornerSet
from marey.calibration.boards.still import join_still
from marey.calibration.quality.causes import Cause
from marey.calibration.quality.reference_views import CHANGES, DELAY, READOUT
from marey.calibration.sights.board_sights import board_sights
from marey.calibration.sights.clock_faults import ClockFault, PairedSights, find_clock_fault, mean_deviation
from marey.calibration.sights.switches import Switch, find_switch
from marey.calibration.timing.wand_faults import WandFault

_LEAST_DEVIATION = 0.1
"""Mean deviation of the pictures of two cameras from their relative pose from which a cause is searched, in those up to
which relative poses agree; chosen by hand. In clean made sessions of the seeds 0 to 5 it was 0.042 at most."""
_LEFT_OUT = {"turned": "was turned", "exchanged": "was exchanged"}
"""Why the pictures on one side of a change are left out, as predicates."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Screening:
    """What is wrong with one camera, and the pictures that are not used therefore."""

    cause: Cause | None = None
    """Why its pictures contradict those of the others; None if they do not, or if that is found only later."""
    cameras: tuple[int, ...] = ()
    """Cameras of which pictures on one side of a change are not used."""
    later: bool = True
    """Whether these are the pictures after the change."""
    left_out: tuple[LeftOut, ...] = ()
    """The views of these pictures."""
    instants: tuple[int, ...] = ()
    """The instant that each picture of the camera at fault shows, -1 for none; empty if each shows its own."""

    def retimed(self, corners: CornerSet) -> CornerSet:
        """Return the corners with the pictures of the camera at fault at the instants that they show."""
        if self.cause is None or not self.instants:
            return corners
        own = corners.camera == self.cause.camera
        picture = np.where(own, np.array(self.instants)[corners.picture], corners.picture)
        moved = replace(corners, picture=picture).subset(picture >= 0)
        return moved.ordered(np.lexsort((moved.corner, moved.camera, moved.picture)))

    def kept(self, corners: CornerSet) -> CornerSet:
        """Return the corners without those of the pictures that are not used."""
        if self.cause is None or not self.cameras:
            return corners
        assert self.cause.picture is not None
        late = corners.picture >= self.cause.picture
        return corners.subset(~(np.isin(corners.camera, self.cameras) & (late if self.later else ~late)))


def screened(corners: CornerSet, board: CalibrationBoard, lenses: Floats, *, videos: bool) -> Screening:
    """Find cameras that were exchanged or turned from some picture on, or one camera with another clock.

    Args:
        corners: The corners of all pictures.
        board: The board.
        lenses: (C, 9) approximate lenses.
        videos: Whether consecutive instants are consecutive pictures of videos.
    """
    sights = board_sights(corners, board, lenses)
    paired = PairedSights(sights, lagging=False)
    plain = [paired.deviations(*pair, np.zeros(paired.pictures), camera=pair[0]) for pair in paired.poses]
    if mean_deviation(plain) < _LEAST_DEVIATION:
        return Screening()
    switch = find_switch(corners, board, lenses, paired)
    if switch is not None:
        return _on_one_side(corners, _cause_of_switch(switch), switch.cameras)
    fault = find_clock_fault(PairedSights(sights, lagging=True)) if videos else None
    if fault is None:
        return Screening()
    cause = _cause_of_clock(fault)
    return Screening(cause=cause, instants=_instants_shown(cause, len(corners.pictures)))


def _instants_shown(cause: Cause, count: int) -> tuple[int, ...]:
    """Return the instants that the pictures of a camera show before and after pictures were lost or inserted."""
    if cause.kind != "lost" or cause.picture is None:
        return ()
    before, after = round(cause.change[DELAY]), round(cause.change[DELAY] + cause.change[READOUT])
    picture = np.arange(count)
    late = picture >= cause.picture
    instant = picture - np.where(late, after, before)
    # Inserted pictures repeat instants that were shown before.
    shown = (instant >= 0) & (instant < count) & ~(late & (instant < cause.picture - before))
    return tuple(np.where(shown, instant, -1).tolist())


def _cause_of_switch(switch: Switch) -> Cause:
    return Cause(
        kind=switch.kind, camera=switch.cameras[0], other=switch.cameras[1] if len(switch.cameras) > 1 else None,
        picture=switch.picture, change=np.zeros(CHANGES), lag=0, gain=float(switch.after - switch.before),
        share=(switch.after - switch.before) / max(switch.common - switch.before, 1),
    )  # fmt: skip


def cause_of_wand(fault: WandFault) -> Cause:
    """Return a clock that was found with a wand as the cause of contradictions.

    Args:
        fault: The clock, which was allowed for.
    """
    known = fault.late[np.isfinite(fault.late)]
    change = np.zeros(CHANGES)
    change[DELAY], change[READOUT] = known[0], known[-1] - known[0]
    return Cause(
        kind="drift" if fault.picture is None else "lost", camera=fault.camera, picture=fault.picture, change=change,
        lag=fault.jump, gain=fault.before - fault.after, share=1.0 - fault.after / fault.before,
    )  # fmt: skip


def _cause_of_clock(fault: ClockFault) -> Cause:
    change = np.zeros(CHANGES)
    change[DELAY], change[READOUT] = fault.begin, fault.end - fault.begin
    lag = round(fault.end - fault.begin) if fault.kind == "lost" else 0
    return Cause(
        kind=fault.kind, camera=fault.camera, picture=fault.picture, change=change, lag=lag,
        gain=fault.before - fault.after, share=1.0 - fault.after / fault.before,
    )  # fmt: skip


def _on_one_side(corners: CornerSet, cause: Cause, cameras: tuple[int, ...]) -> Screening:
    """Keep the side of a change on which more poses of the board are shared with other cameras."""
    views = np.unique(np.stack([corners.picture, corners.camera], axis=-1), axis=0)
    assert cause.picture is not None
    several = np.bincount(views[:, 0], minlength=len(corners.pictures)) > 1
    # Pictures of a board at rest count as one.
    own = np.unique(join_still(corners).first[views[np.isin(views[:, 1], cameras) & several[views[:, 0]], 0]])
    later = bool(np.count_nonzero(own >= cause.picture) < np.count_nonzero(own < cause.picture))
    reason = f"{_LEFT_OUT[cause.kind]}: {'after' if later else 'before'} the change"
    gone = views[np.isin(views[:, 1], cameras) & ((views[:, 0] >= cause.picture) == later)].tolist()
    left_out = tuple(LeftOut(picture=picture, camera=camera, reason=reason) for picture, camera in gone)
    return Screening(cause=cause, cameras=cameras, later=later, left_out=left_out)

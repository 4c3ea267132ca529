"""Calibration with a wand by cameras that are not in step: their delays are unknowns of the adjustment.

Whole and partial delays are found before the first solution (`wand_lags`), and so are cameras whose clocks drift or
that lost pictures (`wand_faults`). The points of late cameras are interpolated at the instants of the others
(`image_paths`); what is left of each delay is a column of the adjustment, in which a point moves along its path. The
same column, with the motion times the distance from the middle of the session, is what is left of a drift. Only delays
that the motion of the wand supports are used.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.calibration.adjustment.adjust import Adjusted, adjust
from marey.calibration.adjustment.covariance import common_covariance
from marey.calibration.adjustment.lens_choice import FixedModel
from marey.calibration.adjustment.problem import session_problem
from marey.calibration.adjustment.solve import SolvedSession, refined_session, solve_session
from marey.calibration.adjustment.state import SessionState, delay_unknowns
from marey.calibration.adjustment.wand_start import with_wand_poses
from marey.calibration.boards.corners import CornerSet
from marey.calibration.boards.wand import CalibrationWand
from marey.calibration.timing.image_paths import ImagePaths, middle_of
from marey.calibration.timing.steady_ends import with_agreeing_ends, with_steady_ends
from marey.calibration.timing.wand_faults import WandFault, find_wand_faults
from marey.calibration.timing.wand_lags import StartClocks, find_wand_lags, from_common_clock

_NEAR_WHOLE = 0.05
"""Distance from a whole number of pictures up to which points are not interpolated, but moved along their paths by the
adjustment, which is linear in it [pictures]; chosen by hand."""
_ROUNDS = 5
"""Largest number of times that points are interpolated again with better delays; chosen by hand."""
_SETTLED = 0.003
"""Change of a delay with which the points are not interpolated again [pictures]; chosen by hand."""
_SIGNIFICANT = 3.5
"""Standard deviations that a delay must exceed to be used: by chance once in 2000 times."""
_LEAST_DELAY = 1e-3
"""Least delay that is used [pictures]: a point that moves by 50 px per picture is then off by half the usual noise of
0.1 px. Chosen by hand."""
_UNDETERMINED = 0.2
"""Standard deviation from which a delay is called undetermined [pictures]; chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class WandClocks:
    """By how much the cameras of a session with a wand are late."""

    reference: int
    """The camera whose clock counts: one of those that most cameras share."""
    base: Floats
    """(C,) delays to which the points were interpolated; that of the adjustment is added [pictures]."""
    used: Mask
    """(C,) cameras whose delays are unknowns of the adjustment; the others count as on time."""
    estimate: Floats
    """(C,) delays before those without support were dropped [pictures]."""
    estimate_sd: Floats
    """(C,) their standard deviations [pictures]."""
    known: Mask
    """(C,) cameras whose delays are determined, whether they are used or not."""
    drift: Floats
    """(C,) change of the delays per picture; the delays are those in the middle of the session."""
    drift_sd: Floats
    """(C,) their standard deviations; zero for cameras that do not drift."""
    faults: tuple[WandFault, ...] = ()
    """The cameras that drift or lost pictures, which was allowed for."""

    def __post_init__(self) -> None:
        freeze_fields(self, "base", "estimate", "estimate_sd", "drift", "drift_sd")
        freeze_fields(self, "used", "known", dtype=bool)


@dataclass(frozen=True, kw_only=True)
class StatedDelay:
    """By how much a camera is late against the reference."""

    camera: int
    pictures: float
    """Delay; negative for a camera that is early [pictures]. In the middle of the session, if the camera drifts."""
    sd: float
    """Its standard deviation [pictures]."""
    used: bool
    """Whether it was allowed for; if not, the camera counts as on time."""
    known: bool
    """Whether it is determined."""
    drift: float = 0.0
    """Change of the delay from the first picture to the last [pictures]."""
    drift_sd: float = 0.0
    """Its standard deviation [pictures]; zero if the camera does not drift."""


def stated_delays(clocks: WandClocks, solved: SolvedSession) -> tuple[StatedDelay, ...]:
    """Return the delays of all cameras but the reference.

    Args:
        clocks: The clocks of the session.
        solved: Its solution.
    """
    place, span = delay_unknowns(solved.state.cameras), len(clocks.faults[0].late) - 1 if clocks.faults else 0
    sd = np.sqrt(np.diag(solved.covariance)[place])
    found = []
    for camera in range(solved.state.cameras):
        if camera == clocks.reference or solved.joined[camera] != solved.joined[clocks.reference]:
            continue
        used = bool(clocks.used[camera])
        value = clocks.base[camera] + solved.state.delay[camera] if used else clocks.estimate[camera]
        found.append(
            StatedDelay(
                camera=camera, pictures=float(value), sd=float(sd[camera] if used else clocks.estimate_sd[camera]),
                used=used, known=bool(clocks.known[camera]), drift=float(span * clocks.drift[camera]),
                drift_sd=float(span * clocks.drift_sd[camera]),
            )
        )  # fmt: skip
    return tuple(found)


def solve_wand_videos(
    corners: CornerSet, wand: CalibrationWand, *, fixed: Sequence[FixedModel] = ()
) -> tuple[SolvedSession, WandClocks]:
    """Calibrate cameras with a wand in videos that may not be in step.

    Args:
        corners: Points of the wand; consecutive instants are consecutive pictures of each camera.
        wand: The wand.
        fixed: Coefficients of each camera that were given, None where the corners decide; for all by default.

    Returns:
        The solution, whose corners are those at the instants of the reference, and the clocks.

    Raises:
        SettingProblem: There are too few points.
    """
    steady = with_steady_ends(corners, wand)
    faults = find_wand_faults(steady, wand)
    for each in faults:
        steady = each.retimed(steady)
    start = _start_clocks(steady, wand, faults)
    count = len(corners.cameras)
    drift: Floats = np.zeros(count)
    for each in faults:
        drift[each.camera] = each.drift
    first = ImagePaths.through(steady).at(_bases(start.late, drift), np.zeros(count, bool), drift)
    solved = solve_session(first, wand, model=False, fixed=fixed)
    paths = ImagePaths.through(with_agreeing_ends(steady, solved.corners, start.late, wand))
    if wand.alike:
        solved = _placed_again(solved, paths.at(_bases(start.late, drift), np.zeros(count, bool), drift), wand)
    work = _Timing(paths, solved, drift)
    late, found = work.settled(start.late, work.all_but(0))
    shared = work.on_common_clock(late, work.deviations(found))
    even = work.comparable(0) & (drift == 0.0)
    reference = int(np.argmin(np.where(even, np.abs(shared), np.inf)))
    shared = shared - shared[reference]
    drift_sd: Floats = np.zeros(count)
    if drift.any():
        late, drift, drift_sd = work.with_drift(shared, work.all_but(reference))
        clear = np.abs(drift) > _SIGNIFICANT * drift_sd
        drift, drift_sd = np.where(clear, drift, 0.0), np.where(clear, drift_sd, 0.0)
        faults = tuple(each for each in faults if not each.drift or clear[each.camera])
        work = replace(work, drift=drift)
    if reference != 0 or drift.any():
        late, found = work.settled(late if drift.any() else shared, work.all_but(reference))
    sd = work.deviations(found)
    known = work.comparable(reference) & (sd < _UNDETERMINED)
    known[reference] = True
    used = known & ((np.abs(late) > np.maximum(_SIGNIFICANT * sd, _LEAST_DELAY)) | (drift != 0.0))
    clocks = WandClocks(
        reference=reference, base=np.zeros(count), used=used, estimate=late, estimate_sd=sd, known=known, drift=drift,
        drift_sd=drift_sd, faults=faults,
    )  # fmt: skip
    # A camera whose delay is not determined keeps the one with which it was first placed.
    kept = np.where(used, late, np.where(known, 0.0, start.late - start.late[reference]))
    late, found = work.settled(kept, used)
    base = _bases(late, drift)
    again = replace(solved, adjusted=found)
    final = refined_session(again, work.paths.at(base, used, drift))
    return final, replace(clocks, base=base)


def _start_clocks(corners: CornerSet, wand: CalibrationWand, faults: Sequence[WandFault]) -> StartClocks:
    """Return the delays before the first solution, of cameras that drift those in the middle of the session."""
    start = find_wand_lags(corners, wand)
    late = start.late.copy()
    for each in faults:
        if each.drift:
            late[each.camera] = late[each.partner] + each.late[len(each.late) // 2]
    return replace(start, late=late)


def _placed_again(solved: SolvedSession, corners: CornerSet, wand: CalibrationWand) -> SolvedSession:
    """Return a session with the wand placed by other points, for instance with other ends first."""
    state, seen = with_wand_poses(solved.state, corners, wand, solved.joined)
    used = corners.subset(seen[corners.picture])
    problem = session_problem(used, wand, solved.lens, solved.joined, shape=False)
    placed = adjust(replace(problem, free=np.zeros_like(problem.free)), state, rounds=1, displaced=False)
    gone = tuple(each for each in solved.left_out if each.camera is None and not seen[each.picture])
    return replace(solved, adjusted=replace(placed, problem=problem), left_out=gone)


def _bases(late: Floats, drift: Floats) -> Floats:
    """Return the delays (C,) to which points are interpolated: whole numbers where these are near and do not drift."""
    whole = np.round(late)
    return np.asarray(np.where((np.abs(late - whole) < _NEAR_WHOLE) & (drift == 0.0), whole, late))


@dataclass(frozen=True, eq=False)
class _Timing:
    """Adjustments of one session with different delays."""

    paths: ImagePaths
    solved: SolvedSession
    drift: Floats
    """(C,) change of the delays per picture."""

    def all_but(self, reference: int) -> Mask:
        """Return all cameras whose clock can be compared with that of one."""
        own = self.comparable(reference)
        own[reference] = False
        return own

    def comparable(self, reference: int) -> Mask:
        """Return the cameras (C,) that are connected with one by common pictures."""
        joined = self.solved.joined
        return np.array(joined == joined[reference])

    def settled(self, late: Floats, timed: Mask) -> tuple[Floats, Adjusted]:
        """Interpolate and adjust in turn, until the delays of the timed cameras no longer change."""
        found, state = self.solved.adjusted, self.solved.state
        for _ in range(_ROUNDS):
            base = _bases(late, self.drift)
            found = self._adjusted(self.paths.at(base, timed, self.drift), state, late - base)
            before, late, state = late, base + found.state.delay, found.state
            if np.abs(late - before).max() < _SETTLED:
                break
        return np.asarray(late), found

    def with_drift(self, late: Floats, timed: Mask) -> tuple[Floats, Floats, Floats]:
        """Adjust the delays and the drifts of the cameras that drift in turn.

        Returns:
            (C,) delays in the middle, drifts per picture, and standard deviations of these.
        """
        work, drifting = self, self.drift != 0.0
        middle = middle_of(self.paths.corners)
        for _ in range(_ROUNDS):
            late, found = work.settled(late, timed)
            base = _bases(late, work.drift)
            corners = self.paths.at(base, timed, work.drift)
            assert corners.motion is not None
            lever = np.where(drifting[corners.camera], corners.picture / middle - 1.0, 1.0)
            turned = replace(corners, motion=corners.motion * lever[:, None])
            found = self._adjusted(turned, found.state, late - base)
            change = np.where(drifting, found.state.delay, 0.0)
            sd = np.where(drifting, self.deviations(found), 0.0)
            late = np.where(drifting, late, base + found.state.delay)
            work = replace(work, drift=work.drift + change / middle)
            if np.abs(change).max() < _SETTLED:
                break
        return late, work.drift, sd / middle

    def _adjusted(self, corners: CornerSet, state: SessionState, delay: Floats) -> Adjusted:
        """Adjust the corners of the pictures and views that are used, with start values of what is left of delays."""
        known = np.zeros(state.poses, bool)
        known[np.unique(self.solved.corners.picture)] = True
        left_out = {(each.picture, each.camera) for each in self.solved.left_out if each.camera is not None}
        pairs = zip(corners.picture.tolist(), corners.camera.tolist(), strict=True)
        keep = known[corners.picture] & np.array([pair not in left_out for pair in pairs], bool)
        wand, lens = self.solved.adjusted.problem.board, self.solved.lens
        problem = session_problem(corners.subset(keep), wand, lens, self.solved.joined, shape=False)
        return adjust(problem, replace(state, delay=delay), rounds=2, displaced=False)

    def deviations(self, found: Adjusted) -> Floats:
        """Return the standard deviations (C,) of the delays [pictures]; infinite for those that no motion shows."""
        place = delay_unknowns(found.state.cameras)
        sd = np.sqrt(np.diag(common_covariance(found))[place])
        return np.asarray(np.where(found.problem.free[place], sd, np.inf))

    def on_common_clock(self, late: Floats, sd: Floats) -> Floats:
        """Return the delays (C,) relative to the clock that most cameras share."""
        own, shared = self.comparable(0), late.copy()
        # The first camera is the reference, and cameras whose delay nothing shows count as on its clock.
        tolerance = np.where(np.isfinite(sd), np.maximum(_SIGNIFICANT * sd, _LEAST_DELAY), _LEAST_DELAY)
        shared[own] = from_common_clock(late[own], tolerance[own])
        return shared

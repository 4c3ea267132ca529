"""Calibration of a session from its corners: start values, joint adjustment, wrong views, choice of the model."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.calibration.adjustment.adjust import Adjusted, AdjustmentProblem, adjust
from marey.calibration.adjustment.covariance import common_covariance
from marey.calibration.adjustment.lens_choice import DISTORTION_NAMES, FixedModel, LensChoice, choose_lenses
from marey.calibration.adjustment.placement import place_board
from marey.calibration.adjustment.problem import (
    default_lens,
    session_problem,
    with_lenses,
    without_coefficients,
    without_extras,
)
from marey.calibration.adjustment.start import (
    LEAST_CORNERS,
    PoseVote,
    SessionStart,
    connected_cameras,
    start_lenses,
    start_session,
    still_connected,
)
from marey.calibration.adjustment.state import LENS, SessionState, shape_unknowns
from marey.calibration.adjustment.wand_session import start_wand_session
from marey.calibration.boards.board import CalibrationBoard
from marey.calibration.boards.corners import CornerSet
from marey.calibration.boards.wand import CalibrationTarget, CalibrationWand
from marey.cameras.camera import camera_faults
from marey.errors import SettingProblem

_WRONG_VIEW = 5.0
"""Typical distance of a view's corners, in their standard deviations, beyond which the view is left out; by hand."""
_WRONG_VIEW_PX = 0.3
"""A view is left out only if its typical distance exceeds this as well [px]; chosen by hand."""
_WRONG_ALONE_PX = 2.0
"""The same for the only view of a picture [px], which no other camera can contradict; chosen by hand."""
_PEELED = 0.4
"""Share of the worst view's distance from which views are left out together; those nearer may be good. By hand."""
_VIEW_ROUNDS = 6
"""Number of times that views are left out; chosen by hand."""
_WRONG_CORNER = 5.0
"""Distance of a corner, in its standard deviations, beyond which it is left out; chosen by hand."""
_SIGNIFICANT_SHAPE = 23.5
"""Chi-square of the board's four shape parameters from which it has them: exceeded by chance once in 10 000 times."""
_GREATEST_STRETCH = 8e-3
"""Largest stretch of a print, as a ratio; chosen by hand."""
_LEAST_SHAPE_GAIN = 0.96
"""Factor to which the shape must also reduce the noise: stretch and focal lengths are hard to separate. By hand."""
_LEAST_SPREAD_GAIN = 0.7
"""Factor to which the shape may reduce the displacements of the boards instead; chosen by hand."""
_MEDIAN_LENGTH = 1.1774
"""Median length of a normal deviation in two dimensions with unit standard deviations: sqrt(2 ln 2)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LeftOut:
    """Something of a session that was not used, and why."""

    picture: int
    """Index of the instant."""
    camera: int | None
    """Index of the camera; None for all cameras."""
    reason: str
    """Predicate of a sentence, for example "contradicts the other cameras by 12 px"."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SolvedSession:
    """An adjusted session with the choices that were made."""

    adjusted: Adjusted
    covariance: Floats
    """(16 C + 4, 16 C + 4) of the common unknowns; rotations turn on the left."""
    joined: Integers
    """(C,) group of cameras whose relative poses are known."""
    votes: tuple[PoseVote, ...]
    lens: Mask
    """(C, 9) lens parameters that were estimated."""
    shape: bool
    """Whether the board's shape was estimated."""
    left_out: tuple[LeftOut, ...]
    wrong_corners: int
    """Number of single corners that were left out."""
    landmarks: tuple[str, ...] = ()
    """Names of the points with known coordinates that were adjusted as well; their instants are the last."""
    choices: tuple[LensChoice | None, ...] = ()
    """(C) choice of the model of each lens, None for one that was not estimated; empty before models are compared."""
    fixed: tuple[FixedModel, ...] = ()
    """(C) distortion coefficients that were given; empty if the corners decide."""

    @property
    def state(self) -> SessionState:
        """The adjusted unknowns."""
        return self.adjusted.state

    @property
    def connected(self) -> Integers:
        """(C,) groups of cameras that all their common pictures connect, also those that were left out."""
        return connected_cameras(len(self.joined), self.votes)[0] if self.votes else self.joined

    @property
    def corners(self) -> CornerSet:
        """The corners that were used."""
        return self.adjusted.problem.corners


def solve_session(
    corners: CornerSet, board: CalibrationTarget, *, lenses: Floats | None = None, model: bool = True,
    fixed: Sequence[FixedModel] = (),
) -> SolvedSession:  # fmt: skip
    """Calibrate all cameras of a session together.

    Args:
        corners: The corners of all pictures.
        board: The board.
        lenses: (C, 9) start values of the lenses in the order of `LENS_NAMES`; estimated from homographies by default.
        model: Whether the distortion coefficients of each lens are chosen, and the shape of the board is estimated
            where the corners support it. Without, each lens has k1, k2, p1 and p2.
        fixed: Coefficients of each camera that were given, None where the corners decide; for all by default.

    Returns:
        The solution in the frame of one of the cameras.

    Raises:
        SettingProblem: There are too few corners.
    """
    if not len(corners):
        raise SettingProblem("There is no corner of the board in any picture.")
    if isinstance(board, CalibrationWand):
        corners, start = start_wand_session(corners, board, lenses)
    else:
        start = start_session(corners, board, start_lenses(corners, board) if lenses is None else lenses)
    if not start.seen.any():
        raise SettingProblem("No picture shows enough corners of the board.")
    start = replace(start, state=without_extras(start.state))
    left_out = _unseen(corners, start, board)
    used = corners.subset(start.seen[corners.picture])
    lens = default_lens(used)
    solved, more = _without_wrong_views(session_problem(used, board, lens, start.joined, shape=False), start.state)
    left_out += more
    used, wrong_corners = _without_wrong_corners(solved)
    joined = still_connected(start.joined, used)
    solved = adjust(session_problem(used, board, lens, joined, shape=False), solved.state)
    plain = SolvedSession(
        adjusted=solved, covariance=common_covariance(solved), joined=joined, votes=start.votes, lens=lens,
        shape=False, left_out=tuple(left_out), wrong_corners=wrong_corners, fixed=tuple(fixed),
    )  # fmt: skip
    return _with_supported_model(plain) if model else _with_sound_lenses(plain)


def recorded_together(corners: CornerSet, board: CalibrationTarget, lenses: Floats | None = None) -> bool:
    """Return whether cameras recorded the board at the same time.

    Pictures of equal numbers of cameras that recorded one after the other do not agree on any relative pose.

    Args:
        corners: The corners of all pictures.
        board: The board.
        lenses: (C, 9) start values of the lenses; estimated by default.
    """
    if len(np.unique(corners.camera)) < 2:
        return True
    return agreeing_pictures(corners, board, start_lenses(corners, board) if lenses is None else lenses) > 0


def agreeing_pictures(corners: CornerSet, board: CalibrationTarget, lenses: Floats) -> int:
    """Return how many common pictures agree on the relative poses of their two cameras, for all pairs together.

    Args:
        corners: The corners of all pictures.
        board: The board.
        lenses: (C, 9) start values of the lenses.
    """
    return sum(vote.agreeing for vote in start_session(corners, board, lenses).votes)


def refined_session(
    solved: SolvedSession, corners: CornerSet, *, kept: Sequence[tuple[int, int]] | None = None
) -> SolvedSession:
    """Adjust a solved session again with corners of the same pictures that were measured better.

    Args:
        solved: The session, for start values and the model.
        corners: The new corners; only pictures whose board pose is known are used.
        kept: Pictures and cameras that are used though they contradict the others, because the cameras were not
            synchronous; the other views that were left out stay so. None to look for contradicting views again.

    Returns:
        The new solution.
    """
    board, joined = solved.adjusted.problem.board, solved.connected
    known = np.zeros(len(corners.pictures), bool)
    known[np.unique(solved.corners.picture)] = True
    used = corners.subset(known[corners.picture])
    if kept is None:
        found, more = _without_wrong_views(
            session_problem(used, board, solved.lens, joined, shape=solved.shape), solved.state
        )  # fmt: skip
    else:
        more = [each for each in solved.left_out if each.camera is not None and (each.picture, each.camera) not in kept]
        gone = {(each.picture, each.camera) for each in more}
        pairs = zip(used.picture.tolist(), used.camera.tolist(), strict=True)
        used = used.subset(np.array([pair not in gone for pair in pairs], bool))
        problem = session_problem(used, board, default_lens(used), joined, shape=False)
        found = adjust(problem, without_extras(solved.state))
    # A picture of which all views were left out before is not used again: its views stay left out.
    gone_before = [each for each in solved.left_out if each.camera is None or not known[each.picture]]
    left_out = gone_before + [each for each in more if each not in gone_before]
    used, wrong_corners = _without_wrong_corners(found)
    lens, joined = default_lens(used), still_connected(joined, used)
    found = adjust(session_problem(used, board, lens, joined, shape=False), without_extras(found.state))
    plain = replace(
        solved, adjusted=found, joined=joined, lens=lens, shape=False, left_out=tuple(left_out),
        wrong_corners=wrong_corners, choices=(),
    )  # fmt: skip
    return _with_supported_model(plain)


def connected_again(solved: SolvedSession, corners: CornerSet) -> tuple[SolvedSession, bool]:
    """Start a session anew if common pictures do not connect all its cameras, by corners that were measured better.

    In a single common picture, a board that is seen from afar has two poses, of which the wrong one may have been
    taken; registered corners and adjusted lenses tell them apart.

    Args:
        solved: The session.
        corners: All corners, also those that were left out.

    Returns:
        The session, and whether more cameras are connected than before.
    """
    if _groups(solved) < 2:
        return solved, False
    board, lenses = solved.adjusted.problem.board, np.array(solved.state.lens)
    again = solve_session(corners, board, lenses=lenses, fixed=solved.fixed)
    better = _groups(again) < _groups(solved)
    return (again if better else solved), better


def _groups(solved: SolvedSession) -> int:
    """Return the number of groups into which common pictures divide the cameras that see the board."""
    return len(np.unique(solved.joined[np.unique(solved.corners.camera)]))


_SOUND_MODELS = (("k1", "k2", "p1", "p2"), ("k1", "k2", "p1", "p2", "k3"), ("k1", "p1", "p2"), ("k1",), ())
"""Models that are tried in turn for a lens that is not invertible in its image before models are compared."""


def _with_sound_lenses(solved: SolvedSession) -> SolvedSession:
    """Change the model of lenses that are not invertible in their whole images, which corners in the middle permit.

    A lens gets the next model of its choice. A model that was given is kept.
    """
    corners, tried = solved.corners, 0
    cameras = [camera for camera in range(len(solved.lens)) if not (solved.fixed and solved.fixed[camera] is not None)]
    order = [
        list(_SOUND_MODELS) if not solved.choices or (own := solved.choices[camera]) is None else own.preferred
        for camera in range(len(solved.lens))
    ]
    while unsound := [k for k in cameras if tried + 1 < len(order[k]) and _unsound(solved.state, k, corners.sizes[k])]:
        tried += 1
        lens, choices = solved.lens.copy(), list(solved.choices)
        for camera in unsound:
            lens[camera, -len(DISTORTION_NAMES) :] = [name in order[camera][tried] for name in DISTORTION_NAMES]
            if choices and (own := choices[camera]) is not None:
                choices[camera] = replace(own, coefficients=order[camera][tried])
        solved = _with_models(replace(solved, choices=tuple(choices)), lens, shape=solved.shape, anew=unsound)
    return solved


def _with_models(
    solved: SolvedSession, lens: Mask, *, shape: bool, anew: Sequence[int] = (), rounds: int = 2
) -> SolvedSession:
    """Adjust with other models of the lenses, for some cameras with a distortion that starts from zero."""
    omitted = np.zeros((len(lens), LENS, LENS))
    for camera, choice in enumerate(solved.choices):
        omitted[camera] += 0.0 if choice is None else choice.omitted
    problem = session_problem(solved.corners, solved.adjusted.problem.board, lens, solved.joined, shape=shape)
    kept = lens & ~np.isin(np.arange(len(lens)), anew)[:, None]
    found = adjust(with_lenses(problem, lens, omitted), without_coefficients(solved.state, kept), rounds=rounds)
    return replace(solved, adjusted=found, covariance=common_covariance(found), lens=lens, shape=shape)


def _unsound(state: SessionState, camera: int, size: tuple[int, int]) -> bool:
    fx, fy, cx, cy, *bending = state.lens[camera]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return bool(camera_faults(size, matrix, np.array(bending), fisheye=False))


def _unseen(corners: CornerSet, start: SessionStart, board: CalibrationTarget) -> list[LeftOut]:
    """Name the pictures with corners whose board pose could not be found."""
    pictures = np.unique(corners.picture)
    reason = f"fewer than {LEAST_CORNERS} corners could be measured, in every camera"
    if isinstance(board, CalibrationWand):
        reason = "shows the wand in one camera only, or not where two cameras agree"
    return [LeftOut(picture=int(each), camera=None, reason=reason) for each in pictures if not start.seen[each]]


def _without_wrong_views(problem: AdjustmentProblem, state: SessionState) -> tuple[Adjusted, list[LeftOut]]:
    """Adjust, and leave out the views that contradict the others most, until none does.

    Displacements of the boards are not estimated here: they would explain a camera that moved.
    """
    left_out: list[LeftOut] = []
    solved = adjust(problem, state, rounds=2, displaced=False)
    for _ in range(_VIEW_ROUNDS):
        wrong = _wrong_views(solved)
        if not len(wrong):
            break
        left_out += _named(solved, wrong)
        corners = problem.corners.subset(~np.isin(problem.corners.view, wrong))
        problem = replace(problem, corners=corners)
        solved = adjust(problem, solved.state, rounds=2, displaced=False)
    return solved, left_out


def _wrong_views(adjusted: Adjusted) -> Integers:
    """Find views whose corners lie far from their predictions in comparison with those of the other views."""
    view = adjusted.problem.corners.view
    distance = np.nan_to_num(adjusted.distance * adjusted.view_factor[view], nan=np.inf) / _MEDIAN_LENGTH
    pixels = np.nan_to_num(np.linalg.norm(adjusted.residual, axis=1), nan=np.inf) / _MEDIAN_LENGTH
    typical = np.array(
        [[np.median(each[view == k]) for each in (distance, pixels)] for k in range(int(view.max()) + 1)]
    )
    picture = adjusted.problem.corners.view_picture
    alone = np.bincount(picture)[picture] == 1
    limit = np.where(alone, _WRONG_ALONE_PX, _WRONG_VIEW_PX)
    wrong = (typical[:, 0] > _WRONG_VIEW) & (typical[:, 1] > limit)
    worst = np.max(np.where(wrong, typical[:, 1], 0.0), initial=0.0)
    return _blamed(adjusted, np.flatnonzero(wrong & (typical[:, 1] >= _PEELED * worst)))


def _blamed(adjusted: Adjusted, views: Integers) -> Integers:
    """Return the views that are to blame in the pictures of views that are far off.

    Of three views or more it is the one without which the others agree best; of two that contradict each other,
    both are left out, since neither is known to be right.
    """
    corners, blamed = adjusted.problem.corners, set()
    for picture in np.unique(corners.view_picture[views]):
        own = np.flatnonzero(corners.view_picture == picture)
        if len(own) < 3:
            blamed |= set(own.tolist())
            continue
        rest = [corners.subset(np.isin(corners.view, np.setdiff1d(own, [view]))) for view in own]
        found = [place_board(adjusted.problem.board, adjusted.state, each, each.camera) for each in rest]
        blamed.add(int(own[np.argmin([np.inf if each is None else each[1] for each in found])]))
    return np.array(sorted(blamed), np.int64)


def _named(adjusted: Adjusted, views: Integers) -> list[LeftOut]:
    corners, named = adjusted.problem.corners, []
    for view in views:
        rows = corners.view_rows(int(view))
        apart = np.linalg.norm(adjusted.residual[rows], axis=1)
        behind = np.isnan(apart).all()
        reason = "lies behind its camera" if behind else f"lies {np.nanmedian(apart):.1f} px from its prediction"
        named.append(
            LeftOut(picture=int(corners.view_picture[view]), camera=int(corners.view_camera[view]), reason=reason)
        )
    return named


def _without_wrong_corners(adjusted: Adjusted) -> tuple[CornerSet, int]:
    keep = adjusted.distance < _WRONG_CORNER
    return adjusted.problem.corners.subset(keep), int(np.count_nonzero(~keep))


def _with_supported_model(solved: SolvedSession) -> SolvedSession:
    """Choose the distortion coefficients of the lenses, and whether the board's shape differs from the ideal one."""
    problem = solved.adjusted.problem
    largest, board = np.repeat(solved.lens.any(axis=1, keepdims=True), LENS, axis=1), problem.board
    has_shape = isinstance(board, CalibrationBoard)
    most = adjust(
        session_problem(problem.corners, board, largest, solved.joined, shape=has_shape), solved.state, rounds=2
    )
    shape = has_shape and _has_shape(most, solved.adjusted)
    choices = choose_lenses(most, solved.fixed, shape=shape)
    lens = np.stack([np.zeros(LENS, bool) if choice is None else choice.lens for choice in choices])
    return _with_sound_lenses(_with_models(replace(solved, choices=choices), lens, shape=shape, rounds=4))


def _has_shape(most: Adjusted, plain: Adjusted) -> bool:
    """Return whether the board is stretched or bent, by an adjustment with its shape and one without."""
    where = shape_unknowns(most.state.cameras)
    own = common_covariance(most)[where, where]
    bent = bool(most.state.shape @ np.linalg.solve(own, most.state.shape) > _SIGNIFICANT_SHAPE)
    # A stretch beyond any print stands for something else, such as the ratio of the focal lengths.
    bent = bent and abs(float(most.state.shape[0])) < _GREATEST_STRETCH
    quieter = most.unit < _LEAST_SHAPE_GAIN * plain.unit
    steadier = most.spread[1] < _LEAST_SPREAD_GAIN * plain.spread[1]
    return bent and (quieter or steadier)

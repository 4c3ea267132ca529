"""From a solved session with contradictions to one without: what explains them is found and allowed for."""

from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Integers
from marey.calibration.adjustment.adjust import adjust
from marey.calibration.adjustment.problem import session_problem, without_extras
from marey.calibration.adjustment.solve import LeftOut, SolvedSession, refined_session
from marey.calibration.boards.corners import CornerSet
from marey.calibration.quality.causes import Cause, find_cause
from marey.calibration.quality.contradictions import displaced_views, explained_views
from marey.calibration.quality.finding import Examined
from marey.calibration.quality.image_geometry import repeated_views
from marey.calibration.quality.screening import Screening
from marey.calibration.quality.views import view_quality

_ASYNCHRONOUS = 0.05
"""Share of the views that contradict the others without a reason from which the cameras are not synchronous; by
hand."""
_ON_ONE_SIDE = {"moved": "moved", "lens-changed": "changed its lens", "turned": "was turned", "lost": "lost pictures"}
"""Explanations after which the views before and after cannot be used together, as predicates."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SettledSession:
    """A solved session whose contradictions were explained as far as possible."""

    solved: SolvedSession
    cause: Cause | None
    """Why one camera contradicts the others; None if they agree, or if nothing explains it."""


def settled_session(
    solved: SolvedSession, corners: CornerSet, *, videos: bool, screening: Screening | None = None,
    still: Integers | None = None,
) -> SettledSession:  # fmt: skip
    """Find why cameras contradict each other, and solve again without that.

    The views of a camera that moved, or whose lens changed, are used on the side of the change with more views. Those
    of cameras that are not synchronous are used with boards that may be displaced.

    Args:
        solved: The solved session.
        corners: All corners, also those that were left out.
        videos: Whether consecutive instants are consecutive pictures of videos.
        screening: What was found before the session was solved.
        still: (F,) the first picture of the run of still pictures that each belongs to; None if none were joined.

    Returns:
        The new solution and the explanation.
    """
    known = None if screening is None else screening.cause
    views = view_quality(solved)
    session = Examined(
        solved=solved, corners=corners, views=views, cameras=(), floor=False, together=True, distances={}
    )  # fmt: skip
    others, rest = explained_views(session)
    # Pictures that repeat those before them contradict the others for that reason alone.
    repeated: set[tuple[int, int]] = repeated_views(corners, still) if videos else set()
    gone = {picture for picture, _ in repeated}
    rest = [each for each in rest if each.picture not in gone]
    cause = known or (None if others else find_cause(*_without_views_of(solved, corners, repeated), videos=videos))
    if known is None and cause is not None and cause.kind in _ON_ONE_SIDE:
        return SettledSession(solved=_on_one_side(solved, corners, cause), cause=cause)
    kept = [] if others else displaced_views(session, rest)
    if len(kept) >= _ASYNCHRONOUS * (len(views.camera) + len(kept)) and kept:
        solved = refined_session(solved, corners, kept=kept)
    if screening is not None:
        solved = replace(solved, left_out=(*solved.left_out, *screening.left_out))
    return SettledSession(solved=solved, cause=cause)


def _without_views_of(
    solved: SolvedSession, corners: CornerSet, repeated: set[tuple[int, int]]
) -> tuple[SolvedSession, CornerSet]:
    """Return a session and its corners without some views, and without what was left out because of them."""
    if not repeated:
        return solved, corners
    pairs = zip(corners.picture.tolist(), corners.camera.tolist(), strict=True)
    kept = corners.subset(np.array([pair not in repeated for pair in pairs], bool))
    gone = {picture for picture, _ in repeated}
    left_out = tuple(each for each in solved.left_out if each.picture not in gone)
    return replace(solved, left_out=left_out), kept


def _on_one_side(solved: SolvedSession, corners: CornerSet, cause: Cause) -> SolvedSession:
    """Solve again without the views of a camera before or after a change, whichever are fewer."""
    own, late = corners.camera == cause.camera, corners.picture >= (cause.picture or 0)
    others = np.bincount(np.unique(np.stack([corners.picture, corners.camera], -1), axis=0)[:, 0],
                         minlength=len(corners.pictures)) > 1  # fmt: skip
    shared = others[corners.picture]
    dropped = own & (late if np.sum(own & late & shared) < np.sum(own & ~late & shared) else ~late)
    used = corners.subset(~dropped)
    again = refined_session(_placed_again(solved, used), used)
    reason = f"{_ON_ONE_SIDE[cause.kind]}: {'before' if late[dropped].sum() == 0 else 'after'} the change"
    left = [LeftOut(picture=int(p), camera=cause.camera, reason=reason) for p in np.unique(corners.picture[dropped])]
    return replace(again, left_out=(*again.left_out, *left))


def _placed_again(solved: SolvedSession, used: CornerSet) -> SolvedSession:
    """Place the boards of all pictures with the present cameras, also of those that were left out."""
    tried = np.isin(used.picture, [each.picture for each in solved.left_out if each.camera is None])
    used = used.subset(~tried)
    problem = session_problem(used, solved.adjusted.problem.board, solved.lens, solved.joined, shape=False)
    fixed = replace(problem, free=np.zeros_like(problem.free))
    found = adjust(fixed, without_extras(solved.state), rounds=1, displaced=False)
    return replace(solved, adjusted=replace(found, problem=problem), left_out=_without_views(solved))


def _without_views(solved: SolvedSession) -> tuple[LeftOut, ...]:
    return tuple(each for each in solved.left_out if each.camera is None)

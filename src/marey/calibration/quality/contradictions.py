"""What contradicts the rest of a session: exchanged cameras, a second board, cameras out of step, single pictures."""

from collections.abc import Iterator, Sequence

import numpy as np

from marey.arrays import Integers, Mask
from marey.calibration.adjustment.placement import place_board
from marey.calibration.adjustment.solve import LeftOut
from marey.calibration.adjustment.start import plane_poses
from marey.calibration.boards.corners import CornerSet
from marey.calibration.quality.finding import Examined, Finding, camera_names, picture_names
from marey.calibration.sights.own_motion import without_cleared_views
from marey.calibration.sights.resection import resect_camera
from marey.geometry.rigid import RigidTransform
from marey.wording import listed

_SOFT_SHARE = 2.0
"""Ratio of the stated errors of a view that contradicts the others from which it counts as blurred; chosen by hand."""
_FITS = 3.0
"""Ratio of the errors up to which a view that contradicts the others fits a board in another place; chosen by hand."""
_FITS_PX = 2.0
"""Median distance up to which the corners of a picture fit one board [px]; chosen by hand."""
_MOST_TRIED = 12
"""Number of contradicting pictures in which an exchange is tried, evenly distributed; chosen by hand."""
_LEAST_VIEWS = 3
"""Least number of pictures that exchanged cameras or a clock must explain; chosen by hand."""
_STANDING_VIEWS = 5
"""Least number of views that show a second board at one place; chosen by hand."""
_STANDING_SHARE = 0.3
"""Share of the contradicting views that must show it: where two views contradict each other, one is right. By hand."""
_SAME_PLACE, _SAME_TURN = 0.05, np.radians(4.0)
"""Distance [m] and angle [rad] up to which two boards stand at one place; chosen by hand."""
_DISAGREEING = 3.0
"""Ratio of the errors of corners with a common board to those with a board of their own from which a camera contradicts
the others; chosen by hand. In the session `boards3` it is 3.6 to 6.6."""
_DISAGREEING_PX = 0.15
"""Least such error that is named [px]; chosen by hand."""
_NOTABLE_DELAY = 0.1
"""Delay from which a camera is named as late, not only noted [pictures]: 3 ms at 30 pictures per second, in which a
hand moves by 6 mm. Chosen by hand."""
_STEP_SD = 4.0
"""Mean shift of a camera along the motion of the board from which it is called out of step; chosen by hand."""


def displaced_views(session: Examined, views: Sequence[LeftOut]) -> list[tuple[int, int]]:
    """Return pictures and cameras that contradict the others though their corners fit a board in another place.

    They are too many in a session whose cameras are not synchronous.

    Args:
        session: The solved session.
        views: Views that are left out without another reason.
    """
    return [(each.picture, int(each.camera or 0)) for each in views if _fits_elsewhere(session, each)]


def explained_views(session: Examined) -> tuple[list[Finding], list[LeftOut]]:
    """Return exchanged cameras and a second board, and the views that are left out for other reasons.

    Args:
        session: The solved session.
    """
    found = []
    open_views = [each for each in session.solved.left_out if each.camera is not None]
    for test in (_exchanged, _second_board):
        for finding, explained in test(session, open_views):
            found.append(finding)
            open_views = [each for each in open_views if each not in explained]
    return found, open_views


def contradicting(session: Examined) -> Iterator[Finding]:
    """Name exchanged cameras, a second board, and other pictures that contradict the rest."""
    if session.cause is None:
        found, open_views = explained_views(session)
        yield from found
    else:
        blamed = {each.camera for each in session.causes}
        known = {*blamed, *(each.other for each in session.causes), None}
        found, open_views = [], [each for each in session.solved.left_out if each.camera not in known]
        # Of two views that contradict each other both are left out: those of the camera explain the others.
        shown = set(session.corners.picture[np.isin(session.corners.camera, list(blamed))].tolist())
        open_views = [each for each in open_views if each.picture not in shown]
    if found:
        return
    if not open_views:
        return
    if session.rate is not None:
        open_views = without_cleared_views(session.corners, open_views)
    fitting = [each for each in open_views if _fits_elsewhere(session, each) and not _is_soft(session, each)]
    rest = [each for each in open_views if each not in fitting]
    for views, code, what in (
        (
            fitting,
            "out-of-sync",
            "left out, because the board is not where it was at that instant: out of step, or not the same instant",
        ),
        (rest, "bad-picture", "left out, in contradiction to the others: blurred, covered or wrongly found"),
    ):
        for camera in sorted({int(each.camera or 0) for each in views}):
            own = [each.picture for each in views if each.camera == camera]
            yield Finding(
                code=code, severity="caution",
                text=f"{session.corners.cameras[camera]}: {picture_names(session, own)} {what}.",
                advice="Move the board slowly, and check the synchronisation.",
            )  # fmt: skip


def _rows_of(session: Examined, view: LeftOut) -> Mask:
    return np.asarray((session.corners.picture == view.picture) & (session.corners.camera == view.camera))


def _unit(session: Examined) -> float:
    """Return the usual error of a corner [px]."""
    return max(float(np.median(np.linalg.norm(session.solved.adjusted.residual, axis=1))) / 1.1774, 1e-3)


def _fits_elsewhere(session: Examined, view: LeftOut) -> bool:
    """Return whether a view that contradicts the others fits a board in another place."""
    rows = _rows_of(session, view)
    found = resect_camera(session.solved, session.corners.subset(rows), int(view.camera or 0), boards=None)
    return found is not None and found.rms_px < _FITS * max(_unit(session), 0.1)


def _is_soft(session: Examined, view: LeftOut) -> bool:
    """Return whether the corners of a view are much less certain than usual, as in a blurred picture."""
    sd = np.sqrt(0.5 * np.trace(session.corners.covariance, axis1=1, axis2=2))
    return bool(np.median(sd[_rows_of(session, view)]) > _SOFT_SHARE * np.median(sd))


def _picture_rows(session: Examined, picture: int) -> Mask:
    return np.asarray(session.corners.picture == picture)


def _exchanged(session: Examined, views: list[LeftOut]) -> Iterator[tuple[Finding, list[LeftOut]]]:
    """Find pairs of cameras whose pictures fit when they are exchanged."""
    every = sorted({each.picture for each in views})
    pictures = every[:: -(-len(every) // _MOST_TRIED)] if every else []
    cameras = sorted({int(each.camera or 0) for each in views})
    used: set[int] = set()
    for first in cameras:
        for second in (each for each in cameras if each > first and not {first, each} & used):
            shown = [each for each in pictures if _shows(session, each, first) or _shows(session, each, second)]
            explained = [each for each in shown if _fits_exchanged(session, each, first, second)]
            if len(explained) >= max(_LEAST_VIEWS, 0.5 * len(shown)):
                used |= {first, second}
                finding = Finding(
                    code="cameras-exchanged", severity="problem",
                    text=f"{camera_names(session, (first, second))}: {picture_names(session, explained)} fit when the "
                        "two cameras are exchanged.",
                    advice="Give the files the names of their cameras again.",
                )  # fmt: skip
                yield finding, [each for each in views if each.camera in (first, second)]


def _placed(session: Examined, corners: CornerSet, cameras: Integers) -> tuple[RigidTransform, float] | None:
    return place_board(session.solved.adjusted.problem.board, session.solved.state, corners, cameras)


def _shows(session: Examined, picture: int, camera: int) -> bool:
    return bool(np.any(_picture_rows(session, picture) & (session.corners.camera == camera)))


def _fits_exchanged(session: Examined, picture: int, first: int, second: int) -> bool:
    """Return whether a picture fits if two cameras are exchanged, and not as it is."""
    corners = session.corners.subset(_picture_rows(session, picture))
    if len(np.unique(corners.camera)) < 2:
        return False
    other = np.where(corners.camera == first, second, np.where(corners.camera == second, first, corners.camera))
    found = _placed(session, corners, other)
    own = _placed(session, corners, corners.camera)
    return found is not None and own is not None and found[1] < _FITS_PX and found[1] < 0.3 * own[1]


def _second_board(session: Examined, views: list[LeftOut]) -> Iterator[tuple[Finding, list[LeftOut]]]:
    """Find a board that stands at one place while the other is carried."""
    poses, shown, state = [], [], session.solved.state
    pairs = zip(session.corners.view_picture.tolist(), session.corners.view_camera.tolist(), strict=True)
    number = {pair: view for view, pair in enumerate(pairs)}
    board = session.solved.adjusted.problem.board
    for each in views:
        camera = int(each.camera or 0)
        view = number.get((each.picture, camera))
        for own in () if view is None else plane_poses(session.corners, board, state.lens, view)[:1]:
            back = RigidTransform(state.camera_rotation[camera], state.camera_translation[camera]).inverse()
            poses.append(back @ own)
            shown.append(each)
    if len(poses) < _STANDING_VIEWS:
        return
    middle = np.stack([each.apply(session.solved.adjusted.problem.board.centre) for each in poses])
    normal = np.stack([each.rotation[:, 2] for each in poses])
    near = np.linalg.norm(middle[:, None] - middle, axis=-1) < _SAME_PLACE
    near &= np.arccos(np.clip(normal @ normal.T, -1, 1)) < _SAME_TURN
    # Pictures that follow each other show a carried board near one place, too.
    pictures = np.array([each.picture for each in shown])
    spread = [len(np.unique(pictures[row] // _APART)) for row in near]
    best = near[int(np.argmax(spread))]
    if max(spread) < _STANDING_VIEWS or best.sum() < _STANDING_SHARE * len(views):
        return
    found = [each for each, own in zip(shown, best, strict=True) if own]
    cameras = sorted({int(each.camera or 0) for each in found})
    place = ", ".join(f"{value:.1f}" for value in np.median(middle[best], axis=0))
    finding = Finding(
        code="second-board", severity="problem",
        text=f"{camera_names(session, cameras)}: {picture_names(session, [each.picture for each in found])} show a "
            f"second print of the board, which stands at one place ({place} m).",
        advice="These views are left out. Cover or remove the other print: its numbers are the same.",
    )  # fmt: skip
    pictures_of = {each.picture for each in found}
    yield finding, [each for each in views if each.picture in pictures_of]


_APART = 5
"""Number of pictures that count as one when the views of a second board are counted; chosen by hand."""


def late_cameras(session: Examined) -> Iterator[Finding]:
    """Name cameras whose pictures were all late or early by whole pictures."""
    for name, pictures in session.late.items():
        seconds = f" ({abs(pictures) / session.rate:.2f} s)" if session.rate else ""
        count = f"{abs(pictures)} picture{'s' if abs(pictures) != 1 else ''}{seconds}"
        yield Finding(
            code="camera-late", severity="caution",
            text=f"{name} shows everything {count} {'later' if pictures > 0 else 'earlier'} than the other cameras.",
            advice="This was allowed for, so the cameras are right. Start all cameras together, or synchronise the "
                "recordings (marey sync).",
        )  # fmt: skip
    yield from _late_by_wand(session)


def _late_by_wand(session: Examined) -> Iterator[Finding]:
    """Name cameras whose delays were estimated with a wand, and those whose delays are not determined."""
    for each in session.delays:
        name, interval = session.corners.cameras[each.camera], 1.96 * each.sd
        if not each.known:
            yield Finding(
                code="clock-unknown", severity="note",
                text=f"Whether {name} is in step with the other cameras cannot be seen: the wand hardly moves in the "
                    "pictures that it shares with them.",
                advice=f"Wave the wand before {name} where another camera sees it, too.",
            )  # fmt: skip
        elif each.used:
            seconds = f" ({1e3 * abs(each.pictures) / session.rate:.1f} ms)" if session.rate else ""
            digits = 2 if abs(each.pictures) >= _NOTABLE_DELAY else 4
            yield Finding(
                code="camera-late", severity="caution" if abs(each.pictures) >= _NOTABLE_DELAY else "note",
                text=f"{name} shows everything {abs(each.pictures):.{digits}f} +- {interval:.{max(digits, 3)}f} "
                    f"pictures{seconds} {'later' if each.pictures > 0 else 'earlier'} than the other cameras.",
                advice="This was allowed for, so the cameras are right. Start all cameras together, or synchronise the "
                    "recordings (marey sync).",
            )  # fmt: skip


def out_of_step(session: Examined) -> Iterator[Finding]:
    """Find cameras that see the board always before or behind the others along its motion."""
    spread = session.solved.adjusted.spread
    if max(spread) == 0.0 or not session.together:
        return
    worst = _contradicting_cameras(session)
    if worst:
        yield Finding(
            code="cameras-disagree", severity="caution",
            text=f"The boards of different cameras disagree: {worst}, though each camera by itself fits them better by "
                f"a factor of {_DISAGREEING:g} or more.",
            advice="The first camera named is off most. Hold the board still for each picture, and check that all "
                "cameras show the same instant and that none moved.",
        )  # fmt: skip
    if 1e3 * spread[1] > 1.0:
        yield Finding(
            code="unsynchronised", severity="caution",
            text=f"The cameras see the board {1e3 * spread[1]:.1f} mm and {np.degrees(spread[0]):.2f} deg apart at the "
            "same instant: they are not exactly synchronous, or the shutters roll.",
            advice="Move the board slowly and hold it still often, or synchronise the cameras.",
        )  # fmt: skip
    for camera, frames, significance in steps(session):
        if significance > _STEP_SD:
            yield Finding(
                code="camera-out-of-step", severity="caution",
                text=f"{session.corners.cameras[camera]} is {frames:+.2f} pictures from the mean clock of the cameras.",
                advice="Synchronise the recordings before the calibration.",
            )  # fmt: skip


def _contradicting_cameras(session: Examined) -> str:
    """Return the cameras whose boards fit alone but not together with the others, the worst first; empty if none."""
    views, found = session.views, []
    # What is left of a view's residuals without a displacement of its board.
    alone = views.scatter * views.corner_sd_px * np.sqrt(2.0)
    for camera in np.unique(views.camera):
        own = views.camera == camera
        joint = float(np.median(views.error_px[own]))
        if joint > max(_DISAGREEING * float(np.median(alone[own])), _DISAGREEING_PX):
            found.append((joint, session.corners.cameras[int(camera)]))
    return listed([f"{name} by {joint:.2f} px" for joint, name in sorted(found, reverse=True)]) if found else ""


def steps(session: Examined) -> list[tuple[int, float, float]]:
    """Estimate how far each camera's clock is off, from the displacements of its boards along their motion.

    Args:
        session: The solved session, whose pictures follow each other at a constant rate.

    Returns:
        Camera, offset [pictures], and its significance in standard deviations.
    """
    solved, views = session.solved, session.views
    state, problem = solved.state, solved.adjusted.problem
    middle = state.board_translation + state.board_rotation @ problem.board.centre
    known = np.unique(views.picture)
    velocity = {int(k): middle[k + 1] - middle[k - 1] for k in known if {k - 1, k + 1} <= set(known.tolist())}
    shift = solved.adjusted.systems.displacement[:, 3:] * solved.adjusted.spread[1]
    found = []
    for camera in np.unique(views.camera):
        own = [k for k in np.flatnonzero(views.camera == camera) if int(views.picture[k]) in velocity]
        if len(own) < _LEAST_VIEWS:
            continue
        speed = 0.5 * np.stack([velocity[int(views.picture[k])] for k in own])
        total = float(np.sum(speed**2))
        step = float(np.sum(speed * shift[own])) / max(total, 1e-12)
        rest = shift[own] - step * speed
        sd = float(np.sqrt(np.sum(np.square(np.sum(speed * rest, axis=1))))) / max(total, 1e-12)
        found.append((int(camera), step, abs(step) / max(sd, 1e-9)))
    return found

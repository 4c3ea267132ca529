"""What is wrong in a calibration session, or could be better, each with what to film next."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.calibration.adjustment.placement import place_board
from marey.calibration.adjustment.resection import Resected, resect_camera
from marey.calibration.adjustment.solve import LeftOut, SolvedSession
from marey.calibration.boards.corners import CornerSet
from marey.calibration.quality.views import COVERAGE, CameraQuality, ViewQuality
from marey.calibration.quality.world import centres
from marey.geometry.rigid import RigidTransform
from marey.wording import listed

Severity = Literal["problem", "caution", "note"]
"""Whether the result is wrong, less accurate than it could be, or only remarkable."""

_LEAST_PICTURES = 8
"""Number of pictures of a camera below which its lens is badly determined; chosen by hand."""
_LEAST_TILT = 25.0
"""Least range of the boards' tilts for a lens [deg]: with less, focal length and distance are not separated. By
hand."""
_LEAST_DEPTH = 1.3
"""Least ratio of the largest to the smallest distance of the boards; chosen by hand."""
_GREATEST_FOCAL_SD = 0.5
"""Standard deviation of a focal length beyond which tilt and depth are too small [%]; chosen by hand."""
_SOFT = 4.0
"""Ratio of a view's corner errors to the usual ones from which its picture is called blurred; chosen by hand."""
_SOFT_SHARE = 2.0
"""Ratio of the stated errors of a view that contradicts the others from which it counts as blurred; chosen by hand."""
_FITS = 3.0
"""Ratio of the errors up to which a view that contradicts the others fits a board in another place; chosen by hand."""
_MOVED_SHARE = 0.7
"""Share of the pictures before or after an instant that must contradict the others if a camera moved; by hand."""
_MOVED_PRESENT = 0.8
"""Share of the contradicting pictures that a camera must show if it moved; chosen by hand."""
_MOVED_PX = 5.0
"""Median distance up to which corners fit another pose of a camera, before boards that single cameras place [px];
by hand."""
_FITS_PX = 2.0
"""Median distance up to which the corners of a picture fit one board [px]; chosen by hand."""
_MOST_TRIED = 40
"""Number of contradicting pictures that are tried at most; chosen by hand."""
_MOVED_VIEWS = 3
"""Least number of views from which a camera's second pose is estimated; chosen by hand."""
_BENT_PX = 0.05
"""Mean residual of a cell of the image from which the lens model is called insufficient [px]; chosen by hand."""
_BENT_SD = 5.0
"""The same in standard deviations; chosen by hand."""
_STRETCHED = 1.5e-3
"""Difference of the sides of a board's squares from which it is named, as a ratio; chosen by hand."""
_BENT_MM = 0.5
"""Sag of a board from which it is named [mm]; chosen by hand."""
_WRONG_SCALE = 0.01
"""Difference of a known distance from which the size of the squares is called wrong, as a ratio; chosen by hand."""
_STEP_SD = 4.0
"""Mean shift of a camera along the motion of the board from which it is called out of step; chosen by hand."""
_NARROW = 0.2
"""Side of the corner regions of an image, as a share of its sides; chosen by hand."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Something that is wrong, or could be better."""

    code: str
    """Name for programs, for example `camera-moved`."""
    severity: Severity
    text: str
    """What was found, as a sentence."""
    advice: str
    """What to do or to film next, as a sentence."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Examined:
    """Everything that the examination of a session uses."""

    solved: SolvedSession
    corners: CornerSet
    """All corners that were measured, also those that were left out."""
    views: ViewQuality
    cameras: tuple[CameraQuality, ...]
    floor: bool
    """Whether the world was set by the board on the floor."""
    together: bool
    """Whether the cameras recorded at the same time."""
    distances: Mapping[tuple[str, str], float]
    """Known distances between cameras by their names [m]."""


def examine(session: Examined) -> tuple[Finding, ...]:
    """Find what is wrong in a session.

    Args:
        session: The solved session.

    Returns:
        The findings, problems first.
    """
    tests = (_layout, _mirrored, _unseen, _unjoined, _left_out, _blurred, _lens_pattern, _weak_lenses, _uncovered,
             _shape, _scale, _out_of_step, _no_floor)  # fmt: skip
    found = [finding for test in tests for finding in test(session)]
    order = ("problem", "caution", "note")
    return tuple(sorted(found, key=lambda each: order.index(each.severity)))


def _names(session: Examined, cameras: Sequence[int] | Integers) -> str:
    return listed([session.corners.cameras[int(camera)] for camera in cameras])


def _pictures(session: Examined, pictures: Sequence[int] | Integers) -> str:
    return listed([session.corners.pictures[int(picture)] for picture in pictures], most=6)


def _layout(session: Examined) -> Iterator[Finding]:
    """A board of other columns, rows or markers: no plane explains the corners of any picture."""
    size = np.median([max(each) for each in session.corners.sizes])
    wrong = [each for each in session.cameras if each.corners and each.median_px > 0.004 * size]
    if wrong and len(wrong) >= 0.5 * sum(each.corners > 0 for each in session.cameras):
        worst = max(each.median_px for each in wrong)
        board = session.solved.adjusted.problem.board.describe()
        yield Finding(
            code="board-layout", severity="problem",
            text=f"The corners do not lie where a {board} has them (off by {worst:.1f} px).",
            advice="Compare columns, rows, dictionary, first marker and legacy_pattern in the board file with the "
                "print.",
        )  # fmt: skip


def _mirrored(session: Examined) -> Iterator[Finding]:
    """A mirrored print: all boards are seen from behind."""
    problem, state = session.solved.adjusted.problem, session.solved.state
    if problem.board.two_sided:
        return
    corners = session.solved.corners
    pose, camera = problem.pose[corners.view_picture], corners.view_camera
    middle = state.board_translation[pose] + state.board_rotation[pose] @ problem.board.centre
    ray = middle - centres(state)[camera]
    behind = np.sum(ray * state.board_rotation[pose][:, :, 2], axis=1) < 0
    if len(behind) and np.mean(behind) > 0.5:
        yield Finding(
            code="mirrored-print", severity="problem",
            text="The board is seen as its mirror image: the print is mirrored, or the videos are flipped.",
            advice="Print the board again without mirroring, or switch off the mirroring of the cameras.",
        )  # fmt: skip


def _unseen(session: Examined) -> Iterator[Finding]:
    for each in session.cameras:
        if each.pictures == 0:
            yield Finding(
                code="camera-unseen", severity="problem",
                text=f"The board was not found in any picture of {each.name}.",
                advice="Film the board before this camera, nearer and facing it.",
            )  # fmt: skip
        elif each.pictures < _LEAST_PICTURES:
            yield Finding(
                code="few-pictures", severity="caution",
                text=f"{each.name} shows the board in only {each.pictures} pictures.",
                advice=f"Film the board before {each.name} in at least {_LEAST_PICTURES} different poses.",
            )  # fmt: skip


def _unjoined(session: Examined) -> Iterator[Finding]:
    groups = [np.flatnonzero(session.solved.joined == each) for each in np.unique(session.solved.joined)]
    groups = [each for each in groups if any(session.cameras[int(k)].pictures for k in each)]
    if session.together and len(groups) > 1:
        parts = " | ".join(_names(session, each) for each in groups)
        yield Finding(
            code="not-connected", severity="problem",
            text=f"No common pictures connect these cameras, or they do not agree: {parts}.",
            advice="Carry the board through places that cameras of both groups see at the same time, and check that "
                "they are synchronous.",
        )  # fmt: skip
    for vote in session.solved.votes if session.together else ():
        if vote.agreeing < 0.6 * vote.common and vote.common >= 5:
            first, second = session.corners.cameras[vote.first], session.corners.cameras[vote.second]
            yield Finding(
                code="pair-disagrees", severity="caution",
                text=f"Only {vote.agreeing} of {vote.common} common pictures of {first} and {second} agree on their "
                "relative pose.",
                advice="Check that both recorded at the same time and that neither moved.",
            )  # fmt: skip


def unexplained_views(session: Examined) -> list[tuple[int, int]]:
    """Return pictures and cameras that contradict the others though their corners fit a board in another place.

    They are too many in a session whose cameras are not synchronous. Cameras that moved or were exchanged explain
    theirs.

    Args:
        session: The solved session.
    """
    _, rest = _explained(session)
    return [(each.picture, int(each.camera or 0)) for each in rest if _fits_elsewhere(session, each)]


def _explained(session: Examined) -> tuple[list[Finding], list[LeftOut]]:
    """Return cameras that moved or were exchanged, and the views that are left out for other reasons."""
    found = []
    open_views = [each for each in session.solved.left_out if each.camera is not None]
    for test in (_exchanged, _moved):
        for finding, explained in test(session, open_views):
            found.append(finding)
            open_views = [each for each in open_views if each not in explained]
    return found, open_views


def _left_out(session: Examined) -> Iterator[Finding]:
    """Name cameras that moved or were exchanged, and other pictures that contradict the rest."""
    found, open_views = _explained(session)
    yield from found
    if not open_views:
        return
    fitting = [each for each in open_views if _fits_elsewhere(session, each) and not _is_soft(session, each)]
    rest = [each for each in open_views if each not in fitting]
    for views, code, what in (
        (
            fitting,
            "out-of-sync",
            "shows the board where it was not at that instant: out of step, or not the same instant",
        ),
        (rest, "bad-picture", "contradicts the others: blurred, covered or wrongly found"),
    ):
        for camera in sorted({int(each.camera or 0) for each in views}):
            own = [each.picture for each in views if each.camera == camera]
            yield Finding(
                code=code, severity="caution",
                text=f"{session.corners.cameras[camera]}: {_pictures(session, own)} {what}.",
                advice="They are left out. Move the board slowly, and check the synchronisation.",
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
    pictures = sorted({each.picture for each in views})[:_MOST_TRIED]
    cameras = sorted({int(each.camera or 0) for each in views})
    used: set[int] = set()
    for first in cameras:
        for second in (each for each in cameras if each > first and not {first, each} & used):
            shown = [each for each in pictures if _shows(session, each, first) or _shows(session, each, second)]
            explained = [each for each in shown if _fits_exchanged(session, each, first, second)]
            if len(explained) >= max(_MOVED_VIEWS, 0.5 * len(shown)):
                used |= {first, second}
                finding = Finding(
                    code="cameras-exchanged", severity="problem",
                    text=f"{_names(session, (first, second))}: {_pictures(session, explained)} fit when the two "
                        "cameras are exchanged.",
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


def _moved(session: Examined, views: list[LeftOut]) -> Iterator[tuple[Finding, list[LeftOut]]]:
    """Find cameras whose pictures from an instant on, or up to it, fit one other pose of the camera."""
    pictures = sorted({each.picture for each in views})
    if len(pictures) < _MOVED_VIEWS:
        return
    seen = [
        np.mean([_shows(session, each, camera) for each in pictures]) for camera in range(len(session.corners.cameras))
    ]
    for camera in np.argsort(-np.array(seen), kind="stable"):
        if seen[camera] < _MOVED_PRESENT:
            return
        found = _second_pose(session, int(camera), pictures)
        if found is not None:
            second, when = found
            turn, shift = second.displacement(session.solved.state, int(camera))
            finding = Finding(
                code="camera-moved", severity="problem",
                text=f"{session.corners.cameras[camera]} moved {when}, by about {turn:.1f} deg and "
                    f"{1e3 * shift:.0f} mm.",
                advice="Pictures on one side of that instant are left out. Fasten the camera, and film again if it "
                    "moved before the recordings.",
            )  # fmt: skip
            yield finding, views
            return


def _second_pose(session: Examined, camera: int, pictures: list[int]) -> tuple[Resected, str] | None:
    """Estimate another pose of a camera from pictures, if they are all on one side of an instant."""
    corners = session.corners
    shared = [int(p) for p in np.unique(corners.picture[corners.camera == camera]) if _others(session, int(p), camera)]
    late = [each for each in shared if each >= pictures[0]]
    early = [each for each in shared if each <= pictures[-1]]
    own = set(pictures)
    for side, when in (
        (late, f"before {corners.pictures[pictures[0]]}"),
        (early, f"after {corners.pictures[pictures[-1]]}"),
    ):
        if len(side) == len(shared) or np.mean([each in own for each in side]) < _MOVED_SHARE:
            continue
        boards = {}
        for picture in pictures[:_MOST_TRIED]:
            rows = _picture_rows(session, picture) & (corners.camera != camera)
            found = _placed(session, corners.subset(rows), corners.camera[rows]) if rows.any() else None
            if found is not None and found[1] < _FITS_PX and _shows(session, picture, camera):
                boards[picture] = found[0]
        rows = np.isin(corners.picture, list(boards)) & (corners.camera == camera)
        resected = (
            resect_camera(session.solved, corners.subset(rows), camera, boards=boards) if len(boards) > 2 else None
        )
        if resected is not None and resected.rms_px < _MOVED_PX:
            return resected, when
    return None


def _others(session: Examined, picture: int, camera: int) -> bool:
    return bool(np.any(_picture_rows(session, picture) & (session.corners.camera != camera)))


def _blurred(session: Examined) -> Iterator[Finding]:
    """Name pictures whose corners scatter much more than usual, though they were used."""
    views = session.views
    spread = views.corner_sd_px * np.maximum(views.scatter, 1.0)
    usual = float(np.median(spread)) if len(spread) else 0.0
    soft = np.flatnonzero((spread > _SOFT * usual) & (spread > 0.3))
    for camera in np.unique(views.camera[soft]):
        own = views.picture[soft][views.camera[soft] == camera]
        yield Finding(
            code="blurred-picture", severity="note",
            text=f"{session.corners.cameras[int(camera)]}: {_pictures(session, own)} blurred: the corners scatter by "
                f"more than {_SOFT:g} times the usual {usual:.2f} px.",
            advice="They have a low weight. Move the board slowly, or expose for a shorter time.",
        )  # fmt: skip


def _lens_pattern(session: Examined) -> Iterator[Finding]:
    """Find cameras whose residuals have a pattern over the image that the lens model does not describe."""
    corners, residual = session.solved.corners, session.solved.adjusted.residual
    for camera, size in enumerate(corners.sizes):
        own = (corners.camera == camera) & np.isfinite(residual).all(axis=1)
        if np.count_nonzero(own) < 100:
            continue
        amplitude, significance = _pattern(corners.pixels[own], residual[own], corners.view[own], size)
        if amplitude > _BENT_PX and significance > _BENT_SD:
            yield Finding(
                code="lens-model", severity="caution",
                text=f"{corners.cameras[camera]}: the residuals have a pattern over the image ({amplitude:.2f} px) "
                    "that the lens model does not describe.",
                advice="Film the board in all parts of its image; check that zoom, focus and stabilisation are off.",
            )  # fmt: skip


def _pattern(pixels: Floats, residual: Floats, view: Integers, size: tuple[int, int]) -> tuple[float, float]:
    """Return the root mean square of the cells' mean residuals [px], and its excess in standard deviations."""
    rows, columns = COVERAGE
    cell = np.clip((pixels[:, 1] + 0.5) * rows // size[1], 0, rows - 1) * columns
    cell = (cell + np.clip((pixels[:, 0] + 0.5) * columns // size[0], 0, columns - 1)).astype(int)
    # Corners of one picture in one cell share errors: the pictures' means count, not the corners.
    key, inverse = np.unique(np.stack([cell, view], axis=-1), axis=0, return_inverse=True)
    inverse = np.ravel(inverse)
    count = np.bincount(inverse)
    mean = np.stack([np.bincount(inverse, residual[:, k]) / count for k in range(2)], axis=-1)
    own = np.ravel(np.unique(key[:, 0], return_inverse=True)[1])
    number = np.bincount(own)
    average = np.stack([np.bincount(own, mean[:, k]) / number for k in range(2)], axis=-1)
    scatter = np.square(mean - average[own]).sum(axis=1)
    variance = np.bincount(own, scatter) / np.maximum(number - 1, 1) / number
    good = number >= 5
    if np.count_nonzero(good) < 4:
        return 0.0, 0.0
    square, expected = np.square(average[good]).sum(axis=1), variance[good]
    excess = float(np.sum(square - expected))
    sd = float(np.sqrt(np.sum(expected**2)))
    return float(np.sqrt(max(excess, 0.0) / np.count_nonzero(good))), excess / max(sd, 1e-12)


def _weak_lenses(session: Examined) -> Iterator[Finding]:
    for each in session.cameras:
        if each.pictures < 2:
            continue
        focal = 100 * float(each.lens_sd[0] / each.lens[0])
        tilt = each.tilt_deg[1] - each.tilt_deg[0]
        flat, shallow = tilt < _LEAST_TILT, each.distance_m[1] < _LEAST_DEPTH * each.distance_m[0]
        if flat or (shallow and focal > 0.3 * _GREATEST_FOCAL_SD):
            what = f"the tilt of the board varies by only {tilt:.0f} deg" if flat else "the board is always equally far"
            yield Finding(
                code="little-tilt" if flat else "little-depth", severity="caution",
                text=f"{each.name}: {what} (focal length to {focal:.2f} %).",
                advice=f"Film the board before {each.name} tilted by 30 to 50 degrees both ways, near and far.",
            )  # fmt: skip
        elif focal > _GREATEST_FOCAL_SD:
            yield Finding(
                code="weak-focal-length", severity="caution",
                text=f"{each.name}: the focal length is known to {focal:.2f} % only.",
                advice=f"Film the board nearer to {each.name} and tilted, in all parts of its image.",
            )  # fmt: skip


def _uncovered(session: Examined) -> Iterator[Finding]:
    corners = session.solved.corners
    labels = {"top left": (0, 0), "top right": (1, 0), "bottom left": (0, 1), "bottom right": (1, 1)}
    for camera, size in enumerate(corners.sizes):
        share = (corners.pixels[corners.camera == camera] + 0.5) / size
        if not len(share):
            continue
        empty = []
        for label, (right, low) in labels.items():
            x, y = (1 - share[:, 0] if right else share[:, 0]), (1 - share[:, 1] if low else share[:, 1])
            if not np.any((x < _NARROW) & (y < _NARROW)):
                empty.append(label)
        if empty:
            yield Finding(
                code="uncovered-corner", severity="note",
                text=f"{corners.cameras[camera]}: no board in the {listed(empty)} of the image; the lens is "
                    "extrapolated there.",
                advice=f"Film the board in the {listed(empty)} of the image of {corners.cameras[camera]}.",
            )  # fmt: skip


def _shape(session: Examined) -> Iterator[Finding]:
    if not session.solved.shape:
        return
    board, shape = session.solved.adjusted.problem.board, session.solved.state.shape
    if abs(shape[0]) > _STRETCHED:
        ratio = 1 + shape[0]
        yield Finding(
            code="squares-not-square", severity="caution",
            text=f"The squares of the board are {ratio:.4f} times as high as wide.",
            advice="Measure the print both ways; printers often stretch one side. The result allows for it.",
        )  # fmt: skip
    half = 0.5 * board.extent
    sag = 1e3 * float(
        max(abs(shape[1]) * half[0] ** 2, abs(shape[3]) * half[1] ** 2, abs(shape[2]) * half[0] * half[1])
    )
    if sag > _BENT_MM:
        yield Finding(
            code="bent-board", severity="caution", text=f"The board is bent by {sag:.1f} mm.",
            advice="Glue the print to a stiff plate. The result allows for a constant bend.",
        )  # fmt: skip


def _scale(session: Examined) -> Iterator[Finding]:
    board = session.solved.adjusted.problem.board
    if board.square_assumed:
        yield Finding(
            code="assumed-scale", severity="note",
            text="The side of the squares is assumed: all distances are in its proportion only.",
            advice="Measure the squares and correct the board file.",
        )  # fmt: skip
    place = dict(zip(session.corners.cameras, centres(session.solved.state), strict=True))
    for (first, second), known in session.distances.items():
        ratio = float(np.linalg.norm(place[first] - place[second])) / known
        if abs(ratio - 1) > _WRONG_SCALE:
            right = 1e3 * board.square / ratio
            yield Finding(
                code="square-size", severity="problem",
                text=f"{first} and {second} are {100 * (ratio - 1):+.1f} % from their known distance of {known:g} m.",
                advice=f"If that distance is right, the squares measure {right:.2f} mm, not {1e3 * board.square:g} mm.",
            )  # fmt: skip


def _out_of_step(session: Examined) -> Iterator[Finding]:
    """Find cameras that see the board always before or behind the others along its motion."""
    spread = session.solved.adjusted.spread
    if max(spread) == 0.0 or not session.together:
        return
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
        if len(own) < _MOVED_VIEWS:
            continue
        speed = 0.5 * np.stack([velocity[int(views.picture[k])] for k in own])
        total = float(np.sum(speed**2))
        step = float(np.sum(speed * shift[own])) / max(total, 1e-12)
        rest = shift[own] - step * speed
        sd = float(np.sqrt(np.sum(np.square(np.sum(speed * rest, axis=1))))) / max(total, 1e-12)
        found.append((int(camera), step, abs(step) / max(sd, 1e-9)))
    return found


def _no_floor(session: Examined) -> Iterator[Finding]:
    if not session.floor and session.together:
        yield Finding(
            code="no-floor", severity="note",
            text="No picture shows the board at rest on the floor: the world is level with the cameras only.",
            advice="Lay the board on the floor for a second where several cameras see it, or give its pictures "
                "(--floor).",
        )  # fmt: skip

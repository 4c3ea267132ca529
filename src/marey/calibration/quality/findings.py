"""What is wrong in a calibration session, or could be better, each with what to film next."""

from collections.abc import Iterator

import numpy as np

from marey.calibration.boards.board import CalibrationBoard
from marey.calibration.boards.wand import CalibrationWand
from marey.calibration.quality.cause_words import CONSEQUENCES, explaining
from marey.calibration.quality.contradictions import contradicting, late_cameras, out_of_step
from marey.calibration.quality.finding import Examined, Finding, camera_names, picture_names
from marey.calibration.quality.fisheye import fisheye_lenses
from marey.calibration.quality.image_geometry import image_geometry, repeated_pictures
from marey.calibration.quality.lens_pattern import lens_patterns
from marey.calibration.quality.world import boards_lie_above, centres
from marey.wording import listed

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
_STRETCHED = 1.5e-3
"""Difference of the sides of a board's squares from which it is named, as a ratio; chosen by hand."""
_BENT_MM = 0.5
"""Sag of a board from which it is named [mm]; chosen by hand."""
_WRONG_SCALE = 0.01
"""Difference of a known distance from which the size of the squares is called wrong, as a ratio; chosen by hand."""
_NARROW = 0.2
"""Side of the corner regions of an image, as a share of its sides; chosen by hand."""


def examine(session: Examined) -> tuple[Finding, ...]:
    """Find what is wrong in a session.

    Args:
        session: The solved session.

    Returns:
        The findings, problems first.
    """
    tests = (_layout, _mirrored, _unseen, _unjoined, repeated_pictures, explaining, contradicting, _blurred,
             fisheye_lenses, lens_patterns, _weak_lenses, image_geometry, _uncovered, _shape, _scale, _landmarks,
             late_cameras, out_of_step, _floor)  # fmt: skip
    found = [finding for test in tests for finding in test(session)]
    if any(each.code == "board-layout" for each in found):
        # Nothing else can be judged.
        found = [each for each in found if each.code in ("board-layout", "camera-unseen")]
    explained = {each.code for each in found} & _EXPLANATIONS
    if explained:
        # What differs from picture to picture may be several things.
        kept = explained | ({"cameras-disagree"} if explained <= {"image-unsteady", "camera-irregular"} else set())
        found = [each for each in found if each.code in kept or each.code not in CONSEQUENCES]
    order = ("problem", "caution", "note")
    return tuple(sorted(found, key=lambda each: order.index(each.severity)))


_EXPLANATIONS = {
    "board-layout", "camera-moved", "lens-changed", "image-turned", "pictures-lost", "camera-out-of-step",
    "clock-drift", "rolling-shutter", "image-unsteady", "camera-irregular", "cameras-exchanged", "second-board",
    "points-mirrored", "points-scale", "points-exchanged", "pictures-repeated", "fisheye-lens",
}  # fmt: skip
"""Findings beside which `CONSEQUENCES` are not stated."""


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
    if not isinstance(problem.board, CalibrationBoard) or problem.board.two_sided:
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
        parts = " | ".join(camera_names(session, each) for each in groups)
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
            text=f"{session.corners.cameras[int(camera)]}: {picture_names(session, own)} blurred: the corners scatter "
                f"by more than {_SOFT:g} times the usual {usual:.2f} px.",
            advice="They have a low weight. Move the board slowly, or expose for a shorter time.",
        )  # fmt: skip


def _weak_lenses(session: Examined) -> Iterator[Finding]:
    for each in session.cameras:
        if each.pictures < 2 or not each.lens_sd[0]:
            continue
        focal = 100 * float(each.lens_sd[0] / each.lens[0])
        tilt = each.tilt_deg[1] - each.tilt_deg[0]
        # The tilt of a wand does not matter, and is not known.
        near, far = each.distance_m
        flat, shallow = tilt < _LEAST_TILT, far < _LEAST_DEPTH * near
        found = []
        if flat:
            found.append((tilt / _LEAST_TILT, "little-tilt", f"the tilt of the board varies by only {tilt:.0f} deg"))
        if shallow and (flat or focal > 0.3 * _GREATEST_FOCAL_SD):
            share = (far / near - 1.0) / (_LEAST_DEPTH - 1.0)
            found.append((share, "little-depth", f"the board is always about equally far, {near:.1f} to {far:.1f} m"))
        # What is farther from enough comes first.
        for _, code, what in sorted(found):
            yield Finding(
                code=code, severity="caution", text=f"{each.name}: {what} (focal length to {focal:.2f} %).",
                advice=f"Film the board before {each.name} tilted by 30 to 50 degrees both ways, near and far.",
            )  # fmt: skip
        if not found and focal > _GREATEST_FOCAL_SD:
            yield Finding(
                code="weak-focal-length", severity="caution",
                text=f"{each.name}: the focal length is known to {focal:.2f} % only.",
                advice=f"Film the board nearer to {each.name} and tilted, in all parts of its image.",
            )  # fmt: skip


def _uncovered(session: Examined) -> Iterator[Finding]:
    """Name the corners of images in which no board was seen, cameras with the same ones together."""
    corners = session.solved.corners
    labels = {"top left": (0, 0), "top right": (1, 0), "bottom left": (0, 1), "bottom right": (1, 1)}
    alike: dict[tuple[str, ...], list[int]] = {}
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
            alike.setdefault(tuple(empty), []).append(camera)
    for where, cameras in alike.items():
        names, image = camera_names(session, cameras), "image" if len(cameras) == 1 else "images"
        places = f"four corners of the {image}" if len(where) == len(labels) else f"{listed(where)} of the {image}"
        yield Finding(
            code="uncovered-corner", severity="note",
            text=f"{names}: no board in the {places}; the lens is extrapolated there.",
            advice=f"Film the board in the {places} of {names}.",
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
    if isinstance(board, CalibrationBoard) and board.square_assumed:
        yield Finding(
            code="assumed-scale", severity="note",
            text="The side of the squares is assumed: all distances are in its proportion only.",
            advice="Measure the squares and correct the board file.",
        )  # fmt: skip
    place = dict(zip(session.corners.cameras, centres(session.solved.state), strict=True))
    for (first, second), known in session.distances.items():
        ratio = float(np.linalg.norm(place[first] - place[second])) / known
        if abs(ratio - 1) > _WRONG_SCALE:
            yield Finding(
                code="square-size", severity="problem",
                text=f"{first} and {second} are {100 * (ratio - 1):+.1f} % from their known distance of {known:g} m.",
                advice=_right_size(session, ratio),
            )  # fmt: skip


def _right_size(session: Examined, ratio: float) -> str:
    """Return what the size of the board or wand would be if a known distance is right."""
    board = session.solved.adjusted.problem.board
    if isinstance(board, CalibrationBoard):
        right = 1e3 * board.square / ratio
        return f"If that distance is right, the squares measure {right:.2f} mm, not {1e3 * board.square:g} mm."
    right = 1e3 * float(board.extent[0]) / ratio
    return f"If that distance is right, the wand is {right:.1f} mm long, not {1e3 * board.extent[0]:g} mm."


def _landmarks(session: Examined) -> Iterator[Finding]:
    """Points whose coordinates contradict each other, the size of the board, or a right-handed world."""
    world = session.landmarks
    if world is None:
        return
    if world.mirrored:
        yield Finding(
            code="points-mirrored", severity="problem",
            text="The points fit the mirror image of their coordinates: these are left-handed.",
            advice="Exchange x and y, or reverse one axis. With Z up and x to the right, y points away.",
        )  # fmt: skip
    elif abs(world.scale - 1) > _WRONG_SCALE and session.solved.adjusted.problem.board.extent[0] > 0:
        yield Finding(
            code="points-scale", severity="problem",
            text=f"The points are {100 * (world.scale - 1):+.1f} % farther apart than their coordinates.",
            advice=f"Check the unit of the coordinates (metres). {_right_size(session, world.scale)}",
        )  # fmt: skip
    if world.exchanged:
        first, second = world.exchanged
        yield Finding(
            code="points-exchanged", severity="problem",
            text=f"The coordinates of {first} and {second} are exchanged: all points agree when they change places.",
            advice="Both are left out. Give each the coordinates of the other.",
        )  # fmt: skip
    for name, off in () if world.exchanged else world.wrong:
        yield Finding(
            code="point-wrong", severity="caution",
            text=f"The coordinates of {name} contradict those of the other points by {1e3 * off:.0f} mm.",
            advice="It is left out. Measure it again, and check its name.",
        )  # fmt: skip


def _floor(session: Examined) -> Iterator[Finding]:
    if session.floor and session.landmarks is None and session.together and not boards_lie_above(session.solved):
        yield Finding(
            code="floor-not-lowest", severity="problem",
            text="The board that sets the floor does not lie on it: cameras or most other boards are below it.",
            advice="Lay the board flat on the floor, printed side up, and give those pictures (--floor).",
        )  # fmt: skip
    if not session.floor and session.together:
        advice = "Lay the board on the floor for a second where several cameras see it, or give its pictures (--floor)."
        if isinstance(session.solved.adjusted.problem.board, CalibrationWand):
            advice = "Lay tags on the floor, or give points with known coordinates (--points)."
        yield Finding(
            code="no-floor", severity="caution",
            text="The floor was not measured: the vertical is the mean of the vertical directions of the images, and "
                "the origin is where the cameras look. Heights, verticals, and angles to the horizontal are not "
                "reliable; distances and angles between segments are.",
            advice=advice,
        )  # fmt: skip

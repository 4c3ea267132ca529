"""What is wrong with the images of a camera as a whole: cropped, scaled unevenly, repeated, or filled too little."""

from collections.abc import Iterator

import numpy as np

from marey.arrays import Integers
from marey.calibration.adjustment.state import CAMERA
from marey.calibration.boards.board import CalibrationBoard
from marey.calibration.boards.corners import CornerSet
from marey.calibration.quality.finding import Examined, Finding, picture_names

_OFF_CENTRE = 0.1
"""Distance of the principal point from the middle of the image, in widths, from which the image is called cropped.

That of the lenses in the recorded sessions is at most 0.03. Chosen by hand."""
_UNEVEN = 0.008
"""Difference of the focal lengths, as a ratio, from which the pixels are not square; twice its prior. By hand."""
_CERTAIN = 5.0
"""Both must exceed their own standard deviations as many times; chosen by hand."""
_SMALL = 0.1
"""Extent of the board, in widths of the image, that it should exceed in some pictures; chosen by hand."""
_HELD_PX = 0.15
"""Root mean square shift of the corners between pictures up to which a picture is a repetition [px]; as for still
boards."""
_HELD_SD, _MOST_HELD_PX = 1.5, 0.5
"""The same in standard deviations of the shift, as for still boards, but not beyond so many pixels, whichever is
larger; chosen by hand."""
_MOVING_PX = 2.0
"""Shift of the corners in another camera from which the board moved meanwhile [px]; chosen by hand."""
_SUDDEN_PX = 5.0
"""Shift per picture before or after repetitions from which a board stops or starts too suddenly, if no other camera
sees it [px]; chosen by hand."""
_LEAST_HELD = 3
"""Least number of repetitions in a row that are named; chosen by hand."""


def image_geometry(session: Examined) -> Iterator[Finding]:
    """Name cameras whose images are cropped, scaled unevenly, or in which the board is always small."""
    for camera, each in enumerate(session.cameras):
        if each.pictures < 2 or not each.lens_sd[0]:
            continue
        width, height = session.corners.sizes[camera]
        off = each.lens[2:4] - (np.array([width, height]) - 1) / 2
        if np.linalg.norm(off) > max(
            _OFF_CENTRE * max(width, height), _CERTAIN * float(np.linalg.norm(each.lens_sd[2:4]))
        ):
            yield Finding(
                code="image-cropped", severity="caution",
                text=f"{each.name}: the optical axis meets the image {off[0]:+.0f} px to the right of its middle and "
                    f"{off[1]:+.0f} px below: the pictures are a part of those that the camera took.",
                advice="Use whole pictures, or crop the later recordings in the same way.",
            )  # fmt: skip
        ratio, own = float(each.lens[1] / each.lens[0]), slice(CAMERA * camera, CAMERA * camera + 2)
        slope = np.array([-ratio, 1.0]) / each.lens[0]
        sd = float(np.sqrt(slope @ session.solved.covariance[own, own] @ slope))
        if abs(ratio - 1.0) > max(_UNEVEN, _CERTAIN * sd):
            yield Finding(
                code="pixels-not-square", severity="caution",
                text=f"{each.name}: its pixels are {100 * (ratio - 1):+.1f} % wider than high: "
                    "the pictures were scaled unevenly.",
                advice="The result allows for it. Use the pictures as the camera took them, or scale the later "
                    "recordings in the same way.",
            )  # fmt: skip
        yield from _small_board(session, camera)


def _small_board(session: Examined, camera: int) -> Iterator[Finding]:
    corners = session.solved.corners
    if not isinstance(session.solved.adjusted.problem.board, CalibrationBoard):
        return
    extent = [float(np.ptp(corners.pixels[corners.view_rows(int(k))], axis=0).max())
              for k in np.flatnonzero(corners.view_camera == camera)]  # fmt: skip
    share = float(np.percentile(extent, 90)) / max(corners.sizes[camera])
    if share < _SMALL:
        yield Finding(
            code="small-board", severity="caution",
            text=f"{corners.cameras[camera]}: the corners of the board span only {100 * share:.0f} % of the image.",
            advice=f"Bring the board nearer to {corners.cameras[camera]}, or use a larger one.",
        )  # fmt: skip


def repeated_pictures(session: Examined) -> Iterator[Finding]:
    """Name pictures of a camera that repeat the one before while the board moves in the other cameras."""
    if session.rate is None or not session.together:
        return
    for camera, name in enumerate(session.corners.cameras):
        if any(each.camera == camera and each.is_other_clock for each in session.causes):
            # It shows a board that came to rest earlier or later than the others.
            continue
        held = repeated_instants(session.corners, session.still, camera)
        if len(held) >= _LEAST_HELD:
            yield Finding(
                code="pictures-repeated", severity="caution",
                text=f"{name}: {picture_names(session, held)} repeat the pictures before them though the board moves.",
                advice="Check the recording for dropped frames, and film again with a constant frame rate.",
            )  # fmt: skip


def repeated_views(corners: CornerSet, still: Integers | None) -> set[tuple[int, int]]:
    """Return the pictures and cameras that repeat the pictures before them though the board moves.

    Args:
        corners: All corners.
        still: (F,) the first picture of the run of still pictures that each belongs to; None if none were joined.
    """
    found: set[tuple[int, int]] = set()
    for camera in range(len(corners.cameras)):
        held = repeated_instants(corners, still, camera)
        if len(held) >= _LEAST_HELD:
            found |= {(picture, camera) for picture in held}
    return found


def repeated_instants(corners: CornerSet, still: Integers | None, camera: int) -> list[int]:
    """Return pictures that repeat those before them while other cameras see the board move, or that end in a jump.

    Args:
        corners: All corners.
        still: (F,) the first picture of the run of still pictures that each belongs to; None if none were joined.
        camera: The camera.
    """
    shifts, cameras = _shifts(corners, still), len(corners.cameras)
    held, run = [], []
    for picture in range(max((at for at, _ in shifts), default=-1) + 2):
        shift, limit = shifts.get((picture, camera), (np.nan, 0.0))
        others = [shifts[picture, k][0] for k in range(cameras) if k != camera and (picture, k) in shifts]
        if shift < limit and min(others, default=np.inf) > _MOVING_PX:
            held += [picture] if others else []
            run.append(picture)
            continue
        around = [shifts.get((at, camera), (0.0, 0.0))[0] for at in (run[0] - 1, picture + 1)] if run else [0.0]
        # The board stops or starts at once, and is then as far as if it had moved on.
        if len(run) >= _LEAST_HELD and max(around) > _SUDDEN_PX and shift > 0.5 * (len(run) + 1) * max(around):
            held += run
        run = []
    return sorted(set(held))


def _shifts(corners: CornerSet, still: Integers | None) -> dict[tuple[int, int], tuple[float, float]]:
    """Return by picture and camera how far the corners lie from those of the picture before (RMS) [px].

    The second value is the distance up to which the picture repeats the one before, by the errors of the corners.
    """
    seen = {(picture, camera): found for picture, camera, found in corners.sightings()}
    firsts = [] if still is None else still.tolist()
    after = {first: picture + 1 for picture, first in enumerate(firsts)}
    for picture, first in enumerate(firsts):
        for camera in range(len(corners.cameras)):
            # A camera that lost the board after the run may have lost it during the run.
            if first != picture and {(first, camera), (after[first], camera)} <= seen.keys():
                seen[picture, camera] = seen[first, camera]
    shifts = {}
    for (picture, camera), found in seen.items():
        before = seen.get((picture - 1, camera))
        if before is None:
            continue
        _, a, b = np.intersect1d(found.corner, before.corner, return_indices=True)
        if len(a) >= 4:
            shift = found.pixels[a] - before.pixels[b]
            spread = found.covariance[a] + before.covariance[b]
            error = float(np.sqrt(np.mean(np.trace(spread, axis1=1, axis2=2)) / 2))
            limit = max(_HELD_PX, min(_HELD_SD * error, _MOST_HELD_PX))
            shifts[picture, camera] = float(np.sqrt(np.mean(np.sum(shift**2, axis=1)) / 2)), limit
    return shifts

"""How well a pose agrees with silhouettes: a cost by which poses are compared, and what a body leaves uncovered."""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.cameras.lens import project_points
from marey.cameras.visibility import MARGIN, Scratch, draw_into, outline_pixels
from marey.compiled.kernels import kernel
from marey.fit.search.levels import FrameLevels, SilhouetteLevel
from marey.fit.solver.picture_times import PictureMotion, PictureTimes
from marey.fit.solver.threads import map_in_threads
from marey.images.silhouettes.contours import CONTOUR_BORDER
from marey.images.silhouettes.nearest import nearest_within, sort_into_cells
from marey.observations.correspondence import view_of
from marey.observations.prior import Habit, JointLimits

LOOKED_INTERVAL = 0.1
"""Time between the frames in which parts outside of the body are looked for [s]. Chosen by hand."""
OUTSIDE_PX = 3
"""Distance from the body up to which nothing is outside of it [px of images in which a person is 160 px high]. Chosen
by hand."""
UNCOVERED_SHARE = 0.01
"""Share of a silhouette that a part outside of the body has at least. A hand that was tracked at a wrong place left
0.014 to 0.019 in `jacks` with two cameras. Of 240 frames of `jacks`, `stealth`, `walk` and `reach` with four cameras
and joints less than 60 mm off, at most one in ten of a take has more than 0.008."""


def outline_cost(
    posed: PosedBody, level: SilhouetteLevel, *, scale: float, sigma_px: float,
    motions: Sequence[PictureMotion] | None = None,
) -> float:  # fmt: skip
    """Return half the robust sum of squares of the distances between the outlines of a body and the silhouettes.

    Each pixel of either outline counts, in units of the standard deviation of a match, and one that is far from the
    other outline with the limit of the robust function, whose weights the refinement uses.

    Args:
        posed: The body.
        level: Silhouettes of a frame; where the image's border or something in front cuts them is no outline.
        scale: Scale of the robust function [px].
        sigma_px: Standard deviation of a match [px].
        motions: Known motion of the body until each camera's picture; None if all pictures are of the frame's instant.
    """
    total = 0.0
    for c, sighting in enumerate(level.sightings):
        seen = posed if motions is None else motions[c].after(posed)
        camera, contour = sighting.camera, sighting.contour
        total += outline_distance(
            Scratch.of(len(seen.vertices), camera.size), seen.vertices, seen.body.faces, camera.packed, camera.width,
            camera.height, contour.pixels, contour.cells, scale,
        )  # fmt: skip
    return 0.5 * total / sigma_px**2


def largest_uncovered(
    posed: PosedBody, level: SilhouetteLevel, *, margin_px: int, motions: Sequence[PictureMotion] | None = None
) -> float:
    """Return the share of a silhouette that its largest connected part outside of a body has, over all cameras.

    Args:
        posed: The body.
        level: Silhouettes of a frame.
        margin_px: Distance from the body up to which nothing is outside [px].
        motions: Known motion of the body until each camera's picture; None if all pictures are of the frame's instant.
    """
    around, largest = np.ones((2 * margin_px + 1, 2 * margin_px + 1), np.uint8), 0.0
    for c, (sighting, mask) in enumerate(zip(level.sightings, level.masks, strict=True)):
        seen = posed if motions is None else motions[c].after(posed)
        drawn = cv2.dilate(view_of(seen, sighting.camera).mask().astype(np.uint8), around)
        outside = np.where(drawn > 0, 0, mask).astype(np.uint8)
        _, _, parts, _ = cv2.connectedComponentsWithStats(outside)
        areas = parts[1:, cv2.CC_STAT_AREA]
        largest = max(largest, float(areas.max(initial=0)) / max(int(np.count_nonzero(mask)), 1))
    return largest


def contradicted_frames(
    levels: FrameLevels, body: Body, poses: Mapping[int, Pose], *, rate: float, times: PictureTimes | None = None
) -> list[int]:
    """Return the frames in which a silhouette has a part outside of the body as large as a hand.

    Args:
        levels: Silhouettes.
        body: The body.
        poses: Poses by frame.
        rate: Frame rate [Hz].
        times: When the cameras have taken their pictures; None if that is at the instants of the frames.
    """
    looked = sorted(poses)[:: max(1, round(LOOKED_INTERVAL * rate))]
    motions = {} if times is None else times.known_motions({frame: poses[frame] for frame in looked})

    def share(frame: int) -> float:
        posed = PosedBody(body, poses[frame])
        return largest_uncovered(posed, levels.at(frame), margin_px=OUTSIDE_PX, motions=motions.get(frame))

    shares = zip(looked, map_in_threads(share, looked), strict=True)
    return [frame for frame, value in shares if value > UNCOVERED_SHARE]


@kernel
def outline_distance(scratch, vertices, faces, camera, width, height, contour, cells, scale):
    """Return the robust sum of squares between the outline of a drawn surface and a contour, in both directions [px2].

    Args:
        scratch: Buffers for the drawing.
        vertices: (V, 3) of the surface [m, world].
        faces: (T, 3).
        camera: The packed camera.
        width: Width of its image [px].
        height: Height of its image [px].
        contour: (n, 2) pixels of the contour.
        cells: The same, sorted into cells.
        scale: Scale of the robust function [px].
    """
    project_points(camera, vertices, scratch.projected)
    left, top, _, face = draw_into(scratch, faces, width, height, MARGIN)
    drawn = outline_pixels(face, left, top, width, height, CONTOUR_BORDER)
    return _robust_sum(drawn, cells, scale) + _robust_sum(contour, sort_into_cells(drawn), scale)


@kernel
def _robust_sum(pixels, cells, scale):
    """Add s^2 r^2 / (s^2 + r^2) for the distances r of pixels (n, 2) from the nearest one in cells, at scale s."""
    total = 0.0
    for i in range(pixels.shape[0]):
        x, y = pixels[i, 0], pixels[i, 1]
        j = nearest_within(cells, x, y, 5.0 * scale)
        if j < 0:
            total += scale**2
            continue
        square = (cells.pixels[j, 0] - x) ** 2 + (cells.pixels[j, 1] - y) ** 2
        total += scale**2 * square / (scale**2 + square)
    return total


def prior_cost(posed: PosedBody, *, habit: float) -> float:
    """Return half the sum of squares of the joint limits and of the usual angles, the latter of weight `habit`."""
    total = 0.0
    for prior in (JointLimits(), Habit(share=habit)):
        residual, _ = prior.by_angle(posed)
        total += 0.5 * float(np.sum((residual / prior.sigma) ** 2))
    return total

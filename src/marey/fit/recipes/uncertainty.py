"""Uncertainty of a pose: projected into the images, and from the contradictions between the cameras."""

from collections.abc import Container, Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from marey.arrays import Floats, Integers
from marey.body.articulation.pose import Pose, PosedBody, SkinPoints
from marey.body.articulation.skeleton import COLOUR_PARTS
from marey.body.articulation.surface import Body
from marey.cameras.camera import Camera
from marey.fit.progress import FrameProgress, no_progress
from marey.fit.recipes.person import PersonSettings, SilhouetteTake, refine_person
from marey.fit.recipes.sequence import FrameTermsFactory, SequenceFit
from marey.fit.solver.banded import LEAST_CAMERAS

_Item = TypeVar("_Item")
"""Type of what a camera has."""
POINTS_PER_PART = 12
"""Number of surface points per part whose uncertainty is averaged. Chosen by hand."""


def part_deviations(posed: PosedBody, covariance: Floats, cameras: Sequence[Camera]) -> Floats:
    """Return the standard deviation of each part's surface in each image, from the covariance of the pose.

    Args:
        posed: The body in its pose.
        covariance: (D, D) of the pose, for the changes that `Pose.step` takes.
        cameras: C cameras.

    Returns:
        (C, P) root mean square over points of the part, per axis of the image [px]; NaN where the camera sees none or
        the body has no such part.
    """
    where, part = _points(posed.body)
    jacobian = posed.pose_jacobian(*posed.parts(where))
    spread = np.einsum("nid,de,nje->nij", jacobian, covariance, jacobian)
    places = posed.points(where)
    found = np.full((len(cameras), len(COLOUR_PARTS)), np.nan)
    for c, camera in enumerate(cameras):
        _, slope = camera.project_with_derivative(places)
        variance = 0.5 * np.einsum("nij,njk,nik->n", slope, spread, slope)
        for p in range(len(COLOUR_PARTS)):
            own = variance[part == p]
            own = own[np.isfinite(own)]
            if len(own):
                found[c, p] = np.sqrt(own.mean())
    return found


def _points(body: Body) -> tuple[SkinPoints, Integers]:
    """Return face centres that are evenly distributed over the list of faces of each part, and their parts."""
    faces = []
    for p in range(len(COLOUR_PARTS)):
        own = np.flatnonzero(body.face_colour_part == p)
        if len(own):
            faces.append(own[np.linspace(0, len(own) - 1, POINTS_PER_PART).astype(int)])
    chosen = np.concatenate(faces)
    weights = np.full((len(chosen), 3), 1 / 3)
    return SkinPoints(face=chosen, barycentric=weights), body.face_colour_part[chosen]


def camera_spread(
    take: SilhouetteTake, body: Body, poses: Mapping[int, Pose], settings: PersonSettings, *, height: float,
    ignored_frames: Container[int] = (), extra_terms: FrameTermsFactory | None = None,
    progress: FrameProgress = no_progress,
) -> dict[int, Floats]:  # fmt: skip
    """Return the covariance of poses that the contradictions between the cameras reveal, by the jackknife.

    The errors of silhouettes that follow a wrong colour, another person or the prior are alike at all points of an
    outline and in neighbouring frames, which the normal equations do not know. Without one camera, the poses are
    different by what its silhouettes alone support: with the changes d_c of the pose without camera c of C, the
    covariance is (C - 1) / C times the sum of d_c d_c'. It contains little where all cameras agree, and much where one
    of them decides.

    Args:
        take: Cameras and silhouettes.
        body: The body, whose shape is kept.
        poses: Poses by frame.
        settings: Settings of the capture.
        height: Height of the person in the images [px].
        ignored_frames: Frames whose silhouettes are ignored.
        extra_terms: Further observations, which are used every time.
        progress: Called with each frame in each of C + 1 refinements.

    Returns:
        (D, D) by frame, for the changes that `Pose.step` takes; empty with fewer than three cameras, because one alone
        does not determine a pose.
    """
    count = len(take.cameras)
    if count < LEAST_CAMERAS:
        return {}

    def refined(own: SilhouetteTake, start: Mapping[int, Pose]) -> dict[int, Pose]:
        found: dict[int, Pose] = {}
        for fit in refine_person(
            own, body, start, [], settings, height=height, rounds=1, ignored_frames=ignored_frames,
            extra_terms=extra_terms, progress=progress,
        ):  # fmt: skip
            found |= fit.by_frame
        own.forget()
        return found

    whole = refined(take, poses)
    total: dict[int, Floats] = {frame: np.zeros((len(body.skeleton),) * 2) for frame in whole}
    for c in range(count):
        for frame, pose in refined(without_camera(take, c), whole).items():
            change = whole[frame].change_to(pose)
            total[frame] += (count - 1) / count * np.outer(change, change)
    return total


SMOOTHED = 0.5
"""Time before and after a frame over which the covariance between the cameras is averaged [s]. With few cameras it has
few degrees of freedom in one frame. After one more round of refinement of its result, the intervals of `stealth`
without camera 4 hold 82 % without this covariance, 91 % with that of the frame itself, 92 % averaged over 0.25 s, and
93 % over 0.5 s; those of `stealth` with all cameras 96, 98, 98 and 98 %."""


def with_camera_contradictions(fit: SequenceFit, *, rate: float) -> SequenceFit:
    """Return a fit whose covariances include what the contradictions between the cameras reveal.

    Unlike `camera_spread`, this uses the equations of the last round of the refinement, see `BandedSystem.jackknife`:
    it costs almost no time.

    Args:
        fit: The fit of some frames.
        rate: Frame rate [Hz].

    Returns:
        The fit with the sum of both; unchanged with fewer than three cameras.
    """
    between = fit.between_cameras
    if between is None or len(between) == 0:
        return fit
    reach, first, count = round(SMOOTHED * rate), np.arange(len(between)), len(between)
    total = np.concatenate([np.zeros_like(between[:1]), np.cumsum(between, 0)])
    low, high = np.maximum(first - reach, 0), np.minimum(first + reach + 1, count)
    mean = (total[high] - total[low]) / (high - low)[:, None, None]
    covariance, degrees = np.array(fit.covariance), between.shape[1]
    covariance[:, :degrees, :degrees] += mean
    return replace(fit, covariance=covariance)


def without_camera(take: SilhouetteTake, camera: int) -> SilhouetteTake:
    """Return a take without one of its cameras, given by its number."""

    def rest(items: Sequence[_Item]) -> list[_Item]:
        return [item for c, item in enumerate(items) if c != camera]

    def rest_or_none(items: Sequence[_Item] | None) -> list[_Item] | None:
        return None if items is None else rest(items)

    return replace(
        take, cameras=tuple(rest(take.cameras)), masks_of=lambda frame: rest(take.masks_of(frame)),
        edges_of=lambda frame: rest_or_none(take.edges_of(frame)),
        hidden_of=lambda frame: rest_or_none(take.hidden_of(frame)),
        times=None if take.times is None else take.times.without(camera),
    )  # fmt: skip


def with_spread(fit: SequenceFit, spread: Mapping[int, Floats]) -> SequenceFit:
    """Return a fit whose poses have additional covariance.

    Args:
        fit: The fit of some frames.
        spread: (D, D) covariance by frame, see `camera_spread`; frames that it lacks are unchanged.

    Returns:
        The fit with the sum of both.
    """
    covariance = np.array(fit.covariance)
    for k, frame in enumerate(map(int, fit.frames)):
        if frame in spread:
            degrees = len(spread[frame])
            covariance[k, :degrees, :degrees] += spread[frame]
    return replace(fit, covariance=covariance)

"""Side of a template: it is registered as it is and mirrored, and the better fit decides."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from marey.arrays import Floats, Mask
from marey.errors import MareyError
from marey.geometry import rotations
from marey.geometry.vectors import unit_or_zero
from marey.knee.registration.rigid import (
    RIGID_DEFAULTS,
    RigidRegistration,
    RigidSettings,
    SupportingPlanes,
    SurfacePoints,
    register_rigidly,
    spread_points,
)
from marey.knee.space.cut_ends import cut_planes
from marey.knee.space.sides import mirrored
from marey.knee.space.surface import TriangleSurface


@dataclass(frozen=True, kw_only=True)
class SideSettings:
    """Settings for determining the side of a template.

    Values without a stated source were chosen by hand.
    """

    rigid: RigidSettings = RIGID_DEFAULTS
    """Settings of the rigid registration on each side."""
    clear_ratio: float = 1.35
    """Ratio of the two sides' distances below which the side counts as uncertain. Of 30 pairs of bones of different
    knees all sides are right, and all femora and tibiae and 3 of 6 patellae are clear (docs/accuracy/knee.md)."""
    points: int = 1500
    """Number of points of each surface."""
    rounds: int = 15
    """Number of steps in which the template is scaled."""
    largest_scaling: float = 0.1
    """Largest change [natural logarithm] of its size in one step."""
    finest_mm: float = RIGID_DEFAULTS.finest_mm
    """Least scale [mm] of the robust weight; as in the rigid registration."""


SIDE_DEFAULTS = SideSettings()
"""Default settings for determining the side of a template."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SidedRegistration:
    """A template registered to a subject, and its side."""

    rigid: RigidRegistration
    """Of the template, which is mirrored first if it is of the other side."""
    mirrored: bool
    same_side_mm: float
    """Mean distance of the surfaces after the template, not mirrored, was registered and scaled; NaN if not tried."""
    other_side_mm: float
    """The same distance when it is mirrored first."""
    clear_ratio: float = SIDE_DEFAULTS.clear_ratio
    """Ratio of the two distances from which the side is certain."""

    @property
    def clear(self) -> bool:
        """Whether one side fits much better than the other, or was given."""
        best, worst = sorted((self.same_side_mm, self.other_side_mm))
        return not np.isfinite([best, worst]).all() or worst > self.clear_ratio * best


def register_on_either_side(
    template: TriangleSurface, subject: TriangleSurface, *, mirror: bool | None = None,
    done: Callable[[float], None] = lambda share: None, settings: SideSettings = SIDE_DEFAULTS
) -> SidedRegistration:  # fmt: skip
    """Register a template rigidly to a subject, mirrored first if it is of the other side.

    People differ in size more than a bone does from its mirror image, so the two fits are compared after each was
    also scaled to the subject's size; the registration itself is the rigid one.

    Args:
        template: A bone of either side.
        subject: The same bone of any person.
        mirror: Whether to mirror the template; None to find out.
        done: Called with the share of the work that is done.
        settings: Tuned constants of the algorithm.

    Raises:
        MareyError: The template fits on neither side.
    """
    if mirror is not None:
        rigid = register_rigidly(
            mirrored(template) if mirror else template, subject, done=done, settings=settings.rigid
        )
        return SidedRegistration(
            rigid=rigid, mirrored=mirror, same_side_mm=np.nan, other_side_mm=np.nan, clear_ratio=settings.clear_ratio
        )
    found: dict[bool, RigidRegistration] = {}
    distance = {False: np.inf, True: np.inf}
    problems = []
    for flipped in (False, True):
        side = mirrored(template) if flipped else template
        try:
            found[flipped] = register_rigidly(
                side, subject, done=partial(_report_half, done, flipped), settings=settings.rigid
            )
            distance[flipped] = _scaled_distance(side, subject, found[flipped], settings=settings)
        except MareyError as error:
            problems.append(error)
    if not found:
        raise problems[0]
    better = distance[True] < distance[False]
    return SidedRegistration(
        rigid=found[better], mirrored=better, same_side_mm=distance[False], other_side_mm=distance[True],
        clear_ratio=settings.clear_ratio,
    )  # fmt: skip


def _report_half(done: Callable[[float], None], second: bool, share: float) -> None:
    done((second + share) / 2)


def _scaled_distance(
    template: TriangleSurface, subject: TriangleSurface, start: RigidRegistration, *, settings: SideSettings
) -> float:
    """Scale a registered template, and return the mean distance [mm] of both surfaces' points from the other."""
    pairs = [
        (
            spread_points(a, cut_planes(a), settings.points, settings=settings.rigid),
            SupportingPlanes.of(b, cut_planes(b), settings.rigid.edge_mm),
        )
        for a, b in ((template, subject), (subject, template))
    ]
    motion = start.subject_from_template
    matrix, shift = motion.rotation.copy(), motion.translation.copy()
    middle = pairs[0][0].places.mean(0)
    for _ in range(settings.rounds):
        places, normals, off, matched = _deviations(pairs, matrix, shift)
        scale = max(3 * 1.4826 * float(np.median(np.abs(off[matched]))), settings.finest_mm) if matched.any() else 1.0
        weight = np.where(matched, 1 / (1 + (off / scale) ** 2) ** 2, 0.0)
        away = places - (about := matrix @ middle + shift)
        slopes = np.column_stack([np.cross(away, normals), normals, (away * normals).sum(1)])
        stiffness = slopes.T @ (weight[:, None] * slopes)
        step = -np.linalg.lstsq(stiffness, slopes.T @ (weight * off), rcond=1e-9)[0]
        change = np.exp(np.clip(step[6], -settings.largest_scaling, settings.largest_scaling)) * rotations.exp(step[:3])
        matrix, shift = change @ matrix, about + step[3:6] + change @ (shift - about)
    _, _, off, matched = _deviations(pairs, matrix, shift)
    return float(np.abs(off[matched]).mean()) / max(float(matched.mean()), 1e-3) if matched.any() else np.inf


def _deviations(
    pairs: list[tuple[SurfacePoints, SupportingPlanes]], matrix: Floats, shift: Floats
) -> tuple[Floats, Floats, Floats, Mask]:
    """Return points and normals in the subject, deviations along them, and which points have a counterpart."""
    (own, subject), (other, template) = pairs
    back = np.linalg.inv(matrix)
    moved, facing = own.places @ matrix.T + shift, unit_or_zero(own.normals @ back)
    near = subject.tree.nearest(moved)
    planes = subject.face_normals[near.face]
    ahead = subject.known[near.face] & ((planes * facing).sum(1) > 0.5)
    nearest = template.tree.nearest((other.places - shift) @ back.T)
    turned = unit_or_zero(template.face_normals[nearest.face] @ back)
    behind = template.known[nearest.face] & ((turned * other.normals).sum(1) > 0.5)
    there = nearest.points_mm @ matrix.T + shift
    off = np.concatenate([((moved - near.points_mm) * planes).sum(1), ((there - other.places) * other.normals).sum(1)])
    return (
        np.concatenate([moved, there]), np.concatenate([planes, other.normals]), off, np.concatenate([ahead, behind]),
    )  # fmt: skip

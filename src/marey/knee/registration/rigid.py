"""A template's bone laid on the subject's by a rigid motion: points on locally supporting planes ([Hemler1995]).

Points of the template look for the nearest places on the subject's surface, whose tangent planes support them; the
motion that brings them onto these planes is found by Levenberg-Marquardt, from several starts on few points and from
the best of these on many. Flat ends, where an image was cut off, and open rims take no part, and neither do points far
from the other surface by the measure of all.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.errors import MareyError
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from marey.knee.registration.covariance import bounded_stiffness, pulls_covariance, smoothed_normals
from marey.knee.space.cut_ends import CutPlane, cut_planes, known_faces
from marey.knee.space.surface import Surface
from marey.knee.space.triangle_tree import TriangleTree

COARSE, FINE = 400, 4000
"""Points of the template by which starts are tried, and by which the best is refined."""
TRIED_TURN = np.radians(22.0)
"""How far the starts lie from the given one, about each axis."""
ROUGHLY = 2e-3
"""On the first round a start is left when a step lowers its cost by less than this share."""
KEPT = 4
"""So many of the starts are refined further."""
COARSE_MM, FINEST_MM = 6.0, 0.15
"""Distances beyond about twice the scale count ever less: the scale of the first rounds, and its least."""
EDGE_MM = 3.0
"""So near to a cut end the surface is left out: smoothing has rounded it."""
FACING = 0.5
"""Cosine of the greatest angle between the normals of two places that may be one."""
LEAST_SHARE = 0.3
"""At least such a share of the points must find a place."""
FARTHEST_MM = 6.0
"""A template whose surface lies farther off than this on average is no such bone."""
_NUDGE_MM = 0.5
"""By such a shift, and turns of the same size, the stiffness is measured."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RigidRegistration:
    """Where a template lies on a subject."""

    subject_from_template: RigidTransform
    """Translation in mm."""
    covariance: Floats
    """(6, 6) of a small turn about the template's middle in the subject's axes [rad], and of that middle [mm]."""
    residual_mm: float
    """Root mean square distance of the points that lie on the subject from their planes."""
    surface_distance_mm: float
    """Mean distance of all the template's own points from the subject; cut ends are left out."""
    used: float
    """Share of the template's points that lie on the subject."""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        freeze_fields(self, "covariance")

    @property
    def turn_sd_deg(self) -> Floats:
        """(3,)."""
        return np.degrees(np.sqrt(np.diag(self.covariance)[:3]))

    @property
    def translation_sd_mm(self) -> Floats:
        """(3,) of the template's middle."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[3:]))


@dataclass(frozen=True, eq=False)
class Points:
    """Points of a surface with normals, spread over its area; only where it is the bone's own."""

    places: Floats
    """(N, 3) mm."""
    normals: Floats
    """(N, 3)."""


@dataclass(frozen=True, eq=False)
class Supports:
    """A surface as locally supporting planes."""

    tree: TriangleTree
    face_normals: Floats
    """(T, 3)."""
    known: Mask
    """(T,) false at cut ends and rims."""

    @staticmethod
    def of(surface: Surface, cuts: tuple[CutPlane, ...]) -> "Supports":
        """Prepare a surface."""
        return Supports(TriangleTree.of(surface), surface.face_normals, known_faces(surface, cuts, EDGE_MM))


@dataclass(frozen=True, eq=False)
class _Fit:
    """Residuals at one motion."""

    residual: Floats
    """(N,) mm, signed, along the planes' normals; of unmatched points their distance."""
    matched: Mask
    """(N,)."""
    normals: Floats
    """(N, 3) of the planes."""
    moved: Floats
    """(N, 3)."""


def register_rigidly(
    template: Surface, subject: Surface, start: RigidTransform | None = None,
    done: Callable[[float], None] = lambda share: None,
) -> RigidRegistration:  # fmt: skip
    """Find the rigid motion that lays a template on a subject ([Alexander2003] section 2.1).

    It is found from any start within 30 degrees and 30 mm; where the surfaces overlap little, or by nothing that tells
    turns apart, the covariance says so.

    Args:
        template: A bone of any field of view.
        subject: The same bone, of the same side, of anybody.
        start: subject_from_template roughly; without one, the start is the better of nothing and of laying the
            surfaces' middles upon each other.
        done: Told of the share of the work that is done.

    Raises:
        MareyError: The surfaces do not lie on each other anywhere.
    """
    cuts = cut_planes(template), cut_planes(subject)
    supports = Supports.of(subject, cuts[1])
    few, many = (spread_points(template, cuts[0], count) for count in (COARSE, FINE))
    centre = few.places.mean(0)
    back = _Backward(Supports.of(template, cuts[0]), spread_points(subject, cuts[1], COARSE))
    tried = []
    starts = _starts(template, subject, centre, start)
    for n, first in enumerate(starts):
        motion = _descend(first, few, supports, centre, scales=(COARSE_MM, COARSE_MM / 2), steps=8, enough=ROUGHLY)
        tried.append((_both_ways(motion, few, supports, back), n, motion))
        done(0.7 * (n + 1) / len(starts))
    tried.sort(key=lambda item: item[:2])
    refined = []
    for _, n, motion in tried[:KEPT]:
        motion = _descend(motion, few, supports, centre, scales=(COARSE_MM / 2, COARSE_MM / 4), steps=25)
        refined.append((_both_ways(motion, few, supports, back), n, motion))
    best = min(refined, key=lambda item: item[:2])[2]
    done(0.8)
    fit = _residuals(best, many, supports)
    scale = _scale(fit)
    for _ in range(4):
        best = _descend(best, many, supports, centre, scales=(scale,), steps=25)
        scale = _scale(_residuals(best, many, supports))
    done(1.0)
    return _result(best, many, supports, centre, scale)


def spread_points(surface: Surface, cuts: tuple[CutPlane, ...], count: int) -> Points:
    """Take points evenly by area from where a surface is the bone's own.

    Raises:
        MareyError: Nothing of it is.
    """
    area = np.where(known_faces(surface, cuts, EDGE_MM), surface.face_areas_mm2, 0.0)
    if not area.any():
        raise MareyError("The surface has nothing but cut ends.")
    draw = np.random.default_rng(len(area))
    # Every so many square millimetres one point, and within its face anywhere.
    marks = (np.arange(count) + 0.5) / count * area.sum()
    face = np.searchsorted(np.cumsum(area), marks).clip(max=len(area) - 1)
    share = np.sort(draw.random((count, 2)), axis=1)
    weights = np.stack([share[:, 0], share[:, 1] - share[:, 0], 1 - share[:, 1]], 1)
    return Points(np.einsum("nk,nki->ni", weights, surface.corners_mm[face]), surface.face_normals[face])


def _starts(template: Surface, subject: Surface, centre: Floats, start: RigidTransform | None) -> list[RigidTransform]:
    """Turn the given place about the template's middle, each axis both ways; and the middles laid on each other."""
    to_middle = RigidTransform(np.eye(3), subject.vertices_mm.mean(0) - template.vertices_mm.mean(0))
    places = [start] if start is not None else [RigidTransform.identity(), to_middle]
    turns = [np.zeros(3), *(sign * TRIED_TURN * axis for axis in np.eye(3) for sign in (1.0, -1.0))]
    turns += [TRIED_TURN * (2.0 * np.array(bits) - 1.0) / np.sqrt(3) for bits in np.ndindex(2, 2, 2)]
    return [
        RigidTransform(rotations.exp(turn), place.apply(centre) - rotations.exp(turn) @ place.apply(centre)) @ place
        for place in places
        for turn in turns
    ]


def _residuals(motion: RigidTransform, points: Points, supports: Supports) -> _Fit:
    moved, facing = motion.apply(points.places), points.normals @ motion.rotation.T
    near = supports.tree.nearest(moved)
    normals = supports.face_normals[near.face]
    matched = supports.known[near.face] & (np.einsum("ni,ni->n", normals, facing) > FACING)
    along = np.einsum("ni,ni->n", moved - near.points_mm, normals)
    return _Fit(np.where(matched, along, near.distance_mm), matched, normals, moved)


def _weights(fit: _Fit, scale: float) -> Floats:
    """Weigh residuals after Geman and McClure; those that are not matched not at all."""
    return np.where(fit.matched, 1 / (1 + (fit.residual / scale) ** 2) ** 2, 0.0)


def _cost(fit: _Fit, scale: float) -> float:
    """Return the robust cost whose slope the weights have; an unmatched point costs the most a point can."""
    squared = (fit.residual / scale) ** 2
    return float(np.where(fit.matched, squared / (1 + squared), 1.0).mean())


def _scale(fit: _Fit) -> float:
    """Return the scale for the next round: three robust standard deviations of what is matched."""
    if not fit.matched.any():
        return COARSE_MM
    return float(max(3 * 1.4826 * np.median(np.abs(fit.residual[fit.matched])), FINEST_MM))


def _descend(
    motion: RigidTransform,
    points: Points,
    supports: Supports,
    centre: Floats,
    *,
    scales: tuple[float, ...],
    steps: int,
    enough: float = 0.0,
) -> RigidTransform:
    """Lower the robust cost by Levenberg-Marquardt; the places are found anew for every motion that is tried.

    A step that lowers it by a smaller share than enough is the last.
    """
    for scale in scales:
        damping = 1e-2
        fit = _residuals(motion, points, supports)
        for _ in range(steps):
            weight = _weights(fit, scale)
            about = motion.apply(centre)
            jacobian = _jacobian(fit, about)
            hessian = jacobian.T @ (weight[:, None] * jacobian)
            gradient = jacobian.T @ (weight * fit.residual)
            floor = 1e-9 * np.diag(hessian).max() + 1e-12
            for _ in range(6):
                step = -np.linalg.solve(hessian + np.diag(damping * np.diag(hessian) + floor), gradient)
                trial = _stepped(motion, step, about)
                tried = _residuals(trial, points, supports)
                if _cost(tried, scale) < _cost(fit, scale):
                    break
                damping = 5 * max(damping, 1e-4)
            else:
                break
            gained = 1 - _cost(tried, scale) / max(_cost(fit, scale), 1e-300)
            motion, fit, damping = trial, tried, damping / 5
            if gained < enough:
                break
            if np.abs(step[:3]).max() < 1e-6 and np.abs(step[3:]).max() < 1e-4:
                break
    return motion


def _stepped(motion: RigidTransform, step: Floats, about: Floats) -> RigidTransform:
    """Turn the moved template about its middle, and shift it."""
    turn = rotations.exp(step[:3])
    return RigidTransform(turn, about + step[3:] - turn @ about) @ motion


@dataclass(frozen=True, eq=False)
class _Backward:
    """The subject's points and the template's planes: the other way about."""

    supports: Supports
    points: Points


def _both_ways(motion: RigidTransform, points: Points, supports: Supports, back: _Backward) -> float:
    """Return the robust cost of both surfaces' points: a template that hides in a corner of the subject costs much."""
    there = _residuals(motion, points, supports)
    here = _residuals(motion.inverse(), back.points, back.supports)
    return _cost(there, COARSE_MM / 2) + _cost(here, COARSE_MM / 2)


def _result(
    motion: RigidTransform, points: Points, supports: Supports, centre: Floats, scale: float
) -> RigidRegistration:
    fit = _residuals(motion, points, supports)
    lying = fit.matched & (np.abs(fit.residual) < 2 * scale)
    known = supports.known[supports.tree.nearest(fit.moved).face]
    distance = float(np.abs(fit.residual[known]).mean()) if known.any() else np.inf
    if lying.mean() < LEAST_SHARE or distance > FARTHEST_MM:
        raise MareyError(
            f"The template lies on the subject with {100 * lying.mean():.0f} % of its surface only, {distance:.1f} mm "
            "off on average: is it the same bone, of the same side, within 30 degrees and 30 mm?"
        )
    return RigidRegistration(
        subject_from_template=motion,
        covariance=_covariance(motion, points, supports, motion.apply(centre), scale),
        residual_mm=float(np.sqrt(np.mean(fit.residual[lying] ** 2))),
        surface_distance_mm=distance,
        used=float(lying.mean()),
    )


def _covariance(motion: RigidTransform, points: Points, supports: Supports, about: Floats, scale: float) -> Floats:
    """Return the covariance (6, 6): what the deviations pull, over how the pull changes with the motion.

    The change of the pull is measured: by the planes' slopes alone a rough surface would seem to hold better than it
    does, for what is rough has slopes, too, and they give way.
    """
    fit = _residuals(motion, points, supports)
    lying = fit.matched & (np.abs(fit.residual) < 2 * scale)
    weight, jacobian = _weights(fit, scale), _jacobian(fit, about)
    squared = (fit.residual / scale) ** 2
    # How the pull of a point changes with its residual: less than its weight says, for the weight falls, too.
    falling = np.where(fit.matched, (1 - 3 * squared) / (1 + squared) ** 3, 0.0).sum() / weight.sum()
    supposed = max(falling, 0.1) * jacobian.T @ (weight[:, None] * jacobian)
    reach = np.sqrt(np.mean(np.sum((fit.moved - about) ** 2, axis=1)))
    nudges = _NUDGE_MM * np.diag(np.repeat([1 / reach, 1.0], 3))
    measured = np.zeros((6, 6))
    for row, nudge in enumerate(nudges):
        ahead, behind = (
            _pull(_stepped(motion, step, about), points, supports, about, scale) for step in (nudge, -nudge)
        )
        measured[row] = (ahead - behind) / (2 * nudge[row])
    inverse = np.linalg.inv(bounded_stiffness((measured + measured.T) / 2, supposed))
    smooth = _Fit(fit.residual, fit.matched, smoothed_normals(fit.moved, fit.normals), fit.moved)
    pulls = pulls_covariance(fit.moved[lying], (weight * fit.residual)[lying], _jacobian(smooth, about)[lying])
    return np.asarray(inverse @ pulls @ inverse)


def _pull(motion: RigidTransform, points: Points, supports: Supports, about: Floats, scale: float) -> Floats:
    """Give half the slope (6,) of the robust cost, summed."""
    fit = _residuals(motion, points, supports)
    return np.asarray(_jacobian(fit, about).T @ (_weights(fit, scale) * fit.residual))


def _jacobian(fit: _Fit, about: Floats) -> Floats:
    """Return the derivatives (N, 6) of the residuals by a turn about a point, and a shift."""
    return np.concatenate([np.cross(fit.moved - about, fit.normals), fit.normals], axis=1)

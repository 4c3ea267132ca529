"""Rigid registration of a template's bone to the subject's: points on locally supporting planes ([Hemler1995]).

Each point of the template is matched to the nearest point on the subject's surface, whose tangent plane supports it;
the motion that brings the points onto these planes is found by Levenberg-Marquardt, from several starts with few
points, and from the best of these with many. Flat ends, where an image was cut off, and open rims are ignored, and
points far from the other surface, relative to the others, have little weight.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.errors import MareyError
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from marey.knee.registration.covariance import bounded_stiffness, gradient_covariance, smoothed_normals
from marey.knee.space.cut_ends import CutPlane, cut_planes, known_faces
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.triangle_tree import TriangleTree


@dataclass(frozen=True, kw_only=True)
class RigidSettings:
    """Settings of the rigid registration of two surfaces.

    Values without a stated source were chosen by hand.
    """

    coarse_points: int = 400
    """Number of points of the template with which starts are tried."""
    fine_points: int = 4000
    """Number of points with which the best start is refined."""
    start_turn_rad: float = float(np.radians(22.0))
    """Rotation [rad] of the starts from the given one, about each axis."""
    least_gain: float = 2e-3
    """A start is left in the first round when a step reduces its cost by a smaller share."""
    kept_starts: int = 4
    """Number of starts that are refined further."""
    coarse_mm: float = 6.0
    """Scale [mm] of the robust weight in the first rounds; residuals beyond about twice the scale have little
    weight."""
    finest_mm: float = 0.15
    """Least scale [mm] of the robust weight."""
    edge_mm: float = 3.0
    """Margin [mm] about cut ends that is ignored, because smoothing has rounded it."""
    least_facing: float = 0.5
    """Cosine of the largest angle between the normals of two corresponding points."""
    least_share: float = 0.3
    """Least share of the points that must lie on the other surface."""
    farthest_mm: float = 6.0
    """Largest mean distance [mm] of the surfaces; a template farther off is not the same bone."""
    nudge_mm: float = 0.5
    """Shift [mm], and rotation of the same size, by which the stiffness is measured."""


RIGID_DEFAULTS = RigidSettings()
"""Default settings of the rigid registration of two surfaces."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RigidRegistration:
    """Position of a template on a subject."""

    subject_from_template: RigidTransform
    """Translation in mm."""
    covariance: Floats
    """(6, 6) of a small rotation about the template's middle in the subject's axes [rad], and of that middle [mm]."""
    residual_mm: float
    """Root mean square distance, from their planes, of the points that lie on the subject."""
    surface_distance_mm: float
    """Mean distance of the template's points from the subject; cut ends are ignored."""
    used: float
    """Share of the template's points that lie on the subject."""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        freeze_fields(self, "covariance")

    @property
    def turn_sd_deg(self) -> Floats:
        """(3,) standard deviations of the rotation."""
        return np.degrees(np.sqrt(np.diag(self.covariance)[:3]))

    @property
    def translation_sd_mm(self) -> Floats:
        """(3,) standard deviations of the template's middle."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[3:]))


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """SurfacePoints with normals, spread over the area of a surface except cut ends and rims."""

    places: Floats
    """(N, 3) mm."""
    normals: Floats
    """(N, 3)."""


@dataclass(frozen=True, eq=False)
class SupportingPlanes:
    """A surface as locally supporting planes."""

    tree: TriangleTree
    face_normals: Floats
    """(T, 3)."""
    known: Mask
    """(T,) false at cut ends and rims."""

    @staticmethod
    def of(
        surface: TriangleSurface, cuts: tuple[CutPlane, ...], edge_mm: float = RIGID_DEFAULTS.edge_mm
    ) -> "SupportingPlanes":
        """Return the planes of a surface."""
        return SupportingPlanes(TriangleTree.of(surface), surface.face_normals, known_faces(surface, cuts, edge_mm))


@dataclass(frozen=True, eq=False)
class _Fit:
    """Residuals of one motion."""

    residual: Floats
    """(N,) mm, signed, along the planes' normals; for unmatched points their distance."""
    matched: Mask
    """(N,)."""
    normals: Floats
    """(N, 3) of the planes."""
    moved: Floats
    """(N, 3)."""


def register_rigidly(
    template: TriangleSurface, subject: TriangleSurface, start: RigidTransform | None = None,
    done: Callable[[float], None] = lambda share: None, *, settings: RigidSettings = RIGID_DEFAULTS
) -> RigidRegistration:  # fmt: skip
    """Find the rigid motion that aligns a template with a subject ([Alexander2003] section 2.1).

    It is found from any start within 30 degrees and 30 mm. Where the surfaces overlap little, or their overlap does not
    determine the rotation, the covariance is large.

    Args:
        template: A bone of any field of view.
        subject: The same bone, of the same side, of any person.
        start: Approximate subject_from_template; without one, both the identity and the alignment of the surfaces'
            middles are tried.
        done: Called with the share of the work that is done.
        settings: Tuned constants of the algorithm.

    Raises:
        MareyError: The surfaces cannot be aligned.
    """
    cuts = cut_planes(template), cut_planes(subject)
    supports = SupportingPlanes.of(subject, cuts[1], settings.edge_mm)
    few, many = (
        spread_points(template, cuts[0], count, settings=settings)
        for count in (settings.coarse_points, settings.fine_points)
    )
    centre = few.places.mean(0)
    back = _Backward(
        SupportingPlanes.of(template, cuts[0], settings.edge_mm),
        spread_points(subject, cuts[1], settings.coarse_points, settings=settings),
    )
    tried = []
    starts = _starts(template, subject, centre, start, settings=settings)
    for n, first in enumerate(starts):
        motion = _descend(
            first,
            few,
            supports,
            centre,
            scales=(settings.coarse_mm, settings.coarse_mm / 2),
            steps=8,
            enough=settings.least_gain,
            settings=settings,
        )
        tried.append((_both_ways(motion, few, supports, back, settings=settings), n, motion))
        done(0.7 * (n + 1) / len(starts))
    tried.sort(key=lambda item: item[:2])
    refined = []
    for _, n, motion in tried[: settings.kept_starts]:
        motion = _descend(
            motion,
            few,
            supports,
            centre,
            scales=(settings.coarse_mm / 2, settings.coarse_mm / 4),
            steps=25,
            settings=settings,
        )
        refined.append((_both_ways(motion, few, supports, back, settings=settings), n, motion))
    best = min(refined, key=lambda item: item[:2])[2]
    done(0.8)
    fit = _residuals(best, many, supports, settings=settings)
    scale = _scale(fit, settings=settings)
    for _ in range(4):
        best = _descend(best, many, supports, centre, scales=(scale,), steps=25, settings=settings)
        scale = _scale(_residuals(best, many, supports, settings=settings), settings=settings)
    done(1.0)
    return _result(best, many, supports, centre, scale, settings=settings)


def spread_points(
    surface: TriangleSurface, cuts: tuple[CutPlane, ...], count: int, *, settings: RigidSettings = RIGID_DEFAULTS
) -> SurfacePoints:
    """Sample points evenly by area from a surface, except from cut ends and rims.

    Raises:
        MareyError: The surface has nothing else.
    """
    area = np.where(known_faces(surface, cuts, settings.edge_mm), surface.face_areas_mm2, 0.0)
    if not area.any():
        raise MareyError("The surface consists of cut ends only.")
    draw = np.random.default_rng(len(area))
    # One point per equal area, at random within its face.
    marks = (np.arange(count) + 0.5) / count * area.sum()
    face = np.searchsorted(np.cumsum(area), marks).clip(max=len(area) - 1)
    share = np.sort(draw.random((count, 2)), axis=1)
    weights = np.stack([share[:, 0], share[:, 1] - share[:, 0], 1 - share[:, 1]], 1)
    return SurfacePoints(np.einsum("nk,nki->ni", weights, surface.corners_mm[face]), surface.face_normals[face])


def _starts(
    template: TriangleSurface,
    subject: TriangleSurface,
    centre: Floats,
    start: RigidTransform | None,
    *,
    settings: RigidSettings,
) -> list[RigidTransform]:
    """Return rotations of the given start about the template's middle, both ways about each axis and diagonal."""
    to_middle = RigidTransform(np.eye(3), subject.vertices_mm.mean(0) - template.vertices_mm.mean(0))
    places = [start] if start is not None else [RigidTransform.identity(), to_middle]
    turns = [np.zeros(3), *(sign * settings.start_turn_rad * axis for axis in np.eye(3) for sign in (1.0, -1.0))]
    turns += [settings.start_turn_rad * (2.0 * np.array(bits) - 1.0) / np.sqrt(3) for bits in np.ndindex(2, 2, 2)]
    return [
        RigidTransform(rotations.exp(turn), place.apply(centre) - rotations.exp(turn) @ place.apply(centre)) @ place
        for place in places
        for turn in turns
    ]


def _residuals(
    motion: RigidTransform, points: SurfacePoints, supports: SupportingPlanes, *, settings: RigidSettings
) -> _Fit:
    moved, facing = motion.apply(points.places), points.normals @ motion.rotation.T
    near = supports.tree.nearest(moved)
    normals = supports.face_normals[near.face]
    matched = supports.known[near.face] & (np.einsum("ni,ni->n", normals, facing) > settings.least_facing)
    along = np.einsum("ni,ni->n", moved - near.points_mm, normals)
    return _Fit(np.where(matched, along, near.distance_mm), matched, normals, moved)


def _weights(fit: _Fit, scale: float) -> Floats:
    """Return the weights of residuals after Geman and McClure; 0 for unmatched points."""
    return np.where(fit.matched, 1 / (1 + (fit.residual / scale) ** 2) ** 2, 0.0)


def _cost(fit: _Fit, scale: float) -> float:
    """Return the robust cost to which the weights belong; an unmatched point has the largest cost of a point."""
    squared = (fit.residual / scale) ** 2
    return float(np.where(fit.matched, squared / (1 + squared), 1.0).mean())


def _scale(fit: _Fit, *, settings: RigidSettings) -> float:
    """Return the scale for the next round: three robust standard deviations of the matched residuals."""
    if not fit.matched.any():
        return settings.coarse_mm
    return float(max(3 * 1.4826 * np.median(np.abs(fit.residual[fit.matched])), settings.finest_mm))


def _descend(
    motion: RigidTransform,
    points: SurfacePoints,
    supports: SupportingPlanes,
    centre: Floats,
    *,
    scales: tuple[float, ...],
    steps: int,
    enough: float = 0.0,
    settings: RigidSettings,
) -> RigidTransform:
    """Reduce the robust cost by Levenberg-Marquardt; points are matched again for every motion that is tried.

    A step that reduces the cost by a smaller share than `enough` is the last.
    """
    for scale in scales:
        damping = 1e-2
        fit = _residuals(motion, points, supports, settings=settings)
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
                tried = _residuals(trial, points, supports, settings=settings)
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
    """Rotate the moved template about its middle, and shift it."""
    turn = rotations.exp(step[:3])
    return RigidTransform(turn, about + step[3:] - turn @ about) @ motion


@dataclass(frozen=True, eq=False)
class _Backward:
    """The subject's points and the template's planes, for the reverse direction."""

    supports: SupportingPlanes
    points: SurfacePoints


def _both_ways(
    motion: RigidTransform,
    points: SurfacePoints,
    supports: SupportingPlanes,
    back: _Backward,
    *,
    settings: RigidSettings,
) -> float:
    """Return the robust cost of both surfaces' points, which is large if only a part of the subject is covered."""
    there = _residuals(motion, points, supports, settings=settings)
    here = _residuals(motion.inverse(), back.points, back.supports, settings=settings)
    return _cost(there, settings.coarse_mm / 2) + _cost(here, settings.coarse_mm / 2)


def _result(
    motion: RigidTransform,
    points: SurfacePoints,
    supports: SupportingPlanes,
    centre: Floats,
    scale: float,
    *,
    settings: RigidSettings,
) -> RigidRegistration:
    fit = _residuals(motion, points, supports, settings=settings)
    lying = fit.matched & (np.abs(fit.residual) < 2 * scale)
    known = supports.known[supports.tree.nearest(fit.moved).face]
    distance = float(np.abs(fit.residual[known]).mean()) if known.any() else np.inf
    if lying.mean() < settings.least_share or distance > settings.farthest_mm:
        raise MareyError(
            f"Only {100 * lying.mean():.0f} % of the template's surface lies on the subject, at a mean distance of "
            f"{distance:.1f} mm. Check that it is the same bone, of the same side, within 30 degrees and 30 mm."
        )
    return RigidRegistration(
        subject_from_template=motion,
        covariance=_covariance(motion, points, supports, motion.apply(centre), scale, settings=settings),
        residual_mm=float(np.sqrt(np.mean(fit.residual[lying] ** 2))),
        surface_distance_mm=distance,
        used=float(lying.mean()),
    )


def _covariance(
    motion: RigidTransform,
    points: SurfacePoints,
    supports: SupportingPlanes,
    about: Floats,
    scale: float,
    *,
    settings: RigidSettings,
) -> Floats:
    """Return the covariance (6, 6) from the covariance of the gradient and its change with the motion (stiffness).

    The stiffness is measured by finite differences: computed from the planes alone it would be too large on a rough
    surface, whose planes change with the motion.
    """
    fit = _residuals(motion, points, supports, settings=settings)
    lying = fit.matched & (np.abs(fit.residual) < 2 * scale)
    weight, jacobian = _weights(fit, scale), _jacobian(fit, about)
    squared = (fit.residual / scale) ** 2
    # A point's gradient changes with its residual by less than its weight, because the weight decreases as well.
    falling = np.where(fit.matched, (1 - 3 * squared) / (1 + squared) ** 3, 0.0).sum() / weight.sum()
    supposed = max(falling, 0.1) * jacobian.T @ (weight[:, None] * jacobian)
    reach = np.sqrt(np.mean(np.sum((fit.moved - about) ** 2, axis=1)))
    nudges = settings.nudge_mm * np.diag(np.repeat([1 / reach, 1.0], 3))
    measured = np.zeros((6, 6))
    for row, nudge in enumerate(nudges):
        ahead, behind = (
            _pull(_stepped(motion, step, about), points, supports, about, scale, settings=settings)
            for step in (nudge, -nudge)
        )
        measured[row] = (ahead - behind) / (2 * nudge[row])
    inverse = np.linalg.inv(bounded_stiffness((measured + measured.T) / 2, supposed))
    smooth = _Fit(fit.residual, fit.matched, smoothed_normals(fit.moved, fit.normals), fit.moved)
    pulls = gradient_covariance(fit.moved[lying], (weight * fit.residual)[lying], _jacobian(smooth, about)[lying])
    return np.asarray(inverse @ pulls @ inverse)


def _pull(
    motion: RigidTransform,
    points: SurfacePoints,
    supports: SupportingPlanes,
    about: Floats,
    scale: float,
    *,
    settings: RigidSettings,
) -> Floats:
    """Return half the gradient (6,) of the summed robust cost."""
    fit = _residuals(motion, points, supports, settings=settings)
    return np.asarray(_jacobian(fit, about).T @ (_weights(fit, scale) * fit.residual))


def _jacobian(fit: _Fit, about: Floats) -> Floats:
    """Return the derivatives (N, 6) of the residuals with respect to a rotation about a point, and a shift."""
    return np.concatenate([np.cross(fit.moved - about, fit.normals), fit.normals], axis=1)

"""Elastic registration of a template's bone to the subject's by the dynamic pyramid ([Dengler1987]).

It solves [Alexander2003] eq. (1). Both bones become images, signed distances from their surfaces, and the field d(u)
minimises M(u - d(u)) - S(u): from a coarse grid to a fine one, on each by Gauss-Newton, with a stabiliser of controlled
continuity. Only the second of its two orders acts everywhere, so that another size or shear costs nothing; the first is
increased where the field is close to a fold, until there is none.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage

from marey.arrays import Floats, Integers, Mask
from marey.compiled.kernels import kernel
from marey.errors import MareyError
from marey.knee.registration.deformation import Deformation
from marey.knee.space.cut_ends import CutPlane, cut_planes, known_faces
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.triangle_tree import TriangleTree, corner_weights


@dataclass(frozen=True, kw_only=True)
class ElasticSettings:
    """Settings of the elastic registration.

    Values without a stated source were chosen by hand.
    """

    steps_mm: tuple[float, ...] = (12.0, 6.0, 3.0)
    """Spacing [mm] of the nodes of the field, one per level."""
    image_mm: float = 2.0
    """Spacing [mm] of the nodes of the images."""
    bands_mm: tuple[float, ...] = (16.0, 8.0, 4.0)
    """Standard deviation [mm] of the weight about the surface, one per level."""
    iterations: int = 12
    """Largest number of iterations on each level."""
    image_sd_mm: float = 0.3
    """Standard deviation [mm] of the difference of the images at a node."""
    bend_sd_per_mm: tuple[float, ...] = (0.004, 0.012, 0.04)
    """Standard deviation [1/mm] of the second derivatives of the field at a node, one per level: finer levels bend
    more."""
    least_determinant: float = 0.15
    """Determinant of the Jacobian below which the first order of continuity is increased."""
    solver_tolerance: float = 1e-3
    """Share of the squared gradient that may remain in each step: the next step solves another problem."""


ELASTIC_DEFAULTS = ElasticSettings()
"""Default settings of the elastic registration."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ElasticRegistration:
    """A template's bone, deformed to the subject's."""

    deformation: Deformation
    registered: TriangleSurface
    """The template with its vertices, in their order, on the subject."""
    normals: Floats
    """(V, 3) the mapped normals of the template."""
    surface_distance_mm: float
    """Mean distance of each surface's vertices from the other surface; cut ends are ignored."""
    farthest_mm: float
    """95th percentile of these distances."""
    least_determinant: float
    """Least determinant of the Jacobian on the grid; above 0 there is no fold."""


@dataclass(frozen=True, eq=False)
class _Image:
    """Signed distances from a bone on a grid."""

    origin_mm: Floats
    step_mm: float
    distance_mm: Floats
    """(X, Y, Z), negative inside."""
    known: Floats
    """(X, Y, Z) 1 where the nearest point of the surface belongs to the bone, 0 where it is on a cut end."""

    @staticmethod
    def of(
        surface: TriangleSurface, cuts: tuple[CutPlane, ...], origin: Floats, step: float, shape: Integers
    ) -> "_Image":
        nodes = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1)
        places = origin + step * nodes
        near = TriangleTree.of(surface).nearest(places)
        weights = corner_weights(surface.corners_mm[near.face], near.points_mm)
        facing = np.einsum("...k,...ki->...i", weights, surface.vertex_normals[surface.faces[near.face]])
        inside = np.einsum("...i,...i->...", places - near.points_mm, facing) < 0
        known = known_faces(surface, cuts, 2.0)[near.face]
        return _Image(origin, step, np.where(inside, -1.0, 1.0) * near.distance_mm, known.astype(float))

    def smoothed(self, width_mm: float) -> "_Image":
        if width_mm <= 0:
            return self
        blurred = ndimage.gaussian_filter(self.distance_mm, width_mm / self.step_mm, mode="nearest")
        return _Image(self.origin_mm, self.step_mm, blurred, self.known)

    def at(self, places: Floats) -> tuple[Floats, Mask]:
        """Return the distances (...) and which are known (...) at positions (..., 3)."""
        nodes = np.moveaxis((places - self.origin_mm) / self.step_mm, -1, 0)
        values = ndimage.map_coordinates(self.distance_mm, nodes, order=1, mode="nearest")
        return values, ndimage.map_coordinates(self.known, nodes, order=1, mode="nearest") > 0.5

    def slopes(self, places: Floats) -> Floats:
        """Return the derivatives (..., 3) at positions."""
        nodes = np.moveaxis((places - self.origin_mm) / self.step_mm, -1, 0)
        parts = [
            ndimage.map_coordinates(part / self.step_mm, nodes, order=1, mode="nearest")
            for part in np.gradient(self.distance_mm)
        ]
        return np.stack(parts, -1)


def register_elastically(
    template: TriangleSurface, subject: TriangleSurface, settings: ElasticSettings = ELASTIC_DEFAULTS,
    done: Callable[[float], None] = lambda share: None,
) -> ElasticRegistration:  # fmt: skip
    """Deform a template's bone to the subject's.

    Args:
        template: Already aligned with the subject by `register_rigidly`.
        subject: The same bone of another person.
        settings: Tuned constants of the algorithm.
        done: Called with the share of the work that is done.

    Raises:
        MareyError: The bones do not overlap, or no field without a fold was found.
    """
    cuts = cut_planes(template), cut_planes(subject)
    images = _images(template, subject, cuts, settings)
    origin = images[0].origin_mm
    field: Floats = np.zeros((3, 2, 2, 2))
    before = float(settings.steps_mm[0])
    for level, step in enumerate(settings.steps_mm):
        shape = _nodes(images[0], step)
        field = _refined(field, before, step, shape) if level else np.zeros((3, *shape))
        field = _level(field, images, step, level, settings)
        before = step
        done((level + 1) / (len(settings.steps_mm) + 1))
    deformation = Deformation(origin_mm=origin, step_mm=before, displacement_mm=field)
    if deformation.least_determinant <= 0:
        raise MareyError("No deformation without a fold was found. Check that both are the same bone of the same side.")
    registered = deformation.subject_surface(template)
    distances = surface_distances(registered, subject, _mapped_cuts(cuts[0], deformation), cuts[1])
    done(1.0)
    return ElasticRegistration(
        deformation=deformation,
        registered=registered,
        normals=deformation.subject_normals(registered.vertices_mm, template.vertex_normals),
        surface_distance_mm=float(distances.mean()),
        farthest_mm=float(np.percentile(distances, 95)),
        least_determinant=deformation.least_determinant,
    )


def surface_distances(
    first: TriangleSurface, second: TriangleSurface, first_cuts: tuple[CutPlane, ...], second_cuts: tuple[CutPlane, ...]
) -> Floats:
    """Return the distances (n,) [mm] of each surface's vertices from the other surface, where both are known.

    Raises:
        MareyError: The surfaces have nothing in common.
    """
    found = []
    for here, there, here_cuts, there_cuts in (
        (first, second, first_cuts, second_cuts), (second, first, second_cuts, first_cuts),
    ):  # fmt: skip
        own = here.vertices_mm[np.unique(here.faces[known_faces(here, here_cuts, 2.0)])]
        near = TriangleTree.of(there).nearest(own)
        found.append(near.distance_mm[known_faces(there, there_cuts, 2.0)[near.face]])
    if not all(len(part) for part in found):
        raise MareyError("The surfaces overlap only at their cut ends.")
    return np.concatenate(found)


def _mapped_cuts(cuts: tuple[CutPlane, ...], deformation: Deformation) -> tuple[CutPlane, ...]:
    places = [deformation.subject_points(cut.point_mm[None])[0] for cut in cuts]
    return tuple(
        CutPlane(point_mm=place, normal=deformation.subject_normals(place[None], cut.normal[None])[0])
        for place, cut in zip(places, cuts, strict=True)
    )


def _images(
    template: TriangleSurface, subject: TriangleSurface, cuts: tuple[tuple[CutPlane, ...], tuple[CutPlane, ...]],
    settings: ElasticSettings,
) -> tuple[_Image, _Image]:  # fmt: skip
    margin = 1.5 * settings.steps_mm[0]
    both = np.concatenate([template.vertices_mm, subject.vertices_mm])
    origin = both.min(0) - margin
    coarse = np.ceil((both.max(0) + margin - origin) / settings.steps_mm[0])
    shape = np.asarray(np.ceil(coarse * settings.steps_mm[0] / settings.image_mm) + 1, np.int64)
    one, two = (
        _Image.of(surface, planes, origin, settings.image_mm, shape)
        for surface, planes in zip((template, subject), cuts, strict=True)
    )
    return one, two


def _nodes(image: _Image, step: float) -> tuple[int, ...]:
    """Count the nodes of a level, which ends where the image does."""
    return tuple(int(np.floor((n - 1) * image.step_mm / step + 1e-9)) + 1 for n in image.distance_mm.shape)


def _refined(field: Floats, before: float, step: float, shape: tuple[int, ...]) -> Floats:
    nodes = np.stack(np.meshgrid(*(np.arange(n) * step / before for n in shape), indexing="ij"))
    return np.stack([ndimage.map_coordinates(part, nodes, order=3, mode="nearest") for part in field])


def _level(field: Floats, images: tuple[_Image, _Image], step: float, level: int, settings: ElasticSettings) -> Floats:
    """Improve the field on one level."""
    width = 0.35 * step if level + 1 < len(settings.steps_mm) else 0.0
    model, subject = (image.smoothed(width) for image in images)
    nodes = np.stack(np.meshgrid(*(np.arange(n) for n in field.shape[1:]), indexing="ij"), -1)
    places = subject.origin_mm + step * nodes
    wanted, known = subject.at(places)
    near = np.exp(-0.5 * (wanted / settings.bands_mm[level]) ** 2)
    stabiliser = _Stabiliser(step, settings.bend_sd_per_mm[level], np.zeros(field.shape[1:]))
    energy = np.inf
    for _ in range(settings.iterations):
        mapped = places - np.moveaxis(field, 0, -1)
        found, there = model.at(mapped)
        # Far from the surfaces of two different bones, their distances are not comparable.
        weight = near * (known & there) / settings.image_sd_mm**2
        residual = found - wanted
        now = float((weight * residual**2).sum() + (field * stabiliser.pull(field)).sum())
        if now > (1 - 1e-3) * energy:
            break
        energy = now
        slope = np.moveaxis(model.slopes(mapped), -1, 0)
        change = _solve(slope, weight, residual, field, stabiliser, tolerance=settings.solver_tolerance)
        field, stabiliser = _without_folds(field, change, stabiliser, step, settings)
    return field


def _solve(
    slope: Floats, weight: Floats, residual: Floats, field: Floats, stabiliser: "_Stabiliser", *, tolerance: float
) -> Floats:
    """Return the change of the field: the solution of the normal equations by conjugate gradients."""

    def applied(vector: Floats) -> Floats:
        return np.asarray(slope * (weight * (slope * vector).sum(0)) + stabiliser.pull(vector))

    right = slope * (weight * residual) - stabiliser.pull(field)
    diagonal = weight * slope**2 + stabiliser.diagonal
    change = np.zeros_like(field)
    rest = right.copy()
    ready = rest / diagonal
    direction = ready.copy()
    product, aim = float((rest * ready).sum()), tolerance * float((right * right / diagonal).sum())
    for _ in range(150):
        if product <= aim or product <= 0:
            break
        image = applied(direction)
        length = product / float((direction * image).sum())
        change += length * direction
        rest -= length * image
        ready = rest / diagonal
        product, before = float((rest * ready).sum()), product
        direction = ready + product / before * direction
    return change


@dataclass(frozen=True, eq=False)
class _Stabiliser:
    """Controlled continuity: the cost of a field's second derivatives, and of its first where that is increased."""

    step_mm: float
    bend_sd: float
    tension: Floats
    """(X, Y, Z) weight of the first order, relative to that of the second on this grid."""

    def pull(self, field: Floats) -> Floats:
        """Return half the derivative of the cost with respect to the field."""
        out = np.zeros_like(field)
        for part, pulled in zip(field, out, strict=True):
            _pull_by_bends(part, pulled)
            if self._tight:
                _pull_by_rises(part, self.tension, pulled)
        out /= (self.step_mm**2 * self.bend_sd) ** 2
        return out

    @cached_property
    def _tight(self) -> bool:
        return bool(self.tension.any())

    @property
    def diagonal(self) -> Floats:
        """(X, Y, Z) approximate diagonal of `pull`."""
        return (42.0 + 6.0 * self.tension) / (self.step_mm**2 * self.bend_sd) ** 2


@kernel
def _pull_by_bends(field, out):  # pragma: no cover - compiled
    """Add to `out` the gradient of the squared second and mixed differences of a field (X, Y, Z), axis by axis."""
    for axis in range(3):
        a, b, c = int(axis == 0), int(axis == 1), int(axis == 2)
        for i in range(field.shape[0] - 2 * a):
            for j in range(field.shape[1] - 2 * b):
                first, middle, last = field[i, j], field[i + a, j + b], field[i + 2 * a, j + 2 * b]
                to_first, to_middle, to_last = out[i, j], out[i + a, j + b], out[i + 2 * a, j + 2 * b]
                for k in range(field.shape[2] - 2 * c):
                    bend = last[k + 2 * c] - 2.0 * middle[k + c] + first[k]
                    to_last[k + 2 * c] += bend
                    to_middle[k + c] -= 2.0 * bend
                    to_first[k] += bend
        # The mixed difference with the next axis, counted twice as in the squared Hessian.
        p, q, r = c, a, b
        for i in range(field.shape[0] - a - p):
            for j in range(field.shape[1] - b - q):
                here, along, aside, both = (
                    field[i, j],
                    field[i + a, j + b],
                    field[i + p, j + q],
                    field[i + a + p, j + b + q],
                )
                to_here, to_along = out[i, j], out[i + a, j + b]
                to_aside, to_both = out[i + p, j + q], out[i + a + p, j + b + q]
                for k in range(field.shape[2] - c - r):
                    twist = 2.0 * (both[k + c + r] - along[k + c] - aside[k + r] + here[k])
                    to_both[k + c + r] += twist
                    to_along[k + c] -= twist
                    to_aside[k + r] -= twist
                    to_here[k] += twist


@kernel
def _pull_by_rises(field, tension, out):  # pragma: no cover - compiled
    """Add to `out` the gradient of the squared first differences of a field (X, Y, Z), weighted by the tension."""
    for axis in range(3):
        a, b, c = int(axis == 0), int(axis == 1), int(axis == 2)
        for i in range(field.shape[0] - a):
            for j in range(field.shape[1] - b):
                for k in range(field.shape[2] - c):
                    tight = 0.5 * (tension[i, j, k] + tension[i + a, j + b, k + c])
                    if tight > 0.0:
                        rise = tight * (field[i + a, j + b, k + c] - field[i, j, k])
                        out[i + a, j + b, k + c] += rise
                        out[i, j, k] -= rise


def _without_folds(
    field: Floats, change: Floats, stabiliser: _Stabiliser, step: float, settings: ElasticSettings
) -> tuple[Floats, _Stabiliser]:
    """Apply the change, or a part of it; increase the continuity where it compresses space too much."""
    for share in (1.0, 0.5, 0.25, 0.1):
        trial = field + share * change
        compressed = _determinants(trial, step) < settings.least_determinant
        if not compressed.any():
            return trial, stabiliser
        spread = ndimage.gaussian_filter(compressed.astype(float), 1.5, mode="nearest")
        raised = stabiliser.tension + 10.0 * spread / max(float(spread.max()), 1e-12)
        stabiliser = _Stabiliser(stabiliser.step_mm, stabiliser.bend_sd, raised)
    return field, stabiliser


def _determinants(field: Floats, step: float) -> Floats:
    """Return the least determinant (X, Y, Z) of the Jacobian of u - d(u), over all one-sided differences."""
    least = np.full(field.shape[1:], np.inf)
    slopes = []
    for axis in range(3):
        gap = np.diff(field, axis=axis + 1) / step
        ahead = np.concatenate([gap, np.take(gap, [-1], axis + 1)], axis + 1)
        behind = np.concatenate([np.take(gap, [0], axis + 1), gap], axis + 1)
        own = np.eye(3)[axis].reshape(3, 1, 1, 1)
        slopes.append((own - ahead, own - behind))
    for bits in np.ndindex(2, 2, 2):
        a, b, c = (slopes[axis][bit] for axis, bit in enumerate(bits))
        least = np.minimum(least, (a * np.cross(b, c, axis=0)).sum(0))
    return least

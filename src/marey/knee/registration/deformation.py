"""Smooth deformation of space on a grid, with its inverse."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage

from marey.arrays import Floats, freeze_fields
from marey.compiled.kernels import kernel
from marey.errors import MareyError
from marey.geometry.vectors import unit_or_zero
from marey.knee.space.surface import TriangleSurface

_NEWTON_STEPS = 40
"""Largest number of Newton steps of the inverse; chosen by hand."""
_CLOSE_MM = 1e-7
"""Error [mm] at which the inverse has converged: negligible for any mesh."""
_ORDER = 3
"""Order of the spline between the nodes."""
_REFINED_NODES = 16
"""Number of nodes of least determinant in each slab about which the determinant is sampled finely; chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Deformation:
    """The field d(u) of [Alexander2003] eq. (1): the point u of the subject is the point u - d(u) of the template."""

    origin_mm: Floats
    """(3,) position of the first node, LPS."""
    step_mm: float
    """Spacing of the nodes along each axis."""
    displacement_mm: Floats
    """(3, X, Y, Z) d at the nodes; a cubic spline between them, constant beyond them."""

    def __post_init__(self) -> None:
        freeze_fields(self, "origin_mm", "displacement_mm")

    def template_points(self, subject_mm: Floats) -> Floats:
        """Map points (..., 3) from the subject to the template."""
        return np.asarray(subject_mm) - self._at(subject_mm)

    def subject_points(self, template_mm: Floats) -> Floats:
        """Map points (..., 3) from the template to the subject: the inverse, by Newton's method.

        Raises:
            MareyError: The field folds there.
        """
        aim = np.asarray(template_mm, float)
        found = aim + self._at(aim)
        for _ in range(_NEWTON_STEPS):
            shift, slopes = self._read(found)
            off = found - shift - aim
            if not off.size or np.abs(off).max() < _CLOSE_MM:
                return found
            step = np.linalg.solve(np.eye(3) - slopes, off[..., None])[..., 0]
            length = np.linalg.norm(step, axis=-1, keepdims=True)
            found = found - step * np.minimum(1.0, 3 * self.step_mm / np.maximum(length, 1e-12))
        raise MareyError("The deformation cannot be inverted everywhere: it folds.")

    def jacobians(self, subject_mm: Floats) -> Floats:
        """Return the derivatives (..., 3, 3) of the template's points with respect to the subject's."""
        return np.asarray(np.eye(3) - self._read(subject_mm)[1])

    def subject_normals(self, subject_mm: Floats, template_normals: Floats) -> Floats:
        """Map normals (..., 3) of the template's surface to its points (..., 3) in the subject."""
        mapped = np.einsum("...ji,...j->...i", self.jacobians(subject_mm), template_normals)
        return unit_or_zero(mapped)

    def subject_surface(self, template: TriangleSurface) -> TriangleSurface:
        """Map a surface of the template to the subject, with its vertices in their order."""
        return TriangleSurface(vertices_mm=self.subject_points(template.vertices_mm), faces=template.faces)

    @cached_property
    def least_determinant(self) -> float:
        """Least determinant of the Jacobian, below 0 where space folds.

        It is sampled at the nodes and halfway between them, and about the least of these at 1/8 of the spacing.
        """
        shape = np.array(self.displacement_mm.shape[1:])
        steps = [np.arange(0, n - 0.5, 0.5) for n in shape]
        found = []
        for x in np.array_split(steps[0], max(len(steps[0]) // 8, 1)):
            nodes = np.stack(np.meshgrid(x, steps[1], steps[2], indexing="ij"), -1).reshape(-1, 3)
            values = np.linalg.det(self.jacobians(self.origin_mm + self.step_mm * nodes))
            least = np.argpartition(values, min(_REFINED_NODES, len(values) - 1))[:_REFINED_NODES]
            found.append(nodes[least])
        eighths = np.stack(np.meshgrid(*[np.arange(-2, 3) / 8] * 3, indexing="ij"), -1).reshape(-1, 1, 3)
        places = np.clip(np.concatenate(found) + eighths, 0, shape - 1)
        return float(np.linalg.det(self.jacobians(self.origin_mm + self.step_mm * places)).min())

    @cached_property
    def _coefficients(self) -> Floats:
        parts = [ndimage.spline_filter(part, _ORDER, mode="nearest") for part in self.displacement_mm]
        return np.ascontiguousarray(np.stack(parts, -1))

    def _at(self, places_mm: Floats) -> Floats:
        return self._read(places_mm)[0]

    def _read(self, places_mm: Floats) -> tuple[Floats, Floats]:
        """Return the displacements (..., 3) at positions (..., 3), and their derivatives (..., 3, 3)."""
        nodes = (np.asarray(places_mm, float) - self.origin_mm) / self.step_mm
        flat = np.ascontiguousarray(nodes.reshape(-1, 3))
        values, slopes = np.empty((len(flat), 3)), np.empty((len(flat), 3, 3))
        _read_spline(self._coefficients, flat, values, slopes)
        return values.reshape(nodes.shape), slopes.reshape(*nodes.shape, 3) / self.step_mm


@kernel
def _read_spline(coefficients, nodes, values, slopes):  # pragma: no cover - compiled
    """Write a cubic spline's values (n, 3) at nodes (n, 3), and its derivatives (n, 3, 3), value by axis.

    Beyond the ends the coefficients (X, Y, Z, 3) are constant.
    """
    count = coefficients.shape
    index = np.empty((3, 4), np.int64)
    weight, rise = np.empty((3, 4)), np.empty((3, 4))
    for n in range(len(nodes)):
        for axis in range(3):
            last = count[axis] - 1
            at = min(max(nodes[n, axis], -3.0), last + 3.0)
            first = int(np.floor(at))
            u = at - first
            weight[axis, 0], weight[axis, 1] = (1 - u) ** 3 / 6, (4 + u * u * (3 * u - 6)) / 6
            weight[axis, 2], weight[axis, 3] = (4 + (1 - u) ** 2 * (3 * (1 - u) - 6)) / 6, u**3 / 6
            rise[axis, 0], rise[axis, 1] = -((1 - u) ** 2) / 2, u * (3 * u - 4) / 2
            rise[axis, 2], rise[axis, 3] = -(1 - u) * (3 * (1 - u) - 4) / 2, u * u / 2
            for m in range(4):
                index[axis, m] = min(max(first - 1 + m, 0), last)
        for part in range(3):
            values[n, part] = 0.0
            for axis in range(3):
                slopes[n, part, axis] = 0.0
        for a in range(4):
            for b in range(4):
                by_both, by_first, by_second = (
                    weight[0, a] * weight[1, b],
                    rise[0, a] * weight[1, b],
                    weight[0, a] * rise[1, b],
                )
                for c in range(4):
                    for part in range(3):
                        term = coefficients[index[0, a], index[1, b], index[2, c], part]
                        values[n, part] += by_both * weight[2, c] * term
                        slopes[n, part, 0] += by_first * weight[2, c] * term
                        slopes[n, part, 1] += by_second * weight[2, c] * term
                        slopes[n, part, 2] += by_both * rise[2, c] * term

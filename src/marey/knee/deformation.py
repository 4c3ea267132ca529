"""A deformation of space on a grid: smooth, without folds, with its inverse."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage

from marey.arrays import Floats, frozen
from marey.errors import MareyError
from marey.knee.surface import Surface

_NEWTON_STEPS = 40
_CLOSE_MM = 1e-7
_ORDER = 3
_LOOKED_CLOSER_AT = 16


@dataclass(frozen=True, eq=False, kw_only=True)
class Deformation:
    """The field d(u) of [Alexander2003] eq. (1): what is at u in the subject is at u - d(u) in the template."""

    origin_mm: Floats
    """(3,) the first node, LPS."""
    step_mm: float
    """From node to node, along each axis."""
    displacement_mm: Floats
    """(3, X, Y, Z) d at the nodes; between them a cubic spline, beyond them as at the last."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "origin_mm", frozen(self.origin_mm))
        object.__setattr__(self, "displacement_mm", frozen(self.displacement_mm))

    def template_points(self, subject_mm: Floats) -> Floats:
        """Carry points (..., 3) from the subject to the template."""
        return np.asarray(subject_mm) - self._at(subject_mm)

    def subject_points(self, template_mm: Floats) -> Floats:
        """Carry points (..., 3) from the template to the subject: the inverse, by Newton's steps.

        Raises:
            MareyError: The field folds there.
        """
        aim = np.asarray(template_mm, float)
        found = aim + self._at(aim)
        for _ in range(_NEWTON_STEPS):
            off = self.template_points(found) - aim
            if not off.size or np.abs(off).max() < _CLOSE_MM:
                return found
            step = np.linalg.solve(self.jacobians(found), off[..., None])[..., 0]
            length = np.linalg.norm(step, axis=-1, keepdims=True)
            found = found - step * np.minimum(1.0, 3 * self.step_mm / np.maximum(length, 1e-12))
        raise MareyError("The deformation cannot be inverted everywhere: it folds.")

    def jacobians(self, subject_mm: Floats) -> Floats:
        """Give the derivatives (..., 3, 3) of the template's points by the subject's: their determinants are positive.

        Of the spline itself, by differences.
        """
        delta = 1e-4 * self.step_mm
        columns = [
            (self.template_points(subject_mm + delta * axis) - self.template_points(subject_mm - delta * axis))
            / (2 * delta)
            for axis in np.eye(3)
        ]
        return np.stack(columns, -1)

    def subject_normals(self, subject_mm: Floats, template_normals: Floats) -> Floats:
        """Carry the normals (..., 3) of a template's surface to the places (..., 3) where it lies in the subject."""
        carried = np.einsum("...ji,...j->...i", self.jacobians(subject_mm), template_normals)
        return np.asarray(carried / np.maximum(np.linalg.norm(carried, axis=-1, keepdims=True), 1e-12))

    def subject_surface(self, template: Surface) -> Surface:
        """Carry a surface of the template to the subject, its vertices in their order."""
        return Surface(vertices_mm=self.subject_points(template.vertices_mm), faces=template.faces)

    @cached_property
    def least_determinant(self) -> float:
        """The least determinant of the Jacobian, below 0 where space folds.

        At the nodes and halfway between them, and by eighths of a step about the places where these are least.
        """
        shape = np.array(self.displacement_mm.shape[1:])
        steps = [np.arange(0, n - 0.5, 0.5) for n in shape]
        found = []
        for x in np.array_split(steps[0], max(len(steps[0]) // 8, 1)):
            nodes = np.stack(np.meshgrid(x, steps[1], steps[2], indexing="ij"), -1).reshape(-1, 3)
            values = np.linalg.det(self.jacobians(self.origin_mm + self.step_mm * nodes))
            least = np.argpartition(values, min(_LOOKED_CLOSER_AT, len(values) - 1))[:_LOOKED_CLOSER_AT]
            found.append(nodes[least])
        eighths = np.stack(np.meshgrid(*[np.arange(-2, 3) / 8] * 3, indexing="ij"), -1).reshape(-1, 1, 3)
        places = np.clip(np.concatenate(found) + eighths, 0, shape - 1)
        return float(np.linalg.det(self.jacobians(self.origin_mm + self.step_mm * places)).min())

    @cached_property
    def _coefficients(self) -> Floats:
        return np.stack([ndimage.spline_filter(part, _ORDER, mode="nearest") for part in self.displacement_mm])

    def _at(self, places_mm: Floats) -> Floats:
        nodes = (np.asarray(places_mm, float) - self.origin_mm) / self.step_mm
        flat = nodes.reshape(-1, 3).T
        parts = [
            ndimage.map_coordinates(part, flat, order=_ORDER, mode="nearest", prefilter=False)
            for part in self._coefficients
        ]
        return np.stack(parts, -1).reshape(nodes.shape)

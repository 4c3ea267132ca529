"""Points measured on a person by frame, with the model's standard deviation."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.body.articulation.pose import PosedBody
from marey.body.metaballs.metaball_person import required_metaballs
from marey.fit.points.point_equations import distances_of, point_equations
from marey.fit.solver.weights import SCALE_IN_SD, component_sd, geman_mcclure
from marey.observations.metaball_points import PointsOnMetaballs, assign

ROBUST_SD_SHARE = 0.932
"""Share of a normal standard deviation that remains under the robust weights at `SCALE_IN_SD`. Its origin is not
recorded. The integral over the weights, sqrt(E[w r^2] / E[w]) of a normal residual r, is 0.906 at a scale of 4 standard
deviations (0.932 belongs to a scale of 4.9): where the deviations are normal and the model's share of them dominates,
the estimated standard deviation is 3 % too small. Results depend on the value; another one was not measured."""

MISFIT_PATCH_M = 0.075
"""Size of the patches over which a person deviates from fitted metaballs by the same amount [m]. On `arm3` the
residuals' correlation is 0.8 within 0.01 m, 0.5 at 0.025 m, 0.2 at 0.05 m and zero beyond 0.12 m, in total as in such
a square."""


@dataclass(frozen=True, kw_only=True)
class PersonPointSettings:
    """Limits of what is estimated from points measured on a person.

    The defaults were chosen by hand; results were not measured against other values.
    """

    least_model_sd_m: float = 2e-4
    """Lower limit of the model's standard deviation: no person is represented more exactly by metaballs [m]."""
    least_scale_m: float = 2e-3
    """Lower limit of the robust scale [m]."""


PERSON_POINT_DEFAULTS = PersonPointSettings()
"""Default limits of what is estimated from points measured on a person."""


@dataclass(frozen=True, eq=False)
class FramePoints:
    """Points measured on the surface in one frame."""

    points: Floats
    """(n, 3) in the world [m]."""
    covariance: Floats
    """(n, 3, 3) [m2]."""

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.points)

    def __getitem__(self, which: Integers | Mask) -> "FramePoints":
        return FramePoints(self.points[which], self.covariance[which])


def thinned_evenly(points: FramePoints, most: int) -> FramePoints:
    """Keep at most a number of points, evenly through their list; neighbouring points are nearly redundant."""
    if len(points) <= most:
        return points
    return points[np.linspace(0, len(points) - 1, most).astype(int)]


def patch_counts(points: Floats, patch_m: float) -> Floats:
    """Return for each point (n,) the number of points in its patch, itself included; patches are cells of a grid.

    The model deviates from a person by the same amount at neighbouring points, so the points of a patch together count
    as one observation.
    """
    if len(points) == 0:
        return np.zeros(0)
    cells = np.floor(points / patch_m).astype(np.int64)
    cells -= cells.min(axis=0)
    # Single numbers are sorted eight times faster than rows.
    cell = np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1))
    _, which, count = np.unique(cell, return_inverse=True, return_counts=True)
    return count[which].astype(float)


@dataclass(frozen=True, eq=False, kw_only=True)
class PersonPoints:
    """All points of a take, and the standard deviation of the model from them."""

    by_frame: Mapping[int, FramePoints]
    """Points by frame."""
    model_sd_m: float = 0.004
    """Standard deviation of a person's surface from that of the metaballs [m]; estimated from the fit."""
    patch_m: float = 0.01
    """Size of the patches in which this deviation is the same [m]."""
    scale_m: float = np.inf
    """Residual at which a point has a quarter of its weight [m]."""
    settings: PersonPointSettings = PERSON_POINT_DEFAULTS
    """Limits of the estimates."""
    _counts: dict[int, Floats] = field(default_factory=dict, init=False, repr=False)

    def observed(self, frame: int, posed: PosedBody) -> PointsOnMetaballs | None:
        """Assign the points of a frame to the limbs of a posed body; return None if there are none."""
        given = self.by_frame.get(frame)
        if given is None or len(given) == 0:
            return None
        if frame not in self._counts:
            self._counts[frame] = patch_counts(given.points, self.patch_m)
        model = self.model_sd_m * np.sqrt(self._counts[frame])
        return assign(required_metaballs(posed.body), posed, given.points, given.covariance, model_sd=model)

    @property
    def shared(self) -> int:
        """Return 0: points have no unknowns of their own."""
        return 0

    def terms(self, frame: int, posed: PosedBody) -> tuple[Floats, Floats]:
        """Return the normal equations (D + N, D + N), (D + N,) of a frame's points, see `sequence.FrameTerms`."""
        size = len(posed.body.skeleton) + len(posed.body.space)
        observed = self.observed(frame, posed)
        if observed is None:
            return np.zeros((size, size)), np.zeros(size)
        found = point_equations(posed, observed, scale=self.scale_m)
        return found.hessian, found.gradient

    def reestimated(self, bodies: Mapping[int, PosedBody]) -> "PersonPoints":
        """Estimate the model's standard deviation from the points' distances to posed bodies (variance component)."""
        found = [self._residuals(frame, posed) for frame, posed in bodies.items()]
        found = [parts for parts in found if parts is not None]
        if not found:
            return self
        residual, known = (np.concatenate(parts) for parts in zip(*found, strict=True))
        weight = geman_mcclure(residual, self.scale_m)
        share = ROBUST_SD_SHARE if np.isfinite(self.scale_m) else 1.0
        model = component_sd(residual / share, known, weight)
        model = max(model, self.settings.least_model_sd_m)
        least = max(SCALE_IN_SD * model, self.settings.least_scale_m)
        return replace(self, model_sd_m=model, scale_m=min(self.scale_m, least))

    def with_narrower_scale(self, factor: float) -> "PersonPoints":
        """Reduce the robust scale by a factor, down to the value that belongs to the model's standard deviation."""
        least = self._least_scale_m
        return replace(self, scale_m=max(least, factor * self.scale_m)) if self.scale_m > least else self

    def with_sd_of_scale(self) -> "PersonPoints":
        """Raise the model's standard deviation to the robust scale while that is wider than its lower limit.

        A wide scale admits residuals as large as itself: the body is not yet in place. Points that are weighed as if
        it were outweigh the priors by so much that sizes and joints move far along what the points hardly determine.
        """
        return replace(self, model_sd_m=max(self.model_sd_m, self.scale_m)) if self.has_wide_scale else self

    @property
    def has_wide_scale(self) -> bool:
        """Whether the robust scale is wider than the value that belongs to the model's standard deviation."""
        return bool(np.isfinite(self.scale_m)) and self.scale_m > self._least_scale_m

    @property
    def _least_scale_m(self) -> float:
        return max(SCALE_IN_SD * self.model_sd_m, self.settings.least_scale_m)

    def _residuals(self, frame: int, posed: PosedBody) -> tuple[Floats, Floats] | None:
        observed = self.observed(frame, posed)
        if observed is None:
            return None
        model = self.model_sd_m**2 * self._counts[frame]
        return distances_of(posed, observed), np.maximum(observed.spread**2 - model, 0.0)

"""Points measured on a person, frame by frame, as the fit of the shape takes them."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.body.articulation.pose import PosedBody
from marey.body.metaballs.metaball_person import required_metaballs
from marey.fit.points.point_equations import distances_of, point_equations
from marey.fit.solver.weights import component, geman_mcclure
from marey.observations.metaball_points import PointsOnMetaballs, assign

STEPS_OF_SCALE = 4.0
"""The robust scale in standard deviations of a point: what lies twice as far hardly counts."""
SHRINKS = 0.932
"""What the robust weights leave of a normal deviation's standard deviation at that scale."""


@dataclass(frozen=True, eq=False)
class FramePoints:
    """Points that were measured on the surface in one frame."""

    points: Floats
    """(n, 3) in the world [m]."""
    covariance: Floats
    """(n, 3, 3) [m2]."""

    def __len__(self) -> int:
        """Count the points."""
        return len(self.points)

    def __getitem__(self, which: Integers | Mask) -> "FramePoints":
        return FramePoints(self.points[which], self.covariance[which])


def spread_over(points: FramePoints, most: int) -> FramePoints:
    """Keep at most so many points, evenly through their list: neighbours say nearly the same."""
    if len(points) <= most:
        return points
    return points[np.linspace(0, len(points) - 1, most).astype(int)]


def alike(points: Floats, patch_m: float) -> Floats:
    """Count for each point (n,) those of its patch, itself included: cells of a grid with about so many metres.

    No body of metaballs is a person: where one point lies off the model, its neighbours do by as much. Each therefore
    counts as one of as many.
    """
    if len(points) == 0:
        return np.zeros(0)
    cells = np.floor(points / patch_m).astype(np.int64)
    _, which, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    return count[which.ravel()].astype(float)


@dataclass(frozen=True, eq=False, kw_only=True)
class PersonPoints:
    """All points of a take, and how well the model is believed to fit them."""

    by_frame: Mapping[int, FramePoints]
    model_sd_m: float = 0.004
    """How far a person's surface lies from the metaballs', as a standard deviation [m]; estimated from the fit."""
    patch_m: float = 0.01
    """Over how many metres such a departure is the same."""
    scale_m: float = np.inf
    """Distance at which a point counts a quarter [m]."""
    _counts: dict[int, Floats] = field(default_factory=dict, init=False, repr=False)

    def observed(self, frame: int, posed: PosedBody) -> PointsOnMetaballs | None:
        """Segment the points of a frame by the limbs of the body as it stands; None where there are none."""
        given = self.by_frame.get(frame)
        if given is None or len(given) == 0:
            return None
        if frame not in self._counts:
            self._counts[frame] = alike(given.points, self.patch_m)
        model = self.model_sd_m * np.sqrt(self._counts[frame])
        return assign(required_metaballs(posed.body), posed, given.points, given.covariance, model_sd=model)

    @property
    def shared(self) -> int:
        """Points have no unknowns of their own."""
        return 0

    def terms(self, frame: int, posed: PosedBody) -> tuple[Floats, Floats]:
        """Give the normal equations (D + N, D + N), (D + N,) of a frame's points, see `sequence.FrameTerms`."""
        size = len(posed.body.skeleton) + len(posed.body.space)
        observed = self.observed(frame, posed)
        if observed is None:
            return np.zeros((size, size)), np.zeros(size)
        found = point_equations(posed, observed, scale=self.scale_m)
        return found.hessian, found.gradient

    def reestimated(self, bodies: Mapping[int, PosedBody]) -> "PersonPoints":
        """Estimate the model's standard deviation from what points lie off posed bodies (variance component)."""
        found = [self._residuals(frame, posed) for frame, posed in bodies.items()]
        found = [parts for parts in found if parts is not None]
        if not found:
            return self
        residual, known = (np.concatenate(parts) for parts in zip(*found, strict=True))
        weight = geman_mcclure(residual, self.scale_m)
        share = SHRINKS if np.isfinite(self.scale_m) else 1.0
        model = component(residual / share, known, weight)
        model = max(model, LEAST_MODEL_SD)
        return replace(self, model_sd_m=model, scale_m=min(self.scale_m, max(STEPS_OF_SCALE * model, LEAST_SCALE)))

    def narrowed(self, factor: float) -> "PersonPoints":
        """Shrink the robust scale, down to what the model's standard deviation asks for."""
        least = max(STEPS_OF_SCALE * self.model_sd_m, LEAST_SCALE)
        return replace(self, scale_m=max(least, factor * self.scale_m)) if self.scale_m > least else self

    def _residuals(self, frame: int, posed: PosedBody) -> tuple[Floats, Floats] | None:
        observed = self.observed(frame, posed)
        if observed is None:
            return None
        model = self.model_sd_m**2 * self._counts[frame]
        return distances_of(posed, observed), np.maximum(observed.spread**2 - model, 0.0)


LEAST_MODEL_SD, LEAST_SCALE = 2e-4, 2e-3
"""No person is metaballs to better than this [m], and no point is thrown out that lies nearer than a scale [m]."""

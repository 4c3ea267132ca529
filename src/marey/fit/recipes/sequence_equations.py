"""Normal equations of a refinement: those of its frames, of further observations, and of windows of frames."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body, ShapeSpace
from marey.fit.solver.banded import BandedSystem, LocalEquations, Window
from marey.fit.solver.body_solver import STEP_SD_M, STEP_SD_RAD
from marey.observations.prior import ShapePrior

STEP_SD_SHAPE = 0.7
"""Standard deviation of a shape parameter's step in one round, in its prior standard deviations (Levenberg-Marquardt
damping). Chosen by hand; other values were not measured."""
UNKNOWN_SD = 1.0
"""Standard deviation of the unknowns that all frames share besides the shape: so large that they are free [m, rad]."""

Arrays = dict[str, Floats]
"""Arrays by name, as a checkpoint stores them."""


@dataclass(frozen=True, eq=False)
class FrameEquations:
    """Normal equations of one frame, and its residuals."""

    hessian: Floats
    """(D, D), (D + M, D + M) or with the shared unknowns (D + M + G, D + M + G)."""
    gradient: Floats
    """(D,), (D + M,) or (D + M + G,)."""
    squares: float
    """Weighted sum of the matches' squared residuals [px2]."""
    total: float
    """Sum of the matches' weights."""
    local: LocalEquations | None = None
    """Equations with unknowns of a few frames, if there are any."""
    by_camera: tuple[tuple[Floats, Floats], ...] = ()
    """Per camera, the part of its matches in `hessian` (D, D) and `gradient` (D,); only in the last round."""


class FrameTerms(Protocol):
    """Normal equations of further observations, frame by frame."""

    @property
    def shared(self) -> int:
        """Return the number G of unknowns that all frames share besides the shape; each round estimates them again."""

    def terms(self, frame: int, posed: PosedBody) -> tuple[Floats, Floats]:
        """Return H (D + M + G, D + M + G) and g (D + M + G,) for pose, shape and the shared unknowns of a frame."""


@runtime_checkable
class LocalTerms(FrameTerms, Protocol):
    """Normal equations of observations with unknowns of a few frames each, which are eliminated with the poses."""

    @property
    def local_sd(self) -> float:
        """Return the standard deviation of such an unknown from zero without observations, in its own unit."""

    def local(self, frame: int, posed: PosedBody) -> LocalEquations | None:
        """Return the equations of a frame; None without any."""


FrameTermsFactory = Callable[[Mapping[int, Pose], Body], FrameTerms]
"""Prepares further observations for a round, given the current poses by frame and the current body."""


def window_terms(
    window: Window, found: Mapping[int, FrameEquations], poses: Sequence[Pose], body: Body, *, frames: Sequence[int],
    spread: Floats, last: bool, local_sd: float | None,
) -> Arrays:  # fmt: skip
    """Return the reduced equations of one window: its poses as functions of the shape, and the shape's terms.

    Args:
        window: The window.
        found: Equations of its frames, by their index.
        poses: One pose per frame of the sequence.
        body: The person.
        frames: The frames of the sequence; smoothness is required between consecutive ones.
        spread: (D,) standard deviation of each coordinate's acceleration [m, rad per squared frame].
        last: Whether the round is the last one, whose covariances are needed.
        local_sd: Standard deviation of unknowns of a few frames; None without any.
    """
    degrees, first = len(body.skeleton), window.first
    shared = max(len(found[f].gradient) for f in range(first, window.last)) - degrees
    system = BandedSystem.empty(window.last - first, degrees, shared)
    for f in range(first, window.last):
        system.add_frame(f - first, found[f].hessian, found[f].gradient, degrees)
    for f in range(first + 1, window.last - 1):
        if frames[f + 1] - frames[f - 1] == 2:
            system.add_smoothness(f - first, poses[first : window.last], spread)
    if local_sd is not None:
        local = {f - first: e.local for f, e in found.items() if e.local is not None and first <= f < window.last}
        system.add_local(local, degrees, prior_sd=local_sd)
    core = range(window.begin, window.end)
    own = [found[f] for f in core if len(found[f].gradient) > degrees]
    none = np.zeros((max(shared, len(body.space)),) * 2)
    step_sd = np.array([STEP_SD_M] * 3 + [STEP_SD_RAD] * (degrees - 3))
    part = system.eliminate(step_sd, window.core) | {
        "corner": sum((e.hessian[degrees:, degrees:] for e in own), none),
        "shape_gradient": sum((e.gradient[degrees:] for e in own), np.zeros(len(none))),
        "squares": np.array(sum(found[f].squares for f in core)),
        "total": np.array(sum(found[f].total for f in core)),
    }
    if last:
        part |= system.covariances(degrees, window.core)
        cameras = [found[f].by_camera for f in range(first, window.last)]
        part["between_cameras"] = system.jackknife(cameras, part["own"], step_sd, window.core)
        part["information"] = np.array([found[f].hessian[:degrees, :degrees] for f in core])
    return part


def step_variance(space: ShapeSpace) -> Floats:
    """Return the variance (M,) of the shape parameters' steps in one round, each in its own unit squared."""
    variance = np.diag(space.prior_covariance)
    usual = np.median(variance) if len(variance) else 0.0
    return np.asarray(STEP_SD_SHAPE**2 * np.maximum(variance, usual))


def shape_prior(body: Body, pose: Pose, count: int | None = None) -> tuple[Floats, Floats]:
    """Return the prior's information and gradient at the body's numbers; further unknowns, up to count, are free."""
    white = ShapePrior().whiten(PosedBody(body, pose), shape=True)
    jacobian = white.jacobian[:, len(body.skeleton) :]
    numbers = len(body.space)
    count = numbers if count is None else count
    information, gradient = np.eye(count) / UNKNOWN_SD**2, np.zeros(count)
    information[:numbers, :numbers] = jacobian.T @ jacobian
    gradient[:numbers] = jacobian.T @ white.residual
    return information, gradient


def add_terms(hessian: Floats, gradient: Floats, more: Floats, pull: Floats, body: Body) -> tuple[Floats, Floats]:
    """Add further equations to those of a frame; without the shape if the frame does not update it."""
    degrees, numbers, size = len(body.skeleton), len(body.space), len(gradient)
    if size == degrees:
        kept = np.r_[0:degrees, degrees + numbers : len(pull)]
        if len(kept) == degrees:
            return hessian + more[:degrees, :degrees], gradient + pull[:degrees]
        silent = np.setdiff1d(np.arange(len(pull)), kept)
        more, pull = more.copy(), pull.copy()
        more[silent], more[:, silent], pull[silent] = 0.0, 0.0, 0.0
    more[:size, :size] += hessian
    pull[:size] += gradient
    return more, pull

"""Normal equations of a stretch of poses, banded over three neighbours in time and bordered by the shape."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from marey.arrays import Floats, Integers
from marey.body.articulation.pose import Pose
from marey.fit.solver.frontal import LINKED_POSES, FrameGroups, FrontalFactor
from marey.fit.solver.threads import map_in_threads

LEAST_CAMERAS = 3
"""Number of cameras from which on one can be left out."""


@dataclass(frozen=True, eq=False)
class LocalEquations:
    """Normal equations of one frame that link its pose with unknowns of a few frames, such as those of a track.

    The unknowns come in groups of k, for example the place of a track on the surface. Different groups are independent
    given the poses.
    """

    groups: Integers
    """(n,) number of each group, which is the same in all its frames."""
    pose: Floats
    """(D, D) information about the pose if the groups were known."""
    pose_gradient: Floats
    """(D,)."""
    by_pose: Floats
    """(D, n, k) information that links pose and groups."""
    own: Floats
    """(n, k, k) information about each group if the pose were known."""
    gradient: Floats
    """(n, k)."""


@dataclass(eq=False)
class BandedSystem:
    """Normal equations of F poses of D coordinates, banded over three neighbours, bordered by M shape parameters.

    Unknowns of a few frames each may be added; they are eliminated with the poses, exactly.
    """

    blocks: Floats
    """(F, 3, D, D) information that links each pose with itself, the next one, and the one after that. Of the first
    block only the upper triangle counts."""
    border: Floats
    """(F D, M)."""
    gradient: Floats
    """(F D,)."""
    groups: FrameGroups | None = None
    """Unknowns of a few frames."""

    @staticmethod
    def empty(frames: int, degrees: int, numbers: int) -> "BandedSystem":
        """Return a system whose equations are all zero."""
        size = frames * degrees
        return BandedSystem(
            np.zeros((frames, LINKED_POSES, degrees, degrees)), np.zeros((size, numbers)), np.zeros(size)
        )  # fmt: skip

    def add_frame(self, f: int, hessian: Floats, gradient: Floats, degrees: int) -> None:
        """Add the equations of one frame, with or without the shape; its block of the shape alone is not stored."""
        here = slice(f * degrees, (f + 1) * degrees)
        self.blocks[f, 0] += hessian[:degrees, :degrees]
        self.gradient[here] += gradient[:degrees]
        if len(gradient) > degrees:
            self.border[here] += hessian[:degrees, degrees:]

    def add_local(self, equations: Mapping[int, LocalEquations], degrees: int, *, prior_sd: float) -> None:
        """Add the equations of unknowns of a few frames; they are eliminated when the system is solved.

        Args:
            equations: Equations by frame, counted from the first of this system.
            degrees: Number D of coordinates of a pose.
            prior_sd: Standard deviation of the unknowns from zero without observations.
        """
        names = sorted({int(name) for equation in equations.values() for name in equation.groups})
        if not names:
            return
        place, size = {name: i for i, name in enumerate(names)}, next(iter(equations.values())).own.shape[1]
        own, pull = np.tile(np.eye(size) / prior_sd**2, (len(names), 1, 1)), np.zeros((len(names), size))
        members = [np.zeros(0, int)] * len(self.blocks)
        links: list[Floats] = [np.zeros((degrees, 0, size))] * len(self.blocks)
        for f, equation in equations.items():
            members[f] = np.array([place[int(name)] for name in equation.groups], int)
            links[f] = equation.by_pose
            own[members[f]] += equation.own
            pull[members[f]] += equation.gradient
            self.blocks[f, 0] += equation.pose
            self.gradient[f * degrees : (f + 1) * degrees] += equation.pose_gradient
        self.groups = FrameGroups(members, links, own, pull)

    def add_smoothness(self, f: int, poses: Sequence[Pose], spread: Floats) -> None:
        """Add the prior that the acceleration at f, the change from f to f+1 less that from f-1 to f, is zero."""
        degrees = len(spread)
        residual = poses[f].change_to(poses[f + 1]) - poses[f - 1].change_to(poses[f])
        weight = 1.0 / spread**2
        share = {f - 1: 1.0, f: -2.0, f + 1: 1.0}
        for a, wa in share.items():
            self.gradient[a * degrees : (a + 1) * degrees] += wa * weight * residual
            for b, wb in share.items():
                if b >= a:
                    np.einsum("ii->i", self.blocks[a, b - a])[:] += wa * wb * weight

    def eliminate(self, step_sd: Floats, core: slice) -> dict[str, Floats]:
        """Eliminate the poses: express them by the shape, and reduce the shape's equations.

        Args:
            step_sd: (D,) standard deviation of a coordinate's step, which damps what no observation determines [m,
                rad].
            core: Frames whose solution is wanted; the others only provide their neighbourhood.

        Returns:
            `own` (n D,) and `by_shape` (n D, M): the poses' step is -(own + by_shape times the shape's step). `taken`
            (M, M) and `taken_gradient` (M,): what the elimination of the core's poses subtracts from the shape's
            information and gradient.
        """
        degrees, sides = len(step_sd), np.concatenate([self.gradient[:, None], self.border], 1)
        of_groups = None
        if self.groups is not None:
            of_groups = np.zeros((*self.groups.gradient.shape, sides.shape[1]))
            of_groups[..., 0] = self.groups.gradient
        rows = slice(core.start * degrees, core.stop * degrees)
        solved, border = self._factored(1.0 / step_sd**2).solve(sides, of_groups)[rows].copy(), self.border[rows]
        return {
            "own": solved[:, 0],
            "by_shape": solved[:, 1:],
            "taken": border.T @ solved[:, 1:],
            "taken_gradient": border.T @ solved[:, 0],
        }

    def covariances(self, degrees: int, core: slice) -> dict[str, Floats]:
        """Compute the covariances of the poses by the recursion of the factor, see `FrontalFactor.inverse_blocks`.

        Returns:
            `blocks` (n, D, D) of the core's poses for a known shape; `spread` (n, D, M), the poses' derivative by the
            shape, see `with_shape_covariance`; `loss` (M, M), what the core's elimination subtracts from the shape's
            information.
        """
        slight = 1e-12 * np.einsum("fii->fi", self.blocks[:, 0]).max()
        factor = self._factored(np.full(degrees, slight))
        solved = factor.solve(self.border)
        rows = slice(core.start * degrees, core.stop * degrees)
        blocks = factor.inverse_blocks()[core]
        spread = solved[rows].reshape(len(blocks), degrees, -1)
        return {"blocks": blocks, "spread": spread.copy(), "loss": self.border[rows].T @ solved[rows]}

    def jackknife(
        self, cameras: Sequence[Sequence[tuple[Floats, Floats]]], whole: Floats, step_sd: Floats, core: slice
    ) -> Floats:  # fmt: skip
        """Compute the covariance that the contradictions between the cameras reveal, for a known shape.

        Without the equations of camera c in all frames, the solution differs by d_c. With C cameras, the jackknife
        gives the covariance (C - 1) / C times the sum of d_c d_c'. The correspondences are kept: this is one step.

        Args:
            cameras: For each frame and camera the parts of H (D, D) and g (D,) that stem from its matches; a frame
                without matches has none.
            whole: (n D,) solution with all cameras, `own` of `eliminate`.
            step_sd: (D,) standard deviation of a coordinate's step, see `eliminate`.
            core: Frames whose covariance is wanted.

        Returns:
            (n, D, D); (0, D, D) with fewer than three cameras, because one alone does not determine a pose.
        """
        degrees, count = len(step_sd), max((len(parts) for parts in cameras), default=0)
        if count < LEAST_CAMERAS:
            return np.zeros((0, degrees, degrees))

        def without(c: int) -> Floats:
            """Return the core's solution (n D,) without camera c."""
            rest = BandedSystem(self.blocks.copy(), self.border[:, :0], self.gradient.copy(), self.groups)
            for f, parts in enumerate(cameras):
                if parts:
                    rest.blocks[f, 0] -= parts[c][0]
                    rest.gradient[f * degrees : (f + 1) * degrees] -= parts[c][1]
            return rest.eliminate(step_sd, core)["own"]

        changes = np.array([whole - each for each in map_in_threads(without, range(count))])
        changes = changes.reshape(count, -1, degrees)
        return np.asarray((count - 1) / count * np.einsum("cni,cnj->nij", changes, changes))

    def _factored(self, more: Floats) -> FrontalFactor:
        """Factor the equations with `more` (D,) added to the diagonal of each pose's block."""
        blocks = self.blocks.copy()
        np.einsum("fii->fi", blocks[:, 0])[:] += more
        return FrontalFactor(blocks, self.groups)


def with_shape_covariance(blocks: Floats, spread: Floats, shape: Floats) -> Floats:
    """Combine the covariances of poses for a known shape with the covariance of the shape.

    Args:
        blocks: (n, D, D) see `BandedSystem.covariances`.
        spread: (n, D, M), or (n, D, 0) where these poses do not depend on the shape.
        shape: (M, M) covariance of the shape.

    Returns:
        (n, D + M, D + M).
    """
    count, degrees, _ = blocks.shape
    whole = np.zeros((count, degrees + len(shape), degrees + len(shape)))
    whole[:, :degrees, :degrees] = blocks
    whole[:, degrees:, degrees:] = shape
    if spread.shape[2]:
        cross = spread @ shape
        whole[:, :degrees, :degrees] += cross @ np.swapaxes(spread, 1, 2)
        whole[:, :degrees, degrees:] = -cross
        whole[:, degrees:, :degrees] = -np.swapaxes(cross, 1, 2)
    return whole


@dataclass(frozen=True)
class Window:
    """A stretch of a sequence that is solved at once: core frames, and neighbours on both sides."""

    first: int
    """The first frame that is used."""
    last: int
    """One beyond the last frame that is used."""
    begin: int
    """The first frame of the core, whose solution is kept."""
    end: int
    """One beyond the last frame of the core."""

    @property
    def core(self) -> slice:
        """The frames of the core, counted from the window's first."""
        return slice(self.begin - self.first, self.end - self.first)


def windows(count: int, length: int, overlap: int) -> list[Window]:
    """Divide a sequence into windows of a given length, each with neighbours; a short sequence is a single window.

    Args:
        count: Number of frames.
        length: Approximate length of the windows' cores, in frames.
        overlap: Number of neighbours on each side.
    """
    if count <= length + 2 * overlap:
        return [Window(0, count, 0, count)]
    edges = np.linspace(0, count, -(-count // length) + 1).astype(int)
    return [Window(max(int(a) - overlap, 0), min(int(b) + overlap, count), int(a), int(b)) for a, b in pairwise(edges)]

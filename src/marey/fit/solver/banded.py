"""Normal equations of a stretch of poses, banded over three neighbours in time and bordered by the shape."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import scipy.linalg

from marey.arrays import Floats, Integers
from marey.body.articulation.pose import Pose
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


@dataclass(frozen=True, eq=False)
class _Eliminated:
    """Groups of k unknowns that are eliminated: B' = B - C E^-1 C' for the poses' information B."""

    border: Floats
    """(F D, G k) C, the information that links poses and groups."""
    own: Floats
    """(G, k, k) the blocks of E, with the groups' prior."""
    gradient: Floats
    """(F D,) what the elimination adds to the poses' gradient."""
    begin: Integers
    """(G k,) first row of each column of the border that may differ from zero; ascending."""


@dataclass(eq=False)
class BandedSystem:
    """Normal equations of F poses of D coordinates, banded over three neighbours, bordered by M shape parameters.

    Unknowns of a few frames each may be added; they are eliminated with the poses, exactly.
    """

    band: Floats
    """(3D, F D) upper form of `scipy.linalg.solveh_banded`."""
    border: Floats
    """(F D, M)."""
    gradient: Floats
    """(F D,)."""
    local: _Eliminated | None = field(default=None, init=False)
    """Unknowns of a few frames."""

    @staticmethod
    def empty(frames: int, degrees: int, numbers: int) -> "BandedSystem":
        """Return a system whose equations are all zero."""
        size = frames * degrees
        return BandedSystem(
            np.zeros((3 * degrees, size)), np.zeros((size, numbers)), np.zeros(size)
        )  # fmt: skip

    def add_block(self, row: int, column: int, block: Floats) -> None:
        """Add a block (D, D) of the upper triangle; the lower half of a diagonal block is ignored."""
        degrees = len(block)
        last = len(self.band) - 1
        i, j = np.meshgrid(np.arange(degrees), np.arange(degrees), indexing="ij")
        r, c = row * degrees + i, column * degrees + j
        upper = c >= r
        self.band[(last + r - c)[upper], c[upper]] += block[upper]

    def add_frame(self, f: int, hessian: Floats, gradient: Floats, degrees: int) -> None:
        """Add the equations of one frame, with or without the shape; its block of the shape alone is not stored."""
        here = slice(f * degrees, (f + 1) * degrees)
        self.add_block(f, f, hessian[:degrees, :degrees])
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
        first: dict[int, int] = {}
        for f, equation in sorted(equations.items()):
            for name in equation.groups:
                first.setdefault(int(name), f)
        if not first:
            return
        # In the order of their first frames: the factor's columns begin there.
        place = {name: i for i, name in enumerate(first)}
        size = next(iter(equations.values())).own.shape[1]
        border = np.zeros((len(self.gradient), len(first), size))
        own, pull = np.tile(np.eye(size) / prior_sd**2, (len(first), 1, 1)), np.zeros((len(first), size))
        for f, equation in equations.items():
            here, at = slice(f * degrees, (f + 1) * degrees), [place[int(name)] for name in equation.groups]
            border[here, at] += equation.by_pose
            own[at] += equation.own
            pull[at] += equation.gradient
            self.add_block(f, f, equation.pose)
            self.gradient[here] += equation.pose_gradient
        flat = border.reshape(len(border), -1)
        solved = np.linalg.solve(own, pull[..., None]).ravel()
        begin = np.repeat(np.array(list(first.values())) * degrees, size)
        self.local = _Eliminated(flat, own, -flat @ solved, begin)

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
                    self._add_diagonal(a, b, wa * wb * weight)

    def _add_diagonal(self, row: int, column: int, values: Floats) -> None:
        degrees = len(values)
        offset = (column - row) * degrees
        columns = np.arange(column * degrees, (column + 1) * degrees)
        self.band[len(self.band) - 1 - offset, columns] += values

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
        degrees = len(step_sd)
        damped = np.tile(1.0 / step_sd**2, self.band.shape[1] // degrees)
        gradient = self.gradient if self.local is None else self.gradient + self.local.gradient
        solved = self._factored(damped).solve(np.concatenate([gradient[:, None], self.border], 1))
        rows = slice(core.start * degrees, core.stop * degrees)
        solved, border = solved[rows].copy(), self.border[rows]
        return {
            "own": solved[:, 0],
            "by_shape": solved[:, 1:],
            "taken": border.T @ solved[:, 1:],
            "taken_gradient": border.T @ solved[:, 0],
        }

    def covariances(self, degrees: int, core: slice) -> dict[str, Floats]:
        """Compute the covariances of the poses by the recursion of the banded factor.

        Ours: the poses' inverse is needed near its diagonal only, where it follows backwards from the Cholesky factor
        ([Takahashi1973]); the shape's contribution is added to it.

        Returns:
            `blocks` (n, D, D) of the core's poses for a known shape; `spread` (n, D, M), the poses' derivative by the
            shape, see `with_shape_covariance`; `loss` (M, M), what the core's elimination subtracts from the shape's
            information.
        """
        slight = np.full(self.band.shape[1], 1e-12 * self.band[-1].max())
        inverse = self._factored(slight)
        solved = inverse.solve(self.border)
        rows = slice(core.start * degrees, core.stop * degrees)
        blocks = inverse.blocks(degrees, core)
        spread = solved[rows].reshape(len(blocks), degrees, -1)
        return {"blocks": blocks, "spread": spread.copy(), "loss": self.border[rows].T @ solved[rows]}

    def jackknife(
        self, cameras: Sequence[Sequence[tuple[Floats, Floats]]], step_sd: Floats, core: slice
    ) -> Floats:  # fmt: skip
        """Compute the covariance that the contradictions between the cameras reveal, for a known shape.

        Without the equations of camera c in all frames, the solution differs by d_c. With C cameras, the jackknife
        gives the covariance (C - 1) / C times the sum of d_c d_c'. The correspondences are kept: this is one step.

        Args:
            cameras: For each frame and camera the parts of H (D, D) and g (D,) that stem from its matches; a frame
                without matches has none.
            step_sd: (D,) standard deviation of a coordinate's step, see `eliminate`.
            core: Frames whose covariance is wanted.

        Returns:
            (n, D, D); (0, D, D) with fewer than three cameras, because one alone does not determine a pose.
        """
        degrees, count = len(step_sd), max((len(parts) for parts in cameras), default=0)
        if count < LEAST_CAMERAS:
            return np.zeros((0, degrees, degrees))
        damped = np.tile(1.0 / step_sd**2, len(cameras))
        gradient = self.gradient if self.local is None else self.gradient + self.local.gradient
        rows = slice(core.start * degrees, core.stop * degrees)

        def without(c: int | None) -> Floats:
            """Return the core's solution (n, D) without camera c."""
            rest = BandedSystem(self.band.copy(), self.border, gradient.copy())
            rest.local = self.local
            for f, parts in enumerate(cameras):
                if parts and c is not None:
                    rest.add_block(f, f, -parts[c][0])
                    rest.gradient[f * degrees : (f + 1) * degrees] -= parts[c][1]
            return rest._factored(damped).solve(rest.gradient[:, None])[rows, 0].reshape(-1, degrees)

        whole, *rest = map_in_threads(without, (None, *range(count)))
        changes = np.array([whole - each for each in rest])
        return np.asarray((count - 1) / count * np.einsum("cni,cnj->nij", changes, changes))

    def _factored(self, more: Floats) -> "_Factored":
        """Factor the equations with `more` (F D,) added to the diagonal."""
        band = self.band.copy()
        band[-1] += more
        factor = scipy.linalg.cholesky_banded(band, overwrite_ab=True, check_finite=False)
        return _Factored(factor, self.local)


class _Factored:
    """The inverse of B - C E^-1 C', for a banded B and the border C of local unknowns.

    With B = U'U and H = U'^-1 C, it is B^-1 + U^-1 H K^-1 H' U'^-1, where K = E - H'H.

    Args:
        factor: The upper banded factor U.
        local: The local unknowns; None if there are none.
    """

    def __init__(self, factor: Floats, local: _Eliminated | None):
        self.factor, self.local = factor, local
        if local is not None:
            self.half = _solve_transposed(factor, local.border, local.begin)
            inner = _lower_products(self.half, local.begin)
            np.negative(inner, out=inner)
            count, size, _ = local.own.shape
            groups = np.arange(count)
            inner.reshape(count, size, count, size)[groups, :, groups] += local.own
            self.lower = scipy.linalg.cholesky(inner, lower=True, overwrite_a=True, check_finite=False)

    def solve(self, right: Floats) -> Floats:
        """Solve for right sides (F D, k)."""
        if right.shape[1] == 0:
            return right
        solved = scipy.linalg.cho_solve_banded((self.factor, False), right, check_finite=False)
        if self.local is None:
            return np.asarray(solved)
        pull = scipy.linalg.cho_solve((self.lower, True), self.local.border.T @ solved, check_finite=False)
        more = scipy.linalg.cho_solve_banded((self.factor, False), self.local.border @ pull, check_finite=False)
        return np.asarray(solved + more)

    def blocks(self, degrees: int, core: slice) -> Floats:
        """Return the diagonal blocks (n, D, D) of the inverse for frames of the core."""
        blocks = _inverse_blocks(self.factor, self.factor.shape[1] // degrees, degrees)[core]
        if self.local is None:
            return blocks
        spread = _solve_upper(self.factor, self.half)[core.start * degrees : core.stop * degrees]
        half = scipy.linalg.solve_triangular(self.lower, spread.T, lower=True, check_finite=False)
        by_frame = np.swapaxes(half.reshape(len(half), len(blocks), degrees), 0, 1)
        return np.asarray(blocks + np.swapaxes(by_frame, 1, 2) @ by_frame)


BLOCK_COLUMNS = 128
"""Columns whose products are computed at once. With 64 to 256, the time of 1,400 columns is the same within 10 %."""


def _lower_products(half: Floats, begin: Integers) -> Floats:
    """Return the lower triangle of X'X for X (n, k) that is zero before its rows `begin` (k,), which ascend.

    Blocks above the diagonal remain zero.
    """
    count = half.shape[1]
    products = np.zeros((count, count))

    def fill(start: int) -> None:
        end, rows = min(start + BLOCK_COLUMNS, count), half[begin[start] :]
        np.matmul(rows[:, start:end].T, rows[:, :end], out=products[start:end, :end])

    for _ in map_in_threads(fill, range(0, count, BLOCK_COLUMNS)):
        pass
    return products


BLOCK_ROWS = 96
"""Rows that are solved at once for many right sides: matrix products are much faster than rows one by one. Chosen by
hand."""


def _solve_transposed(factor: Floats, right: Floats, begin: Integers) -> Floats:
    """Solve U' x = right for an upper banded factor U and right sides (n, k), zero before their rows `begin` (k,)."""
    reach, size, out = len(factor) - 1, len(right), right.copy()
    for start in range(0, size, BLOCK_ROWS):
        end, first = min(start + BLOCK_ROWS, size), max(start - reach, 0)
        part, columns = _dense_part(factor, first, end, start, end), int(np.searchsorted(begin, end))
        here = out[start:end, :columns] - part[: start - first].T @ out[first:start, :columns]
        out[start:end, :columns] = _inverse_of_upper(part[start - first :]).T @ here
    return out


def _solve_upper(factor: Floats, right: Floats) -> Floats:
    """Solve U x = right for an upper banded factor U and right sides (n, k)."""
    reach, size, out = len(factor) - 1, len(right), right.copy()
    for start in reversed(range(0, size, BLOCK_ROWS)):
        end = min(start + BLOCK_ROWS, size)
        last = min(end + reach, size)
        part = _dense_part(factor, start, end, start, last)
        here = out[start:end] - part[:, end - start :] @ out[end:last]
        out[start:end] = _inverse_of_upper(part[:, : end - start]) @ here
    return out


def _inverse_of_upper(block: Floats) -> Floats:
    return np.asarray(scipy.linalg.solve_triangular(block, np.eye(len(block)), check_finite=False))


def _dense_part(factor: Floats, top: int, bottom: int, left: int, right: int) -> Floats:
    """Return rows and columns of a banded upper factor as a dense matrix."""
    i, j = np.meshgrid(np.arange(top, bottom), np.arange(left, right), indexing="ij")
    inside = (j >= i) & (j - i < len(factor))
    part = np.zeros(i.shape)
    part[inside] = factor[(len(factor) - 1 + i - j)[inside], j[inside]]
    return part


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


def _inverse_blocks(factor: Floats, count: int, degrees: int) -> Floats:
    """Return the diagonal blocks (F, D, D) of (U'U)^-1 for a banded factor U of two blocks beside the diagonal."""

    def upper(row: int, column: int) -> Floats:
        block = np.zeros((degrees, degrees))
        if column >= count:
            return block
        i, j = np.meshgrid(np.arange(degrees), np.arange(degrees), indexing="ij")
        r, c = row * degrees + i, column * degrees + j
        inside = (c >= r) & (c - r < len(factor))
        block[inside] = factor[(len(factor) - 1 + r - c)[inside], c[inside]]
        return block

    inverse: dict[tuple[int, int], Floats] = {}
    zero = np.zeros((degrees, degrees))
    for f in range(count - 1, -1, -1):
        diagonal = upper(f, f)
        own = scipy.linalg.solve_triangular(diagonal, np.eye(degrees), check_finite=False)
        first, second = own @ upper(f, f + 1), own @ upper(f, f + 2)
        near, far, beyond = (
            inverse.get((f + 1, f + 1), zero), inverse.get((f + 2, f + 2), zero), inverse.get((f + 1, f + 2), zero)
        )  # fmt: skip
        inverse[f, f + 1] = -(first @ near + second @ beyond.T)
        inverse[f, f + 2] = -(first @ beyond + second @ far)
        # A sum of squares, so that rounding cannot make a variance negative.
        cross = first @ beyond @ second.T
        whole = own @ own.T + first @ near @ first.T + second @ far @ second.T + cross + cross.T
        inverse[f, f] = 0.5 * (whole + whole.T)
    return np.array([inverse[f, f] for f in range(count)])

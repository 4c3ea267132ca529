"""Factorisation of the equations of a stretch of poses, and of unknowns of a few frames each, frame by frame.

A pose is linked with the next two poses, and with the groups of unknowns that its frame shows, for example the places
of the tracks on the surface. Frame by frame, the pose and the groups that end there are eliminated from a small dense
matrix, the front, which holds only what the frames so far are still linked with ([Irons1970]). So time and memory grow
linearly with the number of frames, whatever the number of groups.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from marey.arrays import Floats, Integers

LINKED_POSES = 3
"""Number of successive poses that the equations link: a pose and the next two."""


@dataclass(frozen=True, eq=False)
class FrameGroups:
    """Groups of k unknowns, each linked with the poses of some frames."""

    members: Sequence[Integers]
    """For each frame the groups (n,) that it shows."""
    by_pose: Sequence[Floats]
    """For each frame the information (D, n, k) that links its pose and these groups."""
    own: Floats
    """(G, k, k) information about each group if the poses were known, with its prior."""
    gradient: Floats
    """(G, k)."""


@dataclass(frozen=True, eq=False)
class _Places:
    """Where the unknowns are in the front: the poses in turn, then each group from its first to its last frame."""

    degrees: int
    """Number D of coordinates of a pose."""
    size: int
    """Size N of the front."""
    groups: Integers
    """(G, k) place of each unknown of the groups."""
    begun: Sequence[Integers]
    """For each frame the groups that it shows first."""
    ended: Sequence[Integers]
    """For each frame the groups that it shows last."""

    @staticmethod
    def of(frames: int, degrees: int, groups: FrameGroups | None) -> "_Places":
        """Assign a place to every unknown; a place becomes free where the unknown is eliminated."""
        poses = LINKED_POSES * degrees
        if groups is None:
            none = [np.zeros(0, int)] * frames
            return _Places(degrees, poses, np.zeros((0, 0), int), none, none)
        count, width = groups.gradient.shape
        first, last = np.full(count, frames), np.full(count, -1)
        for f, members in enumerate(groups.members):
            first[members] = np.minimum(first[members], f)
            last[members] = f
        begun, ended = ([np.flatnonzero(at == f) for f in range(frames)] for at in (first, last))
        slot, free, used = np.zeros(count, int), list[int](), 0
        for f in range(frames):
            for group in begun[f]:
                if not free:
                    free.append(used)
                    used += 1
                slot[group] = free.pop()
            free += list(slot[ended[f]])
        places = poses + slot[:, None] * width + np.arange(width)
        return _Places(degrees, poses + used * width, places, begun, ended)

    def pose(self, frame: int) -> slice:
        """Return the places of a pose; a pose takes those of the one three frames before it."""
        first = frame % LINKED_POSES * self.degrees
        return slice(first, first + self.degrees)

    def eliminated(self, frame: int) -> Integers:
        """Return the places of the unknowns that are eliminated in a frame: its pose, and groups."""
        own = self.pose(frame)
        return np.concatenate([np.arange(own.start, own.stop), self.groups[self.ended[frame]].ravel()])


class FrontalFactor:
    """The Cholesky factor of the equations, and solutions with it.

    Args:
        blocks: (F, 3, D, D) information that links each pose with itself (of which the upper triangle is read), with
            the next pose and with the one after it.
        groups: Unknowns of a few frames; None if there are none.

    Raises:
        numpy.linalg.LinAlgError: The equations are singular.
    """

    def __init__(self, blocks: Floats, groups: FrameGroups | None = None):
        frames, _, degrees, _ = blocks.shape
        self._places = _Places.of(frames, degrees, groups)
        self._count = 0 if groups is None else len(groups.own)
        self._steps: list[tuple[Integers, Floats, Floats]] = []
        front = np.zeros((self._places.size, self._places.size))
        for f in range(frames):
            self._add_frame(front, f, blocks[f], min(LINKED_POSES, frames - f), groups)
            places = self._places.eliminated(f)
            rows = front[places]
            upper = scipy.linalg.cholesky(rows[:, places], check_finite=False)
            root = scipy.linalg.solve_triangular(upper, np.eye(len(upper)), check_finite=False)
            rows[:, places] = 0.0
            links = root.T @ rows
            front -= links.T @ links
            front[places], front[:, places] = 0.0, 0.0
            self._steps.append((places, root, links))

    def _add_frame(self, front: Floats, f: int, blocks: Floats, reach: int, groups: FrameGroups | None) -> None:
        own = self._places.pose(f)
        front[own, own] += blocks[0]
        for k in range(1, reach):
            other = self._places.pose(f + k)
            front[own, other] += blocks[k]
            front[other, own] += blocks[k].T
        if groups is None:
            return
        for group in self._places.begun[f]:
            places = self._places.groups[group]
            front[places[0] : places[-1] + 1, places[0] : places[-1] + 1] += groups.own[group]
        places, links = (
            self._places.groups[groups.members[f]].ravel(),
            groups.by_pose[f].reshape(own.stop - own.start, -1),
        )
        front[own, places] += links
        front[places, own] += links.T

    def solve(self, right: Floats, of_groups: Floats | None = None) -> Floats:
        """Solve the equations for the poses.

        Args:
            right: (F D, r) right sides of the poses.
            of_groups: (G, k, r) right sides of the groups; zero if None.

        Returns:
            (F D, r).
        """
        places, degrees = self._places, self._places.degrees
        front = np.zeros((places.size, right.shape[1]))
        halves = []
        for f, (at, root, links) in enumerate(self._steps):
            front[places.pose(f)] += right[f * degrees : (f + 1) * degrees]
            if of_groups is not None:
                front[places.groups[places.begun[f]].ravel()] += of_groups[places.begun[f]].reshape(-1, right.shape[1])
            halves.append(root.T @ front[at])
            front -= links.T @ halves[-1]
            front[at] = 0.0
        out = np.empty(right.shape)
        for f in reversed(range(len(self._steps))):
            at, root, links = self._steps[f]
            front[at] = root @ (halves[f] - links @ front)
            out[f * degrees : (f + 1) * degrees] = front[places.pose(f)]
        return out

    def inverse_blocks(self) -> Floats:
        """Return the diagonal blocks (F, D, D) of the inverse that belong to the poses.

        The inverse is needed only among the unknowns that a front links, where it follows backwards from the factor
        ([Takahashi1973]).
        """
        places, degrees = self._places, self._places.degrees
        inverse = np.zeros((places.size, places.size))
        blocks = np.empty((len(self._steps), degrees, degrees))
        for f in reversed(range(len(self._steps))):
            at, root, links = self._steps[f]
            response = root @ links
            across = response @ inverse
            inverse[at], inverse[:, at] = -across, -across.T
            own = root @ root.T + across @ response.T
            inverse[np.ix_(at, at)] = 0.5 * (own + own.T)
            blocks[f] = inverse[places.pose(f), places.pose(f)]
        return blocks

"""Marker trajectories: paths of labelled skin markers in the laboratory, with gaps and filled points marked."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats, Integers, Mask, freeze_fields
from marey.errors import MareyError


@dataclass(frozen=True, eq=False, kw_only=True)
class MarkerTrajectories:
    """The paths of M markers over F frames, in the laboratory frame of the file."""

    labels: tuple[str, ...]
    """M distinct labels."""
    points: Floats
    """(F, M, 3) [m]; NaN where a marker is missing."""
    rate: float
    """Frames per second [Hz]."""
    start_s: float = 0.0
    """Time of the first frame [s]."""
    filled: Mask
    """(F, M) True where a point was filled rather than measured."""
    residuals: Floats
    """(F, M) residual reported by the measuring system [m]; NaN where it reports none."""
    notes: tuple[str, ...] = ()
    """What the reader skipped or decided, one sentence each."""
    people: tuple[str, ...] = ()
    """Names of people that the reader removed from the labels."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "labels", tuple(str(label) for label in self.labels))
        freeze_fields(self, "points", "residuals")
        freeze_fields(self, "filled", dtype=bool)
        shape = (len(self.points), len(self.labels))
        if self.points.shape != (*shape, 3) or self.filled.shape != shape or self.residuals.shape != shape:
            raise MareyError(f"The array shapes of marker trajectories with {shape[1]} labels do not agree.")
        twice = sorted({label for label in self.labels if self.labels.count(label) > 1})
        if twice:
            raise MareyError(f"Two markers have the label {', '.join(twice)}.")
        if not (np.isfinite(self.rate) and self.rate > 0):
            raise MareyError(f"The rate is {self.rate} and should be above 0.")

    def __len__(self) -> int:
        return len(self.points)

    @property
    def time(self) -> Floats:
        """(F,) time of each frame [s]."""
        return np.asarray(self.start_s + np.arange(len(self)) / self.rate)

    @property
    def present(self) -> Mask:
        """(F, M) True where a marker has a position, measured or filled."""
        return np.asarray(np.isfinite(self.points).all(-1))

    def only_in(self, frames: Mask) -> "MarkerTrajectories":
        """Return a copy that is empty outside of some frames.

        Args:
            frames: (F,) true for the frames to keep.
        """
        if frames.all():
            return self
        points = np.array(self.points)
        points[~frames] = np.nan
        return replace(self, points=points)

    def with_frames_of(self, other: "MarkerTrajectories", frames: Integers) -> "MarkerTrajectories":
        """Return a copy that takes from another one the given frames, where they are empty here.

        Args:
            other: Trajectories of the same markers over the same frames.
            frames: (K,) numbers of frames.
        """
        empty = [f for f in frames if not self.present[f].any() and other.present[f].any()]
        if not empty:
            return self
        points = np.array(self.points)
        points[empty] = other.points[empty]
        return replace(self, points=points)

    def with_points(self, paths: Mapping[str, Floats]) -> "MarkerTrajectories":
        """Return a copy with further points, which count as measured and have no residuals.

        Args:
            paths: Maps a label to positions (F, 3) [m]; NaN where missing. A point of the same label is replaced.
        """
        if not paths:
            return self
        if set(paths) & set(self.labels):
            return self.select([label for label in self.labels if label not in paths]).with_points(paths)
        shape = (len(self), len(paths))
        return replace(
            self, labels=(*self.labels, *paths),
            points=np.concatenate([self.points, np.stack([*paths.values()], 1)], 1),
            filled=np.concatenate([self.filled, np.zeros(shape, bool)], 1),
            residuals=np.concatenate([self.residuals, np.full(shape, np.nan)], 1),
        )  # fmt: skip

    def select(self, labels: Sequence[str]) -> "MarkerTrajectories":
        """Return the trajectories of some markers, in the given order.

        Raises:
            MareyError: A label is missing from the trial.
        """
        unknown = [label for label in labels if label not in self.labels]
        if unknown:
            raise MareyError(f"There is no marker {', '.join(unknown)}. There are: {', '.join(self.labels)}.")
        index = [self.labels.index(label) for label in labels]
        return replace(
            self, labels=tuple(labels), points=self.points[:, index], filled=self.filled[:, index],
            residuals=self.residuals[:, index],
        )  # fmt: skip


def trajectories(labels: Sequence[str], points: Floats, rate: float, *, start_s: float = 0.0) -> MarkerTrajectories:
    """Create trajectories without filled points and with unknown residuals.

    Args:
        labels: M labels.
        points: (F, M, 3) [m]; NaN where missing.
        rate: Frames per second [Hz].
        start_s: Time of the first frame [s].
    """
    shape = np.asarray(points).shape[:2]
    return MarkerTrajectories(
        labels=tuple(labels), points=points, rate=rate, start_s=start_s, filled=np.zeros(shape, bool),
        residuals=np.full(shape, np.nan),
    )  # fmt: skip

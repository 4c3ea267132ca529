"""Frames of a marker trial that are estimated, and its gaps filled."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Mask
from marey.errors import SettingProblem
from marey.markers.data.clusters import Cluster
from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.preprocessing.gaps import FilledGaps, fill_gaps
from marey.pipelines.markers.settings import FILLS, MarkerSettings


@dataclass(frozen=True, eq=False, kw_only=True)
class SelectedTrajectories:
    """Trajectories without the frames that were not requested, and with filled gaps."""

    used: MarkerTrajectories
    """All F frames; those that were not requested are empty."""
    frames: Mask
    """(F,) true for frames that are estimated."""
    filling: FilledGaps | None
    """How gaps were filled; None if that was not requested."""

    @property
    def notes(self) -> tuple[str, ...]:
        """What was filled, one sentence each."""
        return () if self.filling is None else self.filling.notes


def selected_trajectories(
    measured: MarkerTrajectories, clusters: Sequence[Cluster], settings: MarkerSettings
) -> SelectedTrajectories:
    """Keep the requested frames of a trial, and fill its gaps if that is requested.

    Args:
        measured: The trajectories of the file.
        clusters: Segments, from whose other markers a gap can be filled.
        settings: `frames` and `fill`.

    Raises:
        SettingProblem: The trial has none of the requested frames.
    """
    wanted = np.ones(len(measured), bool)
    if settings.frames is not None:
        first, end = settings.frames
        if first >= len(measured):
            raise SettingProblem(
                f"The range of frames (--frames) begins at {first}; the trial has the frames 0 to {len(measured) - 1}."
            )
        wanted[:first] = False
        wanted[end:] = False
    used, filling = measured.only_in(wanted), None
    if FILLS[settings.fill]:
        filling = fill_gaps(used, clusters, ways=FILLS[settings.fill])
        used = filling.trajectories.only_in(wanted)
    return SelectedTrajectories(used=used, frames=wanted, filling=filling)

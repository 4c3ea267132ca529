"""People in the foreground: separate parts of the visual hull, linked over frames."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy.ndimage
from scipy.optimize import linear_sum_assignment

from marey.arrays import Floats, Mask
from marey.cameras.camera import Camera
from marey.fit.search.hull import HullGrid, drawn_cells, filled, room_between
from marey.fit.solver.threads import map_in_threads


@dataclass(frozen=True, kw_only=True)
class HullPeopleSettings:
    """Settings of the search for people in the foreground. Chosen by hand; other values were not measured."""

    cell_m: float = 0.08
    """Edge of the cells of space; people must be farther apart than this [m]."""
    least_height_m: float = 0.7
    """Least height of a part of the hull that may be a person [m]."""
    least_own_share: float = 0.35
    """Least share of its pixels that a person does not share with larger ones, in the camera where this share is
    largest: parts of the hull in which the outlines of others merely cross have less."""
    least_met_share: float = 0.2
    """Least share of the cells of a part in which people have met that belongs to each of them."""
    speed: float = 4.0
    """Largest speed of a person [m/s]."""
    slack_m: float = 0.3
    """Distance that is added to the one which a person may have moved [m]."""
    longest_gap: float = 2.0
    """Longest time after which a person who was not found is the same one [s]."""


@dataclass(eq=False)
class HullTrack:
    """One person in the foreground."""

    cells: dict[int, Floats] = field(default_factory=dict)
    """(n, 3) cells of the person by frame [m]."""

    def middle(self, frame: int) -> Floats:
        """Return the mean (3,) of the cells of a frame [m]."""
        return np.asarray(self.cells[frame].mean(0))


def find_hull_people(
    cameras: Sequence[Camera], masks_of: Callable[[int], Sequence[Mask]], frames: Sequence[int], *, rate: float,
    settings: HullPeopleSettings | None = None, progress: Callable[[int], None] = lambda frame: None,
) -> list[HullTrack]:  # fmt: skip
    """Find the people in the foreground of a take.

    Args:
        cameras: C cameras.
        masks_of: Returns the foreground (height, width) of a frame, one mask per camera.
        frames: The frames, in order.
        rate: Frame rate [Hz].
        settings: Settings of the search.
        progress: Called with each frame.

    Returns:
        The people; the first one was found in the largest number of frames, and among equals with the most cells.
    """
    settings = settings or HullPeopleSettings()
    tracks: list[HullTrack] = []
    parts = map_in_threads(lambda masks: _parts(cameras, masks, settings), map(masks_of, frames))
    for frame, found in zip(frames, parts, strict=True):
        _link_parts(tracks, frame, found, rate, settings)
        progress(frame)
    return sorted(tracks, key=lambda track: (-len(track.cells), -sum(map(len, track.cells.values()))))


def _parts(cameras: Sequence[Camera], masks: Sequence[Mask], settings: HullPeopleSettings) -> list[Floats]:
    """Return the cells (n, 3) of the separate parts of the hull that may be people, the largest one first."""
    seeing = [(camera, mask) for camera, mask in zip(cameras, masks, strict=True) if mask.any()]
    witnesses = min(3, len(seeing))
    if witnesses < 2:
        return []
    centre, reach = room_between([camera for camera, _ in seeing])
    grid = HullGrid.about(centre, reach, settings.cell_m)
    labels, count = scipy.ndimage.label(filled(seeing, grid, witnesses=witnesses), np.ones((3, 3, 3)))
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    boxes = scipy.ndimage.find_objects(labels)
    found: list[Floats] = []
    covered = [np.zeros_like(mask) for _, mask in seeing]
    for part in 1 + np.argsort(-sizes[1:]):
        box = boxes[part - 1]
        if (box[2].stop - box[2].start) * settings.cell_m < settings.least_height_m:
            continue
        corner = np.array([side.start for side in box])
        cells = grid.origin + (np.argwhere(labels[box] == part) + corner) * settings.cell_m
        drawn = [mask & drawn_cells(camera, cells, settings.cell_m) for camera, mask in seeing]
        own = [np.count_nonzero(d & ~c) / (np.count_nonzero(d) + 1e-9) for d, c in zip(drawn, covered, strict=True)]
        if np.max(own) >= settings.least_own_share:
            found.append(cells)
            covered = [c | d for c, d in zip(covered, drawn, strict=True)]
    return found


def _link_parts(
    tracks: list[HullTrack], frame: int, parts: Sequence[Floats], rate: float, settings: HullPeopleSettings
) -> None:
    """Append the parts of a frame to the tracks that end nearest to them, or begin new tracks."""
    parts = _divided(tracks, frame, parts, rate, settings)
    cost = np.full((len(parts), len(tracks)), np.inf)
    for j, track in enumerate(tracks):
        last = max(track.cells)
        gap = (frame - last) / rate
        for i, cells in enumerate(parts):
            apart = float(np.linalg.norm((cells.mean(0) - track.middle(last))[:2]))
            if gap <= settings.longest_gap and apart <= settings.speed * gap + settings.slack_m:
                cost[i, j] = apart
    finite = np.isfinite(cost)
    rows, columns = linear_sum_assignment(np.where(finite, cost, 1.0 + cost[finite].sum()))
    chosen = {int(i): int(j) for i, j in zip(rows, columns, strict=True) if finite[i, j]}
    for i, cells in enumerate(parts):
        if i in chosen:
            tracks[chosen[i]].cells[frame] = cells
        else:
            tracks.append(HullTrack({frame: cells}))


def _divided(
    tracks: Sequence[HullTrack], frame: int, parts: Sequence[Floats], rate: float, settings: HullPeopleSettings
) -> list[Floats]:
    """Divide parts in which several people of the last frame have met, each cell to the nearest person."""
    before = [track.middle(frame - 1)[:2] for track in tracks if frame - 1 in track.cells]
    if len(before) < 2 or not parts:
        return list(parts)
    places = np.array(before)
    nearest = [int(np.argmin([np.linalg.norm(cells[:, :2] - place, axis=1).min() for cells in parts]))
               for place in places]  # fmt: skip
    result = []
    for i, cells in enumerate(parts):
        here = places[[n == i for n in nearest]]
        if len(here) < 2:
            result.append(cells)
            continue
        owner = np.argmin(np.linalg.norm(cells[:, None, :2] - here[None], axis=2), axis=1)
        shares = np.bincount(owner, minlength=len(here)) / len(owner)
        whole = shares.min() < settings.least_met_share
        result += [cells] if whole else [cells[owner == k] for k in range(len(here))]
    return result


def hull_height(track: HullTrack, cell_m: float) -> float:
    """Return the usual vertical extent of a person's part of the hull [m]; raised arms enlarge it."""
    return float(np.median([np.ptp(cells[:, 2]) + cell_m for cells in track.cells.values()]))

"""Causes of tracks of several cameras that contradict the calibration, each tested by trying its repair.

What the thresholds achieve is measured by `bench nonrigid/planted_camera_faults`.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from marey.arrays import Floats
from marey.cameras.camera import Camera
from marey.cameras.epipolar import epipolar_lines
from marey.cameras.rig import Rig
from marey.pipelines.verdict import VerdictReason
from marey.wording import count_of

_NEAR_SIDE = 0.004
"""A place agrees with the calibration if its distance from the epipolar line is below this share of the larger side
of the image. Chosen by hand."""
_SOUND_SHARE = 0.6
"""Share of agreeing places of a pair of cameras from which on nothing is looked for. Chosen by hand."""
_EXPLAINED_SHARE = 0.85
"""Share of agreeing places that a repair must reach. Chosen by hand."""
_CLEARLY = 0.05
"""Difference of two shares below which two repairs explain the same, and nothing is named. Chosen by hand."""
_MOST_PLACES = 400
"""Places of each pair of cameras that are compared; more do not change a share. Chosen for the time."""
_LONGEST_LAG = 10
"""Largest delay of a camera that is tried [frames]. Chosen by hand."""
_RATIOS = (0.1, 0.5, 2 / 3, 1.5, 2.0, 10.0)
"""Ratios of the size of pictures, or of units, that are tried: usual ones. Chosen by hand."""


_UNEXPLAINED = "Check that all tracks are of one recording and of these cameras, and have the same order of points."
"""What to do about tracks that no repair explains."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _TrackRepair:
    """Tracks with a change, as the start of a sentence, and what to do about it."""

    tracks: Floats
    """(C, F, 2, P) [px]."""
    what: str
    remedy: str
    kind: str
    cameras: tuple[str, ...] = ()


def calibrated_track_reasons(tracks: Floats, rig: Rig) -> tuple[VerdictReason, ...]:
    """Explain why tracks of the same points contradict the calibration of their cameras.

    Args:
        tracks: (C, F, 2, P) places [px]; NaN where a point is missing.
        rig: The cameras.

    Returns:
        At most one reason, without a cause if no repair, or more than one, explains it; empty if the cameras agree.
    """
    own = _agreeing_share(tracks, rig)
    if not own < _SOUND_SHARE:
        return ()
    tried = sorted(
        ((_agreeing_share(each.tracks, rig), k, each) for k, each in enumerate(_repairs(tracks, rig))),
        key=lambda found: (-np.nan_to_num(found[0]), found[1]),
    )
    (after, _, best), (rival, _, _) = tried[:2]
    if not after > _EXPLAINED_SHARE or after - rival < _CLEARLY:
        what = f"Only {own:.0%} of the places of one camera agree with the other cameras (epipolar lines)."
        return (VerdictReason.failure(what, _UNEXPLAINED, cause="unexplained"),)
    what = f"{best.what}, {after:.0%} of the places agree with the other cameras (epipolar lines) instead of {own:.0%}."
    return (VerdictReason.failure(what, best.remedy, cameras=best.cameras, cause=best.kind),)


def _agreeing_share(tracks: Floats, rig: Rig) -> float:
    """Return the least share of places near their epipolar lines over the cameras; NaN if no two share points."""
    shares: dict[int, list[float]] = {}
    for i, j in combinations(range(len(tracks)), 2):
        both = np.isfinite(tracks[i]).all(1) & np.isfinite(tracks[j]).all(1)
        frames, points = np.nonzero(both)
        chosen = slice(None, None, max(1, -(-len(frames) // _MOST_PLACES)))
        here, there = (each[frames[chosen], :, points[chosen]] for each in (tracks[i], tracks[j]))
        if len(here):
            share = _near((rig.cameras[i], rig.cameras[j]), here, there)
            shares.setdefault(i, []).append(share)
            shares.setdefault(j, []).append(share)
    return min((float(np.mean(each)) for each in shares.values()), default=float("nan"))


def _near(both: tuple[Camera, Camera], here: Floats, there: Floats) -> float:
    points, along = epipolar_lines(*both, here, there)
    away = there - points
    distance = np.abs(away[:, 0] * along[:, 1] - away[:, 1] * along[:, 0])
    return float(np.mean(distance < _NEAR_SIDE * max(both[1].size)))


def _repairs(tracks: Floats, rig: Rig) -> Iterator[_TrackRepair]:
    yield from _exchanged(tracks, rig)
    flip_remedy = "Write places in pixels from the top left, x to the right and y down."
    for axis, (name, kind) in enumerate((("x", "mirrored"), ("y", "upside down"))):
        for k, camera in enumerate(rig):
            flipped = tracks.copy()
            flipped[k, :, axis] = camera.size[axis] - 1 - flipped[k, :, axis]
            what = f"The {name} axis of the tracks of {camera.name} points the other way: turned round"
            yield _TrackRepair(tracks=flipped, what=what, remedy=flip_remedy, kind=kind, cameras=(camera.name,))
        sizes = np.array([camera.size[axis] for camera in rig])[:, None, None]
        flipped = tracks.copy()
        flipped[:, :, axis] = sizes - 1 - flipped[:, :, axis]
        what = f"The {name} axes of all tracks point the other way: turned round"
        yield _TrackRepair(tracks=flipped, what=what, remedy=flip_remedy, kind=kind)
    for ratio in _RATIOS:
        remedy = "Give the tracks in pixels of the pictures of the calibration."
        for k, camera in enumerate(rig):
            scaled = tracks.copy()
            scaled[k] *= ratio
            what = f"The tracks of {camera.name} are of pictures of another size, or in another unit: times {ratio:.2g}"
            yield _TrackRepair(tracks=scaled, what=what, remedy=remedy, kind="image size", cameras=(camera.name,))
        what = f"The tracks are of pictures of another size than the calibration, or in another unit: times {ratio:.2g}"
        yield _TrackRepair(tracks=tracks * ratio, what=what, remedy=remedy, kind="image size")
    yield from _late(tracks, rig)


def _exchanged(tracks: Floats, rig: Rig) -> Iterator[_TrackRepair]:
    """Yield the tracks of two cameras exchanged."""
    for i, j in combinations(range(len(tracks)), 2):
        order = list(range(len(tracks)))
        order[i], order[j] = j, i
        names = (rig.names[i], rig.names[j])
        what = f"The tracks of {names[0]} and {names[1]} are exchanged: exchanged back"
        remedy = "Exchange the files, or the cameras in the calibration."
        yield _TrackRepair(tracks=tracks[order], what=what, remedy=remedy, kind="exchanged", cameras=names)


def _late(tracks: Floats, rig: Rig) -> Iterator[_TrackRepair]:
    """Yield the tracks of one camera some frames earlier or later."""
    for lag in range(1, min(_LONGEST_LAG, len(tracks[0]) // 2) + 1):
        for sign, how in ((1, "late"), (-1, "early")):
            for k, camera in enumerate(rig):
                moved = np.full_like(tracks, np.nan)
                moved[:] = tracks
                moved[k] = np.nan
                if sign > 0:
                    moved[k, :-lag] = tracks[k, lag:]
                else:
                    moved[k, lag:] = tracks[k, :-lag]
                yield _TrackRepair(
                    tracks=moved, what=f"The tracks of {camera.name} are {count_of(lag, 'frame')} {how}: shifted",
                    remedy="Shift the tracks, or measure the clocks (marey sync).", kind="late",
                    cameras=(camera.name,),
                )  # fmt: skip

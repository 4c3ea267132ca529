"""Following points from one frame to the next: scanned, matched over time in every view, matched between the views."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.cameras.camera import Camera
from marey.cameras.triangulate import triangulate
from marey.errors import SettingProblem
from marey.images.matching.matching import Matches, MatchSettings, match
from marey.images.matching.scanning import scan, scan_patches
from marey.surface.tracks.appearances import Appearances, Picture

_START = 2.5
"""How far a match may go from where the scan found the patch [px]: half a pixel, and what turns and stretches do."""
_LEAST_SD = 0.02
"""No match is trusted more than this [px]."""


@dataclass(frozen=True, kw_only=True)
class ViewPatchSettings:
    """How points are followed by patches that are matched over time and between views.

    Raises:
        SettingProblem: A value is impossible.
    """

    size: int = 13
    """Width and height of a patch [px], odd."""
    box: float = 8.0
    """Half the search box round a predicted place [px]."""
    wide_box: float = 40.0
    """Half the search box where a point's last motion is not known [px]."""
    scanned: float = 0.6
    """Least cross-correlation of a scan."""
    alike: float = 0.85
    """Least correlation with the appearance that a point started with; below, the last frame's takes its place."""
    matched: float = 0.75
    """Least correlation of the last frame, and between the views."""
    agree: float = 0.7
    """How far apart matches over time and between the views may end [px]."""
    certain: float = 0.15
    """Greatest standard deviation of a match [px]: what has too little texture is not followed."""
    residual: float = 1.0
    """Largest root mean square distance of the pixels from the projections of the point they fix [px]."""
    noise: float = 1.5
    """Standard deviation of a pixel's noise [grey levels]."""
    gap: int = 30
    """For how many frames a lost point is looked for."""
    threads: int = 1

    def __post_init__(self) -> None:
        positive = ("box", "wide_box", "agree", "certain", "residual")
        faults = [
            f"{name} is {getattr(self, name):g}; it must be positive"
            for name in positive
            if not getattr(self, name) > 0
        ]
        faults += [
            f"{name} is {getattr(self, name):g}; a correlation lies between 0 and 1"
            for name in ("scanned", "alike", "matched")
            if not 0 <= getattr(self, name) <= 1
        ]
        if faults:
            raise SettingProblem(f"Tracking cannot use these settings: {'; '.join(faults)}.")
        self.matching()

    @property
    def half(self) -> int:
        """Pixels from a patch's centre to its edge."""
        return self.size // 2

    def matching(self) -> MatchSettings:
        """Give the settings of a match."""
        return MatchSettings(size=self.size, noise=self.noise, reach=_START)


@dataclass(frozen=True, eq=False, kw_only=True)
class Followed:
    """What became of n points in a frame; NaN where they were not found."""

    position: Floats
    """(n, 3) [m]."""
    covariance: Floats
    """(n, 3, 3) [m2]."""
    pixels: Floats
    """(n, C, 2) in the views that agree [px]."""
    template: Integers
    """(n,) the view from which the others were matched."""
    across: Floats
    """(n, C, 2, 2) view from template: linear parts of the affine maps between the pictures."""
    maps: Floats
    """(n, C, 2, 2) present picture from appearance."""
    renew: Mask
    """(n, C) whether the appearance has had its day."""

    @property
    def found(self) -> Mask:
        """(n,) whether the point was found."""
        return np.isfinite(self.position[:, 0])


@dataclass(frozen=True, eq=False)
class _Temporal:
    """Matches over time: (n, C) each."""

    pixels: Floats
    maps: Floats
    sd: Floats
    correlation: Floats
    own: Mask
    """Whether the point's own appearance was found, not only the last frame's."""


def follow(
    appearances: Appearances,
    expected: Floats,
    before: tuple[Sequence[Picture], Floats] | None,
    after: Sequence[Picture],
    cameras: Sequence[Camera],
    *,
    template: Integers,
    across: Floats,
    reach: float,
    settings: ViewPatchSettings,
) -> Followed:
    """Find points in a frame, from where they are expected in each view.

    Unlike [Plaenkers1999], where a patch is matched from each frame to the next, it is matched to what it looked like
    when it was started, for as long as it still does so: errors do not add up from frame to frame.

    Args:
        appearances: Of n points.
        expected: (n, C, 2) where each view should show them, NaN in views that should not [px].
        before: The last frame's pictures, and the pixels (n, C, 2) there; None for points that were lost.
        after: C pictures of the frame.
        cameras: C cameras.
        template: (n,) the views from which the others are matched.
        across: (n, C, 2, 2) view from template, as far as known.
        reach: Half the search box [px].
        settings: Sizes and limits.

    Returns:
        What was found.
    """
    temporal = _over_time(appearances, expected, before, after, reach, settings)
    template = _best_template(temporal, template)
    pixels, sd, across = _between_views(temporal, after, expected, template, across, settings)
    points = intersected(cameras, pixels, sd, settings)
    renew = np.isfinite(points.pixels[..., 0]) & ~temporal.own
    return Followed(
        position=points.position, covariance=points.covariance, pixels=points.pixels, template=template, across=across,
        maps=temporal.maps, renew=renew,
    )  # fmt: skip


def _over_time(
    appearances: Appearances, expected: Floats, before: tuple[Sequence[Picture], Floats] | None,
    after: Sequence[Picture], reach: float, settings: ViewPatchSettings,
) -> _Temporal:  # fmt: skip
    """Match every view on its own over time."""
    shape = expected.shape[:2]
    pixels, maps = np.full((*shape, 2), np.nan), appearances.maps.copy()
    sd, correlation, own = np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape, bool)
    for view, picture in enumerate(after):
        wanted = np.isfinite(expected[:, view]).all(axis=1) & appearances.known[:, view]
        if before is not None:
            wanted &= np.isfinite(before[1][:, view]).all(axis=1)
        rows = np.flatnonzero(wanted)
        last = None if before is None else (before[0][view], before[1][rows, view])
        places = _scanned(appearances[rows], expected[rows, view], last, picture, view, reach, settings)
        rows, places = rows[np.isfinite(places[:, 0])], places[np.isfinite(places[:, 0])]
        found = _match_own(appearances[rows], places, picture, view, settings)
        _put(found, rows, view, pixels, maps, sd, correlation)
        own[rows, view] = (found.correlation >= settings.alike) & (_sd(found) <= settings.certain)
        if before is None:
            continue
        again = ~own[rows, view]
        _match_last(rows[again], places[again], view, before, picture, settings, (pixels, maps, sd, correlation))
    unsure = (~own & ~(correlation >= settings.matched)) | ~(sd <= settings.certain)
    pixels[unsure] = np.nan
    if before is None:
        pixels[~own] = np.nan
    return _Temporal(pixels, maps, sd, correlation, own)


def _scanned(
    appearances: Appearances, expected: Floats, last: tuple[Picture, Floats] | None, picture: Picture, view: int,
    reach: float, settings: ViewPatchSettings,
) -> Floats:  # fmt: skip
    """Give the best places (n, 2) of the boxes; NaN where nothing there resembles the point."""
    if last is not None:
        places, score = scan(
            last[0].pyramid, picture.pyramid, last[1], expected, size=settings.size, reach=reach
        )  # fmt: skip
    else:
        drawn = appearances.patches(view, size=settings.size)
        places, score = scan_patches(drawn, picture.pyramid.levels[0], expected, reach=int(np.ceil(reach)))
    places[~(score >= settings.scanned)] = np.nan
    return places


def _match_own(
    appearances: Appearances, places: Floats, picture: Picture, view: int, settings: ViewPatchSettings
) -> Matches:
    """Match the points' own appearances."""
    drawn, centres = appearances.picture(view)
    return match(
        drawn, picture.spline, centres, places, maps=appearances.maps[:, view], settings=settings.matching(),
        threads=settings.threads,
    )  # fmt: skip


def _match_last(
    rows: Integers, places: Floats, view: int, before: tuple[Sequence[Picture], Floats], picture: Picture,
    settings: ViewPatchSettings, into: tuple[Floats, Floats, Floats, Floats],
) -> None:  # fmt: skip
    """Match the last frame's patches where the own appearance is not found any more."""
    origin = before[1][rows, view]
    found = match(
        before[0][view].spline, picture.spline, origin, places, settings=settings.matching(), threads=settings.threads
    )
    _put(found, rows, view, *into)


def _put(
    found: Matches, rows: Integers, view: int, pixels: Floats, maps: Floats, sd: Floats, correlation: Floats
) -> None:
    pixels[rows, view], correlation[rows, view] = found.pixels, np.where(found.converged, found.correlation, np.nan)
    maps[rows, view] = np.where(found.converged[:, None, None], found.search_from_template, maps[rows, view])
    sd[rows, view] = _sd(found)


def _best_template(temporal: _Temporal, template: Integers) -> Integers:
    """Keep a point's template view while it knows the point by its own appearance; otherwise take the most similar."""
    rank = np.where(np.isfinite(temporal.pixels[..., 0]), np.nan_to_num(temporal.correlation), -9.0)
    rank += np.where(temporal.own, 1.0, 0.0)
    row = np.arange(len(template))
    rank[row, template] += np.where(temporal.own[row, template], 9.0, 0.0)
    return np.asarray(rank.argmax(axis=1))


def _between_views(
    temporal: _Temporal, after: Sequence[Picture], expected: Floats, template: Integers, across: Floats,
    settings: ViewPatchSettings,
) -> tuple[Floats, Floats, Floats]:  # fmt: skip
    """Match from the template view to the others, and keep what agrees with the matches over time."""
    row = np.arange(len(template))
    across = _seen_from(across, template)
    pixels, sd = np.full(temporal.pixels.shape, np.nan), np.full(temporal.sd.shape, np.nan)
    pixels[row, template], sd[row, template] = temporal.pixels[row, template], temporal.sd[row, template]
    for origin in range(len(after)):
        for view in range(len(after)):
            rows = np.flatnonzero((template == origin) & np.isfinite(temporal.pixels[:, view, 0]))
            if view == origin or not len(rows):
                continue
            start = temporal.pixels[rows, view]
            found = between(
                after[origin], after[view], temporal.pixels[rows, origin], start, across[rows, view], settings
            )
            rows, place, spread = rows[found.good], found.pixels[found.good], found.sd[found.good]
            own = temporal.own[rows, view]
            pixels[rows, view] = np.where(own[:, None], 0.5 * (place + temporal.pixels[rows, view]), place)
            sd[rows, view] = np.where(own, 0.5 * np.hypot(spread, temporal.sd[rows, view]), spread)
            across[rows, view] = found.maps[found.good]
    return pixels, sd, across


class Between(NamedTuple):
    """Matches from one view to another that agree with where they started; NaN where they do not."""

    good: Mask
    """(n,)."""
    pixels: Floats
    """(n, 2) [px]."""
    sd: Floats
    """(n,) [px]."""
    maps: Floats
    """(n, 2, 2) linear parts."""


def between(
    template: Picture, search: Picture, pixels: Floats, starts: Floats, maps: Floats, settings: ViewPatchSettings,
    *, least: float | None = None,
) -> Between:  # fmt: skip
    """Match points of one view in another one of the same instant.

    Args:
        template: The picture of the one view.
        search: That of the other.
        pixels: (n, 2) the points in the one [px].
        starts: (n, 2) where they should be in the other [px].
        maps: (n, 2, 2) linear parts of the maps to begin with.
        settings: Sizes and limits.
        least: Least correlation, where it is another than that of the settings.

    Returns:
        What was found where it was expected.
    """
    found = match(
        template.spline,
        search.spline,
        pixels,
        starts,
        maps=maps,
        settings=settings.matching(),
        threads=settings.threads,
    )
    apart = np.linalg.norm(found.pixels - starts, axis=1)
    least = settings.matched if least is None else least
    good = np.asarray((found.correlation >= least) & (apart <= settings.agree) & (_sd(found) <= settings.certain))
    return Between(good, np.where(good[:, None], found.pixels, np.nan), _sd(found), found.search_from_template)


def _sd(found: Matches) -> Floats:
    return np.asarray(np.sqrt(0.5 * np.trace(found.covariance, axis1=1, axis2=2)))


def _seen_from(across: Floats, template: Integers) -> Floats:
    """Turn maps from an old template into maps from a new one: the old template's own map is the identity."""
    row = np.arange(len(template))
    return across @ np.linalg.inv(across[row, template])[:, None]


class Intersected(NamedTuple):
    """Points of which the rays meet; NaN where they do not."""

    position: Floats
    """(n, 3) [m]."""
    covariance: Floats
    """(n, 3, 3) [m2]."""
    pixels: Floats
    """(n, C, 2) [px]."""


def intersected(cameras: Sequence[Camera], pixels: Floats, sd: Floats, settings: ViewPatchSettings) -> Intersected:
    """Intersect the rays of n points in C views, and give up those whose rays do not meet.

    Args:
        cameras: C cameras.
        pixels: (n, C, 2) [px]; NaN in views that do not show a point.
        sd: (n, C) their standard deviations [px]; NaN likewise.
        settings: The largest residual.

    Returns:
        The points.
    """
    # The views of a point count alike: what the calibration leaves between the rays must not be shared out anew in
    # every frame.
    views = np.maximum(np.isfinite(sd).sum(axis=1), 1)
    usual = np.sqrt(np.nansum(sd**2, axis=1) / views)
    sigma = np.where(np.isfinite(sd), np.maximum(usual, _LEAST_SD)[:, None], np.nan)
    found = triangulate(cameras, np.moveaxis(pixels, 1, 0), sigma_px=sigma.T)
    good = (found.views >= 2) & (found.residual_px <= settings.residual)
    return Intersected(
        np.where(good[:, None], found.points, np.nan),
        np.where(good[:, None, None], found.covariance, np.nan),
        np.where(good[:, None, None], np.where(np.isfinite(sd)[..., None], pixels, np.nan), np.nan),
    )

"""Tracking of points from one frame to the next: scanning, matching over time in each view, and between the views."""

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
from marey.surface.points.settings import INTERSECTION_DEFAULTS
from marey.surface.tracks.appearances import Appearances, Picture
from marey.surface.tracks.local_motion import LOCAL_MOTION_DEFAULTS, LocalMotionSettings


@dataclass(frozen=True, kw_only=True)
class ViewPatchSettings:
    """Settings of tracking by patches that are matched over time and between views.

    The defaults were chosen by hand unless a field says otherwise; results were not measured against other values.

    Raises:
        SettingProblem: A value is impossible.
    """

    size: int = 13
    """Width and height of a patch [px], odd."""
    box: float = 8.0
    """Half-width of the search box about a predicted position [px]."""
    wide_box: float = 40.0
    """Half-width of the search box if a point's last motion is unknown [px]."""
    scanned: float = 0.6
    """Least cross-correlation of a scan."""
    alike: float = 0.85
    """Least correlation with the point's own appearance; below it, the last frame's patch is used."""
    matched: float = 0.75
    """Least correlation with the last frame's patch, and between the views."""
    agree: float = 0.7
    """Largest distance between the results of matching over time and between the views [px]."""
    certain: float = 0.15
    """Largest standard deviation of a match [px], which excludes points with too little texture."""
    residual: float = 1.0
    """Largest root mean square distance of the pixels from the projections of their point [px]."""
    noise: float = 1.5
    """Standard deviation of a pixel's noise [grey levels]."""
    gap: int = 30
    """Number of frames during which a lost point is searched."""
    start_px: float = 2.5
    """Largest distance of a match from the result of the scan [px]: half a pixel plus the effect of rotation and
    stretch."""
    floor_px: float = INTERSECTION_DEFAULTS.floor_px
    """Standard deviation of a position's errors beyond the covariance of the matches [px]; as for the points of one
    instant."""
    enlarged: tuple[float, ...] = (1.0, 1.6, 2.4)
    """Factors by which patches are enlarged until enough points are confirmed."""
    confirmed_share: float = 0.7
    """Share of the points that patches of a sufficient size confirm."""
    astray_ratio: float = 0.25
    """Largest distance of a point found in a wide box from the prediction by its neighbours, as a share of the largest
    distance of a neighbour."""
    far_ratio: int = 3
    """Factor by which more neighbours, within a larger distance, predict the position of a lost point."""
    local_motion: LocalMotionSettings = LOCAL_MOTION_DEFAULTS
    """How the motion of the surface about a point is estimated."""
    threads: int = 1
    """Number of threads that share the patches."""

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
        """Return the settings of a match."""
        return MatchSettings(size=self.size, noise=self.noise, reach=self.start_px)


@dataclass(frozen=True, eq=False, kw_only=True)
class Followed:
    """Tracking result of n points in a frame; NaN for points that were not found."""

    position: Floats
    """(n, 3) positions [m]."""
    covariance: Floats
    """(n, 3, 3) covariance of the positions [m2]."""
    pixels: Floats
    """(n, C, 2) pixels in the views that agree [px]."""
    sd: Floats
    """(n, C) standard deviations of these pixels [px]."""
    template: Integers
    """(n,) the view from which the others were matched."""
    across: Floats
    """(n, C, 2, 2) view from template: linear parts of the affine maps between the images."""
    maps: Floats
    """(n, C, 2, 2) linear parts of the affine maps from the appearance to the current image."""
    renew: Mask
    """(n, C) whether the appearance must be replaced."""

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
    """Standard deviations that include those of the patches' own places."""
    correlation: Floats
    own: Mask
    """Whether the point's own appearance was found, not only the last frame's patch."""


def follow(
    appearances: Appearances,
    expected: Floats,
    before: tuple[Sequence[Picture], Floats, Floats] | None,
    after: Sequence[Picture],
    cameras: Sequence[Camera],
    *,
    template: Integers,
    across: Floats,
    reach: float,
    settings: ViewPatchSettings,
) -> Followed:
    """Find points in a frame, starting from their predicted positions in each view.

    Unlike [Plaenkers1999], where a patch is matched from each frame to the next, it is matched to its first appearance
    for as long as the two are similar, so that errors do not accumulate.

    Args:
        appearances: Appearances of n points.
        expected: (n, C, 2) predicted pixels, NaN in views that do not show the point [px].
        before: Images of the last frame, the pixels (n, C, 2) in them and the standard deviations (n, C) of these; None
            for lost points.
        after: Images of the C cameras in this frame.
        cameras: C cameras.
        template: (n,) views from which the others are matched.
        across: (n, C, 2, 2) linear parts of the maps from the template view to each view, as far as known.
        reach: Half-width of the search box [px].
        settings: Sizes and limits.

    Returns:
        The tracking result.
    """
    temporal = _over_time(appearances, expected, before, after, reach, settings)
    template = _best_template(temporal, template)
    pixels, sd, across = _between_views(temporal, after, expected, template, across, settings)
    points = intersected(cameras, pixels, sd, settings)
    renew = np.isfinite(points.pixels[..., 0]) & ~temporal.own
    return Followed(
        position=points.position, covariance=points.covariance, pixels=points.pixels,
        sd=np.where(np.isfinite(points.pixels[..., 0]), sd, np.nan), template=template, across=across,
        maps=temporal.maps, renew=renew,
    )  # fmt: skip


def _over_time(
    appearances: Appearances, expected: Floats, before: tuple[Sequence[Picture], Floats, Floats] | None,
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
        places = _scanned(appearances, rows, expected[rows, view], last, picture, view, reach, settings)
        rows, places = rows[np.isfinite(places[:, 0])], places[np.isfinite(places[:, 0])]
        found = _match_own(appearances, rows, places, picture, view, settings)
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
    # An error of the place that a patch was cut out about is one of everything that is matched with it.
    place = appearances.sd if before is None else np.where(own, appearances.sd, before[2])
    return _Temporal(pixels, maps, np.hypot(sd, np.nan_to_num(place)), correlation, own)


def _scanned(
    appearances: Appearances, rows: Integers, expected: Floats, last: tuple[Picture, Floats] | None, picture: Picture,
    view: int, reach: float, settings: ViewPatchSettings,
) -> Floats:  # fmt: skip
    """Return the best positions (n, 2) in the boxes of n points; NaN if no patch there is similar to the point's."""
    if last is not None:
        places, score = scan(
            last[0].pyramid, picture.pyramid, last[1], expected, size=settings.size, reach=reach,
            threads=settings.threads,
        )  # fmt: skip
    else:
        drawn = appearances.patches(view, rows, size=settings.size)
        places, score = scan_patches(
            drawn, picture.pyramid.levels[0], expected, reach=int(np.ceil(reach)), threads=settings.threads
        )
    places[~(score >= settings.scanned)] = np.nan
    return places


def _match_own(
    appearances: Appearances, rows: Integers, places: Floats, picture: Picture, view: int, settings: ViewPatchSettings
) -> Matches:
    """Match the own appearances of n points."""
    drawn, centres = appearances.picture(view, rows)
    return match(
        drawn, picture.spline, centres, places, maps=appearances.maps[rows, view], settings=settings.matching(),
        threads=settings.threads,
    )  # fmt: skip


def _match_last(
    rows: Integers, places: Floats, view: int, before: tuple[Sequence[Picture], Floats, Floats], picture: Picture,
    settings: ViewPatchSettings, into: tuple[Floats, Floats, Floats, Floats],
) -> None:  # fmt: skip
    """Match the last frame's patches of points whose own appearance is no longer found."""
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
    """Keep a point's template view while its own appearance is found there; otherwise choose the most similar view."""
    rank = np.where(np.isfinite(temporal.pixels[..., 0]), np.nan_to_num(temporal.correlation), -9.0)
    rank += np.where(temporal.own, 1.0, 0.0)
    row = np.arange(len(template))
    rank[row, template] += np.where(temporal.own[row, template], 9.0, 0.0)
    return np.asarray(rank.argmax(axis=1))


def _between_views(
    temporal: _Temporal, after: Sequence[Picture], expected: Floats, template: Integers, across: Floats,
    settings: ViewPatchSettings,
) -> tuple[Floats, Floats, Floats]:  # fmt: skip
    """Match from the template view to the others, and keep matches that agree with those over time."""
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
            # Both matches contain the noise of this image, and of the template's: their mean is no more certain.
            sd[rows, view] = np.where(own, 0.5 * (spread + temporal.sd[rows, view]), spread)
            across[rows, view] = found.maps[found.good]
    return pixels, sd, across


class Between(NamedTuple):
    """Matches from one view to another that are near their starting positions; NaN for the others."""

    good: Mask
    """(n,) whether a match is accepted."""
    pixels: Floats
    """(n, 2) positions [px]."""
    sd: Floats
    """(n,) standard deviations of the positions [px]."""
    maps: Floats
    """(n, 2, 2) linear parts of the affine maps."""


def between(
    template: Picture, search: Picture, pixels: Floats, starts: Floats, maps: Floats, settings: ViewPatchSettings,
    *, least: float | None = None,
) -> Between:  # fmt: skip
    """Match points of one view in another view of the same instant.

    Args:
        template: Image of the first view.
        search: Image of the second view.
        pixels: (n, 2) points in the first view [px].
        starts: (n, 2) expected positions in the second view [px].
        maps: (n, 2, 2) linear parts of the initial maps.
        settings: Sizes and limits.
        least: Least correlation, if it differs from the settings'.

    Returns:
        The matches near their expected positions.
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
    """Convert maps from an old template view to maps from a new one; the template's own map is the identity."""
    row = np.arange(len(template))
    return across @ np.linalg.inv(across[row, template])[:, None]


class Intersected(NamedTuple):
    """Intersected points; NaN where the rays do not intersect."""

    position: Floats
    """(n, 3) positions [m]."""
    covariance: Floats
    """(n, 3, 3) covariance of the positions [m2]."""
    pixels: Floats
    """(n, C, 2) pixels of the points [px]."""


def intersected(cameras: Sequence[Camera], pixels: Floats, sd: Floats, settings: ViewPatchSettings) -> Intersected:
    """Intersect the rays of n points in C views, and reject points whose rays do not intersect.

    Args:
        cameras: C cameras.
        pixels: (n, C, 2) pixels of the points [px]; NaN in views that do not show a point.
        sd: (n, C) standard deviations of the pixels [px]; NaN likewise.
        settings: Largest residual.

    Returns:
        The points.
    """
    # All views of a point have equal weight, so that the distribution of calibration errors over the rays is the same
    # in every frame.
    views = np.maximum(np.isfinite(sd).sum(axis=1), 1)
    usual = np.sqrt(np.nansum(sd**2, axis=1) / views)
    sigma = np.where(np.isfinite(sd), np.hypot(usual, settings.floor_px)[:, None], np.nan)
    found = triangulate(cameras, np.moveaxis(pixels, 1, 0), sigma_px=sigma.T)
    good = (found.views >= 2) & (found.residual_px <= settings.residual)
    return Intersected(
        np.where(good[:, None], found.points, np.nan),
        np.where(good[:, None, None], found.covariance, np.nan),
        np.where(good[:, None, None], np.where(np.isfinite(sd)[..., None], pixels, np.nan), np.nan),
    )

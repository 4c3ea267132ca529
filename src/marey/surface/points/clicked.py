"""Refinement of seeds that a user clicked, by matching the images about them."""

from collections.abc import Sequence

import numpy as np

from marey.arrays import Floats, Mask
from marey.cameras.triangulate import triangulate
from marey.surface.points.seeds import Seeds, refine_seeds
from marey.surface.points.settings import SurfaceSettings
from marey.surface.points.sweep import Hypotheses, correlations, facing_maps
from marey.surface.points.views import SurfaceView, TemplateSearch


def clicked_seeds(
    views: Sequence[SurfaceView], compared: Sequence[TemplateSearch], clicks: Floats, settings: SurfaceSettings
) -> tuple[dict[tuple[int, int], Seeds], Mask]:
    """Refine clicked seeds by least-squares matching.

    Two clicks determine a point, and with it its position in the other cameras. About each click the position most
    similar to the template is searched.

    Args:
        views: Views of all C cameras at the instant of the clicks.
        compared: Templates, and the images in which they are searched.
        clicks: (n, C, 2) clicked positions [px]; NaN where unknown.
        settings: Thresholds for matches, and how clicked seeds are refined.

    Returns:
        Seeds by template and searched camera, and which of the clicks were confirmed in any image (n,).
    """
    cameras = [view.camera for view in views]
    points = triangulate(cameras, clicks.swapaxes(0, 1), sigma_px=settings.clicked.click_sd_px).points
    known = np.isfinite(points[:, 0])
    complete = np.array(clicks)
    for c, camera in enumerate(cameras):
        seen = camera.project(points)
        seen[~camera.sees(seen)] = np.nan
        complete[:, c] = np.where(np.isfinite(complete[:, c]), complete[:, c], seen)
    found, confirmed = {}, np.zeros(len(clicks), bool)
    for template, searched in compared:
        for other in searched:
            both = known & np.isfinite(complete[:, [template, other], 0]).all(axis=1)
            pixels = np.round(complete[both, template])
            seeds = _sought(
                views[template], views[other], pixels, complete[both, other], points[both], settings
            )  # fmt: skip
            confirmed[np.flatnonzero(both)[seeds.known]] = True
            found[template, other] = seeds[seeds.known]
    return found, confirmed


def _sought(
    template: SurfaceView, search: SurfaceView, pixels: Floats, there: Floats, points: Floats, settings: SurfaceSettings
) -> Seeds:
    """Compare patches at positions about the clicks, and refine the most similar position."""
    _, maps = facing_maps(template.camera, search.camera, pixels, points)
    clicked = settings.clicked
    steps = np.arange(-clicked.reach_px, clicked.reach_px + 1e-9, clicked.step_px)
    around = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    count, tries = len(pixels), len(around)
    tried = Hypotheses(
        first=np.arange(count + 1) * tries,
        places=(there[:, None] + around).reshape(-1, 2),
        maps=np.repeat(maps, tries, axis=0),
    )
    scores = correlations(
        template.grey.astype(np.float32), search.grey.astype(np.float32), pixels, tried, half=clicked.half_px
    ).reshape(count, tries)
    best = there + around[scores.argmax(axis=1)]
    return refine_seeds(template, search, pixels, best, maps, settings, reach=clicked.refined_reach_px)

"""Detection of the long bones in an image that does not show a femur above a tibia, by fitting a template's bones."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage
from scipy.optimize import least_squares

from marey.arrays import Floats, Integers, Mask
from marey.knee.bones.marrow import WORK_MM, Kind, PreparedImage
from marey.knee.bones.region_growing import GROWING_DEFAULTS, GrowingSettings
from marey.knee.bones.seeds import SEED_DEFAULTS, SeedSettings, check_in_marrow, kind_at, marrow_likeness
from marey.knee.bones.template_fit import (
    TEMPLATE_FIT_DEFAULTS,
    TemplateBone,
    TemplatePlacement,
    edge_contrast,
    moved,
)
from marey.knee.space.distances import distance_within
from marey.knee.space.resampling import read_at
from marey.knee.space.volume import VoxelGrid

LONG_BONES = ("femur", "tibia")
"""Names of the long bones of a knee, from above."""


@dataclass(frozen=True, kw_only=True)
class PartialViewSettings:
    """Settings for finding the long bones in view by a template.

    Values without a stated source were chosen by hand.
    """

    least_contrast: float = 0.65
    """Least mean contrast across the edge of a bone in view, over the part of the edge that lies in the image."""
    least_contrast_at_seed: float = TEMPLATE_FIT_DEFAULTS.least_fit
    """The same for a bone named by a given seed: as for a template's fit."""
    least_known: float = 0.15
    """Least share of the template's edge that lies in the image: any rounded end fits a smaller part."""
    least_fill: float = 0.85
    """Least share of a bone's inside, as far as it lies in the image, that resembles marrow."""
    clear_difference: float = 0.05
    """Least difference of the scores of two bones by which one of them is chosen."""
    sizes: tuple[float, float] = (0.75, 1.33)
    """Least and largest size of a bone relative to the template's."""
    thick_mm: float = 8.0
    """Radius [mm] of the ball that fits into thick places, and their least distance from each other."""
    spots: int = 4
    """Largest number of thick places that are tried."""
    points: int = 400
    """Number of points of the template's edge that are used, approximately."""
    depths_mm: tuple[float, ...] = (8.0, 5.0, 3.0)
    """Distances [mm] from the edge at which the inside is sampled, one per round of the refinement."""
    refined_starts: int = 5
    """Number of starts that are refined."""
    least_start_score: float = 0.1
    """Least score of a start."""
    change_weights: tuple[float, ...] = (7.5, 7.5, 7.5, 0.75, 0.75, 0.75, 20.0)
    """Weights of rotation [1/rad], shift [1/cm] and logarithm of size beside the contrast: 0.2 rad, 20 mm and 8 %
    are usual, and neighbouring points of an edge are not independent."""


PARTIAL_VIEW_DEFAULTS = PartialViewSettings()
"""Default settings for finding the long bones in view by a template."""


@dataclass(frozen=True, kw_only=True)
class EdgeMatch:
    """How well the part of a placed bone's edge that lies in an image matches an edge of marrow."""

    contrast: float
    """Mean contrast over that part, 1 where every point lies on a bone's edge; -1 where none of it is in the image."""
    known: float
    """Share of the edge that lies in the image."""

    @property
    def score(self) -> float:
        """Contrast, weighted by the share of the edge in which it is visible."""
        return float(self.contrast * self.known**0.25)


@dataclass(frozen=True, eq=False, kw_only=True)
class SeenBone:
    """A template's long bone, fitted to where an image may show one."""

    name: str
    kind: Kind
    mirrored: bool
    placement: TemplatePlacement
    seed: Integers
    """(3,) voxel k, j, i in thick marrow within it."""
    contrast: float
    """Mean contrast over the edge that lies in the image; 1 where every point lies on a bone's edge."""
    known: float
    """Share of the template's edge that lies in the image."""
    fill: float
    """Share of its inside, as far as it lies in the image, that resembles marrow."""

    @property
    def score(self) -> float:
        """Contrast, weighted by the share of the edge in which it is visible."""
        return float(self.contrast * self.known**0.25)


@dataclass(frozen=True, eq=False, kw_only=True)
class PartialView:
    """The long bones in an image that does not show a femur above a tibia."""

    kind: Kind
    seeds: dict[str, Integers]
    """Bone to voxel (3,) k, j, i."""
    seen: dict[str, SeenBone]
    """Where the template's bones lie; empty without a template."""


def partial_view(
    knee: PreparedImage,
    bones: Mapping[str, TemplateBone],
    given: Mapping[str, Integers],
    *,
    settings: PartialViewSettings = PARTIAL_VIEW_DEFAULTS,
    seeds: SeedSettings = SEED_DEFAULTS,
    growing: GrowingSettings = GROWING_DEFAULTS,
) -> PartialView | None:
    """Find the long bones in view by a template, or by a given seed.

    Args:
        knee: The prepared image.
        bones: Bones of the template; empty without a template.
        given: Bone to voxel (3,) k, j, i of its seed.
        settings: Tuned constants of the algorithm.
        seeds: Settings for checking the given seeds.
        growing: Settings for the level of marrow about a seed.

    Returns:
        None where there is no evidence for either bone.

    Raises:
        SettingProblem: A given seed does not lie in marrow.
    """
    given = {bone: given[bone] for bone in LONG_BONES if bone in given}
    wanted = {bone: each for bone, each in bones.items() if not given or bone in given}
    seen = seen_bones(knee, wanted, settings=settings, growing=growing)
    if given:
        # The seed names the bone: the template only has to fit there.
        found = {bone: each for bone, each in seen.items() if each.contrast >= settings.least_contrast_at_seed}
    elif not (found := in_view(seen, bones, knee.grid, settings=settings)):
        return None
    kind = next(iter(found.values())).kind if found else kind_at(knee, list(given.values()), settings=seeds)
    check_in_marrow(knee, kind, given, settings=seeds)
    return PartialView(kind=kind, seeds={bone: each.seed for bone, each in found.items()} | given, seen=found)


def seen_bones(
    knee: PreparedImage,
    bones: Mapping[str, TemplateBone],
    *,
    kinds: Sequence[Kind] = ("dark", "bright"),
    settings: PartialViewSettings = PARTIAL_VIEW_DEFAULTS,
    growing: GrowingSettings = GROWING_DEFAULTS,
) -> dict[str, SeenBone]:
    """Fit a template's femur and tibia separately to thick pieces of what may be marrow.

    Args:
        knee: The prepared image.
        bones: Bones of the template.
        kinds: Kinds of marrow that are tried.
        settings: Tuned constants of the algorithm.
        growing: Settings for the level of marrow about a seed.

    Returns:
        Femur and tibia, each where it fits best, whether or not it is in view: `in_view` decides.
    """
    starts: dict[str, list[_Start]] = {name: [] for name in LONG_BONES if name in bones}
    few = {name: _thinned(bones[name], settings=settings) for name in starts}
    for kind in kinds if starts else ():
        for voxel in _thickest(knee.candidates[kind], knee.within, settings=settings):
            likeness = marrow_likeness([knee], [kind], voxel, settings=growing)
            for name, found in starts.items():
                found += _starts(few[name], kind, voxel, likeness, knee.grid, settings=settings)
    best: dict[str, SeenBone] = {}
    for name, found in starts.items():
        for start in sorted(found, key=lambda each: -each.score)[: settings.refined_starts]:
            seen = _fitted(name, few[name], start, knee.grid, settings=settings)
            size = abs(float(np.linalg.det(seen.placement.matrix))) ** (1 / 3)
            if settings.sizes[0] < size < settings.sizes[1] and (name not in best or seen.score > best[name].score):
                best[name] = seen
    return best


def in_view(
    seen: Mapping[str, SeenBone],
    bones: Mapping[str, TemplateBone],
    grid: VoxelGrid,
    *,
    settings: PartialViewSettings = PARTIAL_VIEW_DEFAULTS,
) -> dict[str, SeenBone]:
    """Keep the long bones that are in view.

    Args:
        seen: The fitted bones.
        bones: Bones of the template.
        grid: The upright grid of the image.
        settings: Tuned constants of the algorithm.

    Returns:
        Nothing where no bone is in view, or where one bone is in view that may be either; both bones only where the
        femur lies above the tibia and neither lies in the other.
    """
    sure = {name: each for name, each in seen.items() if _is_sure(each, settings=settings)}
    if len(sure) < 2:
        return sure
    femur, tibia = sure["femur"], sure["tibia"]
    positions = {name: grid.lps(each.seed[::-1].astype(float)) for name, each in sure.items()}
    one_in_other = any(
        lies_within(bones[outer], sure[outer].placement, positions[inner])
        for outer, inner in (("tibia", "femur"), ("femur", "tibia"))
    )
    apart = femur.seed[0] > tibia.seed[0] and not one_in_other
    if apart and femur.kind == tibia.kind and femur.mirrored == tibia.mirrored:
        return sure
    if abs(femur.score - tibia.score) < settings.clear_difference:
        return {}
    return {"femur": femur} if femur.score > tibia.score else {"tibia": tibia}


def _is_sure(seen: SeenBone, *, settings: PartialViewSettings) -> bool:
    """Return whether a bone is in view, rather than something else of the same brightness."""
    return (
        seen.contrast >= settings.least_contrast
        and seen.known >= settings.least_known
        and seen.fill >= settings.least_fill
    )


def _thickest(mask: Mask, within: Mask, *, settings: PartialViewSettings) -> list[Integers]:
    """Return voxels k, j, i in the middle of the thickest pieces, which continue beyond the end of the image."""
    radius = np.where(mask, distance_within(mask | ~within), 0.0) * WORK_MM
    peaks = np.argwhere((ndimage.maximum_filter(radius, 15) == radius) & (radius >= settings.thick_mm))
    chosen: list[Integers] = []
    for voxel in peaks[np.argsort(-radius[tuple(peaks.T)])]:
        if all(np.linalg.norm(voxel - other) * WORK_MM > settings.thick_mm for other in chosen):
            chosen.append(voxel)
    return chosen[: settings.spots]


@dataclass(frozen=True, eq=False, kw_only=True)
class _Start:
    """A candidate position of a bone: one of its thick places on one of the image's."""

    score: float
    kind: Kind
    voxel: Integers
    likeness: np.ndarray
    mirrored: bool
    placement: TemplatePlacement


def _starts(
    bone: TemplateBone,
    kind: Kind,
    voxel: Integers,
    likeness: np.ndarray,
    grid: VoxelGrid,
    *,
    settings: PartialViewSettings,
) -> Iterator[_Start]:
    """Place a bone so that one of its thick places is at a voxel, as a left and as a right bone."""
    place = grid.lps(voxel[::-1].astype(float))
    for mirrored in (False, True):
        flip = np.diag([-1.0 if mirrored else 1.0, 1, 1])
        for spot in _thickest(bone.distance_mm > 0, np.ones(bone.grid.shape, bool), settings=settings):
            placement = TemplatePlacement(matrix=flip, shift=place - flip @ bone.grid.lps(spot[::-1].astype(float)))
            match = edge_match(bone, placement, likeness, grid, settings.depths_mm[0])
            if match.known >= settings.least_known and match.score > settings.least_start_score:
                yield _Start(
                    score=match.score, kind=kind, voxel=voxel, likeness=likeness, mirrored=mirrored, placement=placement
                )


def _fitted(
    name: str, bone: TemplateBone, start: _Start, grid: VoxelGrid, *, settings: PartialViewSettings
) -> SeenBone:
    placement = _refined(bone, start.placement, start.likeness, grid, settings=settings)
    match = edge_match(bone, placement, start.likeness, grid, settings.depths_mm[-1])
    return SeenBone(
        name=name,
        kind=start.kind,
        mirrored=start.mirrored,
        placement=placement,
        seed=start.voxel,
        contrast=match.contrast,
        known=match.known,
        fill=filled_share(bone, placement, start.likeness, grid),
    )


def _thinned(bone: TemplateBone, *, settings: PartialViewSettings) -> TemplateBone:
    every = max(1, len(bone.points_mm) // settings.points)
    return replace(bone, points_mm=bone.points_mm[::every], normals=bone.normals[::every])


def _refined(
    bone: TemplateBone,
    start: TemplatePlacement,
    likeness: np.ndarray,
    grid: VoxelGrid,
    *,
    settings: PartialViewSettings,
) -> TemplatePlacement:
    """Rotate, shift and scale a bone; the part of its edge outside the image is no evidence."""
    centre = start.image_from_template(bone.points_mm.mean(axis=0))
    for depth in settings.depths_mm:
        about = start
        usual = max(edge_match(bone, start, likeness, grid, depth).contrast, 0.0)

        def residuals(
            change: Floats, about: TemplatePlacement = about, usual: float = usual, depth: float = depth
        ) -> Floats:
            contrast = edge_contrast(bone, moved(about, change, centre), likeness, grid, depth)
            return np.concatenate(
                [1 - np.where(np.isnan(contrast), usual, contrast), np.array(settings.change_weights) * change]
            )

        start = moved(start, least_squares(residuals, np.zeros(7), diff_step=1e-2, max_nfev=10).x, centre)
    return start


def edge_match(
    bone: TemplateBone, placement: TemplatePlacement, likeness: np.ndarray, grid: VoxelGrid, depth_mm: float
) -> EdgeMatch:
    """Measure how well the part of an edge in the image matches an edge of marrow; arguments as of `edge_contrast`."""
    contrast = edge_contrast(bone, placement, likeness, grid, depth_mm)
    known = float(np.isfinite(contrast).mean())
    return EdgeMatch(contrast=float(np.nanmean(contrast)) if known else -1.0, known=known)


def filled_share(bone: TemplateBone, placement: TemplatePlacement, likeness: np.ndarray, grid: VoxelGrid) -> float:
    """Return the share of a placed bone's inside, as far as it lies in the image, that resembles marrow."""
    inside = np.argwhere(bone.distance_mm > 3 * WORK_MM)[::41]
    places = placement.image_from_template(bone.grid.lps(inside[:, ::-1].astype(float)))
    values = read_at((likeness > 0) * 1.0 + np.where(np.isnan(likeness), np.nan, 0), grid, places, outside=np.nan)
    return float(np.nanmean(values)) if np.isfinite(values).any() else 0.0


def lies_within(bone: TemplateBone, placement: TemplatePlacement, position_mm: Floats) -> bool:
    """Return whether a position (3,) LPS lies within a placed bone."""
    place = placement.template_from_image(position_mm)[None]
    return bool(read_at(bone.distance_mm, bone.grid, place, outside=-1.0)[0] > 0)

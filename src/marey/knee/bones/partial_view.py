"""Which long bones an image shows that does not show a femur above a tibia, by how a template's lie in it."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage
from scipy.optimize import least_squares

from marey.arrays import Floats, Integers, Mask
from marey.knee.bones.marrow import WORK_MM, Kind, Knee, candidates
from marey.knee.bones.region_growing import marrow_level
from marey.knee.bones.seeds import check_in_marrow, kind_at, seed_voxel
from marey.knee.bones.template_fit import LEAST_FIT, Placement, TemplateBone, edge_contrast, moved
from marey.knee.space.resampling import read_at
from marey.knee.space.volume import Grid

LONG_BONES = ("femur", "tibia")
LEAST_CONTRAST = 0.65
"""A bone is taken to be in view where its edges, as far as they would lie in the image, show so much contrast."""
LEAST_KNOWN = 0.15
"""So much of the template's edge lies in the image at least: of less, any rounded end fits."""
_LEAST_FILL = 0.85
_CLEARLY = 0.05
_SIZES = (0.75, 1.33)
_THICK_MM, _SPOTS = 8.0, 4
_POINTS = 400
_DEPTHS_MM = (8.0, 5.0, 3.0)
_REFINED, _LEAST_START = 5, 0.1
_WEIGHTS = np.array([7.5, 7.5, 7.5, 0.75, 0.75, 0.75, 20.0])
"""Of turns [rad], shifts [cm] and the logarithm of size beside the contrast: 0.2 rad, 20 mm and 8 % are usual, and
neighbouring points of an edge do not speak for themselves."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SeenBone:
    """A template's long bone laid where an image shows one."""

    name: str
    kind: Kind
    mirrored: bool
    placement: Placement
    seed: Integers
    """(3,) voxel k, j, i in thick marrow within it."""
    contrast: float
    """Mean over the edge that lies in the image; 1 where every point lies on a bone's edge."""
    known: float
    """Share of the template's edge that lies in the image."""
    fill: float
    """Share of its inside, as far as it lies in the image, that is like marrow."""

    @property
    def score(self) -> float:
        """Say how much speaks for it: contrast that much of an edge shows counts for more."""
        return self.contrast * self.known**0.25

    @property
    def sure(self) -> bool:
        """Tell whether it is in view, rather than something else that is as bright."""
        return self.contrast >= LEAST_CONTRAST and self.known >= LEAST_KNOWN and self.fill >= _LEAST_FILL


@dataclass(frozen=True, eq=False, kw_only=True)
class PartialView:
    """What an image shows of femur and tibia that does not show one above the other."""

    kind: Kind
    seeds: dict[str, Integers]
    """Bone to voxel (3,) k, j, i."""
    laid: dict[str, SeenBone]
    """Where the template's lie; none without a template."""


def partial_view(knee: Knee, bones: Mapping[str, TemplateBone], given_mm: Mapping[str, Floats]) -> PartialView | None:
    """Find the long bones in view by a template, or by a seed that was given.

    Args:
        knee: The prepared image.
        bones: The template's; none without one.
        given_mm: Bone to (3,) LPS.

    Returns:
        None where nothing speaks for either.

    Raises:
        SettingProblem: A given seed lies outside the image, in the air or not in marrow.
    """
    given = {bone: seed_voxel(knee, bone, given_mm[bone]) for bone in LONG_BONES if bone in given_mm}
    seen = seen_bones(knee, {bone: each for bone, each in bones.items() if not given or bone in given})
    if given:
        # Which bone it is was told: the template must only lie there.
        laid = {bone: each for bone, each in seen.items() if each.contrast >= LEAST_FIT}
    elif not (laid := in_view(seen, bones, knee.grid)):
        return None
    kind = next(iter(laid.values())).kind if laid else kind_at(knee, list(given.values()))
    check_in_marrow(knee, kind, given)
    return PartialView(kind=kind, seeds={bone: each.seed for bone, each in laid.items()} | given, laid=laid)


def seen_bones(
    knee: Knee, bones: Mapping[str, TemplateBone], *, kinds: Sequence[Kind] = ("dark", "bright")
) -> dict[str, SeenBone]:
    """Lay a template's femur and tibia, each for itself, to thick pieces of what may be marrow.

    Args:
        knee: The prepared image.
        bones: The template's.
        kinds: What marrow may be.

    Returns:
        Femur and tibia, each as it fits best, whether it is in view or not: `sure` tells.
    """
    starts: dict[str, list[_Start]] = {name: [] for name in LONG_BONES if name in bones}
    few = {name: _thinned(bones[name]) for name in starts}
    for kind in kinds if starts else ():
        for voxel in _thickest(candidates(knee, kind), knee.within):
            likeness = _likeness(knee, kind, voxel)
            for name, found in starts.items():
                found += _starts(few[name], kind, voxel, likeness, knee.grid)
    best: dict[str, SeenBone] = {}
    for name, found in starts.items():
        for start in sorted(found, key=lambda each: -each.score)[:_REFINED]:
            seen = _laid(name, few[name], start, knee.grid)
            size = abs(float(np.linalg.det(seen.placement.matrix))) ** (1 / 3)
            if _SIZES[0] < size < _SIZES[1] and (name not in best or seen.score > best[name].score):
                best[name] = seen
    return best


def in_view(seen: Mapping[str, SeenBone], bones: Mapping[str, TemplateBone], grid: Grid) -> dict[str, SeenBone]:
    """Keep the long bones that are in view.

    Args:
        seen: As they were laid.
        bones: The template's.
        grid: The image's upright one.

    Returns:
        Nothing where no bone is in view, or where the only one might as well be the other; both where both are,
        the femur above the tibia and neither in the other.
    """
    sure = {name: each for name, each in seen.items() if each.sure}
    if len(sure) < 2:
        return sure
    femur, tibia = sure["femur"], sure["tibia"]
    apart = femur.seed[0] > tibia.seed[0] and not (
        _within(tibia, bones, femur, grid) or _within(femur, bones, tibia, grid)
    )
    if apart and femur.kind == tibia.kind and femur.mirrored == tibia.mirrored:
        return sure
    if abs(femur.score - tibia.score) < _CLEARLY:
        return {}
    return {"femur": femur} if femur.score > tibia.score else {"tibia": tibia}


def _within(outer: SeenBone, bones: Mapping[str, TemplateBone], inner: SeenBone, grid: Grid) -> bool:
    """Tell whether the seed of one bone lies within another as it was laid."""
    place = outer.placement.template_from_image(grid.lps(inner.seed[::-1].astype(float)))[None]
    bone = bones[outer.name]
    return bool(read_at(bone.distance_mm, bone.grid, place, outside=-1.0)[0] > 0)


def _likeness(knee: Knee, kind: Kind, voxel: Integers) -> np.ndarray:
    likeness = marrow_level(knee, kind, voxel).likeness(knee.intensity) * knee.body
    return np.where(knee.within, likeness, np.float32(np.nan))


def _thickest(mask: Mask, within: Mask) -> list[Integers]:
    """Voxels k, j, i in the middle of the thickest pieces, which go on where the image ends."""
    radius = ndimage.distance_transform_edt(mask | ~within) * mask * WORK_MM
    peaks = np.argwhere((ndimage.maximum_filter(radius, 15) == radius) & (radius >= _THICK_MM))
    chosen: list[Integers] = []
    for voxel in peaks[np.argsort(-radius[tuple(peaks.T)])]:
        if all(np.linalg.norm(voxel - other) * WORK_MM > _THICK_MM for other in chosen):
            chosen.append(voxel)
    return chosen[:_SPOTS]


@dataclass(frozen=True, eq=False, kw_only=True)
class _Start:
    """Where a bone might lie: with one of its thick places in one of the image's."""

    score: float
    kind: Kind
    voxel: Integers
    likeness: np.ndarray
    mirrored: bool
    placement: Placement


def _starts(bone: TemplateBone, kind: Kind, voxel: Integers, likeness: np.ndarray, grid: Grid) -> Iterator[_Start]:
    """Lay a bone so that one of its thick places comes to a voxel, of either side."""
    place = grid.lps(voxel[::-1].astype(float))
    for mirrored in (False, True):
        flip = np.diag([-1.0 if mirrored else 1.0, 1, 1])
        for spot in _thickest(bone.distance_mm > 0, np.ones(bone.grid.shape, bool)):
            placement = Placement(matrix=flip, shift=place - flip @ bone.grid.lps(spot[::-1].astype(float)))
            score = _judged(bone, placement, likeness, grid, _DEPTHS_MM[0])[0]
            if score > _LEAST_START:
                yield _Start(
                    score=score, kind=kind, voxel=voxel, likeness=likeness, mirrored=mirrored, placement=placement
                )


def _laid(name: str, bone: TemplateBone, start: _Start, grid: Grid) -> SeenBone:
    placement = _refined(bone, start.placement, start.likeness, grid)
    _, contrast, known = _judged(bone, placement, start.likeness, grid, _DEPTHS_MM[-1])
    return SeenBone(
        name=name, kind=start.kind, mirrored=start.mirrored, placement=placement, seed=start.voxel, contrast=contrast,
        known=known, fill=_fill(bone, placement, start.likeness, grid),
    )  # fmt: skip


def _thinned(bone: TemplateBone) -> TemplateBone:
    every = max(1, len(bone.points_mm) // _POINTS)
    return replace(bone, points_mm=bone.points_mm[::every], normals=bone.normals[::every])


def _judged(
    bone: TemplateBone, placement: Placement, likeness: np.ndarray, grid: Grid, depth_mm: float
) -> tuple[float, float, float]:
    """Give the score, the mean contrast of an edge's part in the image, and how large that part is."""
    contrast = edge_contrast(bone, placement, likeness, grid, depth_mm)
    known = float(np.isfinite(contrast).mean())
    mean = float(np.nanmean(contrast)) if known else -1.0
    return (mean * known**0.25 if known >= LEAST_KNOWN else -1.0), mean, known


def _refined(bone: TemplateBone, start: Placement, likeness: np.ndarray, grid: Grid) -> Placement:
    """Turn, shift and scale; an edge beyond the image's end speaks neither for nor against."""
    centre = start.image_from_template(bone.points_mm.mean(axis=0))
    for depth in _DEPTHS_MM:
        about = start
        usual = max(_judged(bone, start, likeness, grid, depth)[1], 0.0)

        def residuals(change: Floats, about: Placement = about, usual: float = usual, depth: float = depth) -> Floats:
            contrast = edge_contrast(bone, moved(about, change, centre), likeness, grid, depth)
            return np.concatenate([1 - np.where(np.isnan(contrast), usual, contrast), _WEIGHTS * change])

        start = moved(start, least_squares(residuals, np.zeros(7), diff_step=1e-2, max_nfev=10).x, centre)
    return start


def _fill(bone: TemplateBone, placement: Placement, likeness: np.ndarray, grid: Grid) -> float:
    inside = np.argwhere(bone.distance_mm > 3 * WORK_MM)[::41]
    places = placement.image_from_template(bone.grid.lps(inside[:, ::-1].astype(float)))
    values = read_at((likeness > 0) * 1.0 + np.where(np.isnan(likeness), np.nan, 0), grid, places, outside=np.nan)
    return float(np.nanmean(values)) if np.isfinite(values).any() else 0.0

"""A template's bones laid roughly into an image: where each bone's edge should be, against leaks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from marey.arrays import Floats, Mask
from marey.errors import MareyError
from marey.geometry import rotations
from marey.knee.bones.marrow import WORK_MM
from marey.knee.space.distances import distance_within, signed_distance
from marey.knee.space.resampling import part_of, read_at, resampled, upright_grid
from marey.knee.space.structures import BONES
from marey.knee.space.volume import Grid, Labels

_POINTS = 1500
_JOINT_MM = 35.0
_STARTS_MM = (-15.0, 0.0, 15.0)
_AFFINE_SD = 0.08
"""How much a bone may be stretched or sheared beside the whole template: standard deviation of the matrix's terms."""
_SHIFT_SD_MM = 8.0
_SIZES = (0.6, 1.65)
"""How much larger one person's knee is than another's, child and man, at most."""
_OUTWARD_MM = (0.0, 1.0, 2.0, 3.0)
_CARRY_MM = 8.0
LEAST_FIT = 0.35
"""Less of its edges on edges of bone, and a template does not fit."""


class TemplateProblem(MareyError):
    """A template cannot be used for an image."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TemplateBone:
    """A bone of a template."""

    points_mm: Floats
    """(N, 3) LPS on its surface, none where the template's image ends."""
    normals: Floats
    """(N, 3) outward."""
    distance_mm: np.ndarray
    """(k, j, i) signed distance, positive inside, on `grid`."""
    grid: Grid


@dataclass(frozen=True, eq=False, kw_only=True)
class Placement:
    """Where a template's bone lies in the image: image = matrix @ template + shift [mm]."""

    matrix: Floats
    """(3, 3); its determinant is negative when the template was mirrored."""
    shift: Floats
    """(3,)."""

    def image_from_template(self, points_mm: Floats) -> Floats:
        """Carry points (..., 3)."""
        return points_mm @ self.matrix.T + self.shift

    def template_from_image(self, points_mm: Floats) -> Floats:
        """Carry points (..., 3) back."""
        return (points_mm - self.shift) @ np.linalg.inv(self.matrix).T

    def turned(self, normals: Floats) -> Floats:
        """Carry outward normals (N, 3)."""
        carried = normals @ np.linalg.inv(self.matrix)
        return carried / np.linalg.norm(carried, axis=1, keepdims=True)


@dataclass(frozen=True, eq=False, kw_only=True)
class TemplateFit:
    """A template laid into an image."""

    placements: Mapping[str, Placement]
    mirrored: bool
    fit: float
    """Mean contrast across the template's edges, 0 by chance, 1 where every point lies on a bone's edge."""


def template_bones(template: Labels) -> dict[str, TemplateBone]:
    """Take the bones from a template's labels, with points on their surfaces.

    Raises:
        TemplateProblem: It has no femur or no tibia.
    """
    grid = upright_grid(template.grid, WORK_MM)
    bones = {}
    for name in BONES:
        mask = template.mask(name)
        if mask.any():
            bones[name] = _template_bone(name, mask, template.grid, grid)
    missing = [name for name in ("femur", "tibia") if name not in bones]
    if missing:
        raise TemplateProblem(f"The template has no {' and no '.join(missing)}: it cannot be laid into the image.")
    return bones


def _template_bone(name: str, mask: Mask, source: Grid, grid: Grid) -> TemplateBone:
    whole = resampled(mask.astype(np.float32), source, grid) > 0.5
    # A shaft ends where the template's labels end, wherever its image does: beyond, nothing is known.
    heights = np.flatnonzero(whole.any(axis=(1, 2)))
    low = int(heights[0]) if name == "tibia" else 0
    high = int(heights[-1]) + 1 if name == "femur" else len(whole)
    whole, grid = whole[low:high], part_of(grid, (slice(low, high), slice(None), slice(None)))
    distance = signed_distance(whole, grid.array_spacing_mm)
    smooth = ndimage.gaussian_filter(distance, 1.5)
    edge = np.argwhere(whole & (distance < 1.2 * WORK_MM))
    inner = resampled(np.ones(mask.shape, dtype=np.float32), source, grid)
    reach = distance_within(np.pad(inner > 0.99, 1))[1:-1, 1:-1, 1:-1] * WORK_MM
    edge = edge[reach[tuple(edge.T)] > 3]
    chosen = edge[np.linspace(0, len(edge) - 1, min(_POINTS, len(edge))).astype(int)]
    inward = np.stack(np.gradient(smooth), axis=-1)[tuple(chosen.T)][:, ::-1]
    normals = -inward / np.maximum(np.linalg.norm(inward, axis=1, keepdims=True), 1e-6)
    points = grid.lps(chosen[:, ::-1].astype(float))
    return TemplateBone(
        points_mm=points + normals * distance[tuple(chosen.T)][:, None],
        normals=normals,
        distance_mm=distance,
        grid=grid,
    )


def check_fit(value: float) -> None:
    """Make sure that enough of a template's edges, 0 to 1, lie on edges of bone.

    Raises:
        TemplateProblem: The template fits nowhere.
    """
    if value < LEAST_FIT:
        raise TemplateProblem(
            f"The template does not fit this image: only {100 * max(value, 0):.0f} % of its edges lie on edges of bone."
            " Give a template of a knee, femur and tibia alike in both, or leave --template out."
        )


def check_size(placements: Sequence[Placement]) -> None:
    """Make sure that a template was not stretched from a doll's knee, or a giant's.

    Args:
        placements: Of its long bones; a patella's own is too uncertain.

    Raises:
        TemplateProblem: It was.
    """
    size = float(np.mean([abs(np.linalg.det(each.matrix)) ** (1 / 3) for each in placements]))
    if not _SIZES[0] < size < _SIZES[1]:
        raise TemplateProblem(
            f"The template would have to be made {size:.2f} times as large to lie in this image. Is the size of its"
            " voxels in labels.nii.gz right?"
        )


def place_template(
    bones: Mapping[str, TemplateBone], grown: Mapping[str, Mask], likeness: Mapping[str, np.ndarray], grid: Grid
) -> TemplateFit:
    """Lay a template into an image so that its bones' edges are where what is like marrow ends.

    As a whole first, turned, shifted and scaled, as it is and mirrored, whichever fits better; then each bone
    for itself, stretched a little.

    Args:
        bones: The template's.
        grown: (k, j, i) femur and tibia as grown from their seeds, for the start; leaks do not matter much.
        likeness: Of each bone: (k, j, i) how like its marrow each voxel is, 0 to 1; NaN outside the image.
        grid: The upright grid of both.

    Raises:
        TemplateProblem: The template fits nowhere.
    """
    wanted = joint_centre({name: positions_of(grown[name], grid) for name in ("femur", "tibia")})
    fits = [_placed_whole(bones, likeness, grid, wanted, mirrored=mirrored) for mirrored in (False, True)]
    best = max(fits, key=lambda each: each.fit)
    placements = {name: _placed_bone(bone, best.placements[name], likeness[name], grid) for name, bone in bones.items()}
    both = [name for name in grown if name in bones]
    value = float(
        np.mean([_contrast(bones[name], placements[name], likeness[name], grid, 2.0).mean() for name in both])
    )
    check_fit(value)
    check_size([placements[name] for name in both if name in ("femur", "tibia")])
    return replace(best, placements=placements, fit=value)


def place_alone(
    name: str, bones: Mapping[str, TemplateBone], start: TemplateFit, likeness: Mapping[str, np.ndarray], grid: Grid
) -> TemplateFit:
    """Lay a template of which one long bone only is in view, from where that one lies about.

    Args:
        name: The long bone in view.
        bones: The template's.
        start: Where each bone of `likeness` lies about.
        likeness: Of each bone that is or may be in view, as for `place_template`.
        grid: Its own.

    Raises:
        TemplateProblem: The template fits nowhere.
    """
    placements = {}
    for bone, values in likeness.items():
        # What lies beyond the image's end must not draw a bone into it, as it would if it counted as no edge.
        usual = known_contrast(bones[bone], start.placements[bone], values, grid, 5.0)
        placements[bone] = _placed_bone(bones[bone], start.placements[bone], values, grid, beyond=max(usual, 0.0))
    value = known_contrast(bones[name], placements[name], likeness[name], grid, 2.0)
    check_fit(value)
    return replace(start, placements=placements, fit=value)


def template_distance(bone: TemplateBone, placement: Placement, likeness: np.ndarray, grid: Grid) -> np.ndarray:
    """(k, j, i) signed distance [mm] to a bone's edge by the template, drawn to the image's edges nearby.

    The template's surface is moved along its normals by as much as the image's edges ask for, evenly over
    neighbouring points, a few times. NaN above and below the template's own image: it says nothing there.
    """
    indices = np.stack(np.meshgrid(*[np.arange(n) for n in grid.shape], indexing="ij"), axis=-1)
    positions = grid.lps(indices[..., ::-1].astype(np.float64))
    field = _placed_distance(bone, placement, positions)
    points, normals = placement.image_from_template(bone.points_mm), placement.turned(bone.normals)
    offsets = _drawn_offsets(points, normals, likeness, grid)
    band = np.abs(np.nan_to_num(field, nan=100.0)) < 15
    away, near = cKDTree(points).query(positions[band], k=6)
    share = 1 / (away + 0.5)
    field[band] += (share * offsets[near]).sum(axis=1) / share.sum(axis=1)
    return field.astype(np.float32)


def shaft_distance(bone: TemplateBone, placement: Placement, grid: Grid) -> np.ndarray:
    """(k, j, i) signed distance [mm] to a bone's edge as the template was laid; its shaft goes on beyond its end."""
    indices = np.stack(np.meshgrid(*[np.arange(n) for n in grid.shape], indexing="ij"), axis=-1)
    return _placed_distance(bone, placement, grid.lps(indices[..., ::-1].astype(np.float64)), onward=True)


def _placed_distance(bone: TemplateBone, placement: Placement, positions: Floats, *, onward: bool = False) -> Floats:
    """(k, j, i) the placed template's signed distance; beside its image a little more than at the image's side."""
    voxels = bone.grid.voxels(placement.template_from_image(positions))
    ends = np.array(bone.grid.shape[::-1]) - 1.0
    within = np.clip(voxels, 0, ends)
    scale = abs(float(np.linalg.det(placement.matrix))) ** (1 / 3)
    beside = np.linalg.norm((voxels - within)[..., :2], axis=-1) * WORK_MM
    field = (read_at(bone.distance_mm, bone.grid, bone.grid.lps(within)) - beside) * scale
    if not onward:
        field[(voxels[..., 2] < 0) | (voxels[..., 2] > ends[2])] = np.nan
    return field


def _drawn_offsets(points: Floats, normals: Floats, likeness: np.ndarray, grid: Grid) -> Floats:
    """(N,) [mm] how far along its normal the image draws each point of a surface."""
    offsets = np.zeros(len(points))
    away, near = cKDTree(points).query(points, k=24)
    weight = np.exp(-0.5 * (away / (_CARRY_MM / 2)) ** 2)
    for _ in range(8):
        asked, clear = _asked_offsets(points + offsets[:, None] * normals, normals, likeness, grid)
        shares = weight * clear[near]
        total = shares.sum(axis=1)
        drawn = (shares * (offsets + 0.7 * asked)[near]).sum(axis=1) / np.maximum(total, 1e-6)
        offsets = np.where(total > 0.2, drawn, offsets)
    return offsets


def positions_of(mask: Mask, grid: Grid) -> Floats:
    """(N, 3) LPS of a mask's voxels."""
    return grid.lps(np.argwhere(mask)[:, ::-1].astype(float))


def joint_centre(positions: Mapping[str, Floats]) -> Floats:
    """(3,) between the femur's lower and the tibia's upper end, or at the one there is; across, by what is near."""
    ends = {"femur": 2, "tibia": 98}
    height = float(np.mean([np.percentile(each[:, 2], ends[name]) for name, each in positions.items()]))
    near = np.concatenate([each[np.abs(each[:, 2] - height) < _JOINT_MM] for each in positions.values()])
    return np.array([*near[:, :2].mean(axis=0), height])


def edge_contrast(
    bone: TemplateBone, placement: Placement, likeness: np.ndarray, grid: Grid, depth_mm: float
) -> Floats:
    """(N,) likeness a little inside a point less the least at and just outside it; NaN beyond the image."""
    points, normals = placement.image_from_template(bone.points_mm), placement.turned(bone.normals)
    inside = read_at(likeness, grid, points - depth_mm * normals, outside=np.nan)
    reach = np.array(_OUTWARD_MM) * depth_mm / 2
    outside = np.min([read_at(likeness, grid, points + step * normals, outside=np.nan) for step in reach], axis=0)
    return np.asarray(inside - outside)


def known_contrast(
    bone: TemplateBone, placement: Placement, likeness: np.ndarray, grid: Grid, depth_mm: float
) -> float:
    """Give the mean contrast over what of an edge lies in the image; 0 where nothing does."""
    contrast = edge_contrast(bone, placement, likeness, grid, depth_mm)
    return float(np.nanmean(contrast)) if np.isfinite(contrast).any() else 0.0


def _contrast(
    bone: TemplateBone, placement: Placement, likeness: np.ndarray, grid: Grid, depth_mm: float, beyond: float = 0.0
) -> Floats:
    """(N,) the same, with what stands for it beyond the image."""
    return np.nan_to_num(edge_contrast(bone, placement, likeness, grid, depth_mm), nan=beyond)


def moved(placement: Placement, change: Floats, centre: Floats) -> Placement:
    """Turn, shift and scale a placement about a point (3,) of the image, by (7,): rad, cm, logarithm of size."""
    matrix = np.exp(change[6]) * rotations.exp(change[:3])
    return Placement(
        matrix=matrix @ placement.matrix, shift=matrix @ (placement.shift - centre) + centre + 10 * change[3:6]
    )


def _placed_whole(
    bones: Mapping[str, TemplateBone], likeness: Mapping[str, np.ndarray], grid: Grid, wanted: Floats, *, mirrored: bool
) -> TemplateFit:
    flip = np.diag([-1.0 if mirrored else 1.0, 1, 1])
    own = flip @ joint_centre({name: bones[name].points_mm for name in ("femur", "tibia")})
    pair = ("femur", "tibia")
    best: tuple[float, Placement] | None = None
    for up in _STARTS_MM:
        placement = Placement(matrix=flip, shift=wanted - own + np.array([0, 0, up]))
        for depth in (8.0, 5.0, 3.0):
            start = placement

            def residuals(change: Floats, start: Placement = start, depth: float = depth) -> Floats:
                laid = moved(start, change, wanted)
                parts = [1 - _contrast(bones[name], laid, likeness[name], grid, depth) for name in pair]
                return np.concatenate([*parts, change * 5])

            placement = moved(start, least_squares(residuals, np.zeros(7), diff_step=1e-2, max_nfev=12).x, wanted)
        value = float(np.mean([_contrast(bones[name], placement, likeness[name], grid, 3.0).mean() for name in pair]))
        if best is None or value > best[0]:
            best = value, placement
    assert best is not None
    return TemplateFit(placements=dict.fromkeys(bones, best[1]), mirrored=mirrored, fit=best[0])


def _placed_bone(
    bone: TemplateBone, start: Placement, likeness: np.ndarray, grid: Grid, beyond: float = 0.0
) -> Placement:
    """Let a bone turn, shift and stretch for itself."""
    centre = start.image_from_template(bone.points_mm.mean(axis=0))
    size = float(np.sqrt(np.mean((bone.points_mm - bone.points_mm.mean(axis=0)) ** 2)))

    def stretched(change: Floats) -> Placement:
        matrix = np.eye(3) + _AFFINE_SD * change[3:].reshape(3, 3)
        shift = matrix @ (start.shift - centre) + centre + _SHIFT_SD_MM * change[:3]
        return Placement(matrix=matrix @ start.matrix, shift=shift)

    change = np.zeros(12)
    for depth in (5.0, 3.0, 2.0):
        change = least_squares(
            lambda values, depth=depth: np.concatenate(
                [1 - _contrast(bone, stretched(values), likeness, grid, depth, beyond), 2 * values]
            ),
            change,
            diff_step=2e-2 * min(1.0, 30 / size),
            max_nfev=15,
        ).x
    return stretched(change)


def _asked_offsets(points: Floats, normals: Floats, likeness: np.ndarray, grid: Grid) -> tuple[Floats, Floats]:
    """(N,), (N,) how far along its normal each point should go to an edge of likeness, and how clear the edge is."""
    steps = np.arange(-8.0, 8.1, 1.0)
    profile = read_at(likeness, grid, points[:, None] + steps[:, None] * normals[:, None], outside=np.nan)
    # An edge at step s: like marrow before it, unlike at it or just after it.
    before = (profile[:, 0:-5] + profile[:, 1:-4] + profile[:, 2:-3]) / 3
    after = np.fmin(profile[:, 3:-2], np.fmin(profile[:, 4:-1], profile[:, 5:]))
    places = steps[3:-2] - 0.5
    score = np.nan_to_num(before - after, nan=-1.0) * np.exp(-0.5 * (places / 5.0) ** 2)
    best = score.argmax(axis=1)
    clear = np.clip(score[np.arange(len(points)), best], 0, 1)
    return places[best], clear

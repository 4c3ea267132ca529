"""Approximate fit of a template's bones to an image, which limits how far each bone may reach."""

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
from marey.knee.space.volume import Labels, VoxelGrid


@dataclass(frozen=True, kw_only=True)
class TemplateFitSettings:
    """Settings for fitting a template's bones to an image.

    Values without a stated source were chosen by hand.
    """

    points: int = 1500
    """Largest number of points on the surface of each bone."""
    joint_mm: float = 35.0
    """Half the height [mm] of the slab about the joint line from which the joint's centre is averaged."""
    starts_mm: tuple[float, ...] = (-15.0, 0.0, 15.0)
    """Heights [mm] from which the whole template is fitted."""
    affine_sd: float = 0.08
    """Standard deviation of the terms of the matrix by which a bone is stretched or sheared relative to the whole
    template."""
    shift_sd_mm: float = 8.0
    """Standard deviation [mm] of a bone's shift relative to the whole template."""
    sizes: tuple[float, float] = (0.6, 1.65)
    """Least and largest size of a knee relative to another's, child and adult."""
    outward_mm: tuple[float, ...] = (0.0, 1.0, 2.0, 3.0)
    """Distances [mm] outside the edge at which the outside is sampled, for a depth of 2 mm."""
    carry_mm: float = 8.0
    """Twice the standard deviation [mm] of the Gaussian over which offsets are averaged along a surface."""
    least_fit: float = 0.35
    """Least mean contrast across the template's edges; a template with less does not fit."""


TEMPLATE_FIT_DEFAULTS = TemplateFitSettings()
"""Default settings for fitting a template's bones to an image."""


class TemplateProblem(MareyError):
    """A template cannot be used for an image."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TemplateBone:
    """A bone of a template."""

    points_mm: Floats
    """(N, 3) LPS on its surface, except where the template's image ends."""
    normals: Floats
    """(N, 3) outward."""
    distance_mm: np.ndarray
    """(k, j, i) signed distance, positive inside, on `grid`."""
    grid: VoxelGrid


@dataclass(frozen=True, eq=False, kw_only=True)
class TemplatePlacement:
    """Affine map from a template's bone to the image: image = matrix @ template + shift [mm]."""

    matrix: Floats
    """(3, 3); its determinant is negative if the template is mirrored."""
    shift: Floats
    """(3,)."""

    def image_from_template(self, points_mm: Floats) -> Floats:
        """Map points (..., 3) of the template to the image."""
        return points_mm @ self.matrix.T + self.shift

    def template_from_image(self, points_mm: Floats) -> Floats:
        """Map points (..., 3) of the image to the template."""
        return (points_mm - self.shift) @ np.linalg.inv(self.matrix).T

    def image_normals(self, normals: Floats) -> Floats:
        """Map outward normals (N, 3) of the template to the image."""
        mapped = normals @ np.linalg.inv(self.matrix)
        return np.asarray(mapped / np.linalg.norm(mapped, axis=1, keepdims=True))


@dataclass(frozen=True, eq=False, kw_only=True)
class TemplateFit:
    """A template fitted to an image."""

    placements: Mapping[str, TemplatePlacement]
    mirrored: bool
    fit: float
    """Mean contrast across the template's edges, 0 by chance, 1 where every point lies on a bone's edge."""


def template_bones(
    template: Labels, *, settings: TemplateFitSettings = TEMPLATE_FIT_DEFAULTS
) -> dict[str, TemplateBone]:
    """Extract the bones of a template from its labels, with points on their surfaces.

    Raises:
        TemplateProblem: It has no femur or no tibia.
    """
    grid = upright_grid(template.grid, WORK_MM)
    bones = {}
    for name in BONES:
        mask = template.mask(name)
        if mask.any():
            bones[name] = _template_bone(name, mask, template.grid, grid, settings=settings)
    missing = [name for name in ("femur", "tibia") if name not in bones]
    if missing:
        raise TemplateProblem(f"The template has no {' and no '.join(missing)}: it cannot be fitted to the image.")
    return bones


def _template_bone(
    name: str, mask: Mask, source: VoxelGrid, grid: VoxelGrid, *, settings: TemplateFitSettings
) -> TemplateBone:
    whole = resampled(mask.astype(np.float32), source, grid) > 0.5
    # A shaft is known up to where the template's labels end, even if its image continues.
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
    chosen = edge[np.linspace(0, len(edge) - 1, min(settings.points, len(edge))).astype(int)]
    inward = np.stack(np.gradient(smooth), axis=-1)[tuple(chosen.T)][:, ::-1]
    normals = -inward / np.maximum(np.linalg.norm(inward, axis=1, keepdims=True), 1e-6)
    points = grid.lps(chosen[:, ::-1].astype(float))
    return TemplateBone(
        points_mm=points + normals * distance[tuple(chosen.T)][:, None],
        normals=normals,
        distance_mm=distance,
        grid=grid,
    )


def check_fit(value: float, *, settings: TemplateFitSettings = TEMPLATE_FIT_DEFAULTS) -> None:
    """Check that a large enough share of a template's edges, 0 to 1, lies on edges of bone.

    Raises:
        TemplateProblem: The template fits nowhere.
    """
    if value < settings.least_fit:
        raise TemplateProblem(
            f"The template does not fit this image: only {100 * max(value, 0):.0f} % of its edges lie on edges of bone."
            " Give another template of a knee, with femur and tibia in a similar view, or leave out the template"
            " (--template)."
        )


def check_size(
    placements: Sequence[TemplatePlacement], *, settings: TemplateFitSettings = TEMPLATE_FIT_DEFAULTS
) -> None:
    """Check that a template was not scaled by more than knees differ.

    Args:
        placements: Of its long bones; that of a patella is too uncertain.
        settings: Tuned constants of the algorithm.

    Raises:
        TemplateProblem: It was scaled by more.
    """
    sizes = [float(abs(np.linalg.det(each.matrix))) ** (1 / 3) for each in placements]
    size = sum(sizes) / len(sizes)
    if not settings.sizes[0] < size < settings.sizes[1]:
        raise TemplateProblem(
            f"The template would have to be scaled by {size:.2f} to fit this image. Check the size of its voxels in"
            " labels.nii.gz."
        )


def place_template(
    bones: Mapping[str, TemplateBone],
    grown: Mapping[str, Mask],
    likeness: Mapping[str, np.ndarray],
    grid: VoxelGrid,
    *,
    settings: TemplateFitSettings = TEMPLATE_FIT_DEFAULTS,
) -> TemplateFit:
    """Fit a template to an image so that its bones' edges lie where marrow ends.

    First the whole template is rotated, shifted and scaled, as it is and mirrored, and the better fit is kept; then
    each bone is fitted separately, with a small affine deformation.

    Args:
        bones: Bones of the template.
        grown: (k, j, i) femur and tibia as grown from their seeds, for the start; leaks have little influence.
        likeness: For each bone (k, j, i) similarity to its marrow, 0 to 1; NaN outside the image.
        grid: The upright grid of both.
        settings: Tuned constants of the algorithm.

    Raises:
        TemplateProblem: The template fits nowhere.
    """
    wanted = joint_centre({name: positions_of(grown[name], grid) for name in ("femur", "tibia")}, settings=settings)
    fits = [
        _placed_whole(bones, likeness, grid, wanted, mirrored=mirrored, settings=settings) for mirrored in (False, True)
    ]
    best = max(fits, key=lambda each: each.fit)
    placements = {
        name: _placed_bone(bone, best.placements[name], likeness[name], grid, settings=settings)
        for name, bone in bones.items()
    }
    both = [name for name in grown if name in bones]
    contrasts = [
        _contrast(bones[name], placements[name], likeness[name], grid, 2.0, settings=settings).mean() for name in both
    ]
    value = float(sum(contrasts) / len(contrasts))
    check_fit(value, settings=settings)
    check_size([placements[name] for name in both if name in ("femur", "tibia")], settings=settings)
    return replace(best, placements=placements, fit=value)


def place_alone(
    name: str,
    bones: Mapping[str, TemplateBone],
    start: TemplateFit,
    likeness: Mapping[str, np.ndarray],
    grid: VoxelGrid,
    *,
    settings: TemplateFitSettings = TEMPLATE_FIT_DEFAULTS,
) -> TemplateFit:
    """Fit a template to an image that shows only one long bone, from that bone's approximate placement.

    Args:
        name: The long bone in view.
        bones: Bones of the template.
        start: Approximate placement of each bone of `likeness`.
        likeness: For each bone that is or may be in view, as for `place_template`.
        grid: Of the likeness.
        settings: Tuned constants of the algorithm.

    Raises:
        TemplateProblem: The template fits nowhere.
    """
    placements = {}
    for bone, values in likeness.items():
        # An edge outside the image counts as an average one; as no edge it would pull the bone into the image.
        usual = known_contrast(bones[bone], start.placements[bone], values, grid, 5.0, settings=settings)
        placements[bone] = _placed_bone(
            bones[bone], start.placements[bone], values, grid, beyond=max(usual, 0.0), settings=settings
        )
    value = known_contrast(bones[name], placements[name], likeness[name], grid, 2.0, settings=settings)
    check_fit(value, settings=settings)
    return replace(start, placements=placements, fit=value)


def template_distance(
    bone: TemplateBone,
    placement: TemplatePlacement,
    likeness: np.ndarray,
    grid: VoxelGrid,
    *,
    settings: TemplateFitSettings = TEMPLATE_FIT_DEFAULTS,
) -> np.ndarray:
    """(k, j, i) signed distance [mm] to a bone's edge by the template, moved to nearby edges of the image.

    The template's surface is moved along its normals to the edges of the image, with offsets averaged over neighbouring
    points, in eight rounds. NaN above and below the template's own image, where it is not known.
    """
    indices = np.stack(np.meshgrid(*[np.arange(n) for n in grid.shape], indexing="ij"), axis=-1)
    positions = grid.lps(indices[..., ::-1].astype(np.float64))
    field = _placed_distance(bone, placement, positions)
    points, normals = placement.image_from_template(bone.points_mm), placement.image_normals(bone.normals)
    offsets = _edge_offsets(points, normals, likeness, grid, settings=settings)
    band = np.abs(np.nan_to_num(field, nan=100.0)) < 15
    away, near = cKDTree(points).query(positions[band], k=6)
    share = 1 / (away + 0.5)
    field[band] += (share * offsets[near]).sum(axis=1) / share.sum(axis=1)
    return field.astype(np.float32)


def shaft_distance(bone: TemplateBone, placement: TemplatePlacement, grid: VoxelGrid) -> np.ndarray:
    """(k, j, i) signed distance [mm] to a bone's edge by the fitted template, whose shaft is continued."""
    indices = np.stack(np.meshgrid(*[np.arange(n) for n in grid.shape], indexing="ij"), axis=-1)
    return _placed_distance(bone, placement, grid.lps(indices[..., ::-1].astype(np.float64)), continued=True)


def _placed_distance(
    bone: TemplateBone, placement: TemplatePlacement, positions: Floats, *, continued: bool = False
) -> Floats:
    """(k, j, i) signed distance [mm] to the fitted template; beside its image extrapolated from the image's side."""
    voxels = bone.grid.voxels(placement.template_from_image(positions))
    ends = np.array(bone.grid.shape[::-1]) - 1.0
    within = np.clip(voxels, 0, ends)
    scale = abs(float(np.linalg.det(placement.matrix))) ** (1 / 3)
    beside = np.linalg.norm((voxels - within)[..., :2], axis=-1) * WORK_MM
    field = (read_at(bone.distance_mm, bone.grid, bone.grid.lps(within)) - beside) * scale
    if not continued:
        field[(voxels[..., 2] < 0) | (voxels[..., 2] > ends[2])] = np.nan
    return np.asarray(field)


def _edge_offsets(
    points: Floats, normals: Floats, likeness: np.ndarray, grid: VoxelGrid, *, settings: TemplateFitSettings
) -> Floats:
    """(N,) distance [mm] along its normal from each point of a surface to an edge of the image, averaged nearby."""
    offsets = np.zeros(len(points))
    away, near = cKDTree(points).query(points, k=24)
    weight = np.exp(-0.5 * (away / (settings.carry_mm / 2)) ** 2)
    for _ in range(8):
        found, clear = _nearest_edges(points + offsets[:, None] * normals, normals, likeness, grid)
        shares = weight * clear[near]
        total = shares.sum(axis=1)
        mean = (shares * (offsets + 0.7 * found)[near]).sum(axis=1) / np.maximum(total, 1e-6)
        offsets = np.where(total > 0.2, mean, offsets)
    return offsets


def positions_of(mask: Mask, grid: VoxelGrid) -> Floats:
    """(N, 3) LPS of a mask's voxels."""
    return grid.lps(np.argwhere(mask)[:, ::-1].astype(float))


def joint_centre(positions: Mapping[str, Floats], *, settings: TemplateFitSettings = TEMPLATE_FIT_DEFAULTS) -> Floats:
    """(3,) LPS of the joint: between the lower end of the femur and the upper end of the tibia, or at the only one."""
    ends = {"femur": 2, "tibia": 98}
    heights = [float(np.percentile(each[:, 2], ends[name])) for name, each in positions.items()]
    height = sum(heights) / len(heights)
    near = np.concatenate([each[np.abs(each[:, 2] - height) < settings.joint_mm] for each in positions.values()])
    return np.array([*near[:, :2].mean(axis=0), height])


def edge_contrast(
    bone: TemplateBone,
    placement: TemplatePlacement,
    likeness: np.ndarray,
    grid: VoxelGrid,
    depth_mm: float,
    *,
    settings: TemplateFitSettings = TEMPLATE_FIT_DEFAULTS,
) -> Floats:
    """(N,) likeness inside each point of the edge minus the least at and just outside it; NaN outside the image."""
    points, normals = placement.image_from_template(bone.points_mm), placement.image_normals(bone.normals)
    inside = read_at(likeness, grid, points - depth_mm * normals, outside=np.nan)
    reach = np.array(settings.outward_mm) * depth_mm / 2
    outside = np.min([read_at(likeness, grid, points + step * normals, outside=np.nan) for step in reach], axis=0)
    return np.asarray(inside - outside)


def known_contrast(
    bone: TemplateBone,
    placement: TemplatePlacement,
    likeness: np.ndarray,
    grid: VoxelGrid,
    depth_mm: float,
    *,
    settings: TemplateFitSettings = TEMPLATE_FIT_DEFAULTS,
) -> float:
    """Return the mean contrast over the part of an edge in the image; 0 where none of it is."""
    contrast = edge_contrast(bone, placement, likeness, grid, depth_mm, settings=settings)
    return float(np.nanmean(contrast)) if np.isfinite(contrast).any() else 0.0


def _contrast(
    bone: TemplateBone,
    placement: TemplatePlacement,
    likeness: np.ndarray,
    grid: VoxelGrid,
    depth_mm: float,
    beyond: float = 0.0,
    *,
    settings: TemplateFitSettings,
) -> Floats:
    """(N,) the same, with the value `beyond` outside the image."""
    return np.nan_to_num(edge_contrast(bone, placement, likeness, grid, depth_mm, settings=settings), nan=beyond)


def moved(placement: TemplatePlacement, change: Floats, centre: Floats) -> TemplatePlacement:
    """Rotate, shift and scale a placement about a point (3,) of the image by (7,): rad, cm, logarithm of size."""
    matrix = np.exp(change[6]) * rotations.exp(change[:3])
    return TemplatePlacement(
        matrix=matrix @ placement.matrix, shift=matrix @ (placement.shift - centre) + centre + 10 * change[3:6]
    )


def _placed_whole(
    bones: Mapping[str, TemplateBone],
    likeness: Mapping[str, np.ndarray],
    grid: VoxelGrid,
    wanted: Floats,
    *,
    mirrored: bool,
    settings: TemplateFitSettings,
) -> TemplateFit:
    flip = np.diag([-1.0 if mirrored else 1.0, 1, 1])
    own = flip @ joint_centre({name: bones[name].points_mm for name in ("femur", "tibia")}, settings=settings)
    pair = ("femur", "tibia")
    best: tuple[float, TemplatePlacement] | None = None
    for up in settings.starts_mm:
        placement = TemplatePlacement(matrix=flip, shift=wanted - own + np.array([0, 0, up]))
        for depth in (8.0, 5.0, 3.0):
            start = placement

            def residuals(change: Floats, start: TemplatePlacement = start, depth: float = depth) -> Floats:
                placed = moved(start, change, wanted)
                parts = [
                    1 - _contrast(bones[name], placed, likeness[name], grid, depth, settings=settings) for name in pair
                ]
                return np.concatenate([*parts, change * 5])

            placement = moved(start, least_squares(residuals, np.zeros(7), diff_step=1e-2, max_nfev=12).x, wanted)
        contrasts = [
            _contrast(bones[name], placement, likeness[name], grid, 3.0, settings=settings).mean() for name in pair
        ]
        value = float(sum(contrasts) / len(contrasts))
        if best is None or value > best[0]:
            best = value, placement
    assert best is not None
    return TemplateFit(placements=dict.fromkeys(bones, best[1]), mirrored=mirrored, fit=best[0])


def _placed_bone(
    bone: TemplateBone,
    start: TemplatePlacement,
    likeness: np.ndarray,
    grid: VoxelGrid,
    beyond: float = 0.0,
    *,
    settings: TemplateFitSettings,
) -> TemplatePlacement:
    """Rotate, shift and deform one bone."""
    centre = start.image_from_template(bone.points_mm.mean(axis=0))
    size = float(np.sqrt(np.mean((bone.points_mm - bone.points_mm.mean(axis=0)) ** 2)))

    def stretched(change: Floats) -> TemplatePlacement:
        matrix = np.eye(3) + settings.affine_sd * change[3:].reshape(3, 3)
        shift = matrix @ (start.shift - centre) + centre + settings.shift_sd_mm * change[:3]
        return TemplatePlacement(matrix=matrix @ start.matrix, shift=shift)

    change = np.zeros(12)
    for depth in (5.0, 3.0, 2.0):
        change = least_squares(
            lambda values, depth=depth: np.concatenate(
                [1 - _contrast(bone, stretched(values), likeness, grid, depth, beyond, settings=settings), 2 * values]
            ),
            change,
            diff_step=2e-2 * min(1.0, 30 / size),
            max_nfev=15,
        ).x
    return stretched(change)


def _nearest_edges(points: Floats, normals: Floats, likeness: np.ndarray, grid: VoxelGrid) -> tuple[Floats, Floats]:
    """Return the distance (N,) [mm] along its normal from each point to an edge of likeness, and its clarity (N,)."""
    steps = np.arange(-8.0, 8.1, 1.0)
    profile = read_at(likeness, grid, points[:, None] + steps[:, None] * normals[:, None], outside=np.nan)
    # An edge at step s: similar to marrow before it, dissimilar at it or just after it.
    before = (profile[:, 0:-5] + profile[:, 1:-4] + profile[:, 2:-3]) / 3
    after = np.fmin(profile[:, 3:-2], np.fmin(profile[:, 4:-1], profile[:, 5:]))
    places = steps[3:-2] - 0.5
    score = np.nan_to_num(before - after, nan=-1.0) * np.exp(-0.5 * (places / 5.0) ** 2)
    best = score.argmax(axis=1)
    clear = np.clip(score[np.arange(len(points)), best], 0, 1)
    return places[best], clear

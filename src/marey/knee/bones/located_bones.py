"""First two stages of the bone segmentation: prepared images, and a seed in each long bone that they show."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.errors import MareyError, SettingProblem
from marey.knee.bones.marrow import WORK_MM, Kind, PreparedImage, prepare
from marey.knee.bones.partial_view import LONG_BONES, SeenBone, in_view, partial_view, seen_bones
from marey.knee.bones.region_growing import grow, thin_share
from marey.knee.bones.seeds import (
    NoPairFound,
    find_seeds,
    kind_of,
    marrow_likenesses,
    marrow_of,
    seed_ball,
    seed_voxel,
)
from marey.knee.bones.settings import BONE_DEFAULTS, BoneSettings
from marey.knee.bones.template_fit import TemplateBone
from marey.knee.space.resampling import read_at, upright_grid
from marey.knee.space.volume import Volume, VoxelGrid

_REMEDIES = {
    False: "If it shows only one of the two, give a template (--template), or a seed in that bone (--seed).",
    True: "Neither the template's femur nor its tibia alone fits anywhere in it.",
}
"""What a user can do when no femur above a tibia is found, by whether a template was given."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PreparedImages:
    """First stage: the images on one upright grid, and what was given with them."""

    volumes: tuple[Volume, ...]
    """One or two images of the same knee."""
    knees: tuple[PreparedImage, ...]
    """The same images, prepared, all on the grid of the first."""
    template: Mapping[str, TemplateBone] = field(default_factory=dict)
    """Bones of the template by name; empty without a template."""
    seeds_mm: Mapping[str, Floats] = field(default_factory=dict)
    """Bone to (3,) LPS: the seeds given by the user."""
    settings: BoneSettings = BONE_DEFAULTS

    @property
    def grid(self) -> VoxelGrid:
        """The upright grid of all prepared images."""
        return self.knees[0].grid


@dataclass(frozen=True, eq=False, kw_only=True)
class LocatedBones:
    """Second stage: the kind of marrow, and the long bones that are in view, with a seed in each."""

    images: PreparedImages
    kinds: tuple[Kind, ...]
    """Whether marrow is dark or bright, for each image."""
    seeds: Mapping[str, Integers]
    """Long bone to voxel (3,) k, j, i; one entry when only one long bone is in view."""
    seen: Mapping[str, SeenBone]
    """Where the template's long bones lie approximately, when not both are in view; else empty."""
    likenesses: Mapping[str, np.ndarray]
    """Long bone to (k, j, i) similarity to the marrow about its seed, 0 to 1; NaN outside one of the images."""
    single: Mask | None = None
    """(k, j, i) the only long bone in view, when it was already grown to find that out."""
    limits: tuple[str, ...] = ()
    """What contradicts the given seeds, as sentences."""

    def lps(self, name: str) -> str:
        """Return the position [mm] of a bone's seed as text."""
        position = self.images.grid.lps(self.seeds[name][::-1].astype(float))
        return " ".join(f"{each:.0f}" for each in position)


def prepare_images(
    volumes: tuple[Volume, ...],
    template: Mapping[str, TemplateBone],
    seeds_mm: Mapping[str, Floats],
    settings: BoneSettings,
) -> PreparedImages:
    """Correct the bias of the images, and resample them to one upright grid.

    Args:
        volumes: One image, or two of the same knee in the same place.
        template: Bones of the template by name.
        seeds_mm: Bone to (3,) LPS.
        settings: Of all stages.

    Raises:
        SettingProblem: There are more than two volumes, or none.
        MareyError: Two volumes do not show one knee in one place.
    """
    if not 1 <= len(volumes) <= 2:
        raise SettingProblem(f"Expected one volume, or two of the same knee, not {len(volumes)}.")
    grid = upright_grid(volumes[0].grid, WORK_MM)
    knees = tuple(prepare(volume, grid, settings=settings.marrow) for volume in volumes)
    first = knees[0]
    for knee in knees[1:]:
        shared = (knee.body & first.body).sum() / max(1, min(knee.body.sum(), first.body.sum()))
        if shared < settings.least_shared_body:
            raise MareyError("The two volumes do not show the same knee in the same position: they overlap too little.")
    return PreparedImages(volumes=volumes, knees=knees, template=template, seeds_mm=seeds_mm, settings=settings)


def locate_bones(images: PreparedImages) -> LocatedBones:
    """Find a seed in each long bone in view, and whether both seeds lie in one bone.

    Raises:
        SettingProblem: A given seed lies outside the image, in the air, not in marrow, or in the wrong bone.
        MareyError: No knee is found, or the only long bone cannot be named.
    """
    located = _located_in_images(images)
    if len(located.seeds) == 1:
        return located
    single = _bone_of_both_seeds(located)
    if single is not None and not images.template:
        located, single = _without_leak(located, single)
    if single is not None:
        settings, growing = images.settings.partial_view, images.settings.growing
        view = seen_bones(images.knees[0], images.template, kinds=located.kinds[:1], settings=settings, growing=growing)
        seen = {**located.seen, **in_view(view, images.template, images.grid, settings=settings)}
        if len(seen) < 2:
            return _single_bone(located, seen, single)
        name = _only_one_inside(located, single, {name: each.seed for name, each in seen.items()})
        if name is not None:
            _require_given_name(located, name)
        moved = {name: each.seed for name, each in seen.items() if name not in images.seeds_mm}
        likenesses = marrow_likenesses(images.knees, located.kinds, moved, settings=growing)
        located = replace(
            located,
            seeds={**located.seeds, **moved},
            seen=seen,
            likenesses={**located.likenesses, **likenesses},
        )
    if located.seeds["femur"][0] <= located.seeds["tibia"][0] and {"femur", "tibia"} & set(images.seeds_mm):
        given = " and of the ".join(name for name in LONG_BONES if name in images.seeds_mm)
        raise SettingProblem(
            f"With the seed of the {given} the femur would lie below the tibia: check that each seed is in its bone."
        )
    return located


def _located_in_images(images: PreparedImages) -> LocatedBones:
    """Find the seeds from a femur above a tibia, or else from what a template or a seed shows of either."""
    first = images.knees[0]
    settings = images.settings
    seen: Mapping[str, SeenBone] = {}
    seeds: Mapping[str, Integers]
    given = {name: seed_voxel(first, name, place) for name, place in images.seeds_mm.items()}
    try:
        found = find_seeds(first, given, settings=settings.seeds, marrow=settings.marrow)
        kind, seeds = found.kind, {"femur": found.femur, "tibia": found.tibia}
    except NoPairFound as problem:
        view = partial_view(
            first, images.template, given, settings=settings.partial_view, seeds=settings.seeds,
            growing=settings.growing,
        )  # fmt: skip
        if view is None:
            raise NoPairFound(f"{problem} {_REMEDIES[bool(images.template)]}") from problem
        kind, seeds, seen = view.kind, view.seeds, view.seen
    voxels = list(seeds.values())
    further = [kind_of(knee, voxels, settings=settings.seeds, marrow=settings.marrow) for knee in images.knees[1:]]
    kinds = (kind, *further)
    likenesses = marrow_likenesses(images.knees, kinds, seeds, settings=settings.growing)
    return LocatedBones(images=images, kinds=kinds, seeds=seeds, seen=seen, likenesses=likenesses)


def _bone_of_both_seeds(located: LocatedBones) -> Mask | None:
    """(k, j, i) the bone in which both seeds lie; None if they lie in two bones."""
    first, second = located.seeds["femur"], located.seeds["tibia"]
    likeness = located.likenesses["femur"]
    if not in_line(likeness, located.images.grid, first, second, settings=located.images.settings):
        return None
    whole = grow(likeness, first, settings=located.images.settings.growing)
    radius = located.images.settings.seeds.checked_radius_mm
    return whole if whole[seed_ball(located.images.knees[0], second, radius)].mean() > 0.5 else None


def _without_leak(located: LocatedBones, single: Mask) -> tuple[LocatedBones, Mask | None]:
    """Narrow the band of marrow where the bone of both seeds has leaked, until the seeds lie in two bones.

    Args:
        located: With both seeds.
        single: (k, j, i) the bone in which both lie.

    Returns:
        With a narrower band that separates the seeds, the located bones with its likenesses, and None. Otherwise, and
        without a leak, both arguments.
    """
    images, settings = located.images, located.images.settings
    if thin_share(single, settings=settings.growing) <= settings.largest_thin_share:
        return located, single
    for deviations in settings.growing.narrower_deviations:
        growing = replace(settings.growing, deviations=deviations)
        likenesses = marrow_likenesses(images.knees, located.kinds, located.seeds, settings=growing)
        narrower = replace(located, likenesses=likenesses)
        if _bone_of_both_seeds(narrower) is None:
            return narrower, None
    return located, single


def _single_bone(located: LocatedBones, seen: Mapping[str, SeenBone], whole: Mask) -> LocatedBones:
    """Name the bone in which both seeds lie by the template, or else by its shape."""
    name = next(iter(seen), None) or thick_end(whole, settings=located.images.settings)
    _require_given_name(located, name)
    if name is None:
        template = "" if located.images.template else "a template (--template), or "
        raise MareyError(
            "Only one long bone is found, and its shape does not show whether it is a femur or a tibia. Give"
            f" {template}a seed in the bone (--seed)."
        )
    return replace(
        located,
        seeds={name: located.seeds[name]},
        seen=seen,
        likenesses={name: located.likenesses[name]},
        single=whole,
        limits=() if seen else _contradictions(located, name, whole),
    )


def _require_given_name(located: LocatedBones, name: str | None) -> None:
    """Require that the bone in which both seeds lie is that of the given seed.

    Args:
        located: With both seeds, of which the user may have given one.
        name: The bone's name; None if it is not known.

    Raises:
        SettingProblem: It is another bone, or its name is not known.
    """
    for given, other in (("femur", "tibia"), ("tibia", "femur")):
        if given in located.images.seeds_mm and name != given:
            seems = f"it seems to be the {name}" if name else "its shape does not show whether it is femur or tibia"
            raise SettingProblem(
                f"The seed of the {given} at LPS {located.lps(given)} mm and that of the {other} at"
                f" {located.lps(other)} lie in one bone: {seems}. Choose a point within the {given}."
            )


def _contradictions(located: LocatedBones, name: str, whole: Mask) -> tuple[str, ...]:
    """Return what contradicts the name of a given seed: that a second long bone lies where it should not.

    The shape of a bone that is cut by the image does not show its name, but another one above or below it does.
    """
    images = located.images
    if name not in images.seeds_mm:
        return ()
    try:
        pair = marrow_of(images.knees[0], settings=images.settings.marrow)
    except NoPairFound:
        return ()
    found = _only_one_inside(located, whole, {"femur": pair.femur.voxel, "tibia": pair.tibia.voxel})
    if found in (None, name):
        return ()
    side = "above" if name == "femur" else "below"
    return (
        f"The seed of the {name} at LPS {located.lps(name)} mm seems to lie in the {found}: another thick bone lies"
        f" {side} it. Check the seed.",
    )


def _only_one_inside(located: LocatedBones, whole: Mask, seeds: Mapping[str, Integers]) -> str | None:
    """Return which of two seeds lies in a bone (k, j, i); None if neither or both do."""
    knee, radius = located.images.knees[0], located.images.settings.seeds.checked_radius_mm
    inside = [name for name, seed in seeds.items() if whole[seed_ball(knee, seed, radius)].mean() > 0.5]
    return inside[0] if len(inside) == 1 else None


def in_line(
    likeness: np.ndarray, grid: VoxelGrid, first: Integers, second: Integers, *, settings: BoneSettings = BONE_DEFAULTS
) -> bool:
    """Return whether marrow continues from one seed to another without a gap as wide as a joint.

    Args:
        likeness: (k, j, i) similarity to the marrow, 0 to 1.
        grid: Of the likeness.
        first: (3,) voxel k, j, i.
        second: (3,) voxel k, j, i.
        settings: Radius of the discs and width of the gap.
    """
    ends = grid.lps(np.stack([first, second])[:, ::-1].astype(float))
    length = float(np.linalg.norm(ends[1] - ends[0]))
    if length < settings.gap_mm:
        return True
    along = ends[0] + np.linspace(0, 1, 1 + int(np.ceil(length / WORK_MM)))[:, None] * (ends[1] - ends[0])
    places = along[:, None] + _disc((ends[1] - ends[0]) / length, settings.disc_mm)
    poor = read_at((likeness > 0).astype(np.float32), grid, places).mean(axis=1) < 0.5
    width = 1 + int(settings.gap_mm / WORK_MM)
    return not (np.convolve(poor, np.ones(width, dtype=int)) >= width).any()


def thick_end(mask: Mask, *, settings: BoneSettings = BONE_DEFAULTS) -> str | None:
    """Name a long bone by its thick end: a femur's is below, a tibia's above; None where neither is clearly thicker.

    Args:
        mask: (k, j, i) the bone on the upright grid.
        settings: How much thicker one end must be.
    """
    areas = mask.sum(axis=(1, 2))
    areas = areas[areas > 0]
    third = max(1, len(areas) // 3)
    below, above = float(areas[:third].mean()), float(areas[-third:].mean())
    if below > settings.wider * above:
        return "femur"
    return "tibia" if above > settings.wider * below else None


def _disc(normal: Floats, radius_mm: float) -> Floats:
    """(n, 3) [mm] points of a disc about the origin."""
    across = np.cross(normal, np.eye(3)[int(np.abs(normal).argmin())])
    across /= np.linalg.norm(across)
    steps = np.arange(-radius_mm, radius_mm + 0.5)
    a, b = np.meshgrid(steps, steps)
    inside = np.hypot(a, b) <= radius_mm
    return np.asarray(a[inside][:, None] * across + b[inside][:, None] * np.cross(normal, across))

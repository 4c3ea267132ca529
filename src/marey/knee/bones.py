"""Femur, tibia and patella from one MR volume or two of the same knee, with or without a template."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage

from marey.arrays import Floats, Integers, Mask
from marey.errors import MareyError, SettingProblem
from marey.knee.bias_field import bias_field
from marey.knee.bone_edges import Piece, marrow_odds, refined, soft_tissue_odds
from marey.knee.marrow import WORK_MM, Kind, Knee, air_level, prepare
from marey.knee.one_bone import in_line, thick_end
from marey.knee.region_growing import grow, marrow_level, outgrowth, seed_ball, signed_distance
from marey.knee.resampling import onward, part_of, resampled, smoothed
from marey.knee.seeds import find_seeds, patella_seeds, seed_voxel
from marey.knee.structures import BONES, LABELS
from marey.knee.template_fit import (
    TemplateBone,
    TemplateFit,
    joint_centre,
    place_template,
    positions_of,
    template_bones,
    template_distance,
)
from marey.knee.volume import Grid, Labels, Volume

Report = Callable[[str, float], None]
"""Told the name of a step and the share of the work that is done."""
_ASTRAY_MM, _SURE_MM = 4.0, 2.0
_PRIOR_FROM_MM, _PRIOR_NATS = 2.0, 4.0
_BOX_MM = 8.0
_PATELLA_CM3 = (4.0, 45.0)
_LONG_BONES = ("femur", "tibia")
_OUTGROWTH_CM3 = 1.0
_LEAST_MARROW = 0.5


@dataclass(frozen=True, eq=False, kw_only=True)
class Bone:
    """A bone as it was found."""

    distance_mm: np.ndarray
    """(k, j, i) signed distance to its surface, positive inside, on `grid`."""
    grid: Grid
    """The image's own voxels about the bone."""
    seed_mm: Floats
    """(3,) LPS."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BoneSegmentation:
    """The bones of a knee."""

    labels: Labels
    """On the first image's own grid."""
    bones: Mapping[str, Bone]
    kinds: tuple[Kind, ...]
    """Whether marrow is dark or bright, of each image."""
    template_fit: TemplateFit | None
    notes: tuple[str, ...]
    """What a user should know, as sentences."""
    missing: Mapping[str, str] = field(default_factory=dict)
    """Bone that was not found, to the reason."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Look:
    """What is known at work: the images, their marrow, and what a template says."""

    volumes: tuple[Volume, ...]
    knees: tuple[Knee, ...]
    kinds: tuple[Kind, ...]
    seeds: dict[str, Integers]
    grown: dict[str, Mask] = field(default_factory=dict)

    @property
    def grid(self) -> Grid:
        return self.knees[0].grid

    def long_bones(self) -> Mask:
        """(k, j, i) femur and tibia as they grew."""
        return np.asarray(np.logical_or.reduce([self.grown[name] for name in _LONG_BONES if name in self.grown]))

    def likeness(self, voxel: Integers, radius_mm: float = 8.0) -> np.ndarray:
        """(k, j, i) least likeness, over the images, to the marrow about a seed; NaN outside one of them."""
        each = []
        for knee, kind in zip(self.knees, self.kinds, strict=True):
            level = marrow_level(knee, kind, voxel, radius_mm)
            each.append(np.where(knee.within, level.likeness(knee.intensity) * knee.body, np.float32(np.nan)))
        return np.asarray(np.minimum.reduce(each))


def segment_bones(
    volumes: Sequence[Volume],
    *,
    template: Labels | None = None,
    seeds_mm: Mapping[str, Floats] | None = None,
    report: Report = lambda step, share: None,
) -> BoneSegmentation:
    """Find femur, tibia and patella.

    Threshold seed growing with openings against leaks gives them roughly; a template, when there is one, says where
    they cannot be; then each edge moves to where the image changes, on the image's own voxels.

    Args:
        volumes: One image, or two of the same knee in the same place, with and without fat saturation. The answer
            lies on the first one's grid.
        template: Labels of another knee, of either side.
        seeds_mm: Bone to (3,) LPS; bones without one are found.
        report: Called at every step.

    Raises:
        SettingProblem: A seed lies outside the image, in the air, or not in marrow.
        MareyError: No knee is found, the template does not fit, or the two images do not lie in one place.
    """
    given = dict(seeds_mm or {})
    report("bias and body", 0.0)
    look = _looked(tuple(volumes), given)
    report("growing", 0.15)
    missing = _grow_long_bones(look, given)
    report("template" if template is not None else "patella", 0.3)
    _grow_patella(look, None, given)
    fit, limits = _limits(look, template)
    notes = [] if fit is None else [_fit_note(fit)]
    if template is not None and fit is None:
        notes.append(
            "The template is left out: it is laid into the image by femur and tibia together. Without it a bone may"
            " reach far into what surrounds it: look at the surface."
        )
    if "patella" not in look.grown and "patella" in limits:
        _grow_patella(look, limits["patella"], given)
    else:
        # A patella that grew without a leak needs no limit, and a template's seldom has its shape.
        limits.pop("patella", None)
    if "patella" not in look.grown:
        missing["patella"] = "No patella was found: give its place with --seed patella X Y Z."
    found = {}
    for index, name in enumerate(look.grown):
        report(f"edge of the {name}", 0.5 + 0.5 * index / len(look.grown))
        bone, box = _bone(look, name, limits.get(name))
        share = _marrow_share(look, name, bone)
        if share < _LEAST_MARROW:
            missing[name] = f"No {name} was found: of what was taken for it only {100 * share:.0f} % is like marrow."
            continue
        found[name] = bone, box
        notes += _outgrowth_note(name, bone, look.grid)
    report("bones", 1.0)
    notes += missing.values()
    return BoneSegmentation(
        labels=_labelled(found, volumes[0].grid),
        bones={name: bone for name, (bone, _) in found.items()},
        kinds=look.kinds,
        template_fit=fit,
        notes=tuple(notes),
        missing=missing,
    )


def _looked(volumes: tuple[Volume, ...], given: Mapping[str, Floats]) -> _Look:
    if not 1 <= len(volumes) <= 2:
        raise SettingProblem(f"One volume or two of the same knee are wanted, not {len(volumes)}.")
    first = prepare(volumes[0])
    knees = (first, *[prepare(other, first.grid) for other in volumes[1:]])
    for knee in knees[1:]:
        shared = (knee.body & first.body).sum() / max(1, min(knee.body.sum(), first.body.sum()))
        if shared < 0.8:
            raise MareyError("The two volumes do not show one knee in one place: their bodies lie apart.")
    seeds = [find_seeds(knee, given if index == 0 else {}) for index, knee in enumerate(knees)]
    places = {"femur": seeds[0].femur, "tibia": seeds[0].tibia}
    return _Look(volumes=volumes, knees=knees, kinds=tuple(each.kind for each in seeds), seeds=places)


def _grow_long_bones(look: _Look, given: Mapping[str, Floats]) -> dict[str, str]:
    """Grow femur and tibia; give which of them is not in view, with the reason."""
    whole = _one_bone(look)
    if whole is not None:
        return _grow_alone(look, whole, given)
    if look.seeds["femur"][0] <= look.seeds["tibia"][0] and {"femur", "tibia"} & set(given):
        typed = " and of the ".join(name for name in _LONG_BONES if name in given)
        raise SettingProblem(
            f"By the seed of the {typed} the femur would lie below the tibia: are they the right ones?"
        )
    for name, other in (("femur", "tibia"), ("tibia", "femur")):
        keep_out = look.grown.get(other, seed_ball(look.knees[0], look.seeds[other]))
        grown = grow(look.likeness(look.seeds[name]), look.seeds[name], keep_out=keep_out)
        if not grown.any():
            raise MareyError(
                f"Nothing grows from the seed of the {name} at LPS {_said(look, name)} mm, which was"
                f" {'given' if name in given else 'found'}: give another with --seed {name} X Y Z."
            )
        look.grown[name] = grown
    return {}


def _one_bone(look: _Look) -> Mask | None:
    """(k, j, i) the bone in which both seeds lie, if they do."""
    first, second = look.seeds["femur"], look.seeds["tibia"]
    likeness = look.likeness(first)
    if not in_line(likeness, look.grid, first, second):
        return None
    whole = grow(likeness, first)
    return whole if whole[seed_ball(look.knees[0], second, 4.0)].mean() > 0.5 else None


def _grow_alone(look: _Look, whole: Mask, given: Mapping[str, Floats]) -> dict[str, str]:
    """Take the bone in which both seeds lie for the one that its shape tells."""
    name = thick_end(whole)
    for typed, other in (("femur", "tibia"), ("tibia", "femur")):
        if typed in given and name != typed:
            seems = f"it seems to be the {name}" if name else "femur or tibia, its shape does not tell"
            raise SettingProblem(
                f"The seed of the {typed} at LPS {_said(look, typed)} mm and that of the {other} at"
                f" {_said(look, other)} lie in one bone: {seems}. Choose a place within the {typed}."
            )
    if name is None:
        raise MareyError("One long bone only is found, and its shape does not tell whether it is a femur or a tibia.")
    other = "tibia" if name == "femur" else "femur"
    look.grown[name] = whole
    del look.seeds[other]
    return {other: f"No {other} was found: of the long bones, the image shows the {name} only."}


def _said(look: _Look, name: str) -> str:
    return " ".join(f"{each:.0f}" for each in look.grid.lps(look.seeds[name][::-1].astype(float)))


def _limits(look: _Look, template: Labels | None) -> tuple[TemplateFit | None, dict[str, np.ndarray]]:
    """Lay the template into the image; give (k, j, i) the signed distance of each of its bones."""
    if template is None or not all(name in look.grown for name in _LONG_BONES):
        return None, {}
    bones = template_bones(template)
    likeness = {name: look.likeness(look.seeds[name]) * look.grown[name] for name in _LONG_BONES}
    if "patella" in look.grown:
        likeness["patella"] = look.likeness(look.seeds["femur"]) * look.grown["patella"]
    elif "patella" in bones:
        likeness["patella"] = look.likeness(look.seeds["femur"]) * ~look.long_bones()
    fit = place_template(bones, look.grown, likeness, look.grid)
    return fit, {name: _limit(bone, fit, name, likeness, look.grid) for name, bone in bones.items()}


def _limit(
    bone: TemplateBone, fit: TemplateFit, name: str, likeness: Mapping[str, np.ndarray], grid: Grid
) -> np.ndarray:
    return template_distance(bone, fit.placements[name], likeness[name], grid)


def _fit_note(fit: TemplateFit) -> str:
    side = "mirrored, as it is of the other side" if fit.mirrored else "of the same side"
    return f"The template is {side}; {100 * fit.fit:.0f} % of its edges lie on edges of bone."


def _marrow_share(look: _Look, name: str, bone: Bone) -> float:
    """How much of a bone the image itself shows to be like the marrow at its seed: a template may have added much."""
    inside = resampled(bone.distance_mm, bone.grid, look.grid, outside=-50.0) > 0
    likeness = look.likeness(look.seeds[name])[inside]
    known = likeness[~np.isnan(likeness)]
    return float((known > 0).mean()) if known.size else 0.0


def _outgrowth_note(name: str, bone: Bone, grid: Grid) -> list[str]:
    """Say where a femur or tibia has a part that none has: it may have leaked there."""
    if name not in _LONG_BONES:
        return []
    part = outgrowth(resampled(bone.distance_mm, bone.grid, grid, outside=-50.0) > 0)
    pieces, count = ndimage.label(part)
    if not count:
        return []
    sizes = np.bincount(pieces.ravel())[1:]
    cm3 = float(sizes.max()) * WORK_MM**3 / 1000
    if cm3 < _OUTGROWTH_CM3:
        return []
    x, y, z = grid.lps(np.argwhere(pieces == 1 + int(sizes.argmax())).mean(axis=0)[::-1])
    return [
        f"The {name} has an outgrowth of {cm3:.1f} cm3 about LPS {x:.0f} {y:.0f} {z:.0f} mm that may be a leak:"
        " look there; a template, or another seed, may keep it out."
    ]


def _grow_patella(look: _Look, limit: np.ndarray | None, given: Mapping[str, Floats]) -> None:
    taken = look.long_bones()
    if "patella" in given:
        places = [seed_voxel(look.knees[0], "patella", given["patella"])]
        likeness = look.likeness(places[0], 4.0)
    else:
        pair = [name for name in _LONG_BONES if name in look.grown]
        joint = joint_centre({name: positions_of(look.grown[name], look.grid) for name in pair})
        likeness = look.likeness(look.seeds[pair[0]])
        places = patella_seeds(look.knees[0], likeness, taken, joint)
    keep_out = taken if limit is None else taken | (np.nan_to_num(limit, nan=-100.0) < -_ASTRAY_MM)
    for place in places:
        grown = grow(likeness, place, keep_out=keep_out)
        if _PATELLA_CM3[0] <= grown.sum() * WORK_MM**3 / 1000 <= _PATELLA_CM3[1]:
            look.grown["patella"], look.seeds["patella"] = grown, place
            return
    if "patella" in given:
        raise SettingProblem("No patella grows from its seed: choose a place in the middle of the patella.")


def _bone(look: _Look, name: str, limit: np.ndarray | None) -> tuple[Bone, tuple[slice, ...]]:
    """Refine a grown bone on the first image's own voxels."""
    coarse = look.grown[name]
    for other, mask in look.grown.items():
        coarse = coarse if other == name else coarse & ~mask
    if limit is not None:
        coarse = (coarse & ~(limit < -_ASTRAY_MM)) | ((limit > _SURE_MM) & look.knees[0].body)
    elif name in _LONG_BONES:
        coarse = coarse & ~outgrowth(coarse)
    own = look.volumes[0].grid
    coarse = onward(coarse, look.knees[0].within)
    distance = resampled(signed_distance(coarse, look.grid.array_spacing_mm), look.grid, own, outside=-50.0)
    reach = [(np.flatnonzero((distance > -_BOX_MM).any(axis=axes))) for axes in ((1, 2), (0, 2), (0, 1))]
    box = tuple(slice(int(each[0]), int(each[-1]) + 1) for each in reach)
    grid = part_of(own, box)
    prior = np.zeros(grid.shape, dtype=np.float32)
    if limit is not None:
        known = resampled(np.nan_to_num(limit, nan=0.0), look.grid, grid, outside=0.0)
        prior = np.clip(known + _PRIOR_FROM_MM, -_PRIOR_NATS, 0)
    field_mm = _edge(look, distance[box], prior, grid, small=name not in _LONG_BONES)
    seed = look.grid.lps(look.seeds[name][::-1].astype(float))
    return Bone(distance_mm=field_mm, grid=grid, seed_mm=seed), box


def _edge(look: _Look, distance: np.ndarray, prior: np.ndarray, grid: Grid, *, small: bool) -> np.ndarray:
    """(k, j, i) the edge by the image with dark marrow if there is one: it shows the cortex' outside."""
    pieces = [
        Piece(
            intensity=_corrected(volume, grid),
            distance_mm=distance,
            prior_nats=prior,
            grid=grid,
            small=small,
            no_signal=air_level(knee),
        )
        for volume, knee in zip(look.volumes, look.knees, strict=True)
    ]
    lead = look.kinds.index("dark") if "dark" in look.kinds else 0
    others = []
    for index, (piece, kind) in enumerate(zip(pieces, look.kinds, strict=True)):
        if index != lead:
            others.append(marrow_odds(piece, kind) if kind == look.kinds[lead] else soft_tissue_odds(piece))
    return refined(pieces[lead], look.kinds[lead], others)


def _corrected(volume: Volume, grid: Grid) -> np.ndarray:
    """(k, j, i) an image without bias on another grid; as it is where the grid is a part of its own."""
    if np.allclose(volume.grid.lps_from_voxel[:3, :3], grid.lps_from_voxel[:3, :3]):
        values = volume.intensity
    else:
        values = smoothed(volume.intensity, volume.grid, 0.3 * float(grid.spacing_mm.min()))
    return resampled(values, volume.grid, grid) / bias_field(volume).on(grid)


def _labelled(found: Mapping[str, tuple[Bone, tuple[slice, ...]]], grid: Grid) -> Labels:
    labels = np.zeros(grid.shape, dtype=np.uint8)
    for name in BONES:
        if name in found:
            bone, box = found[name]
            part = labels[box]
            part[(bone.distance_mm > 0) & (part == 0)] = LABELS[name]
    return Labels(labels=labels, grid=grid)

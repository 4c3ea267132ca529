"""Femur, tibia and patella from one MR volume or two of the same knee, with or without a template."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.errors import MareyError, SettingProblem
from marey.knee.bones.bone_edges import Piece, marrow_odds, refined, soft_tissue_odds
from marey.knee.bones.bone_notes import fit_note, outgrowth_note, thin_note
from marey.knee.bones.bright_marrow import (
    BrightImage,
    cut_along_line,
    evened,
    evenness,
    followed,
    goes_on,
    template_odds,
)
from marey.knee.bones.marrow import WORK_MM, Kind, Knee, NoPairFound, air_level, prepare
from marey.knee.bones.one_bone import in_line, thick_end
from marey.knee.bones.partial_view import LONG_BONES, SeenBone, in_view, partial_view, seen_bones
from marey.knee.bones.region_growing import grow, marrow_level, outgrowth, seed_ball, signed_distance
from marey.knee.bones.seeds import find_seeds, kind_at, patella_seeds, seed_voxel
from marey.knee.bones.template_fit import (
    TemplateBone,
    TemplateFit,
    joint_centre,
    place_alone,
    place_template,
    positions_of,
    shaft_distance,
    template_bones,
    template_distance,
)
from marey.knee.space.bias_field import bias_field
from marey.knee.space.resampling import onward, part_of, resampled, smoothed
from marey.knee.space.structures import BONES, LABELS
from marey.knee.space.volume import Grid, Labels, Volume

Report = Callable[[str, float], None]
"""Told the name of a step and the share of the work that is done."""
_ASTRAY_MM, _SURE_MM = 4.0, 2.0
_ROUGH_MM = 6.0
"""How far the edge of a long bone alone may lie from where the template was laid as a whole."""
_PRIOR_FROM_MM, _PRIOR_NATS = 2.0, 4.0
_BOX_MM, _BRIGHT_BOX_MM, _FOLLOW_BOX_MM = 8.0, 16.0, 24.0
_PATELLA_CM3 = (4.0, 45.0)
_MOST_PATELLA = 1.6
"""How many times as large as a template's a patella with bright marrow may grow."""
_LEAST_MARROW = 0.5
_TOO_LARGE = 1.4
"""How much larger than the template's a bone is that must have leaked."""
_IN_PART = {
    False: "Where it shows one of the two only, --template, or a --seed in that one, may find it.",
    True: "Neither does the template's femur or tibia alone fit anywhere in it.",
}
"""What to say of an image that may show one long bone only, by whether there is a template."""


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
    template: Mapping[str, TemplateBone] = field(default_factory=dict)
    laid: dict[str, SeenBone] = field(default_factory=dict)
    """Where the template's long bones lie about, when not both are in view."""
    grown: dict[str, Mask] = field(default_factory=dict)
    followed: set[str] = field(default_factory=set)
    """Bones that went on to where marrow is dimmer than at the seed."""

    @property
    def grid(self) -> Grid:
        return self.knees[0].grid

    def long_bones(self) -> Mask:
        """(k, j, i) femur and tibia as they grew."""
        return np.asarray(np.logical_or.reduce([self.grown[name] for name in LONG_BONES if name in self.grown]))

    @property
    def bright(self) -> bool:
        """Whether marrow is bright in every image, which show femur and tibia."""
        return set(self.kinds) == {"bright"} and all(name in self.grown for name in LONG_BONES)

    def own_likeness(self, name: str) -> np.ndarray:
        """(k, j, i) likeness to a bone's marrow; where it was followed, all of it is alike."""
        likeness = self.likeness(self.seeds[name])
        return np.where(self.grown[name] & ~np.isnan(likeness), 1, likeness) if name in self.followed else likeness

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
    look = _looked(tuple(volumes), given, {} if template is None else template_bones(template))
    report("growing", 0.15)
    missing = _grow_long_bones(look, given)
    if look.bright:
        _follow_long_bones(look)
    report("template" if template is not None else "patella", 0.3)
    _grow_patella(look, None, given)
    if look.bright and _larger_than_template(look):
        del look.grown["patella"], look.seeds["patella"]
    fit, limits = _limits(look)
    notes = [] if fit is None else [fit_note(fit)]
    if template is not None and fit is None:
        notes.append(
            "The template is left out: its bone does not lie well on the only long bone in view. Without it a bone may"
            " reach far into what surrounds it: look at the surface."
        )
    _limit_patella(look, limits, fit, given)
    if "patella" not in look.grown:
        missing["patella"] = "No patella was found: give its place with --seed patella X Y Z."
    found, of_bones = _edges(look, limits, missing, report)
    notes += of_bones
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


def _limit_patella(
    look: _Look, limits: dict[str, np.ndarray], fit: TemplateFit | None, given: Mapping[str, Floats]
) -> None:
    """Grow the patella again within the template's where it leaked or did not grow; else take that limit away."""
    if "patella" in limits and _patella_leaks(look, limits["patella"], fit):
        look.grown.pop("patella", None)
        _grow_patella(look, limits["patella"], given)
    else:
        # A patella that grew without a leak needs no limit, and a template's seldom has its shape.
        limits.pop("patella", None)


def _edges(
    look: _Look, limits: Mapping[str, np.ndarray], missing: dict[str, str], report: Report
) -> tuple[dict[str, tuple[Bone, tuple[slice, ...]]], list[str]]:
    """Move the edge of each bone that grew; what turns out to be none goes to those missing. Gives notes, too."""
    found: dict[str, tuple[Bone, tuple[slice, ...]]] = {}
    notes: list[str] = []
    for index, name in enumerate(look.grown):
        report(f"edge of the {name}", 0.5 + 0.5 * index / len(look.grown))
        bone, box = _bone(look, name, limits.get(name))
        inside = resampled(bone.distance_mm, bone.grid, look.grid, outside=-50.0) > 0
        share = _marrow_share(look, name, inside)
        if share < _LEAST_MARROW:
            missing[name] = f"No {name} was found: of what was taken for it only {100 * share:.0f} % is like marrow."
            continue
        found[name] = bone, box
        notes += outgrowth_note(name, inside, look.grid)
        notes += thin_note(name, inside) if name not in limits else []
    return found, notes


def _looked(volumes: tuple[Volume, ...], given: Mapping[str, Floats], bones: Mapping[str, TemplateBone]) -> _Look:
    if not 1 <= len(volumes) <= 2:
        raise SettingProblem(f"One volume or two of the same knee are wanted, not {len(volumes)}.")
    first = prepare(volumes[0])
    knees = (first, *[prepare(other, first.grid) for other in volumes[1:]])
    for knee in knees[1:]:
        shared = (knee.body & first.body).sum() / max(1, min(knee.body.sum(), first.body.sum()))
        if shared < 0.8:
            raise MareyError("The two volumes do not show one knee in one place: their bodies lie apart.")
    laid: dict[str, SeenBone] = {}
    try:
        found = find_seeds(first, given)
        kind, seeds = found.kind, {"femur": found.femur, "tibia": found.tibia}
    except NoPairFound as problem:
        view = partial_view(first, bones, given)
        if view is None:
            raise NoPairFound(f"{problem} {_IN_PART[bool(bones)]}") from problem
        kind, seeds, laid = view.kind, view.seeds, view.laid
    kinds = (kind, *[_kind_of(knee, seeds) for knee in knees[1:]])
    return _Look(volumes=volumes, knees=knees, kinds=kinds, seeds=seeds, template=bones, laid=laid)


def _kind_of(knee: Knee, seeds: Mapping[str, Integers]) -> Kind:
    """Tell a further image's kind of marrow by its own femur and tibia, or else at the first one's."""
    try:
        return find_seeds(knee, {}).kind
    except NoPairFound:
        return kind_at(knee, list(seeds.values()))


def _grow_long_bones(look: _Look, given: Mapping[str, Floats]) -> dict[str, str]:
    """Grow femur and tibia; give which of them is not in view, with the reason."""
    if len(look.seeds) == 1:
        (name,) = look.seeds
        return _keep_alone(look, name, _grown_from(look, name, None, given))
    whole = _one_bone(look)
    if whole is not None:
        look.laid.update(
            in_view(seen_bones(look.knees[0], look.template, kinds=look.kinds[:1]), look.template, look.grid)
        )
        if len(look.laid) < 2:
            return _grow_alone(look, whole, given)
        look.seeds.update({name: each.seed for name, each in look.laid.items() if name not in given})
    if look.seeds["femur"][0] <= look.seeds["tibia"][0] and {"femur", "tibia"} & set(given):
        typed = " and of the ".join(name for name in LONG_BONES if name in given)
        raise SettingProblem(
            f"By the seed of the {typed} the femur would lie below the tibia: are they the right ones?"
        )
    for name, other in (("femur", "tibia"), ("tibia", "femur")):
        keep_out = look.grown.get(other, seed_ball(look.knees[0], look.seeds[other]))
        look.grown[name] = _grown_from(look, name, keep_out, given)
    return {}


def _grown_from(look: _Look, name: str, keep_out: Mask | None, given: Mapping[str, Floats]) -> Mask:
    grown = grow(look.likeness(look.seeds[name]), look.seeds[name], keep_out=keep_out)
    if not grown.any():
        raise MareyError(
            f"Nothing grows from the seed of the {name} at LPS {_said(look, name)} mm, which was"
            f" {'given' if name in given else 'found'}: give another with --seed {name} X Y Z."
        )
    return grown


def _follow_long_bones(look: _Look) -> None:
    """Let bones go on to where bright marrow is dimmer; dark marrow that brightens looks like what is about it."""
    for name in LONG_BONES:
        distance, box = _distance_and_box(look, look.grown[name], _FOLLOW_BOX_MM)
        image = _bright_image(look, name, part_of(look.volumes[0].grid, box))
        further = followed(image, distance[box] > 0)
        if further is not None:
            look.grown[name] = resampled(further.astype(np.float32), image.grid, look.grid) > 0.5
            look.followed.add(name)


def _bright_image(look: _Look, name: str, grid: Grid) -> BrightImage:
    others = np.logical_or.reduce([mask for other, mask in look.grown.items() if other != name])
    free = resampled((look.knees[0].body & ~others).astype(np.float32), look.grid, grid) > 0.5
    return BrightImage(intensity=_corrected(look.volumes[0], grid), free=free, grid=grid)


def _one_bone(look: _Look) -> Mask | None:
    """(k, j, i) the bone in which both seeds lie, if they do."""
    first, second = look.seeds["femur"], look.seeds["tibia"]
    likeness = look.likeness(first)
    if not in_line(likeness, look.grid, first, second):
        return None
    whole = grow(likeness, first)
    return whole if whole[seed_ball(look.knees[0], second, 4.0)].mean() > 0.5 else None


def _grow_alone(look: _Look, whole: Mask, given: Mapping[str, Floats]) -> dict[str, str]:
    """Take the bone in which both seeds lie for the one that the template, or its shape, tells."""
    name = next(iter(look.laid), None) or thick_end(whole)
    for typed, other in (("femur", "tibia"), ("tibia", "femur")):
        if typed in given and name != typed:
            seems = f"it seems to be the {name}" if name else "femur or tibia, its shape does not tell"
            raise SettingProblem(
                f"The seed of the {typed} at LPS {_said(look, typed)} mm and that of the {other} at"
                f" {_said(look, other)} lie in one bone: {seems}. Choose a place within the {typed}."
            )
    if name is None:
        raise MareyError("One long bone only is found, and its shape does not tell whether it is a femur or a tibia.")
    return _keep_alone(look, name, whole)


def _keep_alone(look: _Look, name: str, grown: Mask) -> dict[str, str]:
    """Keep the only long bone in view, as far as the template lets it reach; give that the other is missing."""
    if name in look.laid:
        limit = shaft_distance(look.template[name], look.laid[name].placement, look.grid)
        grown = grown & ~(limit < -_ROUGH_MM)
    look.grown[name] = grown
    other = "tibia" if name == "femur" else "femur"
    look.seeds.pop(other, None)
    return {other: f"No {other} was found: of the long bones, the image shows the {name} only."}


def _said(look: _Look, name: str) -> str:
    return " ".join(f"{each:.0f}" for each in look.grid.lps(look.seeds[name][::-1].astype(float)))


def _limits(look: _Look) -> tuple[TemplateFit | None, dict[str, np.ndarray]]:
    """Lay the template into the image; give (k, j, i) the signed distance of each of its bones."""
    bones, long = look.template, [name for name in LONG_BONES if name in look.grown]
    if not bones or (len(long) == 1 and long[0] not in look.laid):
        return None, {}
    likeness = {name: look.own_likeness(name) * look.grown[name] for name in long}
    if "patella" in bones:
        patella = look.grown.get("patella", ~look.long_bones())
        likeness["patella"] = look.likeness(look.seeds[long[0]]) * patella
        if look.bright and "patella" not in look.grown:
            likeness["patella"] = likeness["patella"] * _evenness(look)
    if len(long) == 2:
        fit = place_template(bones, look.grown, likeness, look.grid)
    else:
        seen = look.laid[long[0]]
        start = TemplateFit(
            placements=dict.fromkeys(likeness, seen.placement), mirrored=seen.mirrored, fit=seen.contrast
        )
        fit = place_alone(long[0], bones, start, likeness, look.grid)
    limits = {
        name: template_distance(bones[name], fit.placements[name], likeness[name], look.grid) for name in likeness
    }
    if len(long) == 1:
        # Nothing else keeps a bone alone from leaking beyond the template's end: there its shaft goes straight on.
        shaft = np.minimum(shaft_distance(bones[long[0]], fit.placements[long[0]], look.grid), 0)
        limits[long[0]] = np.where(np.isnan(limits[long[0]]), shaft, limits[long[0]])
    return fit, limits


def _evenness(look: _Look) -> np.ndarray:
    """(k, j, i) little in dark lines: only they part a patella from the fat about it."""
    own = look.volumes[0].grid
    level = marrow_level(look.knees[0], "bright", look.seeds["femur"]).median
    even = evenness(_corrected(look.volumes[0], own) / np.float32(level), own)
    return resampled(even, own, look.grid, outside=1.0)


def _larger_than_template(look: _Look) -> bool:
    """Tell whether a patella grew so much larger than the template's that it must have leaked."""
    if "patella" not in look.grown or "patella" not in look.template:
        return False
    return int(look.grown["patella"].sum()) > _MOST_PATELLA * int((look.template["patella"].distance_mm > 0).sum())


def _patella_leaks(look: _Look, limit: np.ndarray, fit: TemplateFit | None) -> bool:
    """Tell whether no patella grew, or, about one long bone alone, one far larger than the template's."""
    if "patella" not in look.grown:
        return True
    alone = fit is not None and not all(name in fit.placements for name in LONG_BONES)
    return alone and int(look.grown["patella"].sum()) > _TOO_LARGE * int((limit > 0).sum())


def _marrow_share(look: _Look, name: str, inside: Mask) -> float:
    """How much of a bone the image itself shows to be like the marrow at its seed: a template may have added much."""
    likeness = look.own_likeness(name)[inside]
    known = likeness[~np.isnan(likeness)]
    return float((known > 0).mean()) if known.size else 0.0


def _grow_patella(look: _Look, limit: np.ndarray | None, given: Mapping[str, Floats]) -> None:
    taken = look.long_bones()
    if "patella" in given:
        places = [seed_voxel(look.knees[0], "patella", given["patella"])]
        likeness = look.likeness(places[0], 4.0)
    else:
        pair = [name for name in LONG_BONES if name in look.grown]
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
    elif name in LONG_BONES:
        coarse = coarse & ~outgrowth(coarse)
    along_line = look.bright and limit is not None
    distance, box = _distance_and_box(look, coarse, _BRIGHT_BOX_MM if along_line else _BOX_MM)
    grid, distance = part_of(look.volumes[0].grid, box), distance[box]
    prior = np.zeros(grid.shape, dtype=np.float32)
    if limit is not None and along_line:
        # The template's edges are drawn to where all is marrow: the bone's lie farther out.
        known = resampled(goes_on(limit + _PRIOR_FROM_MM, WORK_MM), look.grid, grid, outside=np.nan)
        inside = cut_along_line(_bright_image(look, name, grid), distance > 0, known)
        distance, prior = signed_distance(inside, grid.array_spacing_mm), template_odds(known)
    elif limit is not None:
        known = resampled(np.nan_to_num(limit, nan=0.0), look.grid, grid, outside=0.0)
        prior = np.clip(known + _PRIOR_FROM_MM, -_PRIOR_NATS, 0)
    field_mm = _edge(look, distance, prior, grid, rough=not along_line, small=name not in LONG_BONES)
    seed = look.grid.lps(look.seeds[name][::-1].astype(float))
    return Bone(distance_mm=field_mm, grid=grid, seed_mm=seed), box


def _distance_and_box(look: _Look, mask: Mask, about_mm: float) -> tuple[np.ndarray, tuple[slice, ...]]:
    """(k, j, i) signed distance [mm] to a grown mask's edge on the first image's grid, and the box about the mask."""
    mask = onward(mask, look.knees[0].within)
    spacing, own = look.grid.array_spacing_mm, look.volumes[0].grid
    distance = resampled(signed_distance(mask, spacing), look.grid, own, outside=-50.0)
    reach = [(np.flatnonzero((distance > -about_mm).any(axis=axes))) for axes in ((1, 2), (0, 2), (0, 1))]
    return distance, tuple(slice(int(each[0]), int(each[-1]) + 1) for each in reach)


def _edge(look: _Look, distance: np.ndarray, prior: np.ndarray, grid: Grid, *, rough: bool, small: bool) -> np.ndarray:
    """(k, j, i) the edge by the image with dark marrow if there is one: it shows the cortex' outside."""
    images = [_corrected(volume, grid) for volume in look.volumes]
    if not rough:
        # Marrow is nowhere dim then: the edge stays about where the cut along the line has it.
        images = [evened(image, distance > 0, grid) for image in images]
    pieces = [
        Piece(
            intensity=image,
            distance_mm=distance,
            prior_nats=prior,
            grid=grid,
            rough=rough,
            small=small,
            no_signal=air_level(knee),
        )
        for image, knee in zip(images, look.knees, strict=True)
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

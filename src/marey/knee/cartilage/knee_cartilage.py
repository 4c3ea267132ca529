"""All cartilages of a knee by a template: registration of each bone, what is foretold, what the image shows."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from marey.arrays import Floats
from marey.errors import MareyError
from marey.geometry.rigid import RigidTransform
from marey.knee.cartilage.outer_surface import CartilageSheet, find_cartilage
from marey.knee.cartilage.prediction import CartilagePrediction, predict_cartilage
from marey.knee.cartilage.thickness import cartilage_thickness
from marey.knee.registration.elastic import ElasticRegistration, register_elastically
from marey.knee.registration.rigid import RigidRegistration, register_rigidly
from marey.knee.space.sides import mirrored
from marey.knee.space.structures import BONES, CARTILAGE_OF_BONE
from marey.knee.space.surface import Surface
from marey.knee.space.volume import Volume

_PASSES = 2
"""In the second one each bone's cartilage knows how thick this person's is on the others."""
_SURE = 0.5
LEAST_SEEN = 0.4
"""Over at least such a share of a cartilage the image must tell more of its thickness than the template does."""
MOST_BLUR = 0.5
"""The blur of its edges [standard deviation] over the thickness: beyond, the two edges of a layer run together."""


@dataclass(frozen=True, eq=False, kw_only=True)
class KneeTemplate:
    """Bones of a normal knee, and how thick the cartilage is on them."""

    bones: Mapping[str, Surface]
    thickness_mm: Mapping[str, Floats]
    """(V,) of each bone's vertices, 0 where it is bare."""
    unusable: Mapping[str, str] = field(default_factory=dict)
    """Bones whose cartilage tells nothing, to the reason."""


@dataclass(frozen=True, eq=False, kw_only=True)
class KneeCartilage:
    """What was found, by the bone's name."""

    sheets: Mapping[str, CartilageSheet]
    rigid: Mapping[str, RigidRegistration]
    elastic: Mapping[str, ElasticRegistration]
    missing: Mapping[str, str]
    """Bones whose cartilage the template has and that was not found, to the reason."""
    notes: tuple[str, ...]
    """What a user should know, as sentences."""


def knee_template(surfaces: Mapping[str, Surface], *, mirror: bool = False) -> KneeTemplate:
    """Make a template of the surfaces of bones and cartilages.

    Args:
        surfaces: By the names of `structures.LABELS`; a bone without cartilage is left out.
        mirror: It is of the other side than the subject.

    Raises:
        MareyError: No bone has its cartilage.
    """
    sided = {name: mirrored(surface) if mirror else surface for name, surface in surfaces.items()}
    told = [bone for bone in BONES if CARTILAGE_OF_BONE[bone] in sided]
    if not any(bone in sided for bone in told):
        raise MareyError("The template has no bone together with its cartilage.")
    thickness, unusable = {}, {}
    for bone in told:
        if bone not in sided:
            unusable[bone] = f"The template has no {bone} under it."
            continue
        try:
            thickness[bone] = cartilage_thickness(sided[bone], [sided[CARTILAGE_OF_BONE[bone]]])
        except MareyError as problem:
            unusable[bone] = f"In the template: {problem}"
    return KneeTemplate(bones={bone: sided[bone] for bone in thickness}, thickness_mm=thickness, unusable=unusable)


def find_knee_cartilage(
    volumes: Sequence[Volume], bones: Mapping[str, Surface], template: KneeTemplate,
    starts: Mapping[str, RigidTransform] | None = None, done: Callable[[float], None] = lambda share: None,
) -> KneeCartilage:  # fmt: skip
    """Find the cartilage on each bone that the template has, too.

    Args:
        volumes: The image, or several in the same place.
        bones: The subject's.
        template: Of the same side.
        starts: Where each bone of the template lies about, as subject_from_template; they are looked for without.
        done: Told of the share of the work that is done.

    Raises:
        MareyError: No bone is in both.

    Returns:
        A bone whose cartilage fails, or is not seen in the image, is in `missing`; the others' are kept.
    """
    laid: dict[str, _Laid] = {}
    missing = dict(template.unusable)
    for bone in template.bones:
        if bone not in bones:
            missing[bone] = f"The {bone} was not found."
    both = [bone for bone in BONES if bone in bones and bone in template.bones]
    if not both and not template.unusable:
        raise MareyError("The template and the image have no bone in common.")
    steps = len(both) * (2 + _PASSES)
    for n, bone in enumerate(both):
        start = (starts or {}).get(bone)
        try:
            laid[bone] = _laid(template, bone, bones[bone], start, partial(_told_part, done, n, steps))
        except MareyError as problem:
            missing[bone] = str(problem)
    sheets: dict[str, CartilageSheet] = {}
    # A bone without a template is in the way of the others' cartilage all the same.
    thickness: dict[str, Floats] = {bone: np.zeros(len(surface.vertices_mm)) for bone, surface in bones.items()}
    thickness |= {bone: _foretold(each.told) for bone, each in laid.items()}
    inner = dict(bones)
    for turn in range(_PASSES):
        for n, bone in enumerate(both):
            if bone in laid and bone not in missing:
                others = [(inner[other], thickness[other]) for other in bones if other != bone]
                try:
                    sheets[bone] = find_cartilage(volumes, bones[bone], laid[bone].told, others, sheets.get(bone))
                except MareyError as problem:
                    missing[bone] = str(problem)
            done((len(both) * (2 + turn) + n + 1) / steps)
        # Not what was found: where cartilages touch, it has been placed by this very sharing.
        inner |= {bone: sheet.bone for bone, sheet in sheets.items()}
        thickness |= {bone: np.asarray(sheet.foretold_mm) for bone, sheet in sheets.items()}
    for bone in list(sheets):
        if (reason := _unseen(sheets[bone])) is not None:
            missing[bone] = reason
    sheets = {bone: sheet for bone, sheet in sheets.items() if bone not in missing}
    elastic = {bone: each.elastic for bone, each in laid.items()}
    return KneeCartilage(
        sheets=sheets, missing=missing, rigid={bone: each.rigid for bone, each in laid.items()}, elastic=elastic,
        notes=_notes(sheets, elastic),
    )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class _Laid:
    """A template's bone on the subject's."""

    rigid: RigidRegistration
    elastic: ElasticRegistration
    told: CartilagePrediction


def _told_part(done: Callable[[float], None], n: int, steps: int, part: float) -> None:
    done((2 * n + part) / steps)


def _laid(
    template: KneeTemplate, name: str, bone: Surface, start: RigidTransform | None, done: Callable[[float], None]
) -> _Laid:
    model = template.bones[name]
    rigid = register_rigidly(model, bone, start)
    moved = Surface(vertices_mm=rigid.subject_from_template.apply(model.vertices_mm), faces=model.faces)
    done(1)
    elastic = register_elastically(moved, bone)
    told = predict_cartilage(bone, moved, template.thickness_mm[name], elastic.deformation)
    done(2)
    return _Laid(rigid=rigid, elastic=elastic, told=told)


def seen_share(sheet: CartilageSheet) -> float:
    """Return the share of the covered vertices at which the image tells more of the thickness than the template."""
    return float((np.asarray(sheet.by_image)[sheet.thickness_mm > 0] > 0.5).mean())


def _unseen(sheet: CartilageSheet) -> str | None:
    """Say why a sheet is not what the image shows; None where it is."""
    if not (sheet.thickness_mm > 0).any():
        return "The image shows none where the template has some."
    if (seen := seen_share(sheet)) >= LEAST_SEEN:
        return None
    blur = np.nanmedian(np.asarray(sheet.blur_mm))
    return (
        f"Over {100 * (1 - seen):.0f} % of it the image tells less of its thickness than the template: its outer edge "
        f"is not seen. An edge is blurred by {blur:.1f} mm (standard deviation) along "
        "the bone's normals; thinner slices, or another contrast, would show it."
    )


def _foretold(prediction: CartilagePrediction) -> Floats:
    return np.where(prediction.presence > _SURE, np.nan_to_num(prediction.thickness_mm), 0.0)


def _notes(sheets: Mapping[str, CartilageSheet], elastic: Mapping[str, ElasticRegistration]) -> tuple[str, ...]:
    notes = []
    for bone, sheet in sheets.items():
        name = CARTILAGE_OF_BONE[bone].replace("_", " ")
        if (unsure := float((sheet.confidence[sheet.thickness_mm > 0] < _SURE).mean())) > 0.3:
            notes.append(f"The {name}'s outer surface is unsure over {100 * unsure:.0f} % of it.")
        ratio = float(
            np.nanmedian(np.asarray(sheet.blur_mm) / np.where(sheet.thickness_mm > 0, sheet.thickness_mm, np.nan))
        )
        if ratio > MOST_BLUR:
            notes.append(
                f"The {name}'s edges are blurred by {100 * ratio:.0f} % of its thickness (standard deviation): the "
                "voxels are too thick for it, and its thickness is unsure."
            )
        if elastic[bone].surface_distance_mm > 1.0:
            far = elastic[bone].surface_distance_mm
            notes.append(f"The template's {bone} could be bent to within {far:.1f} mm of the bone only, on average.")
    return tuple(notes)

"""All cartilages of a knee by a template: registration of each bone, what is foretold, what the image shows."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats
from marey.errors import MareyError
from marey.geometry.rigid import RigidTransform
from marey.knee.cartilage import CartilageSheet, find_cartilage
from marey.knee.cartilage_prediction import CartilagePrediction, predict_cartilage
from marey.knee.elastic_registration import ElasticRegistration, register_elastically
from marey.knee.rigid_registration import RigidRegistration, register_rigidly
from marey.knee.sides import mirrored
from marey.knee.structures import BONES, CARTILAGE_OF_BONE
from marey.knee.surface import Surface
from marey.knee.thickness import cartilage_thickness
from marey.knee.volume import Volume

_PASSES = 2
"""In the second one each bone's cartilage knows how thick this person's is on the others."""
_SURE = 0.5


@dataclass(frozen=True, eq=False, kw_only=True)
class KneeTemplate:
    """Bones of a normal knee, and how thick the cartilage is on them."""

    bones: Mapping[str, Surface]
    thickness_mm: Mapping[str, Floats]
    """(V,) of each bone's vertices, 0 where it is bare."""


@dataclass(frozen=True, eq=False, kw_only=True)
class KneeCartilage:
    """What was found, by the bone's name."""

    sheets: Mapping[str, CartilageSheet]
    rigid: Mapping[str, RigidRegistration]
    elastic: Mapping[str, ElasticRegistration]
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
    bones = {bone: sided[bone] for bone in BONES if bone in sided and CARTILAGE_OF_BONE[bone] in sided}
    if not bones:
        raise MareyError("The template has no bone together with its cartilage.")
    thickness = {
        bone: cartilage_thickness(surface, [sided[CARTILAGE_OF_BONE[bone]]]) for bone, surface in bones.items()
    }
    return KneeTemplate(bones=bones, thickness_mm=thickness)


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
        MareyError: No bone is in both, or a template's bone does not fit.
    """
    both = [bone for bone in BONES if bone in bones and bone in template.bones]
    if not both:
        raise MareyError("The template and the image have no bone in common.")
    rigid, elastic, told = {}, {}, {}
    steps = len(both) * (2 + _PASSES)
    for n, bone in enumerate(both):
        model = template.bones[bone]
        rigid[bone] = register_rigidly(model, bones[bone], (starts or {}).get(bone))
        laid = Surface(
            vertices_mm=rigid[bone].subject_from_template.apply(model.vertices_mm), faces=model.faces
        )  # fmt: skip
        done((2 * n + 1) / steps)
        elastic[bone] = register_elastically(laid, bones[bone])
        told[bone] = predict_cartilage(bones[bone], laid, template.thickness_mm[bone], elastic[bone].deformation)
        done((2 * n + 2) / steps)
    sheets: dict[str, CartilageSheet] = {}
    thickness = {bone: _foretold(each) for bone, each in told.items()}
    for turn in range(_PASSES):
        for n, bone in enumerate(both):
            others = [(bones[other], thickness[other]) for other in both if other != bone]
            sheets[bone] = find_cartilage(volumes, bones[bone], told[bone], others)
            done((len(both) * (2 + turn) + n + 1) / steps)
        # Not what was found: where cartilages touch, it has been placed by this very sharing.
        thickness = {bone: np.asarray(sheet.foretold_mm) for bone, sheet in sheets.items()}
    return KneeCartilage(sheets=sheets, rigid=rigid, elastic=elastic, notes=_notes(sheets, elastic))


def _foretold(prediction: CartilagePrediction) -> Floats:
    return np.where(prediction.presence > _SURE, np.nan_to_num(prediction.thickness_mm), 0.0)


def _notes(sheets: Mapping[str, CartilageSheet], elastic: Mapping[str, ElasticRegistration]) -> tuple[str, ...]:
    notes = []
    for bone, sheet in sheets.items():
        name = CARTILAGE_OF_BONE[bone].replace("_", " ")
        covered = sheet.thickness_mm > 0
        if not covered.any():
            notes.append(f"No {name} was found in the image.")
        elif (unsure := float((sheet.confidence[covered] < _SURE).mean())) > 0.3:
            notes.append(f"The {name}'s outer surface is unsure over {100 * unsure:.0f} % of it.")
        if elastic[bone].surface_distance_mm > 1.0:
            far = elastic[bone].surface_distance_mm
            notes.append(f"The template's {bone} could be bent to within {far:.1f} mm of the bone only, on average.")
    return tuple(notes)

"""All cartilages of a knee by a template: registration of each bone, prediction, and segmentation."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from marey.arrays import Floats
from marey.errors import MareyError
from marey.geometry.rigid import RigidTransform
from marey.knee.cartilage.outer_surface import (
    OUTER_SURFACE_DEFAULTS,
    CartilageSheet,
    OuterSurfaceSettings,
    find_cartilage,
)
from marey.knee.cartilage.prediction import CartilagePrediction, predict_cartilage
from marey.knee.cartilage.thickness import cartilage_thickness
from marey.knee.registration.elastic import ELASTIC_DEFAULTS, ElasticRegistration, ElasticSettings, register_elastically
from marey.knee.registration.rigid import RIGID_DEFAULTS, RigidRegistration, RigidSettings, register_rigidly
from marey.knee.space.sides import mirrored
from marey.knee.space.structures import BONES, CARTILAGE_OF_BONE
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.volume import Volume


@dataclass(frozen=True, kw_only=True)
class KneeCartilageSettings:
    """Settings for finding all cartilages of a knee.

    Values without a stated source were chosen by hand.
    """

    rigid: RigidSettings = RIGID_DEFAULTS
    elastic: ElasticSettings = ELASTIC_DEFAULTS
    outer_surface: OuterSurfaceSettings = OUTER_SURFACE_DEFAULTS
    passes: int = 2
    """Number of passes over the bones. In the second one the thickness predicted for the other bones is that of the
    subject."""
    sure: float = 0.5
    """Probability from which cartilage is predicted, and confidence below which a thickness counts as uncertain."""
    least_seen: float = 0.4
    """Least share of a cartilage over which the image determines its thickness more than the template."""
    much_shared: float = 0.1
    """Share of a cartilage that touches another without a visible edge from which on it is reported."""
    most_blur: float = 0.5
    """Standard deviation of the blur of its edges, relative to the thickness, above which a cartilage is reported:
    the two edges of a layer merge."""


KNEE_CARTILAGE_DEFAULTS = KneeCartilageSettings()
"""Default settings for finding all cartilages of a knee."""


@dataclass(frozen=True, eq=False, kw_only=True)
class KneeTemplate:
    """Bones of a normal knee, and how thick the cartilage is on them."""

    bones: Mapping[str, TriangleSurface]
    thickness_mm: Mapping[str, Floats]
    """(V,) of each bone's vertices, 0 where it is bare."""
    unusable: Mapping[str, str] = field(default_factory=dict)
    """Bones whose cartilage cannot be used, to the reason."""


@dataclass(frozen=True, eq=False, kw_only=True)
class KneeCartilage:
    """The cartilage of a knee, by the bone's name."""

    sheets: Mapping[str, CartilageSheet]
    rigid: Mapping[str, RigidRegistration]
    elastic: Mapping[str, ElasticRegistration]
    missing: Mapping[str, str]
    """Bones whose cartilage is in the template but was not found, to the reason."""
    notes: tuple[str, ...]
    """What a user should know, as sentences."""


def knee_template(surfaces: Mapping[str, TriangleSurface], *, mirror: bool = False) -> KneeTemplate:
    """Make a template of the surfaces of bones and cartilages.

    Args:
        surfaces: Surfaces by the names of `structures.LABELS`; a bone without cartilage is left out.
        mirror: Whether the template is of the other side than the subject.

    Raises:
        MareyError: No bone comes with its cartilage.
    """
    sided = {name: mirrored(surface) if mirror else surface for name, surface in surfaces.items()}
    covered = [bone for bone in BONES if CARTILAGE_OF_BONE[bone] in sided]
    if not any(bone in sided for bone in covered):
        raise MareyError("The template has no bone together with its cartilage.")
    thickness, unusable = {}, {}
    for bone in covered:
        if bone not in sided:
            unusable[bone] = f"The template has no {bone} under it."
            continue
        try:
            thickness[bone] = cartilage_thickness(sided[bone], [sided[CARTILAGE_OF_BONE[bone]]])
        except MareyError as problem:
            unusable[bone] = f"In the template: {problem}"
    return KneeTemplate(bones={bone: sided[bone] for bone in thickness}, thickness_mm=thickness, unusable=unusable)


def find_knee_cartilage(
    volumes: Sequence[Volume],
    bones: Mapping[str, TriangleSurface],
    template: KneeTemplate,
    starts: Mapping[str, RigidTransform] | None = None,
    done: Callable[[float], None] = lambda share: None,
    *,
    settings: KneeCartilageSettings = KNEE_CARTILAGE_DEFAULTS,
) -> KneeCartilage:
    """Find the cartilage on each bone that is also in the template.

    Args:
        volumes: The image, or several in the same place.
        bones: Surfaces of the subject's bones by name.
        template: Template of the same side.
        starts: Bone to its approximate subject_from_template; found if not given.
        done: Called with the share of the work that is done.
        settings: Tuned constants of the algorithm.

    Raises:
        MareyError: No bone is in both.

    Returns:
        A bone whose cartilage fails, or is not visible in the image, is in `missing`; the others are kept.
    """
    missing = dict(template.unusable)
    missing |= {bone: f"The {bone} was not found." for bone in template.bones if bone not in bones}
    both = [bone for bone in BONES if bone in bones and bone in template.bones]
    if not both and not template.unusable:
        raise MareyError("The template and the image have no bone in common.")
    steps = len(both) * (2 + settings.passes)
    registered: dict[str, _RegisteredBone] = {}
    for n, bone in enumerate(both):
        start, report = (starts or {}).get(bone), partial(_report_part, done, n, steps)
        try:
            registered[bone] = _registered(template, bone, bones[bone], start, report, settings)
        except MareyError as problem:
            missing[bone] = str(problem)
    report_pass = partial(_report_pass, done, settings.passes)
    sheets = _found_sheets(volumes, bones, registered, missing, report_pass, settings=settings)
    for bone in list(sheets):
        if (reason := _why_invisible(sheets[bone], settings=settings)) is not None:
            missing[bone] = reason
    sheets = {bone: sheet for bone, sheet in sheets.items() if bone not in missing}
    elastic = {bone: each.elastic for bone, each in registered.items()}
    return KneeCartilage(
        sheets=sheets, missing=missing, rigid={bone: each.rigid for bone, each in registered.items()}, elastic=elastic,
        notes=_notes(sheets, elastic, settings=settings),
    )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class _RegisteredBone:
    """A template's bone, registered to the subject's."""

    rigid: RigidRegistration
    elastic: ElasticRegistration
    prediction: CartilagePrediction


def _found_sheets(
    volumes: Sequence[Volume],
    bones: Mapping[str, TriangleSurface],
    registered: Mapping[str, _RegisteredBone],
    missing: dict[str, str],
    done: Callable[[float], None],
    *,
    settings: KneeCartilageSettings,
) -> dict[str, CartilageSheet]:
    """Find the cartilage of each registered bone in several passes; `missing` receives the reasons of failures.

    `done` is called with the share of these passes that is finished.
    """
    sheets: dict[str, CartilageSheet] = {}
    # A bone that is not in the template still limits the cartilage of the others.
    thickness: dict[str, Floats] = {bone: np.zeros(len(surface.vertices_mm)) for bone, surface in bones.items()}
    thickness |= {bone: _predicted_thickness(each.prediction, settings=settings) for bone, each in registered.items()}
    inner = dict(bones)
    for turn in range(settings.passes):
        for n, bone in enumerate(registered):
            if bone not in missing:
                others = [(inner[other], thickness[other]) for other in bones if other != bone]
                try:
                    sheets[bone] = find_cartilage(
                        volumes, bones[bone], registered[bone].prediction, others, sheets.get(bone),
                        settings=settings.outer_surface,
                    )  # fmt: skip
                except MareyError as problem:
                    missing[bone] = str(problem)
            done((turn + (n + 1) / len(registered)) / settings.passes)
        # The prediction, not the result, which depends on this sharing where cartilages touch.
        inner |= {bone: sheet.bone for bone, sheet in sheets.items()}
        thickness |= {bone: np.asarray(sheet.predicted_mm) for bone, sheet in sheets.items()}
    return sheets


def _report_part(done: Callable[[float], None], n: int, steps: int, part: float) -> None:
    done((2 * n + part) / steps)


def _report_pass(done: Callable[[float], None], passes: int, share: float) -> None:
    """Report the finished share of all work, of which the registration of the bones is as much as two passes."""
    done((2 + passes * share) / (2 + passes))


def _registered(
    template: KneeTemplate,
    name: str,
    bone: TriangleSurface,
    start: RigidTransform | None,
    done: Callable[[float], None],
    settings: KneeCartilageSettings,
) -> _RegisteredBone:
    model = template.bones[name]
    rigid = register_rigidly(model, bone, start, settings=settings.rigid)
    moved = TriangleSurface(vertices_mm=rigid.subject_from_template.apply(model.vertices_mm), faces=model.faces)
    done(1)
    elastic = register_elastically(moved, bone, settings.elastic)
    prediction = predict_cartilage(bone, moved, template.thickness_mm[name], elastic.deformation)
    done(2)
    return _RegisteredBone(rigid=rigid, elastic=elastic, prediction=prediction)


def seen_share(sheet: CartilageSheet) -> float:
    """Return the share of the covered vertices at which the image determines the thickness more than the template."""
    return float((np.asarray(sheet.by_image)[sheet.thickness_mm > 0] > 0.5).mean())


def _why_invisible(sheet: CartilageSheet, *, settings: KneeCartilageSettings) -> str | None:
    """Return why a sheet does not show the image's cartilage; None where it does."""
    if not (sheet.thickness_mm > 0).any():
        return "The image shows no cartilage where the template has it."
    if (seen := seen_share(sheet)) >= settings.least_seen:
        return None
    blur = np.nanmedian(np.asarray(sheet.blur_mm))
    return (
        f"Over {100 * (1 - seen):.0f} % of the cartilage, its thickness depends more on the template than on the "
        f"image: its outer edge is not visible there. An edge is blurred by {blur:.1f} mm (standard deviation) along "
        "the bone's normals; thinner slices, or another contrast, would show it."
    )


def _predicted_thickness(prediction: CartilagePrediction, *, settings: KneeCartilageSettings) -> Floats:
    return np.where(prediction.presence > settings.sure, np.nan_to_num(prediction.thickness_mm), 0.0)


def _notes(
    sheets: Mapping[str, CartilageSheet], elastic: Mapping[str, ElasticRegistration], *, settings: KneeCartilageSettings
) -> tuple[str, ...]:
    notes = []
    for bone, sheet in sheets.items():
        name = CARTILAGE_OF_BONE[bone].replace("_", " ")
        if (unsure := float((sheet.confidence[sheet.thickness_mm > 0] < settings.sure).mean())) > 0.3:
            notes.append(f"The {name}'s outer surface is uncertain over {100 * unsure:.0f} % of it.")
        shared = float(np.isfinite(np.asarray(sheet.shared_mm))[sheet.thickness_mm > 0].mean())
        if shared > settings.much_shared:
            notes.append(
                f"Over {100 * shared:.0f} % of the {name}, another cartilage touches it without a visible edge: there "
                "the sum of both is measured, and the template divides it."
            )
        ratio = float(
            np.nanmedian(np.asarray(sheet.blur_mm) / np.where(sheet.thickness_mm > 0, sheet.thickness_mm, np.nan))
        )
        if ratio > settings.most_blur:
            notes.append(
                f"The {name}'s edges are blurred by {100 * ratio:.0f} % of its thickness (standard deviation): the "
                "voxels are too thick for it, and its thickness is uncertain."
            )
        if elastic[bone].surface_distance_mm > 1.0:
            far = elastic[bone].surface_distance_mm
            notes.append(
                f"The template's {bone} could be deformed only to a mean distance of {far:.1f} mm from the bone."
            )
    return tuple(notes)

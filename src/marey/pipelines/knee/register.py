"""`marey knee register`: a template's bone laid on a subject's, first as it is and then bent."""

from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from marey.errors import FileProblem, MareyError
from marey.io.mr.meshes import write_mesh
from marey.io.mr.tables import write_rigid
from marey.knee.registration.elastic import ElasticRegistration, register_elastically
from marey.knee.registration.rigid import RigidRegistration
from marey.knee.registration.sided import SidedRegistration, register_on_either_side
from marey.knee.space.mesh_repair import joined
from marey.knee.space.sides import MIRROR, mirrored
from marey.knee.space.surface import Surface
from marey.knee.space.triangle_tree import TriangleTree
from marey.pipelines.knee.meshes import read_bone
from marey.pipelines.progress import Progress
from marey.pipelines.run_record import StageCache

_COUNTERPART_MM, _MOST_WITHOUT = 3.0, 0.1
"""So far off a bent template has nothing to lie on; the share of it at which that is said."""
_ALIKE_MM = 0.7
"""Mean distance of bent bones that is too much for the same bone of two people: docs/accuracy.md has 0.23 to 0.45."""


def register(template: Path, subject: Path, out: Path | None, *, mirror: bool | None, progress: Progress) -> Path:
    """Register two bones and write `rigid.json` and `registered.ply`.

    Args:
        template: A mesh.
        subject: A mesh of the same bone.
        out: The folder; `SUBJECT_marey` beside the subject when None.
        mirror: Whether the template is of the other side; None finds it out.
        progress: Is told.

    Returns:
        The folder.

    Raises:
        FileProblem: A mesh cannot be used, or they do not fit each other.
    """
    out = out or subject.with_name(f"{subject.stem}_marey")
    model, person = read_bone(template, progress), joined(read_bone(subject, progress))
    # Made before the work: a folder that cannot be written to is told at once.
    cache = StageCache(out, [])
    try:
        return _registered(model, person, template, subject, out, mirror=mirror, progress=progress)
    finally:
        cache.clear()


def _registered(
    model: Surface, person: Surface, template: Path, subject: Path, out: Path, *, mirror: bool | None,
    progress: Progress,
) -> Path:  # fmt: skip
    """Register, tell and write."""
    try:
        with threadpool_limits(1):
            with progress.stage_of_shares("Laying the template on the bone") as done:
                sided = register_on_either_side(joined(model), person, mirror=mirror, done=done)
            _say_side(sided, mirror, progress)
            side = mirrored(model) if sided.mirrored else model
            laid = Surface(vertices_mm=sided.rigid.subject_from_template.apply(side.vertices_mm), faces=side.faces)
            with progress.stage_of_shares("Bending it") as done:
                elastic = register_elastically(joined(laid), person, done=done)
    except MareyError as error:
        text = str(error).rstrip(".")
        remedy = "" if mirror is None else "Without --mirror and --no-mirror both sides are tried."
        raise FileProblem(template, f"does not fit {subject.name}: {text[0].lower() + text[1:]}", remedy) from error
    _say_doubt(elastic, person, template, subject, progress)
    matrix = sided.rigid.subject_from_template.matrix @ (MIRROR if sided.mirrored else np.eye(4))
    write_rigid(out / "rigid.json", matrix, _about(sided, elastic))
    write_mesh(out / "registered.ply", elastic.deformation.subject_surface(laid))
    progress.report(_summary(sided.rigid, elastic))
    return out


def _say_doubt(
    elastic: ElasticRegistration, person: Surface, template: Path, subject: Path, progress: Progress
) -> None:  # fmt: skip
    """Tell where the template has no counterpart, and that two bones do not become alike."""
    bent = elastic.registered
    off = TriangleTree.of(person).nearest(bent.vertices_mm).distance_mm
    areas = bent.vertex_areas_mm2
    share = float(areas[off > _COUNTERPART_MM].sum() / areas.sum())
    if share > _MOST_WITHOUT:
        progress.warn(
            f"{100 * share:.0f} % of {template.name} still lies more than {_COUNTERPART_MM:g} mm from {subject.name}: "
            "there it has no counterpart, and its place is a guess."
        )
    if elastic.surface_distance_mm > _ALIKE_MM:
        progress.warn(
            f"Bent, {template.name} still lies {elastic.surface_distance_mm:.2f} mm from {subject.name} on average; "
            "the same bone of two people comes to 0.2 to 0.5 mm. Is it the same bone, and as much of it?"
        )


def _say_side(sided: SidedRegistration, mirror: bool | None, progress: Progress) -> None:
    """Tell which side the template is of, and by what."""
    if mirror is not None:
        return
    text = (
        f"The template is of the {'other' if sided.mirrored else 'same'} side: scaled to the bone it lies "
        f"{sided.same_side_mm:.2f} mm off as it is, {sided.other_side_mm:.2f} mm mirrored."
    )
    if sided.clear:
        progress.report(text)
    else:
        force = "--no-mirror" if sided.mirrored else "--mirror"
        progress.warn(f"{text} That is little of a difference; where you know better, say {force}.")


def _about(sided: SidedRegistration, elastic: ElasticRegistration) -> dict[str, object]:
    rigid = sided.rigid
    tried = {"same_side_mm": sided.same_side_mm, "other_side_mm": sided.other_side_mm}
    return {
        "unit": "mm",
        "mirrored": sided.mirrored,
        "side_clear": sided.clear,
        **{key: value for key, value in tried.items() if np.isfinite(value)},
        "sd_deg": rigid.turn_sd_deg.tolist(),
        "sd_mm": rigid.translation_sd_mm.tolist(),
        "residual_mm": rigid.residual_mm,
        "share_used": rigid.used,
        "rigid_surface_distance_mm": rigid.surface_distance_mm,
        "elastic_surface_distance_mm": elastic.surface_distance_mm,
        "elastic_surface_distance_95_mm": elastic.farthest_mm,
        "least_jacobian_determinant": elastic.least_determinant,
    }


def _summary(rigid: RigidRegistration, elastic: ElasticRegistration) -> str:
    turn, shift = rigid.turn_sd_deg.max(), rigid.translation_sd_mm.max()
    return (
        f"Rigid: {rigid.surface_distance_mm:.2f} mm from the bone on average, known to {turn:.2g} degrees and "
        f"{shift:.2g} mm. Bent: {elastic.surface_distance_mm:.2f} mm (95 % within {elastic.farthest_mm:.2f} mm), no "
        f"folds (least Jacobian {elastic.least_determinant:.2f})."
    )

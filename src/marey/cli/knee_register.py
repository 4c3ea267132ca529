"""`marey knee register`: a template's bone laid on a subject's, first as it is and then bent."""

from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from marey.cli.knee_meshes import read_bone
from marey.cli.progress import Progress
from marey.errors import FileProblem, MareyError
from marey.io.meshes import write_mesh
from marey.io.registration import write_rigid
from marey.knee.elastic_registration import ElasticRegistration, register_elastically
from marey.knee.mesh_mending import joined
from marey.knee.rigid_registration import RigidRegistration
from marey.knee.sided_registration import SidedRegistration, register_on_either_side
from marey.knee.sides import MIRROR, mirrored
from marey.knee.surface import Surface


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
    matrix = sided.rigid.subject_from_template.matrix @ (MIRROR if sided.mirrored else np.eye(4))
    write_rigid(out / "rigid.json", matrix, _about(sided, elastic))
    write_mesh(out / "registered.ply", elastic.deformation.subject_surface(laid))
    progress.say(_summary(sided.rigid, elastic))
    return out


def _say_side(sided: SidedRegistration, mirror: bool | None, progress: Progress) -> None:
    """Tell which side the template is of, and by what."""
    if mirror is not None:
        return
    text = (
        f"The template is of the {'other' if sided.mirrored else 'same'} side: scaled to the bone it lies "
        f"{sided.same_side_mm:.2f} mm off as it is, {sided.other_side_mm:.2f} mm mirrored."
    )
    if sided.clear:
        progress.say(text)
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

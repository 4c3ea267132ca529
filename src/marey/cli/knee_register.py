"""`marey knee register`: a template's bone laid on a subject's, first as it is and then bent."""

from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from marey.cli.progress import Progress
from marey.errors import FileProblem, MareyError
from marey.io.meshes import read_mesh, write_mesh
from marey.io.registration import write_rigid
from marey.knee.elastic_registration import ElasticRegistration, register_elastically
from marey.knee.rigid_registration import RigidRegistration, register_rigidly
from marey.knee.sides import MIRROR, mirrored
from marey.knee.surface import Surface


def register(template: Path, subject: Path, out: Path | None, *, mirror: bool, progress: Progress) -> Path:
    """Register two bones and write `rigid.json` and `registered.ply`.

    Args:
        template: A mesh.
        subject: A mesh of the same bone.
        out: The folder; `SUBJECT_marey` beside the subject when None.
        mirror: The template is of the other side.
        progress: Is told.

    Returns:
        The folder.

    Raises:
        FileProblem: A mesh cannot be used, or they do not fit each other.
    """
    out = out or subject.with_name(f"{subject.stem}_marey")
    model, person = read_mesh(template), read_mesh(subject)
    side = mirrored(model) if mirror else model
    try:
        with threadpool_limits(1):
            rigid = _rigid(side, person, progress)
            laid = Surface(vertices_mm=rigid.subject_from_template.apply(side.vertices_mm), faces=side.faces)
            elastic = _elastic(laid, person, progress)
    except FileProblem:
        raise
    except MareyError as error:
        text = str(error).rstrip(".")
        remedy = "" if mirror else "With --mirror a template of the other side is mirrored first."
        raise FileProblem(template, f"does not fit {subject.name}: {text[0].lower() + text[1:]}", remedy) from error
    matrix = rigid.subject_from_template.matrix @ (MIRROR if mirror else np.eye(4))
    write_rigid(out / "rigid.json", matrix, _about(rigid, elastic, mirror))
    write_mesh(out / "registered.ply", elastic.registered)
    progress.say(_summary(rigid, elastic))
    return out


def _rigid(template: Surface, subject: Surface, progress: Progress) -> RigidRegistration:
    with progress.stage_of_shares("Laying the template on the bone") as done:
        return register_rigidly(template, subject, done=done)


def _elastic(template: Surface, subject: Surface, progress: Progress) -> ElasticRegistration:
    with progress.stage_of_shares("Bending it") as done:
        return register_elastically(template, subject, done=done)


def _about(rigid: RigidRegistration, elastic: ElasticRegistration, mirror: bool) -> dict[str, object]:
    return {
        "unit": "mm",
        "mirrored": mirror,
        "turn_sd_deg": rigid.turn_sd_deg.tolist(),
        "translation_sd_mm": rigid.translation_sd_mm.tolist(),
        "residual_mm": rigid.residual_mm,
        "share_used": rigid.used,
        "rigid_surface_distance_mm": rigid.surface_distance_mm,
        "elastic_surface_distance_mm": elastic.surface_distance_mm,
        "elastic_surface_distance_95_mm": elastic.farthest_mm,
        "least_jacobian_determinant": elastic.least_determinant,
    }


def _summary(rigid: RigidRegistration, elastic: ElasticRegistration) -> str:
    return (
        f"Rigid: {rigid.surface_distance_mm:.2f} mm from the bone on average. Bent: {elastic.surface_distance_mm:.2f} "
        f"mm (95 % within {elastic.farthest_mm:.2f} mm), no folds (least Jacobian {elastic.least_determinant:.2f})."
    )

"""Registration of a template's bone with a subject's: rigid, and then elastic."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.errors import MareyError
from marey.io.mr.meshes import write_mesh
from marey.io.mr.tables import write_rigid
from marey.knee.registration.elastic import ElasticRegistration, register_elastically
from marey.knee.registration.sided import SidedRegistration, register_on_either_side
from marey.knee.space.mesh_repair import joined
from marey.knee.space.sides import MIRROR, mirrored
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.triangle_tree import TriangleTree
from marey.pipelines.causes.bone_registration import side_reasons, tried_text, unit_reasons
from marey.pipelines.knee.meshes import read_bone
from marey.pipelines.labelled import Described, Summary
from marey.pipelines.progress import Progress, RecordingProgress
from marey.pipelines.run_record import finished_together, write_record
from marey.pipelines.values import PathLike
from marey.pipelines.verdict import NotUsable, Verdict, VerdictReason

_COUNTERPART_MM = 3.0
"""Distance beyond which a vertex of the deformed template has no counterpart on the subject [mm].

Chosen by hand; results were not measured against other values.
"""
_MOST_WITHOUT = 0.1
"""Share of the template's area without a counterpart above which there is a warning. Chosen by hand."""
_ALIKE_MM = 0.7
"""Mean distance after elastic registration above which two bones are probably not the same bone of two people [mm].

The accuracy pages have 0.23 to 0.45 mm for the same bone.
"""


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class RegisteredBone(Described):
    """A template's bone on a subject's."""

    sided: SidedRegistration
    """Rigid registration, with the side of the template."""
    elastic: ElasticRegistration
    """Elastic registration."""
    surface: TriangleSurface
    """The deformed template on the subject, with the vertices of the template in their order, LPS [mm]."""
    inputs: tuple[Path, ...] = ()
    """The files of the template's and the subject's bone."""
    verdict: Verdict = field(default_factory=Verdict)
    """How far the registration can be used, and what limits it."""

    @property
    def subject_from_template(self) -> Floats:
        """(4, 4) homogeneous matrix of the rigid registration [mm]; it mirrors a template of the other side."""
        matrix = self.sided.rigid.subject_from_template.matrix
        return np.asarray(matrix @ (MIRROR if self.sided.mirrored else np.eye(4)))

    def summary(self) -> Summary:
        """Return the distances between the bones, and the standard deviations of the rigid registration."""
        rigid, elastic = self.sided.rigid, self.elastic
        turn, shift = rigid.turn_sd_deg.max(), rigid.translation_sd_mm.max()
        lines = {
            "rigid": f"mean distance {rigid.surface_distance_mm:.2f} mm, standard deviation {turn:.2g} degrees and "
            f"{shift:.2g} mm",
            "elastic": f"mean distance {elastic.surface_distance_mm:.2f} mm, 95 % within {elastic.farthest_mm:.2f} mm, "
            f"no folds (least Jacobian determinant {elastic.least_determinant:.2f})",
        }
        return Summary("Registered bone", lines)

    def save(self, folder: Path | str) -> Path:
        """Write `rigid.json`, `registered.ply` and `run.json`.

        Args:
            folder: Folder for the files; it is created if it does not exist.

        Returns:
            The folder.
        """
        out = Path(folder)
        with finished_together(out, inputs=self.inputs) as staging:
            write_rigid(staging / "rigid.json", self.subject_from_template, _about(self.sided, self.elastic))
            write_mesh(staging / "registered.ply", self.surface)
            write_record(
                staging, command="knee register", settings={"mirrored": self.sided.mirrored}, inputs=self.inputs,
                root=Path.cwd(), progress=RecordingProgress(), verdict=self.verdict,
            )  # fmt: skip
        return out


def register_bone(
    template: PathLike, subject: PathLike, *, mirror: bool | None = None, progress: Progress | None = None
) -> RegisteredBone:
    """Register the bone of a template with the same bone of a subject.

    Args:
        template: A mesh.
        subject: A mesh of the same bone.
        mirror: Whether the template is of the other side; None tries both.
        progress: Progress reporter.

    Raises:
        FileProblem: A mesh cannot be used.
        NotUsable: The bones do not fit each other; if a unit or the side explains it, that is named.
    """
    progress = progress or RecordingProgress()
    template, subject = Path(template), Path(subject)
    model, person = read_bone(template, progress), joined(read_bone(subject, progress))
    try:
        with progress.stage_of_shares("Rigid registration") as done:
            sided = register_on_either_side(joined(model), person, mirror=mirror, done=done)
        _report_side(sided, mirror, progress)
        side = mirrored(model) if sided.mirrored else model
        moved = TriangleSurface(vertices_mm=sided.rigid.subject_from_template.apply(side.vertices_mm), faces=side.faces)
        with progress.stage_of_shares("Elastic registration") as done:
            elastic = register_elastically(joined(moved), person, done=done)
    except MareyError as error:
        causes = unit_reasons(joined(model), person, None) or side_reasons(joined(model), person, mirror, fits=False)
        if causes:
            raise NotUsable(Verdict.of(causes)) from error
        text = str(error).rstrip(".")
        remedy = "" if mirror is None else "Both sides are tried without mirror (--mirror or --no-mirror)."
        what = f"{template.name} does not fit {subject.name}: {text[0].lower() + text[1:]}."
        raise NotUsable(Verdict.of([VerdictReason.failure(what, remedy, cause="misfit")])) from error
    reasons = [*_unclear_side(sided, mirror), *_without_counterpart(elastic, person, template, subject)]
    fits = elastic.surface_distance_mm <= _ALIKE_MM
    causes = side_reasons(joined(model), person, mirror, fits=fits)
    if not fits:
        causes = causes or unit_reasons(joined(model), person, sided) or _unlike(elastic, sided, template, subject)
    reasons += causes
    for reason in reasons:
        progress.warn(str(reason))
    return RegisteredBone(
        sided=sided, elastic=elastic, surface=elastic.deformation.subject_surface(moved), inputs=(template, subject),
        verdict=Verdict.of(reasons),
    )  # fmt: skip


def _without_counterpart(
    elastic: ElasticRegistration, person: TriangleSurface, template: Path, subject: Path
) -> Iterator[VerdictReason]:
    """Name parts of the template without a counterpart."""
    bent = elastic.registered
    off = TriangleTree.of(person).nearest(bent.vertices_mm).distance_mm
    areas = bent.vertex_areas_mm2
    share = float(areas[off > _COUNTERPART_MM].sum() / areas.sum())
    if share > _MOST_WITHOUT:
        yield VerdictReason.limit(
            f"{100 * share:.0f} % of {template.name} is still more than {_COUNTERPART_MM:g} mm from {subject.name}: "
            "this part has no counterpart, and its position is an extrapolation."
        )


def _unlike(
    elastic: ElasticRegistration, sided: SidedRegistration, template: Path, subject: Path
) -> tuple[VerdictReason, ...]:
    """Name two bones that remain different, with what was tried."""
    what = (
        f"After elastic registration, {template.name} is still {elastic.surface_distance_mm:.2f} mm from "
        f"{subject.name} on average; typical values are 0.2 to 0.5 mm. {tried_text(sided)}"
    )
    remedy = "Check that it is the same part of the same bone."
    return (VerdictReason.failure(what, remedy, cause="unexplained"),)


def _report_side(sided: SidedRegistration, mirror: bool | None, progress: Progress) -> None:
    """Report the side of the template, with the evidence for it."""
    if mirror is None and sided.clear:
        progress.report(_side_text(sided))


def _unclear_side(sided: SidedRegistration, mirror: bool | None) -> Iterator[VerdictReason]:
    """Name a side of the template for which there is little evidence."""
    if mirror is None and not sided.clear:
        force = "mirror=False (--no-mirror)" if sided.mirrored else "mirror=True (--mirror)"
        yield VerdictReason.limit(f"{_side_text(sided)} The difference is small.", f"If it is wrong, give {force}.")


def _side_text(sided: SidedRegistration) -> str:
    return (
        f"The template is of the {'other' if sided.mirrored else 'same'} side: its distance, scaled to the bone, is "
        f"{sided.same_side_mm:.2f} mm unchanged and {sided.other_side_mm:.2f} mm mirrored."
    )


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

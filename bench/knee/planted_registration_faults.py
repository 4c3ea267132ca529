"""Faults planted into bones that `marey knee register` is given: whether they are named, and sound bones as nothing.

The templates are every person's femur, tibia and patella in turn, and the subject is the next person with this bone.
`sound`: nothing is wrong, with the side found and with the side given; no cause may be named, and nothing may be called
not usable. `planted`: the template in another unit, its side given wrongly, and another bone of the template's person.
A fault counts as `named` if a reason has its cause; of the others, `not usable` counts those whose result is called not
usable, `limits` those that are usable with limits, and `silent` those of which nothing is stated. Another bone has no
cause that could be repaired, and `not usable` is right. A length that no bone of the knee has is an error of the
reader, which names the unit.
"""

import argparse
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from bench.common.parts import add_parts, run_parts
from bench.declaration import Bench
from bench.knee.registration import LEFT, PEOPLE, surface_of
from bench.recording import Column, Run
from marey.errors import FileProblem
from marey.io.mr.meshes import write_mesh
from marey.knee.space.surface import TriangleSurface
from marey.pipelines.knee.register import register_bone
from marey.pipelines.verdict import NotUsable, Verdict, VerdictReason

BENCH = Bench(
    measures="Faults planted into bones that are registered: named, and sound bones in which nothing is named.",
    sources=(
        "src/marey/knee/registration", "src/marey/pipelines/knee/register.py",
        "src/marey/pipelines/causes/bone_registration.py", "bench/knee/registration.py",
    ),
    minutes=20,
)  # fmt: skip
UNITS = (0.001, 0.01, 0.1, 10.0, 100.0, 1000.0)
"""Factors of the template's coordinates."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Pair:
    """A template and a subject with the same bone."""

    bone: str
    template: str
    subject: str

    @property
    def name(self) -> str:
        """The bone, and who gave it."""
        return f"{self.bone}, {self.template} to {self.subject}"

    @property
    def mirror(self) -> bool:
        """Whether the template is of the other side."""
        return (self.template in LEFT) != (self.subject in LEFT)


def pairs(run: Run) -> Iterator[Pair]:
    """Yield every person's bone with the next person's; one bone's only if it is chosen."""
    for bone, names in PEOPLE.items():
        if run.arguments.bone not in (None, bone):
            continue
        for template, subject in zip(names, (*names[1:], names[0]), strict=True):
            yield Pair(bone=bone, template=template, subject=subject)


def mesh_of(run: Run, name: str, bone: str, factor: float = 1.0) -> Path:
    """Return a mesh of a person's bone, with its coordinates multiplied by a factor."""
    path = run.out / "meshes" / f"{name}-{bone}-{factor:g}.ply"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        bone_surface = surface_of(run.shared, name, bone)
        surface = TriangleSurface(vertices_mm=bone_surface.vertices_mm * factor, faces=bone_surface.faces)
        write_mesh(path, surface)
    return path


def verdict_of(template: Path, subject: Path, mirror: bool | None = None) -> Verdict:
    """Register two bones, and return the verdict; an error of the reader that names the unit has that cause."""
    try:
        return register_bone(template, subject, mirror=mirror).verdict
    except NotUsable as problem:
        return problem.verdict
    except FileProblem as problem:
        cause = "unit" if "should be in millimetres" in str(problem) else "another"
        return Verdict.of([VerdictReason.failure(str(problem), "", cause=cause)])


def judged(verdict: Verdict, cause: str) -> str:
    """Return how a fault is stated: `named`, `another`, `not usable`, `limits` or `silent`."""
    causes = [reason.cause for reason in verdict.reasons if reason.cause]
    if cause in causes:
        return "named"
    if set(causes) & {"unit", "sides"}:
        return "another"
    return {"not usable": "not usable", "usable with limits": "limits"}.get(verdict.level, "silent")


def sound(run: Run) -> None:
    """Register bones in which nothing is wrong."""
    table = run.table(
        "Sound bones", "bone, template and subject", Column("side found: verdict"), Column("side given: verdict"),
        Column("causes named"),
    )  # fmt: skip
    for pair in pairs(run):
        meshes = mesh_of(run, pair.template, pair.bone), mesh_of(run, pair.subject, pair.bone)
        verdicts = [verdict_of(*meshes, mirror) for mirror in (None, pair.mirror)]
        causes = {reason.cause for verdict in verdicts for reason in verdict.reasons if reason.cause}
        table.row(pair.name, *(verdict.level for verdict in verdicts), ", ".join(sorted(causes)) or "none")


def planted(run: Run) -> None:
    """Plant the faults."""
    table = run.table(
        "Planted faults", "fault", Column("planted"), Column("named"), Column("another one named"),
        Column("not usable"), Column("with a limit"), Column("silent"),
    )  # fmt: skip
    counts: dict[str, Counter[str]] = {}
    for number, pair in enumerate(pairs(run)):
        subject = mesh_of(run, pair.subject, pair.bone)
        own = mesh_of(run, pair.template, pair.bone)
        for factor in (UNITS[number % len(UNITS)], UNITS[(number + 2) % len(UNITS)]):
            verdict = verdict_of(mesh_of(run, pair.template, pair.bone, factor), subject)
            counts.setdefault("unit of the template", Counter())[judged(verdict, "unit")] += 1
        counts.setdefault("side given wrongly", Counter())[
            judged(verdict_of(own, subject, not pair.mirror), "sides")
        ] += 1
        for bone, names in PEOPLE.items():
            if bone != pair.bone and pair.template in names:
                verdict = verdict_of(mesh_of(run, pair.template, bone), subject)
                counts.setdefault(f"{bone} for a {pair.bone}", Counter())[judged(verdict, "")] += 1
    for name, each in sorted(counts.items()):
        kinds = ("named", "another", "not usable", "limits", "silent")
        table.row(name, sum(each.values()), *(each[kind] for kind in kinds))


PARTS = {"sound": sound, "planted": planted}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_parts(parser, PARTS)
    parser.add_argument("--bone", choices=[*PEOPLE], help="all without one")


def run(run: Run) -> None:
    """Run the parts."""
    run_parts(run, PARTS)

"""`marey export --to opensim`: the user's own OpenSim model, scaled to the person of a recording."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

from marey.body.articulation.jointed_body import JointedBody
from marey.body.articulation.model_points import segment_body
from marey.body.articulation.model_scaling import (
    BodyScale,
    body_scales,
    masses_by_group,
    model_joints,
    scaled_to,
)
from marey.errors import FileProblem, MareyError, SettingProblem
from marey.io.devices.results import read_device_clock
from marey.io.documents import read_tables
from marey.io.opensim.osim_model import model_in, read_osim
from marey.io.opensim.osim_scaling import body_masses, scale_osim
from marey.io.opensim.scale_files import ScaleReport, write_scale_report, write_scaled_osim
from marey.io.opensim.tool_setups import add_markers
from marey.pipelines.exchange.opensim_forces import (
    GroundForces,
    ground_forces,
    has_force_plates,
    write_ground_forces,
)
from marey.pipelines.exchange.opensim_person import OpenSimPerson, person_of
from marey.pipelines.exchange.opensim_tools import measured_span, tool_inputs, write_tool_inputs
from marey.pipelines.progress import Progress
from marey.pipelines.run_record import finished_together, write_record

SCALED, REPORT = "scaled.osim", "scale.json"
"""Names of the scaled model and of its scale factors."""
_LIGHTEST_KG, _HEAVIEST_KG = 1.0, 400.0
"""Limits of the mass of a person, as in `trial.toml` [kg]."""


@dataclass(frozen=True, kw_only=True)
class OpenSimOptions:
    """What is given beside the results."""

    model: Path
    """The user's model."""
    joints: Path | None = None
    """TOML with the joints of the model at our joint centres."""
    mass_kg: float | None = None
    """Mass of the person [kg]; None for that of the results."""
    forces: Path | None = None
    """C3D with force plates; None for the C3D of a marker trial, if it has any."""
    clock: Path | None = None
    """The clock of `forces`, as `marey device` wrote it; None if it is that of the results."""

    def __post_init__(self) -> None:
        if self.clock is not None and self.forces is None:
            raise SettingProblem("A clock (--clock) belongs to force plates of another file (--forces).")
        if self.mass_kg is not None and not _LIGHTEST_KG < self.mass_kg < _HEAVIEST_KG:
            raise SettingProblem(
                f"The mass is {self.mass_kg:g} kg and should be between {_LIGHTEST_KG:g} and {_HEAVIEST_KG:g}."
            )

    @property
    def inputs(self) -> list[Path]:
        """The files that are read."""
        return [path for path in (self.model, self.joints, self.forces, self.clock) if path is not None]


@dataclass(frozen=True, eq=False, kw_only=True)
class ScaledModel:
    """The user's model, scaled to a person."""

    root: Element
    """The document."""
    model: JointedBody
    """Its kinematics."""
    joints: Mapping[str, str]
    """Maps a joint centre to the body that rotates about it."""
    report: ScaleReport
    """Factors and masses with their intervals."""


def export_opensim(results: Path, out: Path, options: OpenSimOptions, progress: Progress) -> Path:
    """Scale an OpenSim model to the person of a recording, and write it with what OpenSim's tools need.

    Args:
        results: Results of `marey capture`, `marey shape` or `marey markers`.
        out: Folder for the files.
        options: The model, and what is known beside the results.
        progress: Progress reporter, which notes what was assumed.

    Returns:
        The scaled model.

    Raises:
        FileProblem: A file cannot be read, or the model has nothing in common with the results.
    """
    root = read_osim(options.model)
    person = person_of(results, mass_kg=options.mass_kg)
    scaled = _scaled(root, options, person)
    forces = _forces(results, options, person)
    for note in (*scaled.report.notes, *(() if forces is None else forces.notes)):
        progress.warn(note)
    inputs = tool_inputs(scaled.model, scaled.joints, person)
    if inputs is None:
        progress.warn("No setup of inverse kinematics: no two frames in succession show the segments of the model.")
    else:
        add_markers(options.model, scaled.root, inputs.points)
        if inputs.assumed:
            progress.warn(
                "The trunk was not measured: in points.trc it is upright and faces where the pelvis faces on average."
            )
    span = None if inputs is None or forces is None else measured_span(inputs, person.events, forces.spans)
    if span is not None:
        progress.warn(f"Every foot on the floor is on a force plate from {span[0]:.2f} to {span[1]:.2f} s.")
    with finished_together(out, inputs=options.inputs) as folder:
        write_scaled_osim(folder / SCALED, scaled.root)
        if inputs is not None:
            write_tool_inputs(folder, inputs, model=SCALED, span=span)
        write_scale_report(folder / REPORT, scaled.report)
        if forces is not None and forces.loads:
            write_ground_forces(folder, forces, _feet(options.model, scaled, forces))
        settings = {"results": results, "to": "opensim", "mass_kg": options.mass_kg}
        write_record(
            folder, command="export", settings=settings, inputs=options.inputs, root=Path.cwd(), progress=progress
        )  # fmt: skip
    return out / SCALED


def _scaled(root: Element, options: OpenSimOptions, person: OpenSimPerson) -> ScaledModel:
    """Scale the model in a document by the joint centres and the mass of the person."""
    path = options.model
    model = model_in(path, root)
    try:
        joints = model_joints(model, _given_joints(options.joints))
    except MareyError as problem:
        raise FileProblem(options.joints or path, str(problem).rstrip("."), "Correct [joints].") from None
    own = body_masses(path, root)
    try:
        scales = body_scales(model, joints, person.joints)
        masses = _masses(model, joints, own, person)
    except MareyError as problem:
        wrong = f"cannot be scaled to the person: {problem}".rstrip(".")
        remedy = 'Name the joints of the model in a TOML, [joints] left_hip = "its name", and give it as --joints.'
        raise FileProblem(path, wrong, remedy) from None
    model = scale_osim(path, root, {scale.body: scale.factors for scale in scales}, masses)
    mass = person.mass
    report = ScaleReport(
        model=path, joints=joints, scales=scales, masses=masses, mass=None if mass is None else mass.mass_kg,
        mass_sd=float("nan") if mass is None else mass.sd,
        mass_source="not known: the masses are those of the given model" if mass is None else mass.source,
        notes=_notes(path, scales, person, joints),
    )  # fmt: skip
    return ScaledModel(root=root, model=model, joints=joints, report=report)


def _forces(results: Path, options: OpenSimOptions, person: OpenSimPerson) -> GroundForces | None:
    """Read the force plates of the given C3D, or of the trial of a marker result if it has any."""
    if options.forces is not None:
        clock = None if options.clock is None else read_device_clock(options.clock)
        return ground_forces(options.forces, person, clock)
    own = results / "motion.c3d"
    if not (results / "bones.npz").is_file() or not has_force_plates(own):
        return None
    known = {"left_foot", "right_foot"} & set(person.motion.segments)
    return ground_forces(own, person) if known else None


def _feet(path: Path, scaled: ScaledModel, forces: GroundForces) -> dict[str, str]:
    """Return the bodies that are the feet, by side."""
    sides = sorted({load.side for load in forces.loads})
    bodies = {side: segment_body(scaled.model, scaled.joints, f"{side}_foot") for side in sides}
    missing = [f"{side}_ankle" for side, body in bodies.items() if body is None]
    if missing:
        wrong = f"has no joint that is recognised as {', '.join(missing)}, so the forces have no body to act on"
        raise FileProblem(path, wrong, "Name it in [joints] (--joints).")
    return {side: body for side, body in bodies.items() if body is not None}


def _given_joints(path: Path | None) -> dict[str, str]:
    """Read the TOML with the joints of the model."""
    if path is None:
        return {}
    tables = read_tables(path)
    joints = tables.get("joints")
    only = set(tables) == {"joints"}
    if not only or not isinstance(joints, dict) or any(not isinstance(joint, str) for joint in joints.values()):
        wrong = "should contain the table [joints] alone, with names as texts"
        raise FileProblem(path, wrong, 'Write [joints] and lines such as left_hip = "hip_l".')
    return dict(joints)


def _masses(
    model: JointedBody, joints: Mapping[str, str], own: Mapping[str, float], person: OpenSimPerson
) -> dict[str, float]:
    """Return the masses of the bodies [kg]: by segment if those are known, else by the total, else unchanged."""
    if person.segment_masses:
        return masses_by_group(model, joints, own, person.segment_masses)
    return dict(own) if person.mass is None else scaled_to(own, person.mass.mass_kg)


def _notes(
    path: Path, scales: Sequence[BodyScale], person: OpenSimPerson, joints: Mapping[str, str]
) -> tuple[str, ...]:
    """Return what was assumed, one sentence each."""
    notes = []
    if person.mass is None:
        notes.append(f"The mass of the person is not known: the masses are those of {path.name}. Give it with --mass.")
    elif person.mass.sd == person.mass.sd:
        low, high = (person.mass.mass_kg + sign * 1.959964 * person.mass.sd for sign in (-1, 1))
        notes.append(
            f"The mass was not given: {person.mass.mass_kg:.1f} kg (95 % interval {low:.0f} to {high:.0f} kg) is "
            f"{person.mass.source}. Give it with --mass."
        )
    missing = sorted(set(person.joints.names) - set(joints) - {"neck", "head"})
    if missing:
        notes.append(f"{path.name} has no joint that is recognised as {', '.join(missing)}.")
    assumed = [scale.body for scale in scales if not scale.measured]
    if assumed:
        notes.append(f"No length was measured for {', '.join(assumed)}; their factors come from other bodies.")
    return tuple(notes)

"""The methods from skin markers to bones on made clusters with exact truth.

`rigid`: markers that do not move over the bones; the largest error of each method. `interval`: skin motion of a known
form. `masses`: when redistributed masses help. `table3`: table 3 of [Alexander2003] with data made as the authors
describe theirs.
"""

import argparse
from collections.abc import Callable

import numpy as np
from tests.skin_clusters import leg_and_bones, placed, problem, smooth_motion, thigh, turns

from bench.common.parts import add_parts, run_parts
from bench.declaration import Bench
from bench.recording import Column, Run
from marey.arrays import Floats
from marey.markers.data.cluster_data import cluster_data
from marey.markers.data.problem import MarkerProblem
from marey.markers.data.rigid_fit import fit_rigid, rigid
from marey.markers.methods.interval_deformation import deform
from marey.markers.methods.methods import METHODS
from marey.markers.methods.point_cluster import point_cluster, point_cluster_masses
from marey.markers.methods.skin_forms import SkinForm
from marey.nonrigid.in_space.factorisation import factorise_points

BENCH = Bench(
    measures="Methods from skin markers to bones on made clusters, against exact truth.",
    sources=("src/marey/markers", "src/marey/motion", "src/marey/geometry", "src/marey/nonrigid"),
    minutes=3,
    data=False,
)
SETS = 20
NOISE_M = 2e-4
SKIN_M = 8e-3
RATE = 100.0


def rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def exact(run: Run) -> None:
    """What each method makes of markers that do not move over the bones."""
    columns = (Column("largest turn error", "rad"), Column("largest origin error", "m"))
    table = run.table("Rigid markers", "method", *columns)
    for entry in METHODS.values():
        leg, bones = leg_and_bones(np.random.default_rng(1), known=[0, 20])
        if entry.missing_requirement(leg):
            table.row(entry.name, None, str(entry.missing_requirement(leg)))
            continue
        motion = entry.run(leg)
        turn = max(turns(motion.bone(name)[0], bone[0]).max() for name, bone in bones.items())
        shift = max(np.abs(motion.bone(name)[1] - bone[1]).max() for name, bone in bones.items())
        table.row(entry.name, f"{turn:.0e}", f"{shift:.0e}")


def own_phases(time: Floats, rng: np.random.Generator, markers: int) -> tuple[Floats, Floats]:
    return np.sin(2 * np.pi * time[:, None] + rng.uniform(0, 2 * np.pi, markers)), np.eye(markers, dtype=bool)


def three_on_bone(time: Floats, rng: np.random.Generator, markers: int) -> tuple[Floats, Floats]:
    moving = np.ones((markers, 2), bool)
    moving[[0, markers // 2, markers - 1]] = False
    return np.stack([np.sin(2 * np.pi * time), np.cos(2 * np.pi * time)], 1), moving


def one_phase(time: Floats, rng: np.random.Generator, markers: int) -> tuple[Floats, Floats]:
    return np.sin(2 * np.pi * time)[:, None], np.ones((markers, 1), bool)


def any_phase(time: Floats, rng: np.random.Generator, markers: int) -> tuple[Floats, Floats]:
    return np.stack([np.sin(2 * np.pi * time), np.cos(2 * np.pi * time)], 1), np.ones((markers, 2), bool)


FORMS: dict[str, Callable[[Floats, np.random.Generator, int], tuple[Floats, Floats]]] = {
    "every marker a sinusoid of its own known phase": own_phases,
    "sinusoids of any phase, three markers known to stand on bone": three_on_bone,
    "all markers one sinusoid of known phase": one_phase,
    "all markers sinusoids of any phase": any_phase,
}


def made(seed: int, form: str, frames: int, markers: int) -> tuple[MarkerProblem, Floats, Floats, SkinForm, Floats]:
    """A cluster whose moving markers move by 8 mm in root mean square over the trial, out of the reference."""
    rng = np.random.default_rng(seed)
    rotation, origin = smooth_motion(rng, frames)
    functions, moving = FORMS[form](np.arange(frames) / RATE, rng, markers)
    vectors = rng.normal(size=(markers, functions.shape[1], 3)) * moving[..., None]
    skin = np.einsum("fk,mki->fmi", functions - functions[0], vectors)
    size = np.sqrt((skin**2).sum(-1).mean(0))
    skin *= SKIN_M / rms(size[size > 0])
    points = placed(rotation, origin, thigh(rng, markers) + skin) + rng.normal(0, NOISE_M, (frames, markers, 3))
    trial = problem({"thigh": (rotation, origin)}, {"thigh": points}, frames=[0], noise_m=NOISE_M)
    return trial, rotation, origin, SkinForm(name=form, functions=functions), moving


LENGTHS = {form: (200,) for form in FORMS} | {"all markers sinusoids of any phase": (200, 400)}


def interval(run: Run, markers: int = 12) -> None:
    """What interval deformation takes away of the rigid fit's error."""
    table = run.table(
        f"Skin motion of 8 mm, noise of 0.2 mm, {markers} markers, {SETS} sets; root mean square",
        ("form, known to the method", "frames"),
        Column("rigid", "deg", 2), Column("interval", "deg", 2), Column("removed", "%", 0), Column("rigid", "mm", 1),
        Column("interval", "mm", 1), Column("stated as not determined"),
    )  # fmt: skip
    for form, lengths in LENGTHS.items():
        for frames in lengths:
            errors, unseen = interval_errors(form, frames, markers)
            before, after = np.degrees(errors[:2])
            table.row((form, str(frames)), before, after, 100 * (1 - after / before), *(1000 * errors[2:]), unseen)


def interval_errors(form: str, frames: int, markers: int) -> tuple[Floats, str]:
    """The turn error of rigid fit and interval deformation [rad], the origin's [m], and what is not seen."""
    errors, unseen = [], ""
    for seed in range(SETS):
        trial, rotation, origin, assumed, moving = made(seed, form, frames, markers)
        data = cluster_data(trial, trial.clusters[0])
        found, plain = deform(data, assumed, NOISE_M, moving=moving, most_frames=None), rigid(trial)
        unseen = ", ".join(found.unobserved) or "nothing"
        turned = [rms(turns(r, rotation)) for r in (plain.rotation[:, 0], found.fit.rotation)]
        shifted = [rms(np.linalg.norm(o - origin, axis=-1)) for o in (plain.origin[:, 0], found.fit.origin)]
        errors.append([*turned, *shifted])
    return np.sqrt(np.mean(np.square(errors), 0)), unseen


def noise_alone(shape: Floats, frames: int, rng: np.random.Generator) -> Floats:
    return rng.normal(0, 3e-3, (frames, *shape.shape))


def one_slips(shape: Floats, frames: int, rng: np.random.Generator) -> Floats:
    skin = np.zeros((frames, *shape.shape))
    skin[:, rng.integers(len(shape))] = 0.02 * rng.normal(size=3) * np.sin(np.pi * np.arange(frames) / frames)[:, None]
    return skin


def bulge(shape: Floats, frames: int, rng: np.random.Generator) -> Floats:
    """All markers move out from the axis by up to 10 %, those of one side more."""
    outward = shape * [1, 0, 1]
    side = 0.6 + 0.4 * np.sign(shape[:, :1])
    return 0.12 * np.sin(np.pi * np.arange(frames) / frames)[:, None, None] * side * outward


def even_swelling(shape: Floats, frames: int, rng: np.random.Generator) -> Floats:
    about = shape - shape.mean(0)
    return 0.1 * np.sin(np.pi * np.arange(frames) / frames)[:, None, None] * about


def smooth_skin(shape: Floats, frames: int, rng: np.random.Generator) -> Floats:
    vectors = rng.normal(0, 5e-3, (2, *shape.shape))
    phase = 2 * np.pi * np.arange(frames) / frames
    return np.sin(phase)[:, None, None] * vectors[0] + (1 - np.cos(phase))[:, None, None] * vectors[1]


MOTIONS = {
    "random, 3 mm per coordinate": noise_alone,
    "one marker slips by some 20 mm": one_slips,
    "bulge of one side": bulge,
    "even swelling by 10 %": even_swelling,
    "every marker on its own smooth path, some 10 mm": smooth_skin,
}


def around(rng: np.random.Generator, markers: int) -> Floats:
    return thigh(rng, markers)


def in_front(rng: np.random.Generator, markers: int) -> Floats:
    """Markers on the front half of the cone alone, and a little flattened: three moments well apart."""
    shape = thigh(rng, markers)
    return np.stack([1.6 * np.abs(shape[:, 0]), shape[:, 1], 0.9 * shape[:, 2]], -1)


CLUSTERS = {"all around the limb": around, "on its front half": in_front}


def masses(run: Run, frames: int = 60, markers: int = 12) -> None:
    """When redistributed masses help."""
    table = run.table(
        f"Root mean square turn error, {markers} markers, {SETS} sets of {frames} frames", ("skin motion", "cluster"),
        Column("rigid", "deg", 2), Column("pct", "deg", 2), Column("pct_masses", "deg", 2),
        Column("sets in which masses are better than unit masses"),
    )  # fmt: skip
    for name, skin in MOTIONS.items():
        for kind, cluster in CLUSTERS.items():
            errors = [turn_errors(seed, cluster, skin, frames, markers) for seed in range(SETS)]
            mean = np.degrees(np.sqrt(np.mean(np.square(errors), 0)))
            table.row((name, kind), *mean, sum(e[2] < e[1] for e in errors))


def turn_errors(seed: int, cluster: Callable, skin: Callable, frames: int, markers: int) -> list[float]:
    """The error of the rigid fit, of the point cluster technique, and of it with redistributed masses [rad]."""
    rng = np.random.default_rng(seed)
    rotation, origin = smooth_motion(rng, frames)
    shape = cluster(rng, markers)
    moved = skin(shape, frames, rng)
    moved[0] = 0
    points = placed(rotation, origin, shape + moved)
    trial = problem({"thigh": (rotation, origin)}, {"thigh": points}, frames=[0])
    motions = [method(trial).rotation[:, 0] for method in (rigid, point_cluster, point_cluster_masses)]
    seen = np.all([np.isfinite(m).all((1, 2)) for m in motions], 0)
    return [rms(turns(m[seen], rotation[seen])) for m in motions]


def contaminated(rng: np.random.Generator, frames: int = 100, markers: int = 20) -> tuple[Floats, ...]:
    """A limb with muscle deformation, skin sliding, jiggling skin, and random error, as in section 3.4 of the paper.

    Its sizes are not in the paper; here they are chosen so that the rigid fit comes to the paper's 6.8 mm.

    Returns:
        The bone's rotation and origin, the markers' true places on the bone (F, M, 3), and the measured points.
    """
    rotation, origin = smooth_motion(rng, frames)
    shape, time = thigh(rng, markers), np.arange(frames) / frames
    outward = shape * [1, 0, 1] / np.linalg.norm(shape * [1, 0, 1], axis=1, keepdims=True)
    belly = np.exp(-(((shape[:, 1] - rng.uniform(0.1, 0.3)) / 0.1) ** 2)) * (1 + outward[:, 0])
    muscle = 0.007 * np.sin(np.pi * time)[:, None, None] ** 2 * (belly[:, None] * outward)
    along = rng.normal([0, 1, 0], 0.3, (markers, 3)) * rng.uniform(0.3, 1.0, (markers, 1))
    sliding = 0.007 * (1 - np.cos(2 * np.pi * time))[:, None, None] / 2 * along
    after = np.maximum(time - rng.uniform(0.2, 0.6), 0)[:, None] * rng.uniform(0.8, 1.2, markers)
    wobble = np.exp(-after / 0.1) * np.sin(2 * np.pi * after / 0.12)
    jiggle = 0.007 * wobble[..., None] * rng.normal(size=(markers, 3))
    places = shape + muscle + sliding + jiggle
    return rotation, origin, places, placed(rotation, origin, places) + rng.normal(0, RANDOM_M, places.shape)


def table3(run: Run) -> None:
    """The paper's table 3 with made data: mean and standard deviation over the sets."""
    rows = np.array([reconstructions(np.random.default_rng(seed)) for seed in range(SETS)])
    names = ("from the measured markers [mm]", "from the markers' true places [mm]", "bone's turn [deg]")
    columns = [Column("rigid"), *(Column(f"K = {k}") for k in RANKS)]
    table = run.table(f"{SETS} made sets; mean and standard deviation over them", "error", *columns)
    for number, name in enumerate(names):
        mean, spread = rows[:, number].mean(0), rows[:, number].std(0, ddof=1)
        table.row(name, *[f"{m:.2f} +- {s:.2f}" for m, s in zip(mean, spread, strict=True)])
    table.row("the paper's table 3 [mm]", "6.8", "7.2", "6.7", "6.4", "6.3", "6.2")


RANKS = (1, 2, 3, 4, 5)
RANDOM_M = 2.4e-3


def reconstructions(rng: np.random.Generator) -> list[list[float]]:
    """The errors of the rigid fit and of the factorisations with K shapes, of one made set."""
    rotation, origin, places, points = contaminated(rng)
    at_rest = np.einsum("ji,mj->mi", rotation[0], points[0] - origin[0])
    fit = fit_rigid(at_rest, points, RANDOM_M)
    models, poses = [points - fit.residuals], [fit.rotation]
    for rank in RANKS:
        shapes = factorise_points(points, rank)
        models.append(shapes.points)
        poses.append(shapes.rotation @ (shapes.rotation[0].T @ rotation[0]))
    measured = [1000 * rms(np.linalg.norm(model - points, axis=-1)) for model in models]
    true = [1000 * rms(np.linalg.norm(model - placed(rotation, origin, places), axis=-1)) for model in models]
    return [measured, true, [float(np.degrees(rms(turns(pose, rotation)))) for pose in poses]]


PARTS = {"rigid": exact, "interval": interval, "masses": masses, "table3": table3}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_parts(parser, PARTS)


def run(run: Run) -> None:
    """Run the parts."""
    run_parts(run, PARTS)

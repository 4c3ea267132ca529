"""From the scanner to the moving bone and back, end to end.

`exact`: nothing is off; how well the chain closes, over all frames with the true motion. `draws`: the balls as the
program finds them in the simulated volumes, noise of 0.5 mm per coordinate in the laboratory, 200 draws: error of
each bone's surface and rotation, and the share of errors within the stated 95 % intervals. `moved`: a ball put back
3 to 20 mm beside its place. `motion`: the simulated knees on the real trials of markers/sta, moved by the true motion
and by methods.
The names of the balls and their bones are never given: the program finds them by distance and position. The trials:
Cereatti et al. 2017, J Biomech, doi 10.1016/j.jbiomech.2017.02.004.
"""

import argparse
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.special import gammaincc

from bench.common.parts import add_parts, run_parts
from bench.declaration import Bench
from bench.knee.true_bones import true_bones
from bench.recording import Column, Run
from marey.arrays import Floats
from marey.errors import MareyError
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from marey.io.markers.readers import read_markers
from marey.io.mr.volumes import read_volume
from marey.knee.markers.anatomical_frames import bone_frame
from marey.knee.markers.correspondence import KneeCorrespondence, bone_chain, correspond, mean_error_quantile
from marey.knee.markers.gadolinium import find_gadolinium
from marey.knee.markers.marker_naming import ScannerMarkers
from marey.knee.markers.reference_posture import Activity, reference_posture
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.surfacing import surface_of_labels
from marey.knee.space.volume import Labels
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.data.clusters import AnatomicalCalibration
from marey.markers.data.labels import find_clusters
from marey.markers.data.problem import MarkerProblem
from marey.markers.data.trajectories import MarkerTrajectories, trajectories
from marey.markers.kinematics.transform_chain import CAPTURE_GLOBAL, MR_GLOBAL
from marey.markers.methods.methods import DEFAULT_METHOD, choose_methods

BENCH = Bench(
    measures="Bones of a scanned knee placed in the laboratory and moved, against simulated truth on real trials.",
    sources=("src/marey/knee/markers", "src/marey/knee/space", "src/marey/markers"),
    minutes=5,
)
PHANTOMS = ("phantom_a", "phantom_spl", "phantom_spl_t1")
TRIALS = {"left": ("lmam_treadmill_walking",), "right": ("ottawa_walking", "unibo_step_up")}
SEGMENTS = {"femur": "thigh", "tibia": "shank"}
NOISE_MM = 0.5
DRAWS = 200


@dataclass(frozen=True, eq=False, kw_only=True)
class Phantom:
    """A simulated knee."""

    bones: Mapping[str, TriangleSurface]
    """True ones."""
    true_balls_mm: Floats
    riding: tuple[str, ...]
    """The true bone of each ball."""
    found: ScannerMarkers
    """As the program finds them."""
    left: bool

    def exact(self) -> ScannerMarkers:
        """The true balls, as if found without an error."""
        return ScannerMarkers(centres_mm=self.true_balls_mm, sd_mm=np.full(self.true_balls_mm.shape, 0.05))

    def order(self, scanner: ScannerMarkers) -> list[int]:
        """The true ball of each of the scanner's."""
        return np.linalg.norm(scanner.centres_mm[:, None] - self.true_balls_mm, axis=-1).argmin(1).tolist()


@lru_cache(maxsize=1)
def phantom(shared: Path, name: str) -> Phantom:
    knee = true_phantom(shared, name, edge_mm=2.0)
    balls = find_gadolinium(read_volume(shared / "data" / "knee" / name / "image.nii.gz"), knee.bones)
    return replace(knee, found=ScannerMarkers(centres_mm=balls.centres_mm, sd_mm=balls.centres_sd_mm))


def true_phantom(shared: Path, name: str, edge_mm: float = 3.0) -> Phantom:
    """A phantom whose balls are found where they are."""
    folder = shared / "data" / "knee" / name
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    values = read_volume(folder / "truth_labels.nii.gz")
    labels = Labels(labels=np.round(values.intensity).astype(np.uint8), grid=values.grid)
    balls = np.array(truth["marker_centres_lps_mm"])
    return Phantom(
        bones={bone: surface_of_labels(labels, bone, edge_mm=edge_mm) for bone in ("femur", "tibia", "patella")},
        true_balls_mm=balls, riding=tuple(truth["marker_segment"]), left=truth["side"] == "left",
        found=ScannerMarkers(centres_mm=balls, sd_mm=np.full(balls.shape, 0.05)),
    )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class Placed:
    """A simulated knee in the leg of a real trial."""

    knee: Phantom
    trial: MarkerTrajectories
    motion: BoneMotion
    """True."""
    frame: int
    """The reference posture."""
    bone_from_scanner: Mapping[str, RigidTransform]
    """True [mm]."""

    def laboratory_from_scanner(self, bone: str) -> list[RigidTransform]:
        """True, a frame of the trial."""
        rotation, origin = self.motion.bone(SEGMENTS[bone])
        return [
            RigidTransform(r, o * 1e3) @ self.bone_from_scanner[bone] for r, o in zip(rotation, origin, strict=True)
        ]

    def balls_m(self, frame: int) -> Floats:
        """Where the balls are in the laboratory, each with its bone."""
        at = {bone: self.laboratory_from_scanner(bone)[frame] for bone in SEGMENTS}
        places = zip(self.knee.true_balls_mm, self.knee.riding, strict=True)
        return np.array([at[bone].apply(place) for place, bone in places]) / 1e3


def placed(shared: Path, knee: Phantom, name: str) -> Placed:
    """Put the knee's anatomical frames on the trial's, the tibia where the trial's knee is in the shank."""
    folder = shared / "data" / "markers" / "sta"
    truth = np.load(folder / f"{name}.npz")
    segments = tuple(SEGMENTS.values())
    motion = true_bones(truth, segments)
    known = np.flatnonzero(motion.answered.all(1))
    bend = rotations.log(np.swapaxes(motion.rotation[known, 0], 1, 2) @ motion.rotation[known, 1])
    frame = int(known[np.linalg.norm(bend, axis=1).argmin()])  # the straightest: nearest to standing
    shank = RigidTransform(motion.rotation[frame, 1], motion.origin[frame, 1] * 1e3)
    knee_in_shank = shank.inverse().apply(motion.origin[frame, 0] * 1e3)
    frames = {
        bone: bone_frame(bone, knee.bones[bone], np.zeros((0, 3)), left=knee.left).scanner_from_bone
        for bone in SEGMENTS
    }
    middle = frames["femur"].translation
    shifts = {"femur": np.zeros(3), "tibia": knee_in_shank - frames["tibia"].inverse().apply(middle)}
    on = {bone: RigidTransform(np.eye(3), shifts[bone]) @ frames[bone].inverse() for bone in SEGMENTS}
    return Placed(
        knee=knee, trial=read_markers(folder / f"{name}.c3d"), motion=motion, frame=frame, bone_from_scanner=on
    )  # fmt: skip


def standing(scene: Placed, noise_mm: float, rng: np.random.Generator) -> MarkerTrajectories:
    """The reference posture as a trial of its own: the activity's markers and the balls."""
    points = np.concatenate([scene.trial.points[scene.frame], scene.balls_m(scene.frame)])
    labels = [*scene.trial.labels, *(f"B{n}" for n in rng.permutation(len(scene.knee.riding)))]
    return trajectories(labels, points[None] + rng.normal(0, noise_mm / 1e3, points.shape), scene.trial.rate)


def activity(scene: Placed, motion: BoneMotion) -> Activity:
    clusters = find_clusters(scene.trial.labels).clusters
    return Activity(
        motion=motion, markers=scene.trial, time=scene.trial.time, reference_frames=np.array([scene.frame]),
        segment_of_label={label: cluster.segment for cluster in clusters for label in cluster.labels},
    )  # fmt: skip


def with_balls(done: Activity, stood: MarkerTrajectories, frame: int) -> Activity:
    """The activity whose own reference posture shows the balls."""
    balls = [label for label in stood.labels if label not in done.markers.labels]
    shape = (len(done.markers), len(balls), 3)
    points = np.full(shape, np.nan)
    points[frame] = stood.select(balls).points[0]
    every = np.concatenate([done.markers.points, points], 1)
    return replace(done, markers=trajectories([*done.markers.labels, *balls], every, done.markers.rate))


def joined(
    scene: Placed, scanner: ScannerMarkers, done: Activity, stood: MarkerTrajectories | None
) -> KneeCorrespondence:
    posture = reference_posture(done, stood, noise_mm=NOISE_MM)
    # The activity's labels would give the bone of a ball only if a ball were one of its markers.
    return correspond(scanner, posture, scene.knee.bones, segment_of_label=done.segment_of_label, left=scene.knee.left)


def scenes(shared: Path) -> list[tuple[str, str]]:
    sides = {"phantom_a": "right", "phantom_spl": "left", "phantom_spl_t1": "left"}
    return [(name, trial) for name in PHANTOMS for trial in TRIALS[sides[name]]]


def exact(run: Run) -> None:
    """Close the chain with exact input."""
    shared = run.shared
    table = run.table("Exact input", ("volume", "trial", "bone"), Column("frames"), Column("largest distance", "mm"))
    for name, trial in scenes(shared):
        scene = placed(shared, phantom(shared, name), trial)
        done = activity(scene, scene.motion)
        found = joined(scene, scene.knee.exact(), done, standing(scene, 0.0, np.random.default_rng(0)))
        for bone in SEGMENTS:
            frames = np.flatnonzero(scene.motion.answered.all(1))
            off = surface_errors(scene, found, bone, scene.motion, frames, pick=np.max)
            table.row((name, trial, bone), len(frames), f"{off.max():.0e}")


def surface_errors(scene, found, bone, motion, frames, pick=np.mean) -> Floats:  # type: ignore[no-untyped-def]
    """Mean (or another) distance of a bone's vertices from their true places, a frame."""
    vertices = scene.knee.bones[bone].vertices_mm[::10]
    chain = bone_chain(found.bones[bone], motion).between(CAPTURE_GLOBAL, MR_GLOBAL)
    true = scene.laboratory_from_scanner(bone)
    return np.array(
        [pick(np.linalg.norm(chain.at(f).apply(vertices) - true[f].apply(vertices), axis=1)) for f in frames]
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class Draw:
    """The error of one bone in one draw."""

    surface_mm: float
    turn_deg: float
    turn_held: Floats
    """(3,) whether the rotation error about each axis is within 1.96 standard deviations."""
    place_held: Floats
    """(3,) and the translation along each."""
    pose_held: bool
    """Whether the error is within the 95 % ellipsoid of the pose."""
    surface_held: bool
    """Whether the mean distance of the surface is within the stated 95 % limit."""


def drawn(scene: Placed, found: KneeCorrespondence, bone: str) -> Draw:
    transform = found.bones[bone].capture_anatomic_from_mr_global
    true = scene.bone_from_scanner[bone]
    vertices = scene.knee.bones[bone].vertices_mm[::40]
    distance = float(np.linalg.norm(transform.apply(vertices) - true.apply(vertices), axis=1).mean())
    turn = rotations.log(transform.rotation.T @ true.rotation)
    error = np.concatenate([turn, true.translation - transform.translation])
    assert transform.covariance is not None
    held = np.abs(error) < 1.96 * np.sqrt(np.diag(transform.covariance))
    square = float(error @ np.linalg.solve(transform.covariance, error))
    return Draw(
        surface_mm=distance, turn_deg=float(np.degrees(np.linalg.norm(turn))), turn_held=held[:3], place_held=held[3:],
        pose_held=bool(gammaincc(3, square / 2) > 0.05),
        surface_held=distance < mean_error_quantile(transform, vertices, draws=400),
    )  # fmt: skip


def draws(run: Run) -> None:
    """Draw errors of the markers."""
    shared = run.shared
    table = run.table(
        f"Noise of {NOISE_MM} mm per coordinate in the laboratory, {DRAWS} draws",
        ("volume", "trial", "reference", "bone"),
        Column("balls"),
        Column("surface, median", "mm", 2),
        Column("90 %", "mm", 2),
        Column("turn, median", "deg", 2),
        Column("90 %", "deg", 2),
        Column("hold: surface", "", 2),
        Column("pose", "", 2),
        Column("turns", "", 2),
        Column("places", "", 2),
        Column("wrong names"),
        Column("no result"),
        note=(
            "*Reference*: the bones are known in the reference posture (balls), or estimated from the activity's "
            "own noisy "
            "markers (clusters). *Hold*: share of errors within the stated 95 %."
        ),
    )
    for name, trial in scenes(shared):
        scene = placed(shared, phantom(shared, name), trial)
        for kind in ("balls", "clusters"):
            rng = np.random.default_rng(2003)
            drawn_of: dict[str, list[Draw]] = {bone: [] for bone in SEGMENTS}
            wrong = none = 0
            for _ in range(DRAWS):
                stood, done = standing(scene, NOISE_MM, rng), activity(scene, scene.motion)
                own = kind == "balls"
                done = with_balls(done, stood, scene.frame) if own else done
                try:
                    found = joined(scene, scene.knee.found, done, None if own else stood)
                except MareyError:
                    none += 1
                    continue
                wrong += misnamed(scene, found, stood)
                for bone in set(SEGMENTS) & set(found.bones):
                    drawn_of[bone].append(drawn(scene, found, bone))
            for bone, each in drawn_of.items():
                balls = scene.knee.riding.count(bone)
                table.row((name, trial, kind, bone), balls, *row(each), wrong, none)


def misnamed(scene: Placed, found: KneeCorrespondence, stood: MarkerTrajectories) -> bool:
    balls = [label for label in stood.labels if label not in scene.trial.labels]
    right = [balls[ball] for ball in scene.knee.order(scene.knee.found)]
    return any(label not in (None, true) for label, true in zip(found.naming.labels, right, strict=True))


def row(each: list[Draw]) -> list[float]:
    surface, turn = np.array([d.surface_mm for d in each]), np.array([d.turn_deg for d in each])
    held = [np.mean([getattr(d, f"{what}_held") for d in each]) for what in ("surface", "pose", "turn", "place")]
    return [np.median(surface), np.quantile(surface, 0.9), np.median(turn), np.quantile(turn, 0.9), *held]


def moved(run: Run) -> None:
    """Put one ball back elsewhere."""
    shared = run.shared
    table = run.table(
        "A ball of a bone with four or more lies elsewhere in the laboratory, 50 draws each",
        ("volume", "moved by [mm]"),
        Column("it alone left out"),
        Column("another one"),
        Column("none left out"),
        Column("surface of its bone, median", "mm", 2),
    )
    for name, trial in (("phantom_spl", "lmam_treadmill_walking"),):
        scene = placed(shared, phantom(shared, name), trial)
        for by in (0.0, 3.0, 5.0, 10.0, 20.0):
            rng = np.random.default_rng(5)
            counts, off = np.zeros(3, int), []
            for _ in range(50):
                right, another, error = one_moved(scene, by, rng)
                counts += (right, another, not right and not another)
                off.append(error)
            table.row((name, f"{by:g}"), *counts, np.median(off))


def one_moved(scene: Placed, by: float, rng: np.random.Generator) -> tuple[bool, bool, float]:
    """Move one ball in the laboratory; names are given, as after a remounting."""
    stood = standing(scene, NOISE_MM, rng)
    balls = [label for label in stood.labels if label not in scene.trial.labels]
    ball = int(rng.integers(len(balls)))
    aside = rng.normal(size=3)
    points = np.array(stood.points)
    points[0, stood.labels.index(balls[ball])] += by / 1e3 * aside / np.linalg.norm(aside)
    done = with_balls(activity(scene, scene.motion), replace(stood, points=points), scene.frame)
    order = scene.knee.order(scene.knee.found)
    scanner = replace(
        scene.knee.found, names=tuple(balls[o] for o in order), bones=tuple(scene.knee.riding[o] for o in order)
    )
    found = joined(scene, scanner, done, None)
    left_out = {
        name
        for each in found.bones.values()
        for name, used in zip(each.fit.names, each.fit.used, strict=True)
        if not used
    }
    error = drawn(scene, found, scene.knee.riding[ball]).surface_mm
    return left_out == {balls[ball]}, bool(left_out - {balls[ball]}), error


def motion(run: Run) -> None:
    """Drive the knees by real trials."""
    shared = run.shared
    columns = [Column(f"{what}, {part}", "mm", 2) for what in ("femur", "tibia", "gap") for part in ("median", "90 %")]
    table = run.table(
        "Driven by real motion", ("volume", "trial", "driven by"), *columns,
        note=(
            "Distance of a bone's surface from its true place, mean over the surface, median and 90 % over the "
            "frames. *Gap*: the "
            "tibia as seen from the femur. Balls as found, noise of 0.5 mm in the reference posture."
        ),
    )  # fmt: skip
    for name, trial in scenes(shared):
        scene = placed(shared, phantom(shared, name), trial)
        stood = standing(scene, NOISE_MM, np.random.default_rng(7))
        for method in ("true bones", "rigid", DEFAULT_METHOD):
            driven = scene.motion if method == "true bones" else estimated(scene, method)
            found = joined(scene, scene.knee.found, with_balls(activity(scene, driven), stood, scene.frame), None)
            frames = np.flatnonzero((scene.motion.answered & driven.answered).all(1))
            off = [surface_errors(scene, found, bone, driven, frames) for bone in SEGMENTS]
            off.append(gap_errors(scene, found, driven, frames))
            table.row((name, trial, method), *(np.quantile(each, share) for each in off for share in (0.5, 0.9)))


def estimated(scene: Placed, method: str) -> BoneMotion:
    """The trial's bones by a method, known in the reference posture alone."""
    at = scene.frame
    calibration = AnatomicalCalibration(
        segments=scene.motion.segments, frames=np.array([at]), rotation=scene.motion.rotation[[at]],
        origin=scene.motion.origin[[at]],
    )  # fmt: skip
    problem = MarkerProblem(
        trajectories=scene.trial, clusters=find_clusters(scene.trial.labels).clusters, calibration=calibration,
        joints=(("thigh", "shank"),),
    )  # fmt: skip
    return choose_methods([method])[0].run(problem)


def gap_errors(scene: Placed, found: KneeCorrespondence, driven: BoneMotion, frames: Floats) -> Floats:
    vertices = scene.knee.bones["tibia"].vertices_mm[::10]
    chains = {b: bone_chain(found.bones[b], driven).between(CAPTURE_GLOBAL, MR_GLOBAL) for b in SEGMENTS}
    true = {b: scene.laboratory_from_scanner(b) for b in SEGMENTS}
    off = []
    for f in frames:
        ours = chains["femur"].at(f).inverse().apply(chains["tibia"].at(f).apply(vertices))
        right = (true["femur"][f].inverse() @ true["tibia"][f]).apply(vertices)
        off.append(np.linalg.norm(ours - right, axis=1).mean())
    return np.array(off)


PARTS = {"exact": exact, "draws": draws, "moved": moved, "motion": motion}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_parts(parser, PARTS)


def run(run: Run) -> None:
    """Run the parts."""
    run_parts(run, PARTS)

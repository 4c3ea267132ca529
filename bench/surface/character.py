"""The skin of patches beside the metaballs that it covers, and another character that takes over a motion.

People are drawn from the family and skinned; the stocky character of bodies/character.py takes over captured motions.
"""

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bench.common import program
from bench.declaration import Bench
from bench.provenance import PROJECT
from bench.recording import Column, Run, Table
from marey.body.articulation.skeleton import LIMBS
from marey.body.metaballs.metaball_person import DETAILS, metaball_space
from marey.body.metaballs.metaballs import Metaballs
from marey.body.metaballs.spline_skin import Skin, SkinSamples, sample_skin, tessellate
from marey.io.gltf.glb import write_glb
from marey.io.gltf.rig import read_rig
from marey.io.npz import read_motion
from marey.io.results.body import read_body
from marey.motion.retarget import pose_rig, retarget

BENCH = Bench(
    measures="Distance of the closed skin from its metaballs, and errors of a motion on another character.",
    sources=("src/marey/body/metaballs", "src/marey/motion"),
    minutes=3,
)
PEOPLE, SEED = 20, 1


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("takes", nargs="*", help="of data/people; reach and walk without any")


def run(run: Run) -> None:
    """Skin people, and retarget motions."""
    table = run.table(
        f"Skin of {PEOPLE} people beside their metaballs", ("detail", "person"),
        Column("off, median", "mm", 3), Column("95 %", "mm", 3), Column("99 %", "mm", 3), Column("most", "mm", 3),
        Column("hands, median", "mm", 3), Column("hands, 95 %", "mm", 3), Column("folded faces", "", 0),
        Column("as control points: off, median", "mm", 3), Column("their volume", "%", 3), Column("time", "s", 1),
    )  # fmt: skip
    for detail in DETAILS:
        skins(table, detail)
    table = run.table(
        "Motions on a stocky character",
        "take",
        Column("frames"),
        Column("length of the legs, relative", "", 2),
        Column("directions of arms and legs off", "deg"),
        *(
            Column(f"{side} foot's path off, {way}", "mm", 0)
            for side in ("left", "right")
            for way in ("level", "upright")
        ),
        Column("standing feet slide", "mm", 1),
        Column("planted", "mm", 1),
        Column("time", "s", 2),
    )
    for take in run.arguments.takes or ("reach", "walk"):
        carried(run, table, take)


def skins(table: Table, detail: str) -> None:
    """Draw people, and skin them."""
    space, rng = metaball_space(detail), np.random.default_rng(SEED)
    root = np.linalg.cholesky(space.prior_covariance)
    rows = []
    for _ in range(PEOPLE):
        balls = space.balls(root @ rng.normal(size=len(space)))
        began = time.perf_counter()
        samples = sample_skin(balls.at_rest())
        skin = tessellate(samples)
        took = time.perf_counter() - began
        off, hands = distances(balls, skin), in_hands(balls, skin)
        blended = tessellate(as_control_points(samples))
        rows.append([
            *np.percentile(off[~hands], [50, 95, 99, 100]), *np.percentile(off[hands], [50, 95]),
            folded(balls, skin, hands), np.median(distances(balls, blended)[~hands]),
            100 * (volume(blended) / volume(skin) - 1), took,
        ])  # fmt: skip
    middle, worst = np.median(rows, axis=0), np.max(rows, axis=0)
    for name, row in (("median", middle), ("worst", worst)):
        table.row((f"{detail}, {len(skin.vertices)} vertices", name), *row)


def distances(balls: Metaballs, skin: Skin) -> np.ndarray:
    limb = np.array([LIMBS.index(part) for part in skin.part])
    return 1e3 * np.abs(balls.at_rest().distance(skin.vertices, np.where(limb == 0, -1, limb)))


def in_hands(balls: Metaballs, skin: Skin) -> np.ndarray:
    names, beyond = balls.skeleton.segment_names, np.zeros(len(skin.part), bool)
    for side in ("left", "right"):
        elbow, wrist = (balls.joint_centres[names.index(f"{side}_{n}")] for n in ("forearm", "hand"))
        beyond |= (np.array(skin.part) == f"{side}_arm") & ((skin.vertices - wrist) @ (wrist - elbow) > 0)
    return beyond


def folded(balls: Metaballs, skin: Skin, hands: np.ndarray) -> int:
    """Count faces that look inward, without hands and the crease between the legs, which has no normal."""
    corner = skin.vertices[skin.faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    limb = np.array([LIMBS.index(part) for part in skin.part])
    outward = balls.at_rest().distances(skin.vertices, np.where(limb == 0, -1, limb)).by_point[skin.faces].mean(1)
    counted = ~hands[skin.faces].any(1) & (np.abs(corner[:, :, 0]).max(1) > 0.005)
    return int(np.count_nonzero((np.einsum("ta,ta->t", normal, outward) <= 0) & counted))


def as_control_points(samples: SkinSamples) -> SkinSamples:
    """Blend samples as a B-spline of which they are the control points does at its knots."""

    def blended(points: np.ndarray) -> np.ndarray:
        around = (np.roll(points, 1, 1) + 4 * points + np.roll(points, -1, 1)) / 6
        inner = (around[:-2] + 4 * around[1:-1] + around[2:]) / 6
        return np.concatenate([points[:1], inner, points[-1:]])

    return replace(
        samples, trunk=blended(samples.trunk), head=blended(samples.head),
        limbs={name: blended(points) for name, points in samples.limbs.items()},
    )  # fmt: skip


def volume(skin: Skin) -> float:
    a, b, c = (skin.vertices[skin.faces[:, corner]] for corner in range(3))
    return float(np.einsum("ta,ta->t", a, np.cross(b, c)).sum() / 6)


def carried(run: Run, table: Table, take: str) -> None:
    """Return a motion to the character."""
    sys.path.insert(0, str(PROJECT / "bodies"))
    folder = program.take(run, take)[1]
    from character import foreign, stocky, with_arms_out

    motion, person = read_motion(folder / "motion.npz"), read_body(folder / "body.npz")[0]
    floor = float(person.vertices[:, 2].min() - person.joint_centres[0, 2])
    with TemporaryDirectory() as place:
        path = Path(place) / "stocky.glb"
        write_glb(path, with_arms_out(stocky()))
        foreign(path)
        _, rig = read_rig(path)
    began = time.perf_counter()
    moved = retarget(motion, rig, floor=floor)
    took = time.perf_counter() - began
    known = np.flatnonzero(motion.answered)
    # The rig again, as a viewer sees it: local rotations on the tree.
    turns, place_of = seen(rig, moved)
    posed = pose_rig(rig, len(known), turns, (moved.root, place_of))
    at = {s: posed.position[:, n] @ rig.scene_from_world for s, n in rig.nodes.items()}
    own = {s: motion.segment_origin[known, motion.segment_names.index(s)] for s in rig.nodes}
    size = leg(at) / leg(own)
    worst = np.degrees(max(angle(at[b] - at[a], own[b] - own[a]) for a, b in bones()))
    paths = []
    for name in ("left_foot", "right_foot"):
        beside = at[name] - size * own[name]
        beside = 1e3 * (beside - beside.mean(0))
        paths += [rms(beside[:, :2]), rms(beside[:, 2:])]
    planted = retarget(motion, rig, floor=floor, planted=True)
    slides = (None, None) if planted.slides is None else [1e3 * slide for slide in planted.slides]
    table.row(take, len(known), size, f"{worst:.0e}", *paths, *slides, took)


def seen(rig, moved):
    from marey.geometry import rotations

    linear, position = {}, {}
    for n in rig.order:
        up = int(rig.parents[n])
        base = linear.get(up, np.eye(3)[None])
        own = rotations.from_quaternion(moved.rotation[n]) if n in moved.rotation else rig.rotation[n][None]
        step = moved.translation if n == moved.root else rig.translation[n][None]
        linear[n] = base @ (own * rig.scale[n])
        position[n] = position.get(up, np.zeros((1, 3))) + np.einsum("fab,fb->fa", base, step)
    rest = rig.at_rest.linear[0]
    return {n: linear[n] @ np.linalg.inv(rest[n]) for n in moved.rotation}, position[moved.root]


def bones() -> list[tuple[str, str]]:
    pairs = (("thigh", "shank"), ("shank", "foot"), ("upperarm", "forearm"), ("forearm", "hand"))
    return [(f"{side}_{a}", f"{side}_{b}") for side in ("left", "right") for a, b in pairs]


def leg(at: dict[str, np.ndarray]) -> float:
    return float(sum(np.linalg.norm(at[b][0] - at[a][0]) for a, b in bones() if a.endswith(("thigh", "shank"))))


def angle(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(1)).max())


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(values**2, axis=1))))

"""Foot strikes, foot offs and spatio-temporal parameters against force plates and against true feet.

Walks with truth: `functional/walk.c3d` (force plates of the file, 20 N); `gait/walk.trc` (a treadmill; the force plates
of that recording are distributed with OpenSim's models, its times of 20 N are `OPENSIM_CONTACTS` below); the rendered
walks `walk` and `clocks`, whose feet are known to the vertex, once with heels and toes of the true skin and once as
captured from the videos. A true foot is in contact while its lowest vertex is within 5 mm of its height in stance and
slower than 1 m/s over the floor; the time is interpolated between the frames of 30 Hz, except where the foot stops from
one frame to the next.

`methods` chooses the methods: each is corrected by its mean error on the other walks (leave one walk out; the rendered
takes show the same walk and count as one). `events` measures what the program reports, `parameters` its lengths,
`noise` what worse points cost, and `others` those of gaitkit (MIT licence) where it can be imported, with the walks
that have ankles and knees.
"""

import argparse
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

import marey
from bench.common import program
from bench.common.parts import add_parts, run_parts
from bench.declaration import Bench
from bench.recording import Column, Run
from marey.io.axes import OPENSIM_FROM_WORLD, change_point_axes
from marey.io.markers.c3d_forces import read_events, read_force_plates
from marey.io.markers.readers import read_markers
from marey.markers.preprocessing.gait_events import events_from_force
from marey.motion.events.body_feet import paths_of_body
from marey.motion.events.cycles import OFF, STRIKE, GaitEvent
from marey.motion.events.detection import EVENT_DEFAULTS, find_events
from marey.motion.events.feet import FootPath, WalkPaths, fine_feet
from marey.motion.events.methods import OFF_METHODS, STRIKE_METHODS, find_extremes
from marey.motion.events.parameters import measure_gait
from marey.motion.events.summaries import summarise_gait

BENCH = Bench(
    measures="Foot strikes, foot offs and lengths of steps, against force plates and true feet.",
    sources=("src/marey/motion/events", "src/marey/markers/preprocessing/gait_events.py"),
    minutes=4,
)
SIDES = ("left", "right")
PELVIS = ("LASI", "RASI", "LPSI", "RPSI")
OPENSIM_CONTACTS = (
    (OFF, "right", 0.1648), (STRIKE, "right", 0.6182), (OFF, "left", 0.7882), (STRIKE, "left", 1.2452),
    (OFF, "right", 1.4086), (STRIKE, "right", 1.8522), (OFF, "left", 2.0171), (STRIKE, "left", 2.4588),
)  # fmt: skip
"""When the vertical force of `subject01_walk1_grf.mot` (github.com/opensim-org/opensim-models, Gait2354_Simbody) passes
20 N, read from its rows and interpolated [s]."""
NEAR_S = 0.1
"""An event is found if one of its kind and side lies within this time [s]."""


@dataclass(frozen=True, kw_only=True)
class Walk:
    """A walk with true events."""

    name: str
    group: str
    """Walks of one group are the same walk."""
    paths: WalkPaths
    truth: tuple[GaitEvent, ...]
    every: bool
    """Whether the truth lists all events of the trial."""
    joints: dict[str, np.ndarray] | None = None
    """Ankles and knees (F, 3) by name, for other programs; None if they are not known."""


def event(kind: str, side: str, time: float) -> GaitEvent:
    return GaitEvent(kind=kind, side=side, time=time, source="force")


def with_plates(folder: Path) -> Walk:
    """The walk over three force plates."""
    path = folder / "functional" / "walk.c3d"
    trial = read_markers(path)

    def mean(*labels: str) -> np.ndarray:
        return trial.select(labels).points.mean(1)

    feet = tuple(FootPath(side=s, heel=mean(f"{s[0].upper()}HEE"), toe=mean(f"{s[0].upper()}TOE")) for s in SIDES)
    heels = {foot.side: foot.heel for foot in feet if foot.side}
    force = events_from_force(read_force_plates(path), heels, rate=trial.rate, start_s=trial.start_s)
    joints = {
        f"{s}_{joint}": mean(f"{s[0].upper()}{label}")
        for s in SIDES for joint, label in (("ankle", "ANK"), ("knee", "KNE"))
    }  # fmt: skip
    paths = WalkPaths(body=mean(*PELVIS), feet=feet, rate=trial.rate, start_s=trial.start_s)
    return Walk(name="walk.c3d", group="walk.c3d", paths=paths, truth=force, every=False, joints=joints)


def of_opensim(folder: Path) -> Walk:
    """The walk on an instrumented treadmill."""
    trial = read_markers(folder / "gait" / "walk.trc")

    def mean(*labels: str) -> np.ndarray:
        return change_point_axes(OPENSIM_FROM_WORLD.T, trial.select(labels).points.mean(1))

    feet = tuple(
        FootPath(side=s, heel=mean(f"{s[0].upper()}.Heel"), toe=mean(f"{s[0].upper()}.Toe.Tip")) for s in SIDES
    )
    paths = WalkPaths(body=mean("R.ASIS", "L.ASIS", "V.Sacral"), feet=feet, rate=trial.rate, start_s=trial.start_s)
    truth = tuple(event(*contact) for contact in OPENSIM_CONTACTS)
    return Walk(name="walk.trc (OpenSim)", group="walk.trc", paths=paths, truth=truth, every=True)


def true_feet(folder: Path, name: str) -> Walk:
    """The true skin of a rendered walk."""
    with np.load(folder / name / "truth" / "truth.npz") as truth:
        skin, joints = truth["vertices"].astype(float), truth["joints"].astype(float)
        names, rate, empty = [str(n) for n in truth["joint_names"]], float(truth["rate"]), int(truth["empty"])
    feet, events, known = [], [], {}
    for side in SIDES:
        ankle, toe, knee = (joints[:, names.index(f"{side[0]}_{joint}")] for joint in ("ankle", "toe", "knee"))
        sole, heel, tip = foot_vertices(skin, ankle, toe)
        feet.append(FootPath(side=side, heel=skin[:, heel].mean(1), toe=skin[:, tip].mean(1)))
        events += [event(kind, side, (empty + f) / rate) for kind, f in contacts(skin[:, sole], rate)]
        known |= {f"{side}_ankle": ankle, f"{side}_knee": knee}
    body = joints[:, names.index("pelvis")]
    paths = WalkPaths(body=body, feet=tuple(feet), rate=rate, start_s=empty / rate)
    return Walk(
        name=f"{name}, true skin", group="rendered", paths=paths, joints=known, every=True,
        truth=tuple(sorted(events, key=lambda e: e.time)),
    )  # fmt: skip


def foot_vertices(skin: np.ndarray, ankle: np.ndarray, toe: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices of a foot, of its heel and of its toe, from the frame in which it stands flattest and stillest."""
    frame = int(np.argmin(ankle[:, 2] + np.abs(np.gradient(ankle[:, 1]))))
    at, front = ankle[frame], toe[frame]
    forward = (front - at) * [1.0, 1.0, 0.0]
    near = np.minimum(*(np.linalg.norm(skin[frame] - joint, axis=1) for joint in (at, front))) < 0.16
    sole = np.flatnonzero(near & (skin[frame, :, 2] < at[2] + 0.03))
    along = (skin[frame, sole] - at) @ forward
    return sole, sole[along <= np.percentile(along, 8)], sole[along >= np.percentile(along, 92)]


def contacts(sole: np.ndarray, rate: float) -> list[tuple[str, float]]:
    """When a foot (F, V, 3) comes into contact and leaves it, in frames: low, and not sliding."""
    lowest = sole[..., 2].argmin(1)
    height = sole[np.arange(len(sole)), lowest, 2]
    moved = np.linalg.norm(np.diff(sole[..., :2], axis=0), axis=-1) * rate
    sliding = np.minimum(moved[np.arange(len(moved)), lowest[:-1]], moved[np.arange(len(moved)), lowest[1:]]) > 1.0
    limit = np.median(height[:-1][~sliding & (height[:-1] < 0.02)]) + 0.005
    low = height <= limit
    stands = low[:-1] & low[1:] & ~sliding
    found = []
    for f in range(1, len(stands)):
        before, after = (STRIKE, f - 1) if stands[f] else (OFF, f)
        if stands[f] != stands[f - 1]:
            crosses = not sliding[after] and low[after] != low[after + 1]
            part = (limit - height[after]) / (height[after + 1] - height[after]) if crosses else 0.0
            found.append((before, (after + part) if crosses else float(f)))
    return found


def captured(trial: Path, out: Path, walk: Walk) -> Walk:
    """The same walk as captured from the videos."""
    motion = marey.load_motion(program.capture(trial, out))
    assert motion.body is not None
    paths = paths_of_body(motion.data, motion.body)
    assert paths is not None
    seen = np.flatnonzero(np.isfinite(paths.body).all(1)) / paths.rate
    inside = tuple(e for e in walk.truth if seen[0] <= e.time <= seen[-1])
    return replace(walk, name=f"{trial.name}, captured", paths=paths, truth=inside, joints=None)


def walks(run: Run) -> tuple[Walk, ...]:
    return _walks(run.shared / "data", run.out / "takes")


@cache
def _walks(data: Path, takes: Path) -> tuple[Walk, ...]:
    markers, people = data / "markers", data / "people"
    true = [true_feet(people, name) for name in ("walk", "clocks")]
    filmed = [captured(people / name, takes / name, walk) for walk, name in zip(true, ("walk", "clocks"), strict=True)]
    return (with_plates(markers), of_opensim(markers), *true, *filmed)


def errors(walk: Walk, kind: str, found: Iterable[GaitEvent]) -> tuple[np.ndarray, np.ndarray, int, int]:
    """Errors of the found events [ms], the same in standard deviations, and how many are missed and made up."""
    own, off, scaled, missed = [e for e in found if e.kind == kind], [], [], 0
    true = [e for e in walk.truth if e.kind == kind]
    for known in true:
        near = min((e for e in own if e.side == known.side), key=lambda e: abs(e.time - known.time), default=None)
        if near is None or abs(near.time - known.time) > NEAR_S:
            missed += 1
            continue
        off.append(1e3 * (near.time - known.time))
        scaled.append((near.time - known.time) / near.sd_s if near.sd_s else np.nan)
    made_up = sum(
        not any(k.side == e.side and abs(k.time - e.time) <= NEAR_S for k in true) for e in own
    ) if walk.every else 0  # fmt: skip
    return np.array(off), np.array(scaled), missed, made_up


def f1(hits: int, missed: int, made_up: int) -> float:
    return 2 * hits / (2 * hits + missed + made_up)


def events(run: Run) -> None:
    table = run.table(
        "Events that the program reports, against force plates and true feet", ("walk", "event"), Column("true"),
        Column("F1", "", 3), Column("bias", "ms", 1), Column("spread", "ms", 1), Column("largest", "ms", 0),
        Column("stated sd", "ms", 1), Column("largest error in sd", "", 1),
        note="F1 of `walk.c3d` counts the steps on its plates only. Rendered walks: 30 Hz, a frame is 33 ms.",
    )  # fmt: skip
    everything: dict[str, list[np.ndarray]] = {STRIKE: [], OFF: []}
    for walk in walks(run):
        found = find_events(walk.paths)
        for kind in (STRIKE, OFF):
            off, scaled, missed, made_up = errors(walk, kind, found)
            stated = 1e3 * np.mean([e.sd_s for e in found if e.kind == kind])
            everything[kind].append(scaled)
            table.row(
                (walk.name, kind), len(off) + missed, f1(len(off), missed, made_up), off.mean(), off.std(),
                np.abs(off).max(), stated, np.abs(scaled).max(),
            )  # fmt: skip
    held = {kind: np.abs(np.concatenate(each)) < 1.96 for kind, each in everything.items()}
    shares = run.table(
        "Errors within 1.96 stated standard deviations", "event", Column("errors"), Column("share", "", 2)
    )
    for kind, within in held.items():
        shares.row(kind, len(within), float(within.mean()))
    treadmill(run)


def treadmill(run: Run) -> None:
    """A heel on a treadmill, with strikes that the data give."""
    folder = run.shared / "data" / "markers" / "sta"
    trial = read_markers(folder / "lmam_treadmill_walking.c3d")
    with np.load(folder / "lmam_treadmill_walking.npz") as truth:
        given, heel = truth["event_heel_strike"] / trial.rate, truth["heel_global"] * 1e-3
    thigh = np.nanmean(trial.select([label for label in trial.labels if label.startswith("thigh")]).points, 1)
    found = find_events(WalkPaths(body=thigh, feet=(FootPath(side="left", heel=heel),), rate=trial.rate))
    table = run.table(
        "A treadmill with one heel marker, against strikes that the data give", "strike", Column("off", "ms", 0),
        Column("stated sd", "ms", 0), note="The first and the last one are those of the first and the last frame.",
    )  # fmt: skip
    for time in given:
        near = min(found, key=lambda e: abs(e.time - time))
        here = abs(near.time - time) < NEAR_S
        table.row(f"{time:.2f} s", 1e3 * (near.time - time) if here else None, 1e3 * near.sd_s if here else None)


def placed(walk: Walk, kind: str, place: Callable) -> np.ndarray:
    """Errors of one method without correction at all true events [ms]; NaN where it finds none."""
    off = []
    for foot in fine_feet(walk.paths, cutoff_hz=EVENT_DEFAULTS.cutoff_hz):
        extremes = find_extremes(foot)
        for swing in extremes.strikes if kind == STRIKE else extremes.offs:
            at = foot.time[swing.extreme]
            near = [e.time for e in walk.truth if (e.kind, e.side) == (kind, foot.side) and abs(e.time - at) < 0.15]
            off += [1e3 * (place(foot, swing) - near[0])] if near else []
    return np.array(off)


def methods(run: Run) -> None:
    every = walks(run)
    table = run.table(
        "Published methods, corrected by their mean error on the other walks", ("event", "method"),
        *(Column(walk.name, "ms") for walk in every), Column("root mean square", "ms", 1), Column("not found"),
        Column("correction from all", "ms", 0),
        note="Mean ± standard deviation of the errors. Each of the three walks has the same weight in a correction and "
        "in the root mean square.",
    )  # fmt: skip
    for kind, each in ((STRIKE, STRIKE_METHODS), (OFF, OFF_METHODS)):
        for name, place in each.items():
            off = [placed(walk, kind, place) for walk in every]
            table.row((kind, name), *_left_out([w.group for w in every], off))


def _left_out(groups: Sequence[str], off: Sequence[np.ndarray]) -> list[float | str | int | None]:
    """One row: the errors of each walk after the correction of the others."""
    known = [each[np.isfinite(each)] for each in off]
    means = {g: np.mean(np.concatenate([k for k, own in zip(known, groups, strict=True) if own == g])) for g in groups}
    cells: list[float | str | int | None] = []
    squares: dict[str, list[np.ndarray]] = {}
    for own, each in zip(groups, known, strict=True):
        rest = each - np.mean([mean for group, mean in means.items() if group != own])
        squares.setdefault(own, []).append(rest**2)
        cells.append(f"{rest.mean():.0f} ± {rest.std():.0f}" if len(rest) else None)
    total = np.sqrt(np.mean([np.mean(np.concatenate(each)) for each in squares.values()]))
    return [*cells, float(total), int(sum(np.isnan(each).sum() for each in off)), float(np.mean(list(means.values())))]


def parameters(run: Run) -> None:
    table = run.table(
        "Lengths and times of the rendered walks, against the true skin", ("take", "quantity"), Column("true"),
        Column("captured"), Column("off", "%", 2), Column("95 % interval"),
        note="True: stride and speed of the pelvis over one period of the motion, the others from the true skin with "
        "the true events. Captured: mean over the cycles of both sides.",
    )  # fmt: skip
    every = {walk.name: walk for walk in walks(run)}
    for name in ("walk", "clocks"):
        true, seen = every[f"{name}, true skin"], every[f"{name}, captured"]
        known = {s.quantity: s.value for s in summarise_gait(measure_gait(true.paths, true.truth)) if s.side == "both"}
        period = 38  # frames: the motion repeats exactly
        length = float(np.linalg.norm((true.paths.body[period:] - true.paths.body[:-period])[:, :2], axis=1).mean())
        known |= {"stride_length": length, "speed": length / period * true.paths.rate}
        for entry in summarise_gait(measure_gait(seen.paths, find_events(seen.paths))):
            if entry.side == "both" and entry.quantity in known and entry.unit not in ("%", "deg"):
                truth, interval = known[entry.quantity], f"{entry.low:.3f} to {entry.high:.3f}"
                table.row(
                    (name, f"{entry.quantity.replace('_', ' ')} [{entry.unit}]"), f"{truth:.3f}", f"{entry.value:.3f}",
                    100 * (entry.value / truth - 1) if abs(truth) > 0.05 else None, interval,
                )  # fmt: skip


NOISES_MM = (1, 3, 6)
SEEDS = range(100, 108)
"""Seeds of the noise; the scale of the stated standard deviations was chosen on the seeds 0 to 7."""


def noise(run: Run) -> None:
    """White noise on heels and toes, and fewer frames."""
    table = run.table(
        "With white noise per axis on heels and toes, and fewer frames", ("walk", "rate", "noise", "event"),
        Column("F1", "", 2), Column("bias", "ms", 1), Column("spread", "ms", 1),
        Column("within 1.96 stated sd", "", 2), note=f"{len(SEEDS)} draws each.",
    )  # fmt: skip
    for walk in [walk for walk in walks(run) if not walk.name.endswith("captured")]:
        for step in (1, 2, 4)[: 1 + int(walk.paths.rate > 45) + int(walk.paths.rate > 90)]:
            for level in NOISES_MM:
                drawn = [noisy(walk, step, 1e-3 * level, seed) for seed in SEEDS]
                label = (walk.name, f"{walk.paths.rate / step:g} Hz", f"{level} mm")
                found = [find_events(each.paths) for each in drawn]
                for kind in (STRIKE, OFF):
                    rows = [errors(each, kind, own) for each, own in zip(drawn, found, strict=True)]
                    off, scaled = (np.concatenate([row[i] for row in rows]) for i in (0, 1))
                    share = f1(len(off), sum(row[2] for row in rows), sum(row[3] for row in rows))
                    table.row((*label, kind), share, off.mean(), off.std(), float((np.abs(scaled) < 1.96).mean()))


def noisy(walk: Walk, step: int, noise_m: float, seed: int) -> Walk:
    """Every `step`-th frame of a walk with noise; the events are those inside the remaining frames."""
    rng, paths, first = np.random.default_rng(seed), walk.paths, seed % step

    def drawn(points: np.ndarray) -> np.ndarray:
        return points[first::step] + rng.normal(0, noise_m, points[first::step].shape)

    feet = tuple(
        replace(foot, heel=drawn(foot.heel), toe=None if foot.toe is None else drawn(foot.toe)) for foot in paths.feet
    )
    start = paths.start_s + first / paths.rate
    fewer = WalkPaths(body=paths.body[first::step], feet=feet, rate=paths.rate / step, start_s=start)
    inside = tuple(e for e in walk.truth if fewer.time[0] <= e.time <= fewer.time[-1])
    return replace(walk, paths=fewer, truth=inside)


OTHERS = ("bike", "zeni", "oconnor", "hreljac", "mickelborough", "ghoussayni", "vancanneyt", "dgei")


def others(run: Run) -> None:
    try:
        import gaitkit
    except ImportError:
        return
    table = run.table(
        f"Events of gaitkit {gaitkit.__version__}", ("walk", "method", "event"), Column("F1", "", 2),
        Column("bias", "ms", 0), Column("spread", "ms", 0),
        note="Without correction. Its frames: hips at the pelvis, knees, ankles, heels and toes as measured, and the "
        "angles between them; its times are whole frames.",
    )  # fmt: skip
    for walk in walks(run):
        if walk.joints is None:
            continue
        frames = gaitkit_frames(walk)
        for method in OTHERS:
            try:
                found = gaitkit.detect(frames, method=method, fps=walk.paths.rate, auto_install_deps=False)
            except Exception as error:
                table.row((walk.name, method, f"fails: {type(error).__name__}"), None, None, None)
                continue
            listed = [
                event(kind, side, walk.paths.start_s + entry["frame"] / walk.paths.rate)
                for kind, entries in ((STRIKE, found.hs), (OFF, found.to)) for side in SIDES for entry in entries(side)
            ]  # fmt: skip
            for kind in (STRIKE, OFF):
                off, _, missed, made_up = errors(walk, kind, listed)
                middle = (off.mean(), off.std()) if len(off) else (None, None)
                table.row((walk.name, method, kind), f1(len(off), missed, made_up), *middle)


def gaitkit_frames(walk: Walk) -> list[dict]:
    """The walk as gaitkit takes it: landmarks in mm, angles in degrees."""
    assert walk.joints is not None
    points = dict(walk.joints)
    for foot in walk.paths.feet:
        assert foot.toe is not None
        across = (0.09 if foot.side == "left" else -0.09) * np.array([1.0, 0.0, 0.0])
        points |= {
            f"{foot.side}_heel": foot.heel,
            f"{foot.side}_toe": foot.toe,
            f"{foot.side}_hip": walk.paths.body + across,
        }
    angles = {}
    for side in SIDES:
        thigh, shank, foot = (
            points[f"{side}_{b}"] - points[f"{side}_{a}"]
            for a, b in (("hip", "knee"), ("knee", "ankle"), ("heel", "toe"))
        )
        down = np.broadcast_to([0.0, 0.0, -1.0], thigh.shape)
        angles |= {
            f"{side}_hip_angle": between(thigh, down), f"{side}_knee_angle": between(thigh, shank),
            f"{side}_ankle_angle": 90 - between(shank, foot),
        }  # fmt: skip
    zero = {"trunk_angle": 0.0, "pelvis_tilt": 0.0}
    return [
        {"frame_index": f, **zero, **{name: float(a[f]) for name, a in angles.items()},
         "landmark_positions": {name: (1e3 * p[f]).tolist() for name, p in points.items()}}
        for f in range(len(walk.paths.body))
    ]  # fmt: skip


def between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Angles between vectors (F, 3) [degrees]."""
    lengths = np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
    return np.degrees(np.arccos(np.clip((first * second).sum(1) / lengths, -1, 1)))


def given(run: Run) -> None:
    """The events that `walk.c3d` contains, which a person placed."""
    walk = walks(run)[0]
    listed = read_events(run.shared / "data" / "markers" / "functional" / "walk.c3d")
    table = run.table(
        "Events that walk.c3d contains", ("compared", "event"), Column("found"), Column("bias", "ms", 0),
        Column("spread", "ms", 0),
    )  # fmt: skip
    theirs = replace(walk, truth=tuple(e for e in listed if e.side in SIDES))
    for name, against, found in (
        ("against force plates", walk, listed),
        ("ours against them", theirs, find_events(walk.paths)),
    ):
        for kind in (STRIKE, OFF):
            off, _, missed, _ = errors(against, kind, found)
            table.row((name, kind), f"{len(off)} of {len(off) + missed}", off.mean(), off.std())


PARTS = {
    "events": events, "methods": methods, "parameters": parameters, "noise": noise, "given": given, "others": others,
}  # fmt: skip


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_parts(parser, PARTS)


def run(run: Run) -> None:
    """Run the parts."""
    run_parts(run, PARTS)

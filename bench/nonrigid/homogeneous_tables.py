"""Tables 3 and 4 of [Alexander2003], repeated with other data: error against the number of basis shapes.

`simulated`: their section 3.4, 20 made clusters with muscle, sliding, jiggling and random error (the sizes are ours,
see markers/synthetic). `cameras`: the same clusters seen by four calibrated cameras. `skin`: 20 random sets of real
skin markers and of stretches of their trials (Cereatti et al. 2017, J Biomech, doi 10.1016/j.jbiomech.2017.02.004),
10 % of the points held back, the bone known. `arm`: the videos of arm3 with their cameras.toml, 20 random sets of two
thirds of the points that were followed, K chosen once. *Rigid*: the fit of [Spoor1980] to the first frame's shape on
equal data. Mean and standard deviation over the sets, root mean square in each.
"""

import argparse
from collections.abc import Callable, Sequence

import cv2
import numpy as np
from tests.skin_clusters import placed, turns
from tests.worlds import ring

from bench.common.parts import add_parts, run_parts
from bench.declaration import Bench
from bench.markers.synthetic import RANDOM_M, contaminated
from bench.nonrigid.uncalibrated_chain import PIECES, surface_at
from bench.recording import Column, Run
from marey.arrays import Floats, Mask
from marey.cameras.rig import Rig
from marey.cameras.triangulate import triangulate
from marey.io.calibration.readers import read_rig
from marey.io.video.video import open_clip
from marey.markers.data.rigid_fit import fit_rigid
from marey.nonrigid.correspondence.calibrated_videos import track_calibrated_views
from marey.nonrigid.in_space.calibrated import factorise_calibrated
from marey.nonrigid.in_space.factorisation import HomogeneousShapes, factorise_points

BENCH = Bench(
    measures="Error of shapes in space against the number of basis shapes, on made and real markers and on videos.",
    sources=("src/marey/nonrigid", "src/marey/markers", "src/marey/geometry"),
    minutes=8,
)
SETS = 20
RANKS = (1, 2, 3, 4, 5, None)
MM = 1000.0
PIXEL_SD = 1.0
UNSEEN = 0.3
HELD_BACK = 0.1
CLUSTERS = (("lmam_treadmill_walking", "thigh"), ("lmam_treadmill_walking", "shank"), ("unibo_step_up", "thigh"))

Poses = tuple[Floats, Floats]
"""Rotation (F, 3, 3) and origin (F, 3) of a bone."""


def rms(values: Floats) -> float:
    return float(np.sqrt(np.nanmean(np.square(values))))


def carried_bone(rotation: Floats, translation: Floats, bone: Poses) -> Poses:
    """Tie the bone to a motion in the first frame, and let it be carried along."""
    turn, offset = rotation[0].T @ bone[0][0], rotation[0].T @ (bone[1][0] - translation[0])
    return rotation @ turn, np.einsum("fij,j->fi", rotation, offset) + translation


def rigidly(points: Floats) -> tuple[Floats, Poses]:
    """Fit the first frame's shape to every frame ([Spoor1980]): its points (F, P, 3) and motion."""
    fit = fit_rigid(points[0], points, RANDOM_M)
    return np.einsum("fij,pj->fpi", fit.rotation, points[0]) + fit.translation[:, None], (fit.rotation, fit.translation)


def solved(factorise: Callable[[int | None], HomogeneousShapes], points: Floats) -> list[tuple[Floats, Poses, int]]:
    """Return points, motion and K of the rigid fit to points (F, P, 3), of K = 1 to 5, and of the chosen K."""
    answers = [(*rigidly(points), 0)]
    for rank in RANKS:
        found = factorise(rank)
        answers.append((found.points, (found.rotation, found.translation), found.rank))
    return answers


def pose_errors(answers: Sequence[tuple[Floats, Poses, int]], bone: Poses) -> list[list[float]]:
    """The bone's turn [degrees] and origin [mm] of each answer."""
    bones = [carried_bone(*motion, bone) for _, motion, _ in answers]
    turned = [float(np.degrees(rms(turns(rotation, bone[0])))) for rotation, _ in bones]
    return [turned, [MM * rms(np.linalg.norm(origin - bone[1], axis=-1)) for _, origin in bones]]


def off(answers: Sequence[tuple[Floats, Poses, int]], points: Floats, where: Mask) -> list[float]:
    """Distances of the answers' points from points (F, P, 3), in the places of the mask [mm]."""
    return [MM * rms(np.linalg.norm(model - points, axis=-1)[where]) for model, _, _ in answers]


def fill(run: Run, title: str, names: Sequence[str], sets: Sequence[list[list[float]]], chosen: Sequence[int]) -> None:
    """A table of means and standard deviations over the sets, one row per figure."""
    values = np.array(sets)
    counts = ", ".join(f"{rank} ({count})" for rank, count in zip(*np.unique(chosen, return_counts=True), strict=True))
    columns = [Column(name) for name in ("rigid", *(f"K = {k}" for k in RANKS[:-1]), "chosen")]
    table = run.table(title, "from", *columns, note=f"Chosen K, with the number of sets: {counts}.")
    for number, name in enumerate(names):
        cells = zip(values[:, number].mean(0), values[:, number].std(0, ddof=1), strict=True)
        table.row(name, *[f"{mean:.2f} +- {spread:.2f}" for mean, spread in cells])


def simulated(run: Run) -> None:
    rows, chosen = [], []
    for seed in range(SETS):
        rotation, origin, places, points = contaminated(np.random.default_rng(seed))
        answers = solved(lambda rank, points=points: factorise_points(points, rank), points)
        everywhere = np.ones(points.shape[:2], bool)
        true = placed(rotation, origin, places)
        rows.append([off(answers, points, everywhere), off(answers, true, everywhere)])
        rows[-1] += pose_errors(answers, (rotation, origin))
        chosen.append(answers[-1][2])
    names = ("the measured markers [mm]", "the true places [mm]", "the bone's turn [deg]", "its origin [mm]")
    fill(run, "Simulated markers", names, rows, chosen)


def cameras(run: Run) -> None:
    rig = Rig(ring(4, size=(1280, 960), focal=1200.0, target=(0.0, 0.0, 0.0)))
    rows, chosen = [], []
    for seed in range(SETS):
        rng = np.random.default_rng(seed)
        rotation, origin, places, _ = contaminated(rng)
        true = placed(rotation, origin, places)
        true = true - true.mean((0, 1))
        origin = origin - placed(rotation, origin, places).mean((0, 1))
        pixels = np.stack([camera.project(true) for camera in rig])
        pixels += rng.normal(0, PIXEL_SD, pixels.shape)
        pixels[:, 1:][rng.random(pixels[:, 1:].shape[:-1]) < UNSEEN] = np.nan
        flat = pixels.reshape(len(rig), -1, 2)
        points = triangulate(rig.cameras, flat, sigma_px=PIXEL_SD).points.reshape(true.shape)
        tracks = np.moveaxis(pixels, 3, 2)
        answers = solved(lambda rank, tracks=tracks: factorise_calibrated(tracks, rig, rank=rank), points)
        met = np.isfinite(points[..., 0])
        rows.append([off(answers, points, met), off(answers, true, met), *pose_errors(answers, (rotation, origin))])
        chosen.append(answers[-1][2])
    names = ("points where rays meet [mm]", "the true places [mm]", "the bone's turn [deg]", "its origin [mm]")
    fill(run, f"Four cameras, {PIXEL_SD:g} px, {UNSEEN:.0%} of the views missing", names, rows, chosen)


def skin(run: Run) -> None:
    for trial, segment in CLUSTERS:
        with np.load(run.shared / "data" / "markers" / "sta" / f"{trial}.npz") as truth:
            rotation, origin = truth[f"{segment}_rotation"], truth[f"{segment}_origin"] / MM
            local = truth[f"{segment}_markers"] / MM
        whole = np.einsum("fij,fpj->fpi", rotation, local) + origin[:, None]
        rows, chosen = [], []
        for seed in range(SETS):
            rng = np.random.default_rng(seed)
            markers = rng.permutation(whole.shape[1])[: max(2 * whole.shape[1] // 3, 8)]
            length = max(len(whole) // 4, min(len(whole), 13))
            begin = rng.integers(len(whole) - length + 1)
            frames = slice(begin, begin + length)
            points = whole[frames][:, markers]
            held = rng.random(points.shape[:2]) < HELD_BACK
            held[0] = False
            given = np.where(held[..., None], np.nan, points)
            answers = solved(lambda rank, given=given: factorise_points(given, rank), given)
            rows.append([off(answers, points, ~held), off(answers, points, held)])
            rows[-1] += pose_errors(answers, (rotation[frames], origin[frames]))
            chosen.append(answers[-1][2])
        names = ("the markers [mm]", "markers held back [mm]", "the bone's turn [deg]", "its origin [mm]")
        fill(run, f"Skin: {trial}, {segment}", names, rows, chosen)


def arm(run: Run) -> None:
    trial = run.shared / "data" / "people" / "arm3"
    rig = read_rig(trial / "cameras.toml")
    clips = [open_clip(trial / f"{name}.mp4") for name in rig.names]
    videos = [[cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in clip.images(range(clip.count))] for clip in clips]
    with np.load(trial / "truth" / "truth.npz") as truth:
        vertices, faces = truth["vertices"].astype(float), truth["faces"]
    for piece in ("sleeve", "forearm"):
        within = np.zeros(videos[0][0].shape, np.uint8)
        cv2.fillPoly(within, [np.array(PIECES[piece])], (1,))
        views = track_calibrated_views(videos, rig, within=within > 0)
        true = surface_at(rig, views.tracks[0, 0].T, vertices, faces).points()
        found = np.isfinite(true[0]).all(1)
        rank = factorise_calibrated(views.tracks, rig, tracks_sd=views.tracks_sd).rank
        sets = [np.flatnonzero(found)[np.random.default_rng(seed).random(found.sum()) < 2 / 3] for seed in range(SETS)]
        tracks, sd = views.tracks, views.tracks_sd
        rows = [arm_errors(tracks[..., kept], sd[..., kept], rig, true[:, kept], rank) for kept in sets]
        names = ("points that two cameras see [mm]", "points that one camera sees [mm]")
        fill(run, f"arm3, {piece}, {len(found)} points, {len(sets[0])} in a set", names, rows, [rank])


def arm_errors(tracks: Floats, tracks_sd: Floats, rig: Rig, true: Floats, rank: int) -> list[list[float]]:
    """The errors of some points [mm]; the rigid shape is that of the first frame's points, where rays meet."""
    seen = np.isfinite(tracks[:, :, 0]).sum(0)
    flat = np.moveaxis(tracks, 2, 3).reshape(len(rig), -1, 2)
    points = triangulate(rig.cameras, flat, sigma_px=PIXEL_SD).points.reshape(true.shape)

    def factorise(count: int | None) -> HomogeneousShapes:
        return factorise_calibrated(tracks, rig, tracks_sd=tracks_sd, rank=count or rank)

    answers = solved(factorise, points)
    return [off(answers, true, seen >= 2), off(answers, true, seen == 1)]


PARTS = {"simulated": simulated, "cameras": cameras, "skin": skin, "arm": arm}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_parts(parser, PARTS)


def run(run: Run) -> None:
    """Run the parts."""
    run_parts(run, PARTS)

"""Non-rigid shapes and turns: of one orthographic camera, of several, and of one camera in perspective."""

from collections.abc import Iterator

import numpy as np

from bench.intervals.scoring import Sample, sample
from bench.nonrigid import many_views
from bench.nonrigid.made_perspective import KINDS, bending_sheet, deforming_body, filmed, rubber_sheet
from bench.nonrigid.one_camera import degraded
from bench.recording import Run
from marey.geometry import rotations
from marey.nonrigid.core.alignment import mean_shape
from marey.nonrigid.core.rotation_paths import MIRROR
from marey.nonrigid.many_cameras.many_views import factorise_views
from marey.nonrigid.one_camera.one_view import factorise_tracks
from marey.nonrigid.one_camera.perspective import PerspectiveShapes, factorise_perspective

SEQUENCES = ("pickup", "stretch", "yoga")
"""Recorded sequences before one camera whose truth has the object's axes, along which deviations are stated; not the
longest of them."""
SIDE = 0
"""Direction from which skin markers are filmed [deg]."""
SEED = 0
"""Seed of each kind of made sequence in perspective, and of degraded tracks."""


def one_camera(run: Run) -> Iterator[Sample]:
    """Factorise the recorded sequences, unchanged and degraded."""
    for name in SEQUENCES:
        source = run.shared / "data" / "nonrigid" / f"{name}.npz"
        truth = dict(np.load(source))
        for kind, tracks in (("", source), (", degraded", degraded(run, source, SEED))):
            found = factorise_tracks(np.load(tracks)["tracks"])
            what = f"one camera{kind}"
            yield shape_sample(what, name, found.shape, found.shape_sd, np.asarray(truth["shape"], float))
            rows = np.asarray(truth["rotation"], float)[:, :2]
            camera = np.concatenate([rows, np.cross(rows[:, 0], rows[:, 1])[:, None]], 1)
            yield turn_sample(what, name, found.rotation, found.rotation_sd, camera)


def many_cameras(run: Run) -> Iterator[Sample]:
    """Factorise skin markers before three cameras, and people before two whose tracks are degraded."""
    sources = {
        f"{trial} {segment}": (many_views.skin(run.shared, trial, segment, SIDE), (0, 45, 90))
        for trial in many_views.TRIALS for segment in ("thigh", "shank")
    }  # fmt: skip
    sources |= {name: (many_views.body(run.shared, name), (0, 45)) for name in many_views.BODIES}
    for name, (take, angles) in sources.items():
        spoilt = name in many_views.BODIES
        tracks = many_views.degraded_tracks(run, take, angles) if spoilt else take.tracks(angles, seed=len(angles))
        found = factorise_views(tracks)
        camera = take.camera_from_world @ take.world_from_object
        yield shape_sample("several cameras", name, found.shape, found.shape_sd, take.shape)
        yield turn_sample("several cameras", name, found.rotation, found.rotation_sd, camera)


def perspective(run: Run) -> Iterator[Sample]:
    """Factorise made sheets and bodies: noise 0.5 px, 10 % missing in runs of ten frames."""
    makers = {"sheet": bending_sheet, "rubber": rubber_sheet}
    for kind in KINDS:
        rng = np.random.default_rng(SEED)
        shapes = makers.get(kind, deforming_body)(rng)
        shapes = np.repeat(shapes[:1], len(shapes), axis=0) if kind == "rigid" else shapes
        tracks, matrix, points, _ = filmed(rng, shapes, 1.0, 3.0, 660.0, 0.5, 0.1)
        yield from in_perspective(kind, factorise_perspective(tracks, matrix), points)


def shape_sample(what: str, case: str, shape: np.ndarray, sd: np.ndarray, true: np.ndarray) -> Sample:
    """Compare shapes (F, 3, P) after one rotation or reflection for all frames, in per cent of the object's size."""
    true, shape = (each - each.mean(2, keepdims=True) for each in (true, shape))
    size = true.std(2).mean()
    wrong = []
    for mirror in (np.eye(3), MIRROR):
        a, b = (np.concatenate(list(each), 1) for each in (true, mirror @ shape))
        left, _, right = np.linalg.svd(a @ np.linalg.pinv(b))
        wrong.append(mirror @ shape - (left @ right).T @ true)
    error = min(wrong, key=lambda each: np.square(each).sum())
    return sample(
        f"shapes, {what}", case, "% of the size", *(100 / size * np.swapaxes(each, 1, 2) for each in (error, sd))
    )


def turn_sample(what: str, case: str, rotation: np.ndarray, sd: np.ndarray, true: np.ndarray) -> Sample:
    """Compare rotations (F, 3, 3), camera from object, after one rotation of the object, mirrored or not."""
    wrong = []
    for mirror in (np.eye(3), MIRROR):
        own = mirror @ rotation @ mirror
        turn = rotations.mean(np.swapaxes(own, 1, 2) @ true)
        wrong.append(rotations.log(true @ np.swapaxes(own @ turn, 1, 2)))
    error = min(wrong, key=lambda each: np.square(each).sum())
    return sample(f"turns, {what}", case, "deg", np.degrees(error), np.degrees(sd))


def in_perspective(case: str, found: PerspectiveShapes, truth: np.ndarray) -> Iterator[Sample]:
    """Compare with true points (F, 3, P) before the camera, divided into shape and turn as the result is."""
    shape = found.shape - found.shape.mean(2, keepdims=True)
    points = np.swapaxes(truth - truth.mean(2, keepdims=True), 1, 2)
    _, camera_from_object, _ = mean_shape(points, np.ones(points.shape[:2], bool))
    true = np.swapaxes(points @ camera_from_object, 1, 2)
    rows, others = (each.transpose(1, 0, 2).reshape(3, -1) for each in (shape, true))
    axes = rotations.nearest(rows @ others.T)
    scale = np.sum(rows * (axes @ others)) / np.sum(others**2)
    size = scale * true.std(2).mean()
    wrong, sd = (100 / size * np.swapaxes(each, 1, 2) for each in (shape - scale * axes @ true, found.shape_sd))
    yield sample("shapes, perspective", case, "% of the size", wrong, sd)
    turn = rotations.log(found.rotation @ axes @ np.swapaxes(camera_from_object, 1, 2))
    yield sample("turns, perspective", case, "deg", np.degrees(turn), np.degrees(found.rotation_sd))

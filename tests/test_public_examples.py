"""The examples in the docstrings of the public names, run on small data that the tests make."""

import doctest
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest

import marey
from marey.geometry import rotations
from marey.io.calibration.readers import write_cameras_toml
from marey.io.mr.meshes import write_mesh
from marey.io.mr.volumes import write_labels, write_volume
from marey.io.results.gait import write_cycle_csv, write_events
from marey.io.results.results import write_results
from marey.io.shapes.measured_surface import write_surface
from marey.knee.space.structures import BONES
from marey.knee.space.surfacing import surface_of_labels
from marey.motion.events.cycles import STRIKE, GaitEvent
from marey.surface.points.measured import MeasuredPoints
from tests import performer, rigs, scenes, trials
from tests.io.gltf.test_rig import segments
from tests.made_animations import made_activity
from tests.made_knees import made_grid, made_labels, made_volume
from tests.segmented_once import segment_bones_once

FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
WITHOUT_KNEE = find_spec("SimpleITK") is None
KNEE_NAMES = ("Knee", "load_knee", "read_volume", "segment_knee")


def made_surface(rng: np.random.Generator) -> MeasuredPoints:
    names, count = ("left", "middle", "right"), 40
    return MeasuredPoints(
        frame=np.repeat([0, 1], count // 2), points=rng.normal(size=(count, 3)),
        covariance=np.tile(1e-6 * np.eye(3), (count, 1, 1)), camera_names=names,
        pixels=rng.uniform(0, 200, (count, 3, 2)), correlation=np.tile([0.9, 1.0, 0.95], (count, 1)),
        residual_px=np.full(count, 0.1), colour=np.full((count, 3), 128, np.uint8),
    )  # fmt: skip


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders and files by the names that the examples use."""
    folder, rng = tmp_path_factory.mktemp("examples"), np.random.default_rng(11)
    person = performer.body()
    write_results(folder / "walk01" / "marey", performer.motion(person), person, preset="full")
    rigs.write_rig(folder / "knight.glb", rigs.MIXAMO, segments(rigs.MIXAMO), unit=0.01)
    (folder / "face1").mkdir()
    write_surface(folder / "face1" / "surface.npz", [made_surface(rng)], ("left", "middle", "right"))
    (folder / "ball").mkdir()
    cameras = scenes.rig(-10, 0, 10)
    write_cameras_toml(cameras, folder / "ball" / "cameras.toml")
    for camera, image in zip(cameras, scenes.films(cameras, rng), strict=True):
        cv2.imwrite(str(folder / "ball" / f"{camera.name}.png"), image)
    write_marker_trial(folder)
    write_curves(folder, rng)
    write_cluster(folder / "cluster.npz")
    bend = made_activity(folder / "bend", fine=2)
    marey.animate_knee(bend.knee, bend.motion, reference=bend.standing, views=("plateau",), out=bend.motion / "knee")
    if not WITHOUT_KNEE:
        write_knee(folder)
    return folder


def write_knee(folder: Path) -> None:
    """Write an image of a knee, and its labels and surfaces as if the true bones had been found."""
    image = made_volume(made_grid((2.0, 2.0, 2.5)), "dark")
    write_volume(folder / "knee.nii.gz", image)
    labels = made_labels(image.grid)
    write_labels(folder / "knee_marey", labels)
    for bone in BONES:
        write_mesh(folder / "knee_marey" / f"{bone}.ply", surface_of_labels(labels, bone, edge_mm=3.0))


def write_marker_trial(folder: Path) -> None:
    trials.write_trial(folder / "walk.c3d", trials.marker_points())
    trials.write_reference(folder / "walk_frame0.npz")
    walk = marey.open_markers(folder / "walk.c3d", reference=folder / "walk_frame0.npz")
    marey.estimate_bones(walk, method="rigid", out=folder / "walk_marey")


_STEPS = tuple(
    GaitEvent(kind=STRIKE, side=side, time=time, source="given")
    for side, time in (("left", 0.0), ("right", 0.5), ("left", 1.0), ("right", 1.5))
)
"""One cycle of each foot."""


def write_curves(folder: Path, rng: np.random.Generator) -> None:
    """Write the curves over the gait cycle of three reference walks, and of one with a stiff left knee."""
    names = [f"{side}_{angle}_deg" for side in ("left", "right") for angle in ("hip_flexion", "knee_flexion")]
    usual = 30 * np.sin(np.linspace(0, 2 * np.pi, 101))[:, None] + np.zeros(4)
    for name in ("one", "two", "three"):
        own = folder / "references" / name
        own.mkdir(parents=True)
        write_cycle_csv(own / "cycles.csv", names, usual + rng.normal(0, 2, 4), np.full((101, 4), np.nan))
        write_events(own / "events.csv", _STEPS)
    write_events(folder / "walk01" / "marey" / "events.csv", _STEPS)
    stiff = usual * [1.0, 0.3, 1.0, 1.0]
    write_cycle_csv(folder / "walk01" / "marey" / "cycles.csv", names, stiff, np.full((101, 4), np.nan))


def write_cluster(path: Path) -> None:
    """Write points in space that rotate and deform in one way, and the shapes recovered from them."""
    rng, time = np.random.default_rng(3), np.arange(40)
    path_of_object = rotations.exp(np.outer(0.08 * time, [0.1, 1.0, 0.0]))
    mean, mode = 100 * rng.normal(size=(2, 3, 9))
    points = path_of_object @ (mean + 0.3 * np.sin(time / 7)[:, None, None] * mode)
    np.savez(path, points=points, labels=[f"skin_{n}" for n in range(9)], rate=50.0)
    marey.factorise(path, basis_shapes=2, out=path.with_name("cluster_marey"))


def documented() -> list[doctest.DocTest]:
    """Return the examples of all public names and of their methods."""
    finder = doctest.DocTestFinder(exclude_empty=True)
    found = []
    for name in marey.__all__:
        value = getattr(marey, name)
        if name != "__version__":
            found += [test for test in finder.find(value, name, module=False, globs={}) if test.examples]
    return found


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::marey.errors.MareyWarning")
@pytest.mark.parametrize("example", documented(), ids=lambda test: test.name)
def test_the_example_of_a_public_name_runs(
    example: doctest.DocTest, world: Path, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
):  # fmt: skip
    if WITHOUT_KNEE and example.name.split(".")[0] in KNEE_NAMES:
        pytest.skip("SimpleITK is not installed")
    segment_bones_once(monkeypatch, tmp_path_factory)
    monkeypatch.chdir(world)
    runner = doctest.DocTestRunner(optionflags=FLAGS, verbose=False)
    output: list[str] = []
    runner.run(example, out=output.append)
    assert runner.summarize(verbose=False).failed == 0, "".join(output)


@pytest.mark.parametrize("name", [name for name in marey.__all__ if name != "__version__"])
def test_every_public_name_has_an_example(name: str):
    text = getattr(marey, name).__doc__ or ""
    assert ">>> " in text, f"{name} has no example"

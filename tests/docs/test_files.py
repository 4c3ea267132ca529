"""The reference of files lists every key that the writers write, and no other."""

import csv
import json
import re
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from tests import performer
from tests.made_animations import flexed
from tests.made_joints import made_joint
from tests.made_scans import made_scan
from tests.surfaces import CAMERAS, some_points

from marey.body.metaballs.metaball_people import metaball_person
from marey.body.metaballs.segment_measures import SegmentMeasures
from marey.images.matching.feature_tracks import FeatureTracks
from marey.io.devices.results import write_device_clock, write_device_signals
from marey.io.markers.bones import BoneFile, write_bones
from marey.io.markers.results import write_frames
from marey.io.mr import tables
from marey.io.mr.contours import write_contours
from marey.io.mr.correspondence import write_correspondence
from marey.io.mr.gadolinium import MarkersInScanner, write_markers
from marey.io.mr.knee_motion import write_knee_motion, write_proximity
from marey.io.mr.volumes import write_labels
from marey.io.results.body import write_body
from marey.io.results.comparison import write_comparison
from marey.io.results.csv import write_segments
from marey.io.results.results import write_results
from marey.io.shapes.measured_surface import write_surface
from marey.io.shapes.shapes import write_residuals, write_shapes
from marey.io.shapes.tracks import write_tracks
from marey.io.shapes.trajectories import write_trajectories
from marey.io.trial.masks import write_masks
from marey.knee.markers.correspondence import correspond
from marey.knee.markers.reference_posture import reference_posture
from marey.knee.motion.joint_motion import JointMotion, KneeMotion, joint_proximities, joint_sides
from marey.knee.outlines.contours import Contour
from marey.knee.space.volume import Labels, VoxelGrid
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.kinematics.joint_angles import JointKinematics
from marey.markers.kinematics.transform_chain import CAPTURE_GLOBAL, MR_ANATOMIC, MR_GLOBAL, NamedTransform
from marey.motion.device_clock import DeviceClock
from marey.nonrigid.recovered import GAUGES, ONE_VIEW, CameraRelations, RankCurve, RecoveredShapes
from marey.pipelines.knee import register
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.run_record import write_record
from marey.surface.tracks.trajectories import Trajectories

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "files.md"


def documented(anchor: str) -> set[str]:
    """The keys in the table below the heading with an anchor."""
    text = PAGE.read_text(encoding="utf-8")
    part = re.split(r"^##+ ", text.split(f"{{ #{anchor} }}")[1], maxsplit=1, flags=re.MULTILINE)[0]
    cells = re.findall(r"^\| (`.+?`) \|", part, re.MULTILINE)
    return {key for cell in cells for key in re.findall(r"`([^`]+)`", cell)}


def keys_of(path: Path) -> set[str]:
    with np.load(path) as file:
        return set(file.files)


def columns_of(path: Path) -> set[str]:
    with path.open(newline="", encoding="utf-8") as file:
        return set(next(csv.reader(file)))


def keys_in(path: Path) -> set[str]:
    return set(json.loads(path.read_text(encoding="utf-8")))


@pytest.fixture(scope="module")
def captured(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("captured")
    person = performer.body()
    motion = performer.motion(person)
    skin = np.zeros((len(motion), len(person.vertices), 3))
    write_results(folder, motion, person, preset="full", skin=skin)
    return folder


def test_a_captured_motion(captured):
    assert keys_of(captured / "motion.npz") == documented("motion-npz")
    assert keys_of(captured / "skin.npz") == documented("skin-npz")
    names = {name for name in columns_of(captured / "angles.csv") if not re.search(r"_(sd_)?deg$", name)}
    assert names | {"NAME_deg", "NAME_sd_deg"} == documented("angles-csv")


@pytest.mark.slow
def test_a_body_with_metaballs_and_one_without(captured, tmp_path):
    write_body(tmp_path / "body.npz", metaball_person("simple", "coarse"), preset="full")
    assert keys_of(tmp_path / "body.npz") == documented("body-npz")
    lacking = documented("body-npz") - keys_of(captured / "body.npz")
    assert lacking == {
        key for key in documented("body-npz")
        if key.startswith("metaball_") and not re.fullmatch(r"metaball_(segment|centre|radii|radii_sd|weight)", key)
    }  # fmt: skip


def test_silhouettes(tmp_path):
    write_masks(tmp_path / "cam01.npz", [np.ones((4, 5), bool)], shape=(1, 4, 5))
    assert keys_of(tmp_path / "cam01.npz") == documented("masks-npz")


def test_segments(tmp_path):
    one, three, six = np.ones(1), np.ones((1, 3)), np.ones((1, 6))
    measures = SegmentMeasures(
        names=("thigh",), girth=three, girth_sd=three, volume=one, volume_sd=one, mass=one, mass_sd=one, centre=three,
        centre_sd=three, inertia=six, inertia_sd=six, whole_volume=1.0, whole_volume_sd=1.0, whole_mass=1.0,
        whole_mass_sd=1.0,
    )  # fmt: skip
    write_segments(tmp_path / "segments.csv", measures, one, one)
    written = {name for name in columns_of(tmp_path / "segments.csv") if "_sd_" not in name}
    assert written == documented("segments-csv")


def test_a_surface_and_trajectories(tmp_path, rng):
    write_surface(tmp_path / "surface.npz", [some_points(rng, [0, 0])], CAMERAS)
    assert keys_of(tmp_path / "surface.npz") == documented("surface-npz")
    three = np.zeros((2, 1, 3))
    write_trajectories(
        tmp_path / "trajectories.npz",
        Trajectories(
            frames=np.arange(2), rate=30.0, position=three, velocity=three, acceleration=three,
            covariance=np.zeros((2, 1, 3, 3)), camera_names=("a",), pixels=np.zeros((2, 1, 1, 2)),
            removed=np.zeros(1, bool),
        ),
    )  # fmt: skip
    assert keys_of(tmp_path / "trajectories.npz") == documented("trajectories-npz")


def test_bones(tmp_path):
    motion = BoneMotion(
        segments=("thigh",), rotation=np.tile(np.eye(3), (2, 1, 1, 1)), origin=np.zeros((2, 1, 3)),
        covariance=np.tile(np.eye(6), (2, 1, 1, 1)),
    )  # fmt: skip
    file = BoneFile(motion=motion, time=np.arange(2) / 10, side="left", reference_frames=np.array([0]))
    write_bones(tmp_path / "bones.npz", file)
    written = {re.sub("^thigh", "NAME", key) for key in keys_of(tmp_path / "bones.npz")}
    assert written == documented("bones-npz")
    write_frames(tmp_path / "frames.json", {})
    assert keys_in(tmp_path / "frames.json") == documented("frames-json")


def test_a_comparison(tmp_path):
    nothing = SimpleNamespace(alignment=SimpleNamespace(shift_s=0.0, shift_sd_s=0.0), agreements=())
    write_comparison(tmp_path / "compare.csv", nothing)
    assert columns_of(tmp_path / "compare.csv") == documented("compare-csv")


def test_a_device(tmp_path):
    clock = DeviceClock(offset_s=0.0, drift=0.0, covariance=np.eye(2), used=9)
    write_device_clock(tmp_path / "clock.json", clock, method="signals")
    assert keys_in(tmp_path / "clock.json") == documented("clock-json")
    write_device_signals(tmp_path / "signals.csv", np.zeros(1), ("NAME",), np.zeros((1, 1)), np.zeros((1, 1)))
    assert columns_of(tmp_path / "signals.csv") == documented("signals-csv")


def test_recovered_shapes(tmp_path, rng):
    f, p, k = 3, 4, 2
    coefficients = np.ones((f, k))
    basis = rng.normal(size=(k, 3, p))
    shape = np.einsum("fk,kip->fip", coefficients, basis)
    found = RecoveredShapes(
        kind=ONE_VIEW, shape=shape, shape_sd=np.abs(shape), rotation=np.tile(np.eye(3), (f, 1, 1)),
        rotation_sd=np.full((f, 3), 0.01), translation=np.zeros((f, 2)), basis=basis, coefficients=coefficients,
        residuals=np.full((1, f, p), 0.1), predicted=np.zeros((f, p), bool), modelled=shape[None, :, :2],
        noise_sd=np.array([0.1]), gauge=GAUGES[ONE_VIEW], notes=(), path_ambiguity=np.zeros((f, 3)),
        curve=RankCurve(ranks=np.arange(2), errors=np.ones(2), errors_sd=np.ones(2), measure="error"),
        cameras=CameraRelations(
            camera_from_first=np.eye(3)[None], camera_sd=np.zeros((1, 3)), scale=np.ones(1),
            translation=np.zeros((1, f, 2)), magnification=np.ones(f),
        ),
    )  # fmt: skip
    numbers = np.zeros((1, p), int)
    write_shapes(tmp_path / "shapes.npz", found, labels=list("abcd"), camera_points=numbers, probability=numbers + 1.0)
    assert keys_of(tmp_path / "shapes.npz") == documented("shapes-npz")
    write_residuals(tmp_path / "residuals.csv", found, list("abcd"))
    assert columns_of(tmp_path / "residuals.csv") == documented("residuals-csv")
    flags = np.zeros((f, p), bool)
    tracks = FeatureTracks(tracks=shape[:, :2], tracks_sd=shape[:, :2] ** 2, visible=flags, predicted=flags)
    write_tracks(tmp_path / "tracks.npz", tracks)
    assert keys_of(tmp_path / "tracks.npz") == documented("tracks-npz")


def test_scanner_markers_and_outlines(tmp_path):
    places = np.zeros((1, 3))
    write_markers(
        tmp_path / "markers.json",
        MarkersInScanner(centres_mm=places, sd_mm=places, diameter_mm=np.ones(1), names=("a",), bones=("femur",)),
    )
    assert keys_in(tmp_path / "markers.json") == documented("markers-json")
    square = np.array([[0.0, 0], [2, 0], [2, 2]])
    contour = Contour(structure="femur", axis="k", index=0, anchors=square, outline=square)
    grid = VoxelGrid(shape=(4, 4, 4), lps_from_voxel=np.eye(4))
    write_contours(tmp_path / "contours.json", [contour], grid, "knee.nii.gz")
    whole = json.loads((tmp_path / "contours.json").read_text(encoding="utf-8"))
    assert set(whole) | set(whole["contours"][0]) == documented("contours-json")


def test_registration_and_cartilage():
    # The table of rigid.json is made in one place, of plain names.
    source = Path(register.__file__).read_text(encoding="utf-8").split("def _about")[1].split("def ")[0]
    written = set(re.findall(r'"(\w+)":', source)) | {"subject_from_template"}
    assert written == documented("rigid-json")
    assert set(tables._HEAD) == documented("cartilage-csv")


def test_a_knee_in_motion(tmp_path):
    bends = [flexed(20.0 * f) for f in range(2)]
    poses = {
        "femur": (np.array([b.rotation for b in bends]), np.array([b.translation for b in bends])),
        "tibia": (np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3))),
    }
    named = {
        frame: {
            bone: NamedTransform(to=CAPTURE_GLOBAL, from_=frame, rotation=turn, translation=place)
            for bone, (turn, place) in poses.items()
        }
        for frame in (MR_GLOBAL, MR_ANATOMIC)
    }
    motion = JointMotion(time=np.arange(2) / 10, left=False, poses=named[MR_GLOBAL], anatomical=named[MR_ANATOMIC])
    sides, _ = joint_sides(made_joint(fine=2), ["femur", "tibia"], left=False)
    three = np.zeros((2, 3))
    angles = JointKinematics(
        angle_names=("a", "b", "c"), angles=three, angles_sd=three,
        translation_names=("d", "e", "f"), translations=three, translations_sd=three,
    )  # fmt: skip
    found = KneeMotion(method="skin", motion=motion, joints=joint_proximities(motion, sides), angles=angles)
    write_knee_motion(tmp_path / "knee_motion.npz", found)
    written = {
        re.sub("^JOINT_(femoral|tibial)_cartilage", "JOINT_CARTILAGE", re.sub("^tibiofemoral", "JOINT", key))
        for key in keys_of(tmp_path / "knee_motion.npz")
    }
    assert written == documented("knee_motion-npz")
    write_proximity(tmp_path / "proximity.csv", found, replace(found, method="rigid"))
    assert columns_of(tmp_path / "proximity.csv") == documented("proximity-csv")


def test_a_correspondence(tmp_path, rng):
    scan = made_scan(rng, noise_mm=0.5)
    posture = reference_posture(scan.activity, scan.standing)
    found = correspond(scan.scanner, posture, scan.bones, segment_of_label=scan.activity.segment_of_label)
    write_correspondence(tmp_path / "correspondence.json", found)
    whole = json.loads((tmp_path / "correspondence.json").read_text(encoding="utf-8"))
    assert set(whole) | set(whole["bones"]["tibia"]) == documented("correspondence-json")


def test_the_record_of_a_run(tmp_path):
    progress = RecordingProgress()
    write_record(tmp_path, command="capture", settings={}, inputs=[], root=tmp_path, progress=progress)
    # Some are written where there is something to write: other commands' records, the steps within a stage, the
    # rounds of silhouettes and pose, the tracked patches, what is hidden, and the verdict of a capture.
    within = {"energy_nat", "overlap", "level", "reasons", "count", "mean_frames", "person", "image"}
    more = {"steps_s", "earlier", "silhouette_rounds", "surface_tracks", "hidden", "verdict", *within}
    assert keys_in(tmp_path / "run.json") | more >= documented("run-json") > more - within


def test_labels_of_a_knee(tmp_path):
    if find_spec("SimpleITK") is None:  # imported by marey alone: see `simple_itk`
        pytest.skip("SimpleITK is not installed")
    grid = VoxelGrid(shape=(2, 2, 2), lps_from_voxel=np.eye(4))
    labels = Labels(labels=np.zeros((2, 2, 2), np.uint8), grid=grid)
    write_labels(tmp_path, labels, missing={"patella": "not in the image"})
    assert keys_in(tmp_path / "labels.json") == documented("labels-json")


def test_every_result_file_of_the_writers_is_named_on_the_page():
    text = PAGE.read_text(encoding="utf-8")
    package = PAGE.parents[2] / "src" / "marey" / "pipelines"
    named = set()
    for path in package.rglob("*.py"):
        text_of_code = path.read_text(encoding="utf-8")
        written = re.findall(r'folder / f?"([\w{}./]+\.(?:npz|csv|json|trc|mot|sto|c3d|nc|osim|bvh))"', text_of_code)
        named |= {r"\w+".join(map(re.escape, re.split(r"\{[^}]*\}", name))) for name in written}
    # Files that an interrupted run needs to be resumed are deleted at the end.
    assert {name for name in named - {re.escape("tracks_state.npz")} if not re.search(name, text)} == set()

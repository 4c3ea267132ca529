"""Every kind of file on a disk that becomes full: one error that names the file, and nothing under its name."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.errors import NotWritten
from marey.geometry.rigid import RigidTransform
from marey.io import npz
from marey.io.atomic import replacing
from marey.io.calibration.readers import write_cameras_toml
from marey.io.gltf.glb import write_glb
from marey.io.markers.c3d import write_c3d
from marey.io.mr.volumes import write_labels
from marey.io.opensim.osim import write_osim
from marey.io.opensim.trc import PointPaths
from marey.io.results.csv import write_angles
from marey.io.results.netcdf import write_netcdf
from marey.io.trial.masks import write_masks
from marey.io.video.pictures import grey_pictures, write_picture
from marey.io.video.video_writer import VideoWriter
from marey.knee.space.volume import Labels, VoxelGrid

RNG = np.random.default_rng(5)
NOISE = RNG.integers(0, 256, (48, 64, 3), dtype=np.uint8)
NUMBERS = RNG.normal(size=(50, 20, 3))
VOXELS = RNG.integers(0, 3, (40, 40, 40)).astype(np.uint8)
MASKS = RNG.random((9, 48, 64)) > 0.5


def video(path: Path) -> None:
    with VideoWriter(path, (64, 48), rate=30) as writer:
        for turn in range(40):
            writer.add(np.roll(NOISE, 3 * turn, axis=1))


def c3d(path: Path, rotations: int) -> None:
    points = PointPaths(names=("a", "b"), time=np.arange(50) / 100, rate=100.0, points=NUMBERS[:, :2])
    turned = np.broadcast_to(np.eye(3), (50, rotations, 3, 3))
    names = tuple(f"s{number}" for number in range(rotations))
    more = {"segment_names": names, "segment_rotation": turned, "segment_origin": np.zeros((50, rotations, 3))}
    write_c3d(path, points, **(more if rotations else {}))


def labels(path: Path) -> None:
    grid = VoxelGrid(shape=(40, 40, 40), lps_from_voxel=np.eye(4))
    write_labels(path.parent, Labels(grid=grid, labels=VOXELS))


def cameras(path: Path) -> None:
    matrix = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    pose = RigidTransform(np.eye(3), np.zeros(3))
    camera = Camera(name="a", size=(640, 480), matrix=matrix, distortion=np.zeros(4), camera_from_world=pose)
    write_cameras_toml(Rig((camera,)), path)


def page(path: Path) -> None:
    with replacing(path) as beside:
        beside.write_text("<p>" + "x" * 5000, encoding="utf-8")


WRITERS: dict[str, Callable[..., None]] = {
    "arrays.npz": lambda path, person, motion: npz.write_arrays(path, {"x": NUMBERS}),
    "skin.npz": lambda path, person, motion: npz.write_skin(
        path, NUMBERS[:9, :20], np.zeros((4, 3), int), frames=9, count=20
    ),
    "masks.npz": lambda path, person, motion: write_masks(path, MASKS, shape=(9, 48, 64)),
    "angles.csv": lambda path, person, motion: write_angles(path, motion),
    "cameras.toml": lambda path, person, motion: cameras(path),
    "page.html": lambda path, person, motion: page(path),
    "picture.png": lambda path, person, motion: write_picture(path, NOISE),
    "video.mp4": lambda path, person, motion: video(path),
    "points.c3d": lambda path, person, motion: c3d(path, 0),
    "poses.c3d": lambda path, person, motion: c3d(path, 3),
    "body.glb": lambda path, person, motion: write_glb(path, person, motion),
    "body.osim": lambda path, person, motion: write_osim(path, person),
    "motion.nc": lambda path, person, motion: write_netcdf(path, motion),
    "labels.nii.gz": lambda path, person, motion: labels(path),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_file_that_does_not_fit_is_one_error_and_leaves_nothing(name, tmp_path, person, motion, full_disk):
    whole = tmp_path / "whole" / name
    WRITERS[name](whole, person, motion)
    size = whole.stat().st_size
    # An encoder with several threads does not write the same number of bytes twice.
    nearly = size * 9 // 10 if name == "video.mp4" else size - 1
    for most in (0, size // 2, nearly):
        path = tmp_path / str(most) / name
        with full_disk(most), pytest.raises(NotWritten) as error:
            WRITERS[name](path, person, motion)
        assert str(error.value).startswith(f"{path}: cannot be written (")
        assert list(path.parent.iterdir()) == []
    again = tmp_path / "0" / name
    WRITERS[name](again, person, motion)
    assert again.stat().st_size > size // 2


def test_a_full_disk_keeps_the_file_that_was_there(tmp_path, full_disk):
    path = tmp_path / "cameras.toml"
    cameras(path)
    before = path.read_bytes()
    with full_disk(10), pytest.raises(NotWritten):
        cameras(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("name", ["video.mp4", "poses.c3d", "arrays.npz", "labels.nii.gz"])
def test_the_error_of_a_full_disk_names_the_cause(name, mounted, person, motion):
    disk = mounted("size=8k")
    (disk / "filler").write_bytes(bytes(4096))
    with pytest.raises(NotWritten, match="No space left on device"):
        WRITERS[name](disk / name, person, motion)
    assert [path.name for path in disk.iterdir()] == ["filler"]


def test_a_read_only_disk_is_one_error(mounted, person, motion):
    with pytest.raises(NotWritten, match="Read-only file system"):
        cameras(mounted("ro") / "cameras.toml")


def test_mapped_pictures_reserve_their_space_before_they_are_written(mounted):
    """A write to a mapped file beyond the end of the disk would end the process."""

    class Clip:
        size = (640, 480)

        def images(self, frames):
            return (np.zeros((480, 640, 3), np.uint8) for _ in frames)

    disk = mounted("size=256k")
    with pytest.raises(NotWritten, match="No space left on device"):
        grey_pictures(disk / "grey.npy", Clip(), range(9), lambda: None)
    assert os.listdir(disk) == []

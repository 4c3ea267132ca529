import numpy as np
import pytest

from marey.errors import FileProblem
from marey.io.npz import write_arrays
from marey.io.shapes.trajectories import read_trajectories, write_trajectories
from marey.surface.tracks.trajectories import Trajectories


def made(rng) -> Trajectories:
    shape = (6, 4)
    position = rng.normal(size=(*shape, 3))
    position[2, 1] = np.nan
    return Trajectories(
        frames=np.arange(6), rate=29.97, position=position, velocity=rng.normal(size=(*shape, 3)),
        acceleration=rng.normal(size=(*shape, 3)), covariance=rng.normal(size=(*shape, 3, 3)),
        camera_names=("left", "right"), pixels=rng.normal(size=(*shape, 2, 2)), removed=np.array([0, 1, 0, 0], bool),
    )  # fmt: skip


def test_what_is_written_is_read_again(tmp_path, rng):
    path, given = tmp_path / "trajectories.npz", made(rng)
    write_trajectories(path, given)
    back = read_trajectories(path)
    for name, value in given.arrays().items():
        np.testing.assert_array_equal(getattr(back, name), value)
    with np.load(path) as file:
        assert set(file.files) == {
            *("frames", "rate", "position", "velocity", "acceleration", "covariance", "camera_names", "pixels"),
            "removed",
        }
        assert file["rate"].shape == ()


def test_a_file_without_trajectories_is_named(tmp_path, rng):
    path = tmp_path / "trajectories.npz"
    with pytest.raises(FileProblem, match="does not exist"):
        read_trajectories(path)
    write_arrays(path, {"frames": np.arange(3)})
    with pytest.raises(FileProblem, match="lacks rate"):
        read_trajectories(path)
    write_arrays(path, made(rng).arrays() | {"frames": np.arange(3)})
    with pytest.raises(FileProblem, match=r"cannot be used: .*position has the shape"):
        read_trajectories(path)

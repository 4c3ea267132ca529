"""Paths of points from the files of a motion that have them, for comparison with each other."""

from pathlib import Path

from marey.io.markers.c3d import read_c3d
from marey.io.npz import read_motion
from marey.io.opensim.trc import PointPaths, read_trc


def read_points(path: Path) -> PointPaths:
    """Read the markers of a TRC or a C3D, or the joint centres of a motion.npz."""
    if path.suffix == ".npz":
        motion = read_motion(path)
        return PointPaths(names=motion.joint_names, time=motion.time, rate=motion.rate, points=motion.joint_centres)
    return {".trc": read_trc, ".c3d": read_c3d}[path.suffix](path)

"""Writing motions to NetCDF with named dimensions and units, for xarray and other tools."""

from pathlib import Path

import numpy as np
from scipy.io import netcdf_file

from marey.io.atomic import replacing
from marey.motion.motion import BodyMotion

_NAMES = {"joint_names": "joint", "segment_names": "segment", "coordinate_names": "coordinate"} | {
    "angle_names": "angle",
    "camera_names": "camera",
}
"""Dimension by the variable with its names."""
_LAYOUT = {
    "time": (("time",), "s"),
    "rate": ((), "Hz"),
    "joint_centres": (("time", "joint", "space"), "m"),
    "joint_centres_sd": (("time", "joint", "space"), "m"),
    "segment_rotation": (("time", "segment", "row", "column"), "1"),
    "segment_origin": (("time", "segment", "space"), "m"),
    "coordinates": (("time", "coordinate"), "rad; the first three m"),
    "coordinates_sd": (("time", "coordinate"), "rad; the first three m"),
    "determined": (("time", "coordinate"), "1"),
    "angles_deg": (("time", "angle"), "degrees"),
    "angles_deg_sd": (("time", "angle"), "degrees"),
    "angles_determined": (("time", "angle"), "1"),
    "state": (("time",), "0 no person detected, 1 measured, 2 filled, 3 lost"),
    "agreement": (("time", "camera"), "1"),
}
"""Dimensions and unit of each variable."""


def write_netcdf(path: Path | str, motion: BodyMotion) -> None:
    """Write `motion.nc`: the keys of motion.npz as variables, with dimensions and units.

    The format is NetCDF 3 with 64-bit offsets, which xarray, MATLAB and R read without additional libraries.

    Args:
        path: The file.
        motion: The motion to write.
    """
    with replacing(path) as temporary, netcdf_file(temporary, "w", version=2) as file:
        file.title = "Motion of a person measured by marey"
        file.axes = "world: right-handed, Z up"
        file.createDimension("time", len(motion))
        for name, size in (("space", 3), ("row", 3), ("column", 3)):
            file.createDimension(name, size)
        for key, dimension in _NAMES.items():
            write_netcdf_names(file, key, dimension, getattr(motion, key))
        known = motion.arrays()
        for key, (dimensions, unit) in _LAYOUT.items():
            if key not in known:
                continue
            value = known[key]
            flag = value.dtype.kind in "bi"
            variable = file.createVariable(key, "b" if flag else "d", dimensions)
            variable.units = unit
            if value.dtype.kind == "b":
                variable.dtype = "bool"  # lets xarray read 0 and 1 as Boolean values
            variable.data[...] = value.astype(np.int8 if flag else np.float64)


def write_netcdf_names(file: netcdf_file, key: str, dimension: str, names: tuple[str, ...]) -> None:
    """Write names as rows of UTF-8 bytes, which xarray reads as strings.

    Args:
        file: The file, open for writing.
        key: Name of the variable.
        dimension: Name of the dimension, which is created with the number of names as its size.
        names: The names.
    """
    encoded = np.array([name.encode() for name in names], dtype="S")
    length = max(encoded.dtype.itemsize, 1)
    file.createDimension(dimension, len(names))
    file.createDimension(f"{dimension}_letters", length)
    variable = file.createVariable(key, "c", (dimension, f"{dimension}_letters"))
    variable._Encoding = "utf-8"
    if len(names):
        variable[:] = encoded.astype(f"S{length}").view("S1").reshape(len(names), length)

"""Writing positions of points as a poses dataset that the package `movement` opens."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.io import netcdf_file
from scipy.special import gammainc

from marey.arrays import Floats, Integers, freeze_fields
from marey.io.atomic import replacing
from marey.io.results.netcdf import write_netcdf_names

CONFIDENT_WITHIN_M = 0.03
"""Distance [m] whose probability is the confidence of a point: the true point lies within it. Chosen by hand, as the
error at which a point still lies inside of its joint; deviations of 8, 15 and 30 mm give 0.997, 0.74 and 0.20."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PoseTracks:
    """Positions and joint angles of I people over F frames."""

    people: tuple[str, ...]
    """I names."""
    names: tuple[str, ...]
    """K names of points."""
    time: Floats
    """(F,) [s]."""
    rate: float
    """Frames per second [Hz]."""
    positions: Floats
    """(F, K, 3, I) [m]; NaN where missing."""
    position_sds: Floats
    """(F, K, 3, I) standard deviations [m]; NaN where unknown."""
    angle_names: tuple[str, ...]
    """A names of joint angles."""
    angles: Floats
    """(F, A, I) [degrees]; NaN where missing."""
    angle_sds: Floats
    """(F, A, I) standard deviations [degrees]; NaN where unknown."""
    states: Integers | None = None
    """(F, I) 0 no person detected, 1 measured, 2 filled, 3 lost; None for results without states."""

    def __post_init__(self) -> None:
        freeze_fields(self, "time", "positions", "position_sds", "angles", "angle_sds")

    @property
    def confidence(self) -> Floats:
        """(F, K, I) probability that the true point lies within `CONFIDENT_WITHIN_M` of the position.

        The three axes share the mean of their variances. It is 0 where there is no position, and NaN where there is
        one whose standard deviation is unknown.
        """
        variance = np.square(self.position_sds).mean(2)
        with np.errstate(divide="ignore"):
            # The distribution of chi-square with three degrees of freedom.
            within = gammainc(1.5, 0.5 * CONFIDENT_WITHIN_M**2 / variance)
        return np.asarray(np.where(np.isfinite(self.positions).all(2), within, 0.0))


def write_movement(
    path: Path | str, tracks: PoseTracks, *, source: str, attributes: Mapping[str, str], singular: bool = False
) -> None:
    """Write a poses dataset of `movement` as NetCDF 3 with 64-bit offsets, which xarray opens with SciPy alone.

    Beside `position` and `confidence` it has `position_sd`, `joint_angle`, `joint_angle_sd` and, if known, `state`.

    Args:
        path: The file.
        tracks: Positions and angles.
        source: Name and version of the program that measured them.
        attributes: Further attributes of the dataset, by name.
        singular: Name the dimensions `keypoint` and `individual`, as `movement` does from version 0.17 on, instead
            of `keypoints` and `individuals`.
    """
    keypoint, person = ("keypoint", "individual") if singular else ("keypoints", "individuals")
    with replacing(path) as temporary, netcdf_file(temporary, "w", version=2) as file:
        needed = {"ds_type": "poses", "source_software": source, "time_unit": "seconds", "fps": float(tracks.rate)}
        for name, value in (needed | dict(attributes)).items():
            setattr(file, name, value)
        file.createDimension("time", len(tracks.time))
        named = {"space": ("x", "y", "z"), keypoint: tracks.names, person: tracks.people, "angle": tracks.angle_names}
        for dimension, names in named.items():
            write_netcdf_names(file, dimension, dimension, names)
        _write(file, "time", ("time",), tracks.time)
        for name, values in (("position", tracks.positions), ("position_sd", tracks.position_sds)):
            _write(file, name, ("time", "space", keypoint, person), np.swapaxes(values, 1, 2), "m")
        _write(file, "confidence", ("time", keypoint, person), tracks.confidence, "1")
        for name, values in (("joint_angle", tracks.angles), ("joint_angle_sd", tracks.angle_sds)):
            _write(file, name, ("time", "angle", person), values, "degrees")
        if tracks.states is not None:
            _write_states(file, tracks.states, person)


def _write_states(file: netcdf_file, states: Integers, person: str) -> None:
    state = file.createVariable("state", "b", ("time", person))
    state.flag_values = np.arange(4, dtype=np.int8)
    state.flag_meanings = "no_person measured filled lost"
    state.data[...] = states


def _write(file: netcdf_file, name: str, dimensions: tuple[str, ...], values: Floats, unit: str | None = None) -> None:
    """Write a variable of numbers; the time has no unit, because xarray would read it as durations."""
    variable = file.createVariable(name, "d", dimensions)
    if unit is not None:
        variable.units = unit
    variable.data[...] = values

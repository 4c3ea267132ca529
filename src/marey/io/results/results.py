"""Writing all result files of a capture that contain the motion or the body."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.body.articulation.surface import Body
from marey.io import npz
from marey.io.gltf.bvh import write_bvh
from marey.io.gltf.glb import write_glb
from marey.io.markers.c3d import write_c3d
from marey.io.opensim.mot_sto import Orientations, TimeSeriesTable, write_orientations, write_table
from marey.io.opensim.osim import write_osim
from marey.io.opensim.trc import PointPaths, write_trc
from marey.io.results import body as body_file
from marey.io.results.csv import write_angles
from marey.io.results.netcdf import write_netcdf
from marey.motion.events.cycles import GaitEvent
from marey.motion.motion import BodyMotion


def write_results(
    folder: Path | str,
    motion: BodyMotion,
    body: Body,
    *,
    preset: str,
    mass_kg: float | None = None,
    skin: Iterable[Floats] | None = None,
    skin_faces: Integers | None = None,
    seen: Iterable[Mask] | None = None,
    events: Sequence[GaitEvent] = (),
) -> None:
    """Write all files of a captured motion; each file is either complete or absent.

    Args:
        folder: The folder; created if it does not exist.
        motion: The measured motion.
        body: The body at rest.
        preset: Name of the body's preset.
        mass_kg: Mass of the person for the OpenSim model; None if unknown.
        skin: The posed skin, one array (V, 3) per frame in the world [m], NaN in frames without a pose, as an array
            (F, V, 3) or an iterable; None if `skin.npz` should not be written.
        skin_faces: (T, 3) faces of the skin, which contain all its vertices; None for the faces of the body.
        seen: One array (V,) per frame, true for vertices that were measured by an observation.
        events: Gait events, for `motion.c3d`.
    """
    folder = Path(folder)
    npz.write_motion(folder / "motion.npz", motion)
    write_netcdf(folder / "motion.nc", motion)
    write_motion_tables(folder, motion, events)
    write_osim(folder / "body.osim", body, mass_kg=mass_kg)
    body_file.write_body(folder / "body.npz", body, preset=preset)
    write_glb(folder / "body.glb", body, motion)
    if motion.answered.any():
        write_bvh(folder / "motion.bvh", body, motion)
    if skin is not None:
        faces, count = body.faces, len(body.vertices)
        if skin_faces is not None and skin_faces is not faces:
            faces, count = skin_faces, int(skin_faces.max()) + 1
        npz.write_skin(folder / "skin.npz", skin, faces, seen, frames=len(motion), count=count)


def write_motion_tables(folder: Path | str, motion: BodyMotion, events: Sequence[GaitEvent] = ()) -> None:
    """Write the files that contain only the motion.

    These are `joint_centres.trc`, `angles.mot`, `orientations.sto`, `motion.c3d` and `angles.csv`.

    Args:
        folder: The folder.
        motion: The measured motion.
        events: Gait events, for `motion.c3d`.
    """
    folder = Path(folder)
    paths = PointPaths(names=motion.joint_names, time=motion.time, rate=motion.rate, points=motion.joint_centres)
    write_trc(folder / "joint_centres.trc", paths)
    values = np.array(motion.coordinates)
    values[:, 3:] = np.degrees(values[:, 3:])
    write_table(
        folder / "angles.mot",
        TimeSeriesTable(name="angles", columns=motion.coordinate_names, time=motion.time, values=values),
    )
    write_orientations(
        folder / "orientations.sto",
        Orientations(
            names=motion.segment_names, time=motion.time, rate=motion.rate, world_from_body=motion.segment_rotation
        ),
    )
    write_c3d(
        folder / "motion.c3d",
        paths,
        segment_names=motion.segment_names,
        segment_rotation=motion.segment_rotation,
        segment_origin=motion.segment_origin,
        events=[replace(event, time=event.time - float(motion.time[0])) for event in events],
    )
    write_angles(folder / "angles.csv", motion)

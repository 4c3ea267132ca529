"""Registration of bones made from label maps: back from 30 degrees and 30 mm, and one person's bent into another's.

    python bench/knee_registration.py SHARED [rigid|elastic|thickness] [--draws N]

SHARED holds `data/knee`. `rigid`: a bone's surface from a label map, its field of view cut shorter and its mesh another
one than the template's, is moved by 30 degrees about an axis through its middle and by 30 mm, both in random
directions; prints one JSON line a bone: median and greatest error of what `register_rigidly` finds, the share within
0.3 degrees and 0.3 mm, the share of the six numbers within two of their stated standard deviations. `elastic`: one line
a pair: mean distance of the surfaces before and after, 95 %, the least determinant of the Jacobian, seconds of process
time. `thickness`: leaves thickness_femur.npz and thickness_tibia.npz in the working folder for `score/thickness.py`.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from marey.geometry.rigid import RigidTransform
from marey.io.meshes import read_mesh
from marey.io.npz import write_arrays
from marey.io.volumes import read_labels
from marey.knee.cut_ends import cut_planes
from marey.knee.elastic_registration import register_elastically, surface_distances
from marey.knee.rigid_registration import register_rigidly
from marey.knee.sides import mirrored
from marey.knee.surface import Surface
from marey.knee.surfacing import surface_of_labels
from marey.knee.thickness import cartilage_thickness
from marey.knee.volume import Grid, Labels

SHORTER_MM = 15.0
PAIRS = (
    ("atlas", "template_a", "femur"), ("atlas", "dess", "femur"), ("atlas", "thickness", "femur"),
    ("dess", "template_a", "femur"), ("dess", "thickness", "femur"), ("thickness", "template_a", "femur"),
    ("template_a", "atlas", "tibia"), ("atlas", "template_a", "patella"),
)  # fmt: skip
LEFT = ("atlas",)


def labels_of(shared: Path, name: str) -> Labels:
    folder = shared / "data" / "knee" / name
    if name != "dess":
        return read_labels(folder)
    return read_labels(folder / "reference_labels.nii.gz")


def surface_of(shared: Path, name: str, bone: str) -> Surface:
    if name == "thickness":
        return read_mesh(shared / "data" / "knee" / "thickness" / f"{bone}.npz")
    return surface_of_labels(labels_of(shared, name), bone)


def shortened(labels: Labels, bone: str) -> Labels:
    """The same without the last of the shaft."""
    filled = np.argwhere(labels.mask(bone))
    heights = labels.grid.lps(filled[:, ::-1].astype(float))[:, 2]
    keep = heights < heights.max() - SHORTER_MM if bone == "femur" else heights > heights.min() + SHORTER_MM
    cut = np.zeros_like(labels.labels)
    spots = tuple(filled[keep].T)
    cut[spots] = labels.labels[spots]
    return Labels(labels=cut, grid=Grid(shape=labels.grid.shape, lps_from_voxel=labels.grid.lps_from_voxel))


def rigid(shared: Path, draws: int) -> None:
    rng = np.random.default_rng(1)
    for name, bone in (("template_a", "femur"), ("template_a", "tibia"), ("atlas", "femur"), ("atlas", "patella")):
        labels = labels_of(shared, name)
        template = surface_of_labels(labels, bone)
        other = labels if bone == "patella" else shortened(labels, bone)
        subject = surface_of_labels(other, bone, edge_mm=1.5)
        middle = template.vertices_mm.mean(0)
        errors, whitened, spent = [], [], []
        for _ in range(draws):
            axis, shift = rng.normal(size=(2, 3))
            turn = RigidTransform.from_vector(np.radians(30) * axis / np.linalg.norm(axis), np.zeros(3)).rotation
            true = RigidTransform(turn, middle - turn @ middle + 30 * shift / np.linalg.norm(shift))
            moved = Surface(vertices_mm=true.apply(subject.vertices_mm), faces=subject.faces)
            began = time.process_time()
            found = register_rigidly(template, moved)
            spent.append(time.process_time() - began)
            left = found.subject_from_template @ true.inverse()
            off = found.subject_from_template.apply(middle) - true.apply(middle)
            errors.append((np.degrees(np.linalg.norm(left.rotation_vector)), np.linalg.norm(off)))
            whitened.append(np.r_[left.rotation_vector, off] / np.sqrt(np.diag(found.covariance)))
        table = np.array(errors)
        line = {
            "bone": f"{name} {bone}", "draws": draws,
            "median_deg": np.median(table[:, 0]), "worst_deg": table[:, 0].max(),
            "median_mm": np.median(table[:, 1]), "worst_mm": table[:, 1].max(),
            "success": (table < 0.3).all(1).mean(), "within_two_sd": (np.abs(whitened) < 2).mean(),
            "seconds": np.median(spent),
        }  # fmt: skip
        rounded = {
            key: value if isinstance(value, (str, int)) else round(float(value), 4) for key, value in line.items()
        }
        print(json.dumps(rounded), flush=True)


def elastic(shared: Path) -> None:
    for first, second, bone in PAIRS:
        template, subject = surface_of(shared, first, bone), surface_of(shared, second, bone)
        template = mirrored(template) if (first in LEFT) != (second in LEFT) else template
        began = time.process_time()
        found = register_rigidly(template, subject)
        laid = Surface(vertices_mm=found.subject_from_template.apply(template.vertices_mm), faces=template.faces)
        before = surface_distances(laid, subject, cut_planes(laid), cut_planes(subject))
        bent = register_elastically(laid, subject)
        line = {
            "pair": f"{bone}: {first} to {second}", "rigid_mm": round(float(before.mean()), 2),
            "mean_mm": round(bent.surface_distance_mm, 3), "within_95_mm": round(bent.farthest_mm, 2),
            "least_determinant": round(bent.least_determinant, 3), "seconds": round(time.process_time() - began, 1),
        }  # fmt: skip
        print(json.dumps(line), flush=True)


def thickness(shared: Path) -> None:
    folder = shared / "data" / "knee" / "thickness"
    parts = {"femur": ("femoral_cartilage",), "tibia": ("medial_tibial_cartilage", "lateral_tibial_cartilage")}
    for bone, cartilages in parts.items():
        surfaces = [read_mesh(folder / f"{name}.npz") for name in cartilages]
        found = cartilage_thickness(read_mesh(folder / f"{bone}.npz"), surfaces)
        write_arrays(f"thickness_{bone}.npz", {"thickness_mm": found})


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("shared", type=Path)
    parser.add_argument("what", nargs="?", choices=("rigid", "elastic", "thickness"))
    parser.add_argument("--draws", type=int, default=50)
    given = parser.parse_args()
    with threadpool_limits(1):
        if given.what in (None, "rigid"):
            rigid(given.shared, given.draws)
        if given.what in (None, "elastic"):
            elastic(given.shared)
        if given.what in (None, "thickness"):
            thickness(given.shared)


if __name__ == "__main__":
    main()

"""Bones from MR against the shared references: `python bench/knee_bones.py SHARED OUT [NAME ...] [--no-template]`.

Each NAME is segmented, its labels and surfaces go to OUT/NAME, and Dice, ASD and HD95 of the bones are printed as
../shared/score/knee.py counts them, with the time and the memory. Names: dess, phantom_a, phantom_spl,
phantom_spl_t1, phantom_spl+phantom_spl_t1 (two volumes), mese (no reference: volumes only).
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from pathlib import Path

from threadpoolctl import threadpool_limits

from marey.io.meshes import write_mesh
from marey.io.volumes import read_template, read_volume, write_labels
from marey.knee.bones import segment_bones
from marey.knee.surfacing import surface_of_field

NAMES = ("dess", "phantom_a", "phantom_spl", "phantom_spl_t1", "phantom_spl+phantom_spl_t1", "mese")
TEMPLATES = {"dess": "atlas", "phantom_a": "atlas", "mese": "atlas"}


def volume_path(shared: Path, name: str) -> Path:
    folder = shared / "data" / "knee" / name
    return folder if name == "mese" else folder / "image.nii.gz"


def segment(shared: Path, name: str, out: Path, *, with_template: bool) -> dict[str, object]:
    started = time.perf_counter()
    volumes = [read_volume(volume_path(shared, each)) for each in name.split("+")]
    folder = shared / "data" / "knee" / TEMPLATES.get(name, "template_a")
    found = segment_bones(volumes, template=read_template(folder) if with_template else None)
    write_labels(out, found.labels)
    volumes_cm3 = {}
    for bone, each in found.bones.items():
        surface = surface_of_field(each.distance_mm, each.grid)
        write_mesh(out / f"{bone}.ply", surface)
        volumes_cm3[bone] = round(surface.volume_mm3 / 1000, 1)
    seconds = round(time.perf_counter() - started, 1)
    return {"marrow": found.kinds, "cm3": volumes_cm3, "seconds": seconds, "notes": found.notes}


def score(shared: Path, name: str, out: Path) -> dict[str, object]:
    first = shared / "data" / "knee" / name.split("+")[0]
    truth = first / ("reference_labels.nii.gz" if name == "dess" else "truth_labels.nii.gz")
    rows = ["--rows", "60", "400"] if name == "dess" else []
    script = [sys.executable, str(shared / "score" / "knee.py"), str(out / "labels.nii.gz"), str(truth), *rows]
    told = json.loads(subprocess.run(script, check=True, capture_output=True, text=True).stdout)
    return {bone: told.get(bone) for bone in ("femur", "tibia", "patella")}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("shared", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("names", nargs="*", default=NAMES)
    parser.add_argument("--no-template", action="store_true")
    asked = parser.parse_args()
    for name in asked.names:
        out = asked.out / name.replace("+", "_and_")
        with threadpool_limits(1):
            told = segment(asked.shared, name, out, with_template=not asked.no_template)
        if name != "mese":
            told |= score(asked.shared, name, out)
        told["peak_gb"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6, 2)
        print(name, json.dumps(told), flush=True)


if __name__ == "__main__":
    main()

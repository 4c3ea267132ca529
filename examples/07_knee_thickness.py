"""Segment a knee in an MR volume, and report the thickness of its cartilage.

    python examples/07_knee_thickness.py KNEE.nii.gz --template ATLAS [--out knee]
    python examples/07_knee_thickness.py RESULTS

Input: an MR volume and a template (a folder with the labels of another knee), or a folder with the results of
`marey knee segment`.
Output: the files of `marey knee segment` in the folder OUT, thickness on the terminal, and `thickness.png`.
Features: `marey.segment_knee`, `marey.load_knee`, `Knee.thickness`, `Knee.to_pandas`, `Knee.plot`.
Needs the optional packages of the group `knee`.
"""

import argparse
from pathlib import Path

import matplotlib
import numpy as np

import marey

matplotlib.use("Agg")


def main(arguments: list[str] | None = None) -> marey.Knee:
    """Segment the knee or read it, and report the thickness of each cartilage."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("knee", type=Path, help="an MR volume, or a folder of results")
    parser.add_argument("--template", type=Path, default=None)
    parser.add_argument("--out", type=Path, default=Path("knee"))
    given = parser.parse_args(arguments)

    if (given.knee / "labels.nii.gz").is_file():
        knee = marey.load_knee(given.knee)
    else:
        knee = marey.segment_knee(given.knee, template=given.template)
        knee.save(given.out)
    print(knee)
    for name, reason in knee.missing.items():
        print(f"Not found: {name} ({reason})")

    given.out.mkdir(parents=True, exist_ok=True)
    for bone, cartilage in knee.thickness.items():
        covered = cartilage.thickness_mm > 0
        sd = np.sqrt(np.average(cartilage.sd_mm[covered] ** 2, weights=cartilage.areas_mm2[covered]))
        print(
            f"Cartilage of the {bone}: mean {cartilage.mean_mm:.2f} mm; a single vertex has a deviation of {sd:.2f} mm"
        )
        axes = knee.plot(bone)
        axes.figure.savefig(given.out / f"{bone}_thickness.png", dpi=120)
    print(knee.to_pandas().to_string(index=False))
    return knee


if __name__ == "__main__":
    main()

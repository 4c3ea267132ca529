"""Read results of a capture into xarray and pandas.

    python examples/08_results_as_tables.py [CAPTURED]

Input: a folder of results of `marey capture` (see example 1).
Output: labelled arrays and tables on the terminal; `angles_by_second.csv` in the same folder.
Features: `marey.load_motion`, `Motion.to_xarray`, `Motion.to_pandas`, `Curve.flags`.
"""

import argparse
from pathlib import Path

import numpy as np

import marey


def main(arguments: list[str] | None = None) -> Path:
    """Show the motion as labelled arrays, select and average it, and write a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captured", nargs="?", type=Path, default=Path("knee"))
    given = parser.parse_args(arguments)
    motion = marey.load_motion(given.captured)

    # Labelled arrays: dimensions have names, variables have units, standard deviations are beside the values.
    data = motion.to_xarray()
    print(data)
    centres = data["joint_centres"].dropna("time", how="all")
    print(f"Mean height of the left wrist: {float(centres.sel(joint='left_wrist', space='z').mean()):.3f} m")

    # A table with one row per frame and one column per angle.
    table = motion.to_pandas()
    print(table.describe().T[["mean", "std", "min", "max"]].round(1).to_string())

    # A coordinate that the images do not determine is flagged; leave such values out of statistics.
    for curve in motion.coordinates.matching("elbow"):
        plain = np.array([flag == "" for flag in curve.flags])[motion.measured]
        print(f"{curve.name}: determined in {100 * plain.mean():.0f} % of the measured frames")

    by_second = table.groupby(table.index.astype(float) // 1).mean(numeric_only=True)
    path = given.captured / "angles_by_second.csv"
    by_second.to_csv(path)
    print(f"Table: {path}")
    return path


if __name__ == "__main__":
    main()

"""CSV: the anatomical angles as a spreadsheet reads them."""

import csv
from pathlib import Path

from marey.io.atomic import replacing
from marey.motion.motion import Motion


def write_angles(path: Path | str, motion: Motion) -> None:
    """Write `angles.csv`: a row a frame with time, state, and every angle beside its standard deviation.

    The header carries the units; where there is no answer the cells are empty.

    Args:
        path: The file.
        motion: What to write.
    """
    head = ["time_s", "state"] + [f"{name}{end}" for name in motion.angle_names for end in ("_deg", "_sd_deg")]
    with replacing(path) as beside, beside.open("w", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(head)
        for time, state, angles, sds in zip(
            motion.time, motion.state, motion.angles_deg, motion.angles_deg_sd, strict=True
        ):
            cells = [value for pair in zip(angles, sds, strict=True) for value in pair]
            rows.writerow([f"{time:.6f}", int(state), *("" if v != v else f"{v:.5f}" for v in cells)])

"""Capture the same trial with another set of cameras, and compare both motions.

    python examples/02_another_set_of_cameras.py [TRIAL] [--without cam03] [--frames 40:70]

Input: a trial; by default the one that comes with marey.
Output: how far the angles of both motions differ, on the terminal.
Features: `marey.read_cameras`, `marey.capture(cameras=...)`, `marey.compare`, `Comparison.to_pandas`.
"""

import argparse
from pathlib import Path

import numpy as np

import marey


def main(arguments: list[str] | None = None) -> marey.Comparison:
    """Capture with all cameras and with a part of them, and compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("trial", nargs="?", type=Path, default=None)
    parser.add_argument("--without", default="cam03", help="camera that is left out")
    parser.add_argument("--frames", default="40:70", help="first frame and the frame after the last")
    given = parser.parse_args(arguments)
    trial = given.trial or marey.example_folder()
    first, end = map(int, given.frames.split(":"))

    # The calibration alone: where each camera stands, and in which direction it looks.
    rig = marey.read_cameras(trial)
    for camera in rig:
        height = camera.centre[2]
        print(f"{camera.name}: {camera.width} x {camera.height} px, {height:.2f} m above the floor")

    kept = [name for name in rig.names if name != given.without]
    with marey.tuned_process():
        whole = marey.capture(trial, frames=range(first, end), overlay=False)
        part = marey.capture(trial, frames=range(first, end), cameras=kept, overlay=False)

    comparison = marey.compare(whole, part, same_laboratory=True, shift=0.0)
    table = comparison.to_pandas()
    print(f"All {len(rig)} cameras and {', '.join(kept)}:")
    print(table.to_string())

    # The standard deviations grow where a camera is missing.
    for name in ("left elbow flexion", "right elbow flexion"):
        before, after = (np.nanmedian(motion.angles[name].sd) for motion in (whole, part))
        print(f"{name}: standard deviation {before:.1f} degrees with all cameras, {after:.1f} without {given.without}")
    return comparison


if __name__ == "__main__":
    main()

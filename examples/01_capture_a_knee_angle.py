"""Capture a trial and plot a knee angle with its 95 % interval.

    python examples/01_capture_a_knee_angle.py [TRIAL] [--frames 30:130] [--out knee]

Input: a trial, that is a folder with `cameras.toml` and one video per camera; by default the one that comes with marey.
Output: the files of `marey capture` and `knee_angle.png` in the folder OUT.
Features: `marey.open_trial`, `marey.capture`, `motion.angles`, `Curve.interval`, `motion.plot`.
"""

import argparse
from pathlib import Path

import matplotlib
import numpy as np

import marey

matplotlib.use("Agg")


def main(arguments: list[str] | None = None) -> marey.Motion:
    """Capture the trial, print the range of the angle, and save the plot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("trial", nargs="?", type=Path, default=None)
    parser.add_argument("--frames", default="30:130", help="first frame and the frame after the last")
    parser.add_argument("--angle", default="left knee flexion")
    parser.add_argument("--out", type=Path, default=Path("knee"))
    given = parser.parse_args(arguments)
    first, end = map(int, given.frames.split(":"))

    trial = marey.open_trial(given.trial or marey.example_folder(), frames=range(first, end))
    with marey.tuned_process():
        motion = marey.capture(trial, out=given.out, overlay=False)
    print(motion)

    # One angle over time: values in degrees, standard deviations, and a flag for every frame.
    angle = motion.angles[given.angle]
    low, high = angle.interval(0.95)
    peak = int(np.nanargmax(np.asarray(angle)))
    print(f"Largest {given.angle}: {angle[peak]:.1f} degrees, 95 % interval {low[peak]:.1f} to {high[peak]:.1f}")

    axes = motion.plot(given.angle)
    figure = np.ravel(np.asarray(axes))[0].figure
    figure.savefig(given.out / "knee_angle.png", dpi=120)
    print(f"Plot: {given.out / 'knee_angle.png'}")
    return motion


if __name__ == "__main__":
    main()

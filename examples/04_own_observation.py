"""Add an observation of a kind that marey does not have.

    python examples/04_own_observation.py [TRIAL] [--frames 40:60]

Input: a trial; by default the one that comes with marey. Suppose that a laser measured the height of the head's joint
above the floor in some frames, with a standard deviation of 2 mm.
Output: the height of the joint with and without these measurements, on the terminal.
Features: `marey.Observation`, `marey.Linearization`, `marey.capture(observations=...)`.

An observation holds measurements of one kind for one frame. It provides `sigma`, the standard deviation of a residual
in the residual's own unit, and `linearize`, which predicts the measurements for a posed body: residuals and their
derivatives with respect to the pose and, on request, to the shape of the body.
"""

import argparse
from pathlib import Path

import numpy as np

import marey


class HeightAboveFloor(marey.Observation):
    """The height of a segment's origin above the floor was measured."""

    def __init__(self, segment: int, height_m: float, sigma_m: float):
        self.segment, self.height_m, self.sigma_m = segment, height_m, sigma_m

    @property
    def sigma(self) -> float:
        """Standard deviation of a residual [m]."""
        return self.sigma_m

    def linearize(self, posed, *, shape: bool = False) -> marey.Linearization:
        """Return predicted minus measured height, and its derivatives."""
        residual = posed.segment_origin[self.segment][2:] - self.height_m
        jacobian = posed.pose_jacobian(*posed.joint_parts(np.array([self.segment])))[:, 2]
        if shape:
            jacobian = np.hstack([jacobian, posed.origin_shape_jacobian()[self.segment, 2:]])
        return marey.Linearization(residual, jacobian)


def main(arguments: list[str] | None = None) -> tuple[float, float]:
    """Capture with and without the laser, and print the mean height of the head."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("trial", nargs="?", type=Path, default=None)
    parser.add_argument("--frames", default="40:60", help="first frame and the frame after the last")
    parser.add_argument(
        "--raised", type=float, default=0.02, help="how much higher than the video the laser measures [m]"
    )
    given = parser.parse_args(arguments)
    trial = given.trial or marey.example_folder()
    frames = range(*map(int, given.frames.split(":")))

    with marey.tuned_process():
        video = marey.capture(trial, frames=frames, overlay=False)
        head = video.body.skeleton.segment_names.index("head")
        seen = video.data.segment_origin[frames, head, 2]
        laser = {
            frame: [HeightAboveFloor(head, height + given.raised, sigma_m=0.002)]
            for frame, height in zip(frames, seen, strict=True)
        }
        both = marey.capture(trial, frames=frames, overlay=False, observations=laser)
    heights = float(np.nanmean(seen)), float(np.nanmean(both.data.segment_origin[frames, head, 2]))
    print(f"Mean height of the head: {heights[0]:.4f} m by video, {heights[1]:.4f} m by video and laser")
    return heights


if __name__ == "__main__":
    main()

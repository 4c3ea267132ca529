"""Estimate bones from skin markers, and compare them with the video of the same trial.

    python examples/03_markers_beside_video.py [CAPTURED] [--out markers]

Input: a folder of results of `marey capture` (see example 1). A laboratory that filmed a trial and recorded markers at
the same time gives its C3D instead of the markers that this example makes: four markers on each thigh and shank of the
captured body, with measurement noise of 0.5 mm and skin that slides by up to 4 mm. The poses of the bones in the first
frame have anatomical axes (X forward, Y up, Z to the right), so that the knee angles mean the same in both systems.
Output: the made recording in OUT_recorded; the files of `marey markers` in the folder OUT; the differences of the knee
angles on the terminal.
Features: `marey.load_motion`, `marey.open_markers`, `marey.estimate_bones`, `Bones.angles`.
"""

import argparse
from pathlib import Path

import numpy as np

import marey
from marey.motion.anatomical import anatomy_of

SEGMENTS = ("left_thigh", "left_shank", "right_thigh", "right_shank")
NOISE_M = 0.0005
"""Standard deviation of a measured coordinate [m]."""
SLIDING_M = 0.004
"""Largest shift of the skin over the bone [m]."""


def made_markers(motion: marey.Motion, folder: Path) -> tuple[Path, Path]:
    """Write a CSV of markers on the captured body and an NPZ with the bones of the first measured frame."""
    rng = np.random.default_rng(0)
    frames = np.flatnonzero(motion.measured)
    time = motion.time[frames] - motion.time[frames[0]]
    axes = anatomy_of(motion.body.skeleton, motion.body.joint_centres).frames
    reference: dict[str, np.ndarray] = {"frame": np.array(0)}
    header, columns = ["time"], [time]
    for name in SEGMENTS:
        index = motion.data.segment_names.index(name)
        rotation, origin = motion.data.segment_rotation[frames, index], motion.data.segment_origin[frames, index]
        reference[f"{name}_rotation"], reference[f"{name}_origin"] = rotation[0] @ axes[index], 1000 * origin[0]
        places = rng.uniform(-0.07, 0.07, (4, 3)) * [1.0, 1.0, 1.5] + [0.0, 0.0, -0.2]
        slide = SLIDING_M * np.sin(2 * np.pi * (time[:, None, None] + rng.uniform(0, 1, (4, 1)))) * [0.0, 0.0, 1.0]
        slide -= slide[0]
        points = origin[:, None] + np.einsum("fij,fmj->fmi", rotation, places + slide)
        points += rng.normal(0.0, NOISE_M, points.shape)
        for m in range(4):
            for axis, letter in enumerate("xyz"):
                header.append(f"{name}_{m + 1:02d}_{letter}_m")
                columns.append(points[:, m, axis])
    folder.mkdir(parents=True, exist_ok=True)
    table, known = folder / "markers.csv", folder / "reference.npz"
    np.savetxt(table, np.column_stack(columns), delimiter=",", header=",".join(header), comments="", fmt="%.6f")
    np.savez(known, **reference)
    return table, known


def main(arguments: list[str] | None = None) -> marey.Bones:
    """Estimate the bones and print how far both systems differ."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captured", nargs="?", type=Path, default=Path("knee"))
    parser.add_argument("--out", type=Path, default=Path("markers"))
    given = parser.parse_args(arguments)

    motion = marey.load_motion(given.captured)
    table, reference = made_markers(motion, given.out.with_name(f"{given.out.name}_recorded"))

    trial = marey.open_markers(table, reference=reference)
    bones = marey.estimate_bones(trial, method=["skin", "rigid"], out=given.out)
    print(bones)

    # The orientation of the shank relative to the thigh, since the first frame, by video and by markers.
    frames = np.flatnonzero(motion.measured)
    for side in ("left", "right"):
        video = turned(motion.rotation(f"{side}_thigh")[frames], motion.rotation(f"{side}_shank")[frames])
        for method in ("skin", "rigid"):
            run = bones.method(method).runs[0].motion
            thigh, shank = (run.rotation[:, run.segments.index(f"{side}_{name}")] for name in ("thigh", "shank"))
            difference = np.sqrt(np.nanmean((turned(thigh, shank) - video) ** 2))
            print(f"{side} knee, method {method}: differs from the video by {difference:.2f} degrees (RMS)")
    return bones


def turned(parent: np.ndarray, child: np.ndarray) -> np.ndarray:
    """Return the angle (F,) [degrees] by which the child has turned in its parent since the first frame."""
    relative = np.swapaxes(parent, 1, 2) @ child
    trace = np.trace(np.swapaxes(relative[:1], 1, 2) @ relative, axis1=1, axis2=2)
    return np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))


if __name__ == "__main__":
    main()

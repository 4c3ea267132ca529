"""Made studies: short marker trials of several subjects and conditions, whose knees bend by known amounts."""

from pathlib import Path

import numpy as np

from tests.trials import marker_points, write_reference, write_trial

TOML = """
pattern = "{subject}/{condition}_*.c3d"

[[steps]]
command = "markers"
method = "rigid"
reference = "frame0.npz"
"""


def write_study(folder: Path, *, subjects: int = 2, conditions: tuple[str, ...] = ("slow",), trials: int = 1) -> Path:
    """Write a study of marker trials that differ by their noise."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "study.toml").write_text(TOML)
    write_reference(folder / "frame0.npz")
    rng = np.random.default_rng(8)
    for subject in range(subjects):
        (folder / f"S{subject + 1:02d}").mkdir(exist_ok=True)
        for condition in conditions:
            for trial in range(trials):
                points = marker_points(frames=40)
                noisy = {name: path + 1e-3 * rng.normal(size=path.shape) for name, path in points.items()}
                write_trial(folder / f"S{subject + 1:02d}" / f"{condition}_{trial + 1}.c3d", noisy)
    return folder

"""Render the images of the documentation from the example take and its results.

    marey demo --out results
    python docs/tools/pictures.py results

Screenshots of report pages need Chromium; `--chromium` names the program where it is not found by itself.
`report-before.jpg` is kept: it shows a page as it was before verdicts.
"""

import argparse
import shutil
import subprocess
import tempfile
from pathlib import Path

import cv2
import numpy as np
from matplotlib.figure import Figure

from marey.cli.main import run
from marey.io.opensim.trc import PointPaths, write_trc

ROOT = Path(__file__).parents[2]
TAKE = ROOT / "examples" / "reach"
FRAME = 50
"""Frame of the stills: both arms are raised, and every limb is visible in some camera."""
QUALITY = 82
"""JPEG quality: images of 50 to 120 kB."""
CAMERAS = ("cam01", "cam02", "cam03", "cam04")


def main() -> None:
    """Write all images into docs/pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, help="folder in which `marey demo --out` left its results")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "pictures")
    parser.add_argument("--chromium", default=shutil.which("chromium") or shutil.which("google-chrome"))
    given = parser.parse_args()
    given.out.mkdir(exist_ok=True)
    write(given.out / "take.jpg", grid([still(TAKE / f"{name}.mp4", FRAME) for name in CAMERAS], 640))
    write(given.out / "background.jpg", grid([cv2.imread(str(TAKE / "background" / f"{n}.png")) for n in CAMERAS], 640))
    overlays = [still(given.results / f"overlay_{name}.mp4", FRAME) for name in CAMERAS]
    write(given.out / "overlay.jpg", grid(overlays, 640))
    write(given.out / "overlay-close.jpg", overlays[0])
    write(given.out / "silhouette.jpg", silhouette(given.results, CAMERAS[0]))
    angle(given.results, "elbow_flexion", "Elbow flexion", given.out / "elbow.png")
    angle(given.results, "knee_rotation", "Knee rotation", given.out / "knee-rotation.png")
    if given.chromium:
        report(given.chromium, given.results / "report.html", given.out)
        comparison(given.chromium, given.results, given.out)


def still(video: Path, frame: int) -> np.ndarray:
    """Read one frame of a video, (height, width, 3), blue first."""
    clip = cv2.VideoCapture(str(video))
    for _ in range(frame + 1):
        found, picture = clip.read()
        if not found:
            raise SystemExit(f"{video} has no frame {frame}. Run marey demo with overlay videos.")
    return picture


def grid(pictures: list[np.ndarray], width: int) -> np.ndarray:
    """Put images beside each other, each `width` pixels wide."""
    scaled = [
        cv2.resize(p, (width, round(width * p.shape[0] / p.shape[1])), interpolation=cv2.INTER_AREA) for p in pictures
    ]
    return cv2.resize(np.hstack(scaled), None, fx=0.55, fy=0.55, interpolation=cv2.INTER_AREA)


def silhouette(results: Path, camera: str) -> np.ndarray:
    """Image and silhouette of one frame beside each other."""
    with np.load(results / "masks" / f"{camera}.npz") as file:
        frames, height, width = file["shape"]
        masks = np.unpackbits(file["bits"], count=int(frames * height * width)).reshape(frames, height, width)
    white = np.repeat(masks[FRAME][:, :, None] * np.uint8(255), 3, axis=2)
    return np.hstack([still(TAKE / f"{camera}.mp4", FRAME), white])


def angle(results: Path, name: str, title: str, path: Path) -> None:
    """Plot an angle of both sides over time with its 95 % interval."""
    with np.load(results / "motion.npz") as file:
        names = file["angle_names"].tolist()
        time, values, deviations = file["time"], file["angles_deg"], file["angles_deg_sd"]
    figure = Figure(figsize=(7, 3), layout="constrained")
    axes = figure.subplots()
    for side, colour in (("left", "#1f6fb5"), ("right", "#c23b33")):
        index = names.index(f"{side}_{name}")
        value, half = values[:, index], 1.96 * deviations[:, index]
        axes.plot(time, value, color=colour, label=side)
        axes.fill_between(time, value - half, value + half, color=colour, alpha=0.2, linewidth=0)
    axes.set(xlabel="time (s)", ylabel="angle (degrees)", title=f"{title}, with 95 % interval")
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=110)


def report(chromium: str, page: Path, out: Path) -> None:
    """Screenshots of the report: its head with the replay, and its curves."""
    picture = screenshot(chromium, page, 2400)
    write(out / "report.jpg", scaled(picture[:1245], 0.8))
    write(out / "report-curves.jpg", scaled(picture[1235:1980], 0.8))


def comparison(chromium: str, results: Path, out: Path) -> None:
    """Screenshot of a comparison: the captured motion with the true joint centres of the rendered person."""
    with np.load(TAKE / "truth" / "truth.npz") as truth:
        joints, rate = truth["joints"], float(truth["rate"])
        time = (np.arange(len(joints)) + int(truth["empty"])) / rate
        paths = PointPaths(names=tuple(map(str, truth["joint_names"])), time=time, rate=rate, points=joints)
    with tempfile.TemporaryDirectory() as folder:
        write_trc(Path(folder) / "truth.trc", paths)
        arguments = ["compare", str(results), str(Path(folder) / "truth.trc"), "--out", str(Path(folder) / "compared")]
        if run([*arguments, "--quiet"]):
            raise SystemExit("The comparison failed.")
        picture = screenshot(chromium, Path(folder) / "compared" / "report.html", 1200)
    write(out / "comparison.jpg", scaled(picture[:1120], 0.8))


def screenshot(chromium: str, page: Path, height: int) -> np.ndarray:
    """Show a page in Chromium, 1200 pixels wide, and return the image (height, 1200, 3)."""
    with tempfile.TemporaryDirectory() as folder:
        shot = Path(folder) / "page.png"
        options = [
            "--headless",
            "--no-sandbox",
            "--use-gl=angle",
            "--use-angle=swiftshader",
            "--enable-unsafe-swiftshader",
            "--disable-background-networking",
            "--hide-scrollbars",
        ]
        options += [f"--window-size=1200,{height}", "--virtual-time-budget=4000", f"--screenshot={shot}"]
        subprocess.run([chromium, *options, page.resolve().as_uri()], check=True, capture_output=True)
        return cv2.imread(str(shot))


def scaled(picture: np.ndarray, factor: float) -> np.ndarray:
    """Make an image smaller."""
    return cv2.resize(picture, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)


def write(path: Path, picture: np.ndarray) -> None:
    """Write a JPEG."""
    cv2.imwrite(str(path), picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


if __name__ == "__main__":
    main()

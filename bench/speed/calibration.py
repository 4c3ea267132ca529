"""Time and accuracy of `marey calibrate` on a rendered session of eight cameras and one minute.

A ChArUco board of 0.9 x 0.6 m is carried in front of cameras of 1280 x 720 px and at last laid on the floor; ten
pictures per second, motion blur of 6 ms, noise of 2 grey levels, H.264. The pictures are rendered by OpenCV warps from
the true cameras. Core time is that of the process with all threads; the aim is 5 minutes on two cores.
"""

import argparse
import time

import marey
from bench.common import program
from bench.common.board_videos import make_board_videos
from bench.declaration import Bench
from bench.recording import Column, Run
from marey.pipelines.calibrate.tasks import calibrate

BENCH = Bench(
    measures="Time of `marey calibrate` on rendered videos of a board, and the cameras against the truth.",
    sources=("src/marey/calibration", "src/marey/pipelines/calibrate", "src/marey/io/video"),
    minutes=7,
)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("--cameras", type=int, default=8, help="number of cameras")
    parser.add_argument("--seconds", type=float, default=60.0, help="length of the videos")


def run(run: Run) -> None:
    """Render a session, calibrate it, and compare."""
    count, seconds = run.arguments.cameras, run.arguments.seconds
    made = make_board_videos(run.out / f"boards{count}x{seconds:g}", cameras=count, seconds=seconds)
    progress = marey.RecordingProgress()
    wall, core = time.perf_counter(), time.process_time()
    with marey.tuned_process():
        found = calibrate(made.folder, out=run.out / f"calibrated{count}x{seconds:g}", progress=progress)
    wall, core = time.perf_counter() - wall, time.process_time() - core
    table = run.table(
        "Rendered session", ("cameras", "pictures"), Column("time on two cores", "s", 0), Column("core time", "s", 0),
        Column("views with the board", "", 0), Column("rotation", "deg", 4), Column("position", "mm", 2),
        Column("focal length", "%", 3), Column("points", "mm", 2),
    )  # fmt: skip
    score = program.score(run, "calibration.py", found.path, made.truth)
    views = sum(each["pictures"] for each in found.data["cameras"].values())
    table.row(
        (str(count), str(made.pictures)), wall, core, views, score["rotation_deg"], score["position_mm"],
        score["focal_percent"], score["volume_mm"],
    )  # fmt: skip
    stages = run.table("Stages", "stage", Column("time", "s", 1))
    for name, each in progress.timings.items():
        stages.row(name, each)

"""One small valid file for every reader of calibrations, videos and series of slices, and of what belongs to them."""

import pickle
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np

from marey.io.calibration.readers import read_rig
from marey.io.calibration.writers import write_rig
from marey.io.devices.signals import read_event_times, read_signals
from marey.io.mr.volumes import read_volume
from marey.io.trial.person_network import open_person_network
from marey.io.trial.program_boards import program_board
from marey.io.video.sound import read_sound
from marey.io.video.timestamps import recorded_times
from marey.io.video.video import open_video, read_picture
from tests.clips import write_video
from tests.file_samples import FileSample
from tests.io.mr.test_volumes import write_series
from tests.onnx_files import write_onnx
from tests.rig_files import made_rig, opencap_table, write_colmap, write_xcp

NAMES = ("cam_1", "cam_2")
QUALISYS = """<calibration><cameras><camera active="1" serial="21001" model="Miqus Video">
<fov_video left="32" top="16" right="1951" bottom="1095"/>
<fov_video_max left="0" top="0" right="1983" bottom="1111"/>
<transform x="3000" y="0" z="1500" r11="0" r12="1" r13="0" r21="0" r22="0" r23="1" r31="1" r32="0" r33="0"/>
<intrinsic sensorMinU="0" sensorMaxU="126975" focalLengthU="107520" focalLengthV="107584" centerPointU="64000"
 centerPointV="35200" skew="0" radialDistortion1="-0.046" radialDistortion2="0.14" radialDistortion3="0.01"
 tangentalDistortion1="0.0006" tangentalDistortion2="-0.0007"/></camera></cameras></calibration>
"""


def calibrations(folder: Path) -> dict[str, FileSample]:
    """Calibrations of every format, and files of text beside videos."""
    rig, found = made_rig(NAMES), {}
    for kind in ("pose2sim", "caliscope", "opencv", "vicon", "qualisys", "colmap", "opencap"):
        (folder / kind).mkdir(parents=True)
    for kind in ("pose2sim", "caliscope", "opencv"):
        for path in write_rig(rig, folder / kind, to=kind):
            found[path.name] = FileSample(path, lambda path: read_rig(path.parent))
    write_xcp(folder / "vicon" / "lab.xcp", rig, radial="Vicon3Parameter {x} {y} 2e-08 3e-15 0")
    (folder / "qualisys" / "lab.qca.txt").write_text(QUALISYS)
    write_colmap(folder / "colmap", rig)
    for camera in rig:
        (folder / "opencap" / f"{camera.name}.pickle").write_bytes(pickle.dumps(opencap_table(camera)))
    for name in ("vicon/lab.xcp", "qualisys/lab.qca.txt", "colmap/cameras.txt", "colmap/images.txt"):
        found[f"calibration {name}"] = FileSample(folder / name, lambda path: read_rig(path.parent))
    found["calibration pickle"] = FileSample(folder / "opencap" / "cam_1.pickle", read_rig)
    return found | _beside_videos(folder)


def _beside_videos(folder: Path) -> dict[str, FileSample]:
    boards = {
        "pose2sim_board": ("Config.toml", "[calibration.calculate.extrinsics.board]\n"
                           "extrinsics_corners_nb = [4, 7]\nextrinsics_square_size = 60\n"),
        "caliscope_board": ("charuco.toml", 'columns = 9\nrows = 6\ndictionary = "DICT_5X5_250"\n'
                            "square_size_override_cm = 10.0\naruco_scale = 0.75\ninverted = false\n"),
        "opencap_board": ("sessionMetadata.yaml", "checkerBoard:\n  black2BlackCornersWidth_n: 5\n"
                          "  black2BlackCornersHeight_n: 4\n  squareSideLength_mm: 35\n  placement: backWall\n"),
    }  # fmt: skip
    found = {}
    for name, (file, text) in boards.items():
        (folder / name).mkdir(parents=True)
        (folder / name / file).write_text(text)
        found[f"board of {file}"] = FileSample(folder / name / file, lambda path: program_board(path.parent))
    clips = [SimpleNamespace(count=6, rate=30.0, seconds=None)] * 2
    for name, rows in {
        "timestamps.csv": [f"{name},{k / 30}" for k in range(6) for name in NAMES], "cam_1_timestamps.csv": ["0.1"],
    }.items():  # fmt: skip
        place = folder / name.partition(".")[0] / name
        place.parent.mkdir()
        if name == "timestamps.csv":
            place.write_text("\n".join(["cam_id,frame_time", *rows]) + "\n")
        else:
            for camera in NAMES:
                own = "\n".join(["time", *(f"{k / 30}" for k in range(6))]) + "\n"
                place.with_name(f"{camera}_timestamps.csv").write_text(own)
        found[name] = FileSample(place, lambda path: recorded_times(path.parent, NAMES, clips))
    signals = folder / "signals.csv"
    signals.write_text("time,left,right\n" + "".join(f"{k / 100},{k},{2 * k}\n" for k in range(30)))
    taps = folder / "taps.csv"
    taps.write_text("motion_s,device_s\n1,1.5\n2,2.5\n")
    return found | {"signals": FileSample(signals, read_signals), "event times": FileSample(taps, read_event_times)}


def _whole(path: Path) -> None:
    """Open a video, and decode all its images and its sound."""
    clip = open_video(path)
    for _ in clip.images(range(clip.count)):
        pass
    read_sound(path)


def films(folder: Path) -> dict[str, FileSample]:
    """Files that are read by libraries that are not written in Python: videos, pictures, networks, slices."""
    folder.mkdir(parents=True, exist_ok=True)
    found = {}
    for ending in ("mp4", "avi"):
        found[f"video {ending}"] = FileSample(write_video(folder / f"cam.{ending}", 8), _whole)
    for ending in ("bmp", "tif", "webp"):
        cv2.imwrite(str(folder / f"still.{ending}"), np.full((12, 16, 3), 90, np.uint8))
        found[f"picture {ending}"] = FileSample(folder / f"still.{ending}", read_picture)
    network = write_onnx(
        folder / "net.onnx", np.ones((1, 3)), bias=(0.0,), shape=(1, 3, 8, 8), end="Sigmoid"
    )  # fmt: skip
    found["network"] = FileSample(
        network, lambda path: open_person_network(path).loaded()(np.full((9, 9, 3), 90, np.uint8))
    )
    write_series(folder / "series", list(range(5)))
    found["slice"] = FileSample(
        sorted((folder / "series").iterdir())[2], lambda path: read_volume(path.parent)
    )  # fmt: skip
    return found


GROUPS: dict[str, Callable[[Path], dict[str, FileSample]]] = {"calibrations": calibrations, "films": films}
"""The samples, by the kind of file."""

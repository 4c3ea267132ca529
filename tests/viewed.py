"""A made result with numbered videos, for the tests of the page of `marey view`."""

from pathlib import Path

import numpy as np

from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.io.video.video import open_clip
from marey.motion.events.cycles import OFF, STRIKE, GaitEvent
from marey.view.viewer.viewed import ViewedBody, ViewedResult, ViewedTake, ViewerContent
from tests.clips import write_video
from tests.takes import FRAMES, camera, small_take

FIRST = 3
"""Number of the first frame of the result."""
SIZE = (160, 120)


def result(rng: np.random.Generator, name: str = "walk") -> ViewedResult:
    """A captured motion that begins at frame `FIRST` of the videos; two frames do not determine the left knee."""
    motion, posed = small_take(rng)
    determined = np.ones(motion.angles_deg.shape, bool)
    determined[:2, motion.angle_names.index("left_knee_flexion")] = False
    return ViewedResult(
        name=name, time=motion.time, first=FIRST, state=motion.state, angle_names=motion.angle_names,
        angles_deg=motion.angles_deg, angles_deg_sd=motion.angles_deg_sd, angles_determined=determined,
        shown=ViewedBody(motion=motion, body=posed[0].body), level="good", report=b"<p>report of the run</p>",
        events=[GaitEvent(kind=STRIKE, side="left", time=0.1, source="body"),
                GaitEvent(kind=OFF, side="right", time=0.3, source="body")],
    )  # fmt: skip


def take(folder: Path, count: int = FRAMES + FIRST) -> ViewedTake:
    """Two cameras, one of them a fisheye, with videos whose pictures carry their frame numbers."""
    rig = Rig((camera("cam01"), fisheye()))
    return ViewedTake(rig=rig, clips=[open_clip(write_video(folder / f"{c.name}.mp4", count, size=SIZE)) for c in rig])


def fisheye() -> Camera:
    """A camera with a fisheye."""
    plain = camera("cam02", distance=2.5)
    return Camera(
        name=plain.name, size=SIZE, matrix=plain.matrix, distortion=np.array([-0.3, 0.02, 0.003, -0.001]),
        fisheye=True, camera_from_world=plain.camera_from_world,
    )  # fmt: skip


def content(rng: np.random.Generator, folder: Path, *, second: bool = False) -> ViewerContent:
    """One result with videos, or two beside each other."""
    results = [result(rng), *([result(np.random.default_rng(2), "walk again")] if second else [])]
    return ViewerContent(results=results, take=take(folder), same_room=second)

"""The stages of a capture that go through the videos, frame by frame, and remember what is done."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np

from marey.arrays import Image, Mask
from marey.body.pose import Pose, PosedBody
from marey.body.surface import Body
from marey.cameras.camera import Camera
from marey.cli.progress import Progress
from marey.errors import FileProblem
from marey.fit.pose_solver import overlap
from marey.images.background import Background, from_pictures, from_take
from marey.images.silhouettes import Silhouette, segment
from marey.io.stages import FrameLog
from marey.io.trial import Trial
from marey.observations.correspondence import view_of

PLATES = 25
"""Pictures of a clip of the empty room that are looked at."""
SAMPLES = 36
"""Pictures of a take from which an empty room is put together."""


class MaskStore:
    """Silhouettes of a take's frames, on disk; the frames asked for last are kept.

    Args:
        log: One record a frame, packed bits by camera.
        first: The number of the frame in the log's first record.
        cameras: In the order of the records.
    """

    def __init__(self, log: FrameLog, first: int, cameras: Sequence[Camera]):
        self._log, self._first = log, first
        self._sizes = [camera.size for camera in cameras]

    @property
    def frames(self) -> range:
        """The frames that are there."""
        return range(self._first, self._first + len(self._log))

    def append(self, masks: Sequence[Mask]) -> None:
        """Add the next frame's silhouettes."""
        self._log.append({f"camera_{c}": np.packbits(mask) for c, mask in enumerate(masks)})

    def __call__(self, frame: int) -> list[Mask]:
        """Give a frame's silhouettes, one a camera."""
        record = self._log[frame - self._first]
        return [
            np.unpackbits(record[f"camera_{c}"], count=w * h).reshape(h, w).view(bool)
            for c, (w, h) in enumerate(self._sizes)
        ]


def backgrounds(trial: Trial, progress: Progress) -> list[Background]:
    """Model every camera's empty picture: from plates, from a clip, or from the take itself."""
    wanting = [name for name in trial.rig.names if name not in trial.background]
    models: dict[str, Background] = {}
    for name, clip in trial.background.items():
        index = np.unique(np.linspace(0, clip.count - 1, min(PLATES, clip.count)).astype(int))
        models[name] = from_pictures(list(clip.images([int(i) for i in index])))
    if wanting:
        progress.warn(
            f"No picture of the empty room for {', '.join(wanting)}: it is put together from the take itself."
        )
        take = trial.take
        index = np.unique(np.linspace(0, take.count - 1, min(SAMPLES, take.count)).astype(int))
        samples = [images for _, images in take.at([int(i) for i in index])]
        for c, name in enumerate(trial.rig.names):
            if name in wanting:
                models[name] = from_take([images[c] for images in samples])
    return [models[name] for name in trial.rig.names]


def find_silhouettes(
    trial: Trial,
    models: Sequence[Background],
    store: MaskStore,
    progress: Progress,
    *,
    name: str,
    predicted: Callable[[int], Sequence[Mask] | None] = lambda frame: None,
) -> None:
    """Find the silhouettes of all frames that are not in the store yet.

    Args:
        trial: Its take is gone through once, in order.
        models: The empty picture of each camera.
        store: Takes the silhouettes.
        progress: Is told.
        name: Of the stage.
        predicted: Gives for a frame where the body is believed, one mask a camera; None where nobody knows.
    """
    take = trial.take
    done = len(store.frames)
    before: list[Silhouette | None] = [None] * len(models)
    with (
        progress.stage(name, take.end - take.first, done=done) as step,
        ThreadPoolExecutor(max_workers=2) as pool,
    ):
        for frame, images in take.frames(first=take.first + done):
            starts = predicted(frame) or [None] * len(models)
            found = list(pool.map(_segment, images, models, starts, before))
            before = [new if new.mask.any() else old for new, old in zip(found, before, strict=True)]
            store.append([silhouette.mask for silhouette in found])
            step()


def _segment(image: Image, background: Background, start: Mask | None, before: Silhouette | None) -> Silhouette:
    return segment(image, background, start=start, before=before)


def known_silhouettes(trial: Trial, store: MaskStore, masks: Mapping[str, np.ndarray], progress: Progress) -> None:
    """Take silhouettes that the user gave: (F, height, width) by camera."""
    take = trial.take
    with progress.stage("Silhouettes", take.end - take.first, done=len(store.frames)) as step:
        for frame in range(take.first + len(store.frames), take.end):
            store.append([masks[name][frame] for name in trial.rig.names])
            step()


def frames_with_somebody(store: MaskStore) -> tuple[int, ...]:
    """Give the frames in which at least two cameras see somebody."""
    return tuple(frame for frame in store.frames if sum(bool(mask.any()) for mask in store(frame)) >= 2)


def require_somebody(trial: Trial, frames: Sequence[int]) -> None:
    """Check that somebody is there.

    Raises:
        FileProblem: Nobody is.
    """
    if not frames:
        wrong = "shows nobody whom at least two cameras see at the same time"
        remedy = "Check that the background pictures belong to this take, and that a person moves in the videos."
        raise FileProblem(trial.folder, wrong, remedy)


def surface_masks(
    body: Body, poses: Mapping[int, Pose], cameras: Sequence[Camera]
) -> Callable[[int], Sequence[Mask] | None]:
    """Give a function that draws the body's silhouette in every camera, for frames whose pose is known."""

    def drawn(frame: int) -> Sequence[Mask] | None:
        if frame not in poses:
            return None
        posed = PosedBody(body, poses[frame])
        return [view_of(posed, camera).mask() for camera in cameras]

    return drawn


def compare_with_silhouettes(
    body: Body, poses: Mapping[int, Pose], cameras: Sequence[Camera], store: MaskStore
) -> Iterator[tuple[int, list[Mask], np.ndarray]]:
    """Go through the fitted frames: number, the surface's masks, and its agreement (C,) with the silhouettes."""
    for frame, pose in poses.items():
        posed = PosedBody(body, pose)
        views = [view_of(posed, camera) for camera in cameras]
        masks = store(frame)
        agreement = np.array([overlap(view, mask) for view, mask in zip(views, masks, strict=True)])
        yield frame, [view.mask() for view in views], agreement


def quiet_threads() -> None:
    """Leave the parallel work to the cameras: OpenCV's own threads would only wait for each other."""
    cv2.setNumThreads(1)

"""Backgrounds of a take: from images of the empty room, or from the take, and images that are just large enough."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np

from marey.arrays import Floats, Image
from marey.body.articulation.presets import follows_limb
from marey.cameras.camera import Camera
from marey.fit.solver.threads import usable_threads
from marey.images.silhouettes.background import (
    Background,
    background_frames,
    from_pictures,
    from_take,
    shrunk,
    with_reduced_weight,
)
from marey.images.silhouettes.silhouettes import segment
from marey.io.trial.trial import Trial
from marey.pipelines.progress import Progress

PLATES = 25
"""Images that are read from a clip of the empty room.

Chosen by hand; results were not measured against other values.
"""
CHECKED_IMAGES = 12
"""Images of a take with which the images of the empty room are compared.

Chosen by hand; results were not measured against other values.
"""
PEEK, PEEKS = 0.25, 6
"""Scale and number of the images in which the height of the person is measured in advance.

Chosen by hand; results were not measured against other values.
"""
TRACKED_PX = 300.0
"""Height of the person in images that are large enough for the start and for tracking [px].

With 150 px the first silhouettes take a quarter of the time, but joints of `balancing` are 50 instead of 39 mm off
(docs/accuracy/rejected.md).
"""


def model_backgrounds(trial: Trial, progress: Progress) -> tuple[list[Background], list[Camera]]:
    """Model the empty image of every camera: from still images, from a clip, or from the take itself.

    Images of the empty room are compared with images of the take. Where they explain none of them, their weight is
    reduced.

    Args:
        trial: The trial.
        progress: Progress reporter.

    Returns:
        The models, and cameras of images that are just large enough for tracking, see `enough_for_tracking`.
    """
    take = trial.take
    with progress.stage("Empty room"):
        models = _given_backgrounds(trial)
        wanting = cameras_without_image(trial)
        if wanting:
            progress.warn(
                f"No image of the empty room for {', '.join(wanting)}: the background is estimated from the recording, "
                "which fails where the person never leaves or others are present; detected joints help (--keypoints)."
            )
        spread = _checked_frames(take.count)
        whole = [int(i) for i in background_frames(take.count)]
        peeks = [int(i) for i in np.unique(np.linspace(take.first, take.end - 1, PEEKS).astype(int))]
        # All samples are read in one pass: most of the time is spent on decoding.
        samples = dict(take.at(sorted({*spread, *peeks, *(whole if wanting else ())})))

        limb = follows_limb(trial.settings.preset)

        def model(c: int, name: str) -> Background:
            if name in wanting:
                return from_take([samples[i][c] for i in whole])
            return with_reduced_weight(models[name], [samples[i][c] for i in spread], limb=limb)

        with ThreadPoolExecutor(max_workers=usable_threads()) as pool:
            made = list(pool.map(model, range(len(trial.rig.names)), trial.rig.names))
        return made, enough_for_tracking(list(trial.rig), made, [samples[i] for i in peeks])


def cameras_without_image(trial: Trial) -> list[str]:
    """Return the names of the cameras that have no image of the empty room."""
    return [name for name in trial.rig.names if name not in trial.background]


def empty_rooms(trial: Trial, cameras: Sequence[Camera]) -> dict[int, Background]:
    """Model the empty image of those cameras that have one; its weight is reduced as in `model_backgrounds`.

    Args:
        trial: The trial.
        cameras: The cameras of the images in which the backgrounds are used, in the order of the trial's.

    Returns:
        The backgrounds in the sizes of these images, by number of the camera.
    """
    if not trial.background:
        return {}
    models, samples = _given_backgrounds(trial), dict(trial.take.at(_checked_frames(trial.take.count)))
    found = {}
    for c, (name, camera) in enumerate(zip(trial.rig.names, cameras, strict=True)):
        if name in models:
            pictures = [images[c] for images in samples.values()]
            whole = with_reduced_weight(models[name], pictures, limb=follows_limb(trial.settings.preset))
            found[c] = shrunk(whole, camera.size)
    return found


def _given_backgrounds(trial: Trial) -> dict[str, Background]:
    """Return the backgrounds of the cameras that have images of the empty room, by name."""
    models = {}
    for name, clip in trial.background.items():
        index = np.unique(np.linspace(0, clip.count - 1, min(PLATES, clip.count)).astype(int))
        models[name] = from_pictures(list(clip.images([int(i) for i in index])))
    return models


def _checked_frames(count: int) -> list[int]:
    """Return the frames of a take with which images of the empty room are compared."""
    return [int(i) for i in np.unique(np.linspace(0, count - 1, min(CHECKED_IMAGES, count)).astype(int))]


def enough_for_tracking(
    cameras: Sequence[Camera], models: Sequence[Background], pictures: Sequence[Sequence[Image]]
) -> list[Camera]:
    """Return cameras of images that are just large enough for the first silhouettes and for tracking.

    The height of the person is measured in some strongly reduced images of the take.

    Args:
        cameras: C cameras of the full images.
        models: The C backgrounds.
        pictures: Images of some frames, C per frame.

    Returns:
        The C cameras of the reduced images.
    """
    small = [camera.scaled(PEEK) for camera in cameras]
    peeks = [shrunk(model, camera.size) for model, camera in zip(models, small, strict=True)]

    def tallest_in(camera: Camera, model: Background, images: Sequence[Image]) -> float:
        seen = (segment(resized(image, camera), model).mask for image in images)
        return max(np.count_nonzero(mask.any(1)) / PEEK for mask in seen)

    with ThreadPoolExecutor(max_workers=usable_threads()) as pool:
        tallest = max(pool.map(tallest_in, small, peeks, zip(*pictures, strict=True)))
    return reduced_cameras(cameras, tallest)


def reduced_cameras(cameras: Sequence[Camera], tallest: float, enough: float = TRACKED_PX) -> list[Camera]:
    """Return cameras of images that are just large enough for a task, by default for tracking.

    Args:
        cameras: Cameras of the full images.
        tallest: Height of the person in the image that shows it largest [px]; 0 if it is not known.
        enough: Height of the person that is large enough [px].

    Returns:
        The cameras of the reduced images.
    """
    factor = min(1.0, float(2.0 ** np.ceil(np.log2(enough / tallest)))) if tallest > 0 else 1.0
    return [camera.scaled(factor) for camera in cameras]


def resized(image: Image, camera: Camera) -> Image:
    """Resize an image to the size of a camera."""
    if (image.shape[1], image.shape[0]) == camera.size:
        return image
    return np.asarray(cv2.resize(image, camera.size, interpolation=cv2.INTER_AREA), np.uint8)


def in_small_pictures(pixels: Floats, cameras: Sequence[Camera], small: Sequence[Camera]) -> Floats:
    """Convert pixels (C, n, 2) of full images to those of reduced ones; pixel centres are at whole numbers in both."""
    factors = np.array([after.width / before.width for before, after in zip(cameras, small, strict=True)])
    return np.asarray((pixels + 0.5) * factors[:, None, None] - 0.5)

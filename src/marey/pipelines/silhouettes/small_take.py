"""A take in strongly reduced images, as classes of pixels."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import cv2
import numpy as np

from marey.arrays import Floats, Image, Integers
from marey.body.articulation.pose import PosedBody
from marey.cameras.camera import Camera
from marey.fit.regions.region_search import RegionImages
from marey.fit.regions.region_track import IMAGES_KEPT, RegionTrack
from marey.images.silhouettes.background import Background
from marey.images.silhouettes.colour_words import (
    MOTION_OFFSETS,
    ColourWords,
    largest_channel,
    learned_words,
    motion_outside,
    motion_ratio,
    motion_words,
)
from marey.images.silhouettes.uncovered import background_with_empty
from marey.io.trial.trial import Trial
from marey.observations.correspondence import view_of
from marey.pipelines.people.other_regions import OtherPeople
from marey.pipelines.progress import Progress
from marey.pipelines.silhouettes.drawn_body import length_px
from marey.pipelines.silhouettes.empty_rooms import empty_rooms, resized

SHORT_SIDE = 120
"""Shorter side of the reduced images [px]. From the measured recipe for rooms without a plate; others were not
compared."""
WORD_FRAMES = 8
"""Number of frames from which the colour words are learned. Chosen by hand."""
MOTION_RATE = 30.0
"""Frame rate to which `MOTION_OFFSETS` belong [Hz]."""
LEARNED_FRAMES = 40
"""Number of frames from which the background is learned. Chosen by hand."""
ABSENT_FRAMES = 6
"""Largest number of frames without the person from which the background is learned, too. With five, a pixel's most
frequent colour is certain, see `uncovered.ENOUGH`; one more, since the room may have changed in one of them."""
PLATE_NOISE = 5.0
"""Standard deviation of a pixel from the learned background [grey levels]. Chosen by hand."""
PLATE_RATIO = 3.0
"""Largest log-likelihood ratio of a pixel from the learned background. Chosen by hand."""
PLATE_CONFIDENCE = 0.97
"""Largest confidence of the learned background. Chosen by hand."""


@dataclass(frozen=True, eq=False)
class SmallTake:
    """The take in reduced images, as classes of pixels."""

    cameras: tuple[Camera, ...]
    """C cameras of the reduced images."""
    pictures: Mapping[int, Sequence[Image]]
    """The reduced images by frame."""
    words: ColourWords
    """The colour words."""
    offsets: tuple[int, ...]
    """Other frames with which an image is compared, relative to its own."""
    backgrounds: Sequence[Background] = ()
    """The background of each camera, given or learned; empty while it is not learned."""
    motion: Sequence[Floats] = ()
    """The probabilities of the motion words of each camera where the person is elsewhere, see `motion_outside`; empty
    while they are not known."""
    given: Mapping[int, Background] = field(default_factory=dict)
    """The background of the cameras with an image of the empty room, by number of the camera."""
    _classes: dict[int, tuple[Integers, Integers]] = field(default_factory=dict, repr=False)

    def images_of(self, frame: int) -> RegionImages:
        """Return the classes of the pixels of a frame."""
        return self._kept_images(frame)

    @cached_property
    def _kept_images(self) -> Callable[[int], RegionImages]:
        return lru_cache(maxsize=IMAGES_KEPT)(self._images_of)

    def _images_of(self, frame: int) -> RegionImages:
        words, motion = self._words_of(frame)
        evidence = motion_ratio(motion)
        known = dict(enumerate(self.backgrounds)) or self.given
        for c, background in known.items():
            picture = self.pictures[frame][c]
            part = (c, slice(picture.shape[0]), slice(picture.shape[1]))
            own = motion_ratio(motion[part], self.motion[c]) if self.motion else evidence[part]
            evidence[part] = own + plate_ratio(picture, background)
        evidence.setflags(write=False)
        return RegionImages(words, evidence)

    def _words_of(self, frame: int) -> tuple[Integers, Integers]:
        """Return the colour words and the motion words of a frame (C, h, w)."""
        if frame not in self._classes:
            self._classes[frame] = self._classified(frame)
        return self._classes[frame]

    def _classified(self, frame: int) -> tuple[Integers, Integers]:
        shape = (
            len(self.cameras),
            max(camera.height for camera in self.cameras),
            max(camera.width for camera in self.cameras),
        )
        words: Integers = np.zeros(shape, np.uint8)
        motion: Integers = np.zeros(shape, np.uint8)
        others = [self.pictures[frame + step] for step in self.offsets if frame + step in self.pictures]
        for c, camera in enumerate(self.cameras):
            picture = self.pictures[frame][c]
            words[c, : camera.height, : camera.width] = self.words.of(picture)
            motion[c, : camera.height, : camera.width] = motion_words(picture, [other[c] for other in others])
        words.setflags(write=False)
        return words, motion

    def with_backgrounds(
        self, track: RegionTrack, reach_m: float, others: OtherPeople | None = None
    ) -> "SmallTake":  # fmt: skip
        """Learn the backgrounds that are not given, and what moves in all, where a tracked person is elsewhere.

        Args:
            track: The track.
            reach_m: Distance from the drawn body within which the background is not learned [m].
            others: Other people, where the background is not learned, either.

        Returns:
            The same take with the backgrounds.
        """
        frames = spread(list(track.poses), LEARNED_FRAMES)
        absent = spread(far_from(self.pictures, track.poses), ABSENT_FRAMES)
        learned, moving = [], []
        for c, camera in enumerate(self.cameras):
            covered, inside = [], np.ones((camera.height, camera.width), bool)
            for frame in frames:
                posed = PosedBody(track.body, track.poses[frame])
                reach = int(np.ceil(length_px(posed, camera, reach_m)))
                disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
                body = view_of(posed, camera).mask()
                inside &= body
                covered.append(cv2.dilate(body.view(np.uint8), disk) > 0)
                place = posed.segment_origin.mean(axis=0)
                regions = None if others is None else others.regions(frame, c, camera, place)
                if regions is not None:
                    covered[-1] |= regions.near
            if c in self.given:
                learned.append(self.given[c])
            else:
                pictures, without = ([self.pictures[frame][c] for frame in each] for each in (frames, absent))
                learned.append(background_with_empty(pictures, covered, inside, without))
            words = [self._words_of(frame)[1][c, : camera.height, : camera.width] for frame in frames]
            moving.append(motion_outside(words, covered))
        return replace(self, backgrounds=tuple(learned), motion=tuple(moving))


def spread(frames: Sequence[int], most: int) -> list[int]:
    """Return at most a number of frames, evenly distributed over those that are given."""
    index = np.unique(np.linspace(0, len(frames) - 1, min(most, len(frames))).astype(int))
    return [frames[i] for i in index]


def far_from(frames: Iterable[int], tracked: Collection[int]) -> list[int]:
    """Return the frames that are farther from every tracked one than twice the usual distance of these."""
    known = np.sort(np.array(list(tracked)))
    every, step = np.array(list(frames)), float(np.median(np.diff(known))) if len(known) > 1 else 1.0
    after = np.searchsorted(known, every)
    before = np.abs(every - known[np.maximum(after - 1, 0)])
    nearest = np.minimum(before, np.abs(every - known[np.minimum(after, len(known) - 1)]))
    return [int(frame) for frame in every[nearest > 2 * step]]


def plate_ratio(picture: Image, background: Background) -> Floats:
    """Return the log-likelihood ratio (H, W) of person and learned background, from an image (H, W, C) uint8.

    It is negative where the image shows the background, and positive where it differs; both as far as the background
    is certain.
    """
    shown = picture.astype(np.float32)
    gain = np.median((shown[::3, ::3] + 1) / (background.mean[::3, ::3] + 1), axis=(0, 1))
    distance = largest_channel(np.abs(shown - background.mean * gain)) / np.float32(PLATE_NOISE)
    confidence = np.minimum(background.confidence, np.float32(PLATE_CONFIDENCE))
    ratio = -np.log((1 - confidence) + confidence * np.exp(np.float32(PLATE_RATIO) - 0.5 * distance * distance))
    return np.asarray(np.clip(ratio, -PLATE_RATIO, PLATE_RATIO), np.float32)


def small_take(trial: Trial, progress: Progress) -> SmallTake:
    """Read the frames of a trial in reduced images."""
    cameras = tuple(camera.scaled(min(1.0, SHORT_SIDE / min(camera.size))) for camera in trial.rig)
    take, pictures = trial.take, dict[int, Sequence[Image]]()
    with progress.stage("Small images", take.end - take.first) as step:
        for frame, images in take.frames(first=take.first):
            small = [resized(image, camera) for image, camera in zip(images, cameras, strict=True)]
            pictures[frame] = [image[..., None] if image.ndim == 2 else image for image in small]
            step()
    words = learned_words([image for frame in spread(list(pictures), WORD_FRAMES) for image in pictures[frame]])
    offsets = sorted({round(step * take.rate / MOTION_RATE) for step in MOTION_OFFSETS} - {0})
    return SmallTake(cameras, pictures, words, tuple(offsets), given=empty_rooms(trial, cameras))

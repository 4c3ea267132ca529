"""Copies of takes in which one thing is wrong: cameras, videos, images of the empty room, people, or the body."""

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import marey
from marey.arrays import Image, Mask
from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from marey.io.calibration.readers import write_cameras_toml

Pictures = Callable[[Sequence[Image]], Sequence[Image]]
Plant = Callable[["TakeCopy"], None]


@dataclass(frozen=True)
class TakeCopy:
    """A copy of a take that is changed in place."""

    take: Path
    """The sound take."""
    folder: Path
    """The copy."""

    @staticmethod
    def of(take: Path, folder: Path) -> "TakeCopy":
        """Copy what a capture reads."""
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        copy = TakeCopy(take, folder)
        for path in (*take.glob("*.mp4"), *take.glob("*.avi"), *take.glob("*.toml")):
            shutil.copyfile(path, folder / path.name)
        if (take / "background").is_dir():
            shutil.copytree(take / "background", folder / "background", copy_function=shutil.copyfile)
        return copy

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the cameras."""
        return tuple(marey.read_cameras(self.take).names)

    def calibrate(self, change: Callable[[Rig], Rig]) -> None:
        """Change the calibration."""
        write_cameras_toml(change(marey.read_cameras(self.take)), self.folder / "cameras.toml")

    def film(self, number: int, change: Pictures, *, plate: bool = True) -> None:
        """Change the pictures of a camera, and its plate as it would be changed by the same cause."""
        name = self.names[number]
        rewrite(self.folder / f"{name}.mp4", change)
        if plate and self.plate(number).exists():
            self.light(number, lambda image: change([image] * 20)[-1])

    def plate(self, number: int) -> Path:
        """The image of the empty room of a camera."""
        return self.folder / "background" / f"{self.names[number]}.png"

    def light(self, number: int, change: Callable[[Image], Image]) -> None:
        """Change the image of the empty room of a camera."""
        cv2.imwrite(str(self.plate(number)), change(cv2.imread(str(self.plate(number)))))


@dataclass(frozen=True, kw_only=True)
class Fault:
    """A fault that is planted into a take."""

    take: str
    name: str
    plant: Plant = lambda copy: None
    causes: tuple[str, ...]
    """The kinds of causes in a verdict that name the fault."""
    words: str = ""
    """What an error has to contain to name the fault: a regular expression."""
    frames: range = range(30, 70)
    keypoints: bool = False
    """Whether the key points of the take are given."""
    body_of: str = ""
    """The take whose captured body is given; none if empty."""
    ahead: int = 0
    """Number of frames by which a second person is ahead, who may be captured as well; negative if the clock of the
    take, that of camera 1, is behind; 0 otherwise."""
    settings: dict[str, Any] = field(default_factory=dict)
    """Further arguments of the capture."""


def rewrite(path: Path, change: Pictures) -> None:
    """Change the pictures of a video; the new one is without further loss."""
    video = cv2.VideoCapture(str(path))
    rate, images = video.get(cv2.CAP_PROP_FPS), []
    while (read := video.read())[0]:
        images.append(read[1])
    changed = change(images)
    size = changed[0].shape[1], changed[0].shape[0]
    path.unlink()
    writer = cv2.VideoWriter(str(path.with_suffix(".avi")), cv2.VideoWriter.fourcc(*"FFV1"), rate, size)
    for image in changed:
        writer.write(image)
    writer.release()


def turned(camera: Camera, degrees: float, axis: Sequence[float] = (1.0, 1.0, 1.0)) -> Camera:
    """Return a camera that was knocked about its centre."""
    turn = rotations.exp(np.radians(degrees) * np.array(axis) / np.linalg.norm(axis))
    pose = camera.camera_from_world
    return replace(camera, camera_from_world=RigidTransform(turn @ pose.rotation, turn @ pose.translation))


def zoomed(camera: Camera, factor: float) -> Camera:
    """Return a camera with another focal length."""
    return replace(camera, matrix=np.array(camera.matrix) * [[factor, factor, 1], [1, factor, 1], [1, 1, 1]])


def in_unit(camera: Camera, per_metre: float) -> Camera:
    """Return a camera whose place is in another unit."""
    pose = camera.camera_from_world
    return replace(camera, camera_from_world=RigidTransform(pose.rotation, pose.translation * per_metre))


def with_cameras(changed: Callable[[Camera], Camera], *numbers: int) -> Plant:
    """Return the fault of wrong calibrations of some cameras; of all without numbers."""

    def change(rig: Rig) -> Rig:
        chosen = numbers or range(len(rig.names))
        return Rig(tuple(changed(camera) if c in chosen else camera for c, camera in enumerate(rig)))

    return lambda copy: copy.calibrate(change)


def in_order(*order: int) -> Plant:
    """Return the fault of calibrations in another order."""
    return lambda copy: copy.calibrate(
        lambda rig: Rig(tuple(replace(rig.cameras[k], name=rig.names[c]) for c, k in enumerate(order)))
    )


def filmed(change: Pictures, *numbers: int, plate: bool = True) -> Plant:
    """Return the fault of wrong pictures of some cameras; of all without numbers."""

    def plant(copy: TakeCopy) -> None:
        for c in numbers or range(len(copy.names)):
            copy.film(c, change, plate=plate)

    return plant


def late(frames: int) -> Pictures:
    """Return the change of a camera that was started some pictures too early: it shows everything later."""
    return lambda images: [*images[:1] * frames, *images[:-frames]]


def losing(frames: int, at: int) -> Pictures:
    """Return the change of a camera that records nothing for some frames; the last picture is repeated at the end."""
    return lambda images: [*images[:at], *images[at + frames :], *images[-1:] * frames]


def joined_at(at: int) -> Pictures:
    """Return the change of a camera whose recording begins again at a picture, as if two recordings were joined."""
    return lambda images: [*images[:at], *images[: len(images) - at]]


def each(change: Callable[[Image], Image]) -> Pictures:
    """Return the change of every picture."""
    return lambda images: [np.ascontiguousarray(change(image)) for image in images]


def small(image: Image) -> Image:
    """Return a picture of half the size."""
    return cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)


def darker(image: Image) -> Image:
    """Return a picture at another light: 30 % darker, and with a lamp at the left that is out."""
    gain = 0.7 - 0.25 * np.linspace(1, 0, image.shape[1])[None, :, None]
    return np.clip(image * gain, 0, 255).astype(np.uint8)


def cut_below(row: int) -> Plant:
    """Return the fault of pictures that end at a row, with a calibration that states it."""

    def plant(copy: TakeCopy) -> None:
        filmed(each(lambda image: image[:row]))(copy)
        copy.calibrate(lambda rig: Rig(tuple(replace(camera, size=(camera.width, row)) for camera in rig)))

    return plant


def exchanged_plates(copy: TakeCopy) -> None:
    """Exchange the plates of the first two cameras."""
    first, second = (cv2.imread(str(copy.plate(c))) for c in (0, 1))
    copy.light(0, lambda image: second)
    copy.light(1, lambda image: first)


def plates_of(take: str) -> Plant:
    """Return the fault of plates from another recording with cameras of the same names."""

    def plant(copy: TakeCopy) -> None:
        for c in range(len(copy.names)):
            shutil.copyfile(copy.take.parent / take / "background" / copy.plate(c).name, copy.plate(c))

    return plant


def empty_room(copy: TakeCopy) -> None:
    """Repeat the empty pictures that a take begins with."""
    filmed(lambda images: [images[i % 10] for i in range(len(images))], plate=False)(copy)


def second_person(ahead: int) -> Plant:
    """Return the fault of a second person: the same one some frames later, in front."""

    def plant(copy: TakeCopy) -> None:
        for c, own in enumerate(true_masks(copy.take)):
            copy.film(c, lambda images, own=own: _with_second(images, own, ahead), plate=False)

    return plant


def two_people(ahead: int) -> Plant:
    """Return the change of a second person: the same one some frames later, whom the nearer one hides."""

    def plant(copy: TakeCopy) -> None:
        middles = np.load(copy.take / "truth" / "truth.npz")["joints"].mean(1)
        for c, (own, camera) in enumerate(zip(true_masks(copy.take), marey.read_cameras(copy.take), strict=True)):
            depths = np.linalg.norm(middles - camera.centre, axis=1)
            hidden = [before & (depths[f] < depths[f + ahead]) for f, before in enumerate(own[: len(own) - ahead])]
            copy.film(c, lambda images, own=own, hidden=hidden: _with_second(images, own, ahead, hidden), plate=False)

    return plant


def _with_second(
    images: Sequence[Image], masks: Sequence[Mask], ahead: int, hidden: Sequence[Mask] | None = None
) -> list[Image]:
    empty, made = len(images) - len(masks), [np.array(image) for image in images]
    for f in range(empty, len(images) - ahead):
        mask = masks[f + ahead - empty]
        if hidden is not None:
            mask = mask & ~hidden[f - empty]
        made[f][mask] = images[f + ahead][mask]
    return made


def later(truth: Path, ahead: int, path: Path) -> Path:
    """Write the truth of a person who is some frames ahead, or, for a negative number, behind."""
    given = dict(np.load(truth))
    before, first = max(-ahead, 0), max(ahead, 0)
    shifted = {
        key: np.concatenate([*[value[:1]] * before, value[first:]]) for key, value in given.items() if value.ndim > 1
    }
    np.savez(path, **given | shifted)
    return path


def true_masks(take: Path) -> Sequence[Sequence[Mask]]:
    """The true silhouettes of a take by camera and frame."""
    found = np.load(take / "truth" / "masks.npz")
    shape = found["shape"]
    return np.unpackbits(found["bits"])[: shape.prod()].reshape(shape).astype(bool)

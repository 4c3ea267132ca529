"""Furniture that stands in rendered takes: made of cuboids in space, drawn into all images of every camera.

A thing hides the person where it is nearer to the camera, and stands behind the person elsewhere. The true silhouettes
lose what it hides. It casts no shadow.
"""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

import marey
from bench.common.program import empty_frames
from marey.arrays import Floats, Image, Mask
from marey.cameras.camera import Camera

NOISE = 2.0
"""Standard deviation of the noise of a drawn thing, as in the rendered takes [grey levels]."""
TILE_M = 0.06
"""Edge of the tiles of the texture [m]."""


@dataclass(frozen=True)
class Cuboid:
    """A part of a thing, with edges along the world's axes."""

    low: tuple[float, float, float]
    """Least coordinates [m]."""
    high: tuple[float, float, float]
    """Greatest coordinates [m]."""


def counter(x: tuple[float, float], y: tuple[float, float], height: float) -> list[Cuboid]:
    """A closed counter on the floor [m]."""
    return [Cuboid((x[0], y[0], 0.0), (x[1], y[1], height))]


def rail(start: tuple[float, float], end: tuple[float, float], heights: Sequence[float]) -> list[Cuboid]:
    """A rail along x or y with bars of 8 cm at some heights, and a post at both ends [m]."""
    low, high = np.minimum(start, end) - 0.03, np.maximum(start, end) + 0.03
    bars = [Cuboid((low[0], low[1], z), (high[0], high[1], z + 0.08)) for z in heights]
    posts = [Cuboid((x - 0.03, y - 0.03, 0.0), (x + 0.03, y + 0.03, max(heights))) for x, y in (start, end)]
    return bars + posts


def table(x: tuple[float, float], y: tuple[float, float], height: float) -> list[Cuboid]:
    """A table with a top of 5 cm and four legs [m]."""
    top = Cuboid((x[0], y[0], height - 0.05), (x[1], y[1], height))
    feet = [(a, b) for a in (x[0], x[1] - 0.06) for b in (y[0], y[1] - 0.06)]
    return [top, *(Cuboid((a, b, 0.0), (a + 0.06, b + 0.06, height)) for a, b in feet)]


@dataclass(frozen=True, eq=False)
class DrawnThing:
    """A thing in the image of one camera."""

    image: Image
    """(height, width, 3) its colours."""
    distance: Floats
    """(height, width) its distance from the camera; infinite beside it [m]."""


def drawn_thing(camera: Camera, parts: Sequence[Cuboid], colour: tuple[int, int, int]) -> DrawnThing:
    """Draw a thing by the intersection of each pixel's ray with each cuboid."""
    pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), -1).reshape(-1, 2).astype(float)
    ray = camera.rays(pixels).directions
    nearest, shade = np.full(len(ray), np.inf), np.zeros(len(ray))
    for part in parts:
        with np.errstate(divide="ignore", invalid="ignore"):
            both = (np.array([part.low, part.high])[:, None] - camera.centre) / ray
        near, far = both.min(0), both.max(0)
        enter = near.max(1)
        hit = (enter < far.min(1)) & (enter > 0) & (enter < nearest)
        nearest[hit] = enter[hit]
        shade[hit] = np.array([0.7, 0.85, 1.0])[near[hit].argmax(1)]
    met = np.isfinite(nearest)
    point = camera.centre + ray[met] * nearest[met, None]
    tiles = np.floor(point / TILE_M + 1e-6).astype(np.int64) @ np.array([73856093, 19349663, 83492791])
    shade[met] *= 0.8 + 0.4 * ((tiles * 2654435761 >> 7) % 64) / 64
    image = np.clip(shade[:, None] * np.array(colour), 0, 255).astype(np.uint8)
    shape = camera.height, camera.width
    # As after a lens, the borders are not sharper than the rest of the image.
    return DrawnThing(cv2.GaussianBlur(image.reshape(*shape, 3), (0, 0), 0.6), nearest.reshape(shape))


def furnished(
    take: Path, folder: Path, parts: Sequence[Cuboid], *, colour: tuple[int, int, int] = (70, 110, 150),
    empty_room: bool = True,
) -> Path:  # fmt: skip
    """Write a rendered take with a thing in it.

    Args:
        take: A rendered take of data/people.
        folder: Folder of the new trial.
        parts: The thing.
        colour: Its colour, blue first.
        empty_room: Whether the trial has images of the empty room, with the thing.

    Returns:
        The folder, whose `truth` holds the joints, the silhouettes of what is visible, and `hidden.npz`, the
        silhouettes of what is not.
    """
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "truth").mkdir(parents=True)
    shutil.copyfile(take / "cameras.toml", folder / "cameras.toml")
    shutil.copyfile(take / "truth" / "truth.npz", folder / "truth" / "truth.npz")
    with np.load(take / "truth" / "truth.npz") as truth:
        places = truth["joints"].mean(1)
    person, skip = true_masks(take), empty_frames(take)
    hidden = np.zeros_like(person)
    for c, camera in enumerate(marey.read_cameras(take)):
        thing = drawn_thing(camera, parts, colour)
        away = np.linalg.norm(places - camera.centre, axis=1)
        hidden[c] = person[c] & (thing.distance < away[:, None, None])
        before = np.concatenate([np.zeros((skip, *person.shape[2:]), bool), person[c] & ~hidden[c]])
        _write_video(take / f"{camera.name}.mp4", folder / f"{camera.name}.mp4", thing, before)
        if empty_room:
            _write_plate(take, folder, camera.name, thing)
    for name, masks in {"masks": person & ~hidden, "hidden": hidden}.items():
        np.savez(folder / "truth" / f"{name}.npz", shape=np.array(masks.shape), bits=np.packbits(masks))
    return folder


def true_masks(take: Path, name: str = "masks") -> Mask:
    """Read the true silhouettes (cameras, frames, height, width) of a rendered take."""
    with np.load(take / "truth" / f"{name}.npz") as stored:
        shape = stored["shape"]
        return np.unpackbits(stored["bits"])[: shape.prod()].reshape(shape).astype(bool)


def _write_plate(take: Path, folder: Path, name: str, thing: DrawnThing) -> None:
    (folder / "background").mkdir(exist_ok=True)
    plate = cv2.imread(str(take / "background" / f"{name}.png"))
    shown = np.isfinite(thing.distance)
    plate[shown] = thing.image[shown]
    cv2.imwrite(str(folder / "background" / f"{name}.png"), plate)


def _write_video(source: Path, path: Path, thing: DrawnThing, before: Mask) -> None:
    """Draw a thing into each image of a video, except where the person stands before it (frames, height, width)."""
    rng, video = np.random.default_rng(0), cv2.VideoCapture(str(source))
    rate = video.get(cv2.CAP_PROP_FPS)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), rate, before.shape[2:0:-1])
    for person in before:
        image = video.read()[1]
        shown = np.isfinite(thing.distance) & ~person
        noisy = thing.image[shown] + NOISE * rng.normal(size=(np.count_nonzero(shown), 3))
        image[shown] = np.clip(noisy, 0, 255).astype(np.uint8)
        writer.write(image)
    writer.release()

"""Reading and writing of silhouettes: masks/<camera>.npz in our own format, grey images, and grey videos."""

import math
import re
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO

import cv2
import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from marey.arrays import Image, Integers, Mask
from marey.errors import FileProblem
from marey.io.atomic import replacing
from marey.io.npz import DAMAGED_ARCHIVE, array_header, require_possible_sizes
from marey.io.run_files import RECORD, files_of_runs
from marey.io.video.video import (
    PICTURE_SUFFIXES,
    VIDEO_SUFFIXES,
    Clip,
    open_stills,
    open_video,
    read_picture,
)

CERTAIN = 255
"""Grey level of probability 1."""

_LAYOUT = "It should contain shape = (frames, height, width) and bits = numpy.packbits of the silhouettes."
"""Remedy in the error messages: the expected arrays."""


def pack_mask(mask: Mask) -> NDArray[np.uint8]:
    """Compress one silhouette for storage in memory: some hundred bytes instead of one byte per pixel.

    Args:
        mask: (height, width).

    Returns:
        Bytes for `unpack_mask`.
    """
    return np.frombuffer(zlib.compress(np.packbits(mask).tobytes(), level=1), np.uint8)


def unpack_mask(packed: NDArray[np.uint8], shape: tuple[int, int]) -> Mask:
    """Undo `pack_mask`.

    Args:
        packed: The bytes from `pack_mask`.
        shape: Height and width.

    Returns:
        (height, width).
    """
    bits = np.unpackbits(np.frombuffer(zlib.decompress(packed.tobytes()), np.uint8), count=shape[0] * shape[1])
    return bits.view(bool).reshape(shape)


def write_masks(path: Path, masks: Iterable[Mask | None], *, shape: tuple[int, int, int]) -> None:
    """Write the silhouettes of one camera; only one frame at a time is held in memory.

    Args:
        path: The file; an interrupted write leaves no partial file.
        masks: One mask (height, width) per frame; None where no person was detected. Missing frames at the end are
            written as empty.
        shape: Number of frames, height and width.

    Raises:
        FileProblem: The folder cannot be written to.
        ValueError: A silhouette has another shape, or there are more silhouettes than frames.
    """
    with mask_writer(path, shape=shape) as append:
        for mask in masks:
            append(mask)


@contextmanager
def mask_writer(path: Path, *, shape: tuple[int, int, int]) -> Iterator[Callable[[Mask | None], None]]:
    """Open a file for the silhouettes of one camera, to which they are appended frame by frame.

    Args:
        path: The file; an interrupted write leaves no partial file.
        shape: Number of frames, height and width.

    Yields:
        A function that appends the mask (height, width) of the next frame, or None for an empty one. Missing frames at
        the end are written as empty. It raises `ValueError` for a mask of another shape, and for more masks than
        frames.

    Raises:
        FileProblem: The folder cannot be written to.
    """
    with replacing(path) as beside, zipfile.ZipFile(beside, "w", zipfile.ZIP_DEFLATED, compresslevel=4) as archive:
        with archive.open("shape.npy", "w") as stream:
            npy.write_array(stream, np.array(shape, np.int64), allow_pickle=False)
        with archive.open("bits.npy", "w", force_zip64=True) as stream:
            bits = _BitWriter(stream, shape)
            yield bits.append
            bits.finish()


class _BitWriter:
    """Writes numpy.packbits of all frames as one array; a frame may end in the middle of a byte.

    Args:
        stream: The stream, which receives the header at once.
        shape: Number of frames, height and width.
    """

    def __init__(self, stream: IO[bytes], shape: tuple[int, int, int]):
        self._stream, self._shape = stream, shape
        self._total = (math.prod(shape) + 7) // 8
        npy.write_array_header_1_0(stream, {"descr": "|u1", "fortran_order": False, "shape": (self._total,)})
        self._rest, self._written, self._frame = np.zeros(0, bool), 0, 0

    def append(self, mask: Mask | None) -> None:
        """Write the mask (height, width) of the next frame, or an empty one."""
        frames, height, width = self._shape
        picture = np.zeros((height, width), bool) if mask is None else np.asarray(mask, bool)
        if picture.shape != (height, width) or self._frame >= frames:
            raise ValueError(f"Silhouette {self._frame} of shape {picture.shape} does not belong to {self._shape}.")
        bits = np.concatenate([self._rest, picture.ravel()]) if len(self._rest) else picture.ravel()
        whole = len(bits) // 8 * 8
        self._stream.write(np.packbits(bits[:whole]).tobytes())
        self._rest, self._written, self._frame = bits[whole:], self._written + whole // 8, self._frame + 1

    def finish(self) -> None:
        """Write the last incomplete byte, and zeros for the missing frames."""
        if len(self._rest):
            self._stream.write(np.packbits(self._rest).tobytes())
            self._written += 1
        while self._written < self._total:
            block = min(self._total - self._written, 1 << 20)
            self._stream.write(bytes(block))
            self._written += block


def require_no_results(trial: Path, paths: Iterable[Path]) -> None:
    """Check that silhouettes in a trial are given ones, and not results that were written into the trial.

    Args:
        trial: The folder of the trial.
        paths: The silhouettes.

    Raises:
        FileProblem: The trial holds results of marey, and one of the silhouettes is among them.
    """
    written = files_of_runs(trial)
    results = [path for path in paths if path.relative_to(trial).as_posix() in written]
    if results:
        wrong = f"is a result of `marey capture`, by {RECORD} in the trial, and not a known silhouette"
        raise FileProblem(results[0], wrong, f"Remove the results, which {RECORD} lists, from the trial.")


@dataclass(frozen=True, eq=False, kw_only=True)
class MaskFile:
    """The silhouettes of one camera: a file of our own format, or grey images."""

    path: Path
    """The file, or the folder of the images."""
    shape: tuple[int, int, int]
    """Number of frames, height and width."""
    clip: Clip | None = None
    """Grey images, whose values from 0 to 255 are probabilities from 0 to 1; None for a single PNG and our format."""
    pictures: Integers | None = None
    """(F,) number of the silhouette of each frame; None if they have the frames' numbers."""

    def selected(self, pictures: Integers) -> "MaskFile":
        """Return the silhouettes of given pictures (F,) as frames 0 to F - 1."""
        return replace(self, pictures=pictures, shape=(len(pictures), *self.shape[1:]))

    @property
    def paths(self) -> tuple[Path, ...]:
        """All its files."""
        return (self.path,) if self.clip is None else self.clip.paths

    def masks(self, frames: Iterable[int] | None = None) -> Iterator[Mask]:
        """Iterate over silhouettes; only one at a time is held in memory.

        Args:
            frames: Frame numbers, fastest in ascending order; all frames by default.

        Yields:
            (height, width); of probabilities, those above 0.5.

        Raises:
            FileProblem: The file is damaged.
        """
        frames = self._numbers(range(self.shape[0]) if frames is None else frames)
        if self.clip is not None:
            yield from (grey > CERTAIN / 2 for grey in self._grey(self.clip, frames))
            return
        if self.path.suffix.lower() in PICTURE_SUFFIXES:
            picture = _picture_mask(self.path)
            yield from (picture for _ in frames)
            return
        count = self.shape[0] if self.pictures is None else int(self.pictures.max()) + 1
        try:
            with closing(_BitReader(self.path, (count, *self.shape[1:]))) as reader:
                for frame in frames:
                    yield reader.mask(frame)
        except DAMAGED_ARCHIVE as error:
            raise FileProblem(self.path, f"is damaged ({error})", _LAYOUT) from error

    def levels(self, frames: Iterable[int]) -> Iterator[Image]:
        """Iterate over probabilities.

        Args:
            frames: Frame numbers, fastest in ascending order.

        Yields:
            (height, width) uint8, from 0 (certainly not the person) to 255 (certainly the person).

        Raises:
            FileProblem: The file is damaged.
        """
        if self.clip is not None:
            yield from self._grey(self.clip, self._numbers(frames))
        else:
            yield from (mask.astype(np.uint8) * np.uint8(CERTAIN) for mask in self.masks(frames))

    def _numbers(self, frames: Iterable[int]) -> Iterable[int]:
        return frames if self.pictures is None else (int(self.pictures[frame]) for frame in frames)

    def _grey(self, clip: Clip, frames: Iterable[int]) -> Iterator[Image]:
        for image in clip.images(frames):
            yield np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)


def open_masks(path: Path, *, shape: tuple[int, int, int] | None = None) -> MaskFile:
    """Open silhouettes: an NPZ, a PNG for a take of one frame, a folder of PNGs, or a grey video.

    Args:
        path: The file or folder.
        shape: Required number of frames, height and width; not checked by default.

    Returns:
        The file, opened for reading frame by frame.

    Raises:
        FileProblem: The file is missing, or has another format or shape.
    """
    clip: Clip | None = None
    if path.is_dir():
        clip = open_stills(numbered_images(path))
    elif path.suffix.lower() in VIDEO_SUFFIXES:
        clip = open_video(path)
    if clip is not None:
        found = clip.count, clip.size[1], clip.size[0]
    elif path.suffix.lower() in PICTURE_SUFFIXES:
        found = (1, *_picture_mask(path).shape)
    else:
        found = _stated_shape(path)
    if shape is not None and found != tuple(shape):
        wrong = (
            f"has {found[0]} frames of {found[2]} x {found[1]}, but the video has {shape[0]} of {shape[2]} x {shape[1]}"
        )
        raise FileProblem(path, wrong, "Silhouettes should have the number of frames and the size of the video.")
    return MaskFile(path=path, shape=found, clip=clip)


def numbered_images(folder: Path) -> tuple[Path, ...]:
    """Find the PNG images of a folder, in the order of the numbers at the end of their names.

    Args:
        folder: The folder; other files in it are ignored.

    Returns:
        The images.

    Raises:
        FileProblem: There is none, one has no number, or two have the same.
    """
    files: dict[int, Path] = {}
    for path in sorted(path for path in folder.iterdir() if path.suffix.lower() == ".png"):
        number = re.search(r"(\d+)$", path.stem)
        if number is None:
            remedy = "The name of each silhouette should end with the number of its frame."
            raise FileProblem(path, "has no number at the end of its name", remedy)
        if int(number[1]) in files:
            raise FileProblem(
                path, f"has the same number as {files[int(number[1])].name}", "There should be one image per frame."
            )
        files[int(number[1])] = path
    if not files:
        raise FileProblem(folder, "has no PNG image", "It should hold one grey PNG per frame of the video.")
    return tuple(files[number] for number in sorted(files))


def _picture_mask(path: Path) -> Mask:
    """Return pixels above half of the maximum, for masks of 0 and 1 as well as 0 and 255."""
    grey = read_picture(path).max(axis=2)
    return np.asarray(grey > grey.max() / 2)


def _stated_shape(path: Path) -> tuple[int, int, int]:
    try:
        with zipfile.ZipFile(path) as archive:
            require_possible_sizes(path, archive)
            missing = {"shape", "bits"} - {name.removesuffix(".npy") for name in archive.namelist()}
            if missing:
                raise FileProblem(path, f"has no {' and no '.join(sorted(missing))}", _LAYOUT)
            with archive.open("shape.npy") as stream:
                shape = npy.read_array(stream, allow_pickle=False)
            with archive.open("bits.npy") as stream:
                bits, kind = array_header(stream)
    except FileNotFoundError as error:
        raise FileProblem(path, "does not exist", _LAYOUT) from error
    except DAMAGED_ARCHIVE as error:
        raise FileProblem(path, f"cannot be read as silhouettes ({error})", _LAYOUT) from error
    if shape.shape != (3,) or shape.dtype.kind not in "iu" or shape.min() < 1:
        raise FileProblem(path, f"has the shape {shape.tolist()}, which is not (frames, height, width)", _LAYOUT)
    frames, height, width = (int(n) for n in shape)
    if kind != np.uint8 or bits != ((frames * height * width + 7) // 8,):
        wrong = f"has bits of shape {bits} and type {kind}, which are not those of {frames} x {height} x {width} pixels"
        raise FileProblem(path, wrong, _LAYOUT)
    return frames, height, width


class _BitReader:
    """Reads frames of packed bits from a compressed stream, which is reopened only to go backward."""

    def __init__(self, path: Path, shape: tuple[int, int, int]):
        self._archive = zipfile.ZipFile(path)
        self._shape = shape
        self._open()

    def _open(self) -> None:
        self._stream = self._archive.open("bits.npy")
        array_header(self._stream)
        self._next, self._last = 0, b""

    def close(self) -> None:
        self._archive.close()

    def mask(self, frame: int) -> Mask:
        frames, height, width = self._shape
        if not 0 <= frame < frames:
            raise IndexError(f"There are silhouettes of the frames 0 to {frames - 1}, not {frame}.")
        first, last = frame * height * width, (frame + 1) * height * width
        begin, end = first // 8, (last + 7) // 8
        if begin < self._next - len(self._last):
            self._open()
        while self._next < begin:
            self._read(min(begin - self._next, 1 << 20))
        # A frame may begin in the byte in which the previous frame ends.
        content = self._last[: self._next - begin] + self._read(end - self._next)
        bits = np.unpackbits(np.frombuffer(content, np.uint8))[first - 8 * begin : last - 8 * begin]
        return bits.reshape(height, width).astype(bool)

    def _read(self, count: int) -> bytes:
        content = self._stream.read(count)
        if len(content) < count:
            raise EOFError("it ends before its last frame")
        self._next += count
        self._last = content[-1:] or self._last
        return content

"""What was found in each picture of a session, stored on disk while a run lasts, so that it can be resumed."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Generic, TypeVar

from marey.calibration.boards.balls import Spots
from marey.calibration.boards.corners import BoardSighting
from marey.io.calibration.session import SessionFiles
from marey.io.stages import Arrays, FrameLog, file_fingerprint
from marey.pipelines.run_record import StageCache

Found = TypeVar("Found")


@dataclass(frozen=True, eq=False, kw_only=True)
class StoredPictures(Generic[Found]):
    """Where a stage stores what it found in each picture."""

    cache: StageCache
    name: str
    """Name of the stage, which becomes part of the file names."""
    depends: object
    """Everything that the stage depends on besides the pictures."""
    pack: Callable[[Found], Arrays]
    """Returns what was found as arrays, at least one."""
    unpack: Callable[[Arrays], Found]
    """The inverse of `pack`."""

    def logs(self, cameras: Sequence[str], stack: ExitStack) -> list[FrameLog]:
        """Open the log of each camera; its length is the number of finished pictures.

        Args:
            cameras: Names of the cameras.
            stack: Closes the logs.
        """
        return [
            stack.enter_context(self.cache.frames(f"{self.name}-{k}", depends=(camera, self.depends)))
            for k, camera in enumerate(cameras)
        ]

    def append(self, log: FrameLog, found: Found | None) -> None:
        """Store what was found in the next picture.

        Args:
            log: The log of the camera.
            found: What was found; None for nothing.
        """
        log.append({} if found is None else self.pack(found))

    def read(self, log: FrameLog) -> list[Found | None]:
        """Return what was found in the finished pictures.

        Args:
            log: The log of the camera.
        """
        return [self.unpack(arrays) if arrays else None for arrays in log]


def session_fingerprints(session: SessionFiles) -> list[object]:
    """Return what identifies the pictures of a session: names of the cameras, instants, and hashes of the files.

    Args:
        session: The videos or pictures.

    Raises:
        FileProblem: A file cannot be read.
    """
    return [
        [each.name, each.instants, [file_fingerprint(path) for path in each.clip.paths]] for each in session.clips
    ]


def stored_sightings(cache: StageCache, name: str, depends: object) -> StoredPictures[BoardSighting]:
    """Return where a stage stores the corners that it found.

    Args:
        cache: The checkpoints of the run.
        name: Name of the stage, which becomes part of the file names.
        depends: Everything that the stage depends on besides the pictures.
    """
    return StoredPictures(cache=cache, name=name, depends=depends, pack=_packed_sighting, unpack=_unpacked_sighting)


def stored_spots(cache: StageCache, name: str, depends: object) -> StoredPictures[list[Spots]]:
    """Return where a stage stores the spots that it found, of one or several colours.

    Args:
        cache: The checkpoints of the run.
        name: Name of the stage, which becomes part of the file names.
        depends: Everything that the stage depends on besides the pictures.
    """
    return StoredPictures(cache=cache, name=name, depends=depends, pack=_packed_spots, unpack=_unpacked_spots)


def _packed_sighting(found: BoardSighting) -> Arrays:
    return {"corner": found.corner, "pixels": found.pixels, "covariance": found.covariance}


def _unpacked_sighting(arrays: Arrays) -> BoardSighting:
    return BoardSighting(corner=arrays["corner"], pixels=arrays["pixels"], covariance=arrays["covariance"])


def _packed_spots(found: list[Spots]) -> Arrays:
    return {
        f"{name}{k}": getattr(each, name) for k, each in enumerate(found) for name in ("pixels", "variance", "area")
    }


def _unpacked_spots(arrays: Arrays) -> list[Spots]:
    return [
        Spots(pixels=arrays[f"pixels{k}"], variance=arrays[f"variance{k}"], area=arrays[f"area{k}"])
        for k in range(len(arrays) // 3)
    ]

"""What the tests share."""

import gc
import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg  # noqa: F401  (its threads are limited below, too)
from threadpoolctl import threadpool_limits

from tests.pages import links_checked

gc.disable()


def pytest_collection_finish() -> None:
    """Leave modules and collected tests out of garbage collection: this saves about 5 % of the time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)
    gc.enable()


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> Iterator[None]:
    """Small matrices on several threads wait for each other most of the time; a capture uses one, too."""
    with threadpool_limits(1):
        yield


@pytest.fixture(scope="session", autouse=True)
def whole_links() -> Iterator[None]:
    """Every page that a test lets a command write links only to files that exist."""
    with links_checked():
        yield


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20060101)


@pytest.fixture
def shared() -> Path:
    """The recordings and rendered takes beside the project; a test that needs them skips where they are missing."""
    for up in Path(__file__).resolve().parents[1:5]:
        if (up / "shared" / "data").is_dir():
            return up / "shared"
    pytest.skip("../shared is not beside the project")


@pytest.fixture
def full_disk() -> Callable[[int], AbstractContextManager[None]]:
    """A context in which no file can become larger than a number of bytes, as on a disk that is full by then."""
    resource = pytest.importorskip("resource", reason="this system has no limits for the size of files")

    @contextmanager
    def limited(most: int) -> Iterator[None]:
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

    return limited


@pytest.fixture
def mounted(tmp_path: Path) -> Iterator[Callable[[str], Path]]:
    """Mounts an empty file system in memory with options, for example a small or a read-only one."""
    places: list[Path] = []

    def mount(options: str) -> Path:
        place = tmp_path / f"disk{len(places)}"
        place.mkdir()
        done = os.name == "posix" and os.geteuid() == 0
        done = done and not subprocess.run(
            ["mount", "-t", "tmpfs", "-o", options, "none", str(place)], capture_output=True, check=False
        ).returncode  # fmt: skip
        if not done:
            pytest.skip("only the administrator can mount a file system")
        places.append(place)
        return place

    yield mount
    for place in places:
        # Lazily: a traceback may still hold a file of the disk.
        subprocess.run(["umount", "--lazy", str(place)], check=True)

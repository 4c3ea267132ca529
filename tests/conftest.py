"""What the tests share."""

import gc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg  # noqa: F401  (its threads are limited below, too)
from threadpoolctl import threadpool_limits

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

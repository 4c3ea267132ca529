"""A value that takes long is computed once for all parallel workers of a test run."""

import os
import pickle
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import pytest

Value = TypeVar("Value")

WAITING_S = 300
"""Time after which a worker no longer waits for a value that another one computes [s]."""


def common_folder(factory: pytest.TempPathFactory) -> Path:
    """Return the folder of temporary files that all workers of this run have in common."""
    base = factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


def computed_once(factory: pytest.TempPathFactory, name: str, compute: Callable[[], Value]) -> Value:
    """Return a value that one of the workers computes; the others read it from a file.

    Args:
        factory: Gives the folder.
        name: Of the value.
        compute: Returns it; it can be pickled.

    Returns:
        The value. If its computation fails, each worker has the error of its own computation.
    """
    folder = common_folder(factory) / f"computed-{name}"
    try:
        folder.mkdir()
    except FileExistsError:
        wait_for(folder, "value", "failed")
        if (folder / "failed").exists():
            return compute()
        return pickle.loads((folder / "value").read_bytes())
    try:
        value = compute()
        (folder / "begun").write_bytes(pickle.dumps(value))
    except BaseException:
        (folder / "failed").touch()
        raise
    (folder / "begun").rename(folder / "value")
    return value


def wait_for(folder: Path, *names: str) -> None:
    """Wait until one of some files exists."""
    end = time.monotonic() + WAITING_S
    while not any((folder / name).exists() for name in names):
        assert time.monotonic() < end, f"{' or '.join(names)} has not appeared"
        time.sleep(0.1)

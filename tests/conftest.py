"""What the tests share."""

from pathlib import Path

import numpy as np
import pytest


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

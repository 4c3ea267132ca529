"""What continuous integration installs: each archive has a hash, at the version that the constraints state."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def normalised(name: str) -> str:
    """Return the name of a package as indices compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def constrained() -> dict[str, str]:
    """Return the versions of constraints.txt by package."""
    pairs = [line.split("==") for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line]
    return {normalised(name): version for name, version in pairs}


@pytest.mark.parametrize("python", ["3.11", "3.13"])
def test_each_package_has_a_hash_and_the_version_of_the_constraints(python):
    lines = (ROOT / ".ci" / f"hashes-{python}.txt").read_text().splitlines()
    found = [re.fullmatch(r"([\w.-]+)==(\S+) --hash=sha256:[0-9a-f]{64}", line) for line in lines if line[0] != "#"]
    assert all(found)
    versions = {normalised(each[1]): each[2] for each in found if each is not None}
    assert len(versions) == len(found) > 50
    known = constrained()
    assert {name: version for name, version in versions.items() if known.get(name) != version} == {}
    assert {"numpy", "pytest", "setuptools", "setuptools-scm", "distributed"} <= set(versions)

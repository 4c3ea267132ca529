"""Measures how a body moves and what shape it has, from what is seen at its surface."""

import os
import tempfile
from pathlib import Path

UNKNOWN_VERSION = "0+unknown"
"""Version of a source tree that was never installed: its tags were not read."""


def __getattr__(name: str) -> str:
    """Read the version, which follows the repository's tags, from the installed package when it is first needed."""
    if name != "__version__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib.metadata import PackageNotFoundError, version

    try:
        globals()[name] = version("marey")
    except PackageNotFoundError:
        globals()[name] = UNKNOWN_VERSION
    return str(globals()[name])


def _find_place_for_kernels() -> None:
    """Give compiled kernels a folder where neither the program's nor the user's can be written to.

    Numba keeps them beside the code, or else in the user's cache; where both are read-only, as in some containers,
    it would refuse to start. A private folder, because what lies in it is run.
    """
    home = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~"))
    places = [Path(__file__).parent, home, *home.parents]
    nearest_home = next(place for place in places[1:] if place.exists())
    if not any(os.access(place, os.W_OK) for place in (places[0], nearest_home)):
        os.environ.setdefault("NUMBA_CACHE_DIR", tempfile.mkdtemp(prefix="marey-kernels-"))


_find_place_for_kernels()

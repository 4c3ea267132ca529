"""Measures how a body moves and what shape it has, from what is seen at its surface."""

import os
import tempfile
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from marey.cameras.camera import Camera
    from marey.cameras.rig import Rig
    from marey.cameras.triangulate import triangulate
    from marey.errors import FileProblem, MareyError, SettingProblem
    from marey.io.trial.example import example_folder
    from marey.observations.observation import Linearization, Observation, SurfaceObservation
    from marey.pipelines.markers.bones import Bones, load_bones
    from marey.pipelines.markers.estimate import estimate_bones, open_markers
    from marey.pipelines.nonrigid.factorise import factorise, read_tracks
    from marey.pipelines.nonrigid.shapes import Shapes, load_shapes
    from marey.pipelines.progress import Progress, RecordingProgress
    from marey.process import tuned_process

__version__ = "0.1.0"

__all__ = [
    "Bones",
    "Camera",
    "FileProblem",
    "Linearization",
    "MareyError",
    "Observation",
    "Progress",
    "RecordingProgress",
    "Rig",
    "SettingProblem",
    "Shapes",
    "SurfaceObservation",
    "__version__",
    "estimate_bones",
    "example_folder",
    "factorise",
    "load_bones",
    "load_shapes",
    "open_markers",
    "read_tracks",
    "triangulate",
    "tuned_process",
]

_MODULES = {
    "Bones": "pipelines.markers.bones",
    "Camera": "cameras.camera",
    "FileProblem": "errors",
    "Linearization": "observations.observation",
    "MareyError": "errors",
    "Observation": "observations.observation",
    "Progress": "pipelines.progress",
    "RecordingProgress": "pipelines.progress",
    "Rig": "cameras.rig",
    "SettingProblem": "errors",
    "Shapes": "pipelines.nonrigid.shapes",
    "SurfaceObservation": "observations.observation",
    "estimate_bones": "pipelines.markers.estimate",
    "example_folder": "io.trial.example",
    "factorise": "pipelines.nonrigid.factorise",
    "load_bones": "pipelines.markers.bones",
    "load_shapes": "pipelines.nonrigid.shapes",
    "open_markers": "pipelines.markers.estimate",
    "read_tracks": "pipelines.nonrigid.factorise",
    "triangulate": "cameras.triangulate",
    "tuned_process": "process",
}
"""The module of each public name; it is imported when the name is first used ([PEP 562])."""


def __getattr__(name: str) -> object:
    """Import a public name from its module."""
    if name not in _MODULES:
        raise AttributeError(f"module 'marey' has no attribute {name!r}")
    value = getattr(import_module(f"marey.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names, whether they are imported yet or not."""
    return sorted({*globals(), *__all__})


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

"""Measures how a body moves and what shape it has, from what is seen at its surface."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from marey.cameras.camera import Camera
    from marey.cameras.rig import Rig
    from marey.cameras.triangulate import triangulate
    from marey.errors import FileProblem, MareyError, SettingProblem
    from marey.io.mr.volumes import read_volume
    from marey.io.trial.example import example_folder
    from marey.observations.observation import Linearization, Observation, SurfaceObservation
    from marey.pipelines.knee.knee import Knee, load_knee
    from marey.pipelines.knee.segment import segment_knee
    from marey.pipelines.markers.bones import Bones, load_bones
    from marey.pipelines.markers.estimate import estimate_bones, open_markers
    from marey.pipelines.nonrigid.factorise import factorise, read_tracks
    from marey.pipelines.nonrigid.shapes import Shapes, load_shapes
    from marey.pipelines.progress import Progress, RecordingProgress
    from marey.process import tuned_process

    __version__: str
UNKNOWN_VERSION = "0+unknown"
"""Version of a source tree that was never installed: its tags were not read."""


__all__ = [
    "Bones",
    "Camera",
    "FileProblem",
    "Knee",
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
    "load_knee",
    "load_shapes",
    "open_markers",
    "read_tracks",
    "read_volume",
    "segment_knee",
    "triangulate",
    "tuned_process",
]

_MODULES = {
    "Bones": "pipelines.markers.bones",
    "Camera": "cameras.camera",
    "FileProblem": "errors",
    "Knee": "pipelines.knee.knee",
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
    "load_knee": "pipelines.knee.knee",
    "load_shapes": "pipelines.nonrigid.shapes",
    "open_markers": "pipelines.markers.estimate",
    "read_tracks": "pipelines.nonrigid.factorise",
    "read_volume": "io.mr.volumes",
    "segment_knee": "pipelines.knee.segment",
    "triangulate": "cameras.triangulate",
    "tuned_process": "process",
}
"""The module of each public name; it is imported when the name is first used ([PEP 562])."""


def __getattr__(name: str) -> object:
    """Import a public name from its module, or read the version, when it is first used."""
    if name == "__version__":
        value: object = _installed_version()
    elif name in _MODULES:
        value = getattr(import_module(f"marey.{_MODULES[name]}"), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def _installed_version() -> str:
    """Return the version of the installed package, which follows the repository's tags."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("marey")
    except PackageNotFoundError:
        return UNKNOWN_VERSION


def __dir__() -> list[str]:
    """List the public names, whether they are imported yet or not."""
    return sorted({*globals(), *__all__})

"""Measures how a body moves and what shape it has, from what is visible at its surface."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from marey.cameras.camera import Camera
    from marey.cameras.rig import Rig
    from marey.cameras.triangulate import triangulate
    from marey.errors import FileProblem, MareyError, MareyWarning, SettingProblem
    from marey.io.mr.volumes import read_volume
    from marey.io.trial.example import example_folder
    from marey.observations.observation import Linearization, Observation, SurfaceObservation
    from marey.pipelines.calibrate.result import Calibration
    from marey.pipelines.calibrate.tasks import calibrate
    from marey.pipelines.capture.motion import Motion, load_body, load_motion
    from marey.pipelines.capture.tasks import capture, open_trial, read_cameras
    from marey.pipelines.compare import Comparison, compare
    from marey.pipelines.convert_cameras import write_cameras
    from marey.pipelines.device import AlignedDevice, align_device
    from marey.pipelines.exchange.export import export
    from marey.pipelines.gait.profile import GaitProfile, gait_profile
    from marey.pipelines.gait.walks import GaitComparison, compare_gait
    from marey.pipelines.group.everybody import CapturedPeople, capture_people
    from marey.pipelines.group.listing import PeopleList, list_people
    from marey.pipelines.knee.animate import animate_knee
    from marey.pipelines.knee.animated_knee import AnimatedKnee, load_animated_knee
    from marey.pipelines.knee.knee import Knee, load_knee
    from marey.pipelines.knee.segment import segment_knee
    from marey.pipelines.markers.bones import Bones, load_bones
    from marey.pipelines.markers.estimate import estimate_bones, open_markers
    from marey.pipelines.nonrigid.factorise import factorise, read_tracks
    from marey.pipelines.nonrigid.shapes import Shapes, load_shapes
    from marey.pipelines.progress import Progress, RecordingProgress
    from marey.pipelines.propose import TrialProposal, propose_trial
    from marey.pipelines.retarget import retarget
    from marey.pipelines.shape.tasks import fit_shape
    from marey.pipelines.study.study import Study, run_study
    from marey.pipelines.surface.result import Surface, load_surface
    from marey.pipelines.surface.tasks import match_images, measure_surface
    from marey.pipelines.sync.sync import Synchronisation
    from marey.pipelines.sync.tasks import synchronise
    from marey.pipelines.verdict import NotUsable, Verdict
    from marey.process import tuned_process

    __version__: str
UNKNOWN_VERSION = "0+unknown"
"""Version of a source tree that was never installed: its tags were not read."""


__all__ = [
    "AlignedDevice",
    "AnimatedKnee",
    "Bones",
    "Calibration",
    "Camera",
    "CapturedPeople",
    "Comparison",
    "FileProblem",
    "GaitComparison",
    "GaitProfile",
    "Knee",
    "Linearization",
    "MareyError",
    "MareyWarning",
    "Motion",
    "NotUsable",
    "Observation",
    "PeopleList",
    "Progress",
    "RecordingProgress",
    "Rig",
    "SettingProblem",
    "Shapes",
    "Study",
    "Surface",
    "SurfaceObservation",
    "Synchronisation",
    "TrialProposal",
    "Verdict",
    "__version__",
    "align_device",
    "animate_knee",
    "calibrate",
    "capture",
    "capture_people",
    "compare",
    "compare_gait",
    "estimate_bones",
    "example_folder",
    "export",
    "factorise",
    "fit_shape",
    "gait_profile",
    "list_people",
    "load_animated_knee",
    "load_body",
    "load_bones",
    "load_knee",
    "load_motion",
    "load_shapes",
    "load_surface",
    "match_images",
    "measure_surface",
    "open_markers",
    "open_trial",
    "propose_trial",
    "read_cameras",
    "read_tracks",
    "read_volume",
    "retarget",
    "run_study",
    "segment_knee",
    "synchronise",
    "triangulate",
    "tuned_process",
    "write_cameras",
]

_MODULES = {
    "AnimatedKnee": "pipelines.knee.animated_knee",
    "Bones": "pipelines.markers.bones",
    "Calibration": "pipelines.calibrate.result",
    "Camera": "cameras.camera",
    "CapturedPeople": "pipelines.group.everybody",
    "AlignedDevice": "pipelines.device",
    "Comparison": "pipelines.compare",
    "FileProblem": "errors",
    "GaitComparison": "pipelines.gait.walks",
    "GaitProfile": "pipelines.gait.profile",
    "Knee": "pipelines.knee.knee",
    "Linearization": "observations.observation",
    "MareyError": "errors",
    "MareyWarning": "errors",
    "Motion": "pipelines.capture.motion",
    "NotUsable": "pipelines.verdict",
    "Observation": "observations.observation",
    "PeopleList": "pipelines.group.listing",
    "Progress": "pipelines.progress",
    "RecordingProgress": "pipelines.progress",
    "Rig": "cameras.rig",
    "SettingProblem": "errors",
    "Shapes": "pipelines.nonrigid.shapes",
    "Study": "pipelines.study.study",
    "Surface": "pipelines.surface.result",
    "SurfaceObservation": "observations.observation",
    "Synchronisation": "pipelines.sync.sync",
    "Verdict": "pipelines.verdict",
    "TrialProposal": "pipelines.propose",
    "animate_knee": "pipelines.knee.animate",
    "calibrate": "pipelines.calibrate.tasks",
    "capture": "pipelines.capture.tasks",
    "capture_people": "pipelines.group.everybody",
    "align_device": "pipelines.device",
    "compare": "pipelines.compare",
    "compare_gait": "pipelines.gait.walks",
    "estimate_bones": "pipelines.markers.estimate",
    "example_folder": "io.trial.example",
    "export": "pipelines.exchange.export",
    "factorise": "pipelines.nonrigid.factorise",
    "fit_shape": "pipelines.shape.tasks",
    "gait_profile": "pipelines.gait.profile",
    "list_people": "pipelines.group.listing",
    "load_animated_knee": "pipelines.knee.animated_knee",
    "load_body": "pipelines.capture.motion",
    "load_bones": "pipelines.markers.bones",
    "load_knee": "pipelines.knee.knee",
    "load_motion": "pipelines.capture.motion",
    "load_shapes": "pipelines.nonrigid.shapes",
    "load_surface": "pipelines.surface.result",
    "match_images": "pipelines.surface.tasks",
    "measure_surface": "pipelines.surface.tasks",
    "open_markers": "pipelines.markers.estimate",
    "open_trial": "pipelines.capture.tasks",
    "propose_trial": "pipelines.propose",
    "read_cameras": "pipelines.capture.tasks",
    "read_tracks": "pipelines.nonrigid.factorise",
    "read_volume": "io.mr.volumes",
    "retarget": "pipelines.retarget",
    "run_study": "pipelines.study.study",
    "segment_knee": "pipelines.knee.segment",
    "synchronise": "pipelines.sync.tasks",
    "triangulate": "cameras.triangulate",
    "tuned_process": "process",
    "write_cameras": "pipelines.convert_cameras",
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

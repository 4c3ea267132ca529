"""Repairs of a trial whose cameras contradict each other: other calibrations, clocks, or fewer cameras."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from marey.cameras.camera import Camera
from marey.cameras.clocks import Clocks
from marey.cameras.rig import Rig
from marey.geometry.rigid import RigidTransform
from marey.io.trial.trial import Trial, read_trial, with_clocks
from marey.pipelines.verdict import VerdictReason

_TANGENTIAL, _PRISM = slice(2, 4), slice(8, 12)
"""Coefficients of a lens that change their sign if the picture is turned by half a turn."""


class CamerasContradict(Exception):
    """The cameras of a take contradict each other, and the cause is known; the take is to be opened again, repaired.

    Args:
        repairs: The repair of this cause.
        moved: Number of the camera that was probably moved; None if the cause is another one.
    """

    def __init__(self, repairs: "Repairs", *, moved: int | None = None):
        self.repairs, self.moved = repairs, moved
        super().__init__(" ".join(str(reason) for reason in repairs.reasons))


@dataclass(frozen=True, eq=False, kw_only=True)
class Repairs:
    """What is changed in a trial before it is captured."""

    cameras: Mapping[str, Camera] = field(default_factory=dict)
    """Other calibrations of some cameras, by name, in the world of the results."""
    left_out: tuple[str, ...] = ()
    """Cameras that are not used."""
    clocks: Clocks | None = None
    """The clocks of the cameras; None if they have one clock, or those of sync.json."""
    moved: Camera | None = None
    """The camera that was moved and is found again, as it was calibrated; None if there is none."""
    reasons: tuple[VerdictReason, ...] = ()
    """What was found and repaired."""

    def __bool__(self) -> bool:
        return bool(self.reasons)

    def then(self, other: "Repairs") -> "Repairs":
        """Return these repairs followed by others."""
        return Repairs(
            cameras={**self.cameras, **other.cameras}, left_out=(*self.left_out, *other.left_out),
            clocks=self.clocks if other.clocks is None else other.clocks,
            moved=self.moved if other.moved is None else other.moved, reasons=(*self.reasons, *other.reasons),
        )  # fmt: skip

    def applied(self, trial: Trial) -> Trial:
        """Open a trial again with the repairs.

        Args:
            trial: The trial as it was given.

        Returns:
            The repaired trial.
        """
        if not self:
            return trial
        given = trial.rig
        names = tuple(name for name in given.names if name not in self.left_out)
        if self.left_out:
            trial = read_trial(trial.folder, **(trial.settings.model_dump(exclude_none=True) | {"cameras": names}))
        if self.clocks is not None:
            clocks = self.clocks if self.clocks.names == names else self.clocks.subset(names)
            trial = with_clocks(trial, clocks)
        # The given cameras may be others than those of the file.
        rig = Rig(tuple(self.cameras.get(name, given[name]) for name in names))
        return replace(trial, rig=rig)


def half_turned(camera: Camera) -> Camera:
    """Return the camera of pictures that are turned by half a turn.

    Args:
        camera: The camera of the pictures as they were when it was calibrated.

    Returns:
        The camera; it projects each point to the opposite pixel.
    """
    matrix, lens = np.array(camera.matrix), np.array(camera.distortion)
    matrix[:2, 2] = np.array(camera.size) - 1 - matrix[:2, 2]
    if not camera.fisheye:
        lens[_TANGENTIAL] *= -1
        lens[_PRISM] *= -1
    turn, pose = np.diag([-1.0, -1.0, 1.0]), camera.camera_from_world
    turned = RigidTransform(turn @ pose.rotation, turn @ pose.translation)
    return replace(camera, matrix=matrix, distortion=lens, camera_from_world=turned)

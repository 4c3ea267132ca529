"""Force plates: their frame in the laboratory, ground reaction force, and centre of pressure."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.geometry.rigid import RigidTransform

LOADED_N = 20.0
"""A plate carries a foot above this vertical force [N]; below it the centre of pressure is not defined reliably. Chosen
by hand; results were not measured against other values."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ForcePlate:
    """One force plate of a trial, over T samples of its own rate."""

    name: str
    """`force_plate_1`, ..."""
    corners: Floats
    """(4, 3) in the laboratory [m], in the file's order."""
    rate: float
    """Sampling rate [Hz]."""
    force: Floats
    """(T, 3) force of the plate on the person, in the laboratory [N]."""
    moment: Floats
    """(T, 3) moment of that force about the centre of the plate's surface, in the laboratory [N m]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "corners", "force", "moment")

    @property
    def laboratory_from_plate(self) -> RigidTransform:
        """The plate's frame: origin at the centre of its surface, X from its second corner to its first.

        The corners lie at (+x, +y), (-x, +y), (-x, -y), (+x, -y). Z completes the right-handed frame, perpendicular to
        the surface; for most plates it points down.
        """
        c = self.corners
        x = (c[0] + c[3] - c[1] - c[2]) / 2
        y = (c[0] + c[1] - c[2] - c[3]) / 2
        z = np.cross(x, y)
        x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
        return RigidTransform(np.stack([x, np.cross(z, x), z], -1), c.mean(0))

    @property
    def vertical(self) -> Floats:
        """(T,) force perpendicular to the surface, positive under load [N]."""
        return np.asarray(self.force @ upward(self))

    @property
    def centre_of_pressure(self) -> Floats:
        """(T, 3) in the laboratory, on the surface [m]; NaN where the plate carries less than `LOADED_N`."""
        frame = self.laboratory_from_plate
        force, moment = self.force @ frame.rotation, self.moment @ frame.rotation
        carried = np.where(np.abs(force[:, 2]) > LOADED_N, force[:, 2], np.nan)
        at = np.stack([-moment[:, 1] / carried, moment[:, 0] / carried, 0 * carried], -1)
        return frame.apply(at)


def upward(plate: ForcePlate) -> Floats:
    """Return the direction (3,) perpendicular to the plate in which it pushes."""
    normal = plate.laboratory_from_plate.rotation[:, 2]
    pushes = plate.force @ normal
    heaviest = pushes[int(np.argmax(np.abs(pushes)))] if len(pushes) else 1.0
    return np.asarray(normal if heaviest >= 0 else -normal)

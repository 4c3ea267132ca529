"""Force plates: their frame in the laboratory, ground reaction force, and centre of pressure."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.geometry.rigid import RigidTransform

_LOADED_N = 20.0


@dataclass(frozen=True, eq=False, kw_only=True)
class ForcePlate:
    """One force plate of a trial, over T samples of its own rate."""

    name: str
    """`force_plate_1`, ..."""
    corners: Floats
    """(4, 3) in the laboratory [m], in the file's order."""
    rate: float
    """[Hz]."""
    force: Floats
    """(T, 3) what the plate does to the person, in the laboratory [N]."""
    moment: Floats
    """(T, 3) of that force about the middle of the plate's surface, in the laboratory [N m]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "corners", "force", "moment")

    @property
    def laboratory_from_plate(self) -> RigidTransform:
        """The plate's frame: origin in the middle of its surface, X from its second corner to its first, Z as it says.

        The corners lie at (+x, +y), (-x, +y), (-x, -y), (+x, -y); Z is square to the surface, in most plates downward.
        """
        c = self.corners
        x = (c[0] + c[3] - c[1] - c[2]) / 2
        y = (c[0] + c[1] - c[2] - c[3]) / 2
        z = np.cross(x, y)
        x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
        return RigidTransform(np.stack([x, np.cross(z, x), z], -1), c.mean(0))

    @property
    def vertical(self) -> Floats:
        """(T,) force square to the surface, positive while it carries [N]."""
        return np.asarray(self.force @ upward(self))

    @property
    def centre_of_pressure(self) -> Floats:
        """(T, 3) in the laboratory, on the surface [m]; NaN where the plate carries less than 20 N."""
        frame = self.laboratory_from_plate
        force, moment = self.force @ frame.rotation, self.moment @ frame.rotation
        carried = np.where(np.abs(force[:, 2]) > _LOADED_N, force[:, 2], np.nan)
        at = np.stack([-moment[:, 1] / carried, moment[:, 0] / carried, 0 * carried], -1)
        return frame.apply(at)


def upward(plate: ForcePlate) -> Floats:
    """Give the direction (3,) square to the plate into which it pushes."""
    normal = plate.laboratory_from_plate.rotation[:, 2]
    pushes = plate.force @ normal
    heaviest = pushes[int(np.argmax(np.abs(pushes)))] if len(pushes) else 1.0
    return np.asarray(normal if heaviest >= 0 else -normal)

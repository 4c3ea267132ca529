"""Named cameras in one world and on one clock."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from marey.arrays import Floats, frozen
from marey.cameras.camera import Camera
from marey.errors import SettingProblem
from marey.geometry.rigid import RigidTransform


@dataclass(frozen=True, eq=False)
class Rig:
    """The cameras of a take, in the order of their file.

    Raises:
        SettingProblem: There is no camera, or two have the same name.

    Example:
        >>> import marey
        >>> rig = marey.read_cameras(marey.example_folder())
        >>> rig.subset(["cam01", "cam03"]).names
        ('cam01', 'cam03')
    """

    cameras: tuple[Camera, ...]
    """At least one; names are unique."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "cameras", tuple(self.cameras))
        twice = sorted({name for name in self.names if self.names.count(name) > 1})
        if twice:
            raise SettingProblem(f"Two cameras are called '{twice[0]}'; every camera needs a name of its own.")
        if not self.cameras:
            raise SettingProblem("A rig needs at least one camera.")

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return tuple(camera.name for camera in self.cameras)

    @cached_property
    def packed(self) -> Floats:
        """All cameras for kernels (C, `marey.cameras.lens.PACKED`)."""
        return frozen(np.stack([camera.packed for camera in self.cameras]))

    @cached_property
    def centres(self) -> Floats:
        """The centres of projection (C, 3) in the world [m]."""
        return frozen(np.stack([camera.centre for camera in self.cameras]))

    def __repr__(self) -> str:
        return f"Rig of {len(self.cameras)} cameras: " + ", ".join(map(repr, self.cameras))

    def __len__(self) -> int:
        return len(self.cameras)

    def __iter__(self) -> Iterator[Camera]:
        return iter(self.cameras)

    def __getitem__(self, name: str) -> Camera:
        self._require([name])
        return self.cameras[self.names.index(name)]

    def subset(self, names: Sequence[str]) -> "Rig":
        """Keep some of the cameras, in the rig's own order.

        Args:
            names: The cameras to keep.

        Returns:
            A smaller rig.

        Raises:
            SettingProblem: A name is not in the rig.
        """
        self._require(names)
        return Rig(tuple(camera for camera in self.cameras if camera.name in set(names)))

    def scaled(self, factor: float) -> "Rig":
        """Return the cameras of images that are resized by a factor.

        Args:
            factor: Ratio of new to old size.

        Returns:
            The rig of the resized images.
        """
        return Rig(tuple(camera.scaled(factor) for camera in self.cameras))

    def moved(self, new_from_old: RigidTransform) -> "Rig":
        """Return the same cameras in another world frame.

        Args:
            new_from_old: Transform from the present world frame to the new one.

        Returns:
            The rig in the new world frame.
        """
        return Rig(tuple(camera.moved(new_from_old) for camera in self.cameras))

    def _require(self, names: Sequence[str]) -> None:
        unknown = [name for name in names if name not in self.names]
        if unknown:
            known = ", ".join(self.names)
            raise SettingProblem(f"There is no camera '{unknown[0]}'. The cameras are: {known}.")

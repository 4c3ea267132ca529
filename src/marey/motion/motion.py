"""A measured motion: joints, segments, coordinates and angles in every frame, with standard deviations."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from marey.arrays import Floats, Integers, Mask, fields_of, frozen, true_runs
from marey.errors import MareyError

NO_PERSON, MEASURED, FILLED, LOST = range(4)
"""States of a frame: no person detected; pose measured; pose filled from its neighbours; person lost."""

_SHAPES = {
    "time": "F",
    "joint_centres": "FJ3",
    "joint_centres_sd": "FJ3",
    "segment_rotation": "FS33",
    "segment_origin": "FS3",
    "coordinates": "FD",
    "coordinates_sd": "FD",
    "determined": "FD",
    "angles_deg": "FA",
    "angles_deg_sd": "FA",
    "angles_determined": "FA",
    "state": "F",
    "agreement": "FC",
}
"""Shape of each array field; letters are numbers of frames and names, digits are fixed sizes."""
_NAMES = {"joint_names": "J", "segment_names": "S", "coordinate_names": "D", "angle_names": "A", "camera_names": "C"}
"""Letter of the number of names in each field of names."""
_DTYPES = {"determined": bool, "angles_determined": bool, "state": np.int8}
"""Element types of the array fields that are not floating-point."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyMotion:
    """A motion over the F frames of a video; NaN where there is no estimate, except in flags and states.

    Every array is checked against the number of frames and of names, copied, and made read-only.
    """

    time: Floats
    """(F,) time of each frame [s]."""
    rate: float
    """Frames per second [Hz]."""
    joint_names: tuple[str, ...]
    """J names."""
    joint_centres: Floats
    """(F, J, 3) in the world [m]."""
    joint_centres_sd: Floats
    """(F, J, 3) standard deviations [m]."""
    segment_names: tuple[str, ...]
    """S names."""
    segment_rotation: Floats
    """(F, S, 3, 3) world from segment: the identity in the rest posture."""
    segment_origin: Floats
    """(F, S, 3) the segment's proximal joint centre in the world [m]."""
    coordinate_names: tuple[str, ...]
    """D names of the skeleton's coordinates, the six of the root first."""
    coordinates: Floats
    """(F, D) coordinates [rad], the first three [m]."""
    coordinates_sd: Floats
    """(F, D) standard deviations [rad], the first three [m]."""
    determined: Mask
    """(F, D) False where the views do not determine the coordinate."""
    angle_names: tuple[str, ...]
    """A names of anatomical angles (docs/explanation/angles.md)."""
    angles_deg: Floats
    """(F, A) angles [degrees]."""
    angles_deg_sd: Floats
    """(F, A) standard deviations [degrees]."""
    state: Integers
    """(F,) 0 no person detected, 1 measured, 2 filled, 3 lost."""
    camera_names: tuple[str, ...]
    """C names."""
    agreement: Floats
    """(F, C) intersection over union of projected surface and silhouette."""
    angles_determined: Mask | None = None
    """(F, A) False where the views do not determine the angle; None if that is not known, as in files of version 0.1
    and before."""

    def __post_init__(self) -> None:
        sizes = {"F": len(np.atleast_1d(self.time))}
        for name, letter in _NAMES.items():
            names = tuple(str(n) for n in getattr(self, name))
            object.__setattr__(self, name, names)
            sizes[letter] = len(names)
        lists = {name: getattr(self, name) for name in _NAMES}
        faults = [f"two entries of {name} are equal" for name, own in lists.items() if len(set(own)) < len(own)]
        for name, letters in self._shapes().items():
            array = frozen(getattr(self, name), _DTYPES.get(name, np.float64))
            wanted = tuple(sizes[c] if c in sizes else int(c) for c in letters)
            if array.shape != wanted:
                faults.append(f"{name} has the shape {array.shape} and should have {wanted}")
            object.__setattr__(self, name, array)
        object.__setattr__(self, "rate", float(self.rate))
        if not (np.isfinite(self.rate) and self.rate > 0):
            faults.append(f"rate is {self.rate} and should be above 0")
        if not np.isfinite(self.time).all():
            faults.append("time contains NaN or infinite values")
        if not np.isin(self.state, (NO_PERSON, MEASURED, FILLED, LOST)).all():
            faults.append("state contains values other than 0, 1, 2 and 3")
        if faults:
            raise MareyError("The motion is inconsistent: " + "; ".join(faults) + ".")

    def _shapes(self) -> dict[str, str]:
        """Return the shapes of the arrays that the motion has."""
        return {name: letters for name, letters in _SHAPES.items() if getattr(self, name) is not None}

    def __len__(self) -> int:
        return len(self.time)

    @cached_property
    def answered(self) -> Mask:
        """(F,) True where every segment has a pose."""
        poses = np.concatenate(
            [self.segment_rotation.reshape(len(self), -1), self.segment_origin.reshape(len(self), -1)], 1
        )
        return np.asarray(np.isfinite(poses).all(1))

    def joint(self, name: str) -> Floats:
        """Return one joint centre's path (F, 3) [m]."""
        return self.joint_centres[:, self._index("joint_names", name)]

    def segment(self, name: str) -> Floats:
        """Return one segment's rotation (F, 3, 3), world from segment."""
        return self.segment_rotation[:, self._index("segment_names", name)]

    def coordinate(self, name: str) -> Floats:
        """Return one coordinate's values (F,) [rad or m]."""
        return self.coordinates[:, self._index("coordinate_names", name)]

    def angle(self, name: str) -> Floats:
        """Return one anatomical angle's values (F,) [degrees]."""
        return self.angles_deg[:, self._index("angle_names", name)]

    def _index(self, kind: str, name: str) -> int:
        names = getattr(self, kind)
        if name not in names:
            raise MareyError(f"There is no {name!r} in {kind}. It has: {', '.join(names)}.")
        return int(names.index(name))

    def frames(self, chosen: slice | Sequence[int] | Integers | Mask) -> "BodyMotion":
        """Return the motion in some of its frames.

        Args:
            chosen: A slice, frame indices, or a mask (F,).

        Returns:
            The motion with these frames, in this order.
        """
        index = np.arange(len(self))[chosen]
        return replace(self, **{name: getattr(self, name)[index] for name, s in self._shapes().items() if s[0] == "F"})

    def gaps(self) -> list[tuple[int, int]]:
        """List the runs of frames without poses between the first and the last frame with poses.

        Returns:
            Pairs (first frame of the gap, first frame after it).
        """
        inside = np.flatnonzero(self.answered)
        if not len(inside):
            return []
        missing = ~self.answered[inside[0] : inside[-1] + 1]
        return [(int(inside[0]) + start, int(inside[0]) + end) for start, end in true_runs(missing)]

    def arrays(self) -> dict[str, np.ndarray]:
        """Return every known field as an array by its name, as in `motion.npz`."""
        return {name: array for name, array in fields_of(self).items() if getattr(self, name) is not None}

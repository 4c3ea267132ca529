"""Motion of a knee's bones over an activity: in the room and relative to the tibia, joint angles and proximity."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.errors import MareyError
from marey.knee.motion.joint_surface import JointSurface, joint_surface, whole_surface
from marey.knee.motion.proximity import LIMIT_MM, Proximity, RelativePoses, proximity
from marey.knee.space.structures import CARTILAGE_OF_BONE
from marey.knee.space.surface import TriangleSurface
from marey.markers.data.bone_motion import BoneMotion
from marey.markers.kinematics.joint_angles import JointKinematics, joint_kinematics, joint_of
from marey.markers.kinematics.transform_chain import (
    CAPTURE_GLOBAL,
    MR_ANATOMIC,
    MR_GLOBAL,
    NamedTransform,
    TransformChain,
)

BASE = "tibia"
"""The bone relative to which others are shown."""
JOINTS = (("tibiofemoral", "tibia", "femur"), ("patellofemoral", "patella", "femur"))
"""Name, the bone on whose cartilage the compartments are, and the bone that moves over it."""
_MM = 1e3
"""Millimetres per metre, the factor of unit conversion."""
_SEGMENT = {"femur": "thigh", "tibia": "shank"}
"""Bone to the name of its segment, without side."""


@dataclass(frozen=True, eq=False, kw_only=True)
class JointMotion:
    """The motion of a knee's bones over F frames; NaN where the activity has no pose."""

    time: Floats
    """(F,) [s]."""
    left: bool | None
    """Whether it is a left knee; None where it is not known."""
    poses: Mapping[str, NamedTransform]
    """Bone to capture global from MR global [mm], with covariance."""
    anatomical: Mapping[str, NamedTransform]
    """Bone to capture global from MR anatomic [mm]; empty for a motion that was read from a file."""

    def __post_init__(self) -> None:
        freeze_fields(self, "time")
        wrong = [bone for bone, pose in self.poses.items() if len(pose.rotation) != len(self.time)]
        if wrong:
            raise MareyError(f"The motion of {', '.join(wrong)} has another number of frames than the activity.")

    def __len__(self) -> int:
        return len(self.time)

    @property
    def bones(self) -> tuple[str, ...]:
        """Names of the bones that move."""
        return tuple(self.poses)

    def answered(self, bone: str) -> Mask:
        """Return the frames (F,) in which a bone has a pose."""
        pose = self.poses[bone]
        return np.asarray(np.isfinite(pose.rotation).all((1, 2)) & np.isfinite(pose.translation).all(1))

    def held(self, bone: str, base: str = BASE) -> NamedTransform:
        """Return the pose of a bone in every frame relative to another, which keeps its pose in the scanner [mm].

        Raises:
            MareyError: The motion of one of them was not measured.
        """
        missing = [name for name in (bone, base) if name not in self.poses]
        if missing:
            raise MareyError(f"The motion of the {', '.join(missing)} was not measured.")
        return self.poses[base].inverse() @ self.poses[bone]

    def relative(self, bone: str, base: str) -> RelativePoses:
        """Return the same as poses for the proximity of surfaces."""
        held = self.held(bone, base)
        return RelativePoses(rotation=held.rotation, translation_mm=held.translation, covariance=held.covariance)


@dataclass(frozen=True, eq=False, kw_only=True)
class KneeMotion:
    """All measurements of a knee over an activity with one correction of the skin's motion."""

    method: str
    """Name of the correction."""
    motion: JointMotion
    joints: tuple[Proximity, ...]
    """Proximity in each joint both of whose bones move."""
    angles: JointKinematics | None
    """None where femur or tibia does not move."""


def motion_of_chains(chains: Mapping[str, TransformChain], time: Floats, *, left: bool | None) -> JointMotion:
    """Return the motion of bones from their chains.

    Args:
        chains: Bone to its chain [mm].
        time: (F,) [s].
        left: Whether it is a left knee.
    """
    return JointMotion(
        time=time, left=left,
        poses={bone: chain.between(CAPTURE_GLOBAL, MR_GLOBAL) for bone, chain in chains.items()},
        anatomical={bone: chain.between(CAPTURE_GLOBAL, MR_ANATOMIC) for bone, chain in chains.items()},
    )  # fmt: skip


def knee_angles(motion: JointMotion) -> JointKinematics | None:
    """Return the knee's angles and translations by the bones' own anatomical frames ([Grood1983]).

    The translations are of the tibia's origin from the femur's. None where femur or tibia does not move.
    """
    if any(bone not in motion.anatomical for bone in _SEGMENT):
        return None
    side = {None: None, True: "left", False: "right"}[motion.left]
    prefix = "" if side is None else f"{side}_"
    names = tuple(prefix + segment for segment in _SEGMENT.values())
    poses = [motion.anatomical[bone] for bone in _SEGMENT]
    unknown = np.full((len(motion), 6, 6), np.nan)
    scale = np.diag([1.0] * 3 + [1 / _MM] * 3)
    bones = BoneMotion(
        segments=names, rotation=np.stack([pose.rotation for pose in poses], 1),
        origin=np.stack([pose.translation / _MM for pose in poses], 1),
        covariance=np.stack(
            [unknown if pose.covariance is None else scale @ pose.covariance @ scale for pose in poses], 1
        ),
    )  # fmt: skip
    return joint_kinematics(bones, [joint_of(names[0], names[1], side=side)])


def joint_sides(
    parts: Mapping[str, TriangleSurface], bones: Sequence[str], *, left: bool | None
) -> tuple[dict[str, JointSurface], tuple[str, ...]]:
    """Return the articular side of each bone's cartilage, or of the bone itself if it has none, and notes.

    Args:
        parts: Structures by name.
        bones: Names of the bones.
        left: Whether it is a left knee.
    """
    sides, notes = {}, []
    for bone in bones:
        cartilage = CARTILAGE_OF_BONE[bone]
        if cartilage in parts:
            sides[bone] = joint_surface(cartilage, parts[cartilage], parts[bone], left=left)
        else:
            sides[bone] = whole_surface(bone, parts[bone], left=left)
            notes.append(f"The {bone} has no cartilage here: distances are those to its bone.")
    return sides, tuple(notes)


def joint_proximities(
    motion: JointMotion, sides: Mapping[str, JointSurface], *, limit_mm: float = LIMIT_MM,
    done: Callable[[float], None] = lambda share: None,
) -> tuple[Proximity, ...]:  # fmt: skip
    """Measure the proximity in each joint both of whose bones move.

    Args:
        motion: Motion of the bones.
        sides: Bone to its articular side.
        limit_mm: Distance up to which surfaces count as near.
        done: Called with the share of the work that is done.
    """
    joints = [joint for joint in JOINTS if all(bone in sides and bone in motion.poses for bone in joint[1:])]
    total, count = max(len(joints) * len(motion), 1), 0

    def step() -> None:
        nonlocal count
        count += 1
        done(count / total)

    return tuple(
        proximity(name, sides[base], sides[bone], motion.relative(bone, base), limit_mm=limit_mm, step=step)
        for name, base, bone in joints
    )


def packed_joints(joints: Sequence[Proximity]) -> dict[str, np.ndarray]:
    """Return the measurements of joints as plain arrays, for a checkpoint."""
    arrays = {"names": np.array([joint.name for joint in joints], np.str_)}
    for joint in joints:
        arrays |= {f"{joint.name}.{key}": value for key, value in vars(joint).items() if isinstance(value, np.ndarray)}
        arrays[f"{joint.name}.limit_mm"] = np.array(joint.limit_mm)
        arrays[f"{joint.name}.compartments"] = np.array(joint.compartments, np.str_)
    return arrays


def unpacked_joints(
    arrays: Mapping[str, np.ndarray], sides: Mapping[str, JointSurface]
) -> tuple[Proximity, ...]:  # fmt: skip
    """Restore joints from such arrays, with the same surfaces."""
    bones = {name: pair for name, *pair in JOINTS}
    found = []
    for name in map(str, arrays["names"]):
        held: dict[str, Any] = {
            key.partition(".")[2]: value for key, value in arrays.items() if key.startswith(f"{name}.")
        }
        held["limit_mm"], held["compartments"] = float(held["limit_mm"]), tuple(map(str, held["compartments"]))
        base, moving = (sides[bone] for bone in bones[name])
        found.append(Proximity(name=name, base=base, moving=moving, **held))
    return tuple(found)

"""Presets: which segments and coordinates of a person a capture follows."""

from dataclasses import dataclass
from typing import Literal

_ARM = ("shoulder_sweep", "shoulder_lift", "shoulder_turn", "elbow_flexion", "pronation", "wrist_flexion",
        "wrist_deviation")  # fmt: skip
_LEG = ("hip_flexion", "hip_abduction", "hip_rotation", "knee_flexion", "knee_adduction", "knee_rotation",
        "ankle_dorsiflexion", "ankle_inversion", "toe_extension")  # fmt: skip
_ARM_SEGMENTS, _LEG_SEGMENTS = ("clavicle", "upperarm", "forearm", "hand"), ("thigh", "shank", "foot", "toes")
_TRUNK = ("pelvis", "abdomen", "thorax", "neck", "head")
_BOTH = ("left", "right")


def _of(side: str, names: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"{side}_{name}" for name in names)


@dataclass(frozen=True, kw_only=True)
class Preset:
    """What a capture follows of a person."""

    coordinates: tuple[str, ...] | None = None
    """Joint coordinates that are free besides the root's six; None for all."""
    segments: tuple[str, ...] | None = None
    """Segments whose skin the body has; None for all. What moves with the thorax helps to find it."""
    unseen: tuple[str, ...] = ()
    """Segments whose outline is not believed."""


PRESETS: dict[str, Preset] = {
    "full": Preset(),
    # The paper's: 6 + back 1 + 7 an arm.
    "upper": Preset(
        coordinates=("lumbar_flexion", *(name for side in _BOTH for name in _of(side, _ARM))),
        unseen=tuple(name for side in _BOTH for name in _of(side, _LEG_SEGMENTS)),
    ),
    **{
        f"{side}_arm": Preset(
            coordinates=_of(side, _ARM),
            segments=(*_TRUNK, *_of(side, _ARM_SEGMENTS)),
            unseen=("pelvis", "neck", "head"),
        )
        for side in _BOTH
    },
    **{
        f"{side}_leg": Preset(coordinates=_of(side, _LEG), segments=("pelvis", *_of(side, _LEG_SEGMENTS)))
        for side in _BOTH
    },
}

GENERIC_BODIES: dict[str, Literal["simple", "full"]] = {"metaballs": "full", "simple-metaballs": "simple"}
"""Bodies of generic size that a capture knows by a word instead of a file, and the detail of their metaballs."""

"""Presets: the segments and coordinates of a person that a capture follows."""

from dataclasses import dataclass
from typing import Literal

_ARM = ("shoulder_sweep", "shoulder_lift", "shoulder_turn", "elbow_flexion", "pronation", "wrist_flexion",
        "wrist_deviation")  # fmt: skip
"""Joint coordinates of an arm, without the clavicle's."""
_LEG = ("hip_flexion", "hip_abduction", "hip_rotation", "knee_flexion", "knee_adduction", "knee_rotation",
        "ankle_dorsiflexion", "ankle_inversion", "toe_extension")  # fmt: skip
"""Joint coordinates of a leg."""
_ARM_SEGMENTS, _LEG_SEGMENTS = ("clavicle", "upperarm", "forearm", "hand"), ("thigh", "shank", "foot", "toes")
"""Segments of an arm with its clavicle, and of a leg."""
_TRUNK = ("pelvis", "abdomen", "thorax", "neck", "head")
"""Segments of trunk and head."""
_BOTH = ("left", "right")
"""Prefixes of the two sides' names."""


def _of(side: str, names: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"{side}_{name}" for name in names)


@dataclass(frozen=True, kw_only=True)
class Preset:
    """The parts of a person that a capture follows."""

    coordinates: tuple[str, ...] | None = None
    """Joint coordinates that are free besides the root's six; None for all."""
    segments: tuple[str, ...] | None = None
    """Segments whose skin the body has; None for all. Segments that move with the thorax help to locate it."""
    without_outline: tuple[str, ...] = ()
    """Segments whose outline is not used."""

    @property
    def single_limb(self) -> bool:
        """Whether the body has one limb only, with its part of the trunk."""
        return self.segments is not None


PRESETS: dict[str, Preset] = {
    "full": Preset(),
    # The paper's 6 + 1 + 2 * 7 degrees of freedom: root, back, and arms.
    "upper": Preset(
        coordinates=("lumbar_flexion", *(name for side in _BOTH for name in _of(side, _ARM))),
        without_outline=tuple(name for side in _BOTH for name in _of(side, _LEG_SEGMENTS)),
    ),
    **{
        f"{side}_arm": Preset(
            coordinates=_of(side, _ARM),
            segments=(*_TRUNK, *_of(side, _ARM_SEGMENTS)),
            without_outline=("pelvis", "neck", "head"),
        )
        for side in _BOTH
    },
    **{
        f"{side}_leg": Preset(coordinates=_of(side, _LEG), segments=("pelvis", *_of(side, _LEG_SEGMENTS)))
        for side in _BOTH
    },
}
"""Presets by name, as in `trial.toml`. "upper" is the paper's: 6 coordinates of the root, 1 of the back and 7 per
arm."""

GENERIC_BODIES: dict[str, Literal["simple", "full"]] = {"metaballs": "full", "simple-metaballs": "simple"}
"""Bodies of generic size that can be given by a word instead of a file, with the detail of their metaballs."""


def follows_limb(preset: str | None) -> bool:
    """Return whether a preset follows a single limb; None is "full".

    Args:
        preset: One of `PRESETS`, or None.
    """
    return PRESETS[preset or "full"].single_limb

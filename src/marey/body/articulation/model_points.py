"""Segments of a person on the bodies of a user's model."""

from collections.abc import Mapping

from marey.body.articulation.jointed_body import JointedBody

SEGMENT_JOINTS = {
    "thigh": ("hip", "knee"), "shank": ("knee", "ankle"), "foot": ("ankle", "toe"),
    "upperarm": ("shoulder", "elbow"), "forearm": ("elbow", "wrist"), "hand": ("wrist", None),
}  # fmt: skip
"""Joint centres at the upper and the lower end of a segment, without its side."""


def segment_body(model: JointedBody, joints: Mapping[str, str], segment: str) -> str | None:
    """Return the body that is a limb's segment: the last one above its lower joint centre.

    A foot is the `calcn_l` above the toes rather than the `talus_l` below the ankle, a forearm the radius.

    Args:
        model: The model.
        joints: Maps a joint centre to the body that rotates about it.
        segment: Name of the segment, with its side.

    Returns:
        The body; None if the model has no joint centre at the upper end of the segment.
    """
    side, _, kind = segment.partition("_")
    upper, lower = SEGMENT_JOINTS.get(kind, (None, None))
    start, end = joints.get(f"{side}_{upper}"), joints.get(f"{side}_{lower}")
    above = None if end is None else model.bodies[model.body_names.index(end)].parent
    return start if above is None or start is None else above

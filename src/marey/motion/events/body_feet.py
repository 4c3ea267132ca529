"""Heels and toes of a captured body: points of its skin, carried by the segments of the foot."""

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.surface import Body
from marey.motion.events.feet import FootPath, WalkPaths
from marey.motion.motion import BodyMotion

_POINTS = 5
"""Number of vertices whose mean is a heel or a toe: a patch of some 2 cm, smoother than the outermost vertex alone."""
_BELOW_ANKLE = 0.2
"""The heel lies farther below the ankle than this ratio of the ankle's height above the sole."""


def paths_of_body(motion: BodyMotion, body: Body) -> WalkPaths | None:
    """Return the paths of heels and toes of a captured body, and that of its pelvis.

    The heel is the most posterior patch of the skin of the foot below the ankle, the toe the most anterior patch of
    that of the toes. Both are rigid points of their segments.

    Args:
        motion: The motion, Z up [m].
        body: The body at rest, with the same segments.

    Returns:
        The paths; None if the motion has no foot with toes.
    """
    feet = []
    for side in ("left", "right"):
        foot, toes = f"{side}_foot", f"{side}_toes"
        if {foot, toes} <= set(motion.segment_names) & set(body.skeleton.segment_names):
            heel, toe = _rest_points(body, foot, toes)
            feet.append(
                FootPath(side=side, heel=_carried(motion, body, foot, heel), toe=_carried(motion, body, toes, toe))
            )
    if not feet or "pelvis" not in motion.segment_names:
        return None
    start = float(motion.time[0]) if len(motion) else 0.0
    pelvis = motion.segment_origin[:, motion.segment_names.index("pelvis")]
    return WalkPaths(body=pelvis, feet=tuple(feet), rate=motion.rate, start_s=start)


def _rest_points(body: Body, foot: str, toes: str) -> tuple[Floats, Floats]:
    """Return heel and toe (3,) at rest [m]."""
    names = body.skeleton.segment_names
    ankle, ball = (body.joint_centres[names.index(name)] for name in (foot, toes))
    forward = (ball - ankle) * [1.0, 1.0, 0.0]
    carrier = body.vertex_segments[np.arange(len(body.vertices)), np.argmax(body.vertex_weights, axis=1)]
    of_foot, of_toes = (body.vertices[carrier == names.index(name)] for name in (foot, toes))
    sole = of_foot[:, 2].min()
    low = of_foot[of_foot[:, 2] < ankle[2] - _BELOW_ANKLE * (ankle[2] - sole)]
    heel = low[np.argsort(low @ forward)[:_POINTS]].mean(0)
    return heel, of_toes[np.argsort(of_toes @ forward)[-_POINTS:]].mean(0)


def _carried(motion: BodyMotion, body: Body, segment: str, point: Floats) -> Floats:
    """Return the path (F, 3) of a point that a segment carries [m]."""
    index = motion.segment_names.index(segment)
    local = point - body.joint_centres[body.skeleton.segment_names.index(segment)]
    return np.asarray(motion.segment_rotation[:, index] @ local + motion.segment_origin[:, index])

"""The repetitions of a captured body or of a marker trial."""

from collections import Counter
from pathlib import Path

import numpy as np

from marey.body.articulation.surface import Body
from marey.geometry.continuity import continuous_angles
from marey.io.results.repetitions import write_repetitions
from marey.markers.kinematics.joint_angles import JointKinematics
from marey.motion.events.body_feet import paths_of_body
from marey.motion.events.feet import WalkPaths
from marey.motion.events.repetitions import Repetitions, find_repetitions, with_largest_angles
from marey.motion.motion import BodyMotion
from marey.pipelines.gait.walk import Gait
from marey.wording import count_of

REPETITIONS_FILE = "repetitions.csv"
"""The table of the repetitions."""
_BOTH = 2
"""Number of feet that must be known: one foot in the air is no flight."""


def repetitions_of_body(motion: BodyMotion, body: Body, gait: Gait | None) -> Repetitions:
    """Return the repetitions of a captured body; none of a person who walks, or whose feet are not seen.

    Args:
        motion: The motion.
        body: The body at rest.
        gait: The gait; None if the motion is no walk.
    """
    paths = None if gait is not None and gait.cycles else paths_of_body(motion, body)
    if paths is None or len(paths.feet) < _BOTH:
        return Repetitions()
    return with_largest_angles(
        find_repetitions(paths),
        motion.angle_names,
        continuous_angles(motion.angles_deg, period=360.0, centred=True),
        motion.time,
    )


def repetitions_of_markers(paths: WalkPaths | None, joints: JointKinematics, gait: Gait) -> Repetitions:
    """Return the repetitions of a marker trial; none of a person who walks, or without markers of both feet.

    Args:
        paths: Paths of both feet and of the body; None if they are not known.
        joints: Joint angles in the same frames.
        gait: The gait.
    """
    if paths is None or gait.cycles or len(paths.feet) < _BOTH:
        return Repetitions()
    degrees = continuous_angles(np.degrees(joints.angles), period=360.0, centred=True)
    return with_largest_angles(find_repetitions(paths), joints.angle_names, degrees, paths.time)


def save_repetitions(folder: Path, repetitions: Repetitions) -> None:
    """Write the table of the repetitions, if there are any.

    Args:
        folder: The folder.
        repetitions: The repetitions.
    """
    if len(repetitions):
        write_repetitions(folder / REPETITIONS_FILE, repetitions)


def count_repetitions(repetitions: Repetitions) -> str:
    """Return the number of repetitions of each kind in words."""
    counts = Counter(each.kind for each in repetitions)
    return ", ".join(count_of(number, kind) for kind, number in counts.items())

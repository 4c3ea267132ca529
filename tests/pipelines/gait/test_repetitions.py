from dataclasses import replace

import numpy as np
import pytest
from tests import performer
from tests.motion.events.test_body_feet import walking_body
from tests.motion.events.test_repetitions import eased, paths_of, squats

from marey.io.results.repetitions import read_repetitions
from marey.markers.kinematics.joint_angles import JointKinematics
from marey.motion.motion import BodyMotion
from marey.pipelines.gait.repetitions import (
    REPETITIONS_FILE,
    count_repetitions,
    repetitions_of_body,
    repetitions_of_markers,
    save_repetitions,
)
from marey.pipelines.gait.walk import Gait, gait_of_body
from marey.view.gait.repetition_table import repetition_tables

FRAMES, RATE = 150, 30.0


def squatting_body() -> BodyMotion:
    """A body at rest whose pelvis and knees go down and up again twice."""
    person = performer.body()
    motion = performer.motion(person, FRAMES, gap=())
    time = np.arange(FRAMES) / RATE
    down = (0.95 - squats(time, (0.5, 2.8), 0.3)) / 0.3
    origin = np.repeat(person.joint_centres[None], FRAMES, 0)
    origin[:, motion.segment_names.index("pelvis"), 2] -= 0.3 * down
    angles = np.zeros((FRAMES, len(motion.angle_names)))
    angles[:, motion.angle_names.index("left_knee_flexion")] = 90 * down
    return replace(
        motion, time=time, segment_origin=origin, angles_deg=angles,
        segment_rotation=np.broadcast_to(np.eye(3), motion.segment_rotation.shape),
    )  # fmt: skip


def test_a_body_that_squats_has_a_table_of_its_repetitions(tmp_path):
    found = repetitions_of_body(squatting_body(), performer.body(), None)
    assert [each.kind for each in found] == ["squat", "squat"]
    assert [each.depth_m for each in found] == pytest.approx([0.285, 0.285], abs=0.01)
    knee = found.angle_names.index("left_knee_flexion")
    np.testing.assert_allclose(found.largest_deg[:, knee], 90, atol=1)
    assert count_repetitions(found) == "2 squats"
    (table,) = repetition_tables(found)
    assert all(len(row) == len(table.head) for row in table.rows)
    save_repetitions(tmp_path, found)
    assert len(read_repetitions(tmp_path / REPETITIONS_FILE)) == 2


def test_a_walk_has_no_repetitions_and_no_table(tmp_path):
    person, motion = performer.body(), walking_body()
    found = repetitions_of_body(motion, person, gait_of_body(motion, person))
    assert len(found) == 0
    save_repetitions(tmp_path, found)
    assert list(tmp_path.iterdir()) == []
    assert repetition_tables(found) == []


def test_markers_need_both_feet():
    time = np.arange(0, 8, 1 / 60)
    paths = paths_of(squats(time, (1.0, 4.5), 0.3))
    knee = np.radians(80) * (eased(time, 1.0, 1.8) - eased(time, 1.8, 2.6))
    joints = JointKinematics(
        angle_names=("left_knee_flexion",), angles=knee[:, None], angles_sd=np.ones((len(time), 1))
    )
    nothing = Gait(events=(), cycles=())
    found = repetitions_of_markers(paths, joints, nothing)
    assert len(found) == 2
    assert found.largest_deg[:, 0] == pytest.approx([80, 0], abs=0.5)
    assert len(repetitions_of_markers(replace(paths, feet=paths.feet[:1]), joints, nothing)) == 0
    assert len(repetitions_of_markers(None, joints, nothing)) == 0

from dataclasses import replace

import numpy as np
import pytest
from tests.takes import small_take

from marey.motion.motion import MEASURED
from marey.view.pages.problems import find_problems, frames_text, touches_border


def test_every_problem_of_a_motion_is_named_with_its_frames(rng):
    motion, _ = small_take(rng)
    cut = np.zeros((len(motion), 2), bool)
    cut[3:5, 0] = True
    problems = find_problems(motion, cut=cut, warnings=["cam01 is dark"])
    assert [p.severity for p in problems] == sorted(
        (p.severity for p in problems), key=("problem", "caution", "note").index
    )
    found = {p.where: p.what for p in problems}
    assert "lost" in found["frame 8"]
    assert "interpolated" in found["frame 5"]
    assert "No person" in found["frames 0 to 1"]
    assert "down to 0.50): frame 6" in found["cam02"]
    assert "frames 3 to 4" in found["cam01"]
    # The motion does not state which angles are determined, as in files of earlier versions.
    assert motion.coordinate_names[10].replace("_", " ") in found["1 coordinate"]
    assert found["run"] == "cam01 is dark"


def test_angles_that_are_not_determined_have_the_names_of_the_plots(rng):
    motion, _ = small_take(rng)
    flags = np.ones((len(motion), 3), bool)
    measured = motion.state == MEASURED
    flags[:, 1] = False
    flags[np.flatnonzero(measured)[:2], 2] = False
    problems = find_problems(replace(motion, angles_determined=flags))
    never, partly = (problem.what for problem in problems if problem.where == "1 angle")
    assert "in any frame: left knee flexion." in never
    assert f"right knee flexion ({200 / measured.sum():.0f} %)" in partly
    assert not any("coordinate" in problem.where for problem in problems)


def test_a_motion_without_problems_has_an_empty_list(rng):
    motion, _ = small_take(rng)
    fine = motion.frames([3, 4, 7])
    object.__setattr__(fine, "determined", np.ones_like(fine.determined))
    assert find_problems(fine) == []


def test_a_motion_without_any_measured_frame_is_bad(rng):
    motion, _ = small_take(rng)
    problems = find_problems(motion.frames([0, 1]))
    assert any(p.severity == "problem" and p.where == "whole recording" for p in problems)


def test_frames_are_listed_as_ranges():
    chosen = np.zeros(40, bool)
    chosen[[3, 4, 5, 9]] = True
    assert frames_text(chosen) == "frames 3 to 5, 9"
    chosen[::2] = True
    assert frames_text(chosen).endswith("more stretches")


@pytest.mark.parametrize("where", [(0, 3), (-1, 3), (3, 0), (3, -1)])
def test_a_silhouette_at_the_border_is_detected(where):
    mask = np.zeros((8, 9), bool)
    mask[3, 4] = True
    assert not touches_border(mask)
    mask[where] = True
    assert touches_border(mask)

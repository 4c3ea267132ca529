"""The verdict on recovered shapes."""

from dataclasses import replace

import numpy as np
import pytest
from tests.verdicts import agreed_verdict

from marey.geometry import rotations
from marey.nonrigid.many_cameras.view_checks import UNRELIABLE
from marey.pipelines.nonrigid.factorise import factorise
from marey.pipelines.nonrigid.shapes import Shapes, load_shapes
from marey.pipelines.nonrigid.verdict import shapes_verdict
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.verdict import Verdict

FRAMES, POINTS = 40, 9
ALL = np.ones(FRAMES, bool)


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    """Points (F, 3, P) of a cluster that rotates and deforms in one way."""
    rng, time = np.random.default_rng(3), np.arange(FRAMES)
    path = rotations.exp(np.stack([0.1 * np.sin(time / 15), np.ones(FRAMES), 0 * time], 1) * (0.08 * time)[:, None])
    mean, mode = 100 * rng.normal(size=(2, 3, POINTS))
    return path @ (mean + 0.3 * np.sin(time / 7)[:, None, None] * mode)


@pytest.fixture(scope="module")
def shapes(points) -> Shapes:
    return factorise(points, basis_shapes=2, progress=RecordingProgress())


def test_shapes_that_are_known_better_than_they_deform_are_good(shapes, tmp_path):
    assert shapes.verdict == Verdict()
    shapes.save(tmp_path)
    assert agreed_verdict(tmp_path / "run.json", page=tmp_path / "report.html") == load_shapes(tmp_path).verdict


def test_a_deformation_within_its_standard_deviation_is_a_limit(shapes):
    size = float(np.sqrt(np.nanmean((shapes.found.basis[0] ** 2).sum(0))))
    # A point's standard deviation is the root of the sum over three directions.
    for ratio, level in ((0.5, "usable with limits"), (1.1, "not usable")):
        blurred = replace(shapes.found, shape_sd=np.full(shapes.shape.shape, ratio * size / np.sqrt(3)))
        verdict = shapes_verdict(blurred, ALL)
        assert verdict.level == level
        assert "The standard deviation of a point is" in str(verdict)


def test_frames_without_a_result_are_counted(points):
    for empty, level in ((3, "usable with limits"), (25, "not usable")):
        few = points.copy()
        few[:empty, :, 2:] = np.nan
        verdict = factorise(few, basis_shapes=1, progress=RecordingProgress()).verdict
        assert verdict is not None
        assert verdict.level == level
        assert f"{empty} of {FRAMES} frames have too few points" in str(verdict)


def test_notes_of_the_factorisation_and_of_the_correspondence_are_limits(shapes):
    noted = replace(shapes.found, notes=("The sign of depth is undetermined.",))
    verdict = shapes_verdict(noted, ALL, ["3 of 9 pairs are ambiguous."])
    assert verdict.texts() == (
        "usable with limits", ["3 of 9 pairs are ambiguous.", "The sign of depth is undetermined."]
    )  # fmt: skip
    assert not shapes_verdict(replace(shapes.found, notes=(f"Cameras are late. {UNRELIABLE}",)), ALL).usable

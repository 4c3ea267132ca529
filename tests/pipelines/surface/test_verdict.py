"""The verdict on a measured surface, from its points, its cameras and its trajectories."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from tests import scenes

from marey.pipelines.surface.verdict import surface_verdict, suspicious
from marey.pipelines.verdict import Verdict, VerdictReason
from marey.surface.points.measured import MeasuredPoints
from marey.surface.points.refine_rig import RigRefinement

RIG = scenes.rig(-10, 0, 10)


def part(frame: int, residual_px: float, count: int = 5) -> MeasuredPoints:
    """Points of one frame with equal residuals."""
    return MeasuredPoints(
        frame=np.full(count, frame), points=np.zeros((count, 3)), covariance=np.tile(1e-8 * np.eye(3), (count, 1, 1)),
        camera_names=RIG.names, pixels=np.zeros((count, 3, 2)), correlation=np.ones((count, 3)),
        residual_px=np.full(count, residual_px), colour=np.zeros((count, 3), np.uint8),
    )  # fmt: skip


def corrected(before: float, after: float) -> RigRefinement:
    return RigRefinement(
        rig=RIG, rotation=np.zeros(3), shift=np.zeros(3), moved_px=np.array([0, 0, 0.4]), residual_before=before,
        residual_after=after, tuples=500,
    )  # fmt: skip


def verdict_of(*parts: MeasuredPoints, count: int | None = None, **more: object) -> Verdict:
    given = {"refined": None, "followed": None} | more
    return surface_verdict(RIG, parts, len(parts) if count is None else count, **given)  # type: ignore[arg-type]


def test_points_in_every_frame_with_small_residuals_are_good():
    assert verdict_of(part(0, 0.1), part(1, 0.3)) == Verdict()
    assert verdict_of(part(0, 0.1), refined=corrected(0.11, 0.1)) == Verdict()


@pytest.mark.parametrize(
    ("parts", "more", "what"),
    [
        ((part(0, 0.1), part(1, 0.1, 0), part(2, 0.1)), {}, "1 of 3 frames show no point"),
        ((part(0, 0.7),), {}, "miss each other by 0.70 px"),
        ((part(0, 0.1),), {"count": 4}, "Only the 1 frames before a damaged one were measured, of 4."),
        ((part(0, 0.1),), {"refined": corrected(0.5, 0.2)}, "corrected (right 0.40 px): the median residual fell"),
        ((part(0, 0.1),), {"followed": SimpleNamespace(trajectories=SimpleNamespace(kept=()))}, "No point could be"),
    ],
)
def test_what_limits_a_surface_is_named(parts, more, what):
    verdict = verdict_of(*parts, **more)
    assert verdict.level == "usable with limits"
    assert what in str(verdict)


@pytest.mark.parametrize(
    ("confirmed", "level"), [(3, "good"), (1, "usable with limits"), (0, "not usable")]
)  # fmt: skip
def test_points_that_no_third_camera_confirms_are_named(confirmed, level):
    seen = part(0, 0.1, 10)
    pixels, correlation = np.array(seen.pixels), np.array(seen.correlation)
    pixels[confirmed:, 2] = correlation[confirmed:, 2] = np.nan
    partly = replace(seen, pixels=pixels, correlation=correlation)
    assert verdict_of(partly, third=True).level == level
    # Two cameras alone confirm nothing, which is not their fault.
    assert verdict_of(partly).level == "good"


def test_a_surface_that_most_frames_do_not_show_is_not_usable():
    verdict = verdict_of(part(0, 0.1), part(1, 0.1, 0), part(2, 0.1, 0))
    assert verdict.level == "not usable"
    assert "2 of 3 frames show no point" in str(verdict)


def test_a_calibration_in_millimetres_is_named_by_far_points():
    far = replace(part(0, 0.1), points=np.full((5, 3), 700.0))
    verdict = verdict_of(far)
    assert verdict.reasons[0].cause == "unit"
    assert "the calibration is in millimetres" in str(verdict)


@pytest.mark.parametrize(
    ("parts", "third", "expected"),
    [
        ((part(0, 0.1),), True, False),
        ((part(0, 0.7),), False, True),
        ((part(0, 0.1), part(1, 0.1, 0), part(2, 0.1, 0)), False, True),
    ],
)
def test_large_residuals_and_empty_frames_are_suspicious(parts, third, expected):
    assert suspicious(parts, third=third) == expected


def test_a_cause_stands_for_the_contradictions_that_it_explains():
    exchanged = VerdictReason.failure("The pictures of left, right are exchanged.", cause="exchanged")
    unseen = part(0, 0.7, 10)
    pixels, correlation = np.array(unseen.pixels), np.array(unseen.correlation)
    pixels[:, 2] = correlation[:, 2] = np.nan
    contradicted, empty = replace(unseen, pixels=pixels, correlation=correlation), part(1, 0.1, 0)
    more = {"third": True, "refined": corrected(0.5, 0.2)}
    assert len(verdict_of(contradicted, empty, **more).reasons) == 4
    # Frames without a point remain: they are lacking in the result.
    first, second = verdict_of(contradicted, empty, causes=[exchanged], **more).reasons
    assert first == exchanged
    assert "1 of 2 frames show no point" in second.what

import json

import pytest

from marey.pipelines.run_details import page_head
from marey.pipelines.verdict import NotUsable, Verdict, VerdictReason, without_result

LIMITED = VerdictReason(
    level="usable with limits", what="The camera cam02 was moved.", remedy="Calibrate it.", cameras=("cam02",)
)
NOTE = VerdictReason(level="good", what="The clocks were estimated.")
UNUSABLE = VerdictReason(level="not usable", what="No frame could be measured.")


def test_nothing_found_is_good():
    verdict = Verdict.of([])
    assert verdict.level == "good"
    assert verdict.usable
    assert str(verdict) == "Verdict: good"


def test_the_gravest_finding_decides_and_comes_first():
    assert Verdict.of([NOTE]).level == "good"
    assert Verdict.of([NOTE, LIMITED]).level == "usable with limits"
    verdict = Verdict.of([NOTE, UNUSABLE, LIMITED])
    assert not verdict.usable
    assert [each.level for each in verdict.reasons] == ["not usable", "usable with limits", "good"]


def test_the_head_of_a_page_has_the_reasons_with_how_grave_each_is():
    head = page_head("capture", Verdict.of([NOTE, LIMITED, UNUSABLE]))
    assert head.reasons[:2] == ["No frame could be measured.", "The camera cam02 was moved. Calibrate it."]
    assert head.grades == ["problem", "caution", "note"]
    assert page_head("view", None).grades == ()


def test_a_verdict_is_read_again_from_the_record():
    verdict = Verdict.of([NOTE, LIMITED])
    record = json.loads(json.dumps({"verdict": verdict.as_record()}))
    assert Verdict.from_record(record) == verdict
    assert Verdict.from_record({}) is None


def test_the_cause_is_recorded_and_empty_in_records_without_one():
    verdict = Verdict.of([VerdictReason.failure("It is mirrored.", cameras=["cam02"], cause="mirrored")])
    record = {"verdict": verdict.as_record()}
    assert Verdict.from_record(record).reasons[0].cause == "mirrored"
    del record["verdict"]["reasons"][0]["cause"]
    assert Verdict.from_record(record).reasons[0].cause == ""


def test_the_error_states_the_verdict():
    problem = NotUsable(Verdict.of([LIMITED, UNUSABLE]))
    assert str(problem).splitlines() == [
        "Verdict: not usable", "- No frame could be measured.", "- The camera cam02 was moved. Calibrate it.",
    ]  # fmt: skip


@pytest.mark.parametrize(("missing", "level"), [(1, LIMITED.level), (5, LIMITED.level), (6, UNUSABLE.level)])
def test_frames_without_a_result_limit_the_use_up_to_half_of_them(missing, level):
    [reason] = without_result(missing, 10, "have no pose", "Fill the gaps.")
    assert reason.level == level
    assert str(reason) == f"{missing} of 10 frames have no pose. Fill the gaps."
    assert without_result(0, 10, "have no pose") == ()

import json

from marey.pipelines.verdict import NotUsable, Verdict, VerdictReason

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


def test_a_verdict_is_read_again_from_the_record():
    verdict = Verdict.of([NOTE, LIMITED])
    record = json.loads(json.dumps({"verdict": verdict.as_record()}))
    assert Verdict.from_record(record) == verdict
    assert Verdict.from_record({}) is None


def test_the_error_states_the_verdict():
    problem = NotUsable(Verdict.of([LIMITED, UNUSABLE]))
    assert str(problem).splitlines() == [
        "Verdict: not usable", "- No frame could be measured.", "- The camera cam02 was moved. Calibrate it.",
    ]  # fmt: skip

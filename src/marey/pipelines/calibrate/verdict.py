"""The verdict on calibrated cameras, from what was found in the session."""

from collections.abc import Iterable, Mapping

from marey.pipelines.verdict import Verdict, VerdictReason


def calibration_verdict(findings: Iterable[Mapping[str, str]]) -> Verdict:
    """Return the verdict that follows from findings: a problem makes the cameras unusable, a caution limits their use.

    Args:
        findings: Findings with `severity`, `text` and `advice`, as in calibration.json; notes limit nothing.
    """
    makers = {"problem": VerdictReason.failure, "caution": VerdictReason.limit}
    return Verdict.of(
        makers[each["severity"]](each["text"], each["advice"]) for each in findings if each["severity"] in makers
    )

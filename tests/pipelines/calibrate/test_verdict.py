"""The verdict on calibrated cameras."""

import pytest

from marey.pipelines.calibrate.verdict import calibration_verdict

NOTE, CAUTION, PROBLEM = (
    {"code": "x", "severity": severity, "text": f"A {severity}.", "advice": "Film again."}
    for severity in ("note", "caution", "problem")
)


@pytest.mark.parametrize(
    ("findings", "level", "texts"),
    [
        ([NOTE], "good", []),
        ([NOTE, CAUTION], "usable with limits", ["A caution. Film again."]),
        ([CAUTION, PROBLEM], "not usable", ["A problem. Film again.", "A caution. Film again."]),
    ],
)
def test_the_gravest_finding_decides(findings, level, texts):
    assert calibration_verdict(findings).texts() == (level, texts)

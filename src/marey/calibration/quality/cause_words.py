"""Findings for what explains that cameras contradict the others."""

from collections.abc import Iterator

import numpy as np

from marey.calibration.adjustment.state import CAMERA, LENS
from marey.calibration.quality.causes import Cause
from marey.calibration.quality.finding import Examined, Finding, camera_names
from marey.calibration.quality.reference_views import DELAY, READOUT, ZOOM

CONSEQUENCES = (
    "out-of-sync", "bad-picture", "cameras-disagree", "unsynchronised", "camera-out-of-step", "lens-model",
    "blurred-picture", "pair-disagrees", "camera-late", "image-cropped", "pixels-not-square",
)  # fmt: skip
"""Findings that are not stated beside the explanation of a contradiction, since they may follow from it."""


def explaining(session: Examined) -> Iterator[Finding]:
    """Name the cameras that contradict the others, and why."""
    for cause in session.causes:
        yield _explanation(session, cause)


def _explanation(session: Examined, cause: Cause) -> Finding:
    name = session.corners.cameras[cause.camera]
    since = "" if cause.picture is None else session.corners.pictures[cause.picture]
    change, at = cause.change, f" at {since}"
    code, _, text, advice = _moved_or_lens(cause, name, at)
    if cause.kind == "turned":
        code, text = "image-turned", f"{name}: its pictures are turned by 180 degrees from {since} on."
        advice = "Pictures on one side are left out. Lock the rotation of the camera, or turn these pictures back."
    elif cause.kind == "exchanged":
        assert cause.other is not None
        code = "cameras-exchanged"
        text = f"{camera_names(session, (cause.camera, cause.other))}: their pictures are exchanged from {since} on."
        advice = "Pictures on one side are left out. Give the files the names of their cameras again."
    elif cause.kind == "lost":
        count = abs(cause.lag)
        what = "skipped" if cause.lag < 0 else "repeated or inserted"
        code = "pictures-lost"
        text = (
            f"{name} {what} {count} picture{'s' if count != 1 else ''} before {since}: it is out of step from there on."
        )
        done = "This was allowed for." if change[READOUT] else "Pictures on one side are left out."
        advice = f"{done} Record with a constant frame rate, and check for dropped frames."
    elif cause.kind == "late":
        late = change[DELAY] + session.late.get(name, 0)
        code, text = (
            "camera-out-of-step",
            f"{name} is {late:+.2f} pictures{_seconds(session, late)} from the other cameras.",
        )
        advice = "Synchronise the recordings before the calibration (marey sync)."
    elif cause.kind == "drift":
        code = "clock-drift"
        text = (
            f"{name}: its clock drifts by {change[READOUT]:+.1f} pictures over the session against the other cameras."
        )
        own = [each for each in session.delays if each.camera == cause.camera]
        done = "This was allowed for. " if any(each.drift for each in own) else ""
        again = "" if done else ", and film again"
        advice = f"{done}Convert the videos to a constant frame rate, and synchronise them (marey sync){again}."
    elif cause.kind == "rolling":
        code = "rolling-shutter"
        milliseconds = 1e3 * abs(change[READOUT]) / session.rate if session.rate else float("nan")
        text = f"{name}: its shutter rolls: the last row of a picture is {milliseconds:.0f} ms later than the first."
        advice = "Hold the board still for each picture, or move it slowly."
    elif cause.kind == "irregular":
        code, text = "camera-irregular", f"{name}: the times of its pictures are irregular against the other cameras."
        advice = "Record with a constant frame rate, and film again."
    elif cause.kind == "unsteady":
        code, text = (
            "image-unsteady",
            f"{name}: its image is shifted from picture to picture against the other cameras.",
        )
        advice = "Switch off image stabilisation, or fasten the camera, and film again."
    severe = cause.kind in ("moved", "lens-changed", "turned", "exchanged")
    what = "its contradictions with the others" if session.further else "the contradictions"
    text = f"{text} This explains {100 * min(cause.share, 1.0):.0f} % of {what}."
    return Finding(code=code, severity="problem" if severe else "caution", text=text, advice=advice)


def _moved_or_lens(cause: Cause, name: str, at: str) -> tuple[str, str, str, str]:
    if cause.kind == "lens-changed":
        zoom = 100.0 * float(cause.change[ZOOM])
        return (
            "lens-changed", "problem",
            f"{name}: its lens changed{at}: the focal length by {zoom:+.2f} %.",
            "Pictures on one side are left out. Switch off autofocus and zoom, and film again with the focus of the "
            "later recordings.",
        )  # fmt: skip
    turn = np.degrees(np.linalg.norm(cause.change[LENS : LENS + 3]))
    shift = np.linalg.norm(cause.change[LENS + 3 : CAMERA])
    return (
        "camera-moved", "problem", f"{name} moved{at}, by about {turn:.1f} deg and {1e3 * shift:.0f} mm.",
        "Pictures on one side are left out. Fasten the camera, and film again if it moved before the recordings.",
    )  # fmt: skip


def _seconds(session: Examined, pictures: float) -> str:
    return f" ({1e3 * abs(pictures) / session.rate:.0f} ms)" if session.rate else ""

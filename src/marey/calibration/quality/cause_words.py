"""Findings for what explains that cameras contradict the others."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from marey.calibration.adjustment.state import CAMERA, LENS
from marey.calibration.quality.causes import Cause
from marey.calibration.quality.finding import Examined, Finding, Severity, camera_names
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


@dataclass(frozen=True)
class _Words:
    """An explanation in words."""

    code: str
    text: str
    advice: str
    severe: bool = False
    """Whether it is a problem and not only a caution."""


@dataclass(frozen=True)
class _Explained:
    """A cause in the session in which it was found."""

    session: Examined
    cause: Cause

    @property
    def name(self) -> str:
        """The camera."""
        return self.session.corners.cameras[self.cause.camera]

    @property
    def since(self) -> str:
        """The first picture after the change; empty without a change."""
        return "" if self.cause.picture is None else self.session.corners.pictures[self.cause.picture]


def _explanation(session: Examined, cause: Cause) -> Finding:
    words = _WORDS[cause.kind](_Explained(session, cause))
    what = "its contradictions with the others" if session.further else "the contradictions"
    text = f"{words.text} This explains {100 * min(cause.share, 1.0):.0f} % of {what}."
    severity: Severity = "problem" if words.severe else "caution"
    return Finding(code=words.code, severity=severity, text=text, advice=words.advice)


def _moved(found: _Explained) -> _Words:
    change = found.cause.change
    turn = np.degrees(np.linalg.norm(change[LENS : LENS + 3]))
    shift = np.linalg.norm(change[LENS + 3 : CAMERA])
    return _Words(
        "camera-moved", f"{found.name} moved at {found.since}, by about {turn:.1f} deg and {1e3 * shift:.0f} mm.",
        "Pictures on one side are left out. Fasten the camera, and film again if it moved before the recordings.",
        severe=True,
    )  # fmt: skip


def _lens_changed(found: _Explained) -> _Words:
    zoom = 100.0 * float(found.cause.change[ZOOM])
    return _Words(
        "lens-changed", f"{found.name}: its lens changed at {found.since}: the focal length by {zoom:+.2f} %.",
        "Pictures on one side are left out. Switch off autofocus and zoom, and film again with the focus of the later "
        "recordings.",
        severe=True,
    )  # fmt: skip


def _turned(found: _Explained) -> _Words:
    return _Words(
        "image-turned", f"{found.name}: its pictures are turned by 180 degrees from {found.since} on.",
        "Pictures on one side are left out. Lock the rotation of the camera, or turn these pictures back.",
        severe=True,
    )  # fmt: skip


def _exchanged(found: _Explained) -> _Words:
    assert found.cause.other is not None
    both = camera_names(found.session, (found.cause.camera, found.cause.other))
    return _Words(
        "cameras-exchanged", f"{both}: their pictures are exchanged from {found.since} on.",
        "Pictures on one side are left out. Give the files the names of their cameras again.", severe=True,
    )  # fmt: skip


def _lost(found: _Explained) -> _Words:
    count = abs(found.cause.lag)
    what = "skipped" if found.cause.lag < 0 else "repeated or inserted"
    pictures = f"{count} picture{'s' if count != 1 else ''}"
    done = "This was allowed for." if found.cause.change[READOUT] else "Pictures on one side are left out."
    return _Words(
        "pictures-lost",
        f"{found.name} {what} {pictures} before {found.since}: it is out of step from there on.",
        f"{done} Record with a constant frame rate, and check for dropped frames.",
    )


def _late(found: _Explained) -> _Words:
    late = found.cause.change[DELAY] + found.session.late.get(found.name, 0)
    return _Words(
        "camera-out-of-step",
        f"{found.name} is {late:+.2f} pictures{_seconds(found.session, late)} from the other cameras.",
        "Synchronise the recordings before the calibration (marey sync).",
    )


def _drifting(found: _Explained) -> _Words:
    drift = found.cause.change[READOUT]
    own = [each for each in found.session.delays if each.camera == found.cause.camera]
    done = "This was allowed for. " if any(each.drift for each in own) else ""
    again = "" if done else ", and film again"
    return _Words(
        "clock-drift",
        f"{found.name}: its clock drifts by {drift:+.1f} pictures over the session against the other cameras.",
        f"{done}Convert the videos to a constant frame rate, and synchronise them (marey sync){again}.",
    )


def _rolling(found: _Explained) -> _Words:
    rate = found.session.rate
    milliseconds = 1e3 * abs(found.cause.change[READOUT]) / rate if rate else float("nan")
    return _Words(
        "rolling-shutter",
        f"{found.name}: its shutter rolls: the last row of a picture is {milliseconds:.0f} ms later than the first.",
        "Hold the board still for each picture, or move it slowly.",
    )


def _irregular(found: _Explained) -> _Words:
    return _Words(
        "camera-irregular", f"{found.name}: the times of its pictures are irregular against the other cameras.",
        "Record with a constant frame rate, and film again.",
    )  # fmt: skip


def _unsteady(found: _Explained) -> _Words:
    return _Words(
        "image-unsteady", f"{found.name}: its image is shifted from picture to picture against the other cameras.",
        "Switch off image stabilisation, or fasten the camera, and film again.",
    )  # fmt: skip


_WORDS: Mapping[str, Callable[[_Explained], _Words]] = {
    "moved": _moved, "lens-changed": _lens_changed, "turned": _turned, "exchanged": _exchanged, "lost": _lost,
    "late": _late, "drift": _drifting, "rolling": _rolling, "irregular": _irregular, "unsteady": _unsteady,
}  # fmt: skip
"""Words for each kind of cause."""


def _seconds(session: Examined, pictures: float) -> str:
    return f" ({1e3 * abs(pictures) / session.rate:.0f} ms)" if session.rate else ""

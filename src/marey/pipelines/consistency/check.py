"""Check of a take's cameras against each other, from their silhouettes alone, before anything is captured."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from marey.cameras.camera import Camera
from marey.cameras.shutter import RollingShutter
from marey.fit.clocks.estimate import ClockEstimate
from marey.fit.consistency.breaks import Break, find_break
from marey.fit.consistency.cut_outlines import cut_cameras
from marey.fit.consistency.explanations import (
    CONTRADICTION_PX,
    Contradictions,
    Explanation,
    common_lens,
    contradictions,
)
from marey.fit.consistency.tangents import Outline, differences_px
from marey.pipelines.clocks.disagreement import ClocksDisagree, MaskOfCamera, estimated_clocks, of_frame_zero
from marey.pipelines.consistency.empty_room import foreign_foreground, wrong_empty_rooms
from marey.pipelines.consistency.repairs import CamerasContradict, Repairs, half_turned
from marey.pipelines.verdict import Level, NotUsable, Verdict, VerdictReason
from marey.wording import listed

SAMPLED_FRAMES = 40
"""Number of frames whose silhouettes are compared. Chosen by hand."""
LEAST_CHECKED_FRAMES = 4
"""Takes with fewer frames are not checked. Chosen by hand."""
LONGEST_DELAY = 30
"""Largest delay that is tried without an estimate of the clocks [frames]. Chosen by hand."""
LEAST_CAMERAS_LEFT = 2
"""Least number of cameras that are left if those that contradict them are not used. Chosen by hand."""
SEVERE_PX = 6.0
"""Mean difference of the tangents of all pairs of cameras from which on unexplained contradictions make a result
unusable [px]. It is 0.2 to 1.8 px for sound takes, and 3.1 px for one with things in the silhouettes. Chosen by
hand."""
NEAR_FRAMES = 1.5
"""Difference of a delay and the estimated clock up to which both are the same [frames]. Chosen by hand."""


@dataclass(frozen=True, eq=False)
class _Sampled:
    """The outlines of some frames of a take."""

    cameras: Sequence[Camera]
    frames: Sequence[int]
    known: range
    mask_of: MaskOfCamera
    _done: dict[tuple[int, int], Outline] = field(default_factory=dict)

    def __call__(self, camera: int, shift: int = 0) -> list[Outline]:
        """Return the outlines of the frames, or of pictures that are some numbers later, in one camera."""
        return [self._outline(camera, frame + shift) for frame in self.frames]

    def _outline(self, camera: int, frame: int) -> Outline:
        if frame not in self.known:
            return Outline(np.zeros((0, 2)), np.zeros(0, bool))
        if (camera, frame) not in self._done:
            self._done[camera, frame] = Outline.of(self.mask_of(frame, camera), self.cameras[camera])
        return self._done[camera, frame]


def check_cameras(
    cameras: Sequence[Camera], full: Sequence[Camera], frames: Sequence[int], known: range, mask_of: MaskOfCamera, *,
    rate: float, clocks: bool, shutter: RollingShutter | None = None,
) -> list[VerdictReason]:  # fmt: skip
    """Check that all cameras show the same person at the same instants, and name what would explain it if they do not.

    Args:
        cameras: C cameras of the silhouettes.
        full: The same cameras of the full images.
        frames: Frames that show a person.
        known: All frames with silhouettes.
        mask_of: Returns the silhouette of a frame in a camera.
        rate: Frame rate [Hz].
        clocks: Whether the cameras may have clocks of their own.
        shutter: The cameras' rolling shutters; None without any.

    Returns:
        What contradicts, but cannot be explained or repaired.

    Raises:
        CamerasContradict: The cameras contradict each other, and a repair makes them agree.
        NotUsable: They do, and a known cause cannot be repaired.
    """
    if len(frames) < LEAST_CHECKED_FRAMES:
        return []
    foreign = foreign_foreground(cameras, frames, mask_of)
    if foreign.numbers and len(cameras) - len(foreign.numbers) >= LEAST_CAMERAS_LEFT:
        raise _without(wrong_empty_rooms(cameras, foreign), [camera.name for camera in cameras])
    index = np.unique(np.linspace(0, len(frames) - 1, min(SAMPLED_FRAMES, len(frames))).astype(int))
    sampled = _Sampled(cameras, [frames[i] for i in index], known, mask_of)
    longest = min(LONGEST_DELAY, len(frames) // 2)
    if (broken := find_break(cameras, sampled.frames, sampled, longest_delay=longest)) is not None:
        reason = _of_break(broken, cameras[broken.number].name, sampled.frames)
        raise _without(reason, [camera.name for camera in cameras])
    first = contradictions(cameras, sampled, explain=False)
    if not first.exist:
        enlarged = common_lens(cameras, sampled)
        if enlarged is not None and enlarged.within_errors:
            return [_perhaps(enlarged, [camera.name for camera in cameras])]
        return [] if enlarged is None else _decided(enlarged, cameras, full, None, 0.0, rate, clocks)
    if not first.equal and (cut := cut_cameras(differences_px(cameras, [sampled(c) for c in range(len(cameras))]))):
        return [_something_in_front([cameras[c].name for c in cut])]
    estimate = estimated_clocks(cameras, range(min(frames), max(frames) + 1), mask_of, rate=rate, shutter=shutter)
    shifts = None if estimate is None else _shifts(estimate, [camera.name for camera in cameras], rate)
    found = contradictions(cameras, sampled, longest_delay=longest, shifts=shifts)
    if foreign.numbers and not (found.equal or (found.best and found.best.level_px <= CONTRADICTION_PX)):
        return _limits_only(wrong_empty_rooms(cameras, foreign))
    return _decided(found, cameras, full, estimate if clocks else None, min(frames) / rate, rate, clocks)


def _perhaps(found: Contradictions, names: Sequence[str]) -> VerdictReason:
    """Return the limit of a result whose only two cameras agree better with another focal length."""
    best = found.explanations[0]
    what = (
        f"With {best.amount:.2f} times the calibrated focal length, the silhouettes of {listed(names)} would "
        f"agree within {best.level_px:.1f} px instead of {found.level_px:.1f} px. Errors of the silhouettes may be the "
        "reason as well: two cameras cannot decide."
    )
    remedy = "Compare a known length with the result, for example the stature. If it is wrong, calibrate again."
    return VerdictReason(
        level="usable with limits", what=what, cameras=_named(best, names), remedy=remedy, cause=best.kind
    )


def _shifts(estimate: ClockEstimate, names: Sequence[str], rate: float) -> list[int]:
    """Return by how many pictures each camera is late, as far as it is known."""
    known = dict(zip(estimate.clocks.names, estimate.clocks.offset_s, strict=True))
    return [round(-known.get(name, 0.0) * rate) for name in names]


def _decided(
    found: Contradictions, cameras: Sequence[Camera], full: Sequence[Camera], estimate: ClockEstimate | None,
    begin_s: float, rate: float, clocks: bool,
) -> list[VerdictReason]:  # fmt: skip
    """Return what limits the use of the result only; raise the repair, or that there is none, otherwise."""
    names, best = [camera.name for camera in cameras], found.best
    if best is None or (best.kind in _IN_PLACE and best.level_px > CONTRADICTION_PX):
        return _limits_only(_unexplained(found, names))
    concerned = sorted({*best.numbers, *(c for each in found.rivals for c in each.numbers)})
    what, remedy = _sentence(found, best, names), _REMEDIES[best.kind]
    own = tuple(names[c] for c in concerned)
    reason = VerdictReason(level="not usable", what=what, remedy=remedy, cameras=own, cause=best.kind)
    if found.rivals:
        others = listed([_cause(each, names) for each in found.rivals[:3]])
        reason = replace(reason, what=f"{what} About as well explained by: {others}.")
    elif best.kind in _IN_PLACE:
        done = replace(reason, level="usable with limits", remedy=f"This was repaired. {remedy}")
        raise CamerasContradict(Repairs(cameras=_repaired(best, full), reasons=(done,)))
    elif best.kind == "late" and not clocks:
        raise NotUsable(Verdict.of([replace(reason, remedy=f"{_ESTIMATED} {_OVERRIDE}")]))
    elif best.kind == "late" and estimate is not None and _confirms(estimate, best, names, rate):
        raise ClocksDisagree(of_frame_zero(estimate.clocks, begin_s), rate)
    moved = best.numbers[0] if best.kind == "moved" else None
    raise _without(reason, names, moved=moved, least=LEAST_CAMERAS_LEFT + (1 if found.rivals else 0))


def _of_break(found: Break, name: str, frames: Sequence[int]) -> VerdictReason:
    """Return the reason of a camera that agrees with the others in one part of the take only."""
    before, first = frames[found.first - 1], frames[found.first]
    agree, part = (f"up to about frame {before}", f"from about frame {first} on") if found.after else (
        f"from about frame {first} on", f"up to about frame {before}")  # fmt: skip
    if found.delay:
        way, what = ("later", "repeated") if found.delay > 0 else ("earlier", "missing")
        how = f"show everything {abs(found.delay)} frames {way}: pictures are {what}, or two recordings were joined"
    else:
        how = (
            f"contradict them by {found.level_px:.1f} px or more (median of the planes that touch two silhouettes), "
            "which no delay explains: another recording was joined, or the camera was moved during the take"
        )
    what = f"The pictures of {name} agree with those of the other cameras {agree} only; {part} they {how}."
    remedy = f"To use {name}, capture the frames in which it agrees on their own (--frames)."
    return VerdictReason(level="not usable", what=what, remedy=remedy, cameras=(name,), cause="break")


def _something_in_front(names: Sequence[str]) -> VerdictReason:
    what = (
        f"The silhouettes of {listed(names)} end inside of what the other cameras show, at one end only: something in "
        "front hides a part of the person there."
    )
    remedy = "If nothing stands in front of the person, check calibration and images of the empty room."
    return VerdictReason(level="good", what=what, cameras=tuple(names), remedy=remedy, cause="hidden")


def _limits_only(reason: VerdictReason) -> list[VerdictReason]:
    """Return a reason that does not make the result unusable; raise it otherwise."""
    if reason.level == "not usable":
        raise NotUsable(Verdict.of([reason]))
    return [reason]


def _without(
    reason: VerdictReason, names: Sequence[str], *, moved: int | None = None, least: int = LEAST_CAMERAS_LEFT
) -> CamerasContradict | NotUsable:
    """Return the repair that leaves out the cameras of a reason; if too few were left, that there is none."""
    rest = [name for name in names if name not in reason.cameras]
    if len(rest) < least:
        return NotUsable(Verdict.of([replace(reason, remedy=f"{reason.remedy} {_OVERRIDE}")]))
    limited = replace(reason, level="usable with limits", what=f"{reason.what} Only {listed(rest)} are used.")
    return CamerasContradict(Repairs(left_out=reason.cameras, reasons=(limited,)), moved=moved)


def _named(explanation: Explanation, names: Sequence[str]) -> tuple[str, ...]:
    return tuple(names[c] for c in explanation.numbers)


def _confirms(estimate: ClockEstimate, best: Explanation, names: Sequence[str], rate: float) -> bool:
    """Return whether the estimated clocks are complete and agree with the delays that explain the pictures best."""
    if estimate.undetermined:
        return False
    offsets = -np.asarray(estimate.clocks.offset_s) * rate
    if len(best.numbers) > 1:
        return True
    c = best.numbers[0]
    others = np.delete(offsets, c)
    return bool(abs(offsets[c] - np.median(others) - best.amount) <= NEAR_FRAMES)


def _repaired(best: Explanation, full: Sequence[Camera]) -> Mapping[str, Camera]:
    """Return the cameras of the full images that belong to the pictures, by name."""
    if best.kind == "exchanged":
        return {full[c].name: replace(full[best.order[c]], name=full[c].name) for c in best.numbers}
    return {full[c].name: half_turned(full[c]) for c in best.numbers}


def _unexplained(found: Contradictions, names: Sequence[str]) -> VerdictReason:
    (i, j), value = max(found.pairs_px.items(), key=lambda item: item[1])
    what = (
        f"The silhouettes of {names[i]} and {names[j]} contradict each other by {value:.1f} px (median of the planes "
        f"that touch both), those of all pairs of cameras by {found.level_px:.1f} px on average; no change of "
        "one camera explains it."
    )
    remedy = f"Check the calibration and the images of the empty room of these cameras. {_OVERRIDE}"
    level: Level = "usable with limits" if found.level_px < SEVERE_PX else "not usable"
    return VerdictReason(level=level, what=what, remedy=remedy, cameras=(names[i], names[j]), cause="unexplained")


def _sentence(found: Contradictions, best: Explanation, names: Sequence[str]) -> str:
    cause = _cause(best, names)
    cause = cause[0].upper() + cause[1:] if not cause.startswith(tuple(names)) else cause
    if best.kind == "equal":
        return f"{cause}."
    return (
        f"{cause}: the silhouettes of all cameras then agree within {best.level_px:.1f} px instead of "
        f"{found.level_px:.1f} px (median of the planes that touch two silhouettes)."
    )


def _cause(best: Explanation, names: Sequence[str]) -> str:
    """Return an explanation as a clause."""
    own = listed(_named(best, names))
    texts = {
        "mirrored": f"the pictures of {own} are mirrored",
        "upside down": f"the pictures of {own} are flipped from top to bottom",
        "turned": f"the pictures of {own} are turned by 180 degrees",
        "equal": f"the calibration of {own} is that of another camera" if len(best.numbers) == 1
        else f"the calibrations of {own} are equal",
        "moved": f"{own} looks in another direction than when it was calibrated, by {np.degrees(best.amount):.1f} "
        "degrees: it was moved, or its calibration belongs to another recording",
        "focal length": f"the focal length of {own} is {best.amount:.2f} of the calibrated one"
        + ("" if len(best.numbers) == 1 else ": all pictures were enlarged, cropped, or filmed at another zoom"),
        "late": f"the pictures of {own} show everything {abs(best.amount):.0f} frames "
        f"{'later' if best.amount > 0 else 'earlier'} than those of the other cameras",
    }  # fmt: skip
    if best.kind == "exchanged":
        pairs = [f"the pictures called {names[c]} are those of {names[best.order[c]]}" for c in best.numbers]
        return f"the cameras {own} are exchanged ({'; '.join(pairs)})"
    return texts[best.kind]


_IN_PLACE = ("exchanged", "turned")
"""Kinds of explanations that other calibrations repair exactly."""
_OVERRIDE = "--check off captures nevertheless."
"""How the check is avoided."""
_ESTIMATED = "Without --sync off and without sync.json or timestamps, the clocks are estimated from the silhouettes."
"""Remedy where the clocks that the user has stated contradict the silhouettes."""
_REMEDIES = {
    "exchanged": "Rename the videos or the cameras in the calibration.",
    "turned": "Turn the video, or calibrate the camera with pictures as they are.",
    "mirrored": "Flip the video back, for example by `ffmpeg -i IN -vf hflip OUT`.",
    "upside down": "Flip the video back, for example by `ffmpeg -i IN -vf vflip OUT`.",
    "equal": "Correct the calibration file.",
    "moved": "Calibrate the camera again.",
    "focal length": "Calibrate the camera again at the zoom of this recording.",
    "late": "Run `marey sync` on a take in which somebody moves more, or start the cameras together.",
}
"""What the user can do about each kind of explanation."""

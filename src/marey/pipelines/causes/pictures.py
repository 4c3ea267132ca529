"""Causes of pictures whose matches contradict the calibration, each tested by trying its repair."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations
from typing import NamedTuple

import numpy as np

from marey.arrays import Floats, Image, Mask
from marey.cameras.camera import Camera
from marey.cameras.epipolar import epipolar_lines
from marey.cameras.rig import Rig
from marey.images.matching.keypoints import Keypoints, keypoints, matched_keypoints
from marey.pipelines.verdict import VerdictReason
from marey.wording import count_of, listed

_NEAR_SIDE, _NEAR_PX = 0.002, 1.0
"""A match agrees with the calibration if its distance from the epipolar line is below this share of the larger side
of the image, or below this distance [px]: 85 % of the matches of sound cameras of `face1` are. Chosen by hand."""
_SUSPECTS = 6
"""Number of cameras, those with the fewest agreeing matches, in which repairs are tried. Chosen for the time."""
_FEW_CAMERAS = 4
"""Number of cameras up to which all orders are tried, and not only exchanges of two. Chosen for the time."""
_LEAST_MATCHES = 25
"""Least number of agreeing matches from which anything is concluded. Chosen by hand."""
_LEAST_GAIN = 1.5
"""With a repair, the agreeing matches of the cameras that it changes are at least this many times those without. On
`face1`, planted exchanges, mirrored, turned and resized pictures give 4.3 and more, and one camera's picture of instant
1, at which the face was elsewhere, 1.8 to 4.4; no repair of sound pictures gives more than 1.03. Held out, on
`cylinder`: 2.8 and more, and 0.98 at most."""
_LEAST_SHARE = 0.4
"""And at least this share of all their matches; fewer agreeing ones make a contradiction likely. Sound cameras of
`face1` have 0.82 to 0.93, and wrong repairs 0.23 at most; held out, `cylinder` has 0.97, and 0.33 at most. It was
lowered from 0.5 for `figure20`, whose cameras are 18 degrees apart and have 0.64 together; some of them have too few
matches for anything to be named."""
_CLEARLY = 1.1
"""Ratio of the explained matches above which one repair is better than another: of the pictures of an object that
hardly moves, the nearest is named; and all cameras mirrored may explain as much as exchanged ones. Chosen by hand."""
_SIZES = (0.5, 2 / 3, 1.5, 2.0)
"""Ratios of the size of the pictures to that for which the cameras were calibrated: usual ones. Chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Arrangement:
    """Cameras with pictures."""

    cameras: tuple[Camera, ...]
    pictures: tuple[Keypoints, ...]
    changed: frozenset[int] = frozenset()
    """Indices of the cameras that the repair changes."""
    what: str = ""
    """The cause, as the start of a sentence."""
    remedy: str = ""
    kind: str = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class PicturesOfInstant:
    """The pictures of one instant, and those of others."""

    rig: Rig
    images: Sequence[Image]
    """One per camera."""
    pairs: Sequence[tuple[int, int]]
    """Cameras that see the same places, as pairs of indices."""
    masks: Sequence[Mask] | None = None
    """(H, W) true where the surface may be visible; everywhere if None."""
    others: Mapping[int, Callable[[], Sequence[Image]]] = field(default_factory=dict)
    """The pictures of other instants, by the number of frames that they are later."""

    @property
    def places(self) -> Sequence[Mask | None]:
        """Where keypoints may lie, one mask per camera."""
        return [None] * len(self.images) if self.masks is None else self.masks


def _agreeing(both: tuple[Camera, Camera], matches: tuple[Floats, Floats]) -> int:
    """Count the matches that are near their epipolar lines."""
    here, there = matches
    if not len(here):
        return 0
    points, along = epipolar_lines(*both, here, there)
    away = there - points
    limit = max(_NEAR_PX, _NEAR_SIDE * max(both[1].size))
    return int(np.sum(np.abs(away[:, 0] * along[:, 1] - away[:, 1] * along[:, 0]) < limit))


class _Matches:
    """Counts of agreeing matches; pictures are matched once."""

    def __init__(self, pairs: Sequence[tuple[int, int]]):
        self._pairs = pairs
        self._matches: dict[tuple[int, int], tuple[Floats, Floats]] = {}
        self._kept: list[Keypoints] = []

    def counts(self, tried: _Arrangement, changed: frozenset[int]) -> tuple[int, int]:
        """Return the agreeing and all matches of the pairs with a changed camera."""
        agreeing = total = 0
        for i, j in self._pairs:
            if changed & {i, j}:
                matches = self._matched(tried.pictures[i], tried.pictures[j])
                agreeing += _agreeing((tried.cameras[i], tried.cameras[j]), matches)
                total += len(matches[0])
        return agreeing, total

    def _matched(self, first: Keypoints, second: Keypoints) -> tuple[Floats, Floats]:
        key = id(first), id(second)
        if key not in self._matches:
            self._kept += [first, second]
            self._matches[key] = matched_keypoints(first, second)
        return self._matches[key]


def picture_reasons(shown: PicturesOfInstant, *, suspicious: bool) -> tuple[VerdictReason, ...]:
    """Explain why the pictures of an instant contradict the calibration.

    Args:
        shown: The pictures, of one instant and of others.
        suspicious: Whether something else makes a contradiction likely; otherwise repairs are only tried if few matches
            of the pictures agree with the calibration.

    Returns:
        The cause whose repair explains the most matches; empty if they agree, or if nothing explains them.
    """
    pictures = tuple(keypoints(*each) for each in zip(shown.images, shown.places, strict=True))
    own = _Arrangement(cameras=shown.rig.cameras, pictures=pictures)
    every = frozenset(range(len(shown.rig)))
    matches = _Matches(shown.pairs)
    agreeing, total = matches.counts(own, every)
    if not suspicious and agreeing >= max(_LEAST_MATCHES, _LEAST_SHARE * total):
        return ()
    suspects = sorted(every, key=lambda i: matches.counts(own, frozenset([i]))[0])[:_SUSPECTS]
    found: dict[str, _Explained] = {}
    for tried in _repairs(shown, own, sorted(suspects)):
        each = _Explained(tried, matches.counts(own, tried.changed), matches.counts(tried, tried.changed))
        if each.convincing and (tried.kind not in found or each.gain > _CLEARLY * found[tried.kind].gain):
            found[tried.kind] = each
    most = max((each.gain for each in found.values()), default=0)
    causes = sorted((each for each in found.values() if _CLEARLY * each.gain > most), key=lambda each: -each.gain)
    return (_reason(causes, shown.rig.names),) if causes else ()


class _Explained(NamedTuple):
    """A repair with the agreeing and all matches of the cameras that it changes, without and with it."""

    tried: _Arrangement
    before: tuple[int, int]
    after: tuple[int, int]

    @property
    def gain(self) -> int:
        return self.after[0] - self.before[0]

    @property
    def convincing(self) -> bool:
        return self.after[0] >= max(_LEAST_MATCHES, _LEAST_GAIN * self.before[0], _LEAST_SHARE * self.after[1])


def _reason(causes: Sequence[_Explained], names: Sequence[str]) -> VerdictReason:
    """Name the cause, or the causes between which the matches do not decide, the best first."""
    (tried, before, after), *rivals = causes
    others = "".join(f", or {rival.tried.what[0].lower()}{rival.tried.what[1:]}" for rival in rivals)
    what = (
        f"{tried.what}{others}: corrected, {after[0]} of {after[1]} matches of keypoints are near their epipolar "
        f"lines, instead of {before[0]} of {before[1]}."
    )
    changed = frozenset[int]().union(*(each.tried.changed for each in causes))
    cameras = [names[i] for i in sorted(changed)]
    return VerdictReason.failure(what, tried.remedy, cameras=cameras, cause=tried.kind)


def _repairs(shown: PicturesOfInstant, own: _Arrangement, suspects: Sequence[int]) -> Iterator[_Arrangement]:
    yield from _exchanged(own, suspects)
    yield from _flipped(shown, own, suspects)
    yield from _resized(own)
    yield from _other_instants(shown, own, suspects)


def _exchanged(own: _Arrangement, suspects: Sequence[int]) -> Iterator[_Arrangement]:
    """Yield the pictures in other orders."""
    names = [camera.name for camera in own.cameras]
    for order in permutations(suspects):
        moved = [i for i, j in zip(suspects, order, strict=True) if i != j]
        if not moved or (len(moved) > 2 and len(own.cameras) > _FEW_CAMERAS):
            continue
        source = dict(zip(suspects, order, strict=True))
        yield replace(
            own, pictures=tuple(own.pictures[source.get(i, i)] for i in range(len(names))), changed=frozenset(moved),
            what=f"The pictures of {listed([names[i] for i in moved])} are exchanged", kind="exchanged",
            remedy="Exchange the files, or their cameras in the calibration: "
            + listed([f"{names[source[i]]} shows what {names[i]} should" for i in moved]) + ".",
        )  # fmt: skip


def _flipped(shown: PicturesOfInstant, own: _Arrangement, suspects: Sequence[int]) -> Iterator[_Arrangement]:
    """Yield mirrored and half turned pictures, of one camera and of all."""
    mirrored = [
        keypoints(np.ascontiguousarray(image[:, ::-1]), None if mask is None else np.ascontiguousarray(mask[:, ::-1]))
        for image, mask in zip(shown.images, shown.places, strict=True)
    ]
    turned = [
        Keypoints(pixels=np.array(camera.size) - 1 - each.pixels, descriptors=each.descriptors)
        for camera, each in zip(own.cameras, own.pictures, strict=True)
    ]
    remedy = "Flip the pictures back, or calibrate from pictures as they are."
    for pictures, how, kind in ((mirrored, "mirror images", "mirrored"), (turned, "upside down", "upside down")):
        for i in suspects:
            what = f"The pictures of {own.cameras[i].name} are {how}"
            changed = frozenset([i])
            yield replace(
                own, pictures=_with(own.pictures, i, pictures[i]), changed=changed, what=what, remedy=remedy, kind=kind
            )  # fmt: skip
        every = frozenset(range(len(pictures)))
        what = f"The pictures of all cameras are {how}"
        yield replace(own, pictures=tuple(pictures), changed=every, what=what, remedy=remedy, kind=kind)


def _resized(own: _Arrangement) -> Iterator[_Arrangement]:
    """Yield cameras that were calibrated with pictures of another size."""
    every = frozenset(range(len(own.cameras)))
    for ratio in _SIZES:
        what = f"The cameras were calibrated with pictures {1 / ratio:.2g} times as large as these"
        yield replace(
            own, cameras=tuple(camera.scaled(ratio) for camera in own.cameras), changed=every, what=what,
            remedy="Give the calibration for pictures of this size.", kind="image size",
        )  # fmt: skip


def _other_instants(shown: PicturesOfInstant, own: _Arrangement, suspects: Sequence[int]) -> Iterator[_Arrangement]:
    """Yield one camera's pictures of other instants."""
    for later, read in shown.others.items():
        images = read()
        for i in suspects:
            camera = own.cameras[i].name
            what = f"The pictures of {camera} are of other instants: those {count_of(abs(later), 'frame')} "
            yield replace(
                own, pictures=_with(own.pictures, i, keypoints(images[i])), changed=frozenset([i]), kind="late",
                what=what + ("later" if later > 0 else "earlier") + " belong to the others",
                remedy="Put the pictures of one instant together, or measure the clocks (marey sync).",
            )  # fmt: skip


def _with(pictures: tuple[Keypoints, ...], i: int, picture: Keypoints) -> tuple[Keypoints, ...]:
    return (*pictures[:i], picture, *pictures[i + 1 :])

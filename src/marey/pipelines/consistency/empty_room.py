"""Foreground that never changes and that no other camera shows: the image of the empty room is another room's."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask
from marey.cameras.camera import Camera
from marey.fit.search.hull import common_parts
from marey.pipelines.clocks.disagreement import MaskOfCamera
from marey.pipelines.verdict import VerdictReason
from marey.wording import listed

FOREIGN_FRAMES = 8
"""Number of frames that are compared. Chosen by hand."""
LEAST_FOREIGN = 1.0
"""Area of lasting foreground that no other camera shows, as a share of the usual area that is common, from which on an
image of the empty room is wrong. It is 0 for `walk` and `reach`, at most 0.24 with a camera of these moved by 3 or 5
degrees or exchanged, 0.25 for `seated`, and 0.89 for `tpose`, whose cluttered silhouettes are usable; with a plate of
`reach` at another light it is 1.25. Held out: 0 for `jacks` and `stealth`, at most 0.09 with a camera moved, and 1.4 to
6.3 with wrong plates."""


@dataclass(frozen=True, eq=False)
class ForeignForeground:
    """The part of each camera's foreground that never changes and that the other cameras do not show."""

    masks: Sequence[Mask]
    """(height, width) of each camera."""
    shares: Floats
    """(C,) its area, as a share of the usual area of what the cameras have in common."""

    @property
    def numbers(self) -> tuple[int, ...]:
        """The cameras in which there is much of it."""
        return tuple(int(c) for c in np.flatnonzero(self.shares > LEAST_FOREIGN))


def foreign_foreground(cameras: Sequence[Camera], frames: Sequence[int], mask_of: MaskOfCamera) -> ForeignForeground:
    """Find the foreground that lasts through a take and is not seen by the other cameras.

    A person who stands in one place lasts as well, but the other cameras show the same person there.

    Args:
        cameras: C cameras of the silhouettes.
        frames: Frames that show a person.
        mask_of: Returns the silhouette of a frame in a camera.
    """
    index = np.unique(np.linspace(0, len(frames) - 1, min(FOREIGN_FRAMES, len(frames))).astype(int))
    every = [[np.asarray(mask_of(frames[i], c)) for c in range(len(cameras))] for i in index]
    common = [common_parts(cameras, masks) for masks in every]
    usual = np.median([[np.count_nonzero(part) for part in parts] for parts in common], axis=0)
    usual = np.maximum(usual, np.median(usual))
    found = [
        np.logical_and.reduce([masks[c] & ~parts[c] for masks, parts in zip(every, common, strict=True)])
        for c in range(len(cameras))
    ]
    sizes = np.array([np.count_nonzero(mask) for mask in found])
    return ForeignForeground(found, np.where(sizes > 0, sizes / np.maximum(usual, 1.0), 0.0))


def wrong_empty_rooms(cameras: Sequence[Camera], found: ForeignForeground) -> VerdictReason:
    """Return that the images of the empty room of some cameras do not belong to the recording."""
    names = tuple(cameras[c].name for c in found.numbers)
    shares = listed(f"{cameras[c].name} {100 * found.shares[c]:.0f} %" for c in found.numbers)
    what = (
        f"The image of the empty room of {listed(names)} does not belong to this recording: foreground that never "
        f"changes and that no other camera shows covers {shares} of the area of the person."
    )
    remedy = "Film the empty room again with the light, furniture and camera of this recording."
    return VerdictReason.failure(what, remedy, cameras=names, cause="empty room")

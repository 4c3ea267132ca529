"""The jackknife over the cameras by whole refinements, which `BandedSystem.jackknife` approximates by one step."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.pose import Pose
from marey.body.articulation.surface import Body
from marey.fit.recipes.person import PersonSettings, SilhouetteTake, refine_person

_Item = TypeVar("_Item")
"""Type of what a camera has."""


def camera_spread(
    take: SilhouetteTake, body: Body, poses: Mapping[int, Pose], settings: PersonSettings, *, height: float
) -> dict[int, Floats]:  # fmt: skip
    """Return the covariance of `with_camera_contradictions`, by a whole refinement without each camera."""
    count = len(take.cameras)

    def refined(own: SilhouetteTake, start: Mapping[int, Pose]) -> dict[int, Pose]:
        found: dict[int, Pose] = {}
        for fit in refine_person(
            own, body, start, [], settings, height=height, rounds=1
        ):  # fmt: skip
            found |= fit.by_frame
        own.forget()
        return found

    whole = refined(take, poses)
    total: dict[int, Floats] = {frame: np.zeros((len(body.skeleton),) * 2) for frame in whole}
    for c in range(count):
        for frame, pose in refined(without_camera(take, c), whole).items():
            change = whole[frame].change_to(pose)
            total[frame] += (count - 1) / count * np.outer(change, change)
    return total


def without_camera(take: SilhouetteTake, camera: int) -> SilhouetteTake:
    """Return a take without one of its cameras, given by its number."""

    def rest(items: Sequence[_Item]) -> list[_Item]:
        return [item for c, item in enumerate(items) if c != camera]

    def rest_or_none(items: Sequence[_Item] | None) -> list[_Item] | None:
        return None if items is None else rest(items)

    return replace(
        take, cameras=tuple(rest(take.cameras)), masks_of=lambda frame: rest(take.masks_of(frame)),
        edges_of=lambda frame: rest_or_none(take.edges_of(frame)),
        hidden_of=lambda frame: rest_or_none(take.hidden_of(frame)),
    )  # fmt: skip

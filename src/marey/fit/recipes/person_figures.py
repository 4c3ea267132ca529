"""Figures of people from their joints in one image: roughly the region that a person covers, without a fitted body."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.cameras.camera import Camera

_SIDES = ("left", "right")
"""Prefixes of the names of joints of the two sides."""
LIMB_RADII_M = {
    ("shoulder", "elbow"): 0.065, ("elbow", "wrist"): 0.05, ("hip", "knee"): 0.10, ("knee", "ankle"): 0.07,
    ("ankle", "toe"): 0.06,
}  # fmt: skip
"""Half the width of a limb with clothes between two joints of one side [m]. Chosen by hand."""
HEAD_RADIUS_M, NECK_RADIUS_M, TRUNK_MARGIN_M = 0.14, 0.07, 0.10
"""Radius of the head about the midpoint of the ears, of the neck, and distance of the trunk's outline from the
quadrilateral of shoulders and hips [m]. Chosen by hand."""
HAND_SHARE, FOOT_SHARE = 0.75, 0.5
"""Length of the hand beyond the wrist relative to that of the forearm, and of the foot below the ankle relative to that
of the shank where no toe is known. Chosen by hand: the ankle is 0.08 m above the sole."""
USUAL_LENGTHS_M = (
    {("shoulder", "hip"): 0.50}, {("hip", "knee"): 0.42, ("knee", "ankle"): 0.41},
    {("shoulder", "elbow"): 0.29, ("elbow", "wrist"): 0.25},
)  # fmt: skip
"""Usual distance of joints of one side [m], from which the distance of a person follows in a single image: of the
trunk, or of the legs, or of the arms, the first that is known. From the proportions of a stature of 1.70 m, rounded."""
FARTHEST_SIZES = 8
"""Distance of a joint from the image's corner beyond which it is not drawn, in sides of the image; NaN is not drawn."""
LEAST_FIGURE_JOINTS = 4
"""Number of joints from which a figure is drawn. Chosen by hand."""


@dataclass(frozen=True, eq=False)
class PersonFigure:
    """The joints of a person in one image, and how far away the person is."""

    pixels: Floats
    """(J, 2) the joints [px]; NaN where they are not known."""
    distance_m: float
    """Distance from the camera [m]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "pixels")

    def scaled(self, factor: float) -> "PersonFigure":
        """Return the figure in an image of another size; pixel centres are at whole numbers in both."""
        return self if factor == 1 else replace(self, pixels=(self.pixels + 0.5) * factor - 0.5)


def figure_distance(camera: Camera, joint_names: Sequence[str], pixels: Floats) -> float:
    """Estimate the distance of a person from the camera by the lengths between its joints in one image.

    Perspective shortens a length that is not parallel to the image, therefore the larger one of both sides, relative to
    its usual value, counts.

    Args:
        camera: The camera.
        joint_names: Names of the J joints.
        pixels: (J, 2) the joints [px]; NaN where they are not known.

    Returns:
        The distance [m]; NaN if no length is known.
    """
    at = dict(zip(joint_names, pixels, strict=True))
    for lengths in USUAL_LENGTHS_M:
        scales = [
            float(np.linalg.norm(at[f"{side}_{a}"] - at[f"{side}_{b}"])) / usual
            for (a, b), usual in lengths.items()
            for side in _SIDES
        ]
        known = [scale for scale in scales if scale > 0]
        if known:
            return float(camera.matrix[0, 0]) / max(known)
    return float("nan")


def draw_figures(
    camera: Camera, joint_names: Sequence[str], figures: Sequence[PersonFigure], *, margin_m: float = 0.0
) -> Mask:
    """Draw the regions that people cover in an image.

    Args:
        camera: The camera.
        joint_names: Names of the J joints.
        figures: The people.
        margin_m: Distance by which each region is enlarged at the distance of the person [m].

    Returns:
        (height, width) true where one of the people may be.
    """
    drawn = np.zeros((camera.height, camera.width), np.uint8)
    for figure in figures:
        scale = float(camera.matrix[0, 0]) / figure.distance_m
        known = np.asarray((np.abs(figure.pixels) < FARTHEST_SIZES * max(camera.size)).all(axis=1))
        at = {name: row for name, row, has in zip(joint_names, figure.pixels, known, strict=True) if has}
        _draw_trunk(drawn, at, scale * (TRUNK_MARGIN_M + margin_m))
        _draw_head(drawn, at, scale, margin_m)
        for (a, b), radius in LIMB_RADII_M.items():
            for side in _SIDES:
                _draw_line(drawn, [at.get(f"{side}_{a}"), at.get(f"{side}_{b}")], scale * (radius + margin_m))
        for line, radius in _ends(at):
            _draw_line(drawn, line, scale * (radius + margin_m))
    return drawn > 0


def _ends(at: Mapping[str, Floats]) -> list[tuple[list[Floats | None], float]]:
    """Return hands, and feet whose toe is not known, each as a line with a radius [m]."""
    ends: list[tuple[list[Floats | None], float]] = []
    for side in _SIDES:
        elbow, wrist = at.get(f"{side}_elbow"), at.get(f"{side}_wrist")
        if elbow is not None and wrist is not None:
            ends.append(([wrist, wrist + HAND_SHARE * (wrist - elbow)], LIMB_RADII_M["elbow", "wrist"]))
        knee, ankle = at.get(f"{side}_knee"), at.get(f"{side}_ankle")
        if knee is not None and ankle is not None and f"{side}_toe" not in at:
            ends.append(([ankle, ankle + 0.5 * FOOT_SHARE * (ankle - knee)], LIMB_RADII_M["ankle", "toe"]))
    return ends


def _draw_trunk(drawn: np.ndarray, at: Mapping[str, Floats], margin: float) -> None:
    corners = [at[f"{side}_{joint}"] for side in _SIDES for joint in ("shoulder", "hip") if f"{side}_{joint}" in at]
    if len(corners) >= 3:
        hull = cv2.convexHull(np.round(corners).astype(np.int32))
        cv2.fillConvexPoly(drawn, hull, 1)
        outline = [*hull[:, 0].astype(float), hull[0, 0].astype(float)]
        _draw_line(drawn, outline, margin)


def _draw_head(drawn: np.ndarray, at: Mapping[str, Floats], scale: float, margin_m: float) -> None:
    if "head" not in at:
        return
    _draw_line(drawn, [at["head"], at["head"]], scale * (HEAD_RADIUS_M + margin_m))
    shoulders = [at[f"{side}_shoulder"] for side in _SIDES if f"{side}_shoulder" in at]
    if len(shoulders) == 2:
        _draw_line(drawn, [at["head"], np.mean(shoulders, axis=0)], scale * (NECK_RADIUS_M + margin_m))


def _draw_line(drawn: np.ndarray, points: Sequence[Floats | None], radius: float) -> None:
    """Draw a line of round ends through points; nothing if one of them is missing."""
    known = [np.round(point).astype(int) for point in points if point is not None]
    if len(known) == len(points):
        for a, b in pairwise(known):
            width = max(1, 2 * round(radius) + 1)
            cv2.line(drawn, (int(a[0]), int(a[1])), (int(b[0]), int(b[1])), 1, width, cv2.LINE_8)

"""The learned family of bodies: skin and joint centres as a mean and linear modes of unit variance."""

from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from typing import Literal

import numpy as np

from marey.arrays import Floats, Integers, frozen
from marey.errors import SettingProblem

DetailLevel = Literal["fine", "coarse"]
"""Level of detail of the family's skin."""
LEVELS: tuple[DetailLevel, ...] = ("fine", "coarse")
"""Available levels of detail."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyFamily:
    """Bodies v = mean + sum b_k mode_k, with joint centres moved by the same numbers b, each of unit variance.

    Rest posture: metres, the pelvis's joint centre at the origin, Z up, the person looks along -Y, the left side is
    +X; legs straight down, arms straight along (+-.67, -.02, -.74), feet flat and pointing forward. Both levels belong
    to one set of numbers b: the coarse vertices lie near the first vertices of the fine level and share their weights.

    Attributes:
        level: "fine" or "coarse".
        segment_names: The S segments.
        parents: (S,) index of each segment's parent, -1 for the pelvis.
        vertices_mean: (V, 3).
        vertices_modes: (K, V, 3), in the order of importance.
        joints_mean: (S, 3) proximal joint centre of each segment.
        joints_modes: (K, S, 3).
        faces: (T, 3) triangles of a closed surface, seen counter-clockwise from outside.
        vertex_segments: (V, 4) segments that move a vertex, most first.
        vertex_weights: (V, 4) their shares, sum 1.
        mirror: (V,) the vertex on the other side.
        hinge_axes: (S, 3) unit axis of each knee, elbow, wrist, ankle and toe joint at rest, NaN elsewhere. A positive
            turn bends knee and elbow, turns the hand to its palm, and lifts the foot and the toes.
        joints_sd: (S,) metres by axis by which joint centres lie from where these numbers put them when the skin is
            known, among the people learned from; real people are not all of that family, so it is the least.
        share: (K,) part of the family's variance that each number carries.
    """

    level: DetailLevel
    segment_names: tuple[str, ...]
    parents: Integers
    vertices_mean: Floats
    vertices_modes: Floats
    joints_mean: Floats
    joints_modes: Floats
    faces: Integers
    vertex_segments: Integers
    vertex_weights: Floats
    mirror: Integers
    hinge_axes: Floats
    joints_sd: Floats
    share: Floats

    @property
    def numbers(self) -> int:
        """Number of numbers b that describe a body."""
        return len(self.vertices_modes)

    def segment(self, name: str) -> int:
        """Return the index of a segment.

        Raises:
            SettingProblem: No segment has the name.
        """
        if name not in self.segment_names:
            raise SettingProblem(f"There is no segment '{name}'. The body has {', '.join(self.segment_names)}.")
        return self.segment_names.index(name)

    def vertices(self, coefficients: Floats) -> Floats:
        """Return the skin (V, 3) [m] of the body with numbers (k,), k <= K; omitted numbers are zero."""
        b = np.asarray(coefficients, float)
        return self.vertices_mean + np.tensordot(b, self.vertices_modes[: len(b)], axes=1)

    def joints(self, coefficients: Floats) -> Floats:
        """Return the joint centres (S, 3) [m] of the body with numbers (k,), k <= K; omitted numbers are zero."""
        b = np.asarray(coefficients, float)
        return self.joints_mean + np.tensordot(b, self.joints_modes[: len(b)], axes=1)


def distal_ends(family: BodyFamily) -> Floats:
    """Return the distal end (S, 3) [m] of each segment of the mean body: the next joint centre, or the end of its skin.

    The long axis of a segment runs from its own joint centre to here: the pelvis's to the abdomen's joint, the thorax's
    to the neck's, a clavicle's to the shoulder.
    """
    next_one = {"pelvis": "abdomen", "abdomen": "thorax", "thorax": "neck", "neck": "head", "clavicle": "upperarm"}
    next_one |= {"upperarm": "forearm", "forearm": "hand", "thigh": "shank", "shank": "foot", "foot": "toes"}
    far = {"head": np.array([0.0, 0.0, 1.0]), "toes": np.array([0.0, -1.0, 0.0])}
    ends = np.empty((len(family.segment_names), 3))
    for index, name in enumerate(family.segment_names):
        side, _, plain = name.rpartition("_")
        if plain in next_one:
            following = f"{side}_{next_one[plain]}" if side else next_one[plain]
            ends[index] = family.joints_mean[family.segment(following)]
            continue
        joint = family.joints_mean[index]
        along = far[plain] if plain in far else joint - family.joints_mean[family.parents[index]]
        along = along / np.linalg.norm(along)
        own = family.vertex_segments[:, 0] == index
        ends[index] = joint + along * np.max((family.vertices_mean[own] - joint) @ along)
    return ends


def load_family(level: DetailLevel = "fine", numbers: int | None = None) -> BodyFamily:
    """Load the family that ships with the package.

    Args:
        level: "fine" (about 2600 vertices) or "coarse" (about 800); a body has the same numbers in both.
        numbers: Number of numbers to keep, all 16 if None.

    Raises:
        SettingProblem: The level does not exist, or there are fewer numbers.
    """
    if level not in LEVELS:
        raise SettingProblem(f"There is no level '{level}' of the body. It should be {' or '.join(LEVELS)}.")
    stored = _stored()
    most = len(stored["joints_modes"])
    keep = most if numbers is None else numbers
    if not 0 <= keep <= most:
        raise SettingProblem(f"The body family has {most} shape parameters; {keep} of them cannot be used.")
    mean_step, mode_step = stored["steps"]
    mean = frozen(stored[f"vertices_mean_{level}"] * mean_step)
    count = len(mean)
    weights = stored["vertex_weights"][:count] / 255.0
    return BodyFamily(
        level=level,
        segment_names=tuple(str(name) for name in stored["segment_names"]),
        parents=frozen(stored["parents"], np.int64),
        vertices_mean=mean,
        vertices_modes=frozen(stored[f"vertices_modes_{level}"][:keep] * mode_step),
        joints_mean=frozen(stored["joints_mean"]),
        joints_modes=frozen(stored["joints_modes"][:keep]),
        faces=frozen(stored[f"faces_{level}"], np.int64),
        vertex_segments=frozen(stored["vertex_segments"][:count], np.int64),
        vertex_weights=frozen(weights),
        mirror=frozen(stored["mirror"][:count], np.int64),
        hinge_axes=frozen(stored["hinge_axes"]),
        joints_sd=frozen(stored["joints_sd"][keep]),
        share=frozen(stored["share"][:keep]),
    )


@lru_cache(maxsize=1)
def _stored() -> dict[str, np.ndarray]:
    """Load the arrays of family.npz, described in bodies/README.md."""
    with files("marey.body").joinpath("family.npz").open("rb") as file, np.load(file) as arrays:
        return {name: arrays[name] for name in arrays.files}

"""A bone's own frame in the scanner: from landmarks, from the bone's form, or from the markers on it.

X points anterior, Y proximal and Z to the person's right, as in the laboratory ([Wu2002], [Grood1983]).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, frozen
from marey.errors import MareyError
from marey.geometry.rigid import RigidTransform
from marey.knee.space.surface import Surface
from marey.markers.kinematics.transform_chain import MR_ANATOMIC, MR_GLOBAL, NamedTransform

_UP, _BACK, _RIGHT = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0]), np.array([-1.0, 0.0, 0.0])
"""Directions of a lying person in the scanner's LPS."""
_SECTION_MM = 4.0
_SHORTEST_SHAFT_MM = 30.0
_CONDYLES_MM = 40.0  # from the femur's lowest point: the condyles
_PLATEAU_MM = 20.0  # from the tibia's highest point: the condyles of the tibia
_BACKMOST_MM = 25.0
_APART_MM = (25.0, 75.0)  # the centres of the condyles, of a small knee and of a large one
_NO_CONDYLES = "its posterior condyles are not seen, so that their axis is not known"
_LEAST_OF_SECTION = 8
_ROUNDS = 8
_ALIKE = 0.1  # two principal moments that differ by a smaller share have no axes of their own
_LANDMARKS = {"femur": ("ME", "LE"), "tibia": ("MC", "LC")}
_SHAFT = {"femur": ("FS", "HJC"), "tibia": ("TS",)}


@dataclass(frozen=True, eq=False, kw_only=True)
class BoneFrame:
    """A bone's frame in the scanner."""

    scanner_from_bone: RigidTransform
    """MR global from MR anatomic [mm]."""
    source: str
    """What it was made of, in words."""
    notes: tuple[str, ...] = ()

    @property
    def step(self) -> NamedTransform:
        """The first step of the chain [mm]: direct, without doubt, since the frame is what it is said to be."""
        inverse = self.scanner_from_bone.inverse()
        return NamedTransform(
            to=MR_ANATOMIC, from_=MR_GLOBAL, rotation=inverse.rotation, translation=inverse.translation
        )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class Landmarks:
    """Anatomical landmarks picked in the scanner's images, by the laboratory's names."""

    places_mm: Mapping[str, Floats]
    """Name to (3,) LPS."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "places_mm", {name: frozen(at) for name, at in self.places_mm.items()})


def bone_frame(
    bone: str, surface: Surface | None, markers_mm: Floats, *, left: bool | None, landmarks: Landmarks | None = None
) -> BoneFrame:
    """Make a bone's frame from the best that there is: landmarks, its form, else the markers on it.

    Landmarks are `ME` and `LE` with `FS` (the shaft's middle, as high as is seen) or `HJC` for the femur, `MC` and
    `LC` with `TS` (the shaft's middle, as low as is seen) or `MM` and `LM` for the tibia; `left_` or `right_` may
    stand before them.

    Args:
        bone: Its name.
        surface: Its surface; None where there is none.
        markers_mm: (M, 3) LPS the markers that ride on it.
        left: Which knee it is; None where it is not known.
        landmarks: Those that were picked.
    """
    notes: list[str] = []
    if landmarks is not None and bone in _LANDMARKS:
        if left is None:
            notes.append("its landmarks are passed over, since it is not known which knee it is (--side tells)")
        else:
            frame, missing = _from_landmarks(bone, landmarks, left)
            if frame is not None:
                return BoneFrame(scanner_from_bone=frame, source="landmarks")
            notes.append(f"no frame from landmarks without {', '.join(missing)}")
    if surface is not None and bone in _FORMS:
        try:
            frame, said = _FORMS[bone](surface)
            return BoneFrame(scanner_from_bone=frame, source="the bone's form", notes=(*notes, *said))
        except MareyError as problem:
            notes.append(str(problem))
    frame, said = principal_frame(markers_mm)
    return BoneFrame(
        scanner_from_bone=frame, source="the markers' centre of mass and principal axes", notes=(*notes, *said)
    )  # fmt: skip


def principal_frame(points: Floats) -> tuple[RigidTransform, tuple[str, ...]]:
    """Take the centre of mass of points of unit mass and their principal axes ([Alexander2003] section 2.2).

    The axes go from the longest to the shortest extent. Each of the first two points to the side on which the points
    reach farther (their third moment is positive), so that it turns with them; the third completes a right-handed
    frame.

    Args:
        points: (M, 3).

    Returns:
        The frame of the points from the principal one, and which axes the points do not tell well, in words.
    """
    centre = points.mean(0)
    _, extent, axes = np.linalg.svd(points - centre, full_matrices=True)
    extent = np.pad(extent, (0, 3 - len(extent)))
    first, second = (_farther(points - centre, axis) for axis in axes[:2])
    frame = RigidTransform(np.stack([first, second, np.cross(first, second)], -1), centre)
    names = ("longest", "middle", "shortest")
    notes = [
        f"the {names[k]} and {names[k + 1]} principal axes are nearly alike, and small errors turn them"
        for k in range(2)
        if extent[k + 1] > (1 - _ALIKE) * extent[k]
    ]
    skews = [float(((points - centre) @ axis) ** 3 @ np.ones(len(points))) for axis in (first, second)]
    notes += [
        f"the points reach alike to both sides of the {names[k]} axis, and small errors turn its sense"
        for k, skew in enumerate(skews)
        if skew < _ALIKE * float((np.abs((points - centre) @ (first, second)[k]) ** 3).sum())
    ]
    return frame, tuple(notes)


def _farther(centred: Floats, axis: Floats) -> Floats:
    return axis if ((centred @ axis) ** 3).sum() >= 0 else -axis


def _from_landmarks(bone: str, landmarks: Landmarks, left: bool) -> tuple[RigidTransform | None, list[str]]:
    """Make a frame from landmarks, or say which are missing."""
    side = "left_" if left else "right_"
    at = {name.removeprefix(side): place for name, place in landmarks.places_mm.items()}
    if bone == "tibia" and "TS" not in at and {"MM", "LM"} <= set(at):
        at["TS"] = (at["MM"] + at["LM"]) / 2
    shaft = next((name for name in _SHAFT[bone] if name in at), None)
    missing = [name for name in _LANDMARKS[bone] if name not in at] + ([] if shaft else [" or ".join(_SHAFT[bone])])
    if missing or shaft is None:
        return None, missing
    medial, lateral = (at[name] for name in _LANDMARKS[bone])
    middle = (medial + lateral) / 2
    up = at[shaft] - middle if bone == "femur" else middle - at[shaft]
    return _frame(middle, up=up, right=medial - lateral if left else lateral - medial), []


def _frame(origin: Floats, *, up: Floats, right: Floats, keep_right: bool = False) -> RigidTransform:
    """Make a frame whose Y, or whose Z, is kept as it is."""
    if keep_right:
        z = right / np.linalg.norm(right)
        x = np.cross(up, z)
        x = x / np.linalg.norm(x)
        return RigidTransform(np.stack([x, np.cross(z, x), z], -1), origin)
    y = up / np.linalg.norm(up)
    x = np.cross(y, right)
    x = x / np.linalg.norm(x)
    return RigidTransform(np.stack([x, y, np.cross(x, y)], -1), origin)


def _femur(surface: Surface) -> tuple[RigidTransform, tuple[str, ...]]:
    """Z along the line through the centres of the posterior condyles, Y near the shaft; origin between the centres.

    Each condyle's back is nearly a sphere about the axis of flexion.
    """
    height = surface.vertices_mm @ _UP
    low = height < height.min() + _CONDYLES_MM
    back = low & (surface.vertex_normals @ _BACK > 0.3)
    across = surface.vertices_mm @ _RIGHT
    middle = (across[low].min() + across[low].max()) / 2
    centres = []
    for side in (across < middle, across > middle):
        condyle = surface.vertices_mm[back & side]
        # The backmost part: farther forward the condyle's side and the notch begin.
        condyle = condyle[condyle @ _BACK > (condyle @ _BACK).max() - _BACKMOST_MM] if len(condyle) else condyle
        centres.append(_sphere_centre(condyle))
    if not _APART_MM[0] < np.linalg.norm(centres[1] - centres[0]) < _APART_MM[1]:
        raise MareyError(_NO_CONDYLES)
    up, notes = _shaft_axis(surface, height.min() + np.ptp(across[low]), height.max())
    return _frame((centres[0] + centres[1]) / 2, up=up, right=centres[1] - centres[0], keep_right=True), notes


def _tibia(surface: Surface) -> tuple[RigidTransform, tuple[str, ...]]:
    """Y along the shaft, Z near the longer axis of the plateau; origin at the plateau's middle."""
    height = surface.vertices_mm @ _UP
    top = surface.vertices_mm[height > height.max() - _PLATEAU_MM]
    up, notes = _shaft_axis(surface, height.min(), height.max() - np.ptp(top @ _RIGHT))
    flat = top - np.outer(top @ up, up)
    across = np.linalg.svd(flat - flat.mean(0), full_matrices=False)[2][0]
    return _frame(_middle(top), up=up, right=across if across @ _RIGHT > 0 else -across), notes


_FORMS = {"femur": _femur, "tibia": _tibia}


def _shaft_axis(surface: Surface, low: float, high: float) -> tuple[Floats, tuple[str, ...]]:
    """Fit a line to the middles of the shaft's sections between two heights; up.

    Next to the joint the bone widens to the back, and the middles of its sections lean: where no more than that is
    seen, the scanner's own axis, along which a person lies, is nearer to the shaft's than they are. Then it is taken,
    and said.
    """
    height = surface.vertices_mm @ _UP
    edges = np.arange(low, high - _SECTION_MM, _SECTION_MM)
    sections = [surface.vertices_mm[(height >= edge) & (height < edge + _SECTION_MM)] for edge in edges]
    middles = np.array([_middle(section) for section in sections if len(section) >= _LEAST_OF_SECTION])
    if len(middles) < 3 and high - low >= _SHORTEST_SHAFT_MM:
        return _UP, ("its surface is too coarse to tell the axis of its shaft: Y follows the scanner's",)
    if len(middles) < 3 or high - low < _SHORTEST_SHAFT_MM:
        said = (
            f"too little of its shaft is seen for its axis ({max(high - low, 0.0):.0f} mm beyond the widening at the "
            "joint): Y follows the scanner's, and the joint's bending may be off by some degrees, always the same"
        )
        return _UP, (said,)
    axis = np.linalg.svd(middles - middles.mean(0))[2][0]
    return (axis if axis @ _UP > 0 else -axis), ()


def _middle(points: Floats) -> Floats:
    """Return the middle between extremes, which no finer mesh on one side moves."""
    return np.asarray((points.min(0) + points.max(0)) / 2)


def _sphere_centre(points: Floats) -> Floats:
    """Fit a sphere by linear least squares, in rounds without the points that lie off it.

    Raises:
        MareyError: There are too few points.
    """
    kept: Sequence[bool] | Floats = np.ones(len(points), bool)
    centre = np.zeros(3)
    for _ in range(_ROUNDS):
        chosen = points[kept]
        if len(chosen) < 30:
            raise MareyError(_NO_CONDYLES)
        system = np.column_stack([2 * chosen, np.ones(len(chosen))])
        solution = np.linalg.lstsq(system, (chosen**2).sum(1), rcond=None)[0]
        centre = solution[:3]
        off = np.linalg.norm(points - centre, axis=1) - np.sqrt(solution[3] + centre @ centre)
        kept = np.abs(off) < max(2.5 * 1.4826 * float(np.median(np.abs(off[kept]))), 0.2)
    return centre

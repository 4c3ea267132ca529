"""Anatomical frame of a bone in the scanner: from landmarks, from the bone's shape, or from the markers on it.

X points anterior, Y proximal and Z to the person's right, as in the laboratory ([Wu2002], [Grood1983]).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, frozen
from marey.errors import MareyError
from marey.geometry.rigid import RigidTransform
from marey.knee.space.surface import TriangleSurface
from marey.markers.kinematics.transform_chain import MR_ANATOMIC, MR_GLOBAL, NamedTransform

_UP, _BACK, _RIGHT = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0]), np.array([-1.0, 0.0, 0.0])
"""Directions of a supine person in the scanner's LPS: proximal, posterior and right."""
_NO_CONDYLES = "its posterior condyles are not visible, so that their axis is unknown"
"""Reason for a femur without a frame from its shape."""


@dataclass(frozen=True, kw_only=True)
class BoneFrameSettings:
    """Settings for anatomical frames from the shape of a bone.

    Values without a stated source were chosen by hand.
    """

    section_mm: float = 4.0
    """Height [mm] of the sections of a shaft."""
    shortest_shaft_mm: float = 30.0
    """Least length [mm] of a shaft from which its axis is measured."""
    condyles_mm: float = 40.0
    """Height [mm] of the condyles above the femur's lowest point."""
    plateau_mm: float = 20.0
    """Depth [mm] of the plateau below the tibia's highest point."""
    posterior_mm: float = 25.0
    """Depth [mm] of the posterior part of a condyle, to which a sphere is fitted."""
    condyle_distance_mm: tuple[float, float] = (25.0, 75.0)
    """Least and largest distance [mm] of the centres of the condyles, of a small and of a large knee."""
    fewest_vertices: int = 8
    """Fewest vertices of a section that is used."""
    rounds: int = 8
    """Number of rounds of the fit of a sphere without outliers."""
    similar: float = 0.1
    """Relative difference of two principal moments below which their axes are not determined."""


BONE_FRAME_DEFAULTS = BoneFrameSettings()
"""Default settings for anatomical frames from the shape of a bone."""
_LANDMARKS = {"femur": ("ME", "LE"), "tibia": ("MC", "LC")}
"""Medial and lateral landmark of each bone."""
_SHAFT = {"femur": ("FS", "HJC"), "tibia": ("TS",)}
"""Landmarks of each bone's shaft, the preferred one first."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BoneFrame:
    """A bone's frame in the scanner."""

    scanner_from_bone: RigidTransform
    """MR global from MR anatomic [mm]."""
    source: str
    """From what it was constructed, in words."""
    notes: tuple[str, ...] = ()

    @property
    def step(self) -> NamedTransform:
        """First step of the chain [mm], exact by definition of the frame."""
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
    bone: str,
    surface: TriangleSurface | None,
    markers_mm: Floats,
    *,
    left: bool | None,
    landmarks: Landmarks | None = None,
    settings: BoneFrameSettings = BONE_FRAME_DEFAULTS,
) -> BoneFrame:
    """Construct a bone's frame from landmarks, else from its shape, else from the markers on it.

    Landmarks are `ME` and `LE` with `FS` (the shaft's middle, as proximal as is visible) or `HJC` for the femur, `MC`
    and `LC` with `TS` (the shaft's middle, as distal as is visible) or `MM` and `LM` for the tibia; `left_` or `right_`
    may stand before them.

    Args:
        bone: Name of the bone.
        surface: Surface of the bone, if there is one.
        markers_mm: (M, 3) LPS of the markers on it.
        left: Which knee it is; None where it is not known.
        landmarks: The picked ones, if any.
        settings: Tuned constants of the algorithm.
    """
    notes: list[str] = []
    if landmarks is not None and bone in _LANDMARKS:
        if left is None:
            notes.append("its landmarks are ignored because the side of the knee is unknown; give side (--side)")
        else:
            frame, missing = _from_landmarks(bone, landmarks, left)
            if frame is not None:
                return BoneFrame(scanner_from_bone=frame, source="landmarks")
            notes.append(f"no frame from landmarks without {', '.join(missing)}")
    if surface is not None and bone in _SHAPES:
        try:
            frame, more = _SHAPES[bone](surface, settings=settings)
            return BoneFrame(scanner_from_bone=frame, source="the bone's form", notes=(*notes, *more))
        except MareyError as problem:
            notes.append(str(problem))
    frame, more = principal_frame(markers_mm, settings=settings)
    return BoneFrame(
        scanner_from_bone=frame, source="the markers' centre of mass and principal axes", notes=(*notes, *more)
    )  # fmt: skip


def frame_from_form(
    bone: str, surface: TriangleSurface, *, settings: BoneFrameSettings = BONE_FRAME_DEFAULTS
) -> RigidTransform | None:
    """Return a bone's frame from its form alone; None if the form does not show it.

    Args:
        bone: Name of the bone.
        surface: Its surface.
        settings: Tuned constants of the algorithm.
    """
    if bone not in _SHAPES:
        return None
    try:
        return _SHAPES[bone](surface, settings=settings)[0]
    except MareyError:
        return None


def principal_frame(
    points: Floats, *, settings: BoneFrameSettings = BONE_FRAME_DEFAULTS
) -> tuple[RigidTransform, tuple[str, ...]]:
    """Return the centre of mass of points of unit mass and their principal axes ([Alexander2003] section 2.2).

    The axes are ordered from the longest to the shortest extent. Each of the first two is directed to the side on which
    the points reach farther (their third moment is positive), so that it rotates with them; the third completes a
    right-handed frame.

    Args:
        points: (M, 3).
        settings: Tuned constants of the algorithm.

    Returns:
        The frame of the points from the principal one, and which axes the points do not determine well, in words.
    """
    centre = points.mean(0)
    _, extent, axes = np.linalg.svd(points - centre, full_matrices=True)
    extent = np.pad(extent, (0, 3 - len(extent)))
    first, second = (_farther(points - centre, axis) for axis in axes[:2])
    frame = RigidTransform(np.stack([first, second, np.cross(first, second)], -1), centre)
    names = ("longest", "middle", "shortest")
    notes = [
        f"the {names[k]} and {names[k + 1]} principal axes are nearly equal, and small errors rotate them"
        for k in range(2)
        if extent[k + 1] > (1 - settings.similar) * extent[k]
    ]
    skews = [float(((points - centre) @ axis) ** 3 @ np.ones(len(points))) for axis in (first, second)]
    notes += [
        f"the points reach equally far to both sides of the {names[k]} axis, and small errors reverse it"
        for k, skew in enumerate(skews)
        if skew < settings.similar * float((np.abs((points - centre) @ (first, second)[k]) ** 3).sum())
    ]
    return frame, tuple(notes)


def _farther(centred: Floats, axis: Floats) -> Floats:
    return axis if ((centred @ axis) ** 3).sum() >= 0 else -axis


def _from_landmarks(bone: str, landmarks: Landmarks, left: bool) -> tuple[RigidTransform | None, list[str]]:
    """Construct a frame from landmarks, or return which are missing."""
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
    """Construct a frame from its Y and the approximate Z, or from Z and the approximate Y."""
    if keep_right:
        z = right / np.linalg.norm(right)
        x = np.cross(up, z)
        x = x / np.linalg.norm(x)
        return RigidTransform(np.stack([x, np.cross(z, x), z], -1), origin)
    y = up / np.linalg.norm(up)
    x = np.cross(y, right)
    x = x / np.linalg.norm(x)
    return RigidTransform(np.stack([x, y, np.cross(x, y)], -1), origin)


def _femur(surface: TriangleSurface, *, settings: BoneFrameSettings) -> tuple[RigidTransform, tuple[str, ...]]:
    """Z along the line through the centres of the posterior condyles, Y near the shaft; origin between the centres.

    Each condyle's back is nearly a sphere about the axis of flexion.
    """
    height = surface.vertices_mm @ _UP
    low = height < height.min() + settings.condyles_mm
    back = low & (surface.vertex_normals @ _BACK > 0.3)
    across = surface.vertices_mm @ _RIGHT
    middle = (across[low].min() + across[low].max()) / 2
    centres = []
    for side in (across < middle, across > middle):
        condyle = surface.vertices_mm[back & side]
        # Only the posterior part: farther forward the condyle's side and the notch begin.
        condyle = (
            condyle[condyle @ _BACK > (condyle @ _BACK).max() - settings.posterior_mm] if len(condyle) else condyle
        )
        centres.append(_sphere_centre(condyle, settings=settings))
    if not settings.condyle_distance_mm[0] < np.linalg.norm(centres[1] - centres[0]) < settings.condyle_distance_mm[1]:
        raise MareyError(_NO_CONDYLES)
    up, notes = _shaft_axis(surface, height.min() + np.ptp(across[low]), height.max(), settings=settings)
    return _frame((centres[0] + centres[1]) / 2, up=up, right=centres[1] - centres[0], keep_right=True), notes


def _tibia(surface: TriangleSurface, *, settings: BoneFrameSettings) -> tuple[RigidTransform, tuple[str, ...]]:
    """Y along the shaft, Z near the longer axis of the plateau; origin at the plateau's middle."""
    height = surface.vertices_mm @ _UP
    top = surface.vertices_mm[height > height.max() - settings.plateau_mm]
    up, notes = _shaft_axis(surface, height.min(), height.max() - np.ptp(top @ _RIGHT), settings=settings)
    flat = top - np.outer(top @ up, up)
    across = np.linalg.svd(flat - flat.mean(0), full_matrices=False)[2][0]
    return _frame(_middle(top), up=up, right=across if across @ _RIGHT > 0 else -across), notes


_SHAPES = {"femur": _femur, "tibia": _tibia}
"""Bone to the function that constructs a frame from its shape."""


def _shaft_axis(
    surface: TriangleSurface, low: float, high: float, *, settings: BoneFrameSettings
) -> tuple[Floats, tuple[str, ...]]:
    """Fit a line to the middles of the shaft's sections between two heights; it points up.

    Next to the joint the bone widens to the back, and the line through the middles of its sections leans. Where no more
    than that is visible, the scanner's own axis, along which a person lies, is nearer to the shaft's axis; it is used
    instead, and reported.
    """
    height = surface.vertices_mm @ _UP
    edges = np.arange(low, high - settings.section_mm, settings.section_mm)
    sections = [surface.vertices_mm[(height >= edge) & (height < edge + settings.section_mm)] for edge in edges]
    middles = np.array([_middle(section) for section in sections if len(section) >= settings.fewest_vertices])
    if len(middles) < 3 and high - low >= settings.shortest_shaft_mm:
        return _UP, ("its surface is too coarse for the axis of its shaft: Y follows the scanner's",)
    if len(middles) < 3 or high - low < settings.shortest_shaft_mm:
        note = (
            f"its shaft is too short for its axis ({max(high - low, 0.0):.0f} mm beyond the widening at the "
            "joint): Y follows the scanner's, and the joint's bending may have a constant error of some degrees"
        )
        return _UP, (note,)
    axis = np.linalg.svd(middles - middles.mean(0))[2][0]
    return (axis if axis @ _UP > 0 else -axis), ()


def _middle(points: Floats) -> Floats:
    """Return the middle between the extremes, which does not depend on the density of the mesh."""
    return np.asarray((points.min(0) + points.max(0)) / 2)


def _sphere_centre(points: Floats, *, settings: BoneFrameSettings) -> Floats:
    """Fit a sphere by linear least squares, in rounds without outliers.

    Raises:
        MareyError: There are too few points.
    """
    kept: Sequence[bool] | Floats = np.ones(len(points), bool)
    centre = np.zeros(3)
    for _ in range(settings.rounds):
        chosen = points[kept]
        if len(chosen) < 30:
            raise MareyError(_NO_CONDYLES)
        system = np.column_stack([2 * chosen, np.ones(len(chosen))])
        solution = np.linalg.lstsq(system, (chosen**2).sum(1), rcond=None)[0]
        centre = solution[:3]
        off = np.linalg.norm(points - centre, axis=1) - np.sqrt(solution[3] + centre @ centre)
        kept = np.abs(off) < max(2.5 * 1.4826 * float(np.median(np.abs(off[kept]))), 0.2)
    return centre

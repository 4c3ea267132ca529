"""Faults that are planted one at a time into made calibration sessions, each with the finding that should name it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from tests.made_wands import TAGS, made_wand

from bench.common.fault_sessions import (
    BOARD,
    ON_FLOOR,
    RATE,
    BoardPath,
    Filming,
    clean_filming,
    filmed,
    rearranged,
    with_camera,
)
from marey.arrays import Floats, Integers, Mask
from marey.calibration.adjustment.landmarks import LandmarkPixels
from marey.calibration.adjustment.state import shaped_points
from marey.calibration.boards.corners import CornerSet
from marey.calibration.boards.wand import CalibrationTarget, CalibrationWand, Landmark
from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.geometry.rigid import RigidTransform

WAND_PICTURES = 300
"""Pictures of the sessions with a wand whose cameras have different clocks; a ball moves by 37 px in each."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Planted:
    """A session with a fault."""

    corners: CornerSet
    board: CalibrationTarget = BOARD
    distances: Mapping[tuple[str, str], float] = field(default_factory=dict)
    floor: str = "auto"
    landmarks: tuple[Landmark, ...] = ()
    pixels: LandmarkPixels = field(default_factory=dict)
    named: tuple[str, ...] = ()
    """What the text of the finding must contain, such as the camera."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Fault:
    """A fault and the finding that names it."""

    name: str
    code: str
    plant: Callable[[Filming], Planted]
    """Plants the fault into a clean session."""


def chosen(filming: Filming) -> int:
    """Return the camera that has the fault."""
    return filming.seed % len(filming.rig)


def name_of(filming: Filming) -> str:
    """Return its name."""
    return filming.rig.names[chosen(filming)]


def shared(filming: Filming) -> Integers:
    """Return the pictures of the walk in which the chosen camera and another see the board."""
    corners = filmed(filming)
    views = np.unique(np.stack([corners.picture, corners.camera], -1), axis=0)
    several = np.bincount(views[:, 0], minlength=filming.pictures) > 1
    own = views[views[:, 1] == chosen(filming), 0]
    return np.asarray(own[several[own] & (own < 40 * RATE)])


def begins(filming: Filming) -> int:
    """Return the picture at which a fault begins: the middle one of those of the walk that are shared."""
    seen = shared(filming)
    return int(seen[len(seen) // 2])


def changed(change: Callable[[Camera, int], Camera]) -> Callable[[Filming], Planted]:
    """Plant a change of one camera; `change` returns the camera at a picture."""
    return lambda filming: Planted(
        corners=filmed(with_camera(filming, change, chosen(filming))), named=(name_of(filming),)
    )


def changed_late(change: Callable[[Camera], Camera]) -> Callable[[Filming], Planted]:
    """Plant a change of one camera from an instant in the walk on."""

    def plant(filming: Filming) -> Planted:
        start = begins(filming)
        return changed(lambda camera, picture: change(camera) if picture >= start else camera)(filming)

    return plant


def moved(degrees: float, millimetres: float) -> Callable[[Camera], Camera]:
    """Return a change that turns and shifts a camera."""
    step = RigidTransform.from_vector(
        np.radians(degrees) * np.array([0.6, 0.64, 0.48]), 1e-3 * millimetres * np.array([0.8, 0.0, 0.6])
    )
    return lambda camera: replace(camera, camera_from_world=step @ camera.camera_from_world)


def zoomed(factor: float, aspect: float = 1.0) -> Callable[[Camera], Camera]:
    """Return a change of the focal lengths."""

    def change(camera: Camera) -> Camera:
        matrix = np.array(camera.matrix)
        matrix[0, 0] *= factor
        matrix[1, 1] *= factor * aspect
        return replace(camera, matrix=matrix)

    return change


def cropped(camera: Camera) -> Camera:
    """Cut 40 % of the image away on the right and 30 % at the bottom."""
    return replace(camera, size=(int(0.6 * camera.width), int(0.7 * camera.height)))


def clocked(change: Callable[[Floats, int], Floats]) -> Callable[[Filming], Planted]:
    """Plant other times of the pictures of one camera; `change` is called with the times and the middle picture."""

    def plant(filming: Filming) -> Planted:
        clock = np.array(filming.clock)
        clock[chosen(filming)] = change(clock[chosen(filming)], begins(filming))
        return Planted(corners=filmed(replace(filming, clock=clock)), named=(name_of(filming),))

    return plant


def _lost(clock: Floats, start: int) -> Floats:
    return np.where(np.arange(len(clock)) >= start, clock + 3 / RATE, clock)


def single(filming: Filming) -> Planted:
    """One picture of one camera that shows the next instant, at which the camera sees the board, too."""
    corners, own = filmed(filming), chosen(filming)
    seen, pictures = set(corners.picture[corners.camera == own].tolist()), shared(filming).tolist()
    middle = len(pictures) // 2
    # Without the board in the next instant, the picture would show nothing, and no fault would be planted.
    start = next(
        pictures[k] for k in sorted(range(len(pictures)), key=lambda k: abs(k - middle)) if pictures[k] + 1 in seen
    )
    clock = np.array(filming.clock)
    clock[own, start] += 1.0 / RATE
    return Planted(corners=filmed(replace(filming, clock=clock)), named=(name_of(filming), f"frame {start}"))


def _frozen(clock: Floats, start: int) -> Floats:
    held = clock.copy()
    held[start : start + 8] = clock[start]
    return held


def filmed_with(change: Callable[[Filming], Filming], named: bool = True) -> Callable[[Filming], Planted]:
    """Plant another way of filming."""
    return lambda filming: Planted(corners=filmed(change(filming)), named=(name_of(filming),) if named else ())


def rolling(filming: Filming) -> Filming:
    """One camera with a shutter that takes 25 ms for the image."""
    readout = np.zeros(len(filming.rig))
    readout[chosen(filming)] = 0.025
    return replace(filming, readout=readout)


def unsteady(filming: Filming) -> Filming:
    """One camera whose stabilisation shifts the pictures by some pixels."""
    rng = np.random.default_rng(filming.seed + 5)
    shift = 4.0 * rng.normal(0, 1, (filming.pictures, 2))
    return replace(
        filming, pixels_of=lambda c, p, pixels: pixels + shift[p] if c == chosen(filming) else pixels
    )  # fmt: skip


def blurred(filming: Filming) -> Planted:
    """One picture of one camera, with eight times the errors."""
    corners = filmed(filming)
    own = corners.picture[corners.camera == chosen(filming)]
    shared = [p for p in np.unique(own) if len(np.unique(corners.camera[corners.picture == p])) > 1]
    soft = int(shared[len(shared) // 3])
    worse = replace(
        filming, noise=lambda c, p: 0.8 if (c, p) == (chosen(filming), soft) else 0.1
    )  # fmt: skip
    return Planted(corners=filmed(worse), named=(name_of(filming), f"frame {soft}"))


def shaped(shape: tuple[float, float, float, float]) -> Callable[[Filming], Planted]:
    """Plant a stretched or bent print."""
    return filmed_with(
        lambda filming: replace(filming, points=shaped_points(BOARD.points, np.array(shape), BOARD.centre)[0]), False
    )


def turned_image(filming: Filming) -> Planted:
    """Pictures of one camera that are upside down from an instant on."""
    corners, camera = filmed(filming), chosen(filming)
    late = (corners.camera == camera) & (corners.picture >= begins(filming))
    size = np.array(corners.sizes[camera])
    return Planted(
        corners=replace(corners, pixels=np.where(late[:, None], size - 1 - corners.pixels, corners.pixels)),
        named=(name_of(filming),),
    )


def exchanged(filming: Filming) -> Planted:
    """Two cameras whose pictures are exchanged from an instant on."""
    corners, count = filmed(filming), len(filming.rig)
    first, second = chosen(filming), (chosen(filming) + 1) % count
    other = np.where(corners.camera == first, second, np.where(corners.camera == second, first, corners.camera))
    camera = np.where(corners.picture >= begins(filming), other, corners.camera)
    return Planted(
        corners=rearranged(corners, camera=camera), named=(filming.rig.names[first], filming.rig.names[second])
    )


def second_board(filming: Filming) -> Planted:
    """Another print of the board that stands in the room and is found in some pictures of two cameras instead."""
    rng = np.random.default_rng(filming.seed + 9)
    own = [chosen(filming), (chosen(filming) + 1) % len(filming.rig)]
    centre = np.mean([filming.rig.cameras[k].centre for k in own], axis=0)
    turn = (
        filming.rig.cameras[own[0]].camera_from_world.rotation.T
        + filming.rig.cameras[own[1]].camera_from_world.rotation.T
    )
    u, _, v = np.linalg.svd(turn)
    back = -centre / np.linalg.norm(centre)
    place = np.array([1.5 * back[0], 1.5 * back[1], 0.9])
    pose = RigidTransform(u @ v, place - u @ v @ BOARD.centre)
    corners, rows = filmed(filming), []
    instead = {
        (int(p), c) for c in own for p in rng.choice(np.unique(corners.picture[corners.camera == c]), 9, replace=False)
    }
    still = replace(filming, path=_Standing(filming.path, pose))
    shown = {(p, c): each for p, c, each in filmed(still).sightings() if (p, c) in instead}
    rows = [(p, c, shown.get((p, c), each)) for p, c, each in corners.sightings()]
    return Planted(corners=CornerSet.gather(corners.cameras, corners.sizes, corners.pictures, rows))


class _Standing(BoardPath):
    """A board that does not move."""

    def __init__(self, path: BoardPath, pose: RigidTransform):
        super().__init__(path.place, path.turn, path.end)
        object.__setattr__(self, "_pose", pose)

    _pose: RigidTransform

    def poses(self, time: Floats) -> tuple[Floats, Floats]:
        count = len(time)
        return np.tile(self._pose.rotation, (count, 1, 1)), np.tile(self._pose.translation, (count, 1))


def selected(keep: Callable[[CornerSet, int], Mask], named: bool = True) -> Callable[[Filming], Planted]:
    """Plant what was not filmed; `keep` returns (N,) which corners are kept, from the corners and the camera."""

    def plant(filming: Filming) -> Planted:
        corners = filmed(filming)
        found = corners.subset(keep(corners, chosen(filming)))
        return Planted(corners=found, named=(name_of(filming),) if named else ())

    return plant


def few(corners: CornerSet, camera: int) -> Mask:
    """Keep five pictures of a camera, from the walk."""
    shared = [p for p in np.unique(corners.picture[corners.camera == camera]) if p < 40 * RATE]
    kept = np.array(shared)[np.linspace(0, len(shared) - 1, 5).astype(int)]
    return np.asarray((corners.camera != camera) | np.isin(corners.picture, kept))


def apart(corners: CornerSet, camera: int) -> Mask:
    """Keep only those pictures of a camera that no other camera shares, and of the others those it does not."""
    views = np.unique(np.stack([corners.picture, corners.camera], -1), axis=0)
    own = views[views[:, 1] == camera, 0]
    half = own[::2]
    return np.asarray(np.where(np.isin(corners.picture, half), corners.camera == camera, corners.camera != camera))


def small(corners: CornerSet, camera: int) -> Mask:
    """Keep only distant views of a camera, and six corners of each."""
    views = corners.view
    counts = corners.view_counts[views]
    low, high = np.full(counts.shape, np.inf), np.full(counts.shape, -np.inf)
    for k in range(len(corners.view_starts)):
        rows = corners.view_rows(k)
        low[rows], high[rows] = corners.pixels[rows].min(), np.ptp(corners.pixels[rows], axis=0).max()
    few_corners = np.isin(corners.corner % 5, (1, 2, 3)) & np.isin(corners.corner // 5, (1, 2))
    return np.asarray((corners.camera != camera) | ((high < 200) & few_corners))


def untilted(filming: Filming) -> Planted:
    """A camera that sees the board only from the front."""
    corners, camera = filmed(filming), chosen(filming)
    cosine = [_view(filming, camera, k)[1] for k in range(filming.pictures)]
    keep = (corners.camera != camera) | (np.array(cosine) > np.cos(np.radians(20)))[corners.picture]
    return Planted(corners=corners.subset(keep), named=(name_of(filming),))


def _view(filming: Filming, camera: int, picture: int) -> tuple[float, float]:
    """Return the distance of the board [m] and the cosine of its tilt in a picture."""
    turn, shift = filming.path.poses(np.array([filming.clock[camera, picture]]))
    ray = turn[0] @ BOARD.centre + shift[0] - filming.rig.cameras[camera].centre
    distance = float(np.linalg.norm(ray))
    return distance, float(turn[0][:, 2] @ ray) / distance


def _from_usual(distance: float) -> float:
    """Return how far a distance is from that at which a board is usually carried [m]."""
    return abs(distance - 3.2)


def shallow(filming: Filming) -> Planted:
    """A camera that sees the board at one distance only."""
    corners, camera = filmed(filming), chosen(filming)
    views = [_view(filming, camera, k) for k in range(filming.pictures)]
    distance, cosine = np.array(views).T
    seen = np.unique(corners.picture[corners.camera == camera])
    seen = seen[cosine[seen] > np.cos(np.radians(50))]
    # About 3.2 m, or the nearest distance at which the camera sees the board often enough.
    bands = [
        seen[np.abs(distance[seen] / about - 1) < 0.125] for about in sorted(np.arange(1.2, 5.3, 0.2), key=_from_usual)
    ]
    own = next(band for band in bands if len(band) >= 10)
    few_of = own[np.unique(np.linspace(0, len(own) - 1, 10).astype(int))]
    keep = (corners.camera != camera) | np.isin(corners.picture, few_of)
    return Planted(corners=corners.subset(keep), named=(name_of(filming),))


def table_as_floor(filming: Filming) -> Planted:
    """A picture that was given as the floor, though the board is carried there."""
    return Planted(corners=filmed(filming), floor=str(int(8 * RATE)))


def with_points(change: Callable[[list[Landmark]], list[Landmark]], *named: str) -> Callable[[Filming], Planted]:
    """Plant wrong coordinates of tags on the floor."""

    def plant(filming: Filming) -> Planted:
        rng, seen = np.random.default_rng(filming.seed + 3), {}
        points = [
            *TAGS,
            Landmark(name="tag 5", place=(0.1, -0.2, 0.0), sd=1e-3),
            Landmark(name="tag 6", place=(0.4, 1.0, 0.75), sd=1e-3),
        ]
        for c, camera in enumerate(filming.rig):
            for each in points:
                pixel = camera.project(np.array([each.place]))
                if camera.sees(pixel, margin=4.0).all():
                    seen[c, each.name] = pixel[0] + rng.normal(0, 0.1, 2), 0.01 * np.eye(2)
        return Planted(corners=filmed(filming), landmarks=tuple(change(points)), pixels=seen, named=named)

    return plant


def placed(points: list[Landmark], places: Mapping[int, tuple[float, float, float]]) -> list[Landmark]:
    """Return points of which some have other coordinates."""
    return [replace(each, place=places.get(k, each.place)) for k, each in enumerate(points)]


def smaller(point: Landmark) -> Landmark:
    """Return a point with coordinates that are 5 % too small."""
    x, y, z = (0.95 * value for value in point.place)
    return replace(point, place=(x, y, z))


def long_wand(filming: Filming) -> Planted:
    """A wand of 600 mm that is described as 630 mm long, with four tags on the floor."""
    made = made_wand(cameras=len(filming.rig), pictures=200, seed=filming.seed)
    wand = CalibrationWand(distances=tuple(1.05 * each for each in made.wand.distances), diameter=0.03)
    pixels = {key: (pixel, 0.01 * np.eye(2)) for key, pixel in made.seen.items()}
    return Planted(corners=made.corners, board=wand, landmarks=made.landmarks, pixels=pixels)


def late_wands(filming: Filming, late: Mapping[int, Callable[[Integers], Floats]]) -> Planted:
    """Plant other clocks of several cameras into a session with a wand; see `late_wand`."""
    own: list[Floats] = [np.zeros(WAND_PICTURES) for _ in range(len(filming.rig))]
    for camera, change in late.items():
        own[camera] = change(np.arange(WAND_PICTURES))
    made = made_wand(cameras=len(own), pictures=WAND_PICTURES, seed=filming.seed, late=own, pace=0.5)
    pixels = {key: (pixel, 0.01 * np.eye(2)) for key, pixel in made.seen.items()}
    names = tuple(filming.rig.names[camera] for camera in late)
    return Planted(corners=made.corners, board=made.wand, landmarks=made.landmarks, pixels=pixels, named=names)


def late_wand(late: Callable[[Integers], Floats]) -> Callable[[Filming], Planted]:
    """Plant another clock of a camera into a session with a wand: `late` returns its delay in each picture."""
    return lambda filming: late_wands(filming, {chosen(filming): late})


def known_distance(filming: Filming) -> Planted:
    """Squares of 144 mm that are described as 150 mm, and a known distance of two cameras."""
    first, second = filming.rig.cameras[:2]
    smaller = replace(filming, points=0.96 * BOARD.points)
    distance = float(np.linalg.norm(first.centre - second.centre))
    return Planted(corners=filmed(smaller), distances={(first.name, second.name): distance})


def wider(filming: Filming) -> Planted:
    """A board file with one column too many."""
    return Planted(corners=filmed(filming), board=replace(BOARD, columns=7))


def mirrored(filming: Filming) -> Planted:
    """A print that is mirrored."""
    corners = filmed(filming)
    return Planted(corners=replace(corners, corner=corners.corner // 5 * 5 + 4 - corners.corner % 5))


def fisheye_rig(rig: Rig, camera: int) -> Rig:
    """Return cameras of which one has a fisheye lens."""
    cameras = list(rig.cameras)
    own = cameras[camera]
    matrix = np.array(own.matrix)
    matrix[0, 0] = matrix[1, 1] = 520.0
    cameras[camera] = replace(own, matrix=matrix, distortion=np.array([-0.02, 0.005, -0.003, 0.0005]), fisheye=True)
    return Rig(tuple(cameras))


def fisheye(filming: Filming) -> Planted:
    """A camera with a fisheye lens."""
    rig = fisheye_rig(filming.rig, chosen(filming))
    return Planted(corners=filmed(clean_filming(filming.seed, rig=rig)), named=(name_of(filming),))


FAULTS = (
    Fault(name="squares of 144 mm described as 150 mm, distance known", code="square-size", plant=known_distance),
    Fault(name="board file with a column too many", code="board-layout", plant=wider),
    Fault(name="mirrored print", code="mirrored-print", plant=mirrored),
    Fault(name="board bent by 4 mm", code="bent-board", plant=shaped((0.0, 0.02, 0.0, 0.0))),
    Fault(name="print stretched by 0.4 %", code="squares-not-square", plant=shaped((0.004, 0.0, 0.0, 0.0))),
    Fault(name="second print of the board in the room", code="second-board", plant=second_board),
    Fault(name="camera moved by 2 deg, 30 mm", code="camera-moved", plant=changed_late(moved(2.0, 30.0))),
    Fault(name="camera moved by 0.4 deg, 5 mm", code="camera-moved", plant=changed_late(moved(0.4, 5.0))),
    Fault(name="camera zoomed by 3 %", code="lens-changed", plant=changed_late(zoomed(1.03))),
    Fault(name="camera refocused, 0.6 %", code="lens-changed", plant=changed_late(zoomed(1.006))),
    Fault(name="cameras exchanged from an instant on", code="cameras-exchanged", plant=exchanged),
    Fault(name="pictures upside down from an instant on", code="image-turned", plant=turned_image),
    Fault(name="camera late by 7 pictures", code="camera-late", plant=clocked(lambda clock, _: clock - 7 / RATE)),
    Fault(
        name="camera late by 0.4 pictures",
        code="camera-out-of-step",
        plant=clocked(lambda clock, _: clock - 0.4 / RATE),
    ),
    Fault(name="clock of a camera slow by 1 %", code="clock-drift", plant=clocked(lambda clock, _: 0.99 * clock)),
    Fault(name="three pictures of a camera lost", code="pictures-lost", plant=clocked(_lost)),
    Fault(name="one picture out of step", code="out-of-sync", plant=single),
    Fault(name="eight repeated pictures", code="pictures-repeated", plant=clocked(_frozen)),
    Fault(name="one blurred picture", code="blurred-picture", plant=blurred),
    Fault(name="rolling shutter of 25 ms", code="rolling-shutter", plant=filmed_with(rolling)),
    Fault(name="image stabilisation, 4 px", code="image-unsteady", plant=filmed_with(unsteady)),
    Fault(
        name="pixels 2 % higher than wide",
        code="pixels-not-square",
        plant=changed(lambda camera, _: zoomed(1.0, 1.02)(camera)),
    ),
    Fault(
        name="image cropped at the right and the bottom",
        code="image-cropped",
        plant=changed(lambda camera, _: cropped(camera)),
    ),
    Fault(name="fisheye lens", code="fisheye-lens", plant=fisheye),
    Fault(name="board never tilted", code="little-tilt", plant=untilted),
    Fault(name="board at one distance", code="little-depth", plant=shallow),
    Fault(
        name="left part of an image not covered",
        code="uncovered-corner",
        plant=selected(lambda corners, camera: (corners.camera != camera) | (corners.pixels[:, 0] > 500)),
    ),
    Fault(name="board in five pictures of a camera", code="few-pictures", plant=selected(few)),
    Fault(
        name="board in no picture of a camera",
        code="camera-unseen",
        plant=selected(lambda corners, camera: corners.camera != camera),
    ),
    Fault(name="camera without common pictures", code="not-connected", plant=selected(apart)),
    Fault(name="board far away, six corners", code="small-board", plant=selected(small)),
    Fault(
        name="no board on the floor",
        code="no-floor",
        plant=selected(lambda corners, camera: corners.picture < corners.picture.max() - 1.5 * ON_FLOOR, named=False),
    ),
    Fault(name="carried board given as the floor", code="floor-not-lowest", plant=table_as_floor),
    Fault(
        name="coordinates of a point wrong by 80 mm",
        code="point-wrong",
        plant=with_points(lambda points: placed(points, {1: (1.38, -1.1, 0.0)}), "tag 1"),
    ),
    Fault(
        name="two points exchanged",
        code="points-exchanged",
        plant=with_points(lambda points: placed(points, {1: points[4].place, 4: points[1].place}), "tag 1", "tag 5"),
    ),
    Fault(
        name="coordinates left-handed",
        code="points-mirrored",
        plant=with_points(
            lambda points: [replace(each, place=(each.place[1], each.place[0], each.place[2])) for each in points]
        ),
    ),
    Fault(
        name="coordinates 5 % too small",
        code="points-scale",
        plant=with_points(lambda points: [smaller(each) for each in points]),
    ),
    Fault(name="wand described 5 % too long", code="points-scale", plant=long_wand),
    Fault(
        name="wand, camera late by 7.4 pictures",
        code="camera-late",
        plant=late_wand(lambda picture: np.full(len(picture), 7.4)),
    ),
    Fault(
        name="wand, clock of a camera slow by 1 %", code="clock-drift", plant=late_wand(lambda picture: 0.01 * picture)
    ),
    Fault(
        name="wand, clock of a camera slow by 0.1 %",
        code="clock-drift",
        plant=late_wand(lambda picture: 0.001 * picture),
    ),
    Fault(
        name="wand, three pictures of a camera lost",
        code="pictures-lost",
        plant=late_wand(lambda picture: np.where(picture >= 0.4 * len(picture), -3.0, 0.0)),
    ),
    Fault(
        name="wand, one picture of a camera lost",
        code="pictures-lost",
        plant=late_wand(lambda picture: np.where(picture >= 0.6 * len(picture), -1.0, 0.0)),
    ),
    Fault(
        name="wand, two pictures of a camera shown twice",
        code="pictures-lost",
        plant=late_wand(lambda picture: np.where(picture >= 0.5 * len(picture), 2.0, 0.0)),
    ),
)
"""All faults that are planted into corners."""

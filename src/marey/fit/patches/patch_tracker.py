"""Patches of the surface, placed in the images of one camera and tracked through them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np

from marey.arrays import Floats, Image, Integers, Mask
from marey.body.articulation.kinematics import blend_skin, points_on_faces
from marey.body.articulation.pose import PosedBody, SkinPoints
from marey.body.articulation.surface import Body
from marey.cameras import lens
from marey.cameras.camera import Camera
from marey.cameras.visibility import View, see
from marey.fit.patches.patch_geometry import (
    directions_at,
    face_normals,
    information_along,
    positive_part,
    surface_at,
    with_more_noise,
)
from marey.fit.patches.patch_settings import SurfaceTrackSettings
from marey.geometry import rotations
from marey.images.boxes import box_about
from marey.images.matching.carried_patches import DISTINCT_PIXELS, NOISE_IN_GRADIENTS, match_patches
from marey.observations.correspondence import view_of
from marey.observations.surface_tracks import TrackedPatches

TRUNK = ("pelvis", "abdomen", "thorax", "head")
"""Segments of the trunk, and the head: they are large enough for more patches than a limb's segment."""
JOINED_TO = {"neck": "thorax", "left_clavicle": "thorax", "right_clavicle": "thorax"}
"""Segments too small to be tracked by themselves, and those to which their surface is added."""
WITHOUT_PATCHES = ("hand", "foot", "toes")
"""Segments without patches: hands are no rigid surfaces, and silhouettes determine the feet."""


def tracked_segments(body: Body) -> Integers:
    """Return for each segment (S,) the one to which patches on its surface are assigned; -1 for none."""
    names = body.skeleton.segment_names
    found = np.arange(len(names))
    for s, name in enumerate(names):
        if name.endswith(WITHOUT_PATCHES):
            found[s] = -1
        elif JOINED_TO.get(name) in names:
            found[s] = names.index(JOINED_TO[name])
    return found


def segment_axes(body: Body) -> Floats:
    """Return the long axis (S, 3) of each segment at rest: to the next joint, or upwards for trunk and head."""
    skeleton, joints = body.skeleton, body.joint_centres
    axes = np.tile([0.0, 0.0, 1.0], (len(joints), 1))
    for s, name in enumerate(skeleton.segment_names):
        children = np.flatnonzero(skeleton.parents == s)
        if name not in TRUNK and len(children) == 1:
            away = joints[children[0]] - joints[s]
            axes[s] = away / np.linalg.norm(away)
    return axes


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """A frame that is tracked."""

    frame: int
    posed: PosedBody
    place: bool
    """Whether new patches are placed."""


@dataclass(frozen=True, eq=False)
class _Turned:
    """The surface of a body whose segments were turned about their axes."""

    body: Body
    segment_rotation: Floats
    segment_origin: Floats
    vertices: Floats

    @staticmethod
    def of(posed: PosedBody, axes: Floats, turn: Floats) -> "_Turned":
        body = posed.body
        rotation = posed.segment_rotation @ rotations.about(axes, turn)
        vertices = blend_skin(
            body.vertices, body.vertex_segments, body.vertex_weights, body.joint_centres, rotation, posed.segment_origin
        )
        return _Turned(body, rotation, posed.segment_origin, vertices)

    def points(self, face: Integers, barycentric: Floats) -> Floats:
        """Return points (n, 3) of the surface."""
        return np.asarray(
            points_on_faces(
                self.vertices, self.body.faces, np.ascontiguousarray(face), np.ascontiguousarray(barycentric)
            )
        )  # fmt: skip

    def motion_by_turn(self, camera: Camera, points: Floats, segments: Integers, axes: Floats) -> Floats:
        """Return the derivatives (n, 2) of pixels by the turns of the points' segments [px/rad]."""
        axis = np.einsum("nij,nj->ni", self.segment_rotation[segments], axes[segments])
        _, by_point = camera.project_with_derivative(points)
        moved = np.cross(axis, points - self.segment_origin[segments])
        return np.asarray(np.einsum("nij,nj->ni", by_point, moved))

    def view(self, camera: Camera) -> View:
        """Draw the surface."""
        projected = np.empty_like(self.vertices)
        lens.project_points(camera.packed, self.vertices, projected)
        return see(projected, self.body.faces, camera.size)


@dataclass(frozen=True, eq=False)
class _Patches:
    """Patches that are tracked in one camera at present."""

    tracks: Integers
    """(n,) number of each track."""
    face: Integers
    """(n, k) face of each pixel, -1 where the patch has none."""
    barycentric: Floats
    """(n, k, 3)."""
    grey: Floats
    """(n, k) in the first image."""
    anchor_face: Integers
    """(n,) face to which the patch was attached on the body as it is posed, without the correction of its turn."""
    anchor_barycentric: Floats
    """(n, 3)."""
    segments: Integers
    """(n,)."""
    directions: Floats
    """(n, 3, 3), see `TrackedPatches`."""
    born: Integers
    """(n,) first frame."""
    shift: Floats
    """(n, 2) measured minus predicted in the last image [px]."""

    def __len__(self) -> int:
        return len(self.tracks)

    def __getitem__(self, which: Mask) -> "_Patches":
        return _Patches(**{f.name: getattr(self, f.name)[which] for f in fields(self)})

    def joined(self, other: "_Patches") -> "_Patches":
        return _Patches(
            **{f.name: np.concatenate([getattr(self, f.name), getattr(other, f.name)]) for f in fields(self)}
        )

    @staticmethod
    def none(size: int) -> "_Patches":
        none = np.zeros(0, int)
        return _Patches(
            tracks=none, face=np.zeros((0, size), int), barycentric=np.zeros((0, size, 3)), grey=np.zeros((0, size)),
            anchor_face=none, anchor_barycentric=np.zeros((0, 3)), segments=none, directions=np.zeros((0, 3, 3)),
            born=none, shift=np.zeros((0, 2)),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Shown:
    """An image, for the part that the body covers."""

    corner: Floats
    """(2,) x, y of the first pixel of the part."""
    grey: Floats
    """(h, w) smoothed."""
    label: Integers
    """(h, w) tracked segment at each pixel; -1 outside the silhouette and near the outline."""
    view: View

    @staticmethod
    def of(view: View, image: Image, mask: Mask, segment_of_face: Integers, settings: SurfaceTrackSettings) -> "_Shown":
        """Prepare an image; `segment_of_face` (T,) is -1 for faces that are not tracked."""
        x, y = view.corner
        part = (slice(y, y + view.face.shape[0]), slice(x, x + view.face.shape[1]))
        grey = cv2.cvtColor(np.ascontiguousarray(image[part]), cv2.COLOR_BGR2GRAY).astype(np.float32)
        covered = (view.face >= 0) & mask[part]
        inside = cv2.distanceTransform(np.pad(covered, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
        label = np.where(inside > settings.border_px, segment_of_face[view.face], -1)
        smooth = np.asarray(cv2.GaussianBlur(grey, (0, 0), settings.smoothing_px), np.float32)
        return _Shown(np.array(view.corner, float), smooth, label, view)

    def labels_at(self, pixels: Floats) -> Integers:
        """Return the labels (...) at the pixels of the part that are nearest to positions (..., 2); -1 outside."""
        height, width = self.label.shape
        near = np.rint(np.nan_to_num(pixels, nan=-1.0)).astype(int)
        inside = ((near >= 0) & (near < (width, height))).all(-1)
        column, row = (np.where(inside, near[..., k], 0) for k in range(2))
        return np.where(inside, self.label[row, column], -1)


class CameraTracker:
    """Tracks patches in the images of one camera.

    Args:
        camera: The camera.
        body: The body whose surface carries the patches.
        settings: Settings.
        first: Number of the first track; the tracks of this camera have numbers in steps of `step`.
        step: Number of cameras.
    """

    def __init__(self, camera: Camera, body: Body, settings: SurfaceTrackSettings, first: int, step: int):
        self.camera, self.settings = camera, settings
        self._next, self._step = first, step
        side = np.arange(-settings.half, settings.half + 1)
        self.window = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
        self.segment_of_face = np.where(body.outline_counts, tracked_segments(body)[body.face_segment], -1)
        self.axes = segment_axes(body)
        self.forget()

    def forget(self) -> None:
        """End all tracks."""
        segments = len(self.axes)
        self.patches = _Patches.none(len(self.window))
        self.turn = np.zeros(segments)
        """(S,) turn of each segment beyond its pose, as the patches have shown so far [rad]."""
        self.speed = np.zeros(segments)
        """(S,) turn of each segment from the image before the last one to the last one [rad]."""
        self.change, self.strength = np.zeros(segments), np.zeros(segments)
        """(S,) change of `turn` in the last image, and its information [1/rad2]."""
        self._last: Floats | None = None

    def advance(self, step: TrackedFrame, image: Image, mask: Mask) -> TrackedPatches | None:
        """Track the patches in the next image, and place new ones; return the measured positions."""
        turn = self.turn.copy()
        self.strength[:] = 0.0
        turned = self._predicted(step.posed)
        view = turned.view(self.camera)
        least = 2 * self.settings.half + 3
        if min(view.face.shape) < least:
            self.forget()
            return None
        shown = _Shown.of(view, image, mask, self.segment_of_face, self.settings)
        found = self._follow(step, turned, shown)
        if step.place:
            placed = self._place(step, turned, shown)
            found = found.joined(placed) if found is not None and placed is not None else found or placed
        self.change = self.turn - turn
        return found

    def _predicted(self, posed: PosedBody) -> _Turned:
        """Return the surface with each segment turned as its patches have shown so far.

        Where the poses turn a segment suddenly, its turn is assumed to go on as before.
        """
        if self._last is not None:
            change = rotations.log(posed.segment_rotation @ np.swapaxes(self._last, 1, 2))
            twist = np.einsum("si,sij,sj->s", change, posed.segment_rotation, self.axes)
            sudden = np.abs(twist) > self.settings.sudden
            self.turn = np.where(sudden, self.turn - twist + self.speed, self.turn)
            self.speed = np.where(sudden, self.speed, twist)
        self._last = posed.segment_rotation
        return _Turned.of(posed, self.axes, self.turn)

    def _follow(self, step: TrackedFrame, turned: _Turned, shown: _Shown) -> TrackedPatches | None:
        patches, settings, size = self.patches, self.settings, len(self.window)
        if len(patches) == 0:
            return None
        points = turned.points(np.maximum(patches.face, 0).ravel(), patches.barycentric.reshape(-1, 3))
        pixels = self.camera.project(points).reshape(-1, size, 2) - shown.corner
        used = (patches.face >= 0) & (shown.labels_at(pixels) == patches.segments[:, None])
        match = match_patches(
            shown.grey, pixels, used, patches.grey, patches.shift, search=settings.search,
            least_pixels=int(settings.least_share * size), least_noise=settings.noise**2,
        )  # fmt: skip
        alike = match.noise <= 4.0 * settings.noise**2 + settings.unlike * match.contrast
        found = np.isfinite(match.shift[:, 0]) & alike
        patches, information = replace(patches, shift=match.shift)[found], match.information[found]
        measured = pixels[found, size // 2] + shown.corner + patches.shift
        patches = self._corrected(patches, turned, information)
        kept = np.hypot(*patches.shift.T) <= settings.farthest_px
        self.patches = patches[kept]
        return self._batch(step, self.patches, measured[kept], information[kept]) if kept.any() else None

    def _corrected(self, patches: _Patches, turned: _Turned, information: Floats) -> _Patches:
        """Correct the turn of each segment by its patches, and return the patches with the shifts that remain."""
        centre, away = len(self.window) // 2, patches.shift
        points = turned.points(patches.face[:, centre], patches.barycentric[:, centre])
        along = turned.motion_by_turn(self.camera, points, patches.segments, self.axes)
        weight = with_more_noise(information, np.full(len(away), self.settings.sd_px**2))
        pulled = np.einsum("ni,nij->nj", along, weight)
        strength, pull = (
            np.asarray(np.bincount(patches.segments, (pulled * each).sum(1), len(self.turn)), float)
            for each in (along, away)
        )
        change = pull / (strength + 1.0 / self.settings.turn_sd**2)
        self.strength = strength
        self.turn = self.turn + change
        self.speed = self.speed + change
        return replace(patches, shift=away - change[patches.segments, None] * along)

    def _batch(self, step: TrackedFrame, patches: _Patches, pixels: Floats, information: Floats) -> TrackedPatches:
        settings, where = self.settings, SkinPoints(face=patches.anchor_face, barycentric=patches.anchor_barycentric)
        reach = np.linalg.norm(step.posed.points(where) - self.camera.centre, axis=1)
        slip = settings.slip_m * self.camera.matrix[0, 0] / reach
        growth = settings.growth_px * (step.frame - patches.born)
        information = with_more_noise(information, settings.sd_px**2 + slip**2 + growth**2)
        return TrackedPatches(
            camera=self.camera, tracks=patches.tracks, where=where, segments=patches.segments,
            directions=patches.directions, pixels=pixels, information=information,
        )  # fmt: skip

    def _directions(self, posed: PosedBody, corners: Integers, segments: Integers) -> Floats:
        """Return the directions of the offsets; a unit of the last one is the height per tangential distance."""
        return directions_at(posed, corners, segments) * [
            1.0,
            1.0,
            self.settings.height_sd_m / self.settings.offset_sd_m,
        ]

    def _place(self, step: TrackedFrame, turned: _Turned, shown: _Shown) -> TrackedPatches | None:
        """Place patches where a segment has too few, and return their positions; None if there are none."""
        present = np.bincount(self.patches.segments, minlength=len(self.axes))
        # Without patches nothing is known about the turn; the prediction changes with the next image.
        self.turn = np.where(present > 0, self.turn, 0.0)
        centre, names = len(self.window) // 2, turned.body.skeleton.segment_names
        taken = np.zeros((0, 2))
        if len(self.patches):
            points = turned.points(self.patches.face[:, centre], self.patches.barycentric[:, centre])
            taken = self.camera.project(points) + self.patches.shift - shown.corner
        wanted = {
            int(s): (self.settings.per_trunk_segment if names[s] in TRUNK else self.settings.per_segment) - present[s]
            for s in np.unique(shown.label[shown.label >= 0])
        }
        chosen: list[tuple[int, Integers, Floats]] = []
        for segment, places in self._places_for(turned, shown, [s for s, missing in wanted.items() if missing > 0]):
            best = self._best_places(places, taken, wanted[segment])
            chosen += [(segment, place, information) for place, information in best]
            taken = np.concatenate([taken, *(place[None].astype(float) for place, _ in best)])
        if not chosen:
            return None
        segments, centres, strengths = (np.array(part) for part in zip(*chosen, strict=True))
        born, shows = self._born(step, segments, centres, shown)
        self.patches = self.patches.joined(born)
        return self._batch(step, born, (centres + shown.corner)[shows], strengths[shows]) if len(born) else None

    def _places_for(
        self, turned: _Turned, shown: _Shown, segments: Sequence[int]
    ) -> "Iterator[tuple[int, _PossiblePlaces]]":
        """Iterate over segments, each with the places in the part of the image where its patches may be."""
        settings, texture = self.settings, _Texture.of(shown, self.settings)
        found = [texture.of_segment(shown, segment, settings) for segment in segments]
        if not found:
            return
        # What numpy computes of all segments at once costs hardly more than that of one.
        places = np.concatenate([own for own, _ in found])
        information = texture.information(np.concatenate([products for _, products in found]), settings)
        face, barycentric = surface_at(shown.view, turned.body.faces, places + shown.corner.astype(int))
        points = turned.points(face, barycentric)
        sight = self.camera.centre - points
        normals = face_normals(turned.vertices, turned.body.faces[face])
        facing = np.einsum("ni,ni->n", normals, sight) / np.linalg.norm(sight, axis=1)
        owner = np.repeat(np.array(segments, int), [len(own) for own, _ in found])
        along = turned.motion_by_turn(self.camera, points, owner, self.axes)
        turn = information_along(information, along, settings.farthest_px)
        turn[~(facing >= settings.least_facing)] = 0.0
        ends = np.cumsum([len(own) for own, _ in found])
        for segment, end, (own, _) in zip(segments, ends, found, strict=True):
            here = slice(end - len(own), end)
            if len(own):
                yield segment, _PossiblePlaces(places[here], information[here], turn[here])

    def _best_places(self, possible: "_PossiblePlaces", taken: Floats, wanted: int) -> list[tuple[Integers, Floats]]:
        """Return the places (2,) that tell most about a segment's turn, each with its information (2, 2)."""
        settings, places, turn = self.settings, possible.places, possible.turn.copy()
        apart = 1.5 * settings.half
        if len(taken):
            gaps = np.linalg.norm(places[:, None] - taken[None], axis=2)
            turn[np.nan_to_num(gaps, nan=np.inf).min(1) < apart] = 0.0
        found: list[tuple[Integers, Floats]] = []
        for _ in range(wanted):
            best = int(np.argmax(turn))
            if turn[best] < 1.0 / settings.turn_sd**2:
                break
            found.append((places[best], possible.information[best]))
            turn[np.linalg.norm(places - places[best], axis=1) < apart] = 0.0
        return found

    def _born(self, step: TrackedFrame, segments: Integers, centres: Integers, shown: _Shown) -> tuple[_Patches, Mask]:
        """Return new patches about places (m, 2) of the part, and (m,) which of them the untouched body shows, too."""
        faces, corner = step.posed.body.faces, shown.corner.astype(int)
        pixels = centres[:, None] + self.window
        own = shown.label[pixels[..., 1], pixels[..., 0]] == segments[:, None]
        face, barycentric = surface_at(shown.view, faces, (pixels + corner).reshape(-1, 2))
        anchor, anchor_barycentric = surface_at(view_of(step.posed, self.camera), faces, centres + corner)
        shows = anchor >= 0
        corners = faces[np.maximum(anchor, 0)]
        count = int(np.count_nonzero(shows))
        born = _Patches(
            tracks=self._next + self._step * np.cumsum(shows) - self._step,
            face=np.where(own, face.reshape(own.shape), -1),
            barycentric=barycentric.reshape(*own.shape, 3),
            grey=shown.grey[pixels[..., 1], pixels[..., 0]].astype(float), anchor_face=anchor,
            anchor_barycentric=anchor_barycentric, segments=segments,
            directions=self._directions(step.posed, corners, segments), born=np.full(len(segments), step.frame),
            shift=np.zeros((len(segments), 2)),
        )[shows]  # fmt: skip
        self._next += self._step * count
        return born, shows


@dataclass(frozen=True, eq=False)
class _PossiblePlaces:
    """Places where a segment's patches may be."""

    places: Integers
    """(n, 2) in the part of the image."""
    information: Floats
    """(n, 2, 2) about positions [1/px2]."""
    turn: Floats
    """(n,) about the segment's turn [1/rad2]."""


@dataclass(frozen=True, eq=False)
class _Texture:
    """Products of the gradients of an image."""

    products: tuple[Floats, Floats, Floats]
    """(h, w) each: across squared, across times down, down squared."""

    @staticmethod
    def of(shown: _Shown, settings: SurfaceTrackSettings) -> "_Texture":
        """Compute the products, less those of noise."""
        across, down = (0.5 * cv2.Sobel(shown.grey, cv2.CV_32F, dx, dy, ksize=1) for dx, dy in ((1, 0), (0, 1)))
        idle = NOISE_IN_GRADIENTS * 2.0 * settings.noise**2
        return _Texture((across * across - idle, across * down, down * down - idle))

    def of_segment(self, shown: _Shown, segment: int, settings: SurfaceTrackSettings) -> tuple[Integers, Floats]:
        """Return places (n, 2) for patches of a segment, every second pixel, and the sums (n, 3) of products there."""
        half, box = settings.half, (2 * settings.half + 1,) * 2
        here = box_about(shown.label == segment, half + 1)
        own = (shown.label[here] == segment).astype(np.float32)
        count = cv2.boxFilter(own, cv2.CV_32F, box, normalize=False, borderType=cv2.BORDER_CONSTANT)
        fits = (own > 0) & (count >= settings.least_share * box[0] ** 2)
        fits[: half + 1] = fits[-half - 1 :] = fits[:, : half + 1] = fits[:, -half - 1 :] = False
        top, left = (part.start for part in here)
        rows, columns = np.nonzero(fits)
        even = ((rows + top) % 2 == 0) & ((columns + left) % 2 == 0)
        rows, columns = rows[even], columns[even]
        xx, xy, yy = (
            cv2.boxFilter(own * each[here], cv2.CV_32F, box, normalize=False, borderType=cv2.BORDER_CONSTANT)[
                rows, columns
            ]
            for each in self.products
        )
        return np.stack([columns + left, rows + top], 1), np.stack([xx, xy, yy], -1)

    def information(self, products: Floats, settings: SurfaceTrackSettings) -> Floats:
        """Return the information (n, 2, 2) about positions from the sums (n, 3) of products."""
        matrix = products[:, [0, 1, 1, 2]].reshape(-1, 2, 2).astype(float)
        information = positive_part(matrix) * (DISTINCT_PIXELS / (2.0 * settings.noise**2))
        return with_more_noise(information, np.full(len(products), settings.sd_px**2))

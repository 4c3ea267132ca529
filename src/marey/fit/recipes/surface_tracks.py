"""Patches of the surface that are tracked through the images, as terms of the refinement of a motion.

Silhouettes hardly show how far a limb has turned about its own axis. Patches of its texture do: the body in its
estimated poses predicts where each patch moves and how it deforms, and its measured shift corrects the poses. Each
patch is compared with its first image, so that its position does not drift; its place on the surface is unknown and
is eliminated, so that a track constrains relative motion only.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from marey.arrays import Floats, Image, Integers, Mask
from scipy.spatial.transform import Rotation

from marey.body.articulation.kinematics import blend_skin, points_on_faces
from marey.body.articulation.pose import Pose, PosedBody, SkinPoints
from marey.body.articulation.skeleton import Skeleton
from marey.body.articulation.surface import Body
from marey.cameras import lens
from marey.cameras.camera import Camera
from marey.cameras.visibility import View, see
from marey.fit.search.levels import FrameLevels, SilhouetteLevel
from marey.fit.solver.banded import LocalEquations
from marey.fit.solver.pose_solver import Schedule, fit_pose
from marey.fit.solver.threads import map_in_threads, map_in_two_threads
from marey.images.matching.carried_patches import match_patches
from marey.observations.correspondence import view_of
from marey.observations.observation import Observation
from marey.observations.surface_tracks import TrackedPatches

FrameImages = Callable[[Sequence[int]], Iterable[tuple[int, Sequence[Image]]]]
"""Reads frames in ascending order: returns each frame's number and one image (height, width, 3) per camera."""


@dataclass(frozen=True, kw_only=True)
class SurfaceTrackSettings:
    """Where patches are placed, when a track ends, and how uncertain it is."""

    half: int = 5
    """Pixels from the centre of a patch to its edge."""
    smoothing_px: float = 0.8
    """Standard deviation of the Gaussian by which the images are smoothed [px]."""
    interval: int = 5
    """Number of frames after which new patches are placed where some are missing."""
    per_segment: int = 2
    """Number of patches of a limb's segment in one camera."""
    per_trunk_segment: int = 3
    """The same for the trunk's segments and the head."""
    border_px: float = 2.0
    """Least distance of a patch's pixels from the outline, where the background shows through [px]."""
    least_facing: float = 0.4
    """Least cosine between the surface's normal and the line of sight, where a patch is placed."""
    least_share: float = 0.5
    """Least share of a patch's pixels that must be visible."""
    turn_sd: float = 0.35
    """Largest standard deviation of the segment's rotation that a patch may give, for it to be placed [rad]."""
    search: int = 2
    """Largest shift from one image to the next beyond the prediction [px]."""
    farthest_px: float = 5.0
    """Shift from the prediction, after the correction of the segment's turn, at which a track ends [px]."""
    sudden: float = 0.2
    """Turn of a segment about its axis from one image to the next above which the body is not used as prediction: it
    may be a jump between two answers to the same silhouettes [rad]."""
    unlike: float = 0.3
    """A track ends when its grey values differ from the first ones by more than noise and this share of their
    variance."""
    noise: float = 1.5
    """Standard deviation of a grey value's noise in the smoothed images [grey levels]."""
    sd_px: float = 0.4
    """Standard deviation of a position that is due to shading and to errors of the predicted deformation [px]."""
    slip_m: float = 0.003
    """Standard deviation of skin and cloth from the place on the body [m]."""
    growth_px: float = 0.02
    """Standard deviation that is added per frame since the first image of a patch, as its appearance changes [px]."""
    repeated: float = 2.0
    """Factor of the variances: patches of one segment share errors."""
    jump: float = 0.5
    """Range of a segment's turn beyond the poses' above which several answers are tried [rad]."""
    clearly: float = 0.99
    """Share of the disagreement with the silhouettes below which another answer replaces the present one."""
    least_linked: float = 0.9
    """Least share of the frames in which patches show a segment's turn since the last one, for that."""
    offset_sd_m: float = 0.1
    """Standard deviation of the place of a patch on the surface: so large that it is free [m]."""


@dataclass(frozen=True, eq=False)
class SurfaceTracks:
    """Patches tracked through a take: observations by frame."""

    by_frame: Mapping[int, Sequence[TrackedPatches]]
    """Patches of each frame, one batch per camera."""
    segment_names: tuple[str, ...] = ()
    """Names of the body's segments."""
    turns: Mapping[int, Floats] = field(default_factory=dict)
    """(S,) by frame: by how much each segment has turned about its axis since the last frame beyond what the poses say,
    according to its patches [rad]; NaN where it has none."""

    def summary(self) -> dict[str, tuple[int, float]]:
        """Return for each segment the number of tracks, and the mean number of frames of a track."""
        seen = [(batch.tracks, batch.segments) for batches in self.by_frame.values() for batch in batches]
        if not seen:
            return {}
        tracks, segments = (np.concatenate(parts) for parts in zip(*seen, strict=True))
        found = {}
        for s in np.unique(segments):
            numbers = tracks[segments == s]
            count = len(np.unique(numbers))
            found[self.segment_names[s]] = (count, len(numbers) / count)
        return found


@dataclass(eq=False)
class _Active:
    """Patches that are tracked in one camera at present; arrays of equal length n."""

    tracks: Integers
    face: Integers
    """(n, k) face of each pixel, -1 where the patch has none."""
    barycentric: Floats
    """(n, k, 3)."""
    grey: Floats
    """(n, k)."""
    anchor_face: Integers
    """(n,) face to which the patch was attached on the body as it is posed, without the correction of its turn."""
    anchor_barycentric: Floats
    """(n, 3)."""
    segments: Integers
    tangents: Floats
    born: Integers
    shift: Floats
    """(n, 2) measured minus predicted in the last image [px]."""

    def __getitem__(self, which: Mask) -> "_Active":
        return _Active(*(getattr(self, name)[which] for name in self.__dataclass_fields__))

    def joined(self, other: "_Active") -> "_Active":
        return _Active(
            *(np.concatenate([getattr(self, name), getattr(other, name)]) for name in self.__dataclass_fields__)
        )

    @staticmethod
    def none(size: int) -> "_Active":
        return _Active(
            np.zeros(0, int), np.zeros((0, size), int), np.zeros((0, size, 3)), np.zeros((0, size)), np.zeros(0, int),
            np.zeros((0, 3)), np.zeros(0, int), np.zeros((0, 3, 2)), np.zeros(0, int), np.zeros((0, 2)),
        )  # fmt: skip


class _CameraTracker:
    """Tracks patches in the images of one camera.

    Args:
        camera: The camera of the images as they are processed.
        body: The body whose surface carries the patches.
        settings: Settings.
        first: Number of the first track; the tracks of this camera have numbers in steps of `step`.
        step: See `first`.
    """

    def __init__(self, camera: Camera, body: Body, settings: SurfaceTrackSettings, first: int, step: int):
        self.camera, self.settings = camera, settings
        self._next, self._step = first, step
        side = np.arange(-settings.half, settings.half + 1)
        self.window = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
        self.active = _Active.none(len(self.window))
        self.segment_of_face = tracked_segments(body)[body.face_segment]
        self.axes = segment_axes(body)
        self.turn = np.zeros(len(self.axes))
        self.step = np.zeros(len(self.axes))
        self.strength = np.zeros(len(self.axes))
        self.last: Floats | None = None

    def _corrected(self, posed: PosedBody) -> "_Turned":
        """Return the surface with each segment turned about its axis as its patches have shown so far."""
        if self.last is not None:
            change = posed.segment_rotation @ np.swapaxes(self.last, 1, 2)
            vector = Rotation.from_matrix(change).as_rotvec()
            axis = np.einsum("sij,sj->si", posed.segment_rotation, self.axes)
            twist = np.einsum("si,si->s", vector, axis)
            sudden = np.abs(twist) > self.settings.sudden
            self.turn = np.where(sudden, self.turn - twist + self.step, self.turn)
            self.step = np.where(sudden, self.step, twist)
        self.last = posed.segment_rotation
        return _Turned.of(posed, self.axes, self.turn)

    def advance(self, frame: int, posed: PosedBody, image: Image, mask: Mask, *, place: bool) -> TrackedPatches | None:
        """Track the patches in the next image, and place new ones; return the measured positions."""
        settings = self.settings
        grey = cv2.GaussianBlur(
            cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float32), (0, 0), settings.smoothing_px
        )
        self.strength[:] = 0.0
        turned = self._corrected(posed)
        view = turned.view(self.camera)
        label = np.full((self.camera.height, self.camera.width), -1)
        x, y = view.corner
        part = view.face
        label[y : y + part.shape[0], x : x + part.shape[1]] = np.where(part >= 0, self.segment_of_face[part], -1)
        inside = ((label >= 0) & mask).astype(np.uint8)
        depth_inside = cv2.distanceTransform(np.pad(inside, 1), cv2.DIST_L2, 3)[1:-1, 1:-1]
        label[depth_inside <= settings.border_px] = -1
        found = self._follow(frame, turned, posed, grey, label)
        if place:
            born = self._place(frame, turned, posed, grey, label, view)
            if found is not None and born is not None:
                return _joined(found, born)
            return born if found is None else found
        return found

    def _follow(self, frame: int, posed: "_Turned", unturned: PosedBody, grey: Floats, label: Integers) -> TrackedPatches | None:
        active, settings, size = self.active, self.settings, len(self.window)
        if len(active.tracks) == 0:
            return None
        flat = np.maximum(active.face, 0).reshape(-1)
        points = points_on_faces(posed.vertices, posed.body.faces, flat, active.barycentric.reshape(-1, 3))
        projected = np.empty_like(points)
        lens.project_points(self.camera.packed, points, projected)
        pixels = projected[:, :2].reshape(-1, size, 2)
        near = np.nan_to_num(np.rint(pixels), nan=-1.0).astype(int)
        border = ((near < 0) | (near >= self.camera.size)).any(2)
        near[border] = 0
        used = (active.face >= 0) & ~border & (label[near[..., 1], near[..., 0]] == active.segments[:, None])
        least = int(settings.least_share * size)
        match = match_patches(
            grey, pixels, used, active.grey, active.shift, search=settings.search, least_pixels=least,
            least_noise=settings.noise**2,
        )  # fmt: skip
        alike = match.noise <= 4.0 * settings.noise**2 + settings.unlike * match.contrast
        found = np.isfinite(match.shift[:, 0]) & alike
        measured = pixels[found, size // 2] + match.shift[found]
        self.active = active = replace(active, shift=match.shift)[found]
        information = match.information[found]
        away = self._correct(posed, information)
        kept = np.hypot(*away.T) <= settings.farthest_px
        self.active = replace(active, shift=away)[kept]
        if not kept.any():
            return None
        return self._batch(unturned, frame, self.active, measured[kept], information[kept])

    def _correct(self, posed: "_Turned", information: Floats) -> Floats:
        """Correct the turn of each segment by its patches, and return the patches' shifts (n, 2) that remain."""
        active, centre = self.active, len(self.window) // 2
        away = active.shift.copy()
        if len(away) == 0:
            return away
        points = posed.points(
            SkinPoints(face=active.face[:, centre], barycentric=active.barycentric[:, centre])
        )
        axis = np.einsum("nij,nj->ni", posed.segment_rotation[active.segments], self.axes[active.segments])
        _, by_point = self.camera.project_with_derivative(points)
        along = np.einsum("nij,nj->ni", by_point, np.cross(axis, points - posed.segment_origin[active.segments]))
        weight = with_more_noise(information, np.full(len(away), self.settings.sd_px**2))
        for segment in np.unique(active.segments):
            own = active.segments == segment
            strength = np.einsum("ni,nij,nj->", along[own], weight[own], along[own])
            pull = np.einsum("ni,nij,nj->", along[own], weight[own], away[own])
            change = pull / (strength + 1.0 / self.settings.turn_sd**2)
            self.strength[segment] = strength
            self.turn[segment] += change
            self.step[segment] += change
            away[own] -= change * along[own]
        return away

    def _batch(
        self, posed: PosedBody, frame: int, active: _Active, pixels: Floats, information: Floats
    ) -> TrackedPatches:
        settings = self.settings
        where = SkinPoints(face=active.anchor_face, barycentric=active.anchor_barycentric)
        reach = np.linalg.norm(posed.points(where) - self.camera.centre, axis=1)
        slip = settings.slip_m * self.camera.matrix[0, 0] / reach
        variance = settings.sd_px**2 + slip**2 + (settings.growth_px * (frame - active.born)) ** 2
        return TrackedPatches(
            camera=self.camera, tracks=active.tracks, where=where, segments=active.segments, tangents=active.tangents,
            pixels=pixels, information=with_more_noise(information, variance) / settings.repeated,
        )  # fmt: skip

    def _place(
        self, frame: int, posed: "_Turned", unturned: PosedBody, grey: Floats, label: Integers, view: View
    ) -> TrackedPatches | None:
        """Place patches where a segment has too few, and return their positions."""
        settings, half = self.settings, self.settings.half
        names = posed.body.skeleton.segment_names
        chosen: list[tuple[int, int, int]] = []
        strength: list[Floats] = []
        # Centres of the present patches, which new ones keep away from.
        taken = np.zeros((0, 2))
        if len(self.active.tracks):
            centre = len(self.window) // 2
            points = posed.points(
                SkinPoints(face=self.active.face[:, centre], barycentric=self.active.barycentric[:, centre])
            )
            taken = self.camera.project(points) + self.active.shift
        across, down = cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=1) / 2, cv2.Sobel(grey, cv2.CV_32F, 0, 1, ksize=1) / 2
        corner = np.array(view.corner)
        shown = (slice(corner[1], corner[1] + view.face.shape[0]), slice(corner[0], corner[0] + view.face.shape[1]))
        across, down, labels = across[shown], down[shown], label[shown]
        products = [np.ones_like(across), across * across, across * down, down * down]
        idle = 0.5 * settings.noise**2 * 0.8
        for segment in np.unique(label[label >= 0]):
            if not np.any(self.active.segments == segment):
                # Without patches nothing is known about the turn; the view changes with the next image.
                self.turn[segment] = 0.0
            own = labels == segment
            wanted = settings.per_trunk_segment if names[segment] in TRUNK else settings.per_segment
            wanted -= np.count_nonzero(self.active.segments == segment)
            if wanted <= 0:
                continue
            area = own.astype(np.float32)
            box = (2 * half + 1, 2 * half + 1)
            sums = [
                cv2.boxFilter(area * values, cv2.CV_32F, box, normalize=False, borderType=cv2.BORDER_CONSTANT)
                for values in products
            ]
            rows, columns = np.nonzero(own & (sums[0] >= settings.least_share * box[0] * box[1]))
            even = (rows % 2 == 0) & (columns % 2 == 0)
            rows, columns = rows[even], columns[even]
            count, xx, xy, yy = (values[rows, columns] for values in sums)
            rows, columns = rows + corner[1], columns + corner[0]
            inside = (
                (rows >= half + 1) & (columns >= half + 1) & (rows < grey.shape[0] - half - 1)
                & (columns < grey.shape[1] - half - 1)
            )  # fmt: skip
            rows, columns = rows[inside], columns[inside]
            count, xx, xy, yy = count[inside], xx[inside], xy[inside], yy[inside]
            if len(rows) == 0:
                continue
            face, barycentric = surface_at(view, posed, columns, rows)
            points = points_on_faces(posed.vertices, posed.body.faces, face, barycentric)
            normal = face_normals(posed, face)
            sight = self.camera.centre - points
            sight /= np.linalg.norm(sight, axis=1, keepdims=True)
            facing = np.einsum("ni,ni->n", normal, sight)
            axis = posed.segment_rotation[segment] @ self.axes[segment]
            moved = np.cross(axis, points - posed.segment_origin[segment])
            _, by_point = self.camera.project_with_derivative(points)
            along = np.einsum("nij,nj->ni", by_point, moved)
            noise = 2.0 * settings.noise**2 / 0.25
            matrix = np.stack([xx - idle * count, xy, xy, yy - idle * count], -1).reshape(-1, 2, 2) / noise
            matrix = with_more_noise(positive_part(matrix), np.full(len(matrix), settings.sd_px**2))
            # The information about the turn if the patch's place across the motion is unknown.
            unit = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
            other = np.stack([-unit[:, 1], unit[:, 0]], 1)
            nn = np.einsum("ni,nij,nj->n", other, matrix, other) + 1.0 / settings.farthest_px**2
            mn = np.einsum("ni,nij,nj->n", unit, matrix, other)
            mm = np.einsum("ni,nij,nj->n", unit, matrix, unit)
            turn = np.maximum(mm - mn**2 / nn, 0.0) * np.sum(along**2, 1)
            turn[~(facing >= settings.least_facing)] = 0.0
            if len(taken):
                gap = np.linalg.norm(np.stack([columns, rows], 1)[:, None] - taken[None], axis=2).min(1)
                turn[gap < 1.5 * half] = 0.0
            for _ in range(wanted):
                best = int(np.argmax(turn)) if len(turn) else 0
                if turn[best] < 1.0 / settings.turn_sd**2:
                    break
                chosen.append((int(segment), int(columns[best]), int(rows[best])))
                strength.append(matrix[best])
                turn[np.hypot(columns - columns[best], rows - rows[best]) < 1.5 * half] = 0.0
                taken = np.concatenate([taken, [[columns[best], rows[best]]]])
        if not chosen:
            return None
        segments = np.array([s for s, _, _ in chosen])
        centres = np.array([[x, y] for _, x, y in chosen])
        pixels = centres[:, None] + self.window
        columns, rows = pixels[..., 0], pixels[..., 1]
        part = label[rows, columns] == segments[:, None]
        face, barycentric = surface_at(view, posed, columns.ravel(), rows.ravel())
        face = np.where(part, face.reshape(part.shape), -1)
        seen_face, seen_barycentric = surface_at(view_of(unturned, self.camera), unturned, *centres.T)
        born = _Active(
            tracks=self._next + self._step * np.arange(len(segments)), face=face,
            barycentric=barycentric.reshape(*part.shape, 3), grey=grey[rows, columns].astype(float),
            anchor_face=np.maximum(seen_face, 0), anchor_barycentric=seen_barycentric, segments=segments,
            tangents=tangents_at(unturned, np.maximum(seen_face, 0), segments), born=np.full(len(segments), frame),
            shift=np.zeros((len(segments), 2)),
        )  # fmt: skip
        self._next += self._step * len(segments)
        # A pixel at the very edge of the body may be missed by its other turn.
        shown = seen_face >= 0
        born = born[shown]
        self.active = self.active.joined(born)
        return self._batch(unturned, frame, born, centres[shown].astype(float), np.array(strength)[shown])


@dataclass(frozen=True, eq=False)
class _Turned:
    """A posed body whose segments were turned about their axes, as `PosedBody` presents its surface."""

    body: Body
    segment_rotation: Floats
    segment_origin: Floats
    vertices: Floats

    @staticmethod
    def of(posed: PosedBody, axes: Floats, turn: Floats) -> "_Turned":
        body = posed.body
        rotation = posed.segment_rotation @ Rotation.from_rotvec(axes * turn[:, None]).as_matrix()
        vertices = blend_skin(
            body.vertices, body.vertex_segments, body.vertex_weights, body.joint_centres, rotation, posed.segment_origin
        )
        return _Turned(body, rotation, posed.segment_origin, vertices)

    def points(self, where: SkinPoints) -> Floats:
        return np.asarray(points_on_faces(self.vertices, self.body.faces, where.face, where.barycentric))

    def view(self, camera: Camera) -> View:
        projected = np.empty_like(self.vertices)
        lens.project_points(camera.packed, self.vertices, projected)
        return see(projected, self.body.faces, camera.size)


TRUNK = ("pelvis", "abdomen", "thorax", "head")
"""Segments of the trunk, and the head: they are large enough for more patches than a limb's segment."""
NOT_TRACKED = {"neck": "thorax", "left_clavicle": "thorax", "right_clavicle": "thorax"}
"""Segments too small to be tracked by themselves, and those to which their surface is added."""


def tracked_segments(body: Body) -> Integers:
    """Return for each segment (S,) the one to which patches on its surface are assigned; -1 for none."""
    names = body.skeleton.segment_names
    found = np.arange(len(names))
    for s, name in enumerate(names):
        if name.endswith(("toes", "hand", "foot")):
            found[s] = -1
        elif name in NOT_TRACKED:
            found[s] = names.index(NOT_TRACKED[name])
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


def surface_at(view: View, posed: "PosedBody | _Turned", columns: Integers, rows: Integers) -> tuple[Integers, Floats]:
    """Return face (n,) and barycentric coordinates (n, 3) of the surface at pixels of an image; -1 where there is none.

    The coordinates are those of the pixel's line of sight, with the perspective of the face.
    """
    height, width = view.face.shape
    i, j = rows - view.corner[1], columns - view.corner[0]
    inside = (i >= 0) & (j >= 0) & (i < height) & (j < width)
    face = np.where(inside, view.face[np.clip(i, 0, height - 1), np.clip(j, 0, width - 1)], -1).astype(np.int64)
    corners = view.projected[posed.body.faces[np.maximum(face, 0)]]
    place = np.stack([columns, rows], 1).astype(float)
    first, second, third = (corners[:, c, :2] - place for c in range(3))
    weights = np.stack([_cross(second, third), _cross(third, first), _cross(first, second)], 1) * corners[..., 2]
    total = weights.sum(1, keepdims=True)
    weights = np.where(np.abs(total) > 0, weights / np.where(total == 0, 1.0, total), 1.0 / 3.0)
    return face, np.ascontiguousarray(weights)


def _cross(first: Floats, second: Floats) -> Floats:
    return np.asarray(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])


def face_normals(posed: "PosedBody | _Turned", face: Integers) -> Floats:
    """Return the outward unit normals (n, 3) of faces."""
    a, b, c = (posed.vertices[posed.body.faces[face, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    return np.asarray(normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12))


def tangents_at(posed: "PosedBody | _Turned", face: Integers, segments: Integers) -> Floats:
    """Return two orthogonal directions (n, 3, 2) along faces, in the frames of segments."""
    normal = face_normals(posed, face)
    edge = posed.vertices[posed.body.faces[face, 1]] - posed.vertices[posed.body.faces[face, 0]]
    first = edge / np.maximum(np.linalg.norm(edge, axis=1, keepdims=True), 1e-12)
    both = np.stack([first, np.cross(normal, first)], -1)
    return np.asarray(np.swapaxes(posed.segment_rotation[segments], 1, 2) @ both)


def positive_part(matrices: Floats) -> Floats:
    """Return symmetric matrices (n, 2, 2) with their negative eigenvalues set to zero."""
    values, vectors = np.linalg.eigh(matrices)
    return np.asarray((vectors * np.maximum(values, 0.0)[:, None]) @ np.swapaxes(vectors, 1, 2))


def with_more_noise(information: Floats, variance: Floats) -> Floats:
    """Return the inverse of (information^-1 + variance), for matrices (n, 2, 2) that may be singular."""
    inner = np.eye(2) + variance[:, None, None] * information
    return np.asarray(np.linalg.solve(inner, information))


def _joined(first: TrackedPatches, second: TrackedPatches) -> TrackedPatches:
    """Join two batches of one camera."""
    both = [first, second]
    where = SkinPoints(
        face=np.concatenate([batch.where.face for batch in both]),
        barycentric=np.concatenate([batch.where.barycentric for batch in both]),
    )
    arrays = ("tracks", "segments", "tangents", "pixels", "information")
    return replace(
        first, where=where, **{name: np.concatenate([getattr(batch, name) for batch in both]) for name in arrays}
    )


def track_surface(
    cameras: Sequence[Camera],
    images: FrameImages,
    masks_of: Callable[[int], Sequence[Mask]],
    poses: Mapping[int, Pose],
    body: Body,
    settings: SurfaceTrackSettings | None = None,
) -> SurfaceTracks:
    """Track patches of the surface through a take, with the motion of a posed body as prediction.

    Args:
        cameras: C cameras of the images.
        images: Reads the images.
        masks_of: Returns the silhouettes of a frame, one (height, width) per camera.
        poses: Poses by frame.
        body: The body.
        settings: Settings.

    Returns:
        The tracks.
    """
    settings = settings or SurfaceTrackSettings()
    trackers = [_CameraTracker(camera, body, settings, c, len(cameras)) for c, camera in enumerate(cameras)]
    found: dict[int, list[TrackedPatches]] = {}
    turns: dict[int, Floats] = {}
    last = None
    for frame, pictures in images(sorted(poses)):
        posed, masks = PosedBody(body, poses[frame]), masks_of(frame)
        if last is not None and frame - last != 1:
            for tracker in trackers:
                tracker.active, tracker.last = _Active.none(len(tracker.window)), None
        posed.vertices  # noqa: B018  computed once, before the threads use it

        def one(task, frame=frame, posed=posed):
            tracker, picture, mask = task
            return tracker.advance(frame, posed, picture, mask, place=frame % settings.interval == 0 or last is None)

        before = np.array([tracker.turn for tracker in trackers])
        batches = list(map_in_two_threads(one, list(zip(trackers, pictures, masks, strict=True))))
        found[frame] = [batch for batch in batches if batch is not None]
        turns[frame] = _joint_turn(np.array([t.turn for t in trackers]) - before, np.array([t.strength for t in trackers]))
        last = frame
    return without_single(SurfaceTracks(found, body.skeleton.segment_names, turns))


def _joint_turn(changes: Floats, strength: Floats) -> Floats:
    """Return the mean (S,) of the cameras' changes (C, S), weighted by their information; NaN without any."""
    total = strength.sum(0)
    return np.where(total > 0, (changes * strength).sum(0) / np.where(total > 0, total, 1.0), np.nan)


TURNED_BY = {
    "head": ("neck_rotation", "head_rotation"),
    "left_forearm": ("left_pronation",),
    "right_forearm": ("right_pronation",),
}
"""Coordinates that turn a segment about its axis, where a jump between two answers is undone."""


def without_jumps(
    tracks: SurfaceTracks,
    poses: Mapping[int, Pose],
    body: Body,
    cost: Callable[[Mapping[int, Pose]], float],
    settings: SurfaceTrackSettings | None = None,
) -> dict[int, Pose]:
    """Undo jumps of a segment's turn between two answers to the same silhouettes.

    The tracks tell by how much the segment turned from frame to frame. The turn of the whole take follows from that of
    one frame; several are tried, and the one whose body agrees best with the silhouettes is returned.

    Args:
        tracks: Tracks of the surface, followed with these poses.
        poses: Poses by frame.
        body: The body.
        cost: Disagreement of poses by frame with the silhouettes.
        settings: Settings.

    Returns:
        Poses by frame; the given ones where no segment jumps.
    """
    settings = settings or SurfaceTrackSettings()
    poses, names = dict(poses), list(body.skeleton.coordinate_names)
    for segment, coordinates in TURNED_BY.items():
        if segment not in body.skeleton.segment_names:
            continue
        s = body.skeleton.segment_names.index(segment)
        frames = sorted(poses)
        change = np.array([tracks.turns[frame][s] for frame in frames])
        known = np.isfinite(change[1:])
        if len(known) == 0 or known.mean() < settings.least_linked:
            continue
        turn = np.cumsum(np.nan_to_num(np.append(0.0, change[1:])))
        if np.ptp(turn) < settings.jump:
            continue
        at = [names.index(c) - 6 for c in coordinates if c in names]
        levels = np.unique(np.round(np.quantile(turn, LEVELS) / (0.5 * settings.jump))) * 0.5 * settings.jump
        tried = [poses, *({f: _with_turn(poses[f], at, t - level) for f, t in zip(frames, turn, strict=True)} for level in levels)]
        costs = [cost(each) for each in tried]
        best = int(np.argmin(costs))
        if costs[best] < settings.clearly * costs[0]:
            poses = tried[best]
    return poses


COMPARED_FRAMES = 12
"""Number of frames in which several answers are compared. Chosen by hand."""


def outline_disagreement(
    levels: FrameLevels, body: Body, priors: Sequence[Observation]
) -> Callable[[Mapping[int, Pose]], float]:
    """Return a function that measures how far a body in given poses differs from the silhouettes.

    The poses of a few frames are fitted to the silhouettes first, so that the answers are compared at their best.

    Args:
        levels: Silhouettes.
        body: The body.
        priors: Joint limits and other priors of the fit.

    Returns:
        A function of the poses by frame: the mean number of differing pixels per frame.
    """
    schedule = Schedule(iterations=4, gate=(12.0, 5.0), scale=(6.0, 2.0), cosine=0.5, interior=True)

    def cost(poses: Mapping[int, Pose]) -> float:
        frames = sorted(poses)
        chosen = np.unique(np.linspace(0, len(frames) - 1, min(COMPARED_FRAMES, len(frames))).astype(int))

        def differing(task: tuple[PosedBody, SilhouetteLevel]) -> int:
            posed, level = task
            try:
                posed = fit_pose(posed, level.sightings, priors, schedule=schedule).posed
            except np.linalg.LinAlgError:
                pass
            return sum(
                int(np.count_nonzero(view_of(posed, camera).mask() != mask))
                for camera, mask in zip(level.cameras, level.masks, strict=True)
            )

        tasks = ((PosedBody(body, poses[frames[i]]), levels.at(frames[i])) for i in chosen)
        return float(np.mean(list(map_in_threads(differing, tasks))))

    return cost


LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95)
"""Quantiles of a segment's turn from which the whole take is continued. Chosen by hand."""


def _with_turn(pose: Pose, coordinates: Sequence[int], turn: float) -> Pose:
    angles = np.array(pose.angles)
    angles[list(coordinates)] += turn / len(coordinates)
    return replace(pose, angles=angles)


def without_single(tracks: SurfaceTracks) -> SurfaceTracks:
    """Remove tracks of one frame."""
    every = [batch.tracks for batches in tracks.by_frame.values() for batch in batches]
    names, counts = np.unique(np.concatenate([np.zeros(0, int), *every]), return_counts=True)
    lasting = names[counts > 1]
    kept = {
        frame: [chosen for batch in batches if len((chosen := _chosen(batch, np.isin(batch.tracks, lasting))).tracks)]
        for frame, batches in tracks.by_frame.items()
    }
    return replace(tracks, by_frame=kept)


def _chosen(batch: TrackedPatches, which: Mask) -> TrackedPatches:
    arrays = ("tracks", "segments", "tangents", "pixels", "information")
    where = SkinPoints(face=batch.where.face[which], barycentric=batch.where.barycentric[which])
    return replace(batch, where=where, **{name: getattr(batch, name)[which] for name in arrays})


@dataclass(frozen=True, eq=False)
class SurfaceTrackTerms:
    """Tracked patches as terms of one round of a refinement; see `marey.fit.recipes.sequence.LinkedTerms`."""

    tracks: SurfaceTracks
    """The tracks, followed with the poses of the last round."""
    local_sd: float
    """Standard deviation of a track's offset [m]."""
    shared: int = 0
    """Number of unknowns that all frames share: none."""

    def terms(self, frame: int, posed: PosedBody) -> tuple[Floats, Floats]:
        """Return equations of zeros: all are in `local`."""
        size = len(posed.body.skeleton) + len(posed.body.space)
        return np.zeros((size, size)), np.zeros(size)

    def local(self, frame: int, posed: PosedBody) -> LocalEquations | None:
        """Return the equations of a frame's patches by its pose and by the tracks' offsets."""
        batches = self.tracks.by_frame.get(frame, ())
        if not batches:
            return None
        degrees = len(posed.body.skeleton)
        pose, pull = np.zeros((degrees, degrees)), np.zeros(degrees)
        parts: list[tuple[Integers, Floats, Floats, Floats]] = []
        for batch in batches:
            residual, by_pose, by_offset = batch.derivatives(posed)
            weighted = batch.information * batch.weights(residual)[:, None, None]
            weighted_pose, force = weighted @ by_pose, (weighted @ residual[..., None])[..., 0]
            flat = by_pose.reshape(-1, degrees)
            pose += flat.T @ weighted_pose.reshape(-1, degrees)
            pull += flat.T @ force.ravel()
            back = np.swapaxes(by_offset, 1, 2)
            parts.append((
                batch.tracks, np.einsum("nid,nij->dnj", weighted_pose, by_offset), back @ weighted @ by_offset,
                (back @ force[..., None])[..., 0],
            ))  # fmt: skip
        pairs, by_pose, own, gradient = zip(*parts, strict=True)
        return LocalEquations(
            np.concatenate(pairs), pose, pull, np.concatenate(by_pose, axis=1), np.concatenate(own),
            np.concatenate(gradient),
        )  # fmt: skip

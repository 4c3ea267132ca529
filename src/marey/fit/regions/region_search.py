"""Search among poses by the classes of the pixels that the body covers, where no silhouettes are known."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np

from marey.arrays import Floats, Integers, Mask, freeze_fields
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.skeleton import COLOUR_PARTS, Skeleton
from marey.body.articulation.surface import Body
from marey.cameras.camera import Camera
from marey.fit.regions.border_kernels import fit_borders
from marey.fit.regions.region_kernels import (
    angle_costs,
    climb_regions,
    count_words,
    score_chain,
    score_regions,
    score_shared_words,
)
from marey.fit.search import placements
from marey.fit.search.search import limb_directions
from marey.fit.solver.threads import map_in_threads

PARTS = len(COLOUR_PARTS)
"""Number of parts of the body that have colours of their own."""


THINNED_CELL = 0.08
"""Edge of the cells in which one vertex of a segment remains [m]: scores take half the time, and the drawn area is 4 to
6 % smaller. With 0.05 m it takes 0.7 of the time, and the area is 2 to 3 % smaller."""

NO_EVIDENCE = 255
"""Word of a pixel that is no evidence."""
LARGEST_CHAIN = 0.35
"""Largest share of the faces that a chain of segments moves, of which the other faces are drawn only once while its
coordinates change. An arm moves 0.19 and a leg 0.32 of them."""


@dataclass(frozen=True, kw_only=True)
class RegionSettings:
    """Settings of the score of a region.

    Fields without a source were chosen by hand; results were not measured against other values.
    """

    own_share: float = 0.5
    """Share of a camera's own words in the density of a part; the rest are those of all cameras."""
    unknown_share: float = 0.03
    """Share of unknown words in a density."""
    ring_share: float = 0.7
    """Share of the words near the body in the density of the background; the rest are those of the whole image."""
    ring: float = 0.35
    """Width of the surroundings of the body, as a share of its height in the image."""
    own_removed: float = 0.8
    """Share of the words inside the drawn body that does not count for its surroundings."""
    largest_ratio: float = 3.0
    """Limit of the log-likelihood ratio of a pixel."""
    habit_weight: float = 0.004
    """Weight of the squared deviation of an angle from the usual one [m2]. From the measured recipe for rooms without a
    plate; others were not compared."""
    excess_sd: float = float(np.deg2rad(3.0))
    """Standard deviation of an angle's excess over its limit [rad], as in `JointLimits`."""
    reaches: tuple[int, ...] = (5, 4, 3, 3, 2, 2)
    """Half lengths of the lines across borders in each step of a fit [px]. With seven other courses of three to seven
    steps from 8 to 2 px, the mean score of a track of `jacks` is between 0.8 % lower and 0.3 % higher."""
    metres: float = 0.3
    """Change of a position for a change of an angle while climbing [m/rad]. From the same recipe."""


REGION_DEFAULTS = RegionSettings()
"""Default settings of the score of a region."""


@dataclass(frozen=True, eq=False)
class RegionImages:
    """The reduced images of one frame, as classes of pixels, padded to a common size."""

    words: Integers
    """(C, h, w) uint8 colour word of each pixel, see `ColourWords`; a larger number where the pixel is no evidence."""
    evidence: Floats
    """(C, h, w) float32 log-likelihood ratio of person and background from other evidence, for example motion."""

    def __post_init__(self) -> None:
        freeze_fields(self, "words", dtype=np.uint8)
        freeze_fields(self, "evidence", dtype=np.float32)

    def without(self, covered: Mask) -> "RegionImages":
        """Return the images in which covered pixels (C, h, w) are no evidence."""
        return RegionImages(np.where(covered, NO_EVIDENCE, self.words), np.where(covered, 0, self.evidence))


@dataclass(frozen=True, eq=False)
class NearAngles:
    """Predicted joint angles of a pose."""

    angles: Floats
    """(D - 6,) [rad]."""
    spread: Floats
    """(D - 6,) standard deviations of the changes from them [rad]."""


@dataclass(frozen=True, eq=False)
class RegionSearch:
    """Scores, and steps of a search, in reduced images.

    Args:
        cameras: C cameras of the reduced images.
        count: Number of colour words K.
        settings: Settings of the score.
    """

    cameras: tuple[Camera, ...]
    count: int
    settings: RegionSettings = REGION_DEFAULTS
    _packed: tuple[Floats, Integers, Integers, Floats] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        packed = (
            np.array([camera.packed for camera in self.cameras]),
            np.array([camera.width for camera in self.cameras]),
            np.array([camera.height for camera in self.cameras]),
            np.array([camera.matrix[0, 0] for camera in self.cameras]),
        )
        object.__setattr__(self, "_packed", packed)

    def scores(self, body: Body, poses: Sequence[Pose], images: RegionImages, table: Floats) -> Floats:
        """Return the scores (n,) of poses [nat m2]: log-likelihood ratios of their regions, less the angles' costs."""
        rotations, translations, angles = _stacked(poses)
        regions = score_regions(
            _rest(body), rotations, translations, angles, self._views(images), _padded(table)
        )  # fmt: skip
        return np.asarray(regions - self._angle_costs(body.skeleton, angles))

    def _angle_costs(self, skeleton: Skeleton, angles: Floats) -> Floats:
        """Return the costs (n,) of joint angles (n, D - 6) [nat m2]."""
        free = _change_cost(skeleton, None)
        return np.asarray(angle_costs(angles, self._habit(skeleton), free, self.settings.habit_weight))

    def areas(self, body: Body, poses: Sequence[Pose], images: RegionImages, *, without: Sequence[str] = ()) -> Floats:
        """Return the area of each word in each part of drawn poses (n, C, P, K) [m2].

        Args:
            body: The body.
            poses: The poses.
            images: The images.
            without: Names of the segments whose pixels are not counted.
        """
        rest = _rest(body)
        if without:
            left_out = np.isin(body.face_segment, [body.skeleton.segment(name) for name in without])
            rest = (*rest[:-1], np.where(left_out, PARTS, body.face_colour_part))
        areas = count_words(rest, *_stacked(poses), self._views(images), PARTS + 1, self.count + 1)
        return np.asarray(areas[:, :, :PARTS, :-1])

    def shared_scores(
        self, body: Body, poses: Sequence[Pose], images: RegionImages, *, least_area: float, other_share: float
    ) -> Floats:
        """Return the scores (n,) of poses by the words that the cameras have in common, and by other evidence [nat m2].

        Args:
            body: The body.
            poses: The poses.
            images: The images.
            least_area: Area that is added to that of each word in the other cameras [m2].
            other_share: Share of the other cameras' words in the density of a part; the rest are unknown words.
        """
        rotations, translations, angles = _stacked(poses)
        shown = [images.words[c, : camera.height, : camera.width] for c, camera in enumerate(self.cameras)]
        counts = np.array([self.counts(words) for words in shown]) + 1.0
        whole = np.log(counts / counts.sum(axis=1, keepdims=True))
        found = score_shared_words(
            _rest(body), rotations, translations, angles, self._views(images), PARTS, whole, least_area, other_share
        )
        return np.asarray(found - self._angle_costs(body.skeleton, angles))

    def fit(
        self, posed: PosedBody, images: RegionImages, table: Floats, near: NearAngles | None = None, *,
        reaches: Sequence[int] | None = None,
    ) -> tuple[float, Pose]:  # fmt: skip
        """Improve a pose by moving the borders of all parts to where the classes of the pixels change.

        Args:
            posed: The posed body.
            images: The images.
            table: See `word_table`.
            near: A prediction.
            reaches: Half lengths of the lines across borders in each step [px]; by default those of the settings.

        Returns:
            The score [nat m2] less the cost of a change from the prediction, and the pose. The score is not below that
            of the given pose.
        """
        pose, skeleton, settings = posed.pose, posed.body.skeleton, self.settings
        score, rotation, translation, angles = fit_borders(
            _rest(posed.body), np.array(pose.rotation), np.array(pose.translation), np.array(pose.angles),
            self._views(images), _padded(table), self._habit(skeleton), _change_cost(skeleton, near),
            settings.habit_weight, np.array(reaches or settings.reaches), np.array(posed.body.face_segment),
        )  # fmt: skip
        return float(score), Pose(translation, rotation, angles)

    def climb(
        self, posed: PosedBody, images: RegionImages, table: Floats, steps: Sequence[float], coordinates: Integers
    ) -> tuple[float, Pose]:  # fmt: skip
        """Improve a pose by changes of single coordinates; for the few ones of a limb, this is faster than `fit`.

        Args:
            posed: The posed body.
            images: The images.
            table: See `word_table`.
            steps: Sizes of the changes, from large to small [rad].
            coordinates: The coordinates that are changed, the root's six first.

        Returns:
            The score [nat m2], and the pose.
        """
        pose, skeleton, settings = posed.pose, posed.body.skeleton, self.settings
        score, rotation, translation, angles = climb_regions(
            _rest(posed.body), _chains(posed.body), np.array(pose.rotation), np.array(pose.translation),
            np.array(pose.angles), self._views(images), _padded(table), self._habit(skeleton),
            _change_cost(skeleton, None), settings.habit_weight, np.array(steps), settings.metres,
            np.array(coordinates, np.int64),
        )  # fmt: skip
        return float(score), Pose(translation, rotation, angles)

    def limbs(
        self, posed: PosedBody, images: RegionImages, table: Floats, *, directions: int,
        only: Sequence[str] = placements.SEARCHED_LIMBS,
    ) -> Pose:  # fmt: skip
        """Search each limb on its own in many placements, and return the pose with those that raise the score.

        Args:
            posed: The posed body.
            images: The images.
            table: See `word_table`.
            directions: Number of directions in which a limb is searched.
            only: Names of the limbs that are searched, in this order as far as the body has them.
        """
        pose = posed.pose
        best = float(self.scores(posed.body, [pose], images, table)[0])
        limbs = placements.limbs_of(posed.body.skeleton)
        for limb in (limbs[name] for name in only if name in limbs):
            placed = replace(posed, pose=pose)
            tries, scores = self.limb_tries(placed, images, table, directions=directions, limb=limb)
            i = int(np.argmax(scores))
            if scores[i] > best:
                best, pose = float(scores[i]), replace(pose, angles=tries[i])
        return pose

    def limb_tries(
        self, posed: PosedBody, images: RegionImages, table: Floats, *, directions: int,
        limb: placements.LimbCoordinates,
    ) -> tuple[Floats, Floats]:  # fmt: skip
        """Place a limb in many ways.

        Args:
            posed: The posed body.
            images: The images.
            table: See `word_table`.
            directions: Number of directions of the limb.
            limb: The limb.

        Returns:
            The joint angles (n, D - 6) of the poses [rad], and the scores (n,) of the poses as in `scores`.
        """
        body = posed.body
        arm, leg = limb_directions(body)
        side = np.array([1.0 if limb.name.startswith("left") else -1.0, 1.0, 1.0])
        rest = (arm if "arm" in limb.name else leg) * side
        placed = placements.limb_placements(body.skeleton, limb, rest, count=directions)
        tries = np.tile(posed.pose.angles, (len(placed), 1))
        tries[:, limb.columns] = placed
        segment = body.skeleton.segment(limb.segments[0])
        return tries, self._limb_scores(posed, segment, tries, images, table)

    def _limb_scores(
        self, posed: PosedBody, segment: int, angles: Floats, images: RegionImages, table: Floats
    ) -> Floats:
        """Return the same as `scores`, for joint angles (n, D - 6) that differ from a segment outwards only."""
        body, root = posed.body, posed.pose
        regions = score_chain(
            _rest(body), segment, _chains(body), np.array(root.rotation), np.array(root.translation), angles,
            self._views(images), _padded(table),
        )  # fmt: skip
        return np.asarray(regions - self._angle_costs(body.skeleton, angles))

    def word_table(
        self, learned: Floats, posed: PosedBody | None, images: RegionImages, *, whole_share: float
    ) -> Floats:
        """Return the log-likelihood ratio of each word in each part and in the surroundings of a posed body.

        Args:
            learned: (C, P, K) areas of the words in the parts, see `areas`, summed over frames.
            posed: The body about which the surroundings lie; None for the whole images, if its place is not known.
            images: The images.
            whole_share: Share of the words of the whole body in the density of a part.

        Returns:
            (C, P, K) log-likelihood ratios.
        """
        inside = self.part_densities(learned, whole_share=whole_share)
        outside = self.surroundings(posed, images)
        limit = self.settings.largest_ratio
        return np.asarray(np.clip(np.log(inside) - np.log(outside)[:, None], -limit, limit))

    def part_densities(self, learned: Floats, *, whole_share: float) -> Floats:
        """Return the densities of the words in each part (C, P, K) from their areas; see `word_table`."""
        settings = self.settings
        mixed = settings.own_share * _shares(learned) + (1 - settings.own_share) * _shares(learned.sum(0))
        whole = mixed.mean(axis=1, keepdims=True)
        known = (1 - whole_share - settings.unknown_share) * mixed + whole_share * whole
        return np.asarray(known + settings.unknown_share / self.count)

    def own_areas(self, areas: Floats, around: Floats, *, whole_share: float) -> Floats:
        """Return areas of words without what belongs to the surroundings.

        A drawn body that is too large also covers the surroundings, whose words then seem to be those of the person.
        Each word in a part counts with the probability that it is the part's. With this probability estimated in three
        rounds instead of one, the joints are 8.9 instead of 9.5 mm off in `reach`, and 23.7 instead of 22.6 mm in
        `office`.

        Args:
            areas: (C, P, K) areas of the words in the parts, see `areas`, summed over frames.
            around: (C, K) densities of the words in the surroundings, see `surroundings`.
            whole_share: See `word_table`.

        Returns:
            (C, P, K).
        """
        inside = self.part_densities(areas, whole_share=whole_share)
        return areas * (inside / (inside + around[:, None]))

    def surroundings(self, posed: PosedBody | None, images: RegionImages) -> Floats:
        """Return the density of the words about a posed body, or in the whole images (C, K); see `word_table`."""
        settings = self.settings
        drawn = None if posed is None else self.areas(posed.body, [posed.pose], images)[0].sum(axis=1)
        densities = np.empty((len(self.cameras), self.count))
        for c, camera in enumerate(self.cameras):
            words = images.words[c, : camera.height, : camera.width]
            whole = self.counts(words)
            everywhere = whole / max(1.0, float(whole.sum()))
            ring = everywhere
            if posed is not None and drawn is not None:
                ring = self._ring_density(posed.vertices, drawn[c], words, camera)
            other = 1 - settings.ring_share - settings.unknown_share
            densities[c] = settings.ring_share * ring + other * everywhere + settings.unknown_share / self.count
        return densities

    def _ring_density(self, vertices: Floats, drawn: Floats, words: Integers, camera: Camera) -> Floats:
        """Return the density of the words (K,) about a body, mostly without those in its drawn region (K,) [m2]."""
        pixels = camera.project(vertices)
        near = words[self._ring(pixels[np.isfinite(pixels).all(axis=1)], camera)]
        area = (np.linalg.norm(vertices.mean(axis=0) - camera.centre) / camera.matrix[0, 0]) ** 2
        around = np.maximum(self.counts(near) - self.settings.own_removed * drawn / area, 0.0)
        return np.asarray(around / max(float(around.sum()), 1.0))

    def counts(self, words: Integers) -> Floats:
        """Return the number of pixels of each word (K,) in a part of an image, without those that are no evidence."""
        return np.asarray(np.bincount(np.minimum(words, self.count).ravel(), minlength=self.count + 1)[:-1], float)

    def _ring(self, pixels: Floats, camera: Camera) -> tuple[slice, slice]:
        """Return the rows and columns of an image about the pixels (n, 2) of a body."""
        if len(pixels) == 0:
            return slice(0, 0), slice(0, 0)
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        margin = self.settings.ring * max(high[1] - low[1], 8.0)
        x0, y0 = np.clip(low - margin, 0, camera.size).astype(int)
        x1, y1 = np.clip(high + margin + 1, 0, camera.size).astype(int)
        return slice(y0, y1), slice(x0, x1)

    def _views(self, images: RegionImages) -> tuple[Any, ...]:
        return (*self._packed, np.minimum(images.words, np.uint8(self.count)), images.evidence)

    def _habit(self, skeleton: Skeleton) -> tuple[Any, ...]:
        mean, sd = skeleton.habit
        low, high = skeleton.limits.T
        return np.array(mean), np.array(sd), np.array(low), np.array(high), 1.0 / self.settings.excess_sd


def _change_cost(skeleton: Skeleton, near: NearAngles | None) -> tuple[Floats, Floats]:
    """Return predicted angles, and the reciprocals of the standard deviations of the changes from them (D - 6,)."""
    if near is None:
        return np.zeros(len(skeleton) - 6), np.zeros(len(skeleton) - 6)
    return np.array(near.angles), 1.0 / near.spread


def thinned(body: Body, *, cell: float = THINNED_CELL) -> Body:
    """Return a body with fewer vertices and faces, of the same skeleton and shape parameters.

    Of the vertices of a segment in each cell of a regular grid, at rest, the one nearest to their mean remains.

    Args:
        body: The body.
        cell: Edge of the cells [m].

    Returns:
        The body with fewer vertices, for images in which a cell covers one or two pixels.
    """
    owner = body.vertex_segments[np.arange(len(body.vertices)), body.vertex_weights.argmax(axis=1)]
    keys = np.column_stack([owner, np.floor(body.vertices / cell).astype(np.int64)])
    _, group = np.unique(keys, axis=0, return_inverse=True)
    group = group.reshape(-1)
    count = np.bincount(group)
    mean = np.stack([np.bincount(group, body.vertices[:, i]) for i in range(3)], axis=1) / count[:, None]
    away = np.linalg.norm(body.vertices - mean[group], axis=1)
    order = np.lexsort((away, group))
    kept = order[np.unique(group[order], return_index=True)[1]]
    faces = group[body.faces]
    distinct = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    space = replace(body.space, vertex_mean=body.space.vertex_mean[kept], vertex_modes=body.space.vertex_modes[:, kept])
    return replace(
        body, space=space, faces=faces[distinct], vertex_segments=body.vertex_segments[kept],
        vertex_weights=body.vertex_weights[kept], outlined=None, metaballs=None,
    )  # fmt: skip


def learned_areas(
    search: RegionSearch, body: Body, poses: Mapping[int, Pose], images: Mapping[int, RegionImages]
) -> dict[int, Floats]:
    """Return the area of each word in each part (C, P, K) [m2] by frame, of frames with a pose and images."""
    frames = [frame for frame in poses if frame in images]
    areas = map_in_threads(lambda frame: search.areas(body, [poses[frame]], images[frame])[0], frames)
    return dict(zip(frames, areas, strict=True))


def _padded(table: Floats) -> Floats:
    """Return the log-likelihood ratios of words with one more, for pixels that are no evidence."""
    return np.concatenate([table, np.zeros((*table.shape[:-1], 1))], axis=-1).astype(np.float32)


def _shares(areas: Floats) -> Floats:
    return np.asarray(areas / np.maximum(areas.sum(axis=-1, keepdims=True), 1e-9))


def _stacked(poses: Sequence[Pose]) -> tuple[Floats, Floats, Floats]:
    return (
        np.array([pose.rotation for pose in poses]),
        np.array([pose.translation for pose in poses]),
        np.array([pose.angles for pose in poses]),
    )


def _rest(body: Body) -> tuple[Any, ...]:
    return (
        *body.packed, body.joint_centres, body.vertices, body.vertex_segments, body.vertex_weights, body.faces,
        body.face_colour_part,
    )  # fmt: skip


@lru_cache(maxsize=4)
def _chains(body: Body) -> tuple[Integers, Mask, Mask]:
    """Return which chain of segments each coordinate belongs to, and what the chains move.

    A chain consists of a segment and all segments that it carries; it has the number of that segment. A coordinate
    belongs to the largest chain, up to `LARGEST_CHAIN`, that contains its segment, so that a limb is one chain.

    Returns:
        (D,) number of each coordinate's chain; (S, T) faces and (S, V) vertices that each chain moves.
    """
    skeleton, count = body.skeleton, len(body.skeleton.segment_names)
    carried = np.eye(count, dtype=bool)
    for k in range(count - 1, 0, -1):
        carried[skeleton.parents[k]] |= carried[k]
    vertices: Mask = np.ascontiguousarray((carried[:, body.vertex_segments] & (body.vertex_weights > 0)).any(axis=-1))
    faces: Mask = np.ascontiguousarray(vertices[:, body.faces].any(axis=-1))
    share = faces.mean(axis=1)
    chain = np.arange(count)
    for k in range(1, count):
        parent = skeleton.parents[k]
        chain[k] = chain[parent] if share[chain[parent]] <= LARGEST_CHAIN else k
    own = chain[skeleton.coordinate_segment]
    return np.concatenate([np.zeros(6, np.int64), own]), faces, vertices

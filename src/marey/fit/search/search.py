"""Steps of a search among many poses: score, fit, placement of limbs, exchange of limbs, and reversal of the facing."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.fit.search import cover, placements
from marey.fit.search.levels import SilhouetteLevel
from marey.fit.solver.body_solver import fit_body
from marey.fit.solver.pose_solver import Schedule, fit_pose
from marey.fit.solver.threads import map_in_threads
from marey.geometry import rotations
from marey.observations.observation import Observation
from marey.observations.prior import Habit, JointLimits, ShapePrior


@dataclass(frozen=True, eq=False)
class Candidate:
    """A body in a pose, and its agreement with the silhouettes."""

    posed: PosedBody
    score: float
    """Mean intersection over union, minus the cost of an unlikely posture."""


@dataclass(frozen=True, kw_only=True)
class StartSettings:
    """Extent of the search for a start.

    "Study" marks values of the preliminary study on rendered takes with the true silhouettes, whose starts were right
    in 82 to 91 % of single frames; other values were not compared, and its scripts were not kept. The other defaults
    were chosen by hand; results were not measured against other values.
    """

    yaws: int = 12
    """Number of headings, evenly spaced, in which the whole postures are tried. Study."""
    kept: int = 12
    """Number of candidates whose limbs are searched. Study."""
    finalists: int = 5
    """Number of candidates that are fitted at the larger size. Study."""
    arm_directions: int = 60
    """Number of directions in which an arm is tried."""
    leg_directions: int = 50
    """Number of directions in which a leg is tried."""
    upside_down_below: float = 0.72
    """Score below which postures with the head down are searched, too."""
    good: float = 0.93
    """Score at which no other frame is tried."""
    prior_cost: float = 3e-4
    """Decrease of the score per unit of the posture's prior cost. Study."""
    coarse_height: float = 80.0
    """Height of the person in the images of the search [px]."""
    fine_height: float = 160.0
    """Height of the person in the images of the final fit [px]."""


class Search:
    """Steps of the search at one level.

    Args:
        level: Silhouettes.
        settings: Extent of the search.
    """

    def __init__(self, level: SilhouetteLevel, settings: StartSettings):
        self.level = level
        self.settings = settings
        self.packed = level.packed()

    def score(self, body: Body, poses: Sequence[Pose]) -> Floats:
        """Return the mean intersection over union of poses (n,)."""
        return np.asarray(cover.score_poses(
            *_rest(body), body.faces,
            np.array([pose.rotation for pose in poses]), np.array([pose.translation for pose in poses]),
            np.array([pose.angles for pose in poses]), *self.packed,
        ))  # fmt: skip

    def judge(self, posed: PosedBody) -> Candidate:
        """Return a posed body with its score."""
        cost = sum(float(np.sum(prior.whiten(posed).residual ** 2)) for prior in (Habit(), JointLimits()))
        overlap = float(self.score(posed.body, [posed.pose])[0])
        return Candidate(posed, overlap - self.settings.prior_cost * cost)

    def fit(self, posed: PosedBody, *, numbers: int, iterations: int, gate: tuple[float, float]) -> Candidate:
        """Fit the pose and at most `numbers` leading shape parameters; a body without any keeps its shape."""
        numbers = min(numbers, len(posed.body.space))
        schedule = Schedule(iterations=iterations, gate=gate, scale=(10.0, 3.0) if iterations > 5 else (6.0, 3.0))
        others: list[Observation] = [JointLimits(), Habit(share=0.03)]
        if numbers == 0:
            return self.judge(fit_pose(posed, self.level.sightings, others, schedule=schedule).posed)
        narrowed = _narrow(posed, numbers)
        others.append(ShapePrior())
        fitted = fit_body(narrowed, self.level.sightings, others, schedule=schedule)
        return self.judge(replace(fitted, body=_widen(fitted.body, posed.body)))

    def coarse_poses(self, body: Body, hull: Floats, ways: Sequence[Floats]) -> list[PosedBody]:
        """Compare the whole postures in all directions, and return the two best of each direction."""
        arm, leg = limb_directions(body)
        postures = placements.whole_postures(body.skeleton, arm, leg)
        centre = hull.mean(0)
        centroids = _centroids(body, postures)

        def best_of(turn: Floats) -> list[PosedBody]:
            poses = [Pose(centre - turn @ c, turn, a) for c, a in zip(centroids, postures, strict=True)]
            return [PosedBody(body, poses[i]) for i in np.argsort(-self.score(body, poses))[:2]]

        yaws = np.arange(self.settings.yaws) * 2 * np.pi / self.settings.yaws
        turns = [up @ rotations.about(np.array([0.0, 0.0, 1.0]), yaw) for up in ways for yaw in yaws]
        return list(chain.from_iterable(map_in_threads(best_of, turns)))

    def limbs(self, candidate: Candidate, *, numbers: int, passes: int = 1) -> Candidate:
        """Search every limb on its own, then exchange both arms and both legs; keep changes that raise the score.

        Args:
            candidate: The body in a pose.
            numbers: Number of leading shape parameters that are fitted.
            passes: Number of repetitions of all steps. A step that has not changed the candidate is repeated only after
                another step has changed it.
        """
        limbs = placements.limbs_of(candidate.posed.body.skeleton)
        pairs = [kind for kind in ("arm", "leg") if f"left_{kind}" in limbs and f"right_{kind}" in limbs]
        settled: dict[str, Candidate] = {}
        for _ in range(passes):
            for name in (*limbs, *pairs):
                before = candidate
                if settled.get(name) is before:
                    continue
                placed = [exchanged(before.posed, name)] if name in pairs else self.limb_proposals(before.posed, name)
                for posed in placed:
                    candidate = self.better(candidate, posed, numbers)
                if candidate is before:
                    settled[name] = candidate
        return candidate

    def better(self, candidate: Candidate, posed: PosedBody, numbers: int) -> Candidate:
        """Fit a proposal, and return it if its score is higher."""
        fitted = self.fit(posed, numbers=numbers, iterations=5, gate=(16.0, 8.0))
        return fitted if fitted.score > candidate.score + 0.002 else candidate

    def limb_proposals(self, posed: PosedBody, name: str, *, count: int = 2) -> list[PosedBody]:
        """Return the most promising distinct placements of a limb."""
        body, pose = posed.body, posed.pose
        limb = placements.limb_of(body.skeleton, name)
        arm, leg = limb_directions(body)
        side = np.array([1.0 if name.startswith("left") else -1.0, 1.0, 1.0])
        arms = "arm" in name
        directions = self.settings.arm_directions if arms else self.settings.leg_directions
        angles = placements.limb_placements(body.skeleton, limb, (arm if arms else leg) * side, count=directions)
        own = np.isin(body.face_segment, [body.skeleton.segment(s) for s in limb.segments])
        scores = cover.score_limb(
            *_rest(body), body.faces[own], body.faces[~own], np.unique(body.faces[own]),
            pose.rotation, pose.translation, pose.angles, limb.columns, angles, *self.packed,
        )  # fmt: skip
        proposals: list[Floats] = []
        for i in np.argsort(-scores):
            if all(np.abs(angles[i] - other).max() > 0.6 for other in proposals):
                proposals.append(angles[i])
            if len(proposals) == count:
                break
        moved = []
        for proposal in proposals:
            changed = np.array(pose.angles)
            changed[limb.columns] = proposal
            moved.append(replace(posed, pose=Pose(pose.translation, pose.rotation, changed)))
        return moved


def exchanged(posed: PosedBody, kind: str) -> PosedBody:
    """Exchange the angles of the left and right limbs of a kind ("arm" or "leg")."""
    angles = np.array(posed.pose.angles)
    left, right = (placements.limb_of(posed.body.skeleton, f"{side}_{kind}").columns for side in ("left", "right"))
    angles[left], angles[right] = posed.pose.angles[right], posed.pose.angles[left]
    return replace(posed, pose=Pose(posed.pose.translation, posed.pose.rotation, angles))


def limb_directions(body: Body) -> tuple[Floats, Floats]:
    """Return the unit directions (3,) of the left arm and the left leg at rest."""
    at = {name: body.joint_centres[k] for k, name in enumerate(body.skeleton.segment_names)}
    arm = at["left_hand"] - at["left_upperarm"]
    leg = at["left_foot"] - at["left_thigh"]
    return arm / np.linalg.norm(arm), leg / np.linalg.norm(leg)


def _rest(body: Body) -> tuple[Any, ...]:
    packed = body.packed
    return (*packed, body.joint_centres, body.vertices, body.vertex_segments, body.vertex_weights)


def _centroids(body: Body, postures: Floats) -> Floats:
    rest = [PosedBody(body, Pose(np.zeros(3), np.eye(3), angles)) for angles in postures]
    skin = np.unique(body.faces)
    return np.array([posed.vertices[skin].mean(0) for posed in rest])


def standing_ways(hull: Floats) -> list[Floats]:
    """Return rotations (3, 3) from upright to the directions in which a body may stand: upright, and along the hull."""
    spread = np.linalg.svd(hull - hull.mean(0), full_matrices=False)
    upright = np.array([0.0, 0.0, 1.0])
    axis = spread[2][0] * (1 if spread[2][0, 2] >= 0 else -1)
    lean = np.degrees(np.arccos(np.clip(axis @ upright, -1, 1)))
    ways = [upright]
    if lean > 8:
        ways.append(axis)
    if lean > 25:
        middle = axis + upright
        ways.append(middle / np.linalg.norm(middle))
    if lean > 60:
        # The person lies: the head may be at either end.
        ways.append(-axis)
    return [placements.shortest_turn(upright, way[None])[0] for way in ways]


def _narrow(posed: PosedBody, numbers: int) -> PosedBody:
    """Keep only the leading shape parameters, or leading directions of them, free; the others are fixed."""
    body, whole = posed.body, posed.body.space.by_rank
    steps = np.linalg.solve(body.space.leading.T, body.numbers)
    fixed = np.arange(len(whole)) >= numbers
    space = replace(whole, prior_mean=np.where(fixed, steps, whole.prior_mean)).keep(range(numbers))
    return replace(posed, body=body.within(space, steps[:numbers]))


def _widen(narrow: Body, wide: Body) -> Body:
    """Return the whole body with the numbers that were free."""
    leading = wide.space.leading
    steps = np.linalg.solve(leading.T, wide.numbers)
    steps[: len(narrow.numbers)] = narrow.numbers
    return wide.with_numbers(leading.T @ steps)


def turned_about(posed: PosedBody) -> Pose:
    """Reverse the facing of a pose with nearly the same silhouettes: front becomes back, left becomes right.

    Every segment takes the place of its counterpart on the other side, turned by half a turn about its own long axis:
    R'_left = R_right diag(-1, -1, 1).
    """
    segments, _ = posed.body.skeleton.mirrored()
    half_turn = np.diag([-1.0, -1.0, 1.0])
    wanted = posed.segment_rotation[segments] @ half_turn
    return pose_from_rotations(posed.body, posed.pose.translation, wanted)


def pose_from_rotations(body: Body, translation: Floats, wanted: Floats) -> Pose:
    """Find the joint angles within the limits whose segments come nearest to given rotations (S, 3, 3)."""
    skeleton = body.skeleton
    angles = np.zeros(len(skeleton) - 6)
    reached = np.array(wanted)
    for k, parent in enumerate(skeleton.parents):
        if parent < 0:
            continue
        own = np.flatnonzero(skeleton.coordinate_segment == k)
        if len(own) == 0:
            reached[k] = reached[parent]
            continue
        local = reached[parent].T @ wanted[k]
        angles[own] = _joint_angles(skeleton.axes[own], skeleton.limits[own], local)
        turn = np.eye(3)
        for i in own:
            turn = turn @ rotations.about(skeleton.axes[i], angles[i])
        reached[k] = reached[parent] @ turn
    return Pose(translation, wanted[0], angles)


def _joint_angles(axes: Floats, limits: Floats, local: Floats) -> Floats:
    angles = placements.ball_angles(axes, local) if len(axes) == 3 else axes @ rotations.log(local)
    return np.clip(angles, limits[:, 0], limits[:, 1])

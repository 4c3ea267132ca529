"""Metaballs of a generic person, the shape parameters of people, and their skin as a body that can be fitted."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from importlib.resources import files
from typing import Literal

import numpy as np

from marey.arrays import Floats, Integers, freeze_fields
from marey.body.articulation.skeleton import Skeleton
from marey.body.articulation.surface import Body, ShapeSpace
from marey.body.metaballs.metaballs import ANY_LIMB, Linearized, Metaballs, PosedMetaballs
from marey.body.people.person import family_body
from marey.errors import SettingProblem

Detail = Literal["simple", "full"]
"""Detail of the metaballs."""
DETAILS: tuple[Detail, ...] = ("simple", "full")
"""Available details: the paper's simplified limbs, and all balls."""

SINGLE_SD = 0.08
"""Prior standard deviation of a single ball's radii from those of its segment, as a share. Chosen by hand."""
SHARPNESS_SD = 0.1
"""Prior standard deviation of a single ball's sharpness from the generic one, as a logarithm.

With 0.2 or 0.4 the skin of `arm3` lies 5 % nearer, but the shoulder is 4 mm farther off (docs/accuracy/rejected.md).
"""
OWN_SD = 0.05
"""Prior standard deviation of a segment's length and widths from those of the learned family, as a share. Chosen by
hand."""
KEPT_RADIUS = 0.1
"""Share of its radii that every ball keeps in one step of a refinement. Chosen by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MetaballSpace:
    """The metaballs of people: centres, radii and joint centres are linear in a few numbers.

    The numbers are the sizes of [Plaenkers1999] section 3.3, shares of the generic size: a segment's length, with which
    its balls and the joints beyond it move along it, and its width, or breadth and depth, which all its balls have in
    common. Unlike the paper, a ball beside the bone also moves outwards with the width.

    A ball's weight w ([Plaenkers1999] eq. (5)) and its radii both enlarge it, so that points barely distinguish them.
    Unlike the paper, the number that changes the weight is therefore the ball's sharpness t: the logarithm of its field
    decreases exp(t) times as much from its centre to its skin, and the radii shrink by exp(-t / 2), so that the skin
    stays in place, to first order and in the mean over the generic person. A sharper ball has a larger weight.
    """

    names: tuple[str, ...]
    """(N,) meaning of each number."""
    mean: Metaballs
    """The metaballs at which all numbers are zero."""
    centre_modes: Floats
    """(N, M, 3) [m by unit of the number], in the segments."""
    radii_modes: Floats
    """(N, M, 3) [m by unit of the number]."""
    joint_modes: Floats
    """(N, S, 3) of the joint centres at rest [m by unit of the number]."""
    prior_covariance: Floats
    """(N, N) of the numbers among people."""
    prior_mean: Floats = field(default_factory=lambda: np.zeros(0))
    """(N,) mean of the numbers for an unknown person; zeros when empty."""
    ranked: bool = False
    """Whether the first numbers explain most of the variation."""
    sharpness_modes: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """(N, M) change of each ball's sharpness by unit of the number; zeros when empty."""
    fall: Floats = field(default_factory=lambda: np.zeros(0))
    """(M,) decrease of the logarithm of each ball's field from its centre to the generic skin; when empty, that of a
    single ball."""

    def __post_init__(self) -> None:
        if not len(self.prior_mean):
            object.__setattr__(self, "prior_mean", np.zeros(len(self.names)))
        if not self.sharpness_modes.size:
            object.__setattr__(self, "sharpness_modes", np.zeros((len(self.names), len(self.mean))))
        if not len(self.fall):
            object.__setattr__(self, "fall", np.log(2.0 * self.mean.weight))
        freeze_fields(
            self,
            "centre_modes",
            "radii_modes",
            "joint_modes",
            "prior_covariance",
            "prior_mean",
            "sharpness_modes",
            "fall",
        )

    def __len__(self) -> int:
        """Return the number of shape parameters."""
        return len(self.names)

    def with_skeleton(self, skeleton: Skeleton) -> "MetaballSpace":
        """Return the same space on a skeleton with other coordinates."""
        return replace(self, mean=replace(self.mean, skeleton=skeleton))

    def is_possible(self, numbers: Floats) -> bool:
        """Return whether all balls of a person with numbers (N,) have a size."""
        return bool(np.all(self.mean.radii + np.tensordot(numbers, self.radii_modes, 1) > 0.0))

    def possible_share(self, numbers: Floats, step: Floats) -> float:
        """Return the largest share of a step with which every ball keeps `KEPT_RADIUS` of its radii.

        Args:
            numbers: (N,) of a person all of whose balls have a size.
            step: (N,) change of the numbers.

        Returns:
            A share between 0 and 1.
        """
        radii = self.mean.radii + np.tensordot(numbers, self.radii_modes, 1)
        loss = -np.tensordot(step, self.radii_modes, 1)
        shrinking = loss > 0.0
        return float(np.min((1.0 - KEPT_RADIUS) * radii[shrinking] / loss[shrinking], initial=1.0))

    def balls(self, numbers: Floats) -> Metaballs:
        """Return the balls of a person with numbers (N,).

        Raises:
            ValueError: A ball would have no size.
        """
        mean = self.mean
        sharpness = numbers @ self.sharpness_modes
        radii = mean.radii + np.tensordot(numbers, self.radii_modes, 1)
        return replace(
            mean,
            centre=mean.centre + np.tensordot(numbers, self.centre_modes, 1),
            radii=radii * np.exp(-0.5 * sharpness)[:, None],
            weight=mean.weight * np.exp(self.fall * np.expm1(sharpness)),
            joint_centres=mean.joint_centres + np.tensordot(numbers, self.joint_modes, 1),
        )

    def growth(self, balls: Metaballs) -> Floats:
        """Return the derivatives (N, M, 3) of the balls' radii by the numbers at constant sharpness."""
        return np.asarray(self.radii_modes / np.sqrt(self._steepness(balls))[:, None])

    def rates(self, balls: Metaballs) -> tuple[Floats, Floats]:
        """Return the derivatives of the balls' radii (N, M, 3) and logarithmic weights (N, M) by the numbers."""
        shrinks = 0.5 * self.sharpness_modes[:, :, None] * balls.radii
        return self.growth(balls) - shrinks, self.sharpness_modes * self.fall * self._steepness(balls)

    def _steepness(self, balls: Metaballs) -> Floats:
        """Return the decrease (M,) of the logarithms of the balls' fields relative to the generic ones', exp(t)."""
        return np.asarray(1.0 + np.log(balls.weight / self.mean.weight) / self.fall)

    def by_numbers(self, posed: PosedMetaballs, of: Linearized) -> Floats:
        """Return the derivatives of the residual of points fixed in the world by the numbers: (n, N)."""
        count, flat = len(self), (len(of.residual), -1)
        by_radii, by_weight = self.rates(posed.balls)
        by_balls = of.by_centre.reshape(flat) @ self.centre_modes.reshape(count, -1).T
        by_balls += of.by_radii.reshape(flat) @ by_radii.reshape(count, -1).T
        by_balls += (of.by_weight * posed.balls.weight) @ by_weight.T
        return by_balls + posed.by_joints(of, self.joint_modes)


def metaballs_of(body: Body) -> MetaballSpace | None:
    """Return the metaballs whose surface a body's skin is, or None where the skin is a mesh of its own."""
    return body.metaballs if isinstance(body.metaballs, MetaballSpace) else None


def required_metaballs(body: Body) -> MetaballSpace:
    """Return the metaballs whose surface a body's skin is.

    Raises:
        ValueError: The body has no metaballs.
    """
    space = metaballs_of(body)
    if space is None:
        raise ValueError("the body has no metaballs")
    return space


def generic_metaballs(detail: Detail = "full") -> Metaballs:
    """Return the metaballs that `bodies/fit_metaballs.py` fitted to the mean skin of the learned family.

    Args:
        detail: "simple", with three balls for a segment of arm or leg, or "full".

    Raises:
        SettingProblem: There is no such detail.
    """
    if detail not in DETAILS:
        raise SettingProblem(f"There is no detail '{detail}' of metaballs. It should be {' or '.join(DETAILS)}.")
    body, stored = family_body("coarse"), _stored()
    segment = np.array([body.skeleton.segment(str(name)) for name in stored["segment_names"]])
    return Metaballs(
        skeleton=body.skeleton,
        joint_centres=body.joint_centres,
        segment=segment[stored[f"{detail}_segment"]],
        centre=stored[f"{detail}_centre"],
        rotation=stored[f"{detail}_rotation"],
        radii=stored[f"{detail}_radii"],
        weight=np.ones(len(stored[f"{detail}_segment"])),
    )


@lru_cache(maxsize=1)
def _stored() -> dict[str, np.ndarray]:
    """Load the arrays of metaballs.npz, described in bodies/README.md."""
    with files("marey.body").joinpath("metaballs.npz").open("rb") as file, np.load(file) as arrays:
        return {name: arrays[name] for name in arrays.files}


def metaball_space(detail: Detail = "full") -> MetaballSpace:
    """Return the generic person's metaballs with lengths and widths as shape parameters, equal on both sides.

    Args:
        detail: "simple" has one width for a segment, "full" a breadth and a depth.

    Raises:
        SettingProblem: There is no such detail.
    """
    mean = generic_metaballs(detail)
    across = {"width": (0, 1)} if detail == "simple" else {"breadth": (0,), "depth": (1,)}
    names, centres, radii, joints = [], [], [], []
    plain = np.array([name.rpartition("_")[2] for name in mean.skeleton.segment_names])
    for segment in dict.fromkeys(plain):
        for what, axes in ({"length": (2,)} | across).items():
            own = np.flatnonzero(plain == segment)
            centre, radius = _stretched(mean, own, axes)
            names.append(f"{segment}_{what}")
            centres.append(centre)
            radii.append(radius)
            joints.append(_lengthened(mean, own) if what == "length" else np.zeros_like(mean.joint_centres))
    space = MetaballSpace(
        names=tuple(names), mean=mean, centre_modes=np.array(centres), radii_modes=np.array(radii),
        joint_modes=np.array(joints), prior_covariance=OWN_SD**2 * np.eye(len(names)),
    )  # fmt: skip
    return replace(space, prior_covariance=space.prior_covariance + _family_covariance(space))


def _family_covariance(space: MetaballSpace) -> Floats:
    """Return the covariance (N, N) of the numbers among the people of the learned family.

    A person's numbers are those that bring skin and joint centres nearest to the person's.
    """
    family = family_body("fine")
    own, theirs = (
        np.concatenate([s.vertex_modes.reshape(len(s), -1), s.joint_modes.reshape(len(s), -1)], 1)
        for s in (metaball_body(space).space, family.space)
    )
    by_family = np.linalg.lstsq(own.T, theirs.T, rcond=None)[0]
    return np.asarray(by_family @ by_family.T)


def single_radii(
    space: MetaballSpace, segments: Sequence[str], *, sd: float = SINGLE_SD, sharpness_sd: float | None = SHARPNESS_SD
) -> MetaballSpace:
    """Add numbers for the radii and the weight of every single ball of some segments.

    [Plaenkers1999] section 4 fits the radii themselves; unlike the paper, they are shares of the generic ones, with a
    prior standard deviation from the sizes that the balls of a segment have in common. So is the weight, by the ball's
    sharpness, see `MetaballSpace`.

    Args:
        space: Space of lengths and widths.
        segments: Names without a side; both sides remain equal.
        sd: Prior standard deviation of a radius, as a share of it.
        sharpness_sd: Prior standard deviation of a ball's sharpness, as a logarithm; None keeps the weights.
    """
    mean = space.mean
    added = [f"ball_{{}}_{axis}" for axis in ("breadth", "depth", "length")]
    added += [] if sharpness_sd is None else ["ball_{}_sharpness"]
    names, radii, sharpness = [], [], []
    for segment, j, both in _single_balls(mean, segments):
        for axis, name in enumerate(added):
            grown, sharper = np.zeros_like(mean.radii), np.zeros(len(mean))
            if axis < 3:
                grown[both, axis] = mean.radii[both, axis]
            else:
                sharper[both] = 1.0
            names.append(f"{segment}_{name.format(j)}")
            radii.append(grown)
            sharpness.append(sharper)
    more, count = np.array(radii).reshape(-1, *mean.radii.shape), len(space)
    own = np.full(len(names), sd)
    own[[name.endswith("sharpness") for name in names]] = sharpness_sd or 0.0
    covariance = np.diag(np.concatenate([np.zeros(count), own**2]))
    covariance[:count, :count] = space.prior_covariance
    return replace(
        space, names=(*space.names, *names), radii_modes=np.concatenate([space.radii_modes, more]),
        centre_modes=np.concatenate([space.centre_modes, np.zeros_like(more)]),
        joint_modes=np.concatenate([space.joint_modes, np.zeros((len(more), *space.joint_modes.shape[1:]))]),
        prior_covariance=covariance, prior_mean=np.concatenate([space.prior_mean, np.zeros(len(more))]),
        sharpness_modes=np.concatenate([space.sharpness_modes, np.array(sharpness).reshape(-1, len(mean))]),
        fall=_fall(mean),
    )  # fmt: skip


def _single_balls(mean: Metaballs, segments: Sequence[str]) -> Iterator[tuple[str, int, list[int]]]:
    """Yield the balls of some segments, each with its counterpart: segment, number in it, indices."""
    plain = np.array([name.rpartition("_")[2] for name in mean.skeleton.segment_names])
    for segment in dict.fromkeys(segments):
        sides = [np.flatnonzero(mean.segment == k) for k in np.flatnonzero(plain == segment)]
        for j, both in enumerate(zip(*sides, strict=True), 1):
            yield segment, j, list(both)


def _fall(balls: Metaballs) -> Floats:
    """Return the mean decrease (M,) of the logarithm of each ball's field from its centre to the skin.

    At a point of the skin where a ball has the share p of the field 1/2, it has decreased by ln w + ln 2 - ln p; the
    points are weighted by that share. A ball alone has p = 1.
    """
    posed, body = balls.at_rest(), family_body("coarse")
    limb = vertex_limbs(body)
    share = posed.shares(posed.onto_surface(body.vertices, limb), limb)
    whole = share.sum(0)
    shared = -np.sum(share * np.log(np.where(share > 0.0, share, 1.0)), axis=0) / np.where(whole > 0.0, whole, 1.0)
    return np.asarray(np.log(2.0 * balls.weight) + shared)


def _stretched(balls: Metaballs, segments: Integers, axes: tuple[int, ...]) -> tuple[Floats, Floats]:
    """Return the motion of centres and radii (M, 3) by the relative stretch of some segments' balls along some axes."""
    stretch = np.isin(balls.segment, segments)[:, None] * np.isin(np.arange(3), axes)
    local = np.einsum("mba,mb->ma", balls.rotation, balls.centre)
    return np.einsum("mab,mb->ma", balls.rotation, stretch * local), stretch * balls.radii


def _lengthened(balls: Metaballs, segments: Integers) -> Floats:
    """Return the motion of the joint centres (S, 3) by the relative length of some segments."""
    joints, parents = balls.joint_centres, balls.skeleton.parents
    moved = np.zeros_like(joints)
    for k, parent in enumerate(parents):
        if parent >= 0:
            moved[k] = moved[parent]
            if parent in segments:
                moved[k] += joints[k] - joints[parent]
    return moved


def metaball_body(
    space: MetaballSpace,
    numbers: Floats | None = None,
    template: Body | None = None,
    *,
    settle: bool = True,
    keep_weights: bool = False,
) -> Body:
    """Make the skin of metaballs as a body that can be posed, drawn and fitted like any other.

    The vertices of a template are projected onto the surface at rest. They move with the numbers as material points do:
    with the balls weighted by their share of the field, and, to first order, so that they stay on the surface. The
    body's shapes are therefore accurate near the numbers for which it was made; `reshaped` makes it again for others.
    With the pose the skin is blended; it is the metaballs' own surface only at rest.

    Unlike the paper, whose skin is sampled along cross-sections, the triangles are the template's, so that vertices
    correspond between people.

    Args:
        space: Metaballs.
        numbers: (N,) of this person, the generic one's if None.
        template: Body whose skin is projected onto the surface, the family's mean if None. Its followed segments and
            its outlines are kept.
        settle: Whether its vertices are projected onto the surface; else they stay in place.
        keep_weights: Whether the template's skin weights are kept, which are more accurate if they were learned,
            instead of the balls' shares.
    """
    at = np.zeros(len(space)) if numbers is None else np.asarray(numbers, float)
    given = family_body("fine") if template is None else template
    posed = space.balls(at).at_rest()
    limb = vertex_limbs(given)
    vertices = posed.onto_surface(given.vertices, limb) if settle else given.vertices
    modes = _skin_modes(space, posed, vertices, limb)
    segments, weights = given.vertex_segments, given.vertex_weights
    if not keep_weights:
        segments, weights = _strongest(posed, vertices, limb)
    return replace(
        given,
        space=ShapeSpace(
            names=space.names, vertex_mean=vertices - np.tensordot(at, modes, 1), vertex_modes=modes,
            joint_mean=space.mean.joint_centres, joint_modes=space.joint_modes,
            prior_mean=space.prior_mean, prior_covariance=space.prior_covariance, ranked=space.ranked,
        ),
        numbers=at, vertex_segments=segments, vertex_weights=weights, metaballs=space,
        joint_sd=None, joint_offset_sd=None, numbers_covariance=None,
    )  # fmt: skip


def reshaped(body: Body, numbers: Floats) -> Body:
    """Return a body with other shape parameters; a skin over metaballs is made again for them.

    The uncertainty of the numbers and of the joints is kept.
    """
    changed = body.with_numbers(numbers)
    space = metaballs_of(body)
    if space is None or np.array_equal(numbers, body.numbers):
        return changed
    made = metaball_body(space, numbers, changed, keep_weights=True)
    return replace(
        made, joint_sd=body.joint_sd, joint_offset_sd=body.joint_offset_sd,
        numbers_covariance=body.numbers_covariance,
    )  # fmt: skip


def vertex_limbs(body: Body) -> Integers:
    """Return the limb (V,) to which the skin's vertices belong, `ANY_LIMB` on the trunk."""
    strongest = np.argmax(body.vertex_weights, 1)
    limb = body.skeleton.segment_limb[body.vertex_segments[np.arange(len(strongest)), strongest]]
    return np.where(limb == 0, ANY_LIMB, limb)


def _skin_modes(space: MetaballSpace, posed: PosedMetaballs, vertices: Floats, limb: Integers) -> Floats:
    """Return the derivatives (N, V, 3) of vertices on the surface at rest by the numbers."""
    balls, share = posed.balls, posed.shares(vertices, limb)
    local = np.einsum("mab,vmb->vma", posed.axes, vertices[:, None] - posed.place)
    stretch = share[:, :, None] * local / balls.radii
    # Points in a ball move with it as it moves and grows.
    carried = space.joint_modes[:, balls.segment] + space.centre_modes
    modes = np.ascontiguousarray(np.moveaxis(np.tensordot(share, carried, (1, 1)), 1, 0))
    by_ball, growth = np.ascontiguousarray(np.moveaxis(stretch, 1, 0)), space.growth(balls)
    for i, grown in enumerate(posed.axes * growth[..., None]):
        for m in np.flatnonzero(np.any(grown, (1, 2))):
            modes[i] += by_ball[m] @ grown[m]
    of = posed.distances(vertices, limb)
    off = space.by_numbers(posed, of).T + np.einsum("va,iva->iv", of.by_point, modes)
    square = np.sum(of.by_point**2, axis=1)
    return np.asarray(modes - (off / square)[:, :, None] * of.by_point)


def _strongest(posed: PosedMetaballs, vertices: Floats, limb: Integers) -> tuple[Integers, Floats]:
    """Return the four segments (V, 4) with the largest share of each vertex, and these shares, of sum one."""
    count = len(posed.balls.skeleton.segment_names)
    by_segment = np.eye(count)[posed.balls.segment]
    shares = posed.shares(vertices, limb) @ by_segment
    order = np.argsort(-shares, axis=1, kind="stable")[:, :4]
    weights = np.take_along_axis(shares, order, 1)
    return order, weights / weights.sum(1, keepdims=True)

"""Persons of metaballs from which a capture starts, with the learned person's shape parameters."""

from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from marey.arrays import Floats, frozen
from marey.body.articulation.surface import Body, ShapeSpace
from marey.body.metaballs.metaball_person import (
    Detail,
    MetaballSpace,
    generic_metaballs,
    metaball_body,
    metaball_space,
    vertex_limbs,
)
from marey.body.metaballs.metaballs import PosedMetaballs
from marey.body.people.anthropometry import condition, measures
from marey.body.people.departures import vertex_normals
from marey.body.people.family import DetailLevel, load_family
from marey.body.people.person import (
    CONSTANT,
    STATURE_SD,
    VARYING,
    joint_offsets,
    person_body,
    preset_body,
    preset_named,
)

SURFACE_FIT_SD = 0.001
"""Standard deviation of the skin from the balls' surface when the balls' modes are fitted [m]. Chosen by hand."""
BALL_SHIFT_SD = 0.01
"""Prior standard deviation of a ball's motion from that of the skin around it, by unit of a number [m]. Chosen by
hand."""
BALL_STRETCH_SD = 0.1
"""Prior standard deviation of a ball's relative stretch from that of the skin around it, by unit of a number. Chosen
by hand."""
VERTEX_KNOWN_SD = 0.1
"""Standard deviation of each vertex when sizes are fitted to a skin [m]; large because neighbours deviate together.
Chosen by hand."""
_SLACK = 0.02
"""Regularisation of the skin's stretch around a ball, as a share of the ball's squared radii. Chosen by hand."""


class _BallModes(NamedTuple):
    """Derivatives of balls in the rest posture by some numbers."""

    place: Floats
    """(N, M, 3) of their centres [m by unit of the number]."""
    radii: Floats
    """(N, M, 3) of their radii [m by unit of the number]."""


@lru_cache(maxsize=4)
def learned_metaballs(detail: Detail = "full", *, numbers: int = 8) -> MetaballSpace:
    """Return the generic metaballs with the numbers, and their prior, of the learned person.

    Every ball moves and grows with each number such that the surface stays, to first order and in least squares, on the
    learned skin; the joint centres move as the learned ones do. Unlike the paper, whose widths and lengths
    (`metaball_space`) each concern one segment, the first numbers are those in which people differ most overall.

    Args:
        detail: See `generic_metaballs`.
        numbers: Number of the family's numbers, as in `person_body`.

    Raises:
        SettingProblem: There is no such detail.
    """
    mean, person = generic_metaballs(detail), person_body("fine", numbers=numbers)
    modes = _fitted_ball_modes(mean.at_rest(), person)
    space = person.space
    return MetaballSpace(
        names=space.names,
        mean=mean,
        centre_modes=modes.place - space.joint_modes[:, mean.segment],
        radii_modes=modes.radii,
        joint_modes=space.joint_modes,
        prior_mean=space.prior_mean,
        prior_covariance=space.prior_covariance,
        ranked=space.ranked,
    )


def _fitted_ball_modes(posed: PosedMetaballs, person: Body) -> _BallModes:
    """Fit how balls at rest move and grow so that their surface follows the modes of a skin."""
    limb = vertex_limbs(person)
    surface = posed.onto_surface(person.vertices, limb)
    share = vertex_areas(surface, person.faces)
    guess = _skin_motion(posed, surface, posed.shares(surface, limb) * share[:, None], person.space)
    of, radii, flat = posed.distances(surface, limb), posed.balls.radii, (len(surface), -1)
    by_balls = np.concatenate([of.by_centre.reshape(flat), (of.by_radii * radii).reshape(flat)], 1)
    half = by_balls.shape[1] // 2
    moved = np.concatenate([guess.place.reshape(-1, half), (guess.radii / radii).reshape(-1, half)], 1)
    off = np.einsum("va,iva->iv", of.by_point, person.space.vertex_modes) + moved @ by_balls.T
    weighted = by_balls.T * (share / SURFACE_FIT_SD**2)
    prior = np.repeat([BALL_SHIFT_SD**-2.0, BALL_STRETCH_SD**-2.0], half)
    change = moved - np.linalg.solve(weighted @ by_balls + np.diag(prior), weighted @ off.T).T
    place, size = (part.reshape(len(change), -1, 3) for part in (change[:, :half], change[:, half:]))
    return _BallModes(_symmetric(place, [-1, 1, 1]), _symmetric(size, [1, 1, 1]) * radii)


def _symmetric(modes: Floats, mirror: list[int]) -> Floats:
    """Make modes (N, M, 3) symmetric; the second half of the generic balls mirrors the first."""
    half = modes.shape[1] // 2
    one = 0.5 * (modes[:, :half] + modes[:, half:] * mirror)
    return np.concatenate([one, one * mirror], 1)


def _skin_motion(posed: PosedMetaballs, surface: Floats, share: Floats, space: ShapeSpace) -> _BallModes:
    """Return motion and stretch of the skin about each ball, along its axes, by its share (V, M) of each vertex."""
    place, growth = np.empty((2, len(space), len(posed.balls), 3))
    for m, (axes, radii) in enumerate(zip(posed.axes, posed.balls.radii, strict=True)):
        local = (surface - posed.place[m]) @ axes.T / radii
        terms = np.column_stack([np.ones(len(local)), local])
        weighted = terms.T * (share[:, m] / share[:, m].sum())
        normal = weighted @ terms + np.diag([0.0, _SLACK, _SLACK, _SLACK])
        moved = np.linalg.solve(normal, weighted @ (space.vertex_modes @ axes.T))
        place[:, m] = moved[:, 0] @ axes
        growth[:, m] = np.einsum("iaa->ia", moved[:, 1:])
    return _BallModes(place, growth)


def vertex_areas(vertices: Floats, faces: np.ndarray) -> Floats:
    """Return a third of the area of the triangles around each vertex (V,), relative to the mean."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    around = np.bincount(faces.ravel(), np.repeat(area, 3), len(vertices))
    return np.asarray(around / around.mean())


def metaball_person(
    detail: Detail = "full", level: DetailLevel = "fine", *, preset: str = "full", stature_m: float | None = None
) -> Body:
    """Return the generic person of metaballs, from which a capture starts without other knowledge.

    Args:
        detail: "full", all balls with the numbers of the learned person (`learned_metaballs`), or "simple", the paper's
            simplified limbs with their lengths and widths (`metaball_space`).
        level: Level of the triangles, "fine" or "coarse".
        preset: One of `PRESETS`.
        stature_m: The person's stature, if known [m].

    Raises:
        SettingProblem: The detail or the preset is unknown.
    """
    followed, person = preset_named(preset), person_body(level)
    space = learned_metaballs() if detail == "full" else metaball_space(detail)
    body = metaball_body(space, template=person, keep_weights=True)
    if detail == "full":
        body = replace(body, joint_sd=person.joint_sd, joint_offset_sd=person.joint_offset_sd)
    else:
        beneath, beside = joint_spread()
        body = replace(body, joint_sd=VARYING * beneath, joint_offset_sd=np.hypot(CONSTANT * beneath, beside))
    if stature_m is not None:
        body = _with_stature(body, space, level, stature_m)
    return preset_body(body, followed)


def _with_stature(body: Body, space: MetaballSpace, level: DetailLevel, stature_m: float) -> Body:
    """Condition a metaball body's numbers on its stature."""
    known = condition(body.space, measures(load_family(level)), {"stature": (stature_m, STATURE_SD)})
    space = replace(space, prior_mean=known.prior_mean, prior_covariance=known.prior_covariance)
    made = metaball_body(space, known.prior_mean, body.with_numbers(known.prior_mean), keep_weights=True)
    return replace(made, joint_sd=body.joint_sd, joint_offset_sd=body.joint_offset_sd)


@lru_cache(maxsize=1)
def joint_spread() -> tuple[Floats, Floats]:
    """Return the standard deviations (S,) of joint centres from where simple metaballs fitted to a skin place them [m].

    Outlines determine the skin along its normals only: for every person under the learned prior, the sizes are those
    that bring the metaballs' skin nearest along the normals, subject to their own prior.

    Returns:
        Those of the joints as fitted, and those of people's joints from the family's, per axis.
    """
    people, body = person_body("fine", numbers=16), metaball_body(metaball_space("simple"))
    normals, space = vertex_normals(body.vertices, body.faces), people.space
    root = np.linalg.cholesky(space.prior_covariance).T
    skin, own = (np.einsum("iva,va->iv", modes, normals) for modes in (space.vertex_modes, body.space.vertex_modes))
    information = own @ own.T / VERTEX_KNOWN_SD**2 + np.linalg.inv(body.space.prior_covariance)
    numbers = np.linalg.solve(information, own @ (root @ skin).T / VERTEX_KNOWN_SD**2)
    missed = np.tensordot(root, space.joint_modes, 1) - np.tensordot(numbers.T, body.space.joint_modes, 1)
    known = 0.0 if people.joint_sd is None else people.joint_sd / VARYING
    return frozen(np.hypot(np.sqrt(np.sum(missed**2, axis=(0, 2)) / 3.0), known)), joint_offsets(people.skeleton)

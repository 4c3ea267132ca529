"""Functional joint centres and axes: least-squares sphere, SCoRE and SARA, with covariance."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.errors import MareyError
from marey.markers.data.rigid_fit import EQUAL_SD_M, fit_rigid, in_cluster_frame, mean_shape

_BLOCKS = 20
"""Number of blocks of the trial for the covariance; errors are correlated within a block and independent between
blocks. Chosen by hand; results were not measured against other values."""
_FEWEST_FRAMES = 10
"""Fewest frames from which a joint is estimated. Chosen by hand."""
_MAXIMUM_STEPS = 50
"""Most Gauss-Newton steps; the iteration usually ends earlier, at a step below 1e-10 m."""
_MINIMUM_ROTATION_RATIO = 1e-3
"""Smallest usable singular value as a ratio to the largest; below it, the movement does not determine the joint. Chosen
by hand."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FunctionalCentre:
    """The centre of a joint, fixed in both of its segments."""

    in_parent: Floats
    """(3,) in the frame of `parent_shape` [m]."""
    in_child: Floats
    """(3,) in the frame of `child_shape` [m]; NaN for a sphere, where the child need not be rigid."""
    covariance: Floats
    """(3, 3) of `in_parent` [m2]."""
    residual: float
    """RMS distance between the two segments' centres, or of the markers from their spheres [m]."""
    parent_shape: Floats
    """(M, 3) positions of the parent's markers in its frame [m]."""
    child_shape: Floats
    """(N, 3) positions of the child's markers in its frame [m]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "in_parent", "in_child", "covariance", "parent_shape", "child_shape")


@dataclass(frozen=True, eq=False, kw_only=True)
class FunctionalAxis:
    """The axis of a hinge, fixed in both of its segments."""

    in_parent: Floats
    """(3,) unit direction in the frame of `parent_shape`."""
    in_child: Floats
    """(3,) the same in the frame of `child_shape`."""
    point_in_parent: Floats
    """(3,) the point of the axis closest to the mean of the parent's markers [m]."""
    point_in_child: Floats
    """(3,) the point of the axis closest to the mean of the child's markers [m]."""
    covariance: Floats
    """(3, 3) of the direction in the parent."""
    residual: float
    """RMS distance between the two segments' axis points [m]."""
    parent_shape: Floats
    """(M, 3) positions of the parent's markers in its frame [m]."""
    child_shape: Floats
    """(N, 3) positions of the child's markers in its frame [m]."""

    def __post_init__(self) -> None:
        freeze_fields(
            self,
            "in_parent",
            "in_child",
            "point_in_parent",
            "point_in_child",
            "covariance",
            "parent_shape",
            "child_shape",
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class _Segment:
    """A cluster as a rigid body in the frames in which both segments of the joint are known."""

    shape: Floats
    rotation: Floats
    translation: Floats


def sphere_centre(parent: Floats, child: Floats) -> FunctionalCentre:
    """Estimate the point about which the child's markers move on spheres in the parent's frame.

    Each marker has its own radius; the RMS distance of the markers from their spheres is minimal. The iteration starts
    at the algebraic solution of [Gamage2002]. The child need not be rigid.

    Args:
        parent: (F, M, 3) the parent's markers in the laboratory [m]; NaN where missing.
        child: (F, N, 3) the child's markers [m].

    Raises:
        MareyError: Fewer than ten frames show the parent and a marker of the child, or the child rotates too little.
    """
    local, rotation, translation = in_cluster_frame(parent)
    points = np.einsum("fji,fnj->fni", rotation, child - translation[:, None])
    seen = np.isfinite(points).all(-1)
    _require_frames(np.asarray(seen.any(1)))
    points = points[:, seen.sum(0) > 3]
    seen = np.isfinite(points).all(-1)
    held = np.where(seen[..., None], points, 0.0)
    centre = _algebraic_centre(held, seen)
    for _ in range(_MAXIMUM_STEPS):
        off, jacobian = _from_spheres(held, seen, centre)
        step = np.linalg.lstsq(jacobian.reshape(-1, 3), -off.ravel(), rcond=None)[0]
        centre = centre + step
        if np.linalg.norm(step) < 1e-10:
            break
    off, jacobian = _from_spheres(held, seen, centre)
    return FunctionalCentre(
        in_parent=centre, in_child=np.full(3, np.nan), covariance=_sandwich(jacobian, off),
        residual=float(np.sqrt((off[seen] ** 2).mean())), parent_shape=mean_shape(local),
        child_shape=mean_shape(points),
    )  # fmt: skip


def _algebraic_centre(held: Floats, seen: Mask) -> Floats:
    """Solve for the centre (3,) with squared distances ([Gamage2002])."""
    count = np.maximum(seen.sum(0), 1)[:, None]
    mean = held.sum(0) / count
    square = (held**2).sum(-1)
    off = np.where(seen[..., None], held - mean, 0.0)
    normal = np.einsum("fni,fnj->ij", off, held) * 2
    right = np.einsum("fni,fn->i", off, square)
    values = np.linalg.eigvalsh(normal)
    if values[0] < _MINIMUM_ROTATION_RATIO**2 * values[2]:
        raise MareyError(
            "The child rotates too little relative to the parent: the centre is not determined. Record larger circles."
        )
    return np.linalg.solve(normal, right)


def _from_spheres(held: Floats, seen: Mask, centre: Floats) -> tuple[Floats, Floats]:
    """Return the distances (F, N) from each marker's best sphere, and their derivative by the centre (F, N, 3)."""
    arm = held - centre
    distance = np.where(seen, np.linalg.norm(arm, axis=-1), 0.0)
    count = np.maximum(seen.sum(0), 1)
    away = np.where(seen[..., None], arm / np.where(seen, np.maximum(distance, 1e-9), 1.0)[..., None], 0.0)
    off = np.where(seen, distance - distance.sum(0) / count, 0.0)
    return off, -np.where(seen[..., None], away - away.sum(0) / count[:, None], 0.0)


def score(parent: Floats, child: Floats) -> FunctionalCentre:
    """Estimate the symmetrical centre of rotation: the point that moves least between both segments ([Ehrig2006]).

    Args:
        parent: (F, M, 3) the parent's markers in the laboratory [m]; NaN where missing.
        child: (F, N, 3) the child's markers [m].

    Raises:
        MareyError: Fewer than ten frames show both segments, or they rotate about one axis only, or not at all.
    """
    first, second, jacobian, right = _chain(parent, child)
    size = np.linalg.svd(jacobian.reshape(-1, 6), compute_uv=False)
    if size[-1] < _MINIMUM_ROTATION_RATIO * size[0]:
        raise MareyError("The segments rotate about one axis only, or not at all: the centre is not determined.")
    both = np.linalg.lstsq(jacobian.reshape(-1, 6), right.ravel(), rcond=None)[0]
    off = jacobian @ both - right
    return FunctionalCentre(
        in_parent=both[:3], in_child=both[3:], covariance=_sandwich(jacobian, off)[:3, :3],
        residual=float(np.sqrt((off**2).sum(-1).mean())), parent_shape=first.shape, child_shape=second.shape,
    )  # fmt: skip


def sara(parent: Floats, child: Floats) -> FunctionalAxis:
    """Estimate the symmetrical axis of rotation: the line that moves least between both segments ([Ehrig2007]).

    Args:
        parent: (F, M, 3) the parent's markers in the laboratory [m]; NaN where missing.
        child: (F, N, 3) the child's markers [m].

    Returns:
        The axis; its sign makes the child's rotation from the first frame to the most rotated one positive.

    Raises:
        MareyError: Fewer than ten frames show both segments, or they do not rotate.
    """
    first, second, jacobian, right = _chain(parent, child)
    flat = jacobian.reshape(-1, 6)
    _, size, directions = np.linalg.svd(flat, full_matrices=False)
    if size[-2] < _MINIMUM_ROTATION_RATIO * size[0]:
        raise MareyError("The segments do not rotate relative to each other: the axis is not determined.")
    axis = directions[-1]
    lengths = np.linalg.norm(axis[:3]), np.linalg.norm(axis[3:])
    axis = axis * _sign(first, second, axis[:3])
    along, along_child = axis[:3] / lengths[0], axis[3:] / lengths[1]
    both = np.linalg.lstsq(flat, right.ravel(), rcond=_MINIMUM_ROTATION_RATIO)[0]  # undetermined along a perfect hinge
    off = jacobian @ both - right
    # First-order perturbation of the smallest singular vector by its own residual.
    pull = _block_sum(np.einsum("fri,fr->fi", jacobian, jacobian @ axis))
    inverse = directions[:-1].T @ np.diag(1 / (size[:-1] ** 2 - size[-1] ** 2)) @ directions[:-1]
    covariance = (inverse @ pull @ inverse)[:3, :3] / lengths[0] ** 2
    return FunctionalAxis(
        in_parent=along, in_child=along_child, covariance=covariance,
        point_in_parent=_nearest(both[:3], along, _mean_of(first.shape)),
        point_in_child=_nearest(both[3:], along_child, _mean_of(second.shape)),
        residual=float(np.sqrt((off**2).sum(-1).mean())), parent_shape=first.shape, child_shape=second.shape,
    )  # fmt: skip


def transfer_point(shape: Floats, place: Floats, points: Floats) -> Floats:
    """Transfer a point that is fixed to a cluster into a trial.

    Args:
        shape: (M, 3) the cluster's markers in its frame [m]; NaN where unknown.
        place: (3,) the point in that frame [m].
        points: (F, M, 3) the same markers in the trial [m]; NaN where missing.

    Returns:
        (F, 3) the point in the trial's laboratory [m]; NaN where the cluster has fewer than three markers.
    """
    fit = fit_rigid(shape, points, EQUAL_SD_M)
    return np.asarray(fit.rotation @ place + fit.translation)


def _chain(parent: Floats, child: Floats) -> tuple[_Segment, _Segment, Floats, Floats]:
    """Set up R1 c1 + t1 = R2 c2 + t2 for every frame: [R1, -R2] (F, 3, 6) and t2 - t1 (F, 3) ([Ehrig2006])."""
    bodies = [in_cluster_frame(points) for points in (parent, child)]
    there = np.asarray(np.isfinite(bodies[0][2]).all(-1) & np.isfinite(bodies[1][2]).all(-1))
    _require_frames(there)
    first, second = (
        _Segment(shape=mean_shape(local), rotation=rotation[there], translation=translation[there])
        for local, rotation, translation in bodies
    )
    jacobian = np.concatenate([first.rotation, -second.rotation], -1)
    return first, second, jacobian, second.translation - first.translation


def _require_frames(there: Mask) -> None:
    if there.sum() < _FEWEST_FRAMES:
        raise MareyError(f"{int(there.sum())} frames show both segments; a joint needs at least {_FEWEST_FRAMES}.")


def _sandwich(jacobian: Floats, off: Floats) -> Floats:
    """Return the covariance (P, P) of a least-squares solution whose errors are correlated within blocks of time.

    Args:
        jacobian: (F, R, P) derivatives of the residuals.
        off: (F, R) residuals.
    """
    inverse = np.linalg.inv(np.einsum("fri,frj->ij", jacobian, jacobian))
    return np.asarray(inverse @ _block_sum(np.einsum("fri,fr->fi", jacobian, off)) @ inverse)


def _block_sum(pulls: Floats) -> Floats:
    """Sum the outer products (P, P) of the gradients (F, P), added up within blocks of frames."""
    blocks = np.array([block.sum(0) for block in np.array_split(pulls, min(_BLOCKS, len(pulls)))])
    return np.asarray(blocks.T @ blocks * len(blocks) / max(len(blocks) - 1, 1))


def _mean_of(shape: Floats) -> Floats:
    return np.asarray(shape[np.isfinite(shape).all(-1)].mean(0))


def _nearest(point: Floats, along: Floats, to: Floats) -> Floats:
    """Return the point of a line that is closest to another point."""
    return np.asarray(point + along * (along @ (to - point)))


def _sign(first: _Segment, second: _Segment, axis: Floats) -> float:
    """Return the sign that makes the rotation from the first frame to the most rotated one positive about the axis."""
    turned = np.swapaxes(first.rotation, 1, 2) @ second.rotation
    since = turned @ turned[0].T
    far = since[int(np.argmin(np.trace(since, axis1=1, axis2=2)))]
    skew = np.array([far[2, 1] - far[1, 2], far[0, 2] - far[2, 0], far[1, 0] - far[0, 1]])
    return 1.0 if skew @ axis >= 0 else -1.0

"""Joint centres and axes found from movement: least-squares sphere, SCoRE and SARA, with covariance."""

from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask, freeze_fields
from marey.errors import MareyError
from marey.markers.data.rigid_fit import fit_rigid
from marey.markers.preprocessing.low_rank import in_cluster

_BLOCKS = 20  # of the trial; errors within one go together, those of different ones do not
_FEWEST_FRAMES = 10
_STEPS = 50
_SMALL_TURN = 1e-3  # of the largest singular value: less turn than that tells nothing


@dataclass(frozen=True, eq=False, kw_only=True)
class FunctionalCentre:
    """The centre of a joint, fixed to both of its segments."""

    in_parent: Floats
    """(3,) in the frame of `parent_shape` [m]."""
    in_child: Floats
    """(3,) in the frame of `child_shape` [m]; NaN where the child was no rigid body (sphere)."""
    covariance: Floats
    """(3, 3) of `in_parent` [m2]."""
    residual: float
    """RMS distance of the two segments' centres from each other, or of the markers from their spheres [m]."""
    parent_shape: Floats
    """(M, 3) where the parent's markers are in its frame [m]."""
    child_shape: Floats
    """(N, 3) where the child's markers are in its frame [m]."""

    def __post_init__(self) -> None:
        freeze_fields(self, "in_parent", "in_child", "covariance", "parent_shape", "child_shape")


@dataclass(frozen=True, eq=False, kw_only=True)
class FunctionalAxis:
    """The axis of a hinge, fixed to both of its segments."""

    in_parent: Floats
    """(3,) unit direction in the frame of `parent_shape`."""
    in_child: Floats
    """(3,) the same in the frame of `child_shape`."""
    point_in_parent: Floats
    """(3,) the axis' point nearest to the middle of the parent's markers [m]."""
    point_in_child: Floats
    """(3,) the axis' point nearest to the middle of the child's markers [m]."""
    covariance: Floats
    """(3, 3) of the direction in the parent."""
    residual: float
    """RMS distance of the two segments' axis points from each other [m]."""
    parent_shape: Floats
    """(M, 3) [m]."""
    child_shape: Floats
    """(N, 3) [m]."""

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
    """Find the point about which the child's markers move on spheres in the parent's frame.

    Each marker has a radius of its own; the distances of its places from its sphere are least (RMS). The start is the
    algebraic solution of [Gamage2002]. The child need not be rigid.

    Args:
        parent: (F, M, 3) the parent's markers in the laboratory [m]; NaN where missing.
        child: (F, N, 3) the child's.

    Raises:
        MareyError: Fewer than ten frames show the parent and a marker of the child, or these hardly turn.
    """
    local, rotation, translation = in_cluster(parent)
    points = np.einsum("fji,fnj->fni", rotation, child - translation[:, None])
    seen = np.isfinite(points).all(-1)
    _require_frames(np.asarray(seen.any(1)))
    points = points[:, seen.sum(0) > 3]
    seen = np.isfinite(points).all(-1)
    held = np.where(seen[..., None], points, 0.0)
    centre = _algebraic_centre(held, seen)
    for _ in range(_STEPS):
        off, jacobian = _from_spheres(held, seen, centre)
        step = np.linalg.lstsq(jacobian.reshape(-1, 3), -off.ravel(), rcond=None)[0]
        centre = centre + step
        if np.linalg.norm(step) < 1e-10:
            break
    off, jacobian = _from_spheres(held, seen, centre)
    return FunctionalCentre(
        in_parent=centre, in_child=np.full(3, np.nan), covariance=_sandwich(jacobian, off),
        residual=float(np.sqrt((off[seen] ** 2).mean())), parent_shape=_mean(local), child_shape=_mean(points),
    )  # fmt: skip


def _algebraic_centre(held: Floats, seen: Mask) -> Floats:
    """Solve for the centre with squared distances ([Gamage2002])."""
    count = np.maximum(seen.sum(0), 1)[:, None]
    mean = held.sum(0) / count
    square = (held**2).sum(-1)
    off = np.where(seen[..., None], held - mean, 0.0)
    normal = np.einsum("fni,fnj->ij", off, held) * 2
    right = np.einsum("fni,fn->i", off, square)
    values = np.linalg.eigvalsh(normal)
    if values[0] < _SMALL_TURN**2 * values[2]:
        raise MareyError("The child hardly turns in the parent, so that no centre shows. Record larger circles.")
    return np.linalg.solve(normal, right)


def _from_spheres(held: Floats, seen: Mask, centre: Floats) -> tuple[Floats, Floats]:
    """Give the distances (F, N) from each marker's own best sphere, and their derivative by the centre (F, N, 3)."""
    arm = held - centre
    distance = np.where(seen, np.linalg.norm(arm, axis=-1), 0.0)
    count = np.maximum(seen.sum(0), 1)
    away = np.where(seen[..., None], arm / np.where(seen, np.maximum(distance, 1e-9), 1.0)[..., None], 0.0)
    off = np.where(seen, distance - distance.sum(0) / count, 0.0)
    return off, -np.where(seen[..., None], away - away.sum(0) / count[:, None], 0.0)


def score(parent: Floats, child: Floats) -> FunctionalCentre:
    """Find the point that stays nearest to itself on both segments: the symmetrical centre of rotation ([Ehrig2006]).

    Args:
        parent: (F, M, 3) the parent's markers in the laboratory [m]; NaN where missing.
        child: (F, N, 3) the child's.

    Raises:
        MareyError: Fewer than ten frames show both segments, or they turn about one axis only, or not at all.
    """
    first, second, jacobian, right = _chain(parent, child)
    size = np.linalg.svd(jacobian.reshape(-1, 6), compute_uv=False)
    if size[-1] < _SMALL_TURN * size[0]:
        raise MareyError("The segments turn about one axis only, or not at all, so that no centre shows.")
    both = np.linalg.lstsq(jacobian.reshape(-1, 6), right.ravel(), rcond=None)[0]
    off = jacobian @ both - right
    return FunctionalCentre(
        in_parent=both[:3], in_child=both[3:], covariance=_sandwich(jacobian, off)[:3, :3],
        residual=float(np.sqrt((off**2).sum(-1).mean())), parent_shape=first.shape, child_shape=second.shape,
    )  # fmt: skip


def sara(parent: Floats, child: Floats) -> FunctionalAxis:
    """Find the line that stays nearest to itself on both segments: the symmetrical axis of rotation ([Ehrig2007]).

    Args:
        parent: (F, M, 3) the parent's markers in the laboratory [m]; NaN where missing.
        child: (F, N, 3) the child's.

    Returns:
        The axis; its sign is the one that makes the turn of the child, from the first frame to the farthest, positive.

    Raises:
        MareyError: Fewer than ten frames show both segments, or they do not turn.
    """
    first, second, jacobian, right = _chain(parent, child)
    flat = jacobian.reshape(-1, 6)
    _, size, directions = np.linalg.svd(flat, full_matrices=False)
    if size[-2] < _SMALL_TURN * size[0]:
        raise MareyError("The segments do not turn against each other, so that no axis shows.")
    axis = directions[-1]
    lengths = np.linalg.norm(axis[:3]), np.linalg.norm(axis[3:])
    axis = axis * _sign(first, second, axis[:3])
    along, along_child = axis[:3] / lengths[0], axis[3:] / lengths[1]
    both = np.linalg.lstsq(flat, right.ravel(), rcond=_SMALL_TURN)[0]  # along a perfect hinge nothing tells where
    off = jacobian @ both - right
    # The smallest singular vector moves by what its own misfit pulls along the others.
    pull = _block_sum(np.einsum("fri,fr->fi", jacobian, jacobian @ axis))
    inverse = directions[:-1].T @ np.diag(1 / (size[:-1] ** 2 - size[-1] ** 2)) @ directions[:-1]
    covariance = (inverse @ pull @ inverse)[:3, :3] / lengths[0] ** 2
    return FunctionalAxis(
        in_parent=along, in_child=along_child, covariance=covariance,
        point_in_parent=_nearest(both[:3], along, _mean_of(first.shape)),
        point_in_child=_nearest(both[3:], along_child, _mean_of(second.shape)),
        residual=float(np.sqrt((off**2).sum(-1).mean())), parent_shape=first.shape, child_shape=second.shape,
    )  # fmt: skip


def carried(shape: Floats, place: Floats, points: Floats) -> Floats:
    """Carry a place that is fixed to a cluster into a trial.

    Args:
        shape: (M, 3) the cluster's markers in its frame [m]; NaN where not known.
        place: (3,) in that frame [m].
        points: (F, M, 3) the same markers in the trial [m]; NaN where missing.

    Returns:
        (F, 3) in the trial's laboratory [m]; NaN where the cluster has fewer than three markers.
    """
    fit = fit_rigid(shape, points, 1e-3)
    return np.asarray(fit.rotation @ place + fit.translation)


def _chain(parent: Floats, child: Floats) -> tuple[_Segment, _Segment, Floats, Floats]:
    """Set up R1 c1 + t1 = R2 c2 + t2 for every frame: [R1, -R2] (F, 3, 6) and t2 - t1 (F, 3) ([Ehrig2006])."""
    bodies = [in_cluster(points) for points in (parent, child)]
    there = np.asarray(np.isfinite(bodies[0][2]).all(-1) & np.isfinite(bodies[1][2]).all(-1))
    _require_frames(there)
    first, second = (
        _Segment(shape=_mean(local), rotation=rotation[there], translation=translation[there])
        for local, rotation, translation in bodies
    )
    jacobian = np.concatenate([first.rotation, -second.rotation], -1)
    return first, second, jacobian, second.translation - first.translation


def _require_frames(there: Mask) -> None:
    if there.sum() < _FEWEST_FRAMES:
        raise MareyError(f"{int(there.sum())} frames show both segments; a joint needs {_FEWEST_FRAMES} to show.")


def _sandwich(jacobian: Floats, off: Floats) -> Floats:
    """Give the covariance (P, P) of a least-squares solution whose errors go together within blocks of time.

    Args:
        jacobian: (F, R, P).
        off: (F, R) misfit.
    """
    inverse = np.linalg.inv(np.einsum("fri,frj->ij", jacobian, jacobian))
    return np.asarray(inverse @ _block_sum(np.einsum("fri,fr->fi", jacobian, off)) @ inverse)


def _block_sum(pulls: Floats) -> Floats:
    """Add up the outer products (P, P) of what blocks of frames pull (F, P)."""
    blocks = np.array([block.sum(0) for block in np.array_split(pulls, min(_BLOCKS, len(pulls)))])
    return np.asarray(blocks.T @ blocks * len(blocks) / max(len(blocks) - 1, 1))


def _mean(local: Floats) -> Floats:
    """Average over the frames that are known (F, M, 3)."""
    known = np.isfinite(local)
    count = known.sum(0)
    return np.where(count > 0, np.where(known, local, 0).sum(0) / np.maximum(count, 1), np.nan)


def _mean_of(shape: Floats) -> Floats:
    return np.asarray(shape[np.isfinite(shape).all(-1)].mean(0))


def _nearest(point: Floats, along: Floats, to: Floats) -> Floats:
    """Give the point of a line that is nearest to another."""
    return np.asarray(point + along * (along @ (to - point)))


def _sign(first: _Segment, second: _Segment, axis: Floats) -> float:
    """Tell the sign with which the turn from the first frame to the farthest one is positive about the axis."""
    turned = np.swapaxes(first.rotation, 1, 2) @ second.rotation
    since = turned @ turned[0].T
    far = since[int(np.argmin(np.trace(since, axis1=1, axis2=2)))]
    skew = np.array([far[2, 1] - far[1, 2], far[0, 2] - far[2, 0], far[1, 0] - far[0, 1]])
    return 1.0 if skew @ axis >= 0 else -1.0

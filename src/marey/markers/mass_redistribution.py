"""Masses for a cluster's markers in each frame that keep the eigenvalues of its inertia as they were at rest."""

import numpy as np

from marey.arrays import Floats, Mask

_ROUNDS = 60
_SHORTENED = (1.0, 0.5, 0.2, 0.05, 0.01)
_KEPT = 1e-10  # of the largest moment
_LEAST_MASS = 1e-3  # of the unit mass at rest; a marker may all but vanish, never repel


def redistributed(points: Floats, mass: Floats, moments: Floats) -> tuple[Floats, Mask]:
    """Change masses until the cluster has the moments again that it had at rest.

    Minimises the sum of squared changes of the three eigenvalues ([Andriacchi1998] asks for eigenvalues that stay
    constant) by Gauss-Newton from the given masses, d moment_k / d m_i = (d_i . e_k)^2. More masses than eigenvalues
    leave a choice; every step is the shortest of those that do the same, and is shortened where the moments bend. A
    mass that falls to nothing is held there.

    Args:
        points: (F, M, 3) [m]; read only where the mass is above 0.
        mass: (F, M) masses to start from; 0 where a marker is missing.
        moments: (F, 3) second moments at rest, in any order [m2].

    Returns:
        The masses (F, M), and (F,) whether they keep the moments; where they do not, the given masses.
    """
    wanted = np.sort(moments, 1)
    found = mass.copy()
    active = np.arange(len(mass))
    for _ in range(_ROUNDS):
        found[active] = _step(points[active], found[active], wanted[active])
        active = active[_off(points[active], found[active], wanted[active]) > _KEPT / 100]
        if not len(active):
            break
    kept = _off(points, found, wanted) <= _KEPT
    return np.where(kept[:, None], found, mass), kept


def _step(points: Floats, mass: Floats, wanted: Floats) -> Floats:
    """Take one step towards the wanted moments, of the length among a few that leaves them least off."""
    now, slope = _moments(points, mass)
    change, held = np.zeros_like(mass), mass == 0
    for _ in range(2):  # the second time without the masses that the first would make vanish
        free = np.where(held[:, None], 0.0, slope)
        gain = np.linalg.pinv(free @ np.swapaxes(free, 1, 2), rcond=1e-14, hermitian=True)
        change = np.einsum("fkm,fkl,fl->fm", free, gain, wanted - now)
        held = held | (mass + change < _LEAST_MASS)
    candidates = [np.where(mass > 0, np.maximum(mass + s * change, _LEAST_MASS), 0.0) for s in _SHORTENED]
    off = [_off(points, candidate, wanted) for candidate in candidates]
    return np.asarray(np.stack(candidates)[np.argmin(off, 0), np.arange(len(mass))])


def _off(points: Floats, mass: Floats, wanted: Floats) -> Floats:
    """Tell how far the moments are off, over the largest one wanted (F,)."""
    return np.asarray(np.linalg.norm(_moments(points, mass)[0] - wanted, axis=1) / wanted.max(1))


def _moments(points: Floats, mass: Floats) -> tuple[Floats, Floats]:
    """Give the second moments (F, 3), smallest first, and their derivatives by the masses (F, 3, M)."""
    held = np.where(mass[..., None] > 0, points, 0.0)
    centre = np.einsum("fm,fmi->fi", mass, held) / mass.sum(1)[:, None]
    about = np.where(mass[..., None] > 0, points - centre[:, None], 0.0)
    moments, axes = np.linalg.eigh(np.swapaxes(about * mass[..., None], 1, 2) @ about)
    return moments, np.swapaxes((about @ axes) ** 2, 1, 2)

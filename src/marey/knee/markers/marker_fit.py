"""The rigid transform between two places of the same markers: its residuals, its covariance, a marker that moved."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammaincc

from marey.arrays import Floats, Mask, freeze_fields
from marey.errors import MareyError
from marey.geometry import rotations

FEWEST = 3
LARGEST_TURN_SD = np.radians(10.0)
"""A turn known worse than this is not known: the markers lie too near to one line [rad]."""
DOUBTED = 1e-3
"""Residuals that chance makes as large as this seldom are no chance: a marker is elsewhere."""
_LARGER = 0.05  # the stated deviations are raised where chance makes the residuals so large as seldom as this
_AHEAD = 9.0  # in chi square, by which leaving one marker out is better than another: odds of 90 to 1
_EXPLAINED = 0.01  # the others fit again without the marker that was elsewhere


@dataclass(frozen=True, eq=False, kw_only=True)
class CommonMarkers:
    """The places of M markers in two frames, with standard deviations along the axes of each."""

    names: tuple[str, ...]
    from_mm: Floats
    """(M, 3) in the frame that the transform comes from."""
    from_sd_mm: Floats
    """(M, 3)."""
    to_mm: Floats
    """(M, 3) in the frame that it leads to."""
    to_sd_mm: Floats
    """(M, 3)."""

    def __post_init__(self) -> None:
        names = ("from_mm", "from_sd_mm", "to_mm", "to_sd_mm")
        freeze_fields(self, *names)
        for name in names:
            if getattr(self, name).shape != (len(self.names), 3):
                raise MareyError(f"{len(self.names)} common markers and their {name} do not fit together.")

    def without(self, index: int) -> "CommonMarkers":
        """Give all markers but one."""
        kept = [m for m in range(len(self.names)) if m != index]
        return self.chosen(kept)

    def chosen(self, kept: Sequence[int]) -> "CommonMarkers":
        """Give some of the markers, in the order asked for."""
        rows = np.asarray(kept, np.int64)
        return CommonMarkers(
            names=tuple(self.names[m] for m in rows), from_mm=self.from_mm[rows], from_sd_mm=self.from_sd_mm[rows],
            to_mm=self.to_mm[rows], to_sd_mm=self.to_sd_mm[rows],
        )  # fmt: skip

    @property
    def variance_mm2(self) -> Floats:
        """(M,) of a coordinate's difference between the two frames, the mean over the axes."""
        return np.asarray((self.from_sd_mm**2 + self.to_sd_mm**2).mean(1))


@dataclass(frozen=True, eq=False, kw_only=True)
class MarkerFit:
    """A rigid transform p_to = R p_from + t between the places of M markers."""

    names: tuple[str, ...]
    rotation: Floats
    """(3, 3)."""
    translation_mm: Floats
    """(3,)."""
    residuals_mm: Floats
    """(M, 3) place there less place carried there, along the axes of the frame it leads to; of markers that were left
    out, too."""
    used: Mask
    """(M,) false for a marker that was left out, since it lies elsewhere in one of the two."""
    gain: Floats
    """(6, M, 3) what the turn exp(turn) to the right of R [rad] and the translation [mm] take from a shift of each
    marker [mm] in the frame that the transform leads to."""
    covariance: Floats
    """(6, 6) of turn [rad] and translation [mm]: from the markers' deviations, raised where residuals ask for it."""
    chi_square: float
    """Sum of the squared residuals in their standard deviations."""
    freedom: int
    """How many of the coordinates are left over."""
    raised: float = 1.0
    """By how much the variances were raised."""
    notes: tuple[str, ...] = ()

    @property
    def residual_mm(self) -> float:
        """Distance of the markers that were used from where they are carried (RMS)."""
        return float(np.sqrt((self.residuals_mm[self.used] ** 2).sum(1).mean()))

    @property
    def chance(self) -> float:
        """How often chance makes residuals so large."""
        return float(gammaincc(self.freedom / 2, self.chi_square / 2))


def fit_markers(common: CommonMarkers) -> MarkerFit:
    """Fit the rigid transform between two places of the same markers, and look for one that lies elsewhere.

    The linear least squares of [Alexander2003] section 2.2, in closed form (singular values). Unlike the paper, each
    marker counts by its standard deviation. Where the residuals are no chance, the marker without which the others
    agree is left out, and named; where it may be one of several, they are named, and none is left out. Three markers
    are too few to leave one out, but the one that moved is named where the distance of the other two is right. What
    remains unexplained raises the deviations.

    Args:
        common: At least three markers, not in a line.

    Raises:
        MareyError: There are fewer, or they lie so near to one line that the turn about it is not known.
    """
    fit = _weighted(common)
    if fit.chance >= DOUBTED:
        return _with_raised(fit)
    if len(common.names) == FEWEST:
        return _with_raised(replace(fit, notes=_exchanged(common) or _suspect_of_three(common)))
    without = [(_weighted(common.without(m)), m) for m in range(len(common.names)) if _determined(common.without(m))]
    likely = sorted([pair for pair in without if pair[0].chance >= _EXPLAINED], key=lambda pair: pair[0].chi_square)
    alike = [m for each, m in likely if each.chi_square - likely[0][0].chi_square < _AHEAD]
    if len(alike) == 1:
        return _with_raised(_left_out(common, *likely[0]))
    if alike:
        either = " or ".join(common.names[m] for m in sorted(alike))
        return _with_raised(replace(fit, notes=(f"{either} lies elsewhere in one of the two; which, cannot be told",)))
    several = "more than one marker lies elsewhere in one of the two; none can be left out"
    return _with_raised(replace(fit, notes=_exchanged(common) or (several,)))


def _weighted(common: CommonMarkers) -> MarkerFit:
    """Fit all markers as they are."""
    if len(common.names) < FEWEST:
        raise MareyError(f"{len(common.names)} markers in common, and a bone needs {FEWEST}")
    weight = 1 / common.variance_mm2
    middle_from, middle_to = (weight @ each / weight.sum() for each in (common.from_mm, common.to_mm))
    turned, shape = common.to_mm - middle_to, common.from_mm - middle_from
    if not (_off_line(shape, weight) and _off_line(turned, weight)):
        raise MareyError(
            f"the markers {', '.join(common.names)} lie so near to one line that the turn about it is not known to "
            f"{np.degrees(LARGEST_TURN_SD):.0f} degrees"
        )
    rotation = rotations.nearest((weight[:, None] * turned).T @ shape)
    translation = middle_to - rotation @ middle_from
    residuals = common.to_mm - common.from_mm @ rotation.T - translation
    gain = _gain(rotation, common.from_mm, weight)
    return MarkerFit(
        names=common.names, rotation=rotation, translation_mm=translation, residuals_mm=residuals,
        used=np.ones(len(weight), bool), gain=gain,
        covariance=spread_through(gain, _variances(common, rotation)),
        chi_square=float((weight[:, None] * residuals**2).sum()), freedom=3 * len(weight) - 6,
    )  # fmt: skip


def _off_line(centred: Floats, weight: Floats) -> bool:
    """Return whether the turn about the longest axis of points is known well enough."""
    spread = np.linalg.eigvalsh((weight[:, None] * centred).T @ centred)
    return bool(spread[0] + spread[1] > 1 / LARGEST_TURN_SD**2)


def _determined(common: CommonMarkers) -> bool:
    weight = 1 / common.variance_mm2
    return all(_off_line(each - weight @ each / weight.sum(), weight) for each in (common.from_mm, common.to_mm))


def _gain(rotation: Floats, shape: Floats, weight: Floats) -> Floats:
    """Return the gain (6, M, 3) of the weighted least squares: (J'WJ)^-1 J'W, J of R exp(turn) p + t."""
    jacobian = np.concatenate([-rotation @ rotations.hat(shape), np.broadcast_to(np.eye(3), (len(shape), 3, 3))], -1)
    weighted = weight[:, None, None] * jacobian
    information = np.einsum("mia,mib->ab", weighted, jacobian)
    return np.einsum("ab,mib->ami", np.linalg.inv(information), weighted)


def _variances(common: CommonMarkers, rotation: Floats) -> Floats:
    """Return the covariances (M, 3, 3) of the differences in the frame that the transform leads to."""
    return np.asarray(_diagonal(common.to_sd_mm**2) + rotation @ _diagonal(common.from_sd_mm**2) @ rotation.T)


def _diagonal(values: Floats) -> Floats:
    return values[..., None] * np.eye(3)


def spread_through(gain: Floats, covariance: Floats) -> Floats:
    """Carry the markers' covariances (M, 3, 3) through a gain (6, M, 3): (6, 6)."""
    return np.einsum("ami,mij,bmj->ab", gain, covariance, gain)


def _with_raised(fit: MarkerFit) -> MarkerFit:
    """Raise the covariance where the residuals are larger than the deviations explain."""
    if fit.chance >= _LARGER:
        return fit
    ratio = fit.chi_square / fit.freedom
    said = (
        f"the markers lie {fit.residual_mm:.2f} mm (RMS) from each other, {np.sqrt(ratio):.1f} times what their "
        "standard deviations explain; those of the bone's place are raised by as much"
    )
    return replace(fit, covariance=fit.covariance * ratio, raised=ratio, notes=(*fit.notes, said))


def _left_out(common: CommonMarkers, best: MarkerFit, moved: int) -> MarkerFit:
    """Return the fit without one marker a row for it again, and name it."""
    residuals = common.to_mm - common.from_mm @ best.rotation.T - best.translation_mm
    used = np.arange(len(common.names)) != moved
    off = np.linalg.norm(residuals[moved])
    said = (
        f"{common.names[moved]} lies {off:.1f} mm from where the other {used.sum()} put it, and is left out: "
        "was it put back in another place?"
    )
    return replace(
        best, names=common.names, residuals_mm=residuals, used=used, gain=np.insert(best.gain, moved, 0.0, axis=1),
        notes=(said,),
    )  # fmt: skip


def _suspect_of_three(common: CommonMarkers) -> tuple[str, ...]:
    """Name the one of three markers that moved: the distance of the other two is right, those to it are not."""
    sd = np.sqrt(common.variance_mm2)
    off = [abs(change) / np.hypot(*sd[list(pair)]) for pair, change in _distance_changes(common)]
    right = [n for n, each in enumerate(off) if each < 2]
    if len(right) == 1:
        pair = _distance_changes(common)[right[0]][0]
        suspect = next(name for m, name in enumerate(common.names) if m not in pair)
        return (f"{suspect} seems to lie elsewhere in one of the two; with three markers none can be left out",)
    return ("the distances between the three markers are not the same in both; which one moved cannot be told",)


def _distance_changes(common: CommonMarkers) -> list[tuple[tuple[int, int], float]]:
    pairs = ((0, 1), (0, 2), (1, 2))
    length = [np.linalg.norm(each[[a for a, _ in pairs]] - each[[b for _, b in pairs]], axis=1)
              for each in (common.from_mm, common.to_mm)]  # fmt: skip
    return list(zip(pairs, (length[1] - length[0]).tolist(), strict=True))


def _exchanged(common: CommonMarkers) -> tuple[str, ...]:
    """Find two markers whose names, exchanged, would make all agree."""
    count = len(common.names)
    for a in range(count):
        for b in range(a + 1, count):
            order = [b if m == a else a if m == b else m for m in range(count)]
            turned = replace(common, to_mm=common.to_mm[order], to_sd_mm=common.to_sd_mm[order])
            if _determined(turned) and _weighted(turned).chance >= _EXPLAINED:
                return (
                    f"with {common.names[a]} and {common.names[b]} exchanged all would agree: are their names right?",
                )
    return ()

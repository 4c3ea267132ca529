"""Rigid transform between two sets of positions of the same markers, with detection of a marker that moved."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammaincc

from marey.arrays import Floats, Mask, freeze_fields
from marey.errors import MareyError
from marey.geometry import rotations

FEWEST = 3
"""Fewest markers that determine a rigid transform."""


@dataclass(frozen=True, kw_only=True)
class MarkerFitSettings:
    """Settings of the rigid fit between two sets of the same markers.

    Values without a stated source were chosen by hand.
    """

    most_rotation_sd: float = float(np.radians(10.0))
    """Largest standard deviation [rad] of the rotation: beyond it the markers lie too near to one line."""
    least_probability: float = 1e-3
    """Probability of the residuals below which a marker is taken to have moved."""
    raised_below: float = 0.05
    """Probability of the residuals below which the stated standard deviations are raised."""
    clear_difference: float = 9.0
    """Difference of chi square by which leaving one marker out is better than another: odds of 90 to 1."""
    explained: float = 0.01
    """Least probability of the others' residuals without the marker that moved."""


MARKER_FIT_DEFAULTS = MarkerFitSettings()
"""Default settings of the rigid fit between two sets of the same markers."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CommonMarkers:
    """Positions of M markers in two frames, with standard deviations along the axes of each."""

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
        """Return all markers except one."""
        kept = [m for m in range(len(self.names)) if m != index]
        return self.chosen(kept)

    def chosen(self, kept: Sequence[int]) -> "CommonMarkers":
        """Return some of the markers, in the given order."""
        rows = np.asarray(kept, np.int64)
        return CommonMarkers(
            names=tuple(self.names[m] for m in rows), from_mm=self.from_mm[rows], from_sd_mm=self.from_sd_mm[rows],
            to_mm=self.to_mm[rows], to_sd_mm=self.to_sd_mm[rows],
        )  # fmt: skip

    @property
    def variance_mm2(self) -> Floats:
        """(M,) variance of a coordinate's difference between the two frames, the mean over the axes."""
        return np.asarray((self.from_sd_mm**2 + self.to_sd_mm**2).mean(1))


@dataclass(frozen=True, eq=False, kw_only=True)
class MarkerFit:
    """A rigid transform p_to = R p_from + t between two sets of positions of M markers."""

    names: tuple[str, ...]
    rotation: Floats
    """(3, 3)."""
    translation_mm: Floats
    """(3,)."""
    residuals_mm: Floats
    """(M, 3) position minus transformed position, along the axes of the target frame; also of ignored markers."""
    used: Mask
    """(M,) false for a marker that is ignored because it moved between the two."""
    gain: Floats
    """(6, M, 3) derivatives of the rotation exp(turn) to the right of R [rad] and of the translation [mm] with respect
    to the position of each marker [mm] in the target frame."""
    covariance: Floats
    """(6, 6) of rotation [rad] and translation [mm]: from the markers' standard deviations, raised by the residuals."""
    chi_square: float
    """Sum of the squared residuals in their standard deviations."""
    freedom: int
    """Degrees of freedom of the residuals."""
    raised: float = 1.0
    """Factor by which the variances were raised."""
    notes: tuple[str, ...] = ()

    @property
    def residual_mm(self) -> float:
        """Root mean square distance of the used markers from their transformed positions."""
        return float(np.sqrt((self.residuals_mm[self.used] ** 2).sum(1).mean()))

    @property
    def chance(self) -> float:
        """Probability of residuals at least as large."""
        return float(gammaincc(self.freedom / 2, self.chi_square / 2))


def fit_markers(common: CommonMarkers, *, settings: MarkerFitSettings = MARKER_FIT_DEFAULTS) -> MarkerFit:
    """Fit the rigid transform between two sets of positions of the same markers, and detect one that moved.

    It is the linear least squares of [Alexander2003] section 2.2, in closed form (singular values). Unlike the paper,
    each marker is weighted by its standard deviation. Where noise does not explain the residuals, the marker without
    which the others agree is ignored, and named; where it may be one of several, they are named, and none is ignored.
    Three markers are too few to ignore one, but the one that moved is named if the distance of the other two is right.
    Residuals that remain unexplained raise the standard deviations.

    Args:
        common: At least three markers, not in a line.
        settings: Tuned constants of the algorithm.

    Raises:
        MareyError: There are fewer, or they lie so near to one line that the rotation about it is unknown.
    """
    fit = _weighted(common, settings=settings)
    if fit.chance >= settings.least_probability:
        return _with_raised(fit, settings=settings)
    if len(common.names) == FEWEST:
        return _with_raised(
            replace(fit, notes=_exchanged(common, settings=settings) or _suspect_of_three(common)), settings=settings
        )
    without = [
        (_weighted(common.without(m), settings=settings), m)
        for m in range(len(common.names))
        if _determined(common.without(m), settings=settings)
    ]
    likely = sorted(
        [pair for pair in without if pair[0].chance >= settings.explained], key=lambda pair: pair[0].chi_square
    )
    alike = [m for each, m in likely if each.chi_square - likely[0][0].chi_square < settings.clear_difference]
    if len(alike) == 1:
        return _with_raised(_left_out(common, *likely[0]), settings=settings)
    if alike:
        either = " or ".join(common.names[m] for m in sorted(alike))
        return _with_raised(
            replace(fit, notes=(f"{either} moved between scanner and laboratory; which one cannot be determined",)),
            settings=settings,
        )
    several = "more than one marker moved between scanner and laboratory; none can be identified and ignored"
    return _with_raised(replace(fit, notes=_exchanged(common, settings=settings) or (several,)), settings=settings)


def _weighted(common: CommonMarkers, *, settings: MarkerFitSettings) -> MarkerFit:
    """Fit all markers."""
    if len(common.names) < FEWEST:
        raise MareyError(f"it has {len(common.names)} markers in common with the reference, but needs {FEWEST}")
    weight = 1 / common.variance_mm2
    middle_from, middle_to = (weight @ each / weight.sum() for each in (common.from_mm, common.to_mm))
    turned, shape = common.to_mm - middle_to, common.from_mm - middle_from
    if not (_off_line(shape, weight, settings=settings) and _off_line(turned, weight, settings=settings)):
        raise MareyError(
            f"the markers {', '.join(common.names)} lie so near to one line that the standard deviation of the "
            f"rotation about it exceeds {np.degrees(settings.most_rotation_sd):.0f} degrees"
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


def _off_line(centred: Floats, weight: Floats, *, settings: MarkerFitSettings) -> bool:
    """Return whether the rotation about the longest axis of points is known well enough."""
    spread = np.linalg.eigvalsh((weight[:, None] * centred).T @ centred)
    return bool(spread[0] + spread[1] > 1 / settings.most_rotation_sd**2)


def _determined(common: CommonMarkers, *, settings: MarkerFitSettings) -> bool:
    weight = 1 / common.variance_mm2
    return all(
        _off_line(each - weight @ each / weight.sum(), weight, settings=settings)
        for each in (common.from_mm, common.to_mm)
    )


def _gain(rotation: Floats, shape: Floats, weight: Floats) -> Floats:
    """Return the gain (6, M, 3) of the weighted least squares: (J'WJ)^-1 J'W, J of R exp(turn) p + t."""
    jacobian = np.concatenate([-rotation @ rotations.hat(shape), np.broadcast_to(np.eye(3), (len(shape), 3, 3))], -1)
    weighted = weight[:, None, None] * jacobian
    information = np.einsum("mia,mib->ab", weighted, jacobian)
    return np.asarray(np.einsum("ab,mib->ami", np.linalg.inv(information), weighted))


def _variances(common: CommonMarkers, rotation: Floats) -> Floats:
    """Return the covariances (M, 3, 3) of the differences in the target frame."""
    return np.asarray(_diagonal(common.to_sd_mm**2) + rotation @ _diagonal(common.from_sd_mm**2) @ rotation.T)


def _diagonal(values: Floats) -> Floats:
    return values[..., None] * np.eye(3)


def spread_through(gain: Floats, covariance: Floats) -> Floats:
    """Propagate the markers' covariances (M, 3, 3) through a gain (6, M, 3) to (6, 6)."""
    return np.asarray(np.einsum("ami,mij,bmj->ab", gain, covariance, gain))


def _with_raised(fit: MarkerFit, *, settings: MarkerFitSettings) -> MarkerFit:
    """Raise the covariance where the residuals are larger than the standard deviations explain."""
    if fit.chance >= settings.raised_below:
        return fit
    ratio = fit.chi_square / fit.freedom
    note = (
        f"the markers of scanner and laboratory lie {fit.residual_mm:.2f} mm (RMS) from each other, "
        f"{np.sqrt(ratio):.1f} times what their standard deviations explain; the standard deviations of the bone's "
        "pose are raised by this factor"
    )
    return replace(fit, covariance=fit.covariance * ratio, raised=ratio, notes=(*fit.notes, note))


def _left_out(common: CommonMarkers, best: MarkerFit, moved: int) -> MarkerFit:
    """Return the fit without one marker, with a row for it again, and name it."""
    residuals = common.to_mm - common.from_mm @ best.rotation.T - best.translation_mm
    used = np.arange(len(common.names)) != moved
    off = np.linalg.norm(residuals[moved])
    note = (
        f"{common.names[moved]} lies {off:.1f} mm from the position that the other {used.sum()} markers predict, and "
        "is ignored: check whether it was attached again at another position"
    )
    return replace(
        best, names=common.names, residuals_mm=residuals, used=used, gain=np.insert(best.gain, moved, 0.0, axis=1),
        notes=(note,),
    )  # fmt: skip


def _suspect_of_three(common: CommonMarkers) -> tuple[str, ...]:
    """Name the one of three markers that moved: the distance of the other two is right, those to it are not."""
    sd = np.sqrt(common.variance_mm2)
    off = [abs(change) / np.hypot(*sd[list(pair)]) for pair, change in _distance_changes(common)]
    right = [n for n, each in enumerate(off) if each < 2]
    if len(right) == 1:
        pair = _distance_changes(common)[right[0]][0]
        suspect = next(name for m, name in enumerate(common.names) if m not in pair)
        return (
            f"{suspect} seems to have moved between scanner and laboratory; with three markers none can be ignored",
        )
    return (
        "the distances between the three markers differ between scanner and laboratory; which one moved cannot be "
        "determined",
    )


def _distance_changes(common: CommonMarkers) -> list[tuple[tuple[int, int], float]]:
    pairs = ((0, 1), (0, 2), (1, 2))
    length = [np.linalg.norm(each[[a for a, _ in pairs]] - each[[b for _, b in pairs]], axis=1)
              for each in (common.from_mm, common.to_mm)]  # fmt: skip
    return list(zip(pairs, (length[1] - length[0]).tolist(), strict=True))


def _exchanged(common: CommonMarkers, *, settings: MarkerFitSettings) -> tuple[str, ...]:
    """Find two markers whose names, exchanged, would make all agree."""
    count = len(common.names)
    for a in range(count):
        for b in range(a + 1, count):
            order = [b if m == a else a if m == b else m for m in range(count)]
            turned = replace(common, to_mm=common.to_mm[order], to_sd_mm=common.to_sd_mm[order])
            if (
                _determined(turned, settings=settings)
                and _weighted(turned, settings=settings).chance >= settings.explained
            ):
                pair = f"{common.names[a]} and {common.names[b]}"
                return (f"with {pair} exchanged, all markers would agree: check their names",)
    return ()

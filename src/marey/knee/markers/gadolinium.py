"""Detection of gadolinium markers, bright balls on the skin, in MR volumes to a fraction of a voxel."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask, frozen
from marey.knee.markers.ball_candidates import (
    BALL_CANDIDATE_DEFAULTS,
    BallCandidate,
    BallCandidateSettings,
    LimbImage,
    ball_candidates,
    limb_image,
    sphere_directions,
)
from marey.knee.markers.ball_fit import BALL_FIT_DEFAULTS, BallFit, BallFitSettings, fit_ball
from marey.knee.space.resampling import read_at
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.triangle_tree import TriangleTree
from marey.knee.space.volume import Volume


@dataclass(frozen=True, kw_only=True)
class GadoliniumSettings:
    """Settings for deciding which balls are markers.

    Values without a stated source were chosen by hand.
    """

    candidates: BallCandidateSettings = BALL_CANDIDATE_DEFAULTS
    """Settings for finding candidates."""
    ball_fit: BallFitSettings = BALL_FIT_DEFAULTS
    """Settings for the fit of a ball to the voxels about it."""
    least_open: float = 0.2
    """Least share of the directions in which only air lies beyond a ball."""
    least_air: float = 0.9
    """Least share of air along such a direction."""
    open_from_mm: float = 2.0
    """Distance [mm] from the ball at which these directions begin."""
    open_to_mm: float = 6.0
    """Least length [mm] within the image of a direction that counts."""
    radii_mm: tuple[float, float] = (1.75, 10.75)
    """Least and largest radius [mm] of a marker."""
    least_level: float = 0.9
    """Least level of a ball, as a share of the body's bright tissue."""
    most_misfit: float = 0.1
    """Largest root mean square residual about the ball's edge, as a share of its contrast; larger for shapes that
    are not round."""
    embedded: float = 0.1
    """Share of tissue about a ball from which the ball must be brighter than the tissue."""
    most_embedded: float = 0.7
    """Largest share of tissue about a ball."""
    over_tissue: float = 0.07
    """Least contrast of a ball to such tissue, as a share of its level."""
    blurred_mm: float = 2.5
    """Radius [mm] below which the smoothed image does not show a ball's level."""
    most_sd_mm: float = 0.4
    """Largest standard deviation [mm] of a coordinate."""
    least_slices: float = 1.5
    """Least diameter of a candidate, in the widest voxel spacings."""
    least_slices_fitted: float = 1.8
    """Least diameter of a fitted ball, in the widest voxel spacings: a ball visible in one slice, or in the halves
    of two, cannot be recognised as round."""
    least_visible: float = 0.6
    """Least share of a ball that lies within the image."""
    whole: float = 0.98
    """Share of a ball within the image below which it is reported as cut."""
    same_mm: float = 3.0
    """Largest distance [mm] of the same marker in two volumes."""


GADOLINIUM_DEFAULTS = GadoliniumSettings()
"""Default settings for deciding which balls are markers."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Gadolinium:
    """The gadolinium markers of a volume."""

    centres_mm: Floats
    """(M, 3) LPS."""
    centres_sd_mm: Floats
    """(M, 3) standard deviations along L, P and S."""
    diameter_mm: Floats
    """(M,) diameter of the filling, without the wall."""
    notes: tuple[str, ...] = ()
    """What a user should know, as sentences."""

    def __post_init__(self) -> None:
        for name, shape in (("centres_mm", (-1, 3)), ("centres_sd_mm", (-1, 3)), ("diameter_mm", (-1,))):
            object.__setattr__(self, name, frozen(np.reshape(getattr(self, name), shape)))

    def __len__(self) -> int:
        return len(self.centres_mm)


def find_gadolinium(
    volume: Volume,
    bones: Mapping[str, TriangleSurface] | None = None,
    *,
    settings: GadoliniumSettings = GADOLINIUM_DEFAULTS,
) -> Gadolinium:
    """Find bright balls of 2 to 10 mm radius on the skin or beside it.

    A ball is bright, round, as sharp as the image, open to the air in a fifth of all directions at least, and
    brighter than the tissue in which the rest of it lies. Its centre comes from a fit to the image's own voxels
    (`ball_fit.fit_ball`); the standard deviation is that of the fit, without distortions of the scanner.

    Args:
        volume: The image, fat suppressed or not.
        bones: Surfaces of the bones by name, if known: balls centred within a bone are not markers.
        settings: Tuned constants of the algorithm.

    Returns:
        The markers from head to foot.
    """
    if not np.ptp(volume.intensity):
        return _markers([], settings=settings)
    limb = limb_image(volume, settings=settings.candidates)
    found: list[BallFit] = []
    for place in ball_candidates(limb, settings=settings.candidates):
        if not _may_be(place, limb, volume, settings=settings):
            continue
        ball = fit_ball(volume, place, settings=settings.ball_fit)
        if ball is None or any(_same(ball, other) for other in found):
            continue
        # A neighbouring ball, modelled as tissue, increases the misfit.
        if _is_ball(ball, limb, volume, misfit=2 * settings.most_misfit, settings=settings):
            found.append(ball)
    alone = [_beside_others(volume, ball, found, settings.ball_fit) for ball in found]
    return _markers(
        [
            ball
            for ball in alone
            if _is_ball(ball, limb, volume, settings=settings) and not _within_bone(ball, bones or {})
        ],
        settings=settings,
    )


def joined(first: Gadolinium, second: Gadolinium, *, settings: GadoliniumSettings = GADOLINIUM_DEFAULTS) -> Gadolinium:
    """Combine the markers of two volumes of one knee, weighted by their precision; those in one volume are kept.

    Where the two positions of a marker differ by more than their standard deviations explain, these are increased.

    Args:
        first: Markers of one volume.
        second: Markers of the other volume.
        settings: Tuned constants of the algorithm.
    """
    pairs = _pairs(first, second, settings=settings)
    centres, sds, diameters, off = [], [], [], []
    for one, two in pairs:
        weights = np.stack([first.centres_sd_mm[one], second.centres_sd_mm[two]]) ** -2.0
        places = np.stack([first.centres_mm[one], second.centres_mm[two]])
        centre = (weights * places).sum(axis=0) / weights.sum(axis=0)
        excess = float((weights * (places - centre) ** 2).sum() / 3)
        centres.append(centre)
        sds.append(np.sqrt(max(excess, 1.0) / weights.sum(axis=0)))
        diameters.append((first.diameter_mm[one] + second.diameter_mm[two]) / 2)
        off.append(float(np.linalg.norm(places[0] - places[1])))
    notes = [*first.notes, *(note for note in second.notes if note not in first.notes)]
    if off and max(off) > 1.0:
        notes.append(
            f"The positions of a marker in the two volumes differ by {max(off):.1f} mm: the knee moved, or the volumes"
            " do not have the same coordinate system."
        )
    for index, (each, matched) in enumerate(((first, {a for a, _ in pairs}), (second, {b for _, b in pairs}))):
        for n in set(range(len(each))) - matched:
            centres.append(each.centres_mm[n])
            sds.append(each.centres_sd_mm[n])
            diameters.append(each.diameter_mm[n])
            where = ("first", "second")[index]
            notes.append(f"The marker at LPS {_as_text(each.centres_mm[n])} mm is visible in the {where} volume only.")
    order = np.argsort([-centre[2] for centre in centres], kind="stable")
    return Gadolinium(
        centres_mm=np.array(centres).reshape(-1, 3)[order],
        centres_sd_mm=np.array(sds).reshape(-1, 3)[order],
        diameter_mm=np.array(diameters)[order],
        notes=tuple(notes),
    )


def _pairs(first: Gadolinium, second: Gadolinium, *, settings: GadoliniumSettings) -> list[tuple[int, int]]:
    """Match markers that are each other's nearest and at most `same_mm` apart."""
    if not len(first) or not len(second):
        return []
    apart = np.linalg.norm(first.centres_mm[:, None] - second.centres_mm[None], axis=2)
    pairs = [(one, int(apart[one].argmin())) for one in range(len(first))]
    return [(one, two) for one, two in pairs if apart[:, two].argmin() == one and apart[one, two] < settings.same_mm]


def _may_be(place: BallCandidate, limb: LimbImage, volume: Volume, *, settings: GadoliniumSettings) -> bool:
    """Return whether a candidate may be a marker by inexpensive tests of its size and surroundings."""
    if (
        2 * place.radius_mm < settings.least_slices * float(volume.grid.spacing_mm.max())
        or _open_share(place, limb, settings=settings) < settings.least_open
    ):
        return False
    if place.radius_mm < settings.blurred_mm:
        return True
    level, beside = (
        read_at(limb.intensity, limb.grid, place.centre_mm + steps[None, :, None] * sphere_directions()[:, None, :])
        for steps in (place.radius_mm * np.array([0.0, 0.25, 0.5]), place.radius_mm + np.array([1.5, 2.5]))
    )
    tissue = beside[beside > 0.3 * np.median(level)]
    return bool(
        tissue.size < settings.embedded * beside.size
        or np.median(level) > (1 + settings.over_tissue / 2) * np.percentile(tissue, 75)
    )


def _open_share(place: BallCandidate, limb: LimbImage, *, settings: GadoliniumSettings) -> float:
    """Return the share of directions in which air reaches from a ball to the image's end.

    Dark marrow may also be connected to an end of the image, but from a position in the joint the cut shaft fills only
    a small share of the directions. Directions that leave the image at once are ignored.
    """
    ends = limb.grid.spacing_mm * limb.grid.shape[::-1]
    steps = np.arange(place.radius_mm + settings.open_from_mm, float(np.linalg.norm(ends)), 1.5)
    points = place.centre_mm + steps[None, :, None] * sphere_directions()[:, None, :]
    voxels = np.rint(limb.grid.voxels(points)).astype(np.int64)[..., ::-1]
    within: Mask = np.asarray(((voxels >= 0) & (voxels < limb.grid.shape)).all(axis=-1))
    within[within] = limb.known[tuple(voxels[within].T)]
    air = np.zeros(within.shape, dtype=bool)
    air[within] = limb.air[tuple(voxels[within].T)]
    count = within.sum(axis=1)
    counted = count * 1.5 >= settings.open_to_mm
    return float((air.sum(axis=1)[counted] >= settings.least_air * count[counted]).mean()) if counted.any() else 0.0


def _is_ball(
    ball: BallFit,
    limb: LimbImage,
    volume: Volume,
    misfit: float | None = None,
    *,
    settings: GadoliniumSettings,
) -> bool:
    misfit = settings.most_misfit if misfit is None else misfit
    sds = np.sqrt(np.diag(ball.covariance_mm2))
    bias = float(read_at(limb.bias.factor, limb.bias.grid, ball.centre_mm[None], outside=1.0)[0])
    sound = (
        settings.radii_mm[0] <= ball.radius_mm <= settings.radii_mm[1]
        and 2 * ball.radius_mm >= settings.least_slices_fitted * float(volume.grid.spacing_mm.max())
        and ball.level >= settings.least_level * limb.bright * bias
        and ball.misfit <= misfit
        and ball.tissue_share <= settings.most_embedded
        and sds.max() <= settings.most_sd_mm
        and ball.seen >= settings.least_visible
    )
    embedded = ball.tissue_share > settings.embedded
    return bool(sound and not (embedded and ball.level - ball.tissue < settings.over_tissue * ball.level))


def _same(ball: BallFit, other: BallFit) -> bool:
    return bool(np.linalg.norm(ball.centre_mm - other.centre_mm) < max(ball.radius_mm, other.radius_mm))


def _beside_others(volume: Volume, ball: BallFit, found: Sequence[BallFit], settings: BallFitSettings) -> BallFit:
    """Fit a ball again without the voxels of neighbouring balls."""
    near = [
        (other.centre_mm, other.radius_mm)
        for other in found
        if other is not ball
        and np.linalg.norm(other.centre_mm - ball.centre_mm) < ball.radius_mm + other.radius_mm + 4.0
    ]
    if not near:
        return ball
    start = BallCandidate(centre_mm=ball.centre_mm, radius_mm=ball.radius_mm, share=1.0)
    return fit_ball(volume, start, near, settings=settings) or ball


def _within_bone(ball: BallFit, bones: Mapping[str, TriangleSurface]) -> bool:
    for bone in bones.values():
        nearest = TriangleTree.of(bone).nearest(ball.centre_mm[None])
        if (ball.centre_mm - nearest.points_mm[0]) @ bone.face_normals[int(nearest.face[0])] < 0:
            return True
    return False


def _markers(balls: Sequence[BallFit], *, settings: GadoliniumSettings) -> Gadolinium:
    balls = sorted(balls, key=lambda ball: -ball.centre_mm[2])
    notes = [
        f"The marker at LPS {_as_text(ball.centre_mm)} mm is cut by the border of the image:"
        f" {100 * ball.seen:.0f} % of it is visible."
        for ball in balls
        if ball.seen < settings.whole
    ]
    return Gadolinium(
        centres_mm=np.array([ball.centre_mm for ball in balls]),
        centres_sd_mm=np.array([np.sqrt(np.diag(ball.covariance_mm2)) for ball in balls]),
        diameter_mm=np.array([2 * ball.radius_mm for ball in balls]),
        notes=tuple(notes),
    )


def _as_text(place_mm: Floats) -> str:
    return " ".join(f"{each:.1f}" for each in place_mm)

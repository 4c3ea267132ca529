"""Markers filled with gadolinium, bright balls on the skin, found in MR volumes to a part of a voxel."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats, Mask, frozen
from marey.knee.markers.ball_candidates import (
    BallCandidate,
    LimbImage,
    ball_candidates,
    limb_image,
    sphere_directions,
)
from marey.knee.markers.ball_fit import BallFit, fit_ball
from marey.knee.space.resampling import read_at
from marey.knee.space.surface import Surface
from marey.knee.space.triangle_tree import TriangleTree
from marey.knee.space.volume import Volume

_OPEN = 0.2
"""Least share of the directions in which nothing but air lies beyond a ball."""
_AIRY = 0.9
_OPEN_FROM_MM, _OPEN_TO_MM = 2.0, 6.0
_RADII_MM = (1.75, 10.75)
_BRIGHT = 0.9
"""Least level of a ball, as a share of the body's bright tissue."""
_MISFIT = 0.1
"""Most root mean square residual about its edge, as a share of its contrast: what is not round misses by more."""
_EMBEDDED, _DEEP = 0.1, 0.7
"""Share of tissue about a ball from which it must be brighter than the tissue; and the most that there may be."""
_OVER_TISSUE = 0.07
_BLURRED_MM = 2.5
"""Below this radius the image at work is too smooth to tell a ball's level."""
_SURE_MM = 0.4
"""Most standard deviation of a coordinate."""
_SLICES, _SLICES_FITTED = 1.5, 1.8
"""Least diameter in the widest voxel spacings, of a candidate and of a fitted ball: of one that shows in one slice, or
in the halves of two, nobody sees whether it is round."""
_LEAST_SEEN, _WHOLE = 0.6, 0.98
_SAME_MM = 3.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Gadolinium:
    """The markers of a volume."""

    centres_mm: Floats
    """(M, 3) LPS."""
    centres_sd_mm: Floats
    """(M, 3) standard deviations along L, P and S."""
    diameter_mm: Floats
    """(M,) of what is bright: the filling without its wall."""
    notes: tuple[str, ...] = ()
    """What a user should know, as sentences."""

    def __post_init__(self) -> None:
        for name, shape in (("centres_mm", (-1, 3)), ("centres_sd_mm", (-1, 3)), ("diameter_mm", (-1,))):
            object.__setattr__(self, name, frozen(np.reshape(getattr(self, name), shape)))

    def __len__(self) -> int:
        return len(self.centres_mm)


def find_gadolinium(volume: Volume, bones: Mapping[str, Surface] | None = None) -> Gadolinium:
    """Find bright balls of 2 to 10 mm radius on the skin or beside it.

    A ball is bright, round, as sharp as the image, open to the air in a fifth of all directions at least, and
    brighter than the tissue in which the rest of it lies. Its centre comes from a fit of the image's own voxels
    (`ball_fit.fit_ball`); the standard deviation is the fit's and knows nothing of the scanner's distortions.

    Args:
        volume: The image, fat suppressed or not.
        bones: By name, where they are known: what is centred within one is no marker.

    Returns:
        The markers from head to foot; none where there are none.
    """
    if not np.ptp(volume.intensity):
        return _told([])
    limb = limb_image(volume)
    found: list[BallFit] = []
    for place in ball_candidates(limb):
        if not _may_be(place, limb, volume):
            continue
        ball = fit_ball(volume, place)
        if ball is None or any(_same(ball, other) for other in found):
            continue
        # A neighbour that is taken for even tissue makes it look less round.
        if _is_ball(ball, limb, volume, misfit=2 * _MISFIT):
            found.append(ball)
    alone = [_beside_others(volume, ball, found) for ball in found]
    return _told([ball for ball in alone if _is_ball(ball, limb, volume) and not _within_bone(ball, bones or {})])


def joined(first: Gadolinium, second: Gadolinium) -> Gadolinium:
    """Join the markers of two volumes of one knee: those in both by their precision, those in one as they are.

    Where two places of a marker differ by more than their standard deviations say, the joint ones grow accordingly.

    Args:
        first: Of one volume.
        second: Of the other.
    """
    pairs = _pairs(first, second)
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
            f"A marker lies {max(off):.1f} mm apart in the two volumes: the knee moved, or they are not of one place."
        )
    for index, (each, matched) in enumerate(((first, {a for a, _ in pairs}), (second, {b for _, b in pairs}))):
        for n in set(range(len(each))) - matched:
            centres.append(each.centres_mm[n])
            sds.append(each.centres_sd_mm[n])
            diameters.append(each.diameter_mm[n])
            where = ("first", "second")[index]
            notes.append(f"The marker at LPS {_said(each.centres_mm[n])} mm is seen in the {where} volume only.")
    order = np.argsort([-centre[2] for centre in centres], kind="stable")
    return Gadolinium(
        centres_mm=np.array(centres).reshape(-1, 3)[order],
        centres_sd_mm=np.array(sds).reshape(-1, 3)[order],
        diameter_mm=np.array(diameters)[order],
        notes=tuple(notes),
    )


def _pairs(first: Gadolinium, second: Gadolinium) -> list[tuple[int, int]]:
    """Match markers that are each other's nearest and no farther apart than a marker is wide."""
    if not len(first) or not len(second):
        return []
    apart = np.linalg.norm(first.centres_mm[:, None] - second.centres_mm[None], axis=2)
    pairs = [(one, int(apart[one].argmin())) for one in range(len(first))]
    return [(one, two) for one, two in pairs if apart[:, two].argmin() == one and apart[one, two] < _SAME_MM]


def _may_be(place: BallCandidate, limb: LimbImage, volume: Volume) -> bool:
    """Judge a candidate by what costs little: its size in voxels, what lies about it, and whether that is air."""
    if 2 * place.radius_mm < _SLICES * float(volume.grid.spacing_mm.max()) or _open_share(place, limb) < _OPEN:
        return False
    if place.radius_mm < _BLURRED_MM:
        return True
    level, beside = (
        read_at(limb.intensity, limb.grid, place.centre_mm + steps[None, :, None] * sphere_directions()[:, None, :])
        for steps in (place.radius_mm * np.array([0.0, 0.25, 0.5]), place.radius_mm + np.array([1.5, 2.5]))
    )
    tissue = beside[beside > 0.3 * np.median(level)]
    return bool(
        tissue.size < _EMBEDDED * beside.size or np.median(level) > (1 + _OVER_TISSUE / 2) * np.percentile(tissue, 75)
    )


def _open_share(place: BallCandidate, limb: LimbImage) -> float:
    """Return the share of directions in which air reaches from a ball to the image's end.

    To its end, since dark marrow may hang together with an end of the image, too: from a place in the joint the cut
    shaft fills a small share of all directions. Those that leave the image at once tell nothing.
    """
    ends = limb.grid.spacing_mm * limb.grid.shape[::-1]
    steps = np.arange(place.radius_mm + _OPEN_FROM_MM, float(np.linalg.norm(ends)), 1.5)
    points = place.centre_mm + steps[None, :, None] * sphere_directions()[:, None, :]
    voxels = np.rint(limb.grid.voxels(points)).astype(np.int64)[..., ::-1]
    within: Mask = np.asarray(((voxels >= 0) & (voxels < limb.grid.shape)).all(axis=-1))
    within[within] = limb.known[tuple(voxels[within].T)]
    air = np.zeros(within.shape, dtype=bool)
    air[within] = limb.air[tuple(voxels[within].T)]
    count = within.sum(axis=1)
    told = count * 1.5 >= _OPEN_TO_MM
    return float((air.sum(axis=1)[told] >= _AIRY * count[told]).mean()) if told.any() else 0.0


def _is_ball(ball: BallFit, limb: LimbImage, volume: Volume, misfit: float = _MISFIT) -> bool:
    sds = np.sqrt(np.diag(ball.covariance_mm2))
    bias = float(read_at(limb.bias.factor, limb.bias.grid, ball.centre_mm[None], outside=1.0)[0])
    sound = (
        _RADII_MM[0] <= ball.radius_mm <= _RADII_MM[1]
        and 2 * ball.radius_mm >= _SLICES_FITTED * float(volume.grid.spacing_mm.max())
        and ball.level >= _BRIGHT * limb.bright * bias
        and ball.misfit <= misfit
        and ball.tissue_share <= _DEEP
        and sds.max() <= _SURE_MM
        and ball.seen >= _LEAST_SEEN
    )
    embedded = ball.tissue_share > _EMBEDDED
    return bool(sound and not (embedded and ball.level - ball.tissue < _OVER_TISSUE * ball.level))


def _same(ball: BallFit, other: BallFit) -> bool:
    return bool(np.linalg.norm(ball.centre_mm - other.centre_mm) < max(ball.radius_mm, other.radius_mm))


def _beside_others(volume: Volume, ball: BallFit, found: Sequence[BallFit]) -> BallFit:
    """Fit a ball again without the voxels of those so near that they were in its picture."""
    near = [
        (other.centre_mm, other.radius_mm)
        for other in found
        if other is not ball
        and np.linalg.norm(other.centre_mm - ball.centre_mm) < ball.radius_mm + other.radius_mm + 4.0
    ]
    if not near:
        return ball
    start = BallCandidate(centre_mm=ball.centre_mm, radius_mm=ball.radius_mm, share=1.0)
    return fit_ball(volume, start, near) or ball


def _within_bone(ball: BallFit, bones: Mapping[str, Surface]) -> bool:
    for bone in bones.values():
        nearest = TriangleTree.of(bone).nearest(ball.centre_mm[None])
        if (ball.centre_mm - nearest.points_mm[0]) @ bone.face_normals[int(nearest.face[0])] < 0:
            return True
    return False


def _told(balls: Sequence[BallFit]) -> Gadolinium:
    balls = sorted(balls, key=lambda ball: -ball.centre_mm[2])
    notes = [
        f"The marker at LPS {_said(ball.centre_mm)} mm is cut by the image's end:"
        f" {100 * ball.seen:.0f} % of it are seen."
        for ball in balls
        if ball.seen < _WHOLE
    ]
    return Gadolinium(
        centres_mm=np.array([ball.centre_mm for ball in balls]),
        centres_sd_mm=np.array([np.sqrt(np.diag(ball.covariance_mm2)) for ball in balls]),
        diameter_mm=np.array([2 * ball.radius_mm for ball in balls]),
        notes=tuple(notes),
    )


def _said(place_mm: Floats) -> str:
    return " ".join(f"{each:.1f}" for each in place_mm)

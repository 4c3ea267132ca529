"""Starts sampled about a prediction, for motion that it does not foresee; silhouettes choose among them."""

from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.fit.search.hull import meeting_point
from marey.fit.search.levels import Level
from marey.fit.search.search import Candidate, Search, StartSettings
from marey.observations.correspondence import view_of


@dataclass(frozen=True, kw_only=True)
class SampleSettings:
    """How many starts are sampled about a prediction, and how far from it."""

    momenta: tuple[float, ...] = (0.7, 0.0, 1.0, 1.5)
    """Shares of the last frame's motion that the predictions repeat, the usual one first."""
    samples: int = 32
    """Sampled starts about each of the likeliest predictions."""
    turn: float = 2.0
    """Spread of the samples' turn about the vertical, in spreads of the prediction: people turn more than they tilt."""
    rest: float = 0.25
    """Spread of all else, in spreads of the prediction: limbs are searched one by one afterwards."""
    farthest_turn: float = float(np.deg2rad(60.0))
    """No turn is sampled with a greater spread [rad]."""
    fitted: int = 10
    """Starts that are fitted at the rough level."""
    finalists: int = 3
    """Starts that are fitted at the fine level."""
    seed: int = 2006


def best_of_samples(
    body: Body,
    last: Pose,
    step: Floats,
    spread: Floats,
    fine: Level,
    rough: Level,
    *,
    coarse: Body,
    settings: SampleSettings | None = None,
) -> Candidate:
    """Start from several poses about the predictions; give the one that explains the silhouettes best.

    All starts are compared with the small silhouettes, the best are fitted to them with the body of few vertices, and
    the best of those to the larger ones ([Rosenhahn2006] section 3: several starts about the prediction, of which the
    error between silhouettes chooses). Unlike the paper, the place where the silhouettes meet also moves the starts.

    Args:
        body: whose shape stays as it is.
        last: the pose of the last frame.
        step: (D,) how it came there from the frame before.
        spread: (D,) of each coordinate about its prediction.
        fine: the silhouettes of the fit.
        rough: the same, smaller.
        coarse: the body with few vertices.
        settings: how many starts.
    """
    settings = settings or SampleSettings()
    small, large = Search(rough, StartSettings()), Search(fine, StartSettings())
    poses = sampled_poses(coarse, last, step, spread, rough, settings)
    order = np.argsort(-small.score(coarse, poses))[: settings.fitted]
    fitted = [small.fit(PosedBody(coarse, poses[i]), numbers=0, iterations=5, gate=(20.0, 8.0)) for i in order]
    fitted.sort(key=lambda candidate: -candidate.score)
    refitted = [
        large.fit(replace(c.posed, body=body), numbers=0, iterations=6, gate=(16.0, 5.0))
        for c in fitted[: settings.finalists]
    ]
    return max(refitted, key=lambda candidate: candidate.score)


def sampled_poses(
    body: Body, last: Pose, step: Floats, spread: Floats, level: Level, settings: SampleSettings
) -> list[Pose]:
    """List starts: the motion repeated in several shares, there and where the silhouettes meet, and samples about it.

    The samples are the same in every run.
    """
    rng = np.random.default_rng(settings.seed)
    predicted = [last.step(momentum * step) for momentum in settings.momenta if momentum == 0 or step.any()]
    shift = shift_to_silhouettes(PosedBody(body, predicted[0]), level)
    place = predicted[0].translation + shift
    moved = [replace(pose, translation=place) for pose in predicted]
    wide = np.minimum(settings.rest * spread, settings.farthest_turn)
    wide[5] = min(settings.turn * spread[5], settings.farthest_turn)
    poses = [*predicted, *moved]
    for pose in (predicted[0], *moved[:2]):
        poses += [pose.step(rng.normal(size=len(spread)) * wide) for _ in range(settings.samples)]
    return poses


def shift_to_silhouettes(posed: PosedBody, level: Level) -> Floats:
    """Give the shift (3,) [m] that carries the body to where the middles of its silhouettes meet; none where none do.

    What the picture's border cuts counts in both alike, since the body is drawn into the same pictures.
    """
    seen, drawn = [], []
    for camera, mask in zip(level.cameras, level.masks, strict=True):
        own = view_of(posed, camera).mask()
        if mask.any() and own.any():
            seen.append((camera, mask))
            drawn.append((camera, own))
    if len(seen) < 2:
        return np.zeros(3)
    return meeting_point(seen) - meeting_point(drawn)

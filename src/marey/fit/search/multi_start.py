"""Starts sampled about a prediction, for motion that it misses; the silhouettes choose among them."""

from dataclasses import dataclass, replace

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.fit.search.hull import meeting_point
from marey.fit.search.levels import SilhouetteLevel
from marey.fit.search.search import Candidate, Search, StartSettings
from marey.observations.correspondence import view_of


@dataclass(frozen=True, kw_only=True)
class SampleSettings:
    """Settings of the starts sampled about a prediction. Chosen by hand; other values were not measured."""

    momenta: tuple[float, ...] = (0.7, 0.0, 1.0, 1.5)
    """Shares of the last frame's motion that the predictions repeat, the usual share first."""
    samples: int = 32
    """Number of starts sampled about each of the likeliest predictions."""
    turn: float = 2.0
    """Standard deviation of the samples' rotation about the vertical, in those of the prediction: people turn more than
    they tilt."""
    rest: float = 0.25
    """Standard deviation of all other coordinates, in those of the prediction: limbs are searched one by one
    afterwards."""
    farthest_turn: float = float(np.deg2rad(60.0))
    """Largest standard deviation of a sampled angle [rad]."""
    fitted: int = 10
    """Number of starts that are fitted at the rough level."""
    finalists: int = 3
    """Number of starts that are fitted at the fine level."""
    seed: int = 2006
    """Seed of the samples, which are the same in every run."""


def best_of_samples(
    body: Body,
    last: Pose,
    step: Floats,
    spread: Floats,
    fine: SilhouetteLevel,
    rough: SilhouetteLevel,
    *,
    coarse: Body,
    settings: SampleSettings | None = None,
) -> Candidate:
    """Fit several poses sampled about the predictions, and return the candidate of best agreement.

    All starts are compared with the small silhouettes, the best are fitted to them with the body of few vertices, and
    the best of those to the larger ones ([Rosenhahn2006] section 3: several starts about the prediction, of which the
    error between silhouettes chooses). Unlike the paper, the place where the silhouettes meet also moves the starts.

    Args:
        body: Body of fixed shape.
        last: Pose of the last frame.
        step: (D,) change to it from the frame before.
        spread: (D,) standard deviation of each coordinate from its prediction.
        fine: Silhouettes of the final fit.
        rough: The same silhouettes at a smaller size.
        coarse: The body with few vertices.
        settings: Numbers and spread of the samples.
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
    body: Body, last: Pose, step: Floats, spread: Floats, level: SilhouetteLevel, settings: SampleSettings
) -> list[Pose]:
    """Return starts: predictions with several shares of the motion, there and where the silhouettes meet, and samples.

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


def shift_to_silhouettes(posed: PosedBody, level: SilhouetteLevel) -> Floats:
    """Return the shift (3,) [m] of the body to the place where the centroids of its silhouettes meet; zero if unknown.

    The image's border affects both alike, since the body is drawn into the same images.
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

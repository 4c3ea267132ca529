"""Settings and limits that the orthographic and perspective factorisations share."""

from dataclasses import dataclass

FEWEST_FRAMES = 6
"""Least number of frames of a sequence, and of frames in which a point must be seen. Chosen by hand; results were not
measured against other values."""
INITIAL_NOISE = 0.005
"""Initial standard deviation of the noise, as a fraction of the object's size in the image; it is then estimated."""
COMPARISON_NOISE = 0.01
"""Least standard deviation of the noise when candidates are compared, as a fraction of the object's size in the image.
What few modes leave unexplained is not noise, and would otherwise decide the comparison."""
LEAST_MODE_SIZE = 1e-3
"""Modes with smaller weights, as a fraction of the object's size, are not part of the result. Chosen by hand; results
were not measured against other values."""


@dataclass(frozen=True, kw_only=True)
class RefinementSettings:
    """Settings of the final fit of the Gaussian model before orthographic cameras.

    The defaults were chosen while looking at the five sequences of `nonrigid/` (docs/explanation/nonrigid.md).
    """

    mode_counts: tuple[int, ...] = (3, 6, 12, 20, 36)
    """Numbers of modes of the refined models, one of which is chosen. With 12 only, errors on tracks without noise are
    1.1 to 1.5 times as large; with 36, that of `face` degraded is 0.08 instead of 0.036
    (docs/explanation/nonrigid.md)."""
    cost_share: float = 0.3
    """Fraction of `basis_cost` that counts in the choice of the number of modes. With all of it (near the Bayesian
    information criterion) fewer modes are kept than are useful, with none of it too many for a simple shape
    (docs/explanation/nonrigid.md)."""
    rigid_cost_share: float = 0.75
    """Fraction of `basis_cost` that modes must be worth against a rigid object. Noise alone fills modes that are worth
    up to half of their cost; with the full cost, two of four recordings of real skin over 13 frames count as rigid
    (docs/explanation/nonrigid.md)."""
    rounds: int = 12
    """Number of rounds of expectation maximisation."""
    initial_noise: float = INITIAL_NOISE
    """Initial standard deviation of the noise, as a fraction of the object's size in the image."""
    least_noise: float = 0.005
    """Least standard deviation of the noise before one orthographic camera, as a fraction of the object's size in the
    image. What the modes leave unexplained is not zero: with a noise that approaches zero, tracks without noise are
    followed so closely that depth becomes worse. Metric A without a limit, with 0.3 and with 1 %: `shark_exact` 0.148,
    0.010, 0.020; `dance` 0.142, 0.119, 0.108; `pickup` 0.038, 0.035, 0.034; `stretch` 0.035, 0.030, 0.029; `yoga`
    0.058, 0.056, 0.056 (the script was not kept; docs/accuracy/nonrigid.md has the errors with 0.5 %)."""
    least_mode_size: float = LEAST_MODE_SIZE
    """Modes with smaller weights, as a fraction of the object's size, are not part of the result."""

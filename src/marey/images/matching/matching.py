"""Least-squares matching of patches between two images, with a precision of a few hundredths of a pixel.

A patch of the template is mapped into the search image by an affine map and compared there up to a gain and an offset
of its grey values ([Plaenkers1999] section 2.1, after [Gruen1985]): six and two parameters, by Gauss-Newton.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import IntEnum
from itertools import pairwise

import numpy as np

from marey.arrays import Floats, Integers, Mask, freeze_fields
from marey.errors import SettingProblem
from marey.images.matching import matching_kernels as kernels
from marey.images.matching.splines import SplinePicture
from marey.process import usable_cores

_SHARE = 256
"""Least number of patches per thread. Chosen by hand."""


class Outcome(IntEnum):
    """Outcome of the matching of a patch."""

    CONVERGED = kernels.CONVERGED
    """The steps became small."""
    LEFT_PICTURE = kernels.LEFT_PICTURE
    """The patch extends beyond the template or the search image."""
    TEXTURELESS = kernels.TEXTURELESS
    """The template's gradients are noise, or all have the same direction."""
    DEGENERATE = kernels.DEGENERATE
    """The affine map folds the patch, or stretches or shrinks it too much."""
    STRAYED = kernels.STRAYED
    """The patch moved farther from its start than allowed."""
    UNLIKE = kernels.UNLIKE
    """The matched patch is flat, or its contrast is inverted."""
    UNFINISHED = kernels.UNFINISHED
    """The steps were still large after the largest number of them."""
    MISSING = kernels.MISSING
    """The start is NaN, or an image is NaN within the patch."""


@dataclass(frozen=True, kw_only=True)
class MatchSettings:
    """Settings of least-squares matching.

    Raises:
        SettingProblem: A value is impossible.
    """

    size: int = 13
    """Width and height of a patch [px], odd; larger ones are more precise if the surface is flat."""
    shift_only: bool = False
    """Estimate only the shift and keep the initial affine map: for patches with too little texture for all."""
    steps: int = 20
    """Largest number of Gauss-Newton steps."""
    precision: float = 0.02
    """Size of the last step, root mean square over the patch's pixels [px]; the remaining error is at most 10 % of
    it."""
    reach: float = 4.0
    """Largest distance of a match from its start [px]."""
    stretch: float = 2.0
    """Largest factor by which the affine map stretches or shrinks the patch in any direction."""
    noise: float = 1.0
    """Standard deviation of a pixel's noise in the template [grey levels], which distinguishes texture from noise and
    determines the noise of the gradients. Too large a value biases the matches; 0 disables the correction."""
    texture: float = 2.0
    """Least mean square gradient in the patch's weakest direction, as a multiple of the noise's variance [1/px2]; noise
    itself has 1.4."""

    def __post_init__(self) -> None:
        faults = []
        if self.size < 3 or self.size % 2 == 0:
            faults.append(f"size is {self.size}; a patch has an odd number of pixels from 3 up")
        if self.steps < 1:
            faults.append(f"steps is {self.steps}; at least one step is needed")
        if self.stretch < 1:
            faults.append(f"stretch is {self.stretch:g}; it is a factor from 1 up")
        for name in ("precision", "reach"):
            if not getattr(self, name) > 0:
                faults.append(f"{name} is {getattr(self, name):g}; it must be positive")
        for name in ("noise", "texture"):
            if not getattr(self, name) >= 0:
                faults.append(f"{name} is {getattr(self, name):g}; it must not be negative")
        if faults:
            raise SettingProblem(f"Matching cannot use these settings: {'; '.join(faults)}.")

    @property
    def half(self) -> int:
        """Pixels from a patch's centre to its edge."""
        return self.size // 2


@dataclass(frozen=True, eq=False, kw_only=True)
class Matches:
    """Matches of n patches; NaN for those that were not found."""

    pixels: Floats
    """(n, 2) centres of the patches in the search image [px]."""
    search_from_template: Floats
    """(n, 2, 2) linear part of the affine map."""
    covariance: Floats
    """(n, 2, 2) covariance of the pixels [px2], from the residuals of the grey values."""
    correlation: Floats
    """(n,) correlation of the grey values, 1 if they agree up to gain and offset; also known for some failures."""
    gain: Floats
    """(n,) grey values of the search image are gain times template plus offset."""
    offset: Floats
    """(n,) [grey levels]."""
    noise: Floats
    """(n,) standard deviation of a pixel's noise that explains the residuals, if equal in both images [grey levels]. A
    value above the camera's noise means that the images differ by more than gain, offset and affine map."""
    steps: Integers
    """(n,) number of Gauss-Newton steps."""
    outcome: Integers
    """(n,) one `Outcome` per patch."""

    def __post_init__(self) -> None:
        freeze_fields(self, "pixels", "search_from_template", "covariance", "correlation", "gain", "offset", "noise")
        freeze_fields(self, "steps", "outcome", dtype=np.int64)

    def __len__(self) -> int:
        """Count the patches."""
        return len(self.outcome)

    @property
    def converged(self) -> Mask:
        """(n,) whether the patch was found."""
        return np.asarray(self.outcome == Outcome.CONVERGED)


DEFAULT = MatchSettings()
"""Default settings of least-squares matching."""


def match(
    template: SplinePicture,
    search: SplinePicture,
    pixels: Floats,
    starts: Floats,
    *,
    along: Floats | None = None,
    maps: Floats | None = None,
    settings: MatchSettings = DEFAULT,
    threads: int = 1,
) -> Matches:
    """Match patches of the template image in the search image.

    Each step regresses the search patch on the template's derivatives by the map, its grey values, and a constant; the
    map is then changed by the coefficients of the derivatives. Unlike [Gruen1985], the gradients are the template's and
    constant over all steps (inverse composition [Baker2004]): the minimum is the same to first order in the noise, and
    a step costs less. Ours: the covariance includes the effects of both images' noise, and the result is corrected for
    their bias.

    Args:
        template: Image from which patches are taken.
        search: Image in which they are matched; its size may differ.
        pixels: (n, 2) centres of the patches in the template, not necessarily whole numbers [px].
        starts: (n, 2) initial positions in the search image, to within about 1/3 of the texture's wavelength [px].
        along: (n, 2) directions, of any length, of lines through the starts to which the centres are constrained:
            epipolar lines from `marey.cameras.epipolar`. None leaves the centres free.
        maps: (n, 2, 2) linear parts of the initial affine maps; None for the identity.
        settings: Size of the patches and limits.
        threads: Number of threads that share the patches; 0 for one per core.

    Returns:
        One match per patch. A patch that is not found is no error: its `outcome` gives the reason.
    """
    pixels, count = np.ascontiguousarray(pixels, float), len(pixels)
    to_search = np.tile([0.0, 0, 1, 0, 0, 1], (count, 1))
    to_search[:, :2] = starts
    if maps is not None:
        to_search[:, 2:] = np.reshape(maps, (count, 4))
    lines = np.zeros((count, 2))
    if along is not None:
        length = np.linalg.norm(along, axis=-1, keepdims=True)
        lines = np.divide(along, length, out=np.full((count, 2), np.nan), where=length > 0)
    quality, outcome = np.empty((count, 8)), np.empty(count, np.int8)
    columns = 2 if settings.shift_only else 6
    least = settings.texture * settings.noise**2
    limits = np.array([settings.steps, settings.precision, settings.reach, settings.stretch, least, settings.noise**2])

    def work(some: slice) -> None:
        kernels.match_patches(
            template.coefficients, search.coefficients, pixels[some], to_search[some], lines[some], along is not None,
            settings.half, columns, limits, quality[some], outcome[some],
        )  # fmt: skip

    share_out(work, count, threads or usable_cores())
    return _matches(to_search, quality, outcome)


def share_out(work: Callable[[slice], None], count: int, threads: int) -> None:
    """Process patches in several threads.

    Args:
        work: Processes a part of the patches.
        count: Number of patches.
        threads: Largest number of threads; few patches are processed by fewer.
    """
    parts = max(1, min(threads, count // _SHARE))
    if parts == 1:
        work(slice(None))
        return
    bounds = np.linspace(0, count, parts + 1).astype(int)
    with ThreadPoolExecutor(parts) as pool:
        list(pool.map(work, [slice(a, b) for a, b in pairwise(bounds)]))


def _matches(to_search: Floats, quality: Floats, outcome: np.ndarray) -> Matches:
    failed = outcome != Outcome.CONVERGED
    to_search[failed] = np.nan
    quality[np.ix_(failed, [0, 1, 2, 4, 5, 6])] = np.nan
    covariance = quality[:, [0, 2, 2, 1]].reshape(-1, 2, 2)
    correlation, gain, offset, noise, steps = quality[:, 3:].T
    return Matches(
        pixels=to_search[:, :2], search_from_template=to_search[:, 2:].reshape(-1, 2, 2), covariance=covariance,
        correlation=correlation, gain=gain, offset=offset, noise=noise, steps=steps, outcome=outcome,
    )  # fmt: skip

"""Settings of a surface measurement: spacing, patches, and thresholds for matches."""

from dataclasses import dataclass
from typing import NamedTuple

from marey.errors import SettingProblem


class Pass(NamedTuple):
    """Patch size and thresholds of one matching pass."""

    size: int
    """Width and height of the patches [px]."""
    correlation: float
    """Least correlation."""
    sd_px: float
    """Largest standard deviation in the weakest direction [px]."""


@dataclass(frozen=True, kw_only=True)
class SurfaceSettings:
    """Settings of a surface measurement.

    Raises:
        SettingProblem: A value is impossible.
    """

    spacing: int = 2
    """Distance from point to point in the template [px]."""
    patch: int = 13
    """Width and height of the patches [px], odd; where texture is weak, larger ones are tried."""
    enlarged: tuple[float, ...] = (1.6, 2.4, 3.2, 4.0)
    """Factors by which patches grow at points where smaller ones find no match, or an uncertain one."""
    correlation: float = 0.75
    """Least correlation of a patch with the template's, and ..."""
    correlation_step: float = 0.05
    """... by how much this bound is lower for each larger size of patch: more pixels agree less often by chance."""
    sd_px: float = 0.06
    """Greatest standard deviation of a match in its weakest direction [px]."""
    relaxed_sd_factor: float = 2.5
    """Factor on this standard deviation in the last passes, for points where no patch of any size is more precise."""
    epipolar_px: float = 2.0
    """Greatest distance of a match from the epipolar line [px]; less where the seeds show that the cameras are better
    than that."""
    residual_px: float = 1.0
    """Greatest root mean square residual of the forward intersection [px]; less where most points are better."""
    angle: float = 0.7
    """Cameras whose views of the scene differ by more are not matched with each other [rad]."""
    seeds: int = 900
    """Largest number of the template's corners that are searched in the other images."""

    def __post_init__(self) -> None:
        faults = []
        if self.spacing < 1:
            faults.append(f"spacing is {self.spacing}; it must be a whole number of pixels, 1 or more")
        if self.patch < 5 or self.patch % 2 == 0 or self.patch > 101:
            faults.append(f"patch is {self.patch}; it must be an odd number of pixels from 5 to 101")
        if not 0 < self.correlation < 1:
            faults.append(f"correlation is {self.correlation:g}; it must lie between 0 and 1")
        for name in ("sd_px", "epipolar_px", "residual_px", "angle"):
            if not getattr(self, name) > 0:
                faults.append(f"{name} is {getattr(self, name):g}; it must be positive")
        if faults:
            raise SettingProblem(f"A surface cannot be measured with these settings: {'; '.join(faults)}.")

    @property
    def passes(self) -> tuple[Pass, ...]:
        """The successive passes: increasingly large patches, and last patches with a relaxed standard deviation."""
        sizes = [2 * round(factor * (self.patch - 1) / 2) + 1 for factor in (1.0, *self.enlarged)]
        least = [max(0.3, self.correlation - k * self.correlation_step) for k in range(len(sizes))]
        strict = [Pass(size, bound, self.sd_px) for size, bound in zip(sizes, least, strict=True)]
        last = [Pass(each.size, each.correlation, self.relaxed_sd_factor * self.sd_px) for each in strict[:3]]
        return (*strict, *last)

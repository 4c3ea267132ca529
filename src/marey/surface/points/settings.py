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
class SurfaceSeedSettings:
    """Settings of the search for seeds along epipolar lines.

    The defaults were chosen by hand unless a field says otherwise; results were not measured against other values.
    """

    largest_side_px: int = 720
    """Largest side of the images in the sweep, for which larger ones are reduced [px]."""
    half_px: int = 8
    """Half-size of the patches that the sweep compares [px]."""
    correlation: float = 0.75
    """Least correlation in the sweep."""
    clear_difference: float = 0.04
    """Least difference of the best hypothesis's correlation from that of any distant one."""
    distant_px: float = 4.0
    """Least distance of a distant hypothesis [px of the sweep]."""
    backward_px: float = 2.0
    """Largest distance between the start and the end of a search forward and backward [px of the sweep]."""
    intersection_px: float = 2.5
    """Largest residual of the intersection of a seed's rays [px]."""
    step_px: float = 1.5
    """Distance of successive hypotheses [px of the sweep], over which patches are still similar."""
    supports: int = 65
    """Number of depths at which the epipolar curve and the affine map are computed; between them they are interpolated
    linearly."""
    nearest_baselines: float = 0.8
    """Least searched distance in baselines: at smaller ones the viewing directions differ by more than 64 degrees."""
    farthest_ratio: float = 1e-4
    """Ratio of the inverse distances of the farthest and the nearest points."""
    refined_reach_px: tuple[float, float] = (4.0, 2.5)
    """Largest distance of a refined seed from the result of the sweep: the larger of a number of pixels [px] and of
    pixels of the sweep."""
    noise_ratio: float = 1.0
    """Least mean square gradient in a corner's weakest direction, as a multiple of the noise's variance [1/px2]; noise
    itself has 0.2."""
    least_noise: float = 1.0
    """Lower limit of the noise's standard deviation, because compression hides noise [grey levels]."""
    cell_px: int = 16
    """Least width of the cells that have one corner each [px]; between corners, matches grow."""
    border_px: int = 8
    """Width of the image border without corners [px]."""


SURFACE_SEED_DEFAULTS = SurfaceSeedSettings()
"""Default settings of the search for seeds."""


@dataclass(frozen=True, kw_only=True)
class ClickedSeedSettings:
    """Settings of the search about clicked seeds.

    The defaults were chosen by hand; results were not measured against other values.
    """

    click_sd_px: float = 3.0
    """Standard deviation of a clicked position [px]."""
    reach_px: int = 12
    """Half-width of the search about a click [px]."""
    step_px: float = 1.5
    """Distance between the positions that are tried [px]."""
    half_px: int = 10
    """Half-size of the patches that are compared [px]."""
    refined_reach_px: float = 4.0
    """Largest distance of a refined seed from the most similar position [px]."""


CLICKED_SEED_DEFAULTS = ClickedSeedSettings()
"""Default settings of the search about clicked seeds."""


@dataclass(frozen=True, kw_only=True)
class GrowthSettings:
    """Settings of the growth of matches from patch to patch.

    The defaults were chosen by hand unless a field says otherwise; results were not measured against other values.
    """

    attempts: int = 1
    """Number of attempts to match a patch with each size."""
    steps: int = 15
    """Largest number of steps of a match: three or four are usual with a good neighbour, more if texture is weak."""
    precision_px: float = 0.04
    """Size of the last step of a match [px]; the remaining error is at most 10 % of it."""
    reach_ratio: float = 0.8
    """Largest distance of a match from its neighbour's prediction, as a share of the spacing."""
    least_reach_px: float = 1.5
    """Lower limit of that distance [px]."""
    halved_spacing_px: int = 4
    """Least spacing at which a failed step between neighbours is repeated in two halves [px]."""


GROWTH_DEFAULTS = GrowthSettings()
"""Default settings of the growth of matches."""


@dataclass(frozen=True, kw_only=True)
class MatchCheckSettings:
    """Settings of the checks of matches by their neighbours and by the reverse match.

    The defaults were chosen by hand; results were not measured against other values.
    """

    tolerance_px: float = 0.3
    """Largest distance of a match from the prediction by its neighbour's affine map, without spacing and noise [px]."""
    spacing_ratio: float = 0.05
    """Increase of this distance per pixel of the spacing, because the maps vary between patches."""
    deviations: float = 3.0
    """Increase of this distance per standard deviation of the two matches."""
    agreeing_neighbours: int = 3
    """Least number of neighbours that agree."""
    agreeing_share: float = 0.5
    """Least share of the neighbours that agree."""
    piece_px: int = 16
    """Least width and height of a piece of surface, in pixels of the template: about one patch."""
    backward_px: float = 1.0
    """Largest distance between the start and the end of a match forward and backward [px]."""
    backward_reach_px: float = 2.0
    """Largest distance of a match backward from its start [px]."""


MATCH_CHECK_DEFAULTS = MatchCheckSettings()
"""Default settings of the checks of matches."""


@dataclass(frozen=True, kw_only=True)
class IntersectionSettings:
    """Settings of the forward intersection of matched rays.

    The defaults were chosen by hand; results were not measured against other values.
    """

    floor_px: float = 0.06
    """Standard deviation of a match's errors beyond its covariance: interpolation, and differences in lighting and
    compression between the views [px]."""
    bend_neighbours: int = 3
    """Largest number of neighbours on each side, distributed over the patch, by which the surface's curvature is
    estimated."""
    bend_sd_ratio: float = 0.5
    """Standard deviation of the bend's effect, as a share of it: it depends on the distribution of texture in the
    patch."""
    median_ratio: float = 4.0
    """Residuals above this multiple of the median are gross errors."""
    least_limit_px: float = 0.15
    """Lower limit of that threshold [px]."""
    unmet_ratio: float = 0.75
    """Above this ratio of the median residual to the largest accepted one the rays do not intersect at all: the matches
    lie on outlines of untextured bodies, which differ between the cameras, or the cameras are not calibrated."""


INTERSECTION_DEFAULTS = IntersectionSettings()
"""Default settings of the forward intersection."""


@dataclass(frozen=True, kw_only=True)
class RigRefinementSettings:
    """Settings of the correction of the cameras by the matches.

    The defaults were chosen by hand; results were not measured against other values.
    """

    rotation_sd_px: float = 1.0
    """Standard deviation of a calibrated camera's rotation, as a displacement at the image centre [px]."""
    shift_sd_ratio: float = 0.002
    """Standard deviation of a calibrated camera's position, as a share of its distance from the fixed camera."""
    most_matches: int = 600
    """Largest number of matches in total: patches overlap, and deviations from the lens model are correlated over large
    parts of the images, so that more matches would add no information."""
    least_matches: int = 100
    """Least number of matches for a refinement."""
    rounds: int = 12
    """Number of Gauss-Newton iterations."""
    cauchy_scale: float = 2.4
    """Scale of Cauchy's weights: residuals of this many standard deviations have half the weight."""
    significant_px: float = 0.05
    """Least decrease of the median residual of a significant correction [px]."""
    significant_ratio: float = 0.92
    """Largest ratio of the median residual after a significant correction to that before."""


RIG_REFINEMENT_DEFAULTS = RigRefinementSettings()
"""Default settings of the correction of the cameras."""


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
    most_searched: int = 4
    """Largest number of images in which a template is searched. Chosen by hand."""
    least_epipolar_px: float = 0.5
    """Lower limit of the threshold for epipolar distances that is derived from the seeds [px]. Chosen by hand."""
    epipolar_median_ratio: float = 8.0
    """This threshold as a multiple of the seeds' median distance. Chosen by hand."""
    seed_search: SurfaceSeedSettings = SURFACE_SEED_DEFAULTS
    """How the corners are searched."""
    clicked: ClickedSeedSettings = CLICKED_SEED_DEFAULTS
    """How clicked seeds are refined."""
    growth: GrowthSettings = GROWTH_DEFAULTS
    """How matches grow from patch to patch."""
    checks: MatchCheckSettings = MATCH_CHECK_DEFAULTS
    """How matches are checked by their neighbours."""
    intersection: IntersectionSettings = INTERSECTION_DEFAULTS
    """How points are computed from matches."""
    refinement: RigRefinementSettings = RIG_REFINEMENT_DEFAULTS
    """How the cameras are corrected."""

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


SURFACE_DEFAULTS = SurfaceSettings()
"""Default settings of a surface measurement."""

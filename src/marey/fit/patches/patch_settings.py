"""Settings of the patches of the surface that are tracked through the images."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class SurfaceTrackSettings:
    """Where patches are placed, when a track ends, and how uncertain it is.

    The defaults were chosen by hand on `stealth`, `jacks` and `market`; those without a figure were not measured
    against other values. The benchmark capture/surface_tracks measures the results.
    """

    half: int = 5
    """Pixels from the centre of a patch to its edge."""
    smoothing_px: float = 0.8
    """Standard deviation of the Gaussian by which the images are smoothed [px]."""
    interval: int = 5
    """Number of frames after which new patches are placed where some are missing."""
    per_segment: int = 2
    """Number of patches of a limb's segment in one camera."""
    per_trunk_segment: int = 3
    """Number of patches of a segment of the trunk or the head in one camera."""
    border_px: float = 2.0
    """Least distance of a patch's pixels from the outline, where the background shows through [px]."""
    least_facing: float = 0.4
    """Least cosine between the surface's normal and the line of sight, where a patch is placed."""
    least_share: float = 0.5
    """Least share of a patch's pixels that must be visible."""
    turn_sd: float = 0.35
    """Largest standard deviation of its segment's turn that a patch may give, for it to be placed [rad]."""
    search: int = 2
    """Largest shift from one image to the next beyond the prediction [px]."""
    farthest_px: float = 5.0
    """Shift from the prediction, after the correction of the segment's turn, at which a track ends [px]."""
    sudden: float = 0.2
    """Turn of a segment about its axis from one image to the next above which the body is not used as prediction: it
    may be a jump between two answers to the same silhouettes [rad]."""
    unlike: float = 0.3
    """A track ends when its grey values differ from the first ones by more than noise and this share of their
    variance."""
    noise: float = 1.5
    """Standard deviation of the noise of a pixel in the smoothed images [grey levels]."""
    sd_px: float = 0.4
    """Standard deviation of a position that is due to shading and to errors of the predicted deformation [px]. With
    twice the variance of positions, the errors of the turns of `stealth`, `jacks` and `market` rose from 13.5, 7.6 and
    8.7 to 14.0, 8.4 and 9.1 degrees (before heights were estimated)."""
    slip_m: float = 0.003
    """Standard deviation of the slip of skin and cloth along the body [m]. With 1.5 mm `stealth` and `jacks` had errors
    of the turns of 13.8 and 7.4 instead of 13.5 and 7.6 degrees (before heights were estimated); on people the skin
    slips by more."""
    growth_px: float = 0.02
    """Standard deviation that is added per frame since the first image of a patch, as its appearance changes [px]."""
    least_frames: int = 3
    """Least number of frames of a track that is used. Shorter ones say little that smoothness does not; the time of
    the refinement grows with the square of the number of tracks that a frame shows."""
    offset_sd_m: float = 0.1
    """Standard deviation of the place of a patch along the surface: so large that it is free [m]."""
    height_sd_m: float = 0.01
    """Standard deviation of the height of a patch above the body's surface: that of clothes, and of the body [m].
    Without heights, patches of the pelvis moved the hips of `reach` by 2.5 mm; with 3 cm its joint error is the same
    within 0.1 mm."""

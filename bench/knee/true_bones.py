"""What benches of the moved knee share: the true bones of a trial of real skin markers."""

from collections.abc import Mapping, Sequence

import numpy as np

from marey.markers.data.bone_motion import BoneMotion


def true_bones(truth: Mapping[str, np.ndarray], segments: Sequence[str]) -> BoneMotion:
    """The poses that a trial's NPZ holds (mm), known exactly."""
    rotation = np.stack([truth[f"{s}_rotation"] for s in segments], 1)
    return BoneMotion(
        segments=tuple(segments), rotation=rotation, origin=np.stack([truth[f"{s}_origin"] for s in segments], 1) / 1e3,
        covariance=np.zeros((*rotation.shape[:2], 6, 6)),
    )  # fmt: skip

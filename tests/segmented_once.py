"""A segmentation of bones that is computed once for all tests of a worker with the same images and settings."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from marey.knee.bones.bones import BoneSegmentation, segment_bones
from marey.knee.space.volume import Labels, Volume

_FOUND: dict[object, BoneSegmentation] = {}


def segment_bones_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let `segment_knee` take the bones that it found for an earlier test from the same images, template and seeds."""
    monkeypatch.setattr("marey.pipelines.knee.segment.segment_bones", _remembered)


def _remembered(
    volumes: Sequence[Volume], *, template: Labels | None, seeds_mm: Mapping[str, np.ndarray],
    report: Callable[[str, float], None],
) -> BoneSegmentation:  # fmt: skip
    images = tuple((each.intensity.tobytes(), _grid(each)) for each in volumes)
    known = None if template is None else (template.labels.tobytes(), _grid(template))
    key = (images, known, tuple((name, place.tobytes()) for name, place in seeds_mm.items()))
    if key not in _FOUND:
        _FOUND[key] = segment_bones(volumes, template=template, seeds_mm=seeds_mm, report=report)
    return _FOUND[key]


def _grid(image: Volume | Labels) -> tuple[Any, ...]:
    return image.grid.shape, image.grid.lps_from_voxel.tobytes()

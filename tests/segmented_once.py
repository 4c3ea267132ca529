"""Bones of knees that are segmented once for all tests with the same images and settings, whatever their worker."""

import hashlib
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import pytest

from marey.knee.bones.bones import BoneSegmentation, segment_bones
from marey.knee.space.volume import Labels, Volume
from tests.computed_once import computed_once


def segment_bones_once(monkeypatch: pytest.MonkeyPatch, factory: pytest.TempPathFactory) -> None:
    """Let `segment_knee` take the bones that it found for an earlier test from the same images, template and seeds."""

    def remembered(
        volumes: Sequence[Volume], *, template: Labels | None, seeds_mm: Mapping[str, np.ndarray],
        report: Callable[[str, float], None],
    ) -> BoneSegmentation:  # fmt: skip
        digest = hashlib.sha256()
        for each in volumes:
            _add(digest, each.intensity, each)
        if template is not None:
            _add(digest, template.labels, template)
        for name, place in seeds_mm.items():
            digest.update(name.encode() + place.tobytes())

        def compute() -> BoneSegmentation:
            return segment_bones(volumes, template=template, seeds_mm=seeds_mm, report=report)

        return computed_once(factory, f"bones-{digest.hexdigest()[:16]}", compute)

    monkeypatch.setattr("marey.pipelines.knee.segment.segment_bones", remembered)


def _add(digest: "hashlib._Hash", values: np.ndarray, image: Volume | Labels) -> None:
    digest.update(str((values.dtype, image.grid.shape)).encode() + image.grid.lps_from_voxel.tobytes())
    digest.update(np.ascontiguousarray(values).tobytes())

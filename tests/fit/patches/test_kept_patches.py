from dataclasses import replace

import numpy as np
from tests import worlds

from marey.body.articulation.pose import SkinPoints
from marey.fit.patches.kept_patches import KeptPatches
from marey.observations.surface_tracks import TrackedPatches


def batch_of(camera, tracks: np.ndarray, rng: np.random.Generator) -> TrackedPatches:
    """Return patches whose constant values follow from the numbers of their tracks."""
    count = len(tracks)
    return TrackedPatches(
        camera=camera, tracks=tracks, segments=tracks % 16, directions=tracks[:, None, None] * np.ones((3, 3)),
        where=SkinPoints(face=7 * tracks, barycentric=tracks[:, None] * np.ones(3)), pixels=rng.normal(size=(count, 2)),
        information=rng.normal(size=(count, 2, 2)),
    )  # fmt: skip


def test_patches_are_returned_as_they_were_added_also_when_the_tables_grow(rng):
    cameras = worlds.ring(size=(360, 440), focal=560.0)[:2]
    # Tracks of the cameras have even and odd numbers; they begin and end, and some pause.
    added = {
        frame: [batch_of(camera, 2 * (40 * frame + np.flatnonzero(rng.random(200) < 0.7)) + c, rng)
                for c, camera in enumerate(cameras)]
        for frame in (3, 4, 6, 90)
    }  # fmt: skip
    added[7] = []
    kept = KeptPatches()
    for frame, batches in added.items():
        kept.add(frame, batches)
    assert list(kept) == list(added)
    assert len(kept) == 5
    for frame, batches in added.items():
        assert len(kept[frame]) == len(batches)
        for found, batch in zip(kept[frame], batches, strict=True):
            assert found.camera is batch.camera
            for name, values in batch._arrays().items():
                np.testing.assert_array_equal(found._arrays()[name], values)
                assert found._arrays()[name].dtype == values.dtype


def test_a_frame_of_known_tracks_adds_only_their_numbers_places_and_information(rng):
    camera = worlds.ring(size=(360, 440), focal=560.0)[0]
    kept, tracks = KeptPatches(), np.arange(500)
    kept.add(0, [batch_of(camera, tracks, rng)])
    tables = kept._constant.directions
    later = batch_of(camera, tracks[100:], rng)
    kept.add(1, [replace(later, pixels=later.pixels + 1)])
    assert kept._constant.directions is tables
    (seen,) = kept._frames[1]
    assert sum(values.nbytes for values in seen[1:]) == 400 * (4 + 16 + 32)

from collections import Counter
from dataclasses import replace

import numpy as np
from tests import worlds

from marey.body.articulation.pose import SkinPoints
from marey.fit.patches.kept_patches import KeptPatches
from marey.io.stages import FrameLog
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
    log: list[dict[str, np.ndarray]] = []
    kept, tracks = KeptPatches(log), np.arange(500)
    kept.add(0, [batch_of(camera, tracks, rng)])
    tables = kept._constant.directions
    later = batch_of(camera, tracks[100:], rng)
    kept.add(1, [replace(later, pixels=later.pixels + 1)])
    assert kept._constant.directions is tables
    assert sum(values.nbytes for values in log[1].values()) == 400 * (4 + 16 + 32)


def test_lasting_tracks_are_those_of_enough_frames(rng):
    cameras = worlds.ring(size=(360, 440), focal=560.0)[:2]
    kept = KeptPatches()
    seen = {
        frame: [2 * np.flatnonzero(rng.random(60) < 0.5) + c for c in range(2)] for frame in range(5)
    }  # fmt: skip
    seen[2][1] = np.zeros(0, int)
    for frame, tracks in seen.items():
        kept.add(frame, [batch_of(camera, own, rng) for camera, own in zip(cameras, tracks, strict=True)])
    counts = Counter(np.concatenate([own for tracks in seen.values() for own in tracks]).tolist())
    wanted = {track for track, count in counts.items() if count >= 3}
    assert 0 < len(wanted) < len(counts)
    lasting = kept.lasting(3)
    for frame, tracks in seen.items():
        left = [np.array([track for track in own if track in wanted]) for own in tracks]
        found = lasting[frame]
        assert [batch.camera for batch in found] == [c for c, own in zip(cameras, left, strict=True) if len(own)]
        for batch, own in zip(found, [own for own in left if len(own)], strict=True):
            np.testing.assert_array_equal(batch.tracks, own)
            np.testing.assert_array_equal(batch.where.face, 7 * own)
    segments, frames = lasting.lengths()
    assert sorted(frames.tolist()) == sorted(counts[track] for track in wanted)
    assert sorted(segments.tolist()) == sorted(track % 16 for track in wanted)
    # The tracks that did not last are still in the first mapping.
    assert sum(len(batch.tracks) for batch in kept[0]) == sum(map(len, seen[0]))


def test_a_log_on_disk_gives_the_same_patches_as_a_list(tmp_path, rng):
    camera = worlds.ring(size=(360, 440), focal=560.0)[0]
    batches = [batch_of(camera, np.sort(rng.choice(90, 40, replace=False)), rng) for _ in range(4)]
    with FrameLog(tmp_path / "patches.log") as log:
        log.append({"another": np.ones(3)})  # of an earlier tracking, for example
        in_memory, on_disk = KeptPatches(), KeptPatches(log)
        for frame, batch in enumerate(batches):
            for kept in (in_memory, on_disk):
                kept.add(frame, [batch])
        for frame in range(4):
            for found, wanted in zip(on_disk.lasting(2)[frame], in_memory.lasting(2)[frame], strict=True):
                for name, values in wanted._arrays().items():
                    np.testing.assert_array_equal(found._arrays()[name], values)
        np.testing.assert_array_equal(log[0]["another"], np.ones(3))

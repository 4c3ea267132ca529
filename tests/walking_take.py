"""A made take of a person who walks sidewards, in reduced images."""

import numpy as np

from marey.body.articulation.pose import PosedBody
from marey.fit.regions.region_track import RegionTrack
from marey.images.silhouettes.colour_words import learned_words
from marey.observations.correspondence import view_of
from marey.pipelines.silhouettes.small_take import SmallTake
from tests import worlds


def walking_take(rng: np.random.Generator) -> tuple[SmallTake, RegionTrack, np.ndarray]:
    """Ten frames of a grey person who walks sidewards through a coloured room; the room is returned, too."""
    body, cameras = worlds.person(), tuple(worlds.ring(size=(60, 80), focal=60.0))
    rooms = rng.integers(60, 250, (len(cameras), 10, 15, 3)).repeat(8, 1).repeat(4, 2).astype(np.uint8)
    poses = {frame: worlds.pose(body, at=(0.15 * frame - 0.7, 0.0, 0.0)) for frame in range(10)}
    pictures = {}
    for frame, pose in poses.items():
        shown = rooms.copy()
        for c, camera in enumerate(cameras):
            shown[c][view_of(PosedBody(body, pose), camera).mask()] = 20
        pictures[frame] = list(shown)
    words = learned_words([image for images in pictures.values() for image in images])
    track = RegionTrack(body, poses, dict.fromkeys(poses, 1.0), np.zeros((len(cameras), 1, 1)))
    return SmallTake(cameras, pictures, words, (-2, 2)), track, rooms

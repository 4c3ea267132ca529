"""The closed skin that `marey shape` leaves as a moving GLB."""

from dataclasses import replace

import numpy as np
import pytest
from tests import performer, rigs

from marey.body.metaballs.metaball_people import metaball_person
from marey.io.npz import write_motion
from marey.pipelines.shape.shape import write_skin_glb


@pytest.mark.slow
def test_the_skin_moves_as_the_motion_beside_it(tmp_path):
    body = metaball_person("simple", "coarse")
    motion = performer.motion(body)
    write_motion(tmp_path / "motion.npz", motion)
    write_skin_glb(tmp_path, body, warn=lambda text: None)
    document, binary = rigs.open_glb(tmp_path / "skin.glb")
    time, world = rigs.play(document, binary)
    known = np.flatnonzero(motion.answered)
    np.testing.assert_allclose(time, motion.time[known], atol=1e-6)
    hand = motion.segment_origin[known, motion.segment_names.index("left_hand")]
    np.testing.assert_allclose(world["left_hand"][:, :3, 3], hand @ [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-5)
    faces = document["accessors"][document["meshes"][0]["primitives"][0]["indices"]]["count"] // 3
    vertices = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]["count"]
    assert faces == 2 * vertices - 4, "a closed surface without handles"


@pytest.mark.slow
def test_metaballs_that_fall_apart_have_no_skin_and_it_is_reported(tmp_path):
    body = metaball_person("simple", "coarse")
    assert body.metaballs is not None
    mean = body.metaballs.mean
    thin = np.where((mean.segment == body.skeleton.segment("left_shank"))[:, None], 1e-3, 1.0)
    body = replace(body, metaballs=replace(body.metaballs, mean=replace(mean, radii=mean.radii * thin)))
    warnings: list[str] = []
    write_skin_glb(tmp_path, body, warn=warnings.append)
    assert warnings == ["There is no skin.glb. The metaballs leave a gap in the left leg: its skin cannot be sampled."]
    assert not (tmp_path / "skin.glb").exists()

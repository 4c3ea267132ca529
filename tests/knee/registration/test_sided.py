import numpy as np
import pytest
import trimesh
from tests.made_bones import made_bone

from marey.errors import MareyError
from marey.geometry.rigid import RigidTransform
from marey.knee.registration.rigid import RigidSettings
from marey.knee.registration.sided import SideSettings, register_on_either_side
from marey.knee.space.sides import mirrored
from marey.knee.space.surface import TriangleSurface


@pytest.mark.slow
def test_a_template_of_the_other_side_and_another_size_is_mirrored_by_itself():
    template, subject = mirrored(made_bone(seed=1, fine=2)), made_bone(seed=1, size=1.1, shaft_mm=55.0, fine=2)
    motion = RigidTransform.from_vector(np.radians([5.0, -8, 6]), np.array([10.0, 5, -8]))
    moved = TriangleSurface(vertices_mm=motion.apply(subject.vertices_mm), faces=subject.faces)
    found = register_on_either_side(template, moved)
    assert found.mirrored
    assert found.clear
    assert found.other_side_mm < 0.1 < found.same_side_mm


@pytest.mark.slow
def test_a_bone_that_is_its_own_mirror_image_is_reported_as_uncertain():
    ball = trimesh.creation.icosphere(subdivisions=3)
    bone = TriangleSurface(vertices_mm=ball.vertices * (18, 8, 24), faces=ball.faces)
    found = register_on_either_side(bone, bone)
    assert not found.clear


@pytest.mark.slow
def test_a_given_side_is_used_without_trying_the_other():
    bone = made_bone(fine=2)
    found = register_on_either_side(mirrored(bone), bone, mirror=True)
    assert found.mirrored
    assert found.clear
    assert np.isnan(found.same_side_mm)


@pytest.mark.slow
def test_the_settings_of_the_rigid_registration_reach_both_sides():
    bone = made_bone(fine=2)
    strict = SideSettings(rigid=RigidSettings(least_share=1.1))
    for mirror in (None, True):
        with pytest.raises(MareyError):
            register_on_either_side(bone, bone, mirror=mirror, settings=strict)
    assert register_on_either_side(bone, bone, mirror=False, settings=SideSettings(clear_ratio=2.0)).clear_ratio == 2.0


@pytest.mark.slow
def test_what_fits_on_neither_side_is_an_error():
    # With coarser meshes it depends on rounding whether a rigid fit is found.
    bone = made_bone(fine=3)
    with pytest.raises(MareyError, match="same bone"):
        register_on_either_side(bone, TriangleSurface(vertices_mm=6 * bone.vertices_mm, faces=bone.faces))

import numpy as np
import pytest
from tests.made_bones import made_bone

from marey.errors import MareyError
from marey.geometry.rigid import RigidTransform
from marey.knee.registration.rigid import register_rigidly
from marey.knee.space.sides import mirrored
from marey.knee.space.surface import TriangleSurface


def far_motion(rng: np.random.Generator, bone: TriangleSurface) -> RigidTransform:
    """30 degrees about the bone's middle and 30 mm, in any direction."""
    axis, shift = rng.normal(size=(2, 3))
    middle = bone.vertices_mm.mean(0)
    turn = RigidTransform.from_vector(np.radians(30) * axis / np.linalg.norm(axis), np.zeros(3)).rotation
    return RigidTransform(turn, middle - turn @ middle + 30 * shift / np.linalg.norm(shift))


def moved(surface: TriangleSurface, motion: RigidTransform) -> TriangleSurface:
    return TriangleSurface(vertices_mm=motion.apply(surface.vertices_mm), faces=surface.faces)


def apart(found: RigidTransform, true: RigidTransform, bone: TriangleSurface) -> tuple[float, float]:
    """Degrees, and millimetres of the middle."""
    middle = bone.vertices_mm.mean(0)
    turn = (found @ true.inverse()).rotation_vector
    return float(np.degrees(np.linalg.norm(turn))), float(np.linalg.norm(found.apply(middle) - true.apply(middle)))


@pytest.mark.slow
def test_a_bone_is_registered_from_30_degrees_and_30_mm_with_another_mesh_and_a_shorter_shaft(rng):
    template = made_bone(shaft_mm=60.0, fine=4)
    for _ in range(2):
        true = far_motion(rng, template)
        found = register_rigidly(template, moved(made_bone(shaft_mm=40.0, fine=5), true))
        degrees, mm = apart(found.subject_from_template, true, template)
        # The coarser mesh cuts its corners by up to an edge's square over eight radii, 0.04 mm, everywhere alike.
        assert degrees < 0.1
        assert mm < 0.1
        assert found.residual_mm < 0.1


@pytest.mark.slow
def test_the_stated_standard_deviations_are_those_due_to_noise(rng):
    template, whitened = made_bone(fine=3), []
    middle = template.vertices_mm.mean(0)
    for length in (2.0, 5.0):
        # Noise as of a segmentation, smooth over some millimetres.
        waves, phases = rng.normal(0, 1 / length, (60, 3)), rng.uniform(0, 6.3, 60)
        bumps = 0.4 * np.sqrt(2 / 60) * np.cos(template.vertices_mm @ waves.T + phases).sum(1)
        noisy = TriangleSurface(
            vertices_mm=template.vertices_mm + bumps[:, None] * template.vertex_normals, faces=template.faces
        )
        found = register_rigidly(template, noisy, RigidTransform.identity())
        off = found.subject_from_template.apply(middle) - middle
        whitened.append(np.r_[found.subject_from_template.rotation_vector, off] / np.sqrt(np.diag(found.covariance)))
    # Twelve partly correlated numbers.
    assert 0.3 < np.sqrt(np.mean(np.square(whitened))) < 1.7


def test_a_mirrored_bone_is_mirrored_back():
    bone = made_bone(fine=3)
    other = mirrored(bone)
    assert other.volume_mm3 == pytest.approx(bone.volume_mm3)
    np.testing.assert_allclose(mirrored(other).vertices_mm, bone.vertices_mm)
    np.testing.assert_allclose(other.vertex_normals, bone.vertex_normals * (-1, 1, 1), atol=1e-12)


@pytest.mark.slow
def test_unrelated_surfaces_are_reported():
    bone = made_bone(fine=3)
    with pytest.raises(MareyError, match="same bone"):
        register_rigidly(
            bone, TriangleSurface(vertices_mm=5 * bone.vertices_mm, faces=bone.faces), RigidTransform.identity()
        )

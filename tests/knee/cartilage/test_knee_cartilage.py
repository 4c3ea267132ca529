import numpy as np
import pytest
import trimesh

from marey.errors import MareyError
from marey.knee.cartilage.knee_cartilage import knee_template
from marey.knee.space.surface import TriangleSurface


def ball(radius: float, middle=(0.0, 0.0, 0.0)) -> TriangleSurface:
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    return TriangleSurface(vertices_mm=mesh.vertices + middle, faces=mesh.faces)


def test_a_useless_cartilage_of_the_template_is_named_and_the_others_are_kept():
    parts = {
        "femur": ball(20.0),
        "tibia": ball(20.0, (0, 0, -50)), "tibial_cartilage": ball(5.0, (90, 0, 0)),
        "patellar_cartilage": ball(3.0, (0, -60, 0)),
    }  # fmt: skip
    parts["femoral_cartilage"] = TriangleSurface(
        vertices_mm=np.concatenate([ball(20.0).vertices_mm, ball(22.0).vertices_mm]),
        faces=np.concatenate([ball(20.0).faces[:, ::-1], ball(22.0).faces + len(ball(20.0).vertices_mm)]),
    )
    template = knee_template(parts)
    assert list(template.bones) == ["femur"]
    np.testing.assert_allclose(template.thickness_mm["femur"], 2.0, atol=0.05)
    assert "does not lie on the bone" in template.unusable["tibia"]
    assert "no patella" in template.unusable["patella"]
    with pytest.raises(MareyError, match="no bone together"):
        knee_template({"tibial_cartilage": ball(5.0)})

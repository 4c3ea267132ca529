"""Made bones: lumpy, with a shaft that is cut off, of a shape known in closed form."""

import numpy as np
import trimesh

from marey.knee.space.surface import TriangleSurface


def made_bone(*, shaft_mm: float = 60.0, seed: int = 0, size: float = 1.0, fine: int = 4) -> TriangleSurface:
    """A knob of two unlike condyles under a shaft that ends in a plane at z = shaft_mm; the seed makes the lumps."""
    ball = trimesh.creation.icosphere(subdivisions=fine)
    u = np.asarray(ball.vertices)
    draw = np.random.default_rng(seed)
    lumps = sum(draw.uniform(-1.0, 1.0) * np.cos(u @ draw.normal(0, 2.5, 3) + draw.uniform(0, 6)) for _ in range(6))
    condyles = 10 * np.exp(-8 * ((u - (0.8, -0.2, -0.5)) ** 2).sum(1)) + 6 * np.exp(
        -8 * ((u - (-0.8, 0.3, -0.45)) ** 2).sum(1)
    )
    knob = 22.0 + lumps + condyles
    points = u * knob[:, None]
    up = np.clip((u[:, 2] - 0.3) / 0.7, 0, 1)
    # The upper part is drawn out to a shaft, and cut.
    points[:, 2] += 90.0 * up**2
    points[:, :2] *= (1 - 0.35 * up)[:, None]
    points *= size
    points[:, 2] = np.minimum(points[:, 2], shaft_mm)
    return TriangleSurface(vertices_mm=points, faces=np.asarray(ball.faces))

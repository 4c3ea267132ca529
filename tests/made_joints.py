"""Made joints in closed form: two round condyles over a flat tibial cartilage, a patella before them."""

import numpy as np
import trimesh

from marey.knee.space.surface import TriangleSurface

RADIUS_MM, APART_MM, THICK_MM = 20.0, 44.0, 2.0


def _joined(*meshes: trimesh.Trimesh) -> TriangleSurface:
    whole = trimesh.util.concatenate(meshes)
    return TriangleSurface(vertices_mm=whole.vertices, faces=whole.faces)


def _slab(size: tuple[float, float, float], middle: tuple[float, float, float], edge: float = 1.6) -> trimesh.Trimesh:
    mesh = trimesh.creation.box(size)
    while mesh.edges_unique_length.max() > edge * 1.8:
        mesh = mesh.subdivide()
    mesh.apply_translation(middle)
    return mesh


def _ball(radius: float, middle: tuple[float, float, float], fine: int) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=fine, radius=radius)
    mesh.apply_translation(middle)
    return mesh


def _shell(radius: float, middle: tuple[float, float, float], fine: int) -> trimesh.Trimesh:
    """The lower cap of a sphere with the bone's own surface beneath it: closed, `THICK_MM` thick."""
    outer = trimesh.creation.icosphere(subdivisions=fine, radius=1.0)
    covered = outer.vertices[:, 2] < 0.25
    faces = outer.faces[covered[outer.faces].all(1)]
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    directed = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    _, place, count = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    rim, total = directed[count[place.reshape(-1)] == 1], len(outer.vertices)
    back = rim[:, ::-1]
    walls = np.concatenate([np.c_[back, rim[:, :1] + total], np.c_[rim[:, 1:], rim + total]])
    vertices = np.concatenate([outer.vertices * radius, outer.vertices * (radius - THICK_MM)])
    mesh = trimesh.Trimesh(vertices, np.concatenate([faces, faces[:, ::-1] + total, walls]), process=False)
    mesh.remove_unreferenced_vertices()
    mesh.apply_translation(middle)
    return mesh


def made_joint(*, left: bool = False, gap_mm: float = 1.0, fine: int = 4) -> dict[str, TriangleSurface]:
    """A knee in LPS mm, straight: the lowest place of each condyle's cartilage lies so far above the tibial one.

    The tibial cartilage's upper side is the plane z = 0; medial is towards the body's middle, the patella in front (-y)
    and to the lateral side. The condyles' middles are at x = +-22 mm, y = 0.
    """
    height, half = RADIUS_MM + gap_mm, APART_MM / 2
    lateral = 1.0 if left else -1.0
    femur = [_ball(RADIUS_MM - THICK_MM, (side * half, 0.0, height), fine) for side in (1, -1)]
    femur.append(_slab((50.0, 24.0, 60.0), (0.0, 4.0, height + 30.0), edge=8.0))
    caps = [_shell(RADIUS_MM, (side * half, 0.0, height), fine) for side in (1, -1)]
    plates = [_slab((34.0, 40.0, THICK_MM), (side * half, 0.0, -THICK_MM / 2)) for side in (1, -1)]
    tibia = [_slab((84.0, 46.0, 20.0), (0.0, 0.0, -THICK_MM - 10.0), edge=4.0)]
    tibia.append(_slab((30.0, 26.0, 50.0), (0.0, 0.0, -THICK_MM - 40.0), edge=8.0))
    patella = _slab((34.0, 12.0, 34.0), (6.0 * lateral, -RADIUS_MM - 12.0, height + 8.0), edge=4.0)
    facet = _slab((30.0, THICK_MM, 28.0), (6.0 * lateral, -RADIUS_MM - 5.0, height + 8.0))
    return {
        "femur": _joined(*femur), "femoral_cartilage": _joined(*caps),
        "tibia": _joined(*tibia), "tibial_cartilage": _joined(*plates),
        "patella": _joined(patella), "patellar_cartilage": _joined(facet),
    }  # fmt: skip

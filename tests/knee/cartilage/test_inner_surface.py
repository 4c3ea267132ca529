import numpy as np
import pytest
import trimesh
from scipy.special import ndtr

from marey.knee.cartilage.evidence import DEPTHS_MM, Profiles, Tissues
from marey.knee.cartilage.inner_surface import OFFSETS_MM, inner_costs, inner_edge
from marey.knee.space.mesh_graph import MeshGraph
from marey.knee.space.surface import TriangleSurface

SPREAD, BLUR = 0.05, 0.4


def layered(offset: np.ndarray, thick: np.ndarray, marrow: float, over: float) -> np.ndarray:
    inner, outer = (ndtr((DEPTHS_MM - each[:, None]) / BLUR) for each in (offset, offset + thick))
    return marrow + (1 - marrow) * inner + (over - 1) * outer


def costs_of(values: np.ndarray, marrow: float, thick: np.ndarray, at: np.ndarray) -> np.ndarray:
    every = np.ones(len(values))
    profiles = Profiles(values=values, blur_mm=BLUR * every, correlation_mm=0.5 * every)
    seen = Tissues(relative=values, marrow=marrow * every, spread=SPREAD, over=np.ones(100) / 4)
    return inner_costs(profiles, seen, thick, every > 0, at)


@pytest.mark.parametrize(("marrow", "over"), [(0.12, 0.25), (1.5, 1.6), (1.5, 0.3), (0.12, 1.0)])
@pytest.mark.parametrize("thick", [1.2, 3.0])
def test_the_inner_edge_is_found_wherever_the_profile_begins(rng, marrow, over, thick):
    offset = rng.uniform(-1, 1, 300)
    at = np.full(300, 0.2)  # The profiles begin beside the surface that was found.
    rest = thick * np.ones(300) + offset - at
    values = layered(offset - at, thick * np.ones(300), marrow, over) + rng.normal(0, SPREAD, (300, len(DEPTHS_MM)))
    best = OFFSETS_MM[costs_of(values, marrow, rest, at).argmin(1)]
    # The positions lie 0.2 mm apart, so that a single result has an error of up to 0.1 mm.
    assert abs((best - offset).mean()) < 0.06
    assert (best - offset).std() < 0.2


def test_costs_are_zero_without_a_visible_edge_and_with_a_dark_line():
    thick, at = np.full(2, 2.0), np.zeros(2)
    values = layered(np.full(2, 0.6), thick, 1.5, 0.3)
    assert np.ptp(costs_of(values, 1.5, thick, at), axis=1).min() > 1
    line = values - 1.2 * np.exp(-0.5 * (DEPTHS_MM / 0.4) ** 2)
    assert not costs_of(line, 1.5, thick, at).any()
    assert not costs_of(layered(np.full(2, 0.6), thick, 1.05, 0.3), 1.05, thick, at).any()


def test_the_edge_is_a_smooth_sheet_that_returns_to_the_bone_without_evidence():
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=15.0)
    surface = TriangleSurface(vertices_mm=mesh.vertices, faces=mesh.faces)
    height = mesh.vertices[:, 2]
    costs = np.zeros((len(height), len(OFFSETS_MM)))
    costs[height > 0] = 0.5 * ((OFFSETS_MM - 0.5) / 0.15) ** 2
    stray = int(np.argmax(height))
    costs[stray] = 0.5 * ((OFFSETS_MM + 0.9) / 0.15) ** 2
    found = inner_edge(costs, MeshGraph.of(surface), "bright")
    upper = (height > 3) & (np.linalg.norm(mesh.vertices - mesh.vertices[stray], axis=1) > 3)
    # The prior standard deviation of 0.8 mm has a small effect.
    np.testing.assert_allclose(found.offset_mm[upper], 0.48, atol=0.05)
    assert abs(found.offset_mm[height < -9]).max() < 0.1
    assert found.offset_mm[stray] > -0.4  # It is corrected by its neighbours.
    assert (found.sd_mm[upper] < 0.2).all()
    assert (found.sd_mm[height < -1] > 0.4).all()

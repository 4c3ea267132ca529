"""Recovered shapes in files: what other programs read from them is the shapes themselves."""

import numpy as np
import pytest
import trimesh
from pygltflib import GLTF2

from marey.errors import FileProblem
from marey.geometry import rotations
from marey.io.npz import read_arrays, write_arrays
from marey.io.shapes.shape_glb import write_shape_glb
from marey.io.shapes.shapes import read_shapes, write_point_clouds, write_shapes
from marey.nonrigid.recovered import GAUGES, ONE_VIEW, RankCurve, RecoveredShapes

EDGES = np.array([[0, 1], [1, 4], [2, 3]])


@pytest.fixture
def found(rng):
    """Six frames of five points; the last point and frame 2 have no result."""
    basis = rng.normal(size=(3, 3, 5))
    basis[:, :, 4] = np.nan
    coefficients = np.concatenate([np.ones((6, 1)), rng.normal(size=(6, 2))], 1)
    coefficients[2] = np.nan
    rotation = rotations.exp(rng.normal(size=(6, 3)))
    rotation[2] = np.nan
    shape = np.einsum("fk,kip->fip", coefficients, basis)
    translation = np.where(np.arange(6)[:, None] == 2, np.nan, rng.normal(size=(6, 2)))
    modelled = (rotation @ shape)[:, :2] + translation[:, :, None]
    return RecoveredShapes(
        kind=ONE_VIEW, shape=shape, shape_sd=0.1 * np.abs(shape), rotation=rotation,
        rotation_sd=np.full((6, 3), 0.01), translation=translation, basis=basis, coefficients=coefficients,
        residuals=np.full((1, 6, 5), 0.1), predicted=np.zeros((6, 5), bool), modelled=modelled[None],
        noise_sd=np.array([0.1]), gauge=GAUGES[ONE_VIEW], notes=("a note",),
        curve=RankCurve(ranks=np.arange(1, 4), errors=np.ones(3), errors_sd=np.full(3, np.nan), measure="error"),
    )  # fmt: skip


def test_written_shapes_are_read(tmp_path, found):
    write_shapes(tmp_path / "shapes.npz", found, labels=list("abcde"))
    again = read_shapes(tmp_path / "shapes.npz")
    for name in ("shape", "rotation", "translation", "basis", "coefficients", "residuals", "modelled", "predicted"):
        np.testing.assert_array_equal(getattr(again, name), getattr(found, name))
    assert (again.kind, again.gauge, again.notes) == (found.kind, found.gauge, found.notes)
    assert again.curve.measure == "error"
    arrays = read_arrays(tmp_path / "shapes.npz")
    assert arrays["rank"] == 9
    assert arrays["answered"].tolist() == [True, True, False, True, True, True]


def test_a_file_of_something_else_is_rejected(tmp_path, found):
    write_arrays(tmp_path / "a.npz", {"shape": found.shape})
    with pytest.raises(FileProblem, match="lacks kind"):
        read_shapes(tmp_path / "a.npz")


def test_point_clouds_contain_the_points_with_a_result_and_the_lines_between_them(tmp_path, found):
    write_point_clouds(tmp_path, found, EDGES, scale=2.0, unit="m")
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"frame_{f:05d}.ply" for f in (0, 1, 3, 4, 5)]
    cloud = trimesh.load(tmp_path / "frame_00003.ply")
    np.testing.assert_allclose(cloud.vertices, 2 * found.shape[3, :, :4].T, rtol=1e-6)
    head = (tmp_path / "frame_00003.ply").read_bytes().split(b"end_header")[0]
    assert b"element edge 2" in head
    assert b"comment m, " in head


def array_of(glb: GLTF2, number: int) -> np.ndarray:
    accessor = glb.accessors[number]
    view = glb.bufferViews[accessor.bufferView]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor.type]
    kind = {5126: "<f4", 5125: "<u4"}[accessor.componentType]
    return np.frombuffer(glb.binary_blob(), kind, accessor.count * width, view.byteOffset).reshape(-1, width)


def test_targets_weights_and_the_node_make_every_frame_of_the_glb(tmp_path, found):
    write_shape_glb(tmp_path / "a.glb", found, EDGES, rate=10.0, scale=0.5, unit="px", y_up=False)
    glb = GLTF2().load(str(tmp_path / "a.glb"))
    points, lines = glb.meshes[0].primitives
    assert (points.mode, lines.mode) == (0, 1)
    assert array_of(glb, lines.indices).reshape(-1, 2).tolist() == [[0, 1], [2, 3]]
    targets = [array_of(glb, target["POSITION"]) for target in points.targets]
    values = {
        c.target.path: array_of(glb, glb.animations[0].samplers[c.sampler].output) for c in glb.animations[0].channels
    }
    time = array_of(glb, glb.animations[0].samplers[0].input)[:, 0]
    np.testing.assert_allclose(time, [0, 0.1, 0.3, 0.4, 0.5], atol=1e-7)
    weights = values["weights"].reshape(5, 2)
    turn = rotations.from_quaternion(values["rotation"][:, [3, 0, 1, 2]])
    places = array_of(glb, points.attributes.POSITION) + np.einsum("fk,kpi->fpi", weights, np.array(targets))
    got = np.einsum("fij,fpj->fpi", turn, places) + values["translation"][:, None]
    frames = [0, 1, 3, 4, 5]
    # x right, y down, z ahead of the camera are x, -y, -z of glTF, where Y is up and -Z ahead.
    wanted = 0.5 * np.moveaxis(found.placed[frames][:, :, :4], 1, 2) * [1, -1, -1]
    away = got - wanted
    np.testing.assert_allclose(away - away[0, 0], 0, atol=1e-5)

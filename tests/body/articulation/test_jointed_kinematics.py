"""A jointed body: the kernel against the plain formula, twists against differences, couplings."""

import numpy as np
import pytest
from tests.jointed import leg, walking

from marey.body.articulation.coordinate_functions import linear
from marey.body.articulation.jointed_body import Coupling, JointedBody, ModelBody, ModelCoordinate, ModelMarker
from marey.body.articulation.jointed_kinematics import coordinate_slopes, linearised, place, place_bodies
from marey.errors import MareyError
from marey.geometry import rotations


def test_the_kernel_places_the_bodies_as_the_formula_does():
    body = leg()
    packed = body.packed
    motions = len(packed.turns)
    rotation, origin = np.empty((5, 3, 3)), np.empty((5, 3))
    axes, points, slopes = np.empty((motions, 3)), np.empty((motions, 3)), np.empty(motions)
    for values in walking(body, 5):
        place_bodies(packed, values, rotation, origin, axes, points, slopes)
        placed = place(body, values)
        assert np.allclose(rotation, placed.rotation, atol=1e-14)
        assert np.allclose(origin, placed.origin, atol=1e-14)


@pytest.mark.parametrize("size", [1.0, 1e3])
def test_the_twists_are_differences_of_places_at_any_scale_of_length(size):
    body = leg(locked=())
    values = walking(body, 4)[1]
    values[:3] *= size
    placed = place(body, values)
    for name in body.coordinate_names:
        if name == "patella":
            continue
        c, h = body.coordinate(name), 1e-6
        ahead, behind = (values + sign * h * np.eye(len(values))[c] for sign in (1, -1))
        ahead, behind = place(body, body.coupled(ahead)), place(body, body.coupled(behind))
        turn = rotations.log(ahead.rotation @ behind.rotation.transpose(0, 2, 1)) / (2 * h)
        shift = (ahead.origin - behind.origin) / (2 * h)
        velocity, spin = placed.twists[:, c, :3], placed.twists[:, c, 3:]
        assert np.allclose(spin, turn, atol=1e-8)
        assert np.allclose(velocity + np.cross(spin, placed.origin), shift, atol=1e-8 * size)


def test_couplings_apply_the_chain_rule():
    body = leg()
    values = walking(body, 3)[2]
    function = body.couplings[0].function
    knee, patella = body.coordinate("knee"), body.coordinate("patella")
    value, slope = function.at(values[knee])
    assert values[patella] == value
    slopes = coordinate_slopes(body, values)
    assert slopes[patella, knee] == slope
    assert slopes[patella, patella] == 0
    assert not body.free[patella]


def test_the_linearised_posture_has_the_slopes_of_the_formula():
    body = leg()
    index, spot = body.marker_bodies(tuple(marker.label for marker in body.markers))
    for values in walking(body, 3):
        *_, slopes = linearised(body.packed, index, spot, values.copy())
        np.testing.assert_array_equal(slopes, coordinate_slopes(body, values))


def test_inconsistent_models_are_rejected():
    a, b = ModelCoordinate(name="a"), ModelCoordinate(name="b")
    root = ModelBody(name="root", parent=None, joint="j")
    with pytest.raises(MareyError, match="circle"):
        JointedBody(
            name="m", bodies=(root,), coordinates=(a, b),
            couplings=tuple(Coupling(dependent=x, independent=y, function=linear(1.0)) for x, y in ("ab", "ba")),
        )  # fmt: skip
    with pytest.raises(MareyError, match="'arm', which is not listed before"):
        JointedBody(name="m", bodies=(ModelBody(name="hand", parent="arm", joint="j"),), coordinates=())
    marker = ModelMarker(label="m", body="head", place=np.zeros(3))
    with pytest.raises(MareyError, match="not a body of the model"):
        JointedBody(name="m", bodies=(root,), coordinates=(), markers=(marker,))
    with pytest.raises(MareyError, match="Two coordinates"):
        JointedBody(name="m", bodies=(root,), coordinates=(a, a))
